"""The last pixels of alignment: a homography close to identity from dense flow, and what no homography explains."""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from cv2.typing import MatLike

from sorvolo.change.regions import LOGARITHMS
from sorvolo.geometry.arrays import Bytes, Floats, Mask, Matrix3, shrunk
from sorvolo.kernels import fit_moves, flow_on_grid

_GRID = (28, 16)  # columns and rows of the flow that is fitted; the cached `_rows` are its
_RIDGE = 1e-4 * np.array(
    [0, 0.01, 0.01, 0, 0.01, 0.01, 1, 1]
)  # parts of the size: bends are small, or seen
_LEAST_FLOW_PX = (
    32  # OpenCV's flow crashes on pictures that are wide and less high than four of its patches
)


# Which displacements are taken out: those of the pictures' corners, in their own pixels.
_LARGEST_PX = 6.0  # a larger one has lost its way
_SMALLEST_PX = 0.12  # a resampling costs more than this is worth
_LEAST_PLACES = 30  # of the grid, on known ground


@dataclass(frozen=True, eq=False)
class Settling:
    """`reference_from_query` (3, 3) takes the query's pixels to the reference's; identity where nothing is gained.

    `moved_px` is its largest displacement; `rest_px` the median length of the flow that is left, what parallax and
    wind do, in the pixels of the pictures given.
    """

    reference_from_query: Matrix3
    moved_px: float
    rest_px: float


def settle(reference: Bytes, query: Bytes, known: Mask | None = None) -> Settling:
    """Settle two gray pictures (h, w) uint8 that are a few pixels apart, whatever their light."""
    height, width = query.shape
    small = max(16, width // 2), max(16, height // 2)
    scale = np.array([width / small[0], height / small[1]])
    details = [_details(shrunk(image, small)) for image in (reference, query)]
    if min(small) < _LEAST_FLOW_PX:
        return Settling(np.eye(3), 0.0, 0.0)
    start: Any = None
    flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_ULTRAFAST).calc(
        details[1], details[0], start
    )
    grid = flow_on_grid(np.asarray(flow, np.float32), details[1], *_GRID[::-1]).reshape(-1, 3)
    flow_px, texture = grid[:, :2] * scale, grid[:, 2]
    trust = np.clip(texture.astype(np.float64) / 8, 0.05, 1)
    if known is not None:
        trust *= shrunk(known.astype(np.float32), _GRID).ravel() > 0.99
    if np.count_nonzero(trust) < _LEAST_PLACES:
        return Settling(np.eye(3), 0.0, 0.0)
    matrix, rest_px = _near_homography(flow_px / (width, height), trust, (width, height))
    corners = np.array([[0.0, 0, 1], [width, 0, 1], [0, height, 1], [width, height, 1]]) @ matrix.T
    moved_px = float(
        np.abs(
            corners[:, :2] / corners[:, 2:] - [[0, 0], [width, 0], [0, height], [width, height]]
        ).max()
    )
    if not _SMALLEST_PX <= moved_px <= _LARGEST_PX:
        return Settling(np.eye(3), 0.0, rest_px)
    return Settling(matrix, moved_px, rest_px)


def _details(gray: MatLike) -> Bytes:
    """What is finer than clouds, in logarithms: light falls out of it."""
    logarithm = cv2.LUT(gray, LOGARITHMS)
    return np.asarray(
        cv2.addWeighted(logarithm, 2, cv2.blur(logarithm, (15, 15)), -2, 128), np.uint8
    )


@lru_cache(maxsize=1)
def _rows() -> tuple[Floats, Floats]:
    """What a homography near identity moves the grid's places by, per parameter: (N, 8) in x and in y."""
    x, y = (each.ravel() for each in np.meshgrid(*[(np.arange(n) + 0.5) / n - 0.5 for n in _GRID]))
    zero, one = np.zeros_like(x), np.ones_like(x)
    rows_x = np.column_stack([one, x, y, zero, zero, zero, x * x, x * y])
    return rows_x, np.column_stack([zero, zero, zero, one, x, y, x * y, y * y])


def _near_homography(
    moves: Floats, trust: Floats, size_px: tuple[int, int]
) -> tuple[Matrix3, float]:
    """Homography in pixels, to first order, from displacements of the grid (as parts of the size); median rest, px."""
    rows_x, rows_y = _rows()
    a, rest_px = fit_moves(rows_x, rows_y, moves, trust, _RIDGE, *size_px)
    near = np.array([[1 + a[1], a[2], a[0]], [a[4], 1 + a[5], a[3]], [-a[6], -a[7], 1.0]])
    parts_from_px = np.array(
        [
            [1 / size_px[0], 0, 0.5 / size_px[0] - 0.5],
            [0, 1 / size_px[1], 0.5 / size_px[1] - 0.5],
            [0, 0, 1.0],
        ]
    )
    matrix = np.linalg.inv(parts_from_px) @ near @ parts_from_px
    return matrix / matrix[2, 2], rest_px
