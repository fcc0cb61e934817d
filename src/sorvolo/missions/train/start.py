"""What a training begins with: ImageNet weights of the backbone, or a model of ours that is tuned to other pictures."""

import os
from collections.abc import Sequence
from dataclasses import replace
from hashlib import sha256
from pathlib import Path

from sorvolo.detection.models import file_sha256, find_model, installed_models
from sorvolo.detection.session import read_info, read_model
from sorvolo.errors import InputError
from sorvolo.missions.fetched_files import copy_by_hash
from sorvolo.store.atomic import atomic_path, writing
from sorvolo.training.exported import ExportedModel
from sorvolo.training.presets import NETS, Preset
from sorvolo.training.weights import SOURCES, WAYS, ImageNetWeights, Net, read_weights


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
        raise InputError(f"{choice} holds weights of {weights.net}, but this preset is built on {net}; {WAYS}")
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


def class_notices(start: ExportedModel, classes: Sequence[str]) -> list[str]:
    """What becomes of the model's classes in a training of `classes`, where they are not the same."""
    new = [name for name in classes if name not in start.classes]
    left = [name for name in start.classes if name not in classes]
    notices = []
    if new:
        notices.append(f"{start.origin} does not know {', '.join(new)}: learnt from the beginning")
    if left:
        notices.append(f"{start.origin} knows {', '.join(left)}, which nothing here labels: the new model will not")
    return notices


def _model(choice: str, preset: Preset) -> ExportedModel:
    path = find_model(choice)
    info, content = read_info(path), read_model(path)
    if info.precision != "float32":
        raise InputError(
            f"{path} is in {info.precision} and cannot be learnt on from; give the float32 model that it was made from"
        )
    if info.preset and info.preset != preset:
        raise InputError(f"{path} is of the preset {info.preset}, not {preset}: train with --preset {info.preset}")
    return ExportedModel(
        content, info.classes, f"the model {info.name}", file_sha256(path), info.licence, info.trained_on,
        info.thresholds,
    )
