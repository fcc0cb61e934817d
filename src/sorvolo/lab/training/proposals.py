"""Where objects may be: anchors over the features, and the network that scores and shifts them."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor, nn
from torch.nn import functional

from sorvolo.lab.training.boxes import at_most, boxes_from_offsets, clipped, suppress
from sorvolo.lab.training.depthwise import Depthwise
from sorvolo.lab.training.feature_pyramid import convolution, separable

Stem = Literal["standard", "extended", "extended-residual"]

RATIOS = (0.5, 1.0, 2.0)  # of height to width: Faster R-CNN's (Ren et al. 2015)


@dataclass(frozen=True)
class AnchorSettings:
    """Anchors of one level: a box of each size (square root of its area, px) in each ratio (height to width)."""

    sizes_px: tuple[float, ...]
    ratios: tuple[float, ...] = (1.0,)

    def shapes(self) -> Tensor:
        """(A, 4) boxes around the origin."""
        rows = [
            (
                -size / ratio**0.5 / 2,
                -size * ratio**0.5 / 2,
                size / ratio**0.5 / 2,
                size * ratio**0.5 / 2,
            )
            for size in self.sizes_px
            for ratio in self.ratios
        ]
        return torch.tensor(rows)


@dataclass(frozen=True)
class Proposed:
    """The proposal network's answer for every anchor of a batch: `scores` (N, K) before the sigmoid, `offsets`
    (N, K, 4), `anchors` (K, 4) px."""

    scores: Tensor
    offsets: Tensor
    anchors: Tensor


class ProposalNetwork(nn.Module):
    """For each level a stem of its own (`proposal_stem`), then the scores and offsets of its anchors."""

    def __init__(
        self,
        channels: Sequence[int],
        strides: Sequence[int],
        anchors: Sequence[AnchorSettings],
        stem: Stem,
        width: int,
        *,
        light: bool,
    ) -> None:
        super().__init__()
        self.strides = tuple(strides)
        self.stems = nn.ModuleList(
            proposal_stem(stem, each, width, light=light) for each in channels
        )
        self.scores, self.offsets = nn.ModuleList(), nn.ModuleList()
        for index, (own, each) in enumerate(zip(self.stems, anchors)):
            shapes = each.shapes()
            self.register_buffer(f"shapes_{index}", shapes, persistent=False)
            out: int = own.channels  # type: ignore[assignment]
            self.scores.append(
                _predictor(out, len(shapes), 0.01, -4.0)
            )  # rare objects (Focal Loss, 4.1)
            self.offsets.append(_predictor(out, 4 * len(shapes), 0.001, 0.0))

    def forward(self, levels: Sequence[Tensor]) -> Proposed:
        """Features (N, C, H, W) of each level -> every anchor's score and offsets, fine levels first."""
        scores, offsets, anchors = [], [], []
        for index, level in enumerate(levels):
            x = self.stems[index](level)
            shapes = self.get_buffer(f"shapes_{index}")
            scores.append(self.scores[index](x).permute(0, 2, 3, 1).flatten(1))
            offsets.append(self.offsets[index](x).permute(0, 2, 3, 1).reshape(len(x), -1, 4))
            anchors.append(_anchors(shapes, level, self.strides[index]))
        return Proposed(torch.cat(scores, 1), torch.cat(offsets, 1), torch.cat(anchors))


def propose(
    proposed: Proposed,
    index: int,
    size_px: tuple[Tensor | int, Tensor | int],
    *,
    before: int,
    after: int,
    iou: float = 0.7,
) -> tuple[Tensor, Tensor]:
    """The best regions of picture `index`, (R, 4) px within its (height, width), and their scores 0 to 1, (R,).

    The best `before` anchors are shifted, cut at the edges and suppressed; `after` of them remain at most.
    """
    scores = proposed.scores[index].sigmoid()
    best, rows = torch.topk(scores, at_most(before, scores))
    boxes = boxes_from_offsets(proposed.offsets[index][rows], proposed.anchors[rows])
    boxes = clipped(boxes, *size_px)
    kept = suppress(boxes.detach(), best.detach()[None], after, iou, 0.0)[:, 1]
    return boxes[kept], best[kept]


class StandardStack(nn.Module):
    """The standard proposal network's one 3x3 convolution."""

    def __init__(self, channels: int, out: int) -> None:
        super().__init__()
        self.convolution = convolution(channels, out, 3)
        self.channels = out

    def forward(self, features: Tensor) -> Tensor:
        """(N, channels, H, W) -> (N, self.channels, H, W)."""
        return self.convolution(features)


class ResidualStack(nn.Module):
    """Ours: the standard convolution, to which a stack of Inception modules learns to add; at first it adds nothing.

    `light` is for pictures on a laptop: each module filters by 3x3, 5x5 and 7x7, channel by channel, side by side, and
    mixes the three with its input. Else the modules are the table's, `scale` times as wide.
    """

    def __init__(
        self, channels: int, out: int, *, light: bool, modules: int = 1, scale: float = 0.25
    ) -> None:
        super().__init__()
        self.channels = out
        self.standard: nn.Module = (
            separable(channels, 3) if light else convolution(channels, out, 3)
        )
        if light:
            if channels != out:
                raise ValueError(f"a light stack keeps its width, {channels}; got {out}")
            self.added = nn.Sequential(*(_LightInception(channels) for _ in range(modules)))
        else:
            from sorvolo.lab.thesis.network import ExtendedStack

            stack = ExtendedStack(channels, scale)
            self.added = nn.Sequential(
                stack, nn.Conv2d(stack.channels, out, 1, bias=False), nn.BatchNorm2d(out)
            )
            nn.init.zeros_(self.added[2].weight)  # type: ignore[arg-type]

    def forward(self, features: Tensor) -> Tensor:
        """(N, channels, H, W) -> (N, self.channels, H, W)."""
        standard = self.standard(features)
        if isinstance(self.added[0], _LightInception):
            return self.added(standard)
        return standard + self.added(features)


class _LightInception(nn.Module):
    def __init__(self, channels: int) -> None:
        super().__init__()
        self.branches = nn.ModuleList(
            nn.Sequential(
                Depthwise(channels, kernel),
                nn.BatchNorm2d(channels),
                nn.ReLU(inplace=True),
            )
            for kernel in (3, 5, 7)
        )
        self.mix = nn.Sequential(
            nn.Conv2d(3 * channels, channels, 1, bias=False), nn.BatchNorm2d(channels)
        )
        nn.init.zeros_(self.mix[1].weight)  # type: ignore[arg-type]

    def forward(self, features: Tensor) -> Tensor:
        mixed = self.mix(torch.cat([branch(features) for branch in self.branches], 1))
        return functional.relu(features + mixed)


def proposal_stem(kind: Stem, channels: int, out: int, *, light: bool) -> nn.Module:
    """What replaces the proposal network's convolution; it has `.channels`, the width that comes out."""
    if kind == "standard":
        if not light:
            return StandardStack(channels, out)
        stem = separable(channels, 3)
        stem.channels = channels  # type: ignore[assignment]
        return stem
    if kind == "extended":
        from sorvolo.lab.thesis.network import ExtendedStack

        return ExtendedStack(channels, 0.125 if light else 1.0)
    return ResidualStack(channels, out, light=light)


def _predictor(channels: int, out: int, spread: float, bias: float) -> nn.Conv2d:
    layer = nn.Conv2d(channels, out, 1)
    nn.init.normal_(layer.weight, std=spread)
    nn.init.constant_(layer.bias, bias)  # type: ignore[arg-type]
    return layer


def _anchors(shapes: Tensor, level: Tensor, stride: int) -> Tensor:
    """(H * W * A, 4) px; a feature's place is the middle of the pixels that it stands for."""
    rows = (torch.arange(level.shape[2], device=level.device) + 0.5) * stride
    columns = (torch.arange(level.shape[3], device=level.device) + 0.5) * stride
    y, x = rows[:, None] + 0 * columns, columns[None] + 0 * rows[:, None]
    middle = torch.stack([x, y, x, y], -1)
    return (middle[:, :, None] + shapes).reshape(-1, 4)
