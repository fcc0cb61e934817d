"""What changed between two aligned pictures: the room's public function."""

from collections.abc import Mapping
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from sorvolo.change.robust import as_bgr, compare_robust
from sorvolo.errors import InputError
from sorvolo.geometry.arrays import Boxes, ImageGray, Mask

_LEAST_PX = 32  # along a side


class Comparison(NamedTuple):
    """`mask` (h, w) uint8, 255 where something changed, else 0; `boxes` (N, 4) int64 x, y, width, height."""

    mask: ImageGray
    boxes: Boxes


@runtime_checkable
class PairMethod(Protocol):
    """Another way to compare two aligned pictures than the robust one. A frozen record of its own choices."""

    @property
    def name(self) -> str:
        """As reports name it."""

    def compare(
        self, reference: NDArray[np.uint8], query: NDArray[np.uint8], valid: Mask
    ) -> Comparison:
        """What changed between two RGB pictures (h, w, 3), where `valid` (h, w)."""

    def steps(
        self, reference: NDArray[np.uint8], query: NDArray[np.uint8], valid: Mask
    ) -> Mapping[str, NDArray[np.uint8]]:
        """Its intermediate pictures by name, RGB or gray."""


def compare_images(
    reference: NDArray[np.uint8],
    query: NDArray[np.uint8],
    valid: Mask | None = None,
) -> Comparison:
    """What changed from `reference` to `query`, two aligned RGB pictures (h, w, 3) uint8.

    Where the bool mask `valid` (h, w) is False, as in a hole of a mosaic, the answer is unknown: never changed.
    Raises InputError.
    """
    reference, query = checked_pair(reference, query, valid)
    if min(query.shape[:2]) < _LEAST_PX:
        raise InputError(
            f"the pictures are {_size(query)}; at least {_LEAST_PX} px are needed each way"
        )
    found = compare_robust(as_bgr(reference), as_bgr(query), valid)
    return Comparison(found.mask, found.boxes)


def checked_pair(
    reference: Any, query: Any, valid: Any
) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Both pictures as whole arrays. Raises InputError for what cannot be compared."""
    reference, query = _checked("reference", reference), _checked("query", query)
    if reference.shape != query.shape:
        raise InputError(
            f"reference is {_size(reference)}, query {_size(query)}; give aligned pictures of the same size"
        )
    _check_valid(valid, query)
    return reference, query


def _checked(name: str, image: Any) -> NDArray[np.uint8]:
    if not isinstance(image, np.ndarray):
        raise InputError(
            f"{name} is a {type(image).__name__}; give a NumPy array (height, width, 3) of uint8, RGB"
        )
    if image.dtype != np.uint8:
        raise InputError(f"{name} holds {image.dtype}; give uint8, 0 to 255")
    if image.ndim != 3 or image.shape[2] != 3:
        raise InputError(f"{name} has the shape {image.shape}; give (height, width, 3), RGB")
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
