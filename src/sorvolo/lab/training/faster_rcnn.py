"""The whole detector: Faster R-CNN (Ren et al. 2015) with the proposal network that the thesis extends (its 3.3.2)."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor, nn
from torch.nn import functional

from sorvolo.lab.training.backbones import (
    Depthwise,
    EfficientNetLite0,
    FeaturePyramid,
    convolution,
    load_stage,
    separable,
)
from sorvolo.lab.training.regions import (
    StageHead,
    TwoLayerHead,
    at_most,
    boxes_from_offsets,
    clipped,
    pooled_levels,
    suppress,
)
from sorvolo.lab.training.weights import ImageNetWeights, Net

Stem = Literal["standard", "extended", "extended-residual"]

_PROPOSED_IOU = 0.7  # of two proposals that overlap more, the better one stays (Ren et al. 2015)
_MOST_FOUND = 300  # detections of one picture
_SUPPRESS_IOU = 0.5  # of two boxes of a class that overlap more, the better one stays
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
) -> tuple[Tensor, Tensor]:
    """The best regions of picture `index`, (R, 4) px within its (height, width), and their scores 0 to 1, (R,).

    The best `before` anchors are shifted, cut at the edges and suppressed; `after` of them remain at most.
    """
    scores = proposed.scores[index].sigmoid()
    best, rows = torch.topk(scores, at_most(before, scores))
    boxes = boxes_from_offsets(proposed.offsets[index][rows], proposed.anchors[rows])
    boxes = clipped(boxes, *size_px)
    kept = suppress(boxes.detach(), best.detach()[None], after, _PROPOSED_IOU, 0.0)[:, 1]
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
    """Ours: the standard convolution, to which Inception branches learn to add; at first they add nothing.

    For pictures on a laptop: it filters by 3x3, 5x5 and 7x7, channel by channel, side by side, and mixes the three with
    its input.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.channels = channels
        self.standard = separable(channels, 3)
        self.added = nn.Sequential(_LightInception(channels))

    def forward(self, features: Tensor) -> Tensor:
        """(N, channels, H, W) -> (N, channels, H, W)."""
        return self.added(self.standard(features))


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
    return ResidualStack(channels)


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


@dataclass(frozen=True)
class Reach:
    """How many regions are looked at, and what is reported in the end."""

    before: int = 800  # anchors kept by their score before suppression
    regions: int = 300  # regions that the head looks at
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
        kept = suppress(boxes, shares.contiguous(), _MOST_FOUND, _SUPPRESS_IOU, reach.least_score)
        labels, rows = kept[:, 0], kept[:, 1]
        found = shares.T[rows, labels]
        best, order = torch.topk(found, at_most(_MOST_FOUND, found))
        return boxes[rows][order], best, labels[order]


Preset = Literal["fast", "thesis"]

_FAST_ANCHORS = (
    AnchorSettings((7, 11, 17)),
    AnchorSettings((25, 37, 54)),
    AnchorSettings((80, 120, 190)),
)
_FAST_WIDTH = 64  # channels of the pyramid; by choice, for speed


def fast(
    classes: Sequence[str], rpn: Stem = "extended-residual", *, thaw_all: bool = False
) -> FasterRCNN:
    """For a laptop without a GPU: EfficientNet-Lite0 up to stride 16, a light pyramid down to stride 4, slim stacks."""
    backbone = EfficientNetLite0(thaw_all=thaw_all)
    neck = FeaturePyramid(backbone.channels, _FAST_WIDTH)
    proposals = ProposalNetwork(
        neck.channels, backbone.strides, _FAST_ANCHORS, rpn, _FAST_WIDTH, light=True
    )
    head = TwoLayerHead(_FAST_WIDTH, 160, len(classes))
    return FasterRCNN(backbone, neck, proposals, head, Reach())


NETS: Mapping[Preset, Net] = {"fast": "lite0", "thesis": "resnet50"}
"""The backbone whose ImageNet weights a preset starts from."""


def build(
    preset: Preset,
    classes: Sequence[str],
    rpn: Stem,
    weights: ImageNetWeights | None,
    *,
    original: bool = False,
) -> FasterRCNN:
    """The preset's network, its backbone (and the thesis's head) with `weights`; without, as chance has it.

    Without weights everything is learnt from nothing: no layer is frozen then, and `original` may be chosen.
    """
    if preset == "fast":
        model = fast(classes, rpn, thaw_all=weights is None)
    else:
        from sorvolo.lab.thesis.network import thesis_network

        original = original if weights is None else weights.original
        model = thesis_network(classes, rpn, original=original, frozen=weights is not None)
    if weights is None:
        return model
    model.backbone.load_imagenet(dict(weights.layers))  # type: ignore[operator]
    if isinstance(model.head, StageHead):
        load_stage(model.head.stage, 4, weights.layers)  # type: ignore[arg-type]
    return model
