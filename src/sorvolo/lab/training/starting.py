"""A training's beginning: the device, the network with its weights, the schedule."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import islice
from typing import Literal

import torch

from sorvolo.errors import InputError, SettingsError
from sorvolo.lab.training.exported import ExportedModel, load_exported
from sorvolo.lab.training.faster_rcnn import FasterRCNN
from sorvolo.lab.training.joint import JointSettings, JointTraining, collate
from sorvolo.lab.training.presets import Preset, build, fast
from sorvolo.lab.training.progress import Learner
from sorvolo.lab.training.proposals import Stem
from sorvolo.lab.training.samples import Sample
from sorvolo.lab.training.weights import ImageNetWeights

_RATES = {
    "fast": 1e-3,
    "accurate": 2e-4,
    "thesis": 2e-4,
}  # of AdamW at its height; large networks need less
_BACKBONE_SHARE = 0.2  # of that rate, for layers that ImageNet taught
_TUNED_SHARE = 0.5  # of that rate, for a model that has learnt already
_SETTLING_PX = 6_000_000  # of pictures by which the norms of such a model are settled: a gigabyte or two of memory


def device_of(wanted: str) -> str:
    """ "cpu" or "cuda"; "auto" takes a GPU where there is one. Raises SettingsError for a device that is not there."""
    if wanted == "auto":
        return "cuda" if torch.cuda.is_available() else "cpu"
    kind, _, number = wanted.partition(":")
    if wanted != "cpu" and not (kind == "cuda" and (number.isdecimal() or wanted == "cuda")):
        raise SettingsError(f"device must be auto, cpu or cuda, got {wanted!r}")
    if kind == "cuda" and not torch.cuda.is_available():
        raise SettingsError(
            f"device {wanted} asked for, but this torch sees no GPU; use the device cpu"
        )
    return wanted


@contextmanager
def without_denormals() -> Iterator[None]:
    """What is almost nothing counts as nothing meanwhile: weights that decay so far cost a hundred times as much.

    This sets the processor, hence the whole thread, whatever it calculates.
    """
    torch.set_flush_denormal(True)
    try:
        yield
    finally:
        torch.set_flush_denormal(False)


def start_learner(
    preset: Preset,
    classes: Sequence[str],
    rpn: Stem,
    schedule: Literal["joint", "four-steps"],
    start: ImageNetWeights | ExportedModel | None,
    first: Iterator[Sequence[Sample]],
    *,
    steps: int,
    batch: int,
    seed: int,
    device: str,
) -> Learner:
    """The preset's network before its first step; what is not from `start` follows from the seed.

    `first` are batches of what is to be learnt: they settle the norms of an exported model, and are else not drawn.
    Raises InputError where an exported model does not fit.
    """
    torch.manual_seed(seed)
    rate = _RATES[preset]
    if isinstance(start, ExportedModel):
        model = _learnt_on(preset, classes, rpn, start, first)
        rate *= _TUNED_SHARE
    else:
        model = build(preset, classes, rpn, start)
    model = model.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    if schedule == "four-steps":
        from sorvolo.lab.thesis.four_steps import FourStepSettings, FourStepTraining

        return FourStepTraining(model, FourStepSettings(steps=steps), seed, device)
    settings = JointSettings(
        steps=steps,
        batch=batch,
        rate=rate,
        backbone_rate=rate if start is None else _BACKBONE_SHARE * rate,
        warm_steps=min(200, max(1, steps // 10)),
        mixed_precision=device != "cpu" or _has_bfloat16(),
    )
    return JointTraining(model, settings, seed, device)


def _learnt_on(
    preset: Preset,
    classes: Sequence[str],
    rpn: Stem,
    start: ExportedModel,
    first: Iterator[Sequence[Sample]],
) -> FasterRCNN:
    """The network with an exported model's weights, its norms settled by the first pictures."""
    if preset != "fast":
        raise InputError(
            f"{start.origin} cannot be learnt on from: a model file of the preset {preset} lacks what its batch norms "
            "took from ImageNet; start with --weights auto, or take the preset fast"
        )
    model = fast(classes, rpn)
    samples = [*next(first)]
    size_px = samples[0].image.shape[0] * samples[0].image.shape[1]
    samples += islice(
        (each for batch in first for each in batch), max(0, _SETTLING_PX // size_px - len(samples))
    )
    load_exported(model, start.content, collate(samples, "cpu")[0], classes)
    return model


def _has_bfloat16() -> bool:
    """Whether this processor calculates in it, rather than making believe."""
    return bool(torch.ops.mkldnn._is_mkldnn_bf16_supported())
