"""Faster R-CNN on one level of features (Ren et al. 2015): proposals, regions cut out, and the head on ResNet's C4."""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from sorvolo.lab.training.boxes import Finder, at_most, best_boxes, cell_centres, clipped, suppress

_SIZES_PX = (16, 32, 64, 128, 256)  # of anchors: Faster R-CNN's, an octave finer on either side
_RATIOS = (0.5, 1.0, 2.0)  # of height to width: Faster R-CNN's
_BEFORE = 2000  # anchors kept by their score before suppression
_REGIONS = 75  # that the head looks at, for six frames a second on two cores; crowds need more (docs/train.md)
_PROPOSED_IOU = 0.7  # of two proposals that overlap more, the better one stays
_SUPPRESS_IOU = 0.5  # of two boxes of a class that overlap more, the better one stays
_MOST_GROWTH = 4.135  # log(1000 / 16): a box never grows more than 62 times from its anchor
_SAMPLES = 2  # a side of a region's cell, averaged: Mask R-CNN's four points (He et al. 2017)
_SIDE = 7  # cells of a region


def offsets_from_boxes(boxes: Tensor, anchors: Tensor) -> Tensor:
    """(N, 4) what to add to the anchors, in their own sizes and in logarithms (Faster R-CNN, eq. 2)."""
    size = anchors[:, 2:] - anchors[:, :2]
    wanted = (boxes[:, 2:] - boxes[:, :2]).clamp(min=1e-3)
    shift = ((boxes[:, :2] + boxes[:, 2:]) - (anchors[:, :2] + anchors[:, 2:])) / 2 / size
    return torch.cat([shift, torch.log(wanted / size)], 1)


def boxes_from_offsets(offsets: Tensor, anchors: Tensor) -> Tensor:
    """(N, 4) the inverse of `offsets_from_boxes`."""
    size = anchors[:, 2:] - anchors[:, :2]
    middle = (anchors[:, :2] + anchors[:, 2:]) / 2 + offsets[:, :2] * size
    half = torch.exp(offsets[:, 2:].clamp(max=_MOST_GROWTH)) * size / 2
    return torch.cat([middle - half, middle + half], 1)


@dataclass(frozen=True)
class Proposed:
    """The proposal network's answer for every anchor of a batch: `scores` (N, K) before the sigmoid, `offsets`
    (N, K, 4), `anchors` (K, 4) px."""

    scores: Tensor
    offsets: Tensor
    anchors: Tensor


class ProposalNetwork(nn.Module):
    """A stem of `channels` that come out, then the scores and offsets of the anchors around each feature."""

    shapes: Tensor

    def __init__(self, stem: nn.Module, channels: int, stride: int) -> None:
        super().__init__()
        self.stem, self.stride = stem, stride
        sides = [(size / ratio**0.5, size * ratio**0.5) for size in _SIZES_PX for ratio in _RATIOS]
        shapes = torch.tensor([(-w / 2, -h / 2, w / 2, h / 2) for w, h in sides])
        self.register_buffer("shapes", shapes, persistent=False)
        # objects are rare (Focal Loss, 4.1)
        self.scores = _predictor(channels, len(shapes), 0.01, -4.0)
        self.offsets = _predictor(channels, 4 * len(shapes), 0.001, 0.0)

    def forward(self, features: Tensor) -> Proposed:
        """Features (N, C, H, W) -> every anchor's score and offsets."""
        x = self.stem(features)
        scores = self.scores(x).permute(0, 2, 3, 1).flatten(1)
        offsets = self.offsets(x).permute(0, 2, 3, 1).reshape(len(x), -1, 4)
        x, y = cell_centres(features, self.stride)
        middle = torch.stack([x, y, x, y], -1)
        return Proposed(scores, offsets, (middle[:, :, None] + self.shapes).reshape(-1, 4))


def _predictor(channels: int, out: int, spread: float, bias: float) -> nn.Conv2d:
    layer = nn.Conv2d(channels, out, 1)
    nn.init.normal_(layer.weight, std=spread)
    nn.init.constant_(layer.bias, bias)  # type: ignore[arg-type]
    return layer


def propose(
    proposed: Proposed, index: int, size_px: tuple[Tensor | int, Tensor | int], most: int
) -> Tensor:
    """The best regions of picture `index`, (R, 4) px within its (height, width), `most` of them at most.

    The best anchors are shifted, cut at the edges and suppressed.
    """
    scores = proposed.scores[index].sigmoid()
    best, rows = torch.topk(scores, at_most(_BEFORE, scores))
    boxes = boxes_from_offsets(proposed.offsets[index][rows], proposed.anchors[rows])
    boxes = clipped(boxes, *size_px)
    return boxes[suppress(boxes.detach(), best.detach()[None], most, _PROPOSED_IOU, 0.0)[:, 1]]


class _RoiAlign(torch.autograd.Function):
    """Only to be a single node of the exported graph; training uses `_sampled`."""

    @staticmethod
    def forward(ctx: object, features: Tensor, boxes: Tensor, scale: float) -> Tensor:
        # an export records only the node: values do not matter, and what makes them must not be recorded
        shape = (len(boxes.detach().numpy()), features.detach().numpy().shape[1], _SIDE, _SIDE)
        return torch.from_numpy(np.zeros(shape, np.float32))

    @staticmethod
    def symbolic(g, features, boxes, scale: float):  # type: ignore[no-untyped-def]
        rows = g.op(
            "Gather", g.op("Shape", boxes), g.op("Constant", value_t=torch.tensor([0])), axis_i=0
        )
        batch = g.op("ConstantOfShape", rows, value_t=torch.tensor([0]))
        return g.op(
            "RoiAlign",
            features,
            boxes,
            batch,
            output_height_i=_SIDE,
            output_width_i=_SIDE,
            sampling_ratio_i=_SAMPLES,
            spatial_scale_f=scale,
            mode_s="avg",
            coordinate_transformation_mode_s="half_pixel",
        )


def roi_align(features: Tensor, boxes: Tensor, batch: Tensor, stride: int) -> Tensor:
    """(R, C, 7, 7) means of the features (N, C, H, W) in boxes (R, 4) px of pictures `batch` (R,).

    As ONNX's RoiAlign: bilinear, half-pixel centres, two by two samples a cell (He et al. 2017, Mask R-CNN).
    """
    if torch.onnx.is_in_onnx_export():
        return _RoiAlign.apply(features, boxes, 1.0 / stride)  # type: ignore[no-untyped-call]
    height, width = features.shape[-2:]
    points = _SIDE * _SAMPLES
    steps = (torch.arange(points, dtype=features.dtype, device=features.device) + 0.5) / points
    x = (boxes[:, 0:1] + steps * (boxes[:, 2:3] - boxes[:, 0:1])) / stride
    y = (boxes[:, 1:2] + steps * (boxes[:, 3:4] - boxes[:, 1:2])) / stride
    x, y = x.clamp(0.5, width - 0.5) * 2 / width - 1, y.clamp(0.5, height - 0.5) * 2 / height - 1
    out = features.new_zeros(len(boxes), features.shape[1], _SIDE, _SIDE)
    for index in range(len(features)):
        rows = (batch == index).nonzero()[:, 0]
        if not len(rows):
            continue
        # the regions of one picture as one tall grid, so that its features are not copied for each
        lines, columns = y[rows][:, :, None], x[rows][:, None, :]
        shape = (len(rows), points, points)
        grid = torch.stack([columns.expand(shape), lines.expand(shape)], -1)
        flat = grid.reshape(1, -1, points, 2)
        seen = functional.grid_sample(features[index : index + 1], flat, align_corners=False)
        seen = seen[0].reshape(features.shape[1], len(rows), points, -1).transpose(0, 1)
        out = out.index_copy(0, rows, functional.avg_pool2d(seen, _SAMPLES))
    return out


class StageHead(nn.Module):
    """A network's last stage as the head, as Faster R-CNN has on ResNet's C4: `stage` takes (R, C, 7, 7)."""

    def __init__(self, stage: nn.Module, channels: int, classes: int) -> None:
        super().__init__()
        self.stage = stage
        self.scores, self.offsets = nn.Linear(channels, classes + 1), nn.Linear(channels, 4)
        nn.init.normal_(self.scores.weight, std=0.01)
        nn.init.normal_(self.offsets.weight, std=0.001)

    def forward(self, pooled: Tensor) -> tuple[Tensor, Tensor]:
        """(R, C, 7, 7) -> scores (R, classes + 1) before the softmax, background last, and offsets (R, 4)."""
        x = self.stage(pooled).mean((2, 3))
        return self.scores(x), self.offsets(x)


class FasterRCNN(Finder):
    """Backbone, proposal network and head."""

    least_score = 0.02

    def __init__(self, backbone: nn.Module, proposals: ProposalNetwork, head: StageHead) -> None:
        super().__init__()
        self.backbone, self.proposals, self.head = backbone, proposals, head

    def classify(self, features: Tensor, regions: Tensor, batch: Tensor) -> tuple[Tensor, Tensor]:
        """Scores (R, classes + 1) before the softmax and offsets (R, 4) of regions (R, 4) of pictures `batch` (R,)."""
        return self.head(roi_align(features, regions, batch, self.proposals.stride))

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """As `Finder` has it."""
        features = self.backbone(images)
        size_px = images.shape[2], images.shape[3]
        regions = propose(self.proposals(features), 0, size_px, _REGIONS)
        batch = torch.zeros_like(regions[:, 0], dtype=torch.int64)
        scores, offsets = self.classify(features, regions, batch)
        boxes = clipped(boxes_from_offsets(offsets, regions), *size_px)
        return best_boxes(boxes, scores.softmax(1)[:, :-1].T, _SUPPRESS_IOU, self.least_score)
