"""What a training begins with: ImageNet weights of the backbone, or a model of ours that is tuned to other pictures."""

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from hashlib import sha256
from pathlib import Path
from typing import Any

from sorvolo.detection.calibration import in_own_scale
from sorvolo.detection.contract import ModelInfo
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
from sorvolo.errors import InputError
from sorvolo.lab.training.exported import ExportedModel, other_networks
from sorvolo.lab.training.presets import NETS, Preset
from sorvolo.lab.training.weights import SOURCES, WAYS, ImageNetWeights, Net, read_weights
from sorvolo.missions.fetched_files import copy_by_hash
from sorvolo.store.atomic import atomic_path, writing

_FEW_LABELS = 50  # of a class in a measured set: with fewer, two AP50 may differ by chance
_CLEARLY = 0.03  # so much higher an AP50 is worth a word; by choice


def load_start(choice: str, preset: Preset) -> ImageNetWeights | ExportedModel | None:
    """What `--weights` names: nothing for "none", a model of ours by its name or file, else ImageNet weights.

    Raises InputError when the file holds nothing of the kind, does not fit the preset, or cannot be fetched.
    """
    if choice == "none":
        return None
    is_installed = choice != "auto" and any(each.name == choice for each in installed_models())
    if is_installed or choice.lower().endswith(".onnx"):
        return _model(choice, preset)
    return load_weights(choice, NETS[preset])


def load_weights(choice: str, net: Net) -> ImageNetWeights:
    """ImageNet weights of `net`: fetched or from the cache for "auto", else read from that file.

    Raises InputError when the file holds no such weights or nothing can be fetched.
    """
    weights = read_weights(fetch_weights(net) if choice == "auto" else Path(choice))
    if choice == "auto":
        weights = replace(weights, origin=f"{SOURCES[net].name} ({SOURCES[net].licence})")
    if weights.net != net:
        raise InputError(
            f"{choice} holds weights of {weights.net}, but this preset is built on {net}; {WAYS}"
        )
    return weights


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
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
    offline = f"put that file at {place}, or name it with --weights FILE; --weights none starts from nothing"
    with atomic_path(place) as temporary:
        copy_by_hash(source.url, temporary, source.sha256, offline=offline)
    return place


def part_notices(start: ExportedModel) -> list[str]:
    """What of the model a training does not carry on, and what that costs by its card."""
    if not start.left:
        return []
    text = (
        f"only the aerial network of {start.origin} is learnt on from. Not carried on: {', '.join(start.left)}; the "
        "new model begins with less than that model knows"
    )
    if start.cost:
        text += f" (by its card, AP50 in %: {'; '.join(start.cost)})"
    return [text]


def threshold_notices(start: ExportedModel, too_few: Sequence[str]) -> list[str]:
    """From which scores the new model reports the classes of which too few objects were held out to choose one."""
    why = "too few objects were held out to choose the score to report from"
    own = "those of the model's aerial network by itself" if start.left else "the model's own"
    kept = [name for name in too_few if name in start.thresholds]
    unknown = [name for name in too_few if name in start.classes and name not in start.thresholds]
    notices = []
    if kept:
        notices.append(f"{why}: {', '.join(kept)} kept {own}")
    if unknown:
        notices.append(
            f"{why}, and nothing states those of the model's aerial network by itself: the scores from which "
            f"{', '.join(unknown)} are reported are not calibrated; hold more out (--val)"
        )
    return notices


def size_notices(start: ExportedModel, too_few: Sequence[str]) -> list[str]:
    """Of which classes the new model keeps the sizes at which they are found well (`best_px`)."""
    kept = [name for name in too_few if name in start.best_px]
    if not kept:
        return []
    return [
        "too few objects were held out to measure at which sizes they are found well: "
        f"{', '.join(kept)} kept those of {start.origin}"
    ]


def kept_on_request(
    start: ExportedModel, classes: Sequence[str], too_few: Sequence[str]
) -> tuple[str, ...]:
    """Which of the new model's classes are reported on request alone: those of the model before that are `too_few`
    among the held-out objects, since nothing shows that they became surer. None where no other class would be left."""
    kept = tuple(name for name in classes if name in start.on_request and name in too_few)
    return kept if len(kept) < len(classes) else ()


def request_notices(start: ExportedModel, kept: Sequence[str]) -> list[str]:
    """Which classes `kept_on_request` leaves unreported unless a person asks for them."""
    if not kept:
        return []
    names = ", ".join(kept)
    return [
        f"{names}: reported only where asked for (--classes), as by {start.origin}; too few objects were held out to "
        "show that the new model finds them more surely"
    ]


def kept_thermal_by(start: ExportedModel, classes: Sequence[str], *, thermal: bool) -> str:
    """The installed model that goes on looking at thermal frames in the new one's place: that of the model before,
    unless the new one learnt from thermal frames itself or they share no class; "" for none."""
    if thermal or not start.thermal_by or thermal_model(classes, start.thermal_by) is None:
        return ""
    return start.thermal_by


def class_notices(start: ExportedModel, classes: Sequence[str]) -> list[str]:
    """What becomes of the model's classes in a training of `classes`, where they are not the same."""
    new = [name for name in classes if name not in start.classes]
    left = [name for name in start.classes if name not in classes]
    notices = []
    if new:
        notices.append(f"{start.origin} does not know {', '.join(new)}: learnt from the beginning")
    if left:
        notices.append(
            f"{start.origin} knows {', '.join(left)}, which nothing here labels: the new model will not"
        )
    return notices


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
    start = ExportedModel(
        content,
        info.classes,
        f"the model {info.name}",
        sha256,
        info.licence,
        info.trained_on,
        in_own_scale(info),
        {name: asdict(each) for name, each in info.calibration.items()},
        on_request=info.on_request,
        thermal_by=info.thermal_by,
        best_px=info.best_px,
    )
    return _aerial(start, info, path) if other_networks(content) else start


def _aerial(start: ExportedModel, info: ModelInfo, path: Path) -> ExportedModel:
    """Of a file of several networks the aerial one: its own thresholds, by the card, and what the others gave."""
    card = read_card(InstalledModel(path.stem, path, is_packaged=False))
    is_of_file = str(card.get(HASH_KEY, "")).lower() == start.sha256
    alone = card.get("aerial_alone", {}) if is_of_file else {}
    left = [*other_networks(start.content)]
    left += (
        [f"the second look at reports ({', '.join(info.second_look)})"] if info.second_look else []
    )
    left += ["the search in several sizes"] if info.pyramid else []
    cost = tuple(_lost(alone.get("measured") or {}, card.get("measured") or {})) if alone else ()
    return replace(
        start, thresholds=alone.get("thresholds", {}), calibration={}, left=tuple(left), cost=cost
    )


def _lost(alone: Mapping[str, Any], whole: Mapping[str, Any]) -> Iterator[str]:
    """Of each class that the whole model finds clearly better on a set, both AP50."""
    for name in (each for each in whole if each in alone):
        for label, figures in whole[name].items():
            if label not in alone[name] or figures["labels"] < _FEW_LABELS:
                continue
            before, after = (each["AP50"]["value"] for each in (figures, alone[name][label]))
            if before - after > _CLEARLY:
                yield f"{label} on {name} {100 * after:.1f} alone, {100 * before:.1f} as a whole"
