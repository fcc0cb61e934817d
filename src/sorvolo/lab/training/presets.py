"""The detector's ready-made shapes."""

from collections.abc import Mapping, Sequence
from typing import Literal

from sorvolo.lab.training.backbone import EfficientNetLite0
from sorvolo.lab.training.faster_rcnn import FasterRCNN, Reach
from sorvolo.lab.training.feature_pyramid import Pyramid
from sorvolo.lab.training.heads import StageHead, TwoLayerHead
from sorvolo.lab.training.proposals import RATIOS, AnchorSettings, ProposalNetwork, Stem
from sorvolo.lab.training.resnet import ResNet50, load_stage
from sorvolo.lab.training.weights import ImageNetWeights, Net

Preset = Literal["fast", "accurate", "thesis"]

_FAST_ANCHORS = (
    AnchorSettings((7, 11, 17)),
    AnchorSettings((25, 37, 54)),
    AnchorSettings((80, 120, 190)),
)
_FAST_WIDTH = 64  # channels of the pyramid; by choice, for speed
_ACCURATE_ANCHORS = tuple(
    AnchorSettings(sizes, RATIOS) for sizes in ((10, 16), (25, 40), (63, 100), (160, 250))
)


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


NETS: Mapping[Preset, Net] = {"fast": "lite0", "accurate": "resnet50", "thesis": "resnet50"}
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
        resnet = accurate
        if preset == "thesis":
            from sorvolo.lab.thesis.network import thesis_network as resnet
        original = original if weights is None else weights.original
        model = resnet(classes, rpn, original=original, frozen=weights is not None)
    if weights is None:
        return model
    model.backbone.load_imagenet(dict(weights.layers))  # type: ignore[operator]
    if isinstance(model.head, StageHead):
        load_stage(model.head.stage, 4, weights.layers)  # type: ignore[arg-type]
    return model
