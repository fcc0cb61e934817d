"""The whole detector: Faster R-CNN (Ren et al. 2015) with the proposal network that the thesis extends (its 3.3.2)."""

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from sorvolo.lab.training.boxes import at_most, boxes_from_offsets, clipped, suppress
from sorvolo.lab.training.heads import StageHead, TwoLayerHead, pooled_levels
from sorvolo.lab.training.proposals import ProposalNetwork, Proposed, propose


@dataclass(frozen=True)
class Reach:
    """How many regions are looked at, and what is reported in the end."""

    before: int = 800  # anchors kept by their score before suppression
    regions: int = 300  # regions that the head looks at
    most: int = 300  # detections of one picture
    suppress_iou: float = 0.5  # of two boxes of a class that overlap more, the better one stays
    least_score: float = 0.02


class FasterRCNN(nn.Module):
    """Backbone, neck (a pyramid, or nothing), proposal network and head; the parts are given, the forward is the same.

    `stride` is what the sides of its input must be multiples of.
    """

    def __init__(
        self,
        backbone: nn.Module,
        neck: nn.Module,
        proposals: ProposalNetwork,
        head: TwoLayerHead | StageHead,
        reach: Reach = Reach(),
    ) -> None:
        super().__init__()
        self.backbone, self.neck, self.proposals, self.head, self.reach = (
            backbone,
            neck,
            proposals,
            head,
            reach,
        )
        self.stride = max(32, *proposals.strides)

    def features(self, images: Tensor) -> list[Tensor]:
        """What all later parts share: pictures (N, 3, H, W), RGB 0 to 255, to a tensor per level."""
        return self.neck(self.backbone(images.float()))

    def classify(
        self, levels: list[Tensor], regions: Tensor, batch: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Scores (R, classes + 1) before the softmax and offsets (R, 4) of regions (R, 4) of pictures `batch` (R,)."""
        return self.head(
            pooled_levels(levels, self.proposals.strides, regions, batch, self.head.side)
        )

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """One picture (1, 3, H, W), RGB 0 to 255: boxes (K, 4) px, scores (K,), labels (K,), best first."""
        levels = self.features(images)
        return self.detect(levels, self.proposals(levels), (images.shape[2], images.shape[3]))

    def detect(
        self, levels: list[Tensor], proposed: Proposed, size_px: tuple[int, int]
    ) -> tuple[Tensor, Tensor, Tensor]:
        """What `forward` gives for a picture of that height and width, by its features and what is proposed in it."""
        reach = self.reach
        regions, _ = propose(proposed, 0, size_px, before=reach.before, after=reach.regions)
        scores, offsets = self.classify(
            levels, regions, torch.zeros_like(regions[:, 0], dtype=torch.int64)
        )
        boxes = clipped(boxes_from_offsets(offsets, regions), *size_px)
        shares = scores.softmax(1)[:, :-1].T
        kept = suppress(
            boxes, shares.contiguous(), reach.most, reach.suppress_iou, reach.least_score
        )
        labels, rows = kept[:, 0], kept[:, 1]
        found = shares.T[rows, labels]
        best, order = torch.topk(found, at_most(reach.most, found))
        return boxes[rows][order], best, labels[order]
