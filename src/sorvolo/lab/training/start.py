"""What a training begins with: a model that is tuned, ImageNet weights for the thesis's network, or nothing."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from hashlib import sha256

import torch
from torch import Tensor

from sorvolo.detection.contract import ModelInfo
from sorvolo.detection.models import find_model, thermal_model
from sorvolo.detection.session import read_info, read_model
from sorvolo.errors import InputError, SettingsError
from sorvolo.lab.training.learning import SingleStageTraining
from sorvolo.lab.training.onnx_export import read_layers
from sorvolo.lab.training.progress import Learner
from sorvolo.lab.training.settings import TrainSettings
from sorvolo.lab.training.single_stage import SingleStage

PACKAGED = "default"
"""The model that the preset fast starts from, unless told otherwise."""


@dataclass(frozen=True, eq=False)
class Start:
    """Weights to learn on from: `layers` by their names in the network, where they are from in words, and what tells
    them from others, by which a run knows its own. `info`: what the model states of itself, None for ImageNet weights."""

    layers: Mapping[str, Tensor]
    origin: str
    identity: str
    info: ModelInfo | None = None


def load_start(settings: TrainSettings) -> Start | None:
    """What `--weights` names: nothing for "none", else a model by its name or file; ImageNet's for the preset thesis.

    Raises InputError when the file holds nothing of the kind, or cannot be fetched.
    """
    choice = settings.weights
    if choice == "none":
        return None
    if settings.preset == "thesis":
        from sorvolo.lab.thesis.resnet import imagenet_weights

        return imagenet_weights(choice)
    path = find_model(PACKAGED if choice == "auto" else choice)
    info, content = read_info(path), read_model(path)
    identity = f"model with SHA-256 {sha256(content).hexdigest()[:16]}"
    return Start(read_layers(content), f"the model {info.name}", identity, info)


def start_learner(
    settings: TrainSettings, classes: Sequence[str], start: Start | None, device: str
) -> Learner:
    """The preset's network before its first step; what is not from `start` follows from the seed.

    Raises InputError where the model to tune is another network.
    """
    torch.manual_seed(settings.seed)
    if settings.preset == "thesis":
        from sorvolo.lab.thesis.four_steps import FourStepTraining
        from sorvolo.lab.thesis.network import thesis_network

        model = thesis_network(classes, settings.rpn, start.layers if start else None)
        return FourStepTraining(model, settings.steps, settings.seed, device)
    network = SingleStage(len(classes))
    if start is not None and start.info is not None:
        try:
            network.carry_on(start.layers, start.info.classes, classes)
        except InputError as error:
            raise InputError(f"{start.origin} cannot be learnt on from: {error}") from error
    return SingleStageTraining(network, settings.steps, device, is_tuned=start is not None)


def begin_notices(start: Start, classes: Sequence[str]) -> list[str]:
    """What a training of `classes` learns from the beginning, and what of the model it does not carry on."""
    notices = []
    known = start.info.classes if start.info else classes
    if new := [name for name in classes if name not in known]:
        notices.append(f"{start.origin} does not know {', '.join(new)}: learnt from the beginning")
    if left := [name for name in known if name not in classes]:
        notices.append(
            f"{start.origin} knows {', '.join(left)}, which nothing here labels: the new model will not"
        )
    return notices


def kept_notices(before: ModelInfo, too_few: Sequence[str], on_request: Sequence[str]) -> list[str]:
    """What the new model keeps of the one before: for classes of which `too_few` objects were held out the scores to
    report from and the sizes that are found well, and the classes that are reported `on_request` alone."""
    notices = []
    if kept := [name for name in too_few if name in before.classes]:
        notices.append(
            "too few objects were held out to choose the score to report from and to measure the sizes that are found "
            f"well: {', '.join(kept)} kept those of the model {before.name}"
        )
    if on_request:
        notices.append(
            f"{', '.join(on_request)}: reported only where asked for (--classes), as by the model {before.name}; too "
            "few objects were held out to show that the new model finds them more surely"
        )
    return notices


def kept_on_request(
    before: ModelInfo, classes: Sequence[str], too_few: Sequence[str]
) -> tuple[str, ...]:
    """Which of the new model's classes are reported on request alone: those of the model before that are `too_few`
    among the held-out objects, since nothing shows that they became surer. None where no other class would be left."""
    kept = tuple(name for name in classes if name in before.on_request and name in too_few)
    return kept if len(kept) < len(classes) else ()


def kept_thermal_by(before: ModelInfo, classes: Sequence[str], *, thermal: bool) -> str:
    """The installed model that goes on looking at thermal frames in the new one's place: that of the model before,
    unless the new one learnt from thermal frames itself or they share no class; "" for none."""
    by = before.thermal_by
    return "" if thermal or not by or thermal_model(classes, by) is None else by


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
