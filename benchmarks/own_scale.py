"""Models in their networks' own scale, in which second looks and looks in several sizes are fitted."""

from dataclasses import replace
from typing import Any

from sorvolo.detection.calibration import in_own_scale
from sorvolo.detection.contract import ModelInfo


def own_scale(info: ModelInfo, **cleared: Any) -> ModelInfo:
    """The model without its calibration, thresholds likewise, and with the fields of `cleared` as they are given."""
    return replace(info, calibration={}, thresholds=in_own_scale(info), **cleared)
