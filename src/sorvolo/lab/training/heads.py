"""Regions of the features, cut out at one size, to classes and boxes."""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

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

    def __init__(self, channels: int, width: int, classes: int, *, side: int = 7) -> None:
        super().__init__()
        self.side = side
        self.layers = nn.Sequential(
            nn.Flatten(),
            nn.Linear(channels * side * side, width),
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

    def __init__(self, stage: nn.Module, channels: int, classes: int, *, side: int = 7) -> None:
        super().__init__()
        self.side, self.stage = side, stage
        self.scores, self.offsets = nn.Linear(channels, classes + 1), nn.Linear(channels, 4)
        nn.init.normal_(self.scores.weight, std=0.01)
        nn.init.normal_(self.offsets.weight, std=0.001)

    def forward(self, pooled: Tensor) -> tuple[Tensor, Tensor]:
        """(R, C, side, side) -> scores (R, classes + 1) before the softmax, offsets (R, 4)."""
        x = self.stage(pooled).mean((2, 3))
        return self.scores(x), self.offsets(x)
