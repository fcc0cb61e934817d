"""Which models there are: the packaged ones and the user's, their files, and the hashes that vouch for them."""

import hashlib
import json
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from importlib.resources import files
from pathlib import Path
from typing import Any

from sorvolo.detection.contract import ModelInfo
from sorvolo.detection.layouts import AUTO
from sorvolo.detection.session import adopted, read_info, read_model
from sorvolo.errors import InputError
from sorvolo.paths import AnyPath

FOLDER_VARIABLE = "SORVOLO_MODELS"
"""Names the folder of the user's models in place of the usual one."""

HASH_KEY = "sha256"
"""In the card, NAME.json beside NAME.onnx: the file's SHA-256 in hexadecimal."""


@dataclass(frozen=True)
class InstalledModel:
    """A model by name, and its file; what is known of it stands in its card, the .json of the same name beside it."""

    name: str
    path: Path
    is_packaged: bool


class Integrity(StrEnum):
    """Whether a model file is still the one whose hash its card records."""

    GOOD = "good"
    CHANGED = "changed"
    NOT_RECORDED = "not recorded"


def models_folder() -> Path:
    """Where the user's models lie: $SORVOLO_MODELS, else sorvolo/models in the system's folder for a user's data."""
    if chosen := os.environ.get(FOLDER_VARIABLE):
        return Path(chosen).expanduser()
    if data := os.environ.get("XDG_DATA_HOME") or os.environ.get("LOCALAPPDATA"):
        return Path(data) / "sorvolo" / "models"
    return Path.home() / ".local" / "share" / "sorvolo" / "models"


def installed_models() -> list[InstalledModel]:
    """All models, the packaged ones first, then the user's by name; a packaged name is never replaced."""
    packaged = _models_in(Path(str(files("sorvolo.detection"))) / "data", is_packaged=True)
    names = {each.name for each in packaged}
    return packaged + [
        each for each in _models_in(models_folder(), is_packaged=False) if each.name not in names
    ]


def hidden_models() -> list[InstalledModel]:
    """The user's models that bear a packaged one's name, which hides them."""
    shown = {each.path for each in installed_models()}
    return [
        each for each in _models_in(models_folder(), is_packaged=False) if each.path not in shown
    ]


def find_model(name_or_path: AnyPath) -> Path:
    """The file of an installed model, or the path that was given.

    Raises InputError for a name that is not installed, with those that are.
    """
    path = Path(name_or_path).expanduser()
    if (
        not isinstance(name_or_path, str)
        or path.suffix.lower() == ".onnx"
        or os.sep in name_or_path
        or path.is_file()
    ):
        return path
    return installed_model(name_or_path).path


def demand_searching(info: ModelInfo) -> None:
    """Raise InputError for a model that searches no whole pictures, with the installed ones that do."""
    if info.second_only:
        raise InputError(
            f"the model '{info.name}' only looks again at what other models report, a whole picture means nothing to "
            f"it; give one that searches pictures: {_searching()}"
        )


def installed_model(name: str) -> InstalledModel:
    """The installed model of this name; raises InputError where there is none, with those that are."""
    for each in installed_models():
        if each.name == name:
            return each
    raise InputError(
        f"there is no model {name!r}; installed are: {_searching()} (own ones lie in {models_folder()}); give one of "
        "them or a .onnx file; `pip install sorvolo-models` brings the packaged ones"
    )


def thermal_model(classes: Sequence[str], name: str = "") -> Path | None:
    """An installed model that was trained on thermal frames and knows one of `classes`, None where there is none.

    `name`: no other than this one. The user's own come before the packaged ones, and of these those for thermal frames
    alone first. Files that cannot be used are passed over: `sorvolo models list` shows why.
    """
    found: list[tuple[bool, bool, Path]] = []
    for each in installed_models():
        if name not in ("", each.name):
            continue
        try:
            info = read_info(each.path)
        except InputError:
            continue
        if info.thermal and not info.second_only and set(info.classes) & set(classes):
            found.append((each.is_packaged, info.daylight, each.path))
    return min(found, key=lambda row: row[:2])[2] if found else None


def import_model(
    path: Path, name: str = "", layout: str = AUTO, classes: Sequence[str] | None = None
) -> InstalledModel:
    """Install another maker's ONNX file (`session.adopted`) under a name, with a card that records its hash.

    Raises InputError for what cannot be recognised or run, and for a name that is taken.
    """
    name = name or path.stem
    if not re.fullmatch(r"[\w.-]{1,64}", name):
        raise InputError(
            f"a model's name is 1 to 64 letters, digits, '.', '_' or '-', not {name!r}"
        )
    target = models_folder() / f"{name}.onnx"
    if target.exists() or any(known.name == name for known in installed_models()):
        raise InputError(f"a model named {name!r} is installed already; choose another --name")
    model = adopted(path, layout, classes, name)
    card = {HASH_KEY: hashlib.sha256(model).hexdigest(), "imported_from": path.name}
    target.parent.mkdir(parents=True, exist_ok=True)
    for place, data in (
        (target.with_suffix(".json"), json.dumps(card, indent=1).encode()),
        (target, model),
    ):
        part = place.with_name(f".{place.name}.part")
        part.write_bytes(data)
        part.replace(place)
    return InstalledModel(name, target, False)


def read_card(model: InstalledModel) -> dict[str, Any]:
    """The model's card; empty where it has none. Raises InputError where it is damaged."""
    path = model.path.with_suffix(".json")
    if not path.is_file():
        return {}
    try:
        card = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(
            f"the model card {path} cannot be read ({error}); write it again or remove it"
        ) from error
    if not isinstance(card, dict):
        raise InputError(f"the model card {path} holds no JSON object; write it again or remove it")
    return card


def integrity(model: InstalledModel) -> Integrity:
    """Whether the file is still the one that its card describes. Raises InputError where one of them cannot be read."""
    recorded = str(read_card(model).get(HASH_KEY, "")).lower()
    if not recorded:
        return Integrity.NOT_RECORDED
    return Integrity.GOOD if file_sha256(model.path) == recorded else Integrity.CHANGED


def file_sha256(path: Path) -> str:
    """The SHA-256 of a model file, in hexadecimal. Raises InputError where it cannot be read."""
    return hashlib.sha256(read_model(path)).hexdigest()


def _searching() -> str:
    """The names of the installed models that search pictures; those of files that cannot be used among them."""
    return (
        ", ".join(each.name for each in installed_models() if not _is_second_only(each.path))
        or "none"
    )


def _is_second_only(path: Path) -> bool:
    try:
        return read_info(path).second_only
    except InputError:
        return False


def _models_in(folder: Path, *, is_packaged: bool) -> list[InstalledModel]:
    if not folder.is_dir():
        return []
    paths = sorted(each for each in folder.glob("*.onnx") if not each.name.startswith("."))
    return [InstalledModel(each.stem, each, is_packaged) for each in paths]
