"""What changed between two aligned pictures, by either method: the room's public function."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sorvolo.change.pair.thesis import ThesisReference, ThesisSettings, compare_thesis
from sorvolo.change.robust import RobustSettings, compare_robust
from sorvolo.errors import InputError, SettingsError
from sorvolo.geometry.arrays import Boxes, ImageGray, Mask

METHODS = ("thesis", "robust")


class Comparison(NamedTuple):
    """`mask` (h, w) uint8, 255 where something changed, else 0; `boxes` (N, 4) int64 x, y, width, height."""

    mask: ImageGray
    boxes: Boxes


def compare_images(
    reference: NDArray[np.uint8] | ThesisReference,
    query: NDArray[np.uint8],
    valid: Mask | None = None,
    settings: ThesisSettings | RobustSettings | None = None,
    method: str = "thesis",
    threads: int = 1,
) -> Comparison:
    """What changed from `reference` to `query`, two aligned BGR pictures (h, w, 3) uint8.

    Where the bool mask `valid` (h, w) is False, as in a hole of a mosaic, the answer is unknown: never changed.
    `method` is "thesis" (section 3.2 of the thesis, with `ThesisSettings`; the reference may come from
    `prepare_reference`) or "robust" (`RobustSettings`, one thread). Raises InputError and SettingsError.
    """
    _check_choice(method, settings, threads)
    if isinstance(reference, ThesisReference) and method != "thesis":
        raise InputError("the reference is a ThesisReference; method 'robust' needs a picture")
    before = _checked(
        "reference", reference.picture if isinstance(reference, ThesisReference) else reference
    )
    query = _checked("query", query)
    if before.shape != query.shape:
        raise InputError(
            f"reference is {_size(before)}, query {_size(query)}; give aligned pictures of the same size"
        )
    _check_valid(valid, query)
    if method == "robust":
        robust = compare_robust(
            before, query, valid, settings if isinstance(settings, RobustSettings) else None
        )
        return Comparison(robust.mask, robust.boxes)
    found = compare_thesis(
        reference if isinstance(reference, ThesisReference) else before,
        query,
        valid,
        settings if isinstance(settings, ThesisSettings) else None,
        threads,
    )
    return Comparison(found.mask, found.boxes)


def _check_choice(
    method: str, settings: ThesisSettings | RobustSettings | None, threads: int
) -> None:
    if method not in METHODS:
        raise SettingsError(f"method is {method!r}; give one of {', '.join(METHODS)}")
    wanted = ThesisSettings if method == "thesis" else RobustSettings
    if settings is not None and not isinstance(settings, wanted):
        raise SettingsError(
            f"settings are {type(settings).__name__}; method {method!r} needs {wanted.__name__}"
        )
    if isinstance(threads, bool) or not isinstance(threads, int) or threads < 1:
        raise SettingsError(f"threads is {threads!r}; give a whole number from 1")


def _checked(name: str, image: Any) -> NDArray[np.uint8]:
    if not isinstance(image, np.ndarray):
        raise InputError(
            f"{name} is a {type(image).__name__}; give a NumPy array (height, width, 3) of uint8, BGR"
        )
    if image.dtype != np.uint8:
        raise InputError(f"{name} holds {image.dtype}; give uint8, 0 to 255")
    if image.ndim != 3 or image.shape[2] != 3:
        raise InputError(f"{name} has the shape {image.shape}; give (height, width, 3), BGR")
    if image.size == 0:
        raise InputError(f"{name} is empty, {image.shape}; give at least one pixel")
    return np.ascontiguousarray(image)


def _check_valid(valid: Any, query: NDArray[np.uint8]) -> None:
    if valid is None:
        return
    if not isinstance(valid, np.ndarray) or valid.dtype != np.bool_:
        found = (
            f"n array of {valid.dtype}"
            if isinstance(valid, np.ndarray)
            else f" {type(valid).__name__}"
        )
        raise InputError(
            f"valid is a{found}; give a NumPy array of bool, True where both pictures are known"
        )
    if valid.shape != query.shape[:2]:
        raise InputError(f"valid has the shape {valid.shape}; the pictures need {query.shape[:2]}")


def _size(image: NDArray[np.uint8]) -> str:
    return f"{image.shape[1]} x {image.shape[0]} px"
