"""The array aliases: what shape, order and unit an annotated array has."""

from collections.abc import Sequence
from typing import Any, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

_Kind = TypeVar("_Kind", bound=np.generic)

Floats: TypeAlias = NDArray[np.float64]
"""Any float64 array; the docstring gives its shape."""

Floats16: TypeAlias = NDArray[np.float16]
"""Any float16 array: what is kept to a thousandth; the docstring gives its shape."""

Floats32: TypeAlias = NDArray[np.float32]
"""Any float32 array; the docstring gives its shape."""

Ints32: TypeAlias = NDArray[np.int32]
"""int32, of any shape."""

Bytes: TypeAlias = NDArray[np.uint8]
"""uint8, of any shape."""

PointsPx: TypeAlias = NDArray[np.float64]
"""(N, 2) image or grid points, x right then y down, px; (0, 0) is the centre of the top-left pixel."""

PointsM: TypeAlias = NDArray[np.float64]
"""(N, 2) or (N, 3) metric points: east, north(, up) in the site frame unless the name states another."""

Matrix3: TypeAlias = NDArray[np.float64]
"""(3, 3) matrix."""

Vector3: TypeAlias = NDArray[np.float64]
"""(3,) vector."""

ImageRGB: TypeAlias = NDArray[np.uint8]
"""(height, width, 3) uint8, red green blue."""

ImageRGBA: TypeAlias = NDArray[np.uint8]
"""(height, width, 4) uint8, red green blue alpha (0 = nothing known, 255 = seen)."""

ImageBGR: TypeAlias = NDArray[np.uint8]
"""(height, width, 3) uint8, blue green red: OpenCV's own order, for what goes straight into it."""

ImageGray: TypeAlias = NDArray[np.uint8]
"""(height, width) uint8."""

Mask: TypeAlias = NDArray[np.bool_]
"""(height, width) bool."""

Boxes: TypeAlias = NDArray[np.int64]
"""(N, 4) whole-pixel boxes: x and y of the top-left pixel, width, height."""

BoxesPx: TypeAlias = NDArray[np.float32]
"""(N, 4) left, top, right, bottom edges, px, counted from the picture's top-left corner as label files do: the whole
picture is (0, 0, width, height). An edge minus one half is an image point (PointsPx)."""

TimesNs: TypeAlias = NDArray[np.int64]
"""(N,) UTC time in nanoseconds since 1970-01-01."""

Numbers: TypeAlias = NDArray[np.float32] | NDArray[np.float64] | NDArray[np.integer[Any]]
"""An array of any real numbers; the docstring gives its shape."""

Rows: TypeAlias = NDArray[np.integer[Any]]
"""(N,) indices of rows."""

Descriptors: TypeAlias = NDArray[np.uint8] | NDArray[np.float32]
"""(N, B) features: B bytes each (ORB, A-KAZE), or B float32 (SIFT, learned ones)."""

Labels: TypeAlias = NDArray[np.int64]
"""(N,) class numbers."""

Counts: TypeAlias = NDArray[np.int64]
"""Whole numbers that count something; the docstring gives their shape."""


def floats(values: Any) -> Floats:
    """Numbers from a file's lists as an array; raises ValueError or TypeError for what are none."""
    return np.asarray(values, np.float64)


def frozen(array: Any, dtype: Any = np.float64) -> Any:
    """Copy `array` as a read-only array of `dtype`, for a record's field; in C order, which a file gives back, too:
    the order of numbers in memory decides the last bit of sums over them."""
    copy = np.array(array, dtype=dtype, order="C")
    copy.setflags(write=False)
    return copy


def square(side_px: int) -> NDArray[np.uint8]:
    """The window (side, side) within which OpenCV erodes or dilates."""
    return np.ones((side_px, side_px), np.uint8)


def size_within(image: NDArray[Any], longest_px: int, least_px: int = 1) -> tuple[int, int]:
    """A picture's width and height, made smaller alike until the longer is at most this many pixels."""
    scale = min(1.0, longest_px / max(image.shape[:2]))
    height, width = (max(least_px, round(side * scale)) for side in image.shape[:2])
    return width, height


def shrunk(image: NDArray[_Kind], size_px: Sequence[int]) -> NDArray[_Kind]:
    """A picture of any kind, (height, width) or (height, width, C), brought to this width and height, less than its own:
    a pixel is the mean of those that it covers."""
    import cv2  # most who name arrays shrink none

    return cv2.resize(image, size_px, interpolation=cv2.INTER_AREA)  # type: ignore[arg-type, return-value]
