"""Detection models on disk: fetched by hash, checked, and made smaller."""

import json
import os
import re
from collections.abc import Iterator, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Literal

from sorvolo.capture.decoding import PHOTO_SUFFIXES
from sorvolo.capture.photos import read_picture
from sorvolo.detection.models import (
    HASH_KEY,
    InstalledModel,
    installed_model,
    installed_models,
    models_folder,
)
from sorvolo.detection.quantise import Quantised, quantise
from sorvolo.detection.session import read_info
from sorvolo.errors import InputError, SettingsError
from sorvolo.geometry.arrays import ImageRGB
from sorvolo.missions.fetched_files import copy_by_hash, is_web_address
from sorvolo.store.atomic import atomic_path, atomic_write_bytes, writing

MIRROR_VARIABLE = "SORVOLO_MODELS_URL"
"""A team's own collection: `fetch NAME` asks for NAME.onnx under this address."""

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")
_SHA256 = re.compile(r"[0-9a-f]{64}")


def fetch_model(source: str, sha256: str, *, name: str = "") -> InstalledModel:
    """Install the model at a web address, in a file, or of a name under $SORVOLO_MODELS_URL, if its hash is `sha256`.

    It is written beside its place, and appears there, with a card that records hash and source, only when its hash is
    the one that was asked for and it is a model of ours. `name` is its name among the installed ones, else the file's.
    Raises SettingsError for a hash or a name that cannot be, InputError where it cannot be had, is another file, or is
    no model, StoreError where it cannot be written.
    """
    wanted = parse_sha256(sha256)
    address = _address_of(source)
    own = name or re.sub(r"(?i)\.onnx$", "", re.split(r"[/\\]", address.split("?")[0])[-1])
    if not _NAME.fullmatch(own):
        raise SettingsError(
            f"{own!r} cannot be a model's name: use letters, digits, '.', '_' and '-' with --name"
        )
    if any(each.name == own and each.is_packaged for each in installed_models()):
        raise SettingsError(
            f"{own!r} is a packaged model's name; give the new one another with --name"
        )
    folder = models_folder()
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{own}.onnx"
    with atomic_path(path) as temporary:
        copy_by_hash(
            address,
            temporary,
            wanted,
            offline="bring the file on a disk and give its path: sorvolo models fetch FILE --sha256 HASH",
        )
        try:
            read_info(temporary)
        except InputError as error:
            raise InputError(
                f"nothing was installed: {str(error).replace(str(temporary), address)}"
            ) from error
        card = {
            HASH_KEY: wanted,
            "source": address,
            "fetched": datetime.now(UTC).isoformat(timespec="seconds"),
        }
        atomic_write_bytes(path.with_suffix(".json"), json.dumps(card, indent=1).encode())
    return installed_model(own)


def parse_sha256(text: str) -> str:
    """A SHA-256 as a person gives it, in small letters. Raises SettingsError where it cannot be one."""
    wanted = text.strip().lower()
    if not _SHA256.fullmatch(wanted):
        raise SettingsError(
            f"--sha256 {text!r}: a SHA-256 has 64 hexadecimal digits; ask whoever gives the model"
        )
    return wanted


def quantise_model(
    model: Path,
    pictures: Path,
    out: Path,
    *,
    most: int,
    float_parts: Sequence[str] = (),
    weight_bits: Literal[7, 8] = 8,
) -> Quantised:
    """Write `model` in eight bits to `out`, its ranges from at most `most` pictures of a folder, evenly chosen.

    `float_parts` and `weight_bits` are for `quantise`, which raises what is raised, besides InputError for a folder
    without pictures and StoreError where `out` cannot be written.
    """
    if out.suffix.lower() != ".onnx":
        raise SettingsError(f"--out {out}: a model's file ends in .onnx")
    if not pictures.is_dir():
        raise InputError(
            f"{pictures} is no folder of pictures; give one with what the model will have to see"
        )
    paths = sorted(path for path in pictures.rglob("*") if path.suffix.lower() in PHOTO_SUFFIXES)
    if not paths:
        raise InputError(
            f"there are no pictures in {pictures}; needed are {', '.join(sorted(PHOTO_SUFFIXES))}"
        )
    count = min(most, len(paths))
    chosen = [paths[index * len(paths) // count] for index in range(count)]
    result = quantise(model, _pictures(chosen), float_parts=float_parts, weight_bits=weight_bits)
    atomic_write_bytes(out, result.model)
    return result


def _pictures(paths: list[Path]) -> Iterator[ImageRGB]:
    for path in paths:
        yield read_picture(path)


def _address_of(source: str) -> str:
    """Where a model is: an address or a path as given, or that of a name in the team's own collection."""
    if is_web_address(source) or Path(source).expanduser().is_file():
        return source
    if "://" in source:
        raise SettingsError(f"{source}: models are fetched by http or https, or from a file")
    mirror = os.environ.get(MIRROR_VARIABLE, "")
    if mirror and _NAME.fullmatch(source):
        return f"{mirror.rstrip('/')}/{source}.onnx"
    raise InputError(
        f"there is no file {source}, and ${MIRROR_VARIABLE} names no collection to ask for a model of this name; give "
        "its web address or its file"
    )
