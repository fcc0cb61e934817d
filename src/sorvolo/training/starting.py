"""A training's beginning: the device, the network with its weights, the schedule."""

from collections.abc import Sequence
from typing import Literal

import torch

from sorvolo.errors import SettingsError
from sorvolo.training.four_steps import FourStepSettings, FourStepTraining
from sorvolo.training.inception import Stem
from sorvolo.training.joint import JointSettings, JointTraining
from sorvolo.training.presets import Preset, build
from sorvolo.training.progress import Learner
from sorvolo.training.weights import ImageNetWeights

_RATES = {"fast": 1e-3, "accurate": 2e-4, "thesis": 2e-4}  # of AdamW at its height; large networks need less
_BACKBONE_SHARE = 0.2  # of that rate, for layers that ImageNet taught


def device_of(wanted: str) -> str:
    """"cpu" or "cuda"; "auto" takes a GPU where there is one. Raises SettingsError for a device that is not there."""
    if wanted == "auto":
        return "cuda" if torch.cuda.is_available() else "cpu"
    if wanted.startswith("cuda") and not torch.cuda.is_available():
        raise SettingsError(f"device {wanted} asked for, but this torch sees no GPU; use --device cpu")
    if wanted != "cpu" and not wanted.startswith("cuda"):
        raise SettingsError(f"device must be auto, cpu or cuda, got {wanted!r}")
    return wanted


def start_learner(
    preset: Preset, classes: Sequence[str], rpn: Stem, schedule: Literal["joint", "four-steps"],
    weights: ImageNetWeights | None, *, steps: int, batch: int, seed: int, device: str,
) -> Learner:
    """The preset's network before its first step; what is not from `weights` follows from the seed."""
    torch.set_flush_denormal(True)  # weights that decay to almost nothing would cost a hundred times the time
    torch.manual_seed(seed)
    model = build(preset, classes, rpn, weights).to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    if schedule == "four-steps":
        return FourStepTraining(model, FourStepSettings(steps=steps), seed, device)
    rate = _RATES[preset]
    settings = JointSettings(
        steps=steps, batch=batch, rate=rate, backbone_rate=rate if weights is None else _BACKBONE_SHARE * rate,
        warm_steps=min(200, max(1, steps // 10)), mixed_precision=device != "cpu" or _has_bfloat16(),
    )
    return JointTraining(model, settings, seed, device)


def _has_bfloat16() -> bool:
    """Whether this processor calculates in it, rather than making believe."""
    return bool(torch.ops.mkldnn._is_mkldnn_bf16_supported())
