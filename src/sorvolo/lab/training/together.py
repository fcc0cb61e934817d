"""Two detectors in one graph, of different make, so that they err in different places."""

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from sorvolo.lab.training.boxes import at_most, iou_matrix, suppress
from sorvolo.lab.training.daylight import odds_from_scores, one_hot
from sorvolo.lab.training.faster_rcnn import FasterRCNN
from sorvolo.lab.training.nanodet import CocoDetector


@dataclass(frozen=True)
class TogetherSettings:
    """Which boxes of two detectors are one thing, and what is reported in the end."""

    classes: int = 3
    same_iou: float = 0.5  # of a class, and overlapping so much, two boxes are one thing
    unseen_odds: float = (
        -4.5
    )  # log-odds of what a detector does not report: it reports from -3.9 on
    second_rank: float = (
        1 - 1e-4
    )  # of what the second found, times its score: of equals the first's stays
    most: int = 300  # detections of one picture
    suppress_iou: float = 0.5  # of two boxes of a class that overlap more, the better one stays
    least_score: float = 0.02  # thresholds are far above


class Together(nn.Module):
    """Both look at the picture. A score is the sigmoid of the mean of their log-odds; boxes of one thing are averaged.

    That is a logarithmic opinion pool of equal weights (Genest and Zidek 1986).
    """

    stride = 32

    def __init__(
        self,
        aerial: FasterRCNN,
        coco: CocoDetector,
        settings: TogetherSettings = TogetherSettings(),
    ) -> None:
        """Two networks of the same classes."""
        super().__init__()
        self.aerial, self.coco, self.settings = aerial, coco, settings

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """One picture (1, 3, H, W), RGB 0 to 255: boxes (K, 4) px, scores (K,), labels (K,), best first."""
        reach = self.settings
        one, other = self.aerial(images), self.coco(images)
        boxes, scores, labels = fused(one, other, reach)
        ranks = scores * torch.cat(
            [torch.ones_like(one[1]), torch.ones_like(other[1]) * reach.second_rank]
        )
        by_class = (ranks[:, None] * one_hot(labels, reach.classes)).T
        kept = suppress(
            boxes, by_class.contiguous(), reach.most, reach.suppress_iou, reach.least_score
        )
        rows = kept[:, 1]
        best, order = torch.topk(scores[rows], at_most(reach.most, scores[rows]))
        return boxes[rows][order], best, kept[:, 0][order]


_Found = tuple[Tensor, Tensor, Tensor]  # boxes (N, 4) px, scores (N,), labels (N,)


def fused(one: _Found, other: _Found, settings: TogetherSettings = TogetherSettings()) -> _Found:
    """All boxes of both, (N + M, 4), with the scores and places that both together give them."""
    overlaps = iou_matrix(one[0], other[0]) * (one[2][:, None] == other[2][None])
    parts = [
        _seen_by_both(one, other, overlaps, settings),
        _seen_by_both(other, one, overlaps.T, settings),
    ]
    return (
        torch.cat([parts[0][0], parts[1][0]]),
        torch.cat([parts[0][1], parts[1][1]]),
        torch.cat([one[2], other[2]]),
    )


def _seen_by_both(
    own: _Found, other: _Found, overlaps: Tensor, settings: TogetherSettings
) -> tuple[Tensor, Tensor]:
    """(N, 4) boxes and (N,) scores of what one detector found; `overlaps` (N, M) with what the other did."""
    alone = torch.zeros_like(own[1])[
        :, None
    ]  # a column, so that there is one where the other found nothing
    odds = torch.where(
        overlaps >= settings.same_iou, odds_from_scores(other[1])[None], settings.unseen_odds
    )
    theirs = torch.cat([odds, alone + settings.unseen_odds], 1).amax(1)
    most, nearest = torch.cat([overlaps, alone], 1).max(1)
    places = torch.cat([other[0], torch.zeros(1, 4)])[nearest]
    boxes = torch.where((most >= settings.same_iou)[:, None], (own[0] + places) / 2, own[0])
    return boxes, torch.sigmoid((odds_from_scores(own[1]) + theirs) / 2)
