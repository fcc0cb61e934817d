"""Masks as picture files, ours, a simulation's, or those of a dataset; nonzero is change."""

from pathlib import Path

import cv2
import numpy as np

from sorvolo.errors import InputError
from sorvolo.geometry.arrays import Mask

MASK_ENDINGS = {
    ".png",
    ".jpg",
    ".jpeg",
    ".bmp",
    ".tif",
    ".tiff",
    ".webp",
    ".pgm",
    ".pbm",
    ".ppm",
    ".gif",
}
"""The files that are masks, in small letters."""

_LOSSY = {".jpg", ".jpeg", ".webp"}
_UNKNOWN = 128  # in masks that `compare --masks` writes (docs/formats.md)


def read_mask(path: Path, *, may_be_unknown: bool) -> tuple[Mask, Mask]:
    """Where a mask marks change, and where it marks that nothing is known, (height, width) each.

    A pixel is changed when any of its colours is nonzero; in lossy formats, from 128 on. With `may_be_unknown`, 128 is
    unknown in a mask that holds 0, 128 and 255 only. Raises InputError for a file that is no picture.
    """
    data = np.frombuffer(path.read_bytes(), np.uint8)
    picture = cv2.imdecode(data, cv2.IMREAD_UNCHANGED) if len(data) else None
    if picture is None:
        raise InputError(f"{path}: cannot be read as a picture; make this mask anew")
    values = np.asarray(picture)
    if values.ndim == 3:  # alpha is no part of the change
        values = values[..., :3].max(axis=2) if values.shape[2] != 2 else values[..., 0]
    if path.suffix.lower() in _LOSSY:
        changed: Mask = values >= 128
        return changed, np.zeros(values.shape, bool)
    unknown = values == _UNKNOWN
    if not (may_be_unknown and unknown.any() and np.isin(values, (0, _UNKNOWN, 255)).all()):
        unknown = np.zeros(values.shape, bool)
    return (values > 0) & ~unknown, unknown
