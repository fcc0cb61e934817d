"""What a training begins with: ImageNet weights of the backbone, or a model of ours that is tuned to other pictures."""

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from hashlib import sha256
from itertools import islice
from pathlib import Path
from typing import Literal

import torch

from sorvolo.detection.fusing import in_own_scale
from sorvolo.detection.models import (
    HASH_KEY,
    InstalledModel,
    demand_searching,
    file_sha256,
    find_model,
    installed_models,
    read_card,
    thermal_model,
)
from sorvolo.detection.session import read_info, read_model
from sorvolo.errors import InputError, SettingsError
from sorvolo.lab.training.faster_rcnn import NETS, FasterRCNN, Preset, Stem, build, fast
from sorvolo.lab.training.joint import JointSettings, JointTraining, collate
from sorvolo.lab.training.onnx_export import ExportedModel, load_exported, other_networks
from sorvolo.lab.training.progress import Learner
from sorvolo.lab.training.samples import TrainingSample
from sorvolo.lab.training.weights import SOURCES, ImageNetWeights, Net, read_weights
from sorvolo.missions.fetched_files import copy_by_hash
from sorvolo.store.atomic import atomic_path, make_folder


def load_start(choice: str, preset: Preset) -> ImageNetWeights | ExportedModel | None:
    """What `--weights` names: nothing for "none", a model of ours by its name or file, else ImageNet weights.

    Raises InputError when the file holds nothing of the kind, does not fit the preset, or cannot be fetched.
    """
    if choice == "none":
        return None
    is_installed = choice != "auto" and any(each.name == choice for each in installed_models())
    if is_installed or choice.lower().endswith(".onnx"):
        return _model(choice, preset)
    net = NETS[preset]
    return read_weights(fetch_weights(net) if choice == "auto" else Path(choice), net)


def fetch_weights(net: Net) -> Path:
    """The cached package with this net's weights, downloaded once and checked by its hash.

    The cache is `$SORVOLO_CACHE`, else `sorvolo` in `$XDG_CACHE_HOME` or `~/.cache`. Raises InputError when there is no
    network, or the download is not what it should be: nothing of it is kept then.
    """
    source = SOURCES[net]
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    folder = Path(os.environ.get("SORVOLO_CACHE") or Path(base) / "sorvolo") / "weights"
    place = folder / source.name
    if place.is_file() and sha256(place.read_bytes()).hexdigest() == source.sha256:
        return place
    make_folder(folder)
    offline = f"put that file at {place}, or name it with --weights FILE; --weights none starts from nothing"
    with atomic_path(place) as temporary:
        copy_by_hash(source.url, temporary, source.sha256, offline=offline)
    return place


def begin_notices(start: ExportedModel, classes: Sequence[str]) -> list[str]:
    """What of the model a training of `classes` does not carry on."""
    notices = []
    if start.left:
        notices.append(
            f"only the aerial network of {start.origin} is learnt on from. Not carried on: {', '.join(start.left)}; the "
            "new model begins with less than that model knows"
        )
    known = start.info.classes
    if new := [name for name in classes if name not in known]:
        notices.append(f"{start.origin} does not know {', '.join(new)}: learnt from the beginning")
    if left := [name for name in known if name not in classes]:
        notices.append(
            f"{start.origin} knows {', '.join(left)}, which nothing here labels: the new model will not"
        )
    return notices


def kept_notices(
    start: ExportedModel, too_few: Sequence[str], on_request: Sequence[str]
) -> list[str]:
    """What the new model keeps of the one before: for classes of which `too_few` objects were held out the scores to
    report from and the sizes that are found well (`best_px`), and the classes that are reported `on_request` alone."""
    why = "too few objects were held out to choose the score to report from"
    own = "those of the model's aerial network by itself" if start.left else "the model's own"
    known = start.info.classes
    notices = []
    if kept := [name for name in too_few if name in start.thresholds]:
        notices.append(f"{why}: {', '.join(kept)} kept {own}")
    if unknown := [name for name in too_few if name in known and name not in start.thresholds]:
        notices.append(
            f"{why}, and nothing states those of the model's aerial network by itself: the scores from which "
            f"{', '.join(unknown)} are reported are not calibrated; hold more out (--val)"
        )
    if kept := [name for name in too_few if name in start.info.best_px]:
        notices.append(
            "too few objects were held out to measure at which sizes they are found well: "
            f"{', '.join(kept)} kept those of {start.origin}"
        )
    if on_request:
        notices.append(
            f"{', '.join(on_request)}: reported only where asked for (--classes), as by {start.origin}; too few objects "
            "were held out to show that the new model finds them more surely"
        )
    return notices


def kept_on_request(
    start: ExportedModel, classes: Sequence[str], too_few: Sequence[str]
) -> tuple[str, ...]:
    """Which of the new model's classes are reported on request alone: those of the model before that are `too_few`
    among the held-out objects, since nothing shows that they became surer. None where no other class would be left."""
    kept = tuple(name for name in classes if name in start.info.on_request and name in too_few)
    return kept if len(kept) < len(classes) else ()


def kept_thermal_by(start: ExportedModel, classes: Sequence[str], *, thermal: bool) -> str:
    """The installed model that goes on looking at thermal frames in the new one's place: that of the model before,
    unless the new one learnt from thermal frames itself or they share no class; "" for none."""
    by = start.info.thermal_by
    return "" if thermal or not by or thermal_model(classes, by) is None else by


def _model(choice: str, preset: Preset) -> ExportedModel:
    path = find_model(choice)
    info, content = read_info(path), read_model(path)
    if info.precision != "float32":
        raise InputError(
            f"{path} is in {info.precision} and cannot be learnt on from; give the float32 model that it was made from"
        )
    demand_searching(info)
    if info.preset and info.preset not in NETS:
        raise InputError(
            f"{path} is of the preset {info.preset}, which cannot be trained; there are {', '.join(NETS)}"
        )
    if info.preset and info.preset != preset:
        raise InputError(
            f"{path} is of the preset {info.preset}, not {preset}: train with --preset {info.preset}"
        )
    sha256 = file_sha256(path)
    own, means = in_own_scale(info), info.calibration
    if not (others := other_networks(content)):
        return ExportedModel(content, info, sha256, own, means)
    # of a file of several networks the aerial one, with its own thresholds by the card
    card = read_card(InstalledModel(path.stem, path, is_packaged=False))
    is_of_file = str(card.get(HASH_KEY, "")).lower() == sha256
    alone = card.get("aerial_alone", {}) if is_of_file else {}
    left = [*others]
    if info.second_look:
        left.append(f"the second look at reports ({', '.join(info.second_look)})")
    if info.pyramid:
        left.append("the search in several sizes")
    return ExportedModel(content, info, sha256, alone.get("thresholds", {}), {}, tuple(left))


_RATES = {"fast": 1e-3, "thesis": 2e-4}  # of AdamW at its height; large networks need less
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
    first: Iterator[Sequence[TrainingSample]],
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
        mixed_precision=device != "cpu" or bool(torch.ops.mkldnn._is_mkldnn_bf16_supported()),
    )
    return JointTraining(model, settings, seed, device)


def _learnt_on(
    preset: Preset,
    classes: Sequence[str],
    rpn: Stem,
    start: ExportedModel,
    first: Iterator[Sequence[TrainingSample]],
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
