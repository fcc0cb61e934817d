"""The detector's ready-made shapes."""

from collections.abc import Sequence
from typing import Literal

from sorvolo.training.backbone import EfficientNetLite0
from sorvolo.training.faster_rcnn import FasterRCNN, Reach
from sorvolo.training.heads import TwoLayerHead
from sorvolo.training.inception import Stem
from sorvolo.training.proposals import AnchorSettings, ProposalNetwork
from sorvolo.training.pyramid import Pyramid

Preset = Literal["fast", "accurate", "thesis", "tiny"]

_FAST_ANCHORS = (AnchorSettings((7, 11, 17)), AnchorSettings((25, 37, 54)), AnchorSettings((80, 120, 190)))
_FAST_WIDTH = 64


def fast(classes: Sequence[str], rpn: Stem = "extended-residual", *, thaw_all: bool = False) -> FasterRCNN:
    """For a laptop without a GPU: EfficientNet-Lite0 up to stride 16, a light pyramid down to stride 4, a slim stack."""
    backbone = EfficientNetLite0(thaw_all=thaw_all)
    neck = Pyramid(backbone.channels, _FAST_WIDTH, light=True)
    proposals = ProposalNetwork(
        neck.channels, backbone.strides, _FAST_ANCHORS, rpn, _FAST_WIDTH, light=True
    )
    head = TwoLayerHead(_FAST_WIDTH, 160, len(classes))
    return FasterRCNN(backbone, neck, proposals, head, Reach())
