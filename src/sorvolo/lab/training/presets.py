"""The detector's ready-made shapes."""

from collections.abc import Callable, Mapping, Sequence
from typing import Literal

import torch

from sorvolo.lab.training.backbone import EfficientNetLite0
from sorvolo.lab.training.faster_rcnn import FasterRCNN, Reach
from sorvolo.lab.training.feature_pyramid import Pyramid
from sorvolo.lab.training.heads import StageHead, TwoLayerHead
from sorvolo.lab.training.inception import Stem
from sorvolo.lab.training.proposals import AnchorSettings, ProposalNetwork
from sorvolo.lab.training.resnet import ResNet50, load_stage, resnet_stage
from sorvolo.lab.training.weights import ImageNetWeights, Net

Preset = Literal["fast", "accurate", "thesis"]

_FAST_ANCHORS = (
    AnchorSettings((7, 11, 17)),
    AnchorSettings((25, 37, 54)),
    AnchorSettings((80, 120, 190)),
)
_FAST_WIDTH = 64  # channels of the pyramid; by choice, for speed
_RATIOS = (0.5, 1.0, 2.0)  # of height to width: Faster R-CNN's (Ren et al. 2015)
_ACCURATE_ANCHORS = tuple(
    AnchorSettings(sizes, _RATIOS) for sizes in ((10, 16), (25, 40), (63, 100), (160, 250))
)
_THESIS_REGIONS = 75  # for six frames a second on two cores; crowds need more (docs/train.md)
_THESIS_ANCHORS = (
    AnchorSettings((16, 32, 64, 128, 256), _RATIOS),
)  # of Faster R-CNN, an octave finer on either side


def fast(
    classes: Sequence[str], rpn: Stem = "extended-residual", *, thaw_all: bool = False
) -> FasterRCNN:
    """For a laptop without a GPU: EfficientNet-Lite0 up to stride 16, a light pyramid down to stride 4, slim stacks."""
    backbone = EfficientNetLite0(thaw_all=thaw_all)
    neck = Pyramid(backbone.channels, _FAST_WIDTH, light=True)
    proposals = ProposalNetwork(
        neck.channels, backbone.strides, _FAST_ANCHORS, rpn, _FAST_WIDTH, light=True
    )
    head = TwoLayerHead(_FAST_WIDTH, 160, len(classes))
    return FasterRCNN(backbone, neck, proposals, head, Reach())


def accurate(
    classes: Sequence[str],
    rpn: Stem = "extended-residual",
    *,
    original: bool = False,
    frozen: bool = True,
) -> FasterRCNN:
    """For a GPU: ResNet-50 with a pyramid of strides 4 to 32 (P2 to P5), a stack on each, two fully connected layers.

    `original`: where ResNet's strides sit (`resnet.ResNet50`); it follows from the weights that are to be loaded.
    `frozen`: its batch norms and first layers stay as loaded.
    """
    backbone = ResNet50(deep=True, original=original, frozen_norms=frozen, thaw_all=not frozen)
    neck = Pyramid(backbone.channels, 256, light=False)
    proposals = ProposalNetwork(
        neck.channels, backbone.strides, _ACCURATE_ANCHORS, rpn, 256, light=False
    )
    head = TwoLayerHead(256, 1024, len(classes))
    return FasterRCNN(backbone, neck, proposals, head, Reach(before=2000, regions=500))


def thesis(
    classes: Sequence[str], rpn: Stem = "extended", *, original: bool = False, frozen: bool = True
) -> FasterRCNN:
    """The thesis's own (its 3.3.2): ResNet-50 up to res4, proposals through Table 3.2's nine modules, res5 as head.

    `original` and `frozen` as for `accurate`.
    """
    backbone = ResNet50(original=original, frozen_norms=frozen, thaw_all=not frozen)
    proposals = ProposalNetwork(
        backbone.channels, backbone.strides, _THESIS_ANCHORS, rpn, 512, light=False
    )
    # cut out at the 7x7 that res5's stride would leave of 14x14: a quarter as much to sample, and all of it is used
    stage = resnet_stage(4, original=original, frozen_norms=frozen, halves=False)
    head = StageHead(stage, 2048, len(classes))
    return FasterRCNN(
        backbone, torch.nn.Identity(), proposals, head, Reach(before=2000, regions=_THESIS_REGIONS)
    )


NETS: Mapping[Preset, Net] = {"fast": "lite0", "accurate": "resnet50", "thesis": "resnet50"}
"""The backbone whose ImageNet weights a preset starts from."""

_RESNETS: Mapping[str, Callable[..., FasterRCNN]] = {"accurate": accurate, "thesis": thesis}


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
    if weights is None:
        if preset == "fast":
            return fast(classes, rpn, thaw_all=True)
        return _RESNETS[preset](classes, rpn, original=original, frozen=False)
    model = (
        fast(classes, rpn)
        if preset == "fast"
        else _RESNETS[preset](classes, rpn, original=weights.original)
    )
    model.backbone.load_imagenet(dict(weights.layers))  # type: ignore[operator]
    if isinstance(model.head, StageHead):
        load_stage(model.head.stage, 4, weights.layers)  # type: ignore[arg-type]
    return model
