"""The ground that a flight could compare with the map, told by the outlines of views."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from sorvolo.geometry.arrays import Mask, PointsM

_FINEST_M = 0.1
_LARGEST_CELLS = 4_000_000


@dataclass(frozen=True, eq=False)
class ComparedGround:
    """Cells of ground, rows from north to south; the outer corner of the first is at (`west_m`, `north_m`)."""

    cells: Mask  # (rows, columns)
    west_m: float
    north_m: float
    cell_m: float

    @property
    def area_m2(self) -> float:
        """The area of all compared cells."""
        return float(np.count_nonzero(self.cells)) * self.cell_m**2

    def holds(self, points_m: PointsM) -> Mask:
        """(N,) whether each site point, shape (N, 2), lies on compared ground."""
        columns = np.floor((points_m[:, 0] - self.west_m) / self.cell_m).astype(np.int64)
        rows = np.floor((self.north_m - points_m[:, 1]) / self.cell_m).astype(np.int64)
        height, width = self.cells.shape
        inside = (columns >= 0) & (columns < width) & (rows >= 0) & (rows < height)
        held = np.zeros(len(points_m), bool)
        held[inside] = self.cells[rows[inside], columns[inside]]
        return held


def compared_ground(views_m: Sequence[PointsM], known_m: Sequence[PointsM]) -> ComparedGround:
    """The ground within any of `views_m` and any of `known_m`, convex outlines of (N, 2) site metres each.

    Cells are 0.1 m wide, wider where that would be more than four million of them.
    """
    if not views_m or not known_m:
        return ComparedGround(np.zeros((1, 1), bool), 0.0, 0.0, _FINEST_M)
    corners = np.concatenate(list(views_m))
    low, high = corners.min(axis=0), corners.max(axis=0)
    size_m = np.maximum(high - low, _FINEST_M)
    cell_m = max(_FINEST_M, float(np.sqrt(size_m[0] * size_m[1] / _LARGEST_CELLS)))
    columns, rows = np.ceil(size_m / cell_m).astype(int) + 1
    west_m, north_m = float(low[0]), float(high[1])
    layers = []
    for outlines_m in (views_m, known_m):
        layer = np.zeros((rows, columns), np.uint8)
        for outline_m in outlines_m:
            pixels = (outline_m - [west_m, north_m]) * [1 / cell_m, -1 / cell_m] - 0.5
            cv2.fillConvexPoly(layer, np.rint(pixels * 16).astype(np.int32), 1, shift=4)
        layers.append(layer > 0)
    return ComparedGround(layers[0] & layers[1], west_m, north_m, cell_m)
