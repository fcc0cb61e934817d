"""Contour lines of heights: marching squares, the pieces joined into lines."""

from collections.abc import Iterator

import numpy as np
from shapely import line_merge, linestrings, multilinestrings

from sorvolo.geometry.arrays import Floats, PointsM, Rows
from sorvolo.geometry.homography import apply_homography
from sorvolo.heights.field import HeightField

# per case of corners above the level (top-left 1, top-right 2, bottom-right 4, bottom-left 8): pairs of edges that a
# line joins; edges 0 top, 1 right, 2 bottom, 3 left. Of the two saddles the one that keeps the high corners apart.
_SEGMENTS = {
    1: ((3, 0),),
    2: ((0, 1),),
    3: ((3, 1),),
    4: ((1, 2),),
    5: ((3, 0), (1, 2)),
    6: ((0, 2),),
    7: ((3, 2),),
    8: ((2, 3),),
    9: ((2, 0),),
    10: ((0, 1), (2, 3)),
    11: ((2, 1),),
    12: ((1, 3),),
    13: ((1, 0),),
    14: ((0, 3),),
}


def contours(
    field: HeightField, interval_m: float, zero_m: float = 0.0
) -> Iterator[tuple[float, PointsM]]:
    """Lines of equal height, (N, 2) site metres, at multiples of `interval_m` once `zero_m` is added to all heights."""
    up_m = field.up_m.astype(np.float64) + zero_m
    known = up_m[np.isfinite(up_m)]
    if not len(known):
        return
    for number in range(
        int(np.ceil(known.min() / interval_m)), int(np.floor(known.max() / interval_m)) + 1
    ):
        level = number * interval_m
        pieces = _pieces(up_m, level)
        if len(pieces):
            merged = line_merge(multilinestrings(linestrings(pieces)))
            for line in getattr(merged, "geoms", [merged]):
                yield (
                    level,
                    apply_homography(field.lattice.site_from_cells, np.asarray(line.coords)),
                )


def _pieces(up_m: Floats, level: float) -> Floats:
    """(N, 2, 2) straight pieces of the line at a level: column, row of both ends."""
    corners = np.stack([up_m[:-1, :-1], up_m[:-1, 1:], up_m[1:, 1:], up_m[1:, :-1]])
    known = np.isfinite(corners).all(axis=0)
    with np.errstate(invalid="ignore"):
        case = ((corners > level) * np.array([1, 2, 4, 8])[:, None, None]).sum(axis=0)
    found = []
    for number, joins in _SEGMENTS.items():
        rows, columns = np.nonzero(known & (case == number))
        values = corners[:, rows, columns]
        for ends in joins:
            found.append(
                np.stack([_crossing(values, edge, level, rows, columns) for edge in ends], axis=1)
            )
    # ends that neighbours share must be the same number to be joined
    return np.asarray(np.round(np.concatenate(found), 6), np.float64)


def _crossing(values: Floats, edge: int, level: float, rows: Rows, columns: Rows) -> Floats:
    """(N, 2) where the level crosses an edge of squares whose corners have these values, (4, N)."""
    # edges by the corner that they start from, always left to right and top to bottom, so that both squares agree
    start, end = ((0, 1), (1, 2), (3, 2), (0, 3))[edge]
    share = (level - values[start]) / (values[end] - values[start])
    x = columns + {0: share, 1: 1.0, 2: share, 3: 0.0}[edge]
    y = rows + {0: 0.0, 1: share, 2: 1.0, 3: share}[edge]
    return np.column_stack([np.broadcast_to(x, share.shape), np.broadcast_to(y, share.shape)])
