"""NanoDet-g (RangiLyu 2021): a network trained on COCO's 80 classes, read from its TensorFlow.js graph."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from sorvolo.errors import InputError
from sorvolo.lab.training.boxes import at_most, clipped, suppress
from sorvolo.lab.training.tfjs_graph import TfjsGraph

COCO_CLASSES = 80  # that NanoDet was trained on
BINS = 11
"""A box's side lies 0 to 10 strides from its cell's centre; a distribution over this many bins gives the place."""

_MEAN_BGR, _STD_BGR = (103.53, 116.28, 123.675), (57.375, 57.12, 58.395)
_SLOPE = 0.1  # of NanoDet's leaky ReLU
_PREFIX = "PartitionedCall/"


@dataclass(frozen=True)
class CocoSettings:
    """How many cells are looked at, and what is reported in the end."""

    before: int = 1000  # cells kept by their score before suppression (NanoDet's own number)
    most: int = 300  # detections of one picture
    suppress_iou: float = (
        0.6  # NanoDet's own; of two boxes of a class that overlap more, the better one stays
    )
    least_score: float = 0.02  # thresholds are far above


class NanoDetBackbone(nn.Module):
    """Cross-stage partial blocks of dense 3x3 convolutions; pictures RGB 0 to 255 to strides 4, 8, 16 and 32."""

    channels = (64, 128, 256, 512)
    strides = (4, 8, 16, 32)

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("mean", torch.tensor(_MEAN_BGR[::-1]).reshape(1, 3, 1, 1))
        self.register_buffer("std", torch.tensor(_STD_BGR[::-1]).reshape(1, 3, 1, 1))
        self.stem = _convolution(3, 32, 2)
        self.stages = nn.ModuleList(
            [_Stage(32, 1, 1), _Stage(64, 2, 2), _Stage(128, 2, 2), _Stage(256, 3, 2)]
        )

    def forward(self, images: Tensor) -> list[Tensor]:
        """Pictures (N, 3, H, W), sides multiples of 32, to features (N, C, H / stride, W / stride), fine first."""
        scaled = (images.float() - self.get_buffer("mean")) / self.get_buffer("std")
        x = functional.leaky_relu(self.stem(scaled), _SLOPE)
        x = functional.max_pool2d(x, 3, 2, 1)
        levels = []
        for stage in self.stages:
            x = stage(x)
            levels.append(x)
        return levels


class NanoDetHead(nn.Module):
    """A path aggregation network of 128 channels and a head a level; of strides 8, 16 and 32.

    A `deeper` one has a convolution more a level, which adds to what comes in and at first adds nothing.
    """

    strides = (8, 16, 32)

    def __init__(
        self, classes: int = COCO_CLASSES, width: int = 128, *, deeper: bool = False
    ) -> None:
        super().__init__()
        self.classes = classes
        self.sideways = nn.ModuleList(
            nn.Conv2d(each, width, 1) for each in NanoDetBackbone.channels[1:]
        )
        self.more = nn.ModuleList(_convolution(width, width) for _ in self.strides if deeper)
        for each in self.more:
            nn.init.zeros_(each.weight)  # type: ignore[arg-type]
            nn.init.zeros_(each.bias)  # type: ignore[arg-type]
        self.towers = nn.ModuleList(_convolution(width, width) for _ in self.strides)
        self.outputs = nn.ModuleList(nn.Conv2d(width, classes + 4 * BINS, 1) for _ in self.strides)

    def forward(self, levels: Sequence[Tensor]) -> list[Tensor]:
        """Of each stride (N, classes + 44, H, W): scores before the sigmoid, four sides' bins before the softmax."""
        return self.upward(self.downward(levels))

    def downward(self, levels: Sequence[Tensor]) -> list[Tensor]:
        """Each stride's features (N, width, H, W), the coarser ones added to the finer ones, from the backbone's."""
        c3, c4, c5 = (layer(each) for layer, each in zip(self.sideways, levels[-3:]))
        p4 = c4 + _resized(c5, 2.0)
        return [c3 + _resized(p4, 2.0), p4, c5]

    def upward(self, downward: Sequence[Tensor]) -> list[Tensor]:
        """What `forward` gives, from what `downward` gives."""
        p3, p4, c5 = downward
        n4 = p4 + _resized(p3, 0.5)
        n5 = c5 + _resized(n4, 0.5)
        paths = [p3, n4, n5]
        for index, layer in enumerate(self.more):
            paths[index] = paths[index] + functional.leaky_relu(layer(paths[index]), _SLOPE)
        towers = [
            functional.leaky_relu(tower(each), _SLOPE) for tower, each in zip(self.towers, paths)
        ]
        return [layer(each) for layer, each in zip(self.outputs, towers)]


class FinerNanoDetHead(nn.Module):
    """A deeper NanoDet head with a level of stride 4 besides, for things of some 10 px.

    The coarser levels give what `NanoDetHead` gives with the same weights; the fine one sees the finest of them.
    """

    strides = (4, 8, 16, 32)

    def __init__(self, classes: int, width: int = 128, fine: int = 64) -> None:
        super().__init__()
        self.classes = classes
        self.coarse = NanoDetHead(classes, width, deeper=True)
        self.fine_side = nn.Conv2d(NanoDetBackbone.channels[0], fine, 1)
        self.fine_down = nn.Conv2d(width, fine, 1)
        self.fine_tower = nn.ModuleList(_convolution(fine, fine) for _ in range(2))
        self.fine_output = nn.Conv2d(fine, classes + 4 * BINS, 1)

    def forward(self, levels: Sequence[Tensor]) -> list[Tensor]:
        """Of each stride (N, classes + 44, H, W), as `NanoDetHead.forward` gives them."""
        downward = self.coarse.downward(levels)
        x = self.fine_side(levels[0]) + _resized(self.fine_down(downward[0]), 2.0)
        x = functional.leaky_relu(x, _SLOPE)
        for layer in self.fine_tower:
            x = functional.leaky_relu(layer(x), _SLOPE)
        return [self.fine_output(x), *self.coarse.upward(downward)]


def head_of_class(head: NanoDetHead, row: int) -> NanoDetHead:
    """A deeper head for one class alone, which sees what `head` sees for its class `row` until it learns more."""
    own = NanoDetHead(1, deeper=True).eval()
    known = head.state_dict()
    rows = torch.tensor([row, *range(head.classes, head.classes + 4 * BINS)])
    for name, values in known.items():
        known[name] = values[rows] if name.startswith("outputs.") else values
    own.load_state_dict(own.state_dict() | known)
    return own


def cells(
    outputs: Sequence[Tensor], strides: Sequence[int], classes: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Every cell's scores before the sigmoid (N, K, classes), bins (N, K, 4, 11), and x, y, stride px (K, 3)."""
    scores, bins, places = [], [], []
    for output, stride in zip(outputs, strides):
        flat = output.flatten(2).transpose(1, 2)
        scores.append(flat[..., :classes])
        bins.append(flat[..., classes:].reshape(*flat.shape[:2], 4, BINS))
        rows = (torch.arange(output.shape[2], device=output.device) + 0.5) * stride
        columns = (torch.arange(output.shape[3], device=output.device) + 0.5) * stride
        y, x = rows[:, None] + 0 * columns, columns[None] + 0 * rows[:, None]
        places.append(torch.stack([x, y, torch.full_like(x, stride)], -1).flatten(0, 1))
    return torch.cat(scores, 1), torch.cat(bins, 1), torch.cat(places)


def boxes_from_bins(bins: Tensor, places: Tensor) -> Tensor:
    """(..., K, 4) px, left, top, right, bottom: each side's expected distance from its cell's centre."""
    steps = torch.arange(BINS, dtype=bins.dtype, device=bins.device)
    reach = (bins.softmax(-1) * steps).sum(-1) * places[:, 2:]
    return torch.cat([places[:, :2] - reach[..., :2], places[:, :2] + reach[..., 2:]], -1)


class CocoDetector(nn.Module):
    """NanoDet as `detection` runs it: any of our classes is the best of some of COCO's."""

    stride = 32

    def __init__(
        self,
        backbone: NanoDetBackbone,
        head: NanoDetHead | FinerNanoDetHead,
        coco_of_class: Sequence[Sequence[int]],
        settings: CocoSettings = CocoSettings(),
    ) -> None:
        """`coco_of_class`: for each of our classes the COCO classes (0 to 79) that it stands for."""
        super().__init__()
        self.backbone, self.head, self.settings = backbone, head, settings
        self.coco_of_class = [list(each) for each in coco_of_class]

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """One picture (1, 3, H, W), RGB 0 to 255: boxes (K, 4) px, scores (K,), labels (K,), best first."""
        return self.found(self.head(self.backbone(images)), (images.shape[2], images.shape[3]))

    def found(
        self, outputs: Sequence[Tensor], size_px: tuple[int, int]
    ) -> tuple[Tensor, Tensor, Tensor]:
        """What `forward` gives, from the head's outputs for a picture of this (height, width)."""
        scores, bins, places = cells(outputs, self.head.strides, self.head.classes)
        own = torch.stack([scores[0][:, rows].amax(1) for rows in self.coco_of_class]).sigmoid()
        boxes = clipped(boxes_from_bins(bins[0], places), *size_px)
        best, cell = torch.topk(own.amax(0), at_most(self.settings.before, own[0]))
        reach = self.settings
        kept = suppress(
            boxes[cell],
            own[:, cell].contiguous(),
            reach.most,
            reach.suppress_iou,
            reach.least_score,
        )
        labels, rows = kept[:, 0], cell[kept[:, 1]]
        found = own[labels, rows]
        best, order = torch.topk(found, at_most(self.settings.most, found))
        return boxes[rows][order], best, labels[order]


class _Stage(nn.Module):
    """One convolution, then blocks of two whose outputs are joined, one more, and the stage's own input beside it."""

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
        first = functional.leaky_relu(self.first(x), _SLOPE)
        x = first
        for pair in self.pairs:
            a = functional.leaky_relu(pair[0](x), _SLOPE)  # type: ignore[index]
            x = torch.cat([functional.leaky_relu(pair[1](a), _SLOPE), a], 1)  # type: ignore[index]
        return torch.cat([functional.leaky_relu(self.last(x), _SLOPE), first], 1)


def nanodet_from_graph(graph: TfjsGraph) -> tuple[NanoDetBackbone, NanoDetHead]:
    """The network whose weights the graph holds. Raises InputError where it is another one."""
    backbone, head = NanoDetBackbone().eval(), NanoDetHead().eval()
    layers = [each for each in backbone.modules() if isinstance(each, nn.Conv2d)]
    layers += list(head.sideways)  # type: ignore[arg-type]
    for tower, output in zip(head.towers, head.outputs):
        layers += [tower, output]  # type: ignore[list-item]
    for index, layer in enumerate(layers):
        _fill(layer, graph, index)
    with torch.no_grad():
        backbone.stem.weight.copy_(backbone.stem.weight.flip(1))
    return backbone, head


def _fill(layer: nn.Conv2d, graph: TfjsGraph, index: int) -> None:
    """The `index`-th convolution of the graph and the bias that is added to it."""
    name = f"{_PREFIX}convolution" + (f"_{index}" if index else "")
    adds = [each for each in graph.nodes.values() if each.op == "Add" and each.inputs[0] == name]
    try:
        kernel = graph.constants[graph.nodes[name].inputs[1]]
        bias = graph.constants[adds[0].inputs[1]]
    except (KeyError, IndexError) as error:
        raise InputError(f"{graph.origin} is no NanoDet-g: it lacks {name} and its bias") from error
    weight = np.ascontiguousarray(kernel.transpose(3, 2, 0, 1))
    if weight.shape != tuple(layer.weight.shape) or bias.shape != (len(weight),):
        raise InputError(
            f"{graph.origin} is no NanoDet-g: convolution {index} has weights {weight.shape}, needed are "
            f"{tuple(layer.weight.shape)}"
        )
    assert layer.bias is not None
    with torch.no_grad():
        layer.weight.copy_(torch.from_numpy(weight))
        layer.bias.copy_(torch.from_numpy(np.ascontiguousarray(bias)))


def _convolution(inner: int, outer: int, stride: int = 1) -> nn.Conv2d:
    return nn.Conv2d(inner, outer, 3, stride, 1)


def _resized(x: Tensor, factor: float) -> Tensor:
    return functional.interpolate(x, scale_factor=factor, mode="bilinear", align_corners=False)
