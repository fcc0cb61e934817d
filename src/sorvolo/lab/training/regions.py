"""Boxes in tensors: overlap, offsets from anchors and back, suppression; alike in training and exported graph."""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from sorvolo.geometry.arrays import Floats, Rows

_MOST_GROWTH = 4.135  # log(1000 / 16): a box never grows more than 62 times from its anchor


def iou_matrix(a: Tensor, b: Tensor) -> Tensor:
    """(N, M) intersection over union of boxes (N, 4) and (M, 4)."""
    shared = _shared(a, b)
    union = (area(a)[:, None] + area(b)[None]).sub_(shared).clamp_(min=1e-9)
    return shared.div_(union)


def cover_matrix(a: Tensor, b: Tensor) -> Tensor:
    """(N, M) share of each box of `a`, (N, 4), that lies within each of `b`, (M, 4)."""
    return _shared(a, b) / area(a)[:, None].clamp(min=1e-9)


def _shared(a: Tensor, b: Tensor) -> Tensor:
    a, b = a.detach(), b.detach()
    far = [torch.minimum(a[:, None, axis], b[None, :, axis]) for axis in (2, 3)]
    sides = [
        side.sub_(torch.maximum(a[:, None, axis], b[None, :, axis]))
        for side, axis in zip(far, (0, 1))
    ]
    return sides[0].clamp_(min=0).mul_(sides[1].clamp_(min=0))


def area(boxes: Tensor) -> Tensor:
    """(N,) of boxes (N, 4)."""
    return (boxes[:, 2] - boxes[:, 0]).clamp(min=0) * (boxes[:, 3] - boxes[:, 1]).clamp(min=0)


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


def clipped(boxes: Tensor, height_px: Tensor | int, width_px: Tensor | int) -> Tensor:
    """The boxes (N, 4) cut at the picture's edges."""
    x = boxes[:, 0::2].clamp(min=0)
    y = boxes[:, 1::2].clamp(min=0)
    x, y = torch.clamp(x, max=width_px), torch.clamp(y, max=height_px)
    return torch.stack([x[:, 0], y[:, 0], x[:, 1], y[:, 1]], 1)


def giou_loss(boxes: Tensor, wanted: Tensor) -> Tensor:
    """(N,) one minus the generalised intersection over union of box pairs (Rezatofighi et al. 2019, eq. 5)."""
    corner, far = (
        torch.maximum(boxes[:, :2], wanted[:, :2]),
        torch.minimum(boxes[:, 2:], wanted[:, 2:]),
    )
    shared = (far - corner).clamp(min=0).prod(1)
    union = (area(boxes) + area(wanted) - shared).clamp(min=1e-6)
    hull = torch.maximum(boxes[:, 2:], wanted[:, 2:]) - torch.minimum(boxes[:, :2], wanted[:, :2])
    around = hull.clamp(min=0).prod(1).clamp(min=1e-6)
    return 1 - shared / union + (around - union) / around


def _suppressed(boxes: Floats, scores: Floats, most: int, iou: float, least_score: float) -> Rows:
    """(K, 3) rows of 0, class, index."""
    rows = []
    x1, y1, x2, y2 = boxes.T
    areas = np.maximum(x2 - x1, 0) * np.maximum(y2 - y1, 0)
    for label, own in enumerate(scores):
        left = np.argsort(-own, kind="stable")
        left = left[own[left] > least_score]
        kept = 0
        while len(left) and kept < most:
            best, left = left[0], left[1:]
            rows.append((0, label, best))
            kept += 1
            wide = np.minimum(x2[best], x2[left]) - np.maximum(x1[best], x1[left])
            high = np.minimum(y2[best], y2[left]) - np.maximum(y1[best], y1[left])
            shared = np.maximum(wide, 0) * np.maximum(high, 0)
            left = left[shared <= iou * np.maximum(areas[best] + areas[left] - shared, 1e-9)]
    return np.array(rows, np.int64).reshape(-1, 3)


class _Suppress(torch.autograd.Function):
    """Greedy suppression as ONNX's NonMaxSuppression does it."""

    @staticmethod
    def forward(
        ctx: object, boxes: Tensor, scores: Tensor, most: int, iou: float, least_score: float
    ) -> Tensor:
        """(K, 3) rows of 0, class, index for boxes (N, 4), scores (C, N); by class, then best first."""
        # in NumPy, so that an export records one node and none of this
        own, theirs = boxes.detach().cpu().numpy(), scores.detach().cpu().numpy()
        kept = _suppressed(own, theirs, most, iou, least_score)
        return torch.from_numpy(kept).to(boxes.device)

    @staticmethod
    def symbolic(g, boxes, scores, most: int, iou: float, least_score: float):  # type: ignore[no-untyped-def]
        """The same as a node of the exported graph."""
        lead = g.op("Constant", value_t=torch.tensor([0]))
        return g.op(
            "NonMaxSuppression",
            g.op("Unsqueeze", boxes, lead),
            g.op("Unsqueeze", scores, lead),
            g.op("Constant", value_t=torch.tensor([most])),
            g.op("Constant", value_t=torch.tensor([iou])),
            g.op("Constant", value_t=torch.tensor([least_score])),
            center_point_box_i=0,
        )


def suppress(boxes: Tensor, scores: Tensor, most: int, iou: float, least_score: float) -> Tensor:
    """(K, 2) class and index of what is kept of boxes (N, 4) with scores (C, N), class by class."""
    return _Suppress.apply(boxes, scores, most, iou, least_score)[:, 1:]  # type: ignore[no-untyped-call]


def at_most(most: int, values: Tensor) -> int:
    """`most`, or how many values there are if fewer: for a topk that the exported graph can do with any picture."""
    if torch.onnx.is_in_onnx_export():
        # stays a tensor, so that the graph counts anew for every picture
        return torch.minimum(torch.tensor(most), torch._shape_as_tensor(values)[0])  # type: ignore[return-value]
    return min(most, len(values))


_CANONICAL_PX = (
    56.0  # a box of this size is looked at on the level of stride 8 (Lin et al. 2017, eq. 1)
)
_SAMPLES = 2  # a side of a cell, averaged: Mask R-CNN's four points (He et al. 2017)


class _RoiAlign(torch.autograd.Function):
    """Only to be a single node of the exported graph; training uses `_sampled`."""

    @staticmethod
    def forward(ctx: object, features: Tensor, boxes: Tensor, scale: float, side: int) -> Tensor:
        # an export records only the node: values do not matter, and what makes them must not be recorded
        shape = (len(boxes.detach().numpy()), features.detach().numpy().shape[1], side, side)
        return torch.from_numpy(np.zeros(shape, np.float32))

    @staticmethod
    def symbolic(g, features, boxes, scale: float, side: int):  # type: ignore[no-untyped-def]
        rows = g.op(
            "Gather", g.op("Shape", boxes), g.op("Constant", value_t=torch.tensor([0])), axis_i=0
        )
        batch = g.op("ConstantOfShape", rows, value_t=torch.tensor([0]))
        return g.op(
            "RoiAlign",
            features,
            boxes,
            batch,
            output_height_i=side,
            output_width_i=side,
            sampling_ratio_i=_SAMPLES,
            spatial_scale_f=scale,
            mode_s="avg",
            coordinate_transformation_mode_s="half_pixel",
        )


def roi_align(features: Tensor, boxes: Tensor, batch: Tensor, stride: int, side: int) -> Tensor:
    """(R, C, side, side) means of the features (N, C, H, W) in boxes (R, 4) px of pictures `batch` (R,).

    As ONNX's RoiAlign: bilinear, half-pixel centres, two by two samples a cell (He et al. 2017, Mask R-CNN).
    """
    if torch.onnx.is_in_onnx_export():
        return _RoiAlign.apply(features, boxes, 1.0 / stride, side)  # type: ignore[no-untyped-call]
    return _sampled(features, boxes, batch, 1.0 / stride, side)


def _sampled(features: Tensor, boxes: Tensor, batch: Tensor, scale: float, side: int) -> Tensor:
    height, width = features.shape[-2:]
    steps = (torch.arange(side * _SAMPLES, dtype=features.dtype, device=features.device) + 0.5) / (
        side * _SAMPLES
    )
    x = boxes[:, 0:1] * scale + steps * (boxes[:, 2:3] - boxes[:, 0:1]) * scale
    y = boxes[:, 1:2] * scale + steps * (boxes[:, 3:4] - boxes[:, 1:2]) * scale
    x, y = x.clamp(0.5, width - 0.5) * 2 / width - 1, y.clamp(0.5, height - 0.5) * 2 / height - 1
    out = features.new_zeros(len(boxes), features.shape[1], side, side)
    for index in range(len(features)):
        rows = (batch == index).nonzero()[:, 0]
        if not len(rows):
            continue
        # the regions of one picture as one tall grid, so that its features are not copied for each
        lines, columns = y[rows][:, :, None], x[rows][:, None, :]
        shape = (len(rows), side * _SAMPLES, side * _SAMPLES)
        grid = torch.stack([columns.expand(shape), lines.expand(shape)], -1)
        flat = grid.reshape(1, -1, side * _SAMPLES, 2)
        seen = functional.grid_sample(features[index : index + 1], flat, align_corners=False)
        seen = seen[0].reshape(features.shape[1], len(rows), side * _SAMPLES, -1).transpose(0, 1)
        out = out.index_copy(0, rows, functional.avg_pool2d(seen, _SAMPLES))
    return out


def pooled_levels(
    levels: Sequence[Tensor], strides: Sequence[int], boxes: Tensor, batch: Tensor, side: int
) -> Tensor:
    """(R, C, side, side) each region from the level that suits its size."""
    if len(levels) == 1:
        return roi_align(levels[0], boxes, batch, strides[0], side)
    size = torch.sqrt(((boxes[:, 2] - boxes[:, 0]) * (boxes[:, 3] - boxes[:, 1])).clamp(min=1.0))
    wanted = torch.floor(torch.log2(size / _CANONICAL_PX) + 3.0)  # log2 of the stride
    least, most = (
        int(torch.log2(torch.tensor(float(each))).round()) for each in (strides[0], strides[-1])
    )
    wanted = wanted.clamp(least, most)
    if not torch.onnx.is_in_onnx_export():
        out = levels[0].new_zeros(len(boxes), levels[0].shape[1], side, side)
        for level, stride in zip(levels, strides):
            rows = (wanted == float(stride.bit_length() - 1)).nonzero()[:, 0]
            out = out.index_copy(0, rows, roi_align(level, boxes[rows], batch[rows], stride, side))
        return out
    places = [(wanted == float(stride.bit_length() - 1)).nonzero()[:, 0] for stride in strides]
    parts = [
        roi_align(level, boxes[rows], batch, stride, side)
        for level, stride, rows in zip(levels, strides, places)
    ]
    # the exporter has no index_copy: put together, then back in order
    return torch.cat(parts)[torch.cat(places).argsort()]


class TwoLayerHead(nn.Module):
    """Two fully connected layers, then scores of the classes and background (last), and one box."""

    side = 7  # cells of a region

    def __init__(self, channels: int, width: int, classes: int) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            nn.Flatten(),
            nn.Linear(channels * self.side * self.side, width),
            nn.ReLU(inplace=True),
            nn.Linear(width, width),
            nn.ReLU(inplace=True),
        )
        self.scores = nn.Linear(width, classes + 1)
        self.offsets = nn.Linear(width, 4)
        nn.init.normal_(self.scores.weight, std=0.01)
        nn.init.normal_(self.offsets.weight, std=0.001)
        nn.init.zeros_(self.offsets.bias)

    def forward(self, pooled: Tensor) -> tuple[Tensor, Tensor]:
        """(R, C, side, side) -> scores (R, classes + 1) before the softmax, offsets (R, 4)."""
        x = self.layers(pooled)
        return self.scores(x), self.offsets(x)


class StageHead(nn.Module):
    """A network's last stage as the head, as Faster R-CNN has on ResNet's C4: `stage` takes (R, C, side, side)."""

    side = 7  # cells of a region

    def __init__(self, stage: nn.Module, channels: int, classes: int) -> None:
        super().__init__()
        self.stage = stage
        self.scores, self.offsets = nn.Linear(channels, classes + 1), nn.Linear(channels, 4)
        nn.init.normal_(self.scores.weight, std=0.01)
        nn.init.normal_(self.offsets.weight, std=0.001)

    def forward(self, pooled: Tensor) -> tuple[Tensor, Tensor]:
        """(R, C, side, side) -> scores (R, classes + 1) before the softmax, offsets (R, 4)."""
        x = self.stage(pooled).mean((2, 3))
        return self.scores(x), self.offsets(x)
