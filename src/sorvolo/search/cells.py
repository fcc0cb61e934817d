"""The cells of ground for which a probability of detection is given: a coarse grid north up over what was flown."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_fill_holes
from scipy.spatial import KDTree

from sorvolo.geometry.arrays import Floats, Mask, PointsM, PointsPx, frozen
from sorvolo.geometry.grid import SiteGrid
from sorvolo.geometry.homography import apply_homography
from sorvolo.geometry.polygons import points_inside
from sorvolo.survey.flight import Site

_Number = TypeVar("_Number", np.uint8, np.float64)


_MOST = 40_000  # cells, which bounds its time
_LEAST_M = 1.0  # a cell's side


@dataclass(frozen=True, eq=False)
class Cells:
    """`rows` x `columns` cells of the grid, the first at grid pixel (`left`, `top`); counted row by row.

    A pixel of `site_grid` is a cell. `wanted` (rows * columns,) marks the cells within the area that is to be searched.
    """

    site_grid: SiteGrid
    left: int
    top: int
    columns: int
    rows: int
    wanted: Mask

    def __post_init__(self) -> None:
        object.__setattr__(self, "wanted", frozen(self.wanted, np.bool_))

    def __len__(self) -> int:
        return self.rows * self.columns

    @property
    def cell_m(self) -> float:
        """The side of a cell."""
        return self.site_grid.grid.m_per_px

    @cached_property
    def centres_m(self) -> PointsM:
        """(N, 2) the cells' middles, site metres."""
        return _centres_m(self.site_grid, self.left, self.top, self.columns, self.rows)

    def as_grid(self, values: NDArray[_Number]) -> NDArray[_Number]:
        """(N,) values laid out as (rows, columns), north up."""
        return values.reshape(self.rows, self.columns)

    def wanted_from_m(self, places_m: Sequence[Floats]) -> float:
        """How far the wanted ground is from the nearest of places, (2,) each, m; 0 where nothing is wanted."""
        wanted_m = self.centres_m[self.wanted]
        return float(KDTree(np.array(places_m)).query(wanted_m)[0].min()) if len(wanted_m) else 0.0

    def rows_at(self, places_m: PointsM) -> NDArray[np.intp]:
        """(N,) the numbers of the cells in which places (N, 2) lie, site metres; -1 beyond all cells."""
        column, row = (
            np.floor(self.site_grid.grid_from_site(places_m) + 0.5).astype(int)
            - (self.left, self.top)
        ).T
        inside = (column >= 0) & (row >= 0) & (column < self.columns) & (row < self.rows)
        return np.where(inside, row * self.columns + column, -1)

    def outer_corner_m(self) -> tuple[float, float]:
        """Easting and northing of the grid's north-west corner, in the grid's own projection."""
        corner = self.site_grid.grid.projected_from_grid(
            np.array([[self.left - 0.5, self.top - 0.5]])
        )[0]
        return float(corner[0]), float(corner[1])


def cell_side_m(outlines_m: Sequence[PointsM]) -> float:
    """The side of cells so that not too many cover these outlines: 1, 2, 5, 10 ... metres."""
    points = np.concatenate([np.asarray(each) for each in outlines_m])
    wide_m = float(np.prod(np.maximum(np.ptp(points, axis=0), 1.0)))
    return round_side_m(max(_LEAST_M, (wide_m / _MOST) ** 0.5))


def round_side_m(least_m: float) -> float:
    """The least of 1, 2, 5, 10 ... metres, or of their tenths, that is no less."""
    power = 10.0 ** np.floor(np.log10(least_m))
    return float(next(step * power for step in (1, 2, 5, 10) if step * power >= least_m - 1e-9))


def cells_of(
    outlines_m: Sequence[PointsM], site: Site, area_m: Sequence[Sequence[PointsM]] | None
) -> Cells:
    """`cells_over` of a site, of a side that bounds their number."""
    side_m = cell_side_m(_rings_to_cover(outlines_m, area_m))
    return cells_over(outlines_m, SiteGrid.at(site.origin, side_m, site.crs), area_m)


def cells_over(
    outlines_m: Sequence[PointsM], site_grid: SiteGrid, area_m: Sequence[Sequence[PointsM]] | None
) -> Cells:
    """Cells over frames' outlines, (4, 2) site metres each, and over the area (polygons of rings) to be searched.

    At least one cell of the area is wanted; where the frames are elsewhere there are cells over the area alone.
    Without an area, what is wanted is what the frames show and the gaps that they enclose.
    """
    corners_px = site_grid.grid_from_site(np.concatenate(_rings_to_cover(outlines_m, area_m)))
    left, top = (int(each) for each in np.floor(corners_px.min(axis=0)))
    right, bottom = (int(each) + 1 for each in np.ceil(corners_px.max(axis=0)))
    columns, rows = right - left, bottom - top
    centres_m = _centres_m(site_grid, left, top, columns, rows)
    if area_m is None:
        wanted = _with_enclosed(
            _inside_any([[each] for each in outlines_m], centres_m).reshape(rows, columns)
        ).ravel()
    else:
        wanted = _inside_any(area_m, centres_m)
        if not wanted.any():  # narrower than a cell
            for rings in area_m:
                for ring_m in rings:
                    x, y = (
                        np.floor(_along(site_grid.grid_from_site(np.asarray(ring_m))) + 0.5)
                        .astype(int)
                        .T
                    )
                    wanted[(y - top) * columns + x - left] = True
    return Cells(site_grid, left, top, columns, rows, wanted)


def _rings_to_cover(
    outlines_m: Sequence[PointsM], area_m: Sequence[Sequence[PointsM]] | None
) -> list[PointsM]:
    """What cells have to cover: frames' outlines and the area's rings, or these alone where both are far apart."""
    own = [np.asarray(each) for each in outlines_m]
    wanted = [np.asarray(ring) for rings in area_m or () for ring in rings]
    if area_m is None:
        return own
    shown, asked = np.concatenate(own), np.concatenate(wanted)
    apart_m = np.maximum(
        shown.min(axis=0) - asked.max(axis=0), asked.min(axis=0) - shown.max(axis=0)
    )
    return (
        wanted if (apart_m > np.ptp(asked, axis=0) + np.ptp(shown, axis=0)).any() else own + wanted
    )


def _along(ring_px: PointsPx) -> PointsPx:
    """(M, 2) points along a ring, (N, 2), at most half a pixel apart."""
    ends = np.roll(ring_px, -1, axis=0)
    counts = np.ceil(2 * np.linalg.norm(ends - ring_px, axis=1)).astype(int) + 1
    return np.concatenate([np.linspace(*each) for each in zip(ring_px, ends, counts)])


def _centres_m(site_grid: SiteGrid, left: int, top: int, columns: int, rows: int) -> PointsM:
    x, y = np.meshgrid(np.arange(left, left + columns), np.arange(top, top + rows))
    site_from_grid = np.linalg.inv(site_grid.grid_from_site_affine(np.zeros(2), 50.0))
    return apply_homography(
        site_from_grid, np.column_stack([x.ravel(), y.ravel()]).astype(np.float64)
    )


def _inside_any(polygons: Sequence[Sequence[PointsM]], points: PointsM) -> Mask:
    inside = np.zeros(len(points), bool)
    for rings in polygons:
        inside |= points_inside(rings, points)
    return inside


def _with_enclosed(seen: Mask) -> Mask:
    """The mask with its holes filled: what no way of unseen cells joins with the outside."""
    return np.asarray(binary_fill_holes(seen), bool)
