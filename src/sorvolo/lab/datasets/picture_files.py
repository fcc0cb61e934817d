"""Where a set's pictures lie, and how large they are; only headers are read."""

import os
import warnings
from pathlib import Path

from PIL import ExifTags, Image

from sorvolo.errors import InputError

PICTURE_ENDINGS = frozenset({".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp"})

_BROKEN = (
    OSError,
    SyntaxError,
    ValueError,
    TypeError,
    KeyError,
    IndexError,
    OverflowError,
    Image.DecompressionBombError,
)


def pictures_below(folder: Path) -> list[Path]:
    """All pictures of the folder and its sub-folders, hidden ones left out, sorted by path."""
    return files_below(folder, *PICTURE_ENDINGS)


def files_below(folder: Path, *endings: str) -> list[Path]:
    """All files of the folder and its sub-folders (with one of the endings), hidden ones left out, sorted.

    Linked folders count, as large sets are often kept elsewhere; each folder once, so that links may form a ring.
    """
    found: list[Path] = []
    seen: set[str] = set()
    for parent, folders, files in os.walk(folder, followlinks=True):
        real = os.path.realpath(parent)
        if real in seen:
            folders.clear()
            continue
        seen.add(real)
        folders[:] = sorted(name for name in folders if not _is_hidden(name))
        names = (name for name in files if not _is_hidden(name))
        found += [
            Path(parent, name)
            for name in names
            if not endings or Path(name).suffix.lower() in endings
        ]
    return sorted(found)


def shown_size_px(path: Path) -> tuple[int, int, int]:
    """A picture's width and height as its EXIF orientation wants it shown, and that orientation, 1 to 8.

    Raises InputError for what is no readable picture. Any mode and depth is fine; pixels are not read.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter(
                "ignore"
            )  # a survey's orthophoto is large, not an attack: pixels are not read here
            with Image.open(path) as picture:
                width, height = picture.size
                orientation = _orientation(picture)
    except _BROKEN as error:
        raise InputError(f"{path} is no picture that can be opened ({error})") from error
    if min(width, height) < 1:
        raise InputError(f"{path} has no pixels ({width}x{height})")
    return (height, width, orientation) if orientation >= 5 else (width, height, orientation)


def _orientation(picture: Image.Image) -> int:
    try:
        # a PNG's own method decodes its pixels where no EXIF stands before them
        value = int(Image.Image.getexif(picture).get(ExifTags.Base.Orientation, 1))
    except _BROKEN:
        return 1  # damaged EXIF: viewers show the picture as stored
    return value if 1 <= value <= 8 else 1


def _is_hidden(name: str) -> bool:
    return name.startswith(".") or name == "__MACOSX"
