"""The detector's network: NanoDet-g's backbone (RangiLyu 2021), a path aggregation network, a head a stride from 4 on."""

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional

from sorvolo.errors import InputError
from sorvolo.lab.training.boxes import Finder, at_most, best_boxes, cell_centres, clipped

BINS = 11
"""A box's side is 0 to 10 strides from its cell's centre; a distribution over this many bins gives the place."""

STRIDES = (4, 8, 16, 32)

_CHANNELS = (64, 128, 256, 512)  # of the backbone at each stride
_WIDTH, _FINE_WIDTH = 128, 64  # of the head at the coarser strides, and at the finest
_MEAN_RGB, _STD_RGB = (123.675, 116.28, 103.53), (58.395, 57.12, 57.375)
_SLOPE = 0.1  # of NanoDet's leaky ReLU
_RARE = -4.6  # a new class's score before the sigmoid: one cell of a hundred
_BEFORE = 1000  # cells kept by their score before suppression (NanoDet's own number)
_SUPPRESS_IOU = 0.6  # NanoDet's own


class NanoDetBackbone(nn.Module):
    """Cross-stage partial blocks of dense 3x3 convolutions, without batch norms."""

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("mean", torch.tensor(_MEAN_RGB).reshape(1, 3, 1, 1))
        self.register_buffer("std", torch.tensor(_STD_RGB).reshape(1, 3, 1, 1))
        self.stem = _convolution(3, 32, 2)
        self.stages = nn.ModuleList(
            [_Stage(32, 1, 1), _Stage(64, 2, 2), _Stage(128, 2, 2), _Stage(256, 3, 2)]
        )

    def forward(self, images: Tensor) -> list[Tensor]:
        """Pictures (N, 3, H, W), RGB 0 to 255, to features (N, C, H / stride, W / stride), fine first."""
        scaled = (images.float() - self.get_buffer("mean")) / self.get_buffer("std")
        x = functional.max_pool2d(_leaky(self.stem(scaled)), 3, 2, 1)
        levels = []
        for stage in self.stages:
            x = stage(x)
            levels.append(x)
        return levels


class _Stage(nn.Module):
    """One convolution, then blocks of two whose outputs are joined, one more, and the first one's output beside it."""

    def __init__(self, channels: int, blocks: int, stride: int) -> None:
        super().__init__()
        self.first = _convolution(channels, channels, stride)
        half = channels // 2
        self.pairs = nn.ModuleList(
            nn.ModuleList([_convolution(channels, half), _convolution(half, half)])
            for _ in range(blocks)
        )
        self.last = _convolution(channels, channels)

    def forward(self, x: Tensor) -> Tensor:
        """(N, C, H, W) -> (N, 2 C, H / stride, W / stride)."""
        first = x = _leaky(self.first(x))
        for pair in self.pairs:
            a = _leaky(pair[0](x))  # type: ignore[index]
            x = torch.cat([_leaky(pair[1](a)), a], 1)  # type: ignore[index]
        return torch.cat([_leaky(self.last(x)), first], 1)


class _CoarseHead(nn.Module):
    """NanoDet's path aggregation network and head of strides 8, 16 and 32, with a convolution more a level that adds."""

    def __init__(self, classes: int) -> None:
        super().__init__()
        self.sideways = nn.ModuleList(nn.Conv2d(each, _WIDTH, 1) for each in _CHANNELS[1:])
        convolutions = [_convolution(_WIDTH, _WIDTH) for _ in range(6)]
        self.more, self.towers = nn.ModuleList(convolutions[:3]), nn.ModuleList(convolutions[3:])
        self.outputs = nn.ModuleList(_output(_WIDTH, classes) for _ in range(3))
        for each in self.more:  # adds nothing at first
            nn.init.zeros_(each.weight)  # type: ignore[arg-type]

    def downward(self, levels: Sequence[Tensor]) -> list[Tensor]:
        """Each stride's features (N, width, H, W), the coarser ones added to the finer ones, from the backbone's."""
        c3, c4, c5 = (layer(each) for layer, each in zip(self.sideways, levels[-3:]))
        p4 = c4 + _resized(c5, 2.0)
        return [c3 + _resized(p4, 2.0), p4, c5]

    def upward(self, downward: Sequence[Tensor]) -> list[Tensor]:
        """Each stride's outputs, from what `downward` gives."""
        p3, p4, c5 = downward
        n4 = p4 + _resized(p3, 0.5)
        paths = [p3, n4, c5 + _resized(n4, 0.5)]
        parts = zip(paths, self.more, self.towers, self.outputs)
        return [output(_leaky(tower(x + _leaky(more(x))))) for x, more, tower, output in parts]


class FinerNanoDetHead(nn.Module):
    """The coarse head, and a level of stride 4 for things of some 10 px, which sees the finest of the coarser levels."""

    def __init__(self, classes: int) -> None:
        super().__init__()
        self.coarse = _CoarseHead(classes)
        self.fine_side = nn.Conv2d(_CHANNELS[0], _FINE_WIDTH, 1)
        self.fine_down = nn.Conv2d(_WIDTH, _FINE_WIDTH, 1)
        self.fine_tower = nn.ModuleList(_convolution(_FINE_WIDTH, _FINE_WIDTH) for _ in range(2))
        self.fine_output = _output(_FINE_WIDTH, classes)

    def forward(self, levels: Sequence[Tensor]) -> list[Tensor]:
        """Of each stride (N, classes + 44, H, W): scores before the sigmoid, four sides' bins before the softmax."""
        downward = self.coarse.downward(levels)
        x = _leaky(self.fine_side(levels[0]) + _resized(self.fine_down(downward[0]), 2.0))
        for layer in self.fine_tower:
            x = _leaky(layer(x))
        return [self.fine_output(x), *self.coarse.upward(downward)]


class SingleStage(Finder):
    """Backbone and head. `outputs` is what is learnt from; `forward` is what runs.

    Example:
        boxes_px, scores, labels = SingleStage(3).eval()(picture)  # (1, 3, H, W)
    """

    def __init__(self, classes: int) -> None:
        super().__init__()
        self.backbone, self.head, self.classes = (
            NanoDetBackbone(),
            FinerNanoDetHead(classes),
            classes,
        )

    def outputs(self, images: Tensor) -> list[Tensor]:
        """Of pictures (N, 3, H, W), RGB 0 to 255, what the head gives at each stride."""
        return self.head(self.backbone(images))

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """As `Finder` has it."""
        scores, bins, places = cells(self.outputs(images), self.classes)
        own = scores[0].T.sigmoid()
        _, rows = torch.topk(own.amax(0), at_most(_BEFORE, own[0]))
        placed = boxes_from_bins(bins[0, rows], places[rows])
        boxes = clipped(placed, images.shape[2], images.shape[3])
        return best_boxes(boxes, own[:, rows], _SUPPRESS_IOU, self.least_score)

    def carry_on(
        self, layers: Mapping[str, Tensor], known: Sequence[str], classes: Sequence[str]
    ) -> None:
        """Take the weights of a network of the classes `known`, by their names; this one's are `classes`.

        Of classes that both know the rows are taken by the class's name; others stay as they are. Raises InputError
        where a layer is missing or has another shape.
        """
        own = self.state_dict()
        shared = [name for name in classes if name in known]
        to = [*map(classes.index, shared), *range(len(classes), len(classes) + 4 * BINS)]
        of = [*map(known.index, shared), *range(len(known), len(known) + 4 * BINS)]
        for name, values in own.items():
            given = layers.get(name)
            has_rows = "output" in name
            rows = values.shape[0] + (len(known) - len(classes)) * has_rows
            if given is None or given.shape != (rows, *values.shape[1:]):
                fault = "is missing" if given is None else f"has the shape {list(given.shape)}"
                raise InputError(
                    f"it holds another network than the preset fast trains: the layer {name} {fault}; give a model "
                    "that this version of `sorvolo train` wrote, or --weights auto"
                )
            if has_rows:
                values[to] = given[of]
            else:
                values.copy_(given)
        self.load_state_dict(own)


def cells(outputs: Sequence[Tensor], classes: int) -> tuple[Tensor, Tensor, Tensor]:
    """Every cell's scores before the sigmoid (N, K, classes), bins (N, K, 4, 11), and x, y, stride px (K, 3)."""
    scores, bins, places = [], [], []
    for output, stride in zip(outputs, STRIDES):
        flat = output.flatten(2).transpose(1, 2)
        scores.append(flat[..., :classes])
        bins.append(flat[..., classes:].reshape(*flat.shape[:2], 4, BINS))
        x, y = cell_centres(output, stride)
        places.append(torch.stack([x, y, torch.full_like(x, stride)], -1).flatten(0, 1))
    return torch.cat(scores, 1), torch.cat(bins, 1), torch.cat(places)


def boxes_from_bins(bins: Tensor, places: Tensor) -> Tensor:
    """(..., K, 4) px, left, top, right, bottom: each side's expected distance from its cell's centre."""
    steps = torch.arange(BINS, dtype=bins.dtype, device=bins.device)
    reach = (bins.softmax(-1) * steps).sum(-1) * places[:, 2:]
    return torch.cat([places[:, :2] - reach[..., :2], places[:, :2] + reach[..., 2:]], -1)


def _convolution(channels: int, out: int, stride: int = 1) -> nn.Conv2d:
    layer = nn.Conv2d(channels, out, 3, stride, 1)
    nn.init.kaiming_normal_(layer.weight, _SLOPE)  # without norms signals must keep their size
    nn.init.zeros_(layer.bias)  # type: ignore[arg-type]
    return layer


def _output(channels: int, classes: int) -> nn.Conv2d:
    layer = nn.Conv2d(channels, classes + 4 * BINS, 1)
    nn.init.normal_(layer.weight, std=0.01)
    nn.init.zeros_(layer.bias)  # type: ignore[arg-type]
    nn.init.constant_(layer.bias[:classes], _RARE)  # type: ignore[index]
    return layer


def _leaky(x: Tensor) -> Tensor:
    return functional.leaky_relu(x, _SLOPE)


def _resized(x: Tensor, factor: float) -> Tensor:
    return functional.interpolate(x, scale_factor=factor, mode="bilinear", align_corners=False)
