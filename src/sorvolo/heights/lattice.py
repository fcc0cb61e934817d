"""The cells of a height model: a north-up raster laid on a site."""

import itertools
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from sorvolo.errors import GeometryError
from sorvolo.geometry.arrays import Floats, Matrix3, PointsM, frozen
from sorvolo.geometry.grid import SiteGrid
from sorvolo.geometry.homography import apply_homography, shifted

MOST_SIDE = 32_766
"""The most rows or columns of a height model: OpenCV resamples no larger picture."""


_FINE_PX = 3.0
_COARSE_PX = 6.0
_FEW_CELLS = 2e6
_MOST_CELLS = 60e6  # bounds the memory: larger sites get larger cells still
# of the box's longer side; the raster, north up, may be a little longer (`MOST_SIDE`)
_MOST_SIDE = 30_000


@dataclass(frozen=True, eq=False)
class Lattice:
    """`width` x `height` cells of `cell_m`; `site_from_cells` (3, 3) is the affine map of (column, row) to site metres.

    `first` is the column and row of its top-left cell on the endless grid `site_grid` that it was cut from.
    """

    site_from_cells: Matrix3
    width: int
    height: int
    cell_m: float
    first: tuple[int, int] = (0, 0)

    def __post_init__(self) -> None:
        if min(self.width, self.height) < 1 or not self.cell_m > 0:
            raise GeometryError(
                f"a height model needs cells, got {self.width} x {self.height} of {self.cell_m} m"
            )
        if max(self.width, self.height) > MOST_SIDE:
            raise GeometryError(
                f"a height model of {self.width:,} x {self.height:,} cells: at most {MOST_SIDE:,} a side are possible; "
                f"give cells larger than {self.cell_m:.3g} m (--cell)"
            )
        object.__setattr__(self, "site_from_cells", frozen(self.site_from_cells))

    @classmethod
    def over(cls, points_m: PointsM, site_grid: SiteGrid) -> "Lattice":
        """The cells of a grid that cover these site points, (N, 2)."""
        middle = points_m.mean(axis=0)
        reach_m = float(np.abs(points_m - middle).max())
        cells = apply_homography(
            site_grid.grid_from_site_affine(middle, max(reach_m, 1.0)), points_m
        )
        low, high = np.floor(cells.min(axis=0)).astype(int), np.ceil(cells.max(axis=0)).astype(int)
        return cls.at(
            site_grid,
            (int(low[0]), int(low[1])),
            int(high[0] - low[0]) + 1,
            int(high[1] - low[1]) + 1,
        )

    @classmethod
    def at(cls, site_grid: SiteGrid, first: tuple[int, int], width: int, height: int) -> "Lattice":
        """The cells of a grid from the column and row `first` on."""
        grid = site_grid.grid
        middle_px = np.array([[first[0] + (width - 1) / 2, first[1] + (height - 1) / 2]])
        middle_m = apply_homography(
            np.linalg.inv(site_grid.grid_from_site_affine(np.zeros(2), 50.0)), middle_px
        )[0]
        reach_m = max(width, height) / 2 * grid.m_per_px
        grid_from_site = site_grid.grid_from_site_affine(middle_m, max(reach_m, 1.0))
        return cls(
            np.linalg.inv(grid_from_site) @ shifted(*first), width, height, grid.m_per_px, first
        )

    @staticmethod
    def cell_for(points_m: PointsM, pixel_m: float) -> float:
        """The cells' side over the box of these points: fine on small sites, coarser on larger ones."""
        sides_m = points_m.max(axis=0) - points_m.min(axis=0)
        side_m = float(np.sqrt(np.prod(sides_m)))
        few_m, most_m = side_m / np.sqrt(_FEW_CELLS), side_m / np.sqrt(_MOST_CELLS)
        longest_m = float(sides_m.max()) / _MOST_SIDE
        wanted_m = np.clip(few_m, _FINE_PX * pixel_m, _COARSE_PX * pixel_m)
        return float(f"{max(wanted_m, most_m, longest_m):.3g}")

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, columns)."""
        return self.height, self.width

    def window(self, x0: int, y0: int, x1: int, y1: int) -> "Lattice":
        """The cells of a window, ends exclusive; it may reach beyond."""
        shift = shifted(x0, y0)
        return replace(
            self,
            site_from_cells=self.site_from_cells @ shift,
            width=x1 - x0,
            height=y1 - y0,
            first=(self.first[0] + x0, self.first[1] + y0),
        )

    def coarser(self, factor: int) -> "Lattice":
        """Cells `factor` times as large over the same ground."""
        scale = np.array(
            [[factor, 0, (factor - 1) / 2], [0, factor, (factor - 1) / 2], [0, 0, 1.0]]
        )
        return replace(
            self,
            site_from_cells=self.site_from_cells @ scale,
            width=-(-self.width // factor),
            height=-(-self.height // factor),
            cell_m=self.cell_m * factor,
            first=(0, 0),
        )

    def windows(self, side: int) -> Iterator[tuple[int, int, int, int]]:
        """Windows of at most `side` cells that share the cells evenly, row by row: x0, y0, x1, y1, ends exclusive."""
        rows = np.linspace(0, self.height, -(-self.height // side) + 1).astype(int)
        columns = np.linspace(0, self.width, -(-self.width // side) + 1).astype(int)
        for y0, y1 in itertools.pairwise(rows):
            for x0, x1 in itertools.pairwise(columns):
                yield int(x0), int(y0), int(x1), int(y1)

    def points_m(self) -> PointsM:
        """(H, W, 2) the cells' middles, site metres."""
        x, y = np.meshgrid(np.arange(self.width), np.arange(self.height))
        return apply_homography(
            self.site_from_cells, np.column_stack([x.ravel(), y.ravel()])
        ).reshape(*x.shape, 2)

    def cells_from_site(self, points_m: PointsM) -> Floats:
        """(N, 2) column, row of site points, (N, 2)."""
        return apply_homography(np.linalg.inv(self.site_from_cells), points_m)
