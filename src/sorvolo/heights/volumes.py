"""Volumes: what was dug and heaped between two dates, and what stands above the ground around it."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from shapely import line_merge, linestrings, multilinestrings

from sorvolo.errors import InputError
from sorvolo.geometry.arrays import Floats, Mask, PointsM, Rows
from sorvolo.geometry.homography import apply_homography
from sorvolo.geometry.polygons import polygon_area
from sorvolo.geometry.summary import SIGMA_PER_MEDIAN_DEVIATION
from sorvolo.heights.field import HeightField
from sorvolo.heights.terrain import filled
from sorvolo.survey.findings import HeightChange

Polygons: TypeAlias = Sequence[Sequence[PointsM]]


_ROUNDS = 6  # of a robust fit
_CLIP_SIGMAS = 3.0  # of the spread: what changed outside the area does not tie
_BLOCK_M = 5.0  # errors of a height model hold on for about as long
_LEAST_STABLE = 500  # cells
# of the area outside of the height model: an area drawn elsewhere, not a hole; by choice
_BEYOND = 0.1


_LEAST_KNOWN = 0.5  # of an area


@dataclass(frozen=True, eq=False)
class Tie:
    """How a later height model lies on an earlier one where nothing changed.

    `shift_m` (3,) is to be added to the later one's places, east, north, up; `sigma_m` of its height on the area;
    `spread_m` of the difference that is left, over `cells` cells.
    """

    shift_m: Floats
    sigma_m: float
    spread_m: float
    cells: int


@dataclass(frozen=True)
class Volume:
    """`cut_m3` was taken away, `fill_m3` came; `sigma_m3` of their difference.

    Holes in the area, and what of it lies beyond the heights, count as unchanged: `known_share` of it is known.
    """

    cut_m3: float
    fill_m3: float
    sigma_m3: float
    area_m2: float
    known_share: float

    @property
    def net_m3(self) -> float:
        """What came less what was taken away."""
        return self.fill_m3 - self.cut_m3


def tie(
    earlier: HeightField,
    later: HeightField,
    stable: Mask,
) -> Tie:
    """How `later` is to be moved onto `earlier`, by the cells of `earlier` that are `stable`, (H, W).

    Nuth and Kaab 2011: a shift east or north shows as a difference in height along the slope. Raises InputError where
    the two share too little stable ground.
    """
    shift_m = np.zeros(3)
    down, east = (
        np.gradient(earlier.up_m.astype(np.float64), earlier.lattice.cell_m, axis=axis)
        for axis in (0, 1)
    )
    north = -down
    spread, sigma, count = np.inf, np.inf, 0
    for _ in range(_ROUNDS):
        moved = later.on(earlier.lattice, shift_m[:2])
        off = earlier.up_m - (moved.up_m + shift_m[2])
        usable = (
            stable
            & np.isfinite(off)
            & np.isfinite(east)
            & np.isfinite(north)
            & (np.hypot(east, north) < 1.0)
        )
        if usable.sum() < _LEAST_STABLE:
            raise InputError(
                f"the two flights share {int(usable.sum())} cells of ground outside the area, "
                f"{_LEAST_STABLE} are needed to tie them; give a smaller area, or flights that reach beyond it"
            )
        middle = float(np.median(off[usable]))
        spread = max(
            SIGMA_PER_MEDIAN_DEVIATION * float(np.median(np.abs(off[usable] - middle))), 1e-4
        )
        usable &= np.abs(off - middle) < _CLIP_SIGMAS * spread
        step = _step(off[usable], east[usable], north[usable])
        shift_m += step
        sigma = _offset_sigma(off - step[2], usable, earlier.lattice.cell_m)
        count = int(usable.sum())
        if np.abs(step).max() < 1e-3:
            break
    return Tie(shift_m, sigma, spread, count)


def between(
    earlier: HeightField,
    later: HeightField,
    polygons: Polygons,
    tied: Tie,
) -> Volume:
    """Cut and fill within polygons of rings, site metres. Raises InputError where most of them has no heights."""
    moved = later.on(earlier.lattice, tied.shift_m[:2])
    rise = np.asarray(moved.up_m + tied.shift_m[2] - earlier.up_m, np.float32)
    sigma = np.asarray(np.hypot(earlier.sigma_m, moved.sigma_m), np.float32)
    risen = HeightField(earlier.lattice, rise, sigma)
    return _added_up(risen, risen.inside(polygons), polygons, tied.sigma_m)


def height_changes(
    earlier: HeightField,
    later: HeightField,
    outlines_m: Sequence[PointsM],
    changed_m: Sequence[PointsM],
) -> list[HeightChange | None]:
    """How much higher the ground within each outline, (N, 2) site metres, lies on the mean than before.

    The later heights are tied to the earlier ones outside of `changed_m`, outlines too. None where less than half of
    an outline has heights on both dates; for all of them where the two share too little unchanged ground.
    """
    try:
        tied = tie(earlier, later, ~earlier.inside([[each] for each in changed_m]))
    except InputError:
        return [None] * len(outlines_m)
    return [_height_change(earlier, later, [[each]], tied) for each in outlines_m]


def _height_change(
    earlier: HeightField,
    later: HeightField,
    polygons: Polygons,
    tied: Tie,
) -> HeightChange | None:
    try:
        volume = between(earlier, later, polygons, tied)
    except InputError:
        return None
    known_m2 = volume.area_m2 * volume.known_share
    return HeightChange(volume.net_m3 / known_m2, volume.sigma_m3 / known_m2)


def above_rim(surface: HeightField, polygons: Polygons) -> Volume:
    """What stands above (fill) and below (cut) the ground that goes on from around polygons of rings, site metres."""
    inside = surface.inside(polygons)
    around = np.isfinite(surface.up_m) & ~inside
    if not around.any():
        raise InputError(
            "no heights around the area to measure from; give a smaller area, or two flights"
        )
    base = filled(surface.up_m, around)
    around = np.isfinite(surface.sigma_m) & ~inside
    rim = float(np.median(surface.sigma_m[around]))
    risen = HeightField(surface.lattice, surface.up_m - base, surface.sigma_m)
    return _added_up(risen, inside, polygons, rim)


def _added_up(risen: HeightField, inside: Mask, polygons: Polygons, common_m: float) -> Volume:
    rise, sigma, cell_m = risen.up_m, risen.sigma_m, risen.lattice.cell_m
    known, cell_m2 = inside & np.isfinite(rise) & np.isfinite(sigma), cell_m**2
    area_m2 = max(sum(polygon_area(each) for each in polygons), float(inside.sum()) * cell_m2)
    share = float(known.sum()) * cell_m2 / area_m2 if area_m2 > 0 else 0.0
    if share < _LEAST_KNOWN:
        beyond = 1 - float(inside.sum()) * cell_m2 / area_m2 if area_m2 > 0 else 0.0
        advice = "fly it with more overlap"
        if beyond > _BEYOND:
            advice = f"{beyond:.0%} of it is beyond the flight's heights: draw it on flown ground (check its CRS)"
        raise InputError(
            f"only {share:.0%} of the area has heights, {_LEAST_KNOWN:.0%} are needed; {advice}"
        )
    alike = max(1.0, (_BLOCK_M / cell_m) ** 2)  # cells whose errors are one
    scatter = float(
        np.sqrt((sigma[known].astype(np.float64) ** 2).sum() * min(alike, float(known.sum())))
    )
    return Volume(
        cut_m3=float(-np.minimum(rise[known], 0).sum(dtype=np.float64) * cell_m2),
        fill_m3=float(np.maximum(rise[known], 0).sum(dtype=np.float64) * cell_m2),
        sigma_m3=cell_m2 * float(np.hypot(scatter, common_m * known.sum())),
        area_m2=area_m2,
        known_share=share,
    )


def _step(off: Floats, east: Floats, north: Floats) -> Floats:
    """(3,) the shift that explains the differences; along east and north only as far as slopes show it."""
    columns = np.column_stack([-east, -north, np.ones_like(off)])
    normal = columns.T @ columns
    # flat ground does not show a shift along it: a prior of 1 m against differences of 0.1 m
    normal[[0, 1], [0, 1]] += 0.01
    return np.asarray(np.linalg.solve(normal, columns.T @ off), np.float64)


def _offset_sigma(off: Floats, usable: Mask, cell_m: float) -> float:
    """One sigma of the height of the tie: blocks of cells whose errors are alike count once."""
    side = max(1, round(_BLOCK_M / cell_m))
    rows, columns = np.nonzero(usable)
    block = (rows // side) * (usable.shape[1] // side + 1) + columns // side
    _, at, count = np.unique(block, return_inverse=True, return_counts=True)
    means = np.bincount(at, off[usable])[count >= 4] / count[count >= 4]
    if len(means) < 2:
        return float(np.std(off[usable]))
    return float(means.std(ddof=1) / np.sqrt(len(means)))


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
