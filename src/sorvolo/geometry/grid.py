"""The endless pixel grid that is laid on a site, cut into square tiles."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from sorvolo.errors import GeometryError
from sorvolo.geometry.arrays import ImageRGBA, Matrix3, PointsM, PointsPx
from sorvolo.geometry.geodesy import Geodetic, LocalFrame, Projection
from sorvolo.geometry.homography import apply_homography

TileIndex: TypeAlias = tuple[int, int]
"""(column, row) of a tile; both may be negative."""


@dataclass(frozen=True)
class Grid:
    """Pixels x east, y south in a projected CRS; the centre of pixel (0, 0) lies at `origin_m` (easting, northing).

    `crs` is "" for a site without any geo-reference: then the site's own axes are the projected ones and
    a "metre" is a unit of unknown size (`docs/frames.md`).
    """

    origin_m: tuple[float, float]
    m_per_px: float
    tile_px: int = 512
    crs: str = ""

    def __post_init__(self) -> None:
        if not (np.isfinite(self.m_per_px) and self.m_per_px > 0):
            raise GeometryError(
                f"the ground sampling distance must be positive, got {self.m_per_px}"
            )
        if self.tile_px < 16:
            raise GeometryError(f"a tile needs at least 16 px, got {self.tile_px}")

    def grid_from_projected(self, points_m: PointsM) -> PointsPx:
        """(N, 2) grid pixels of easting, northing, shape (N, 2)."""
        delta_m = np.asarray(points_m, dtype=np.float64) - np.array(self.origin_m)
        return delta_m * np.array([1.0, -1.0]) / self.m_per_px

    def projected_from_grid(self, points_px: PointsPx) -> PointsM:
        """(N, 2) easting, northing of grid pixels, shape (N, 2)."""
        return np.asarray(points_px) * np.array([1.0, -1.0]) * self.m_per_px + np.array(
            self.origin_m
        )

    def tile_window(self, tile: TileIndex) -> tuple[int, int, int, int]:
        """x0, y0, x1, y1 of a tile in grid pixels, ends exclusive."""
        x0, y0 = tile[0] * self.tile_px, tile[1] * self.tile_px
        return x0, y0, x0 + self.tile_px, y0 + self.tile_px

    def tiles_touched(self, outline_px: PointsPx) -> frozenset[TileIndex]:
        """The tiles under the convex outline, shape (N, 2); those whose square it really meets, not its box only."""
        outline = np.asarray(outline_px, dtype=np.float64)
        low = np.floor((outline.min(axis=0) + 0.5) / self.tile_px).astype(int)
        high = np.floor((outline.max(axis=0) + 0.5) / self.tile_px).astype(int)
        return frozenset(
            (column, row)
            for column in range(low[0], high[0] + 1)
            for row in range(low[1], high[1] + 1)
            if self._meets((column, row), outline)
        )

    def _meets(self, tile: TileIndex, outline: PointsPx) -> bool:
        # separating axes: the box's own two were used to list candidates, the outline's edges remain
        x0, y0, x1, y1 = self.tile_window(tile)
        box = np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]]) - 0.5
        edges = np.roll(outline, -1, axis=0) - outline
        normals = np.column_stack([-edges[:, 1], edges[:, 0]])
        a, b = outline @ normals.T, box @ normals.T
        return bool(np.all((a.max(axis=0) >= b.min(axis=0)) & (b.max(axis=0) >= a.min(axis=0))))


def gather_tiles(
    window: tuple[int, int, int, int], side: int, tile_at: Callable[[TileIndex], ImageRGBA | None]
) -> ImageRGBA:
    """(height, width, 4) a window (x0, y0, x1, y1, ends exclusive) of tiles (side, side, 4); zero where there is none."""
    x0, y0, x1, y1 = window
    result = np.zeros((y1 - y0, x1 - x0, 4), np.uint8)
    for row in range(y0 // side, (y1 - 1) // side + 1):
        for column in range(x0 // side, (x1 - 1) // side + 1):
            tile = tile_at((column, row))
            if tile is None:
                continue
            left, top = max(x0, column * side), max(y0, row * side)
            right, bottom = min(x1, (column + 1) * side), min(y1, (row + 1) * side)
            result[top - y0 : bottom - y0, left - x0 : right - x0] = tile[
                top - row * side : bottom - row * side,
                left - column * side : right - column * side,
            ]
    return result


@dataclass(frozen=True)
class SiteGrid:
    """A grid laid on a site: knows the way from site metres to grid pixels, exactly and locally affine."""

    frame: LocalFrame
    grid: Grid

    @classmethod
    def at(cls, origin: Geodetic, m_per_px: float, crs: str, tile_px: int = 512) -> "SiteGrid":
        """Lay a grid whose pixel (0, 0) is at the origin, rounded to whole pixels of the projected CRS."""
        frame = LocalFrame(origin)
        if crs:
            east_m, north_m = Projection(crs).projected_from_wgs84(
                np.array([origin.latitude_deg]), np.array([origin.longitude_deg])
            )[0]
            corner = (round(east_m / m_per_px) * m_per_px, round(north_m / m_per_px) * m_per_px)
        else:
            corner = (0.0, 0.0)
        return cls(frame, Grid(corner, m_per_px, tile_px, crs))

    def grid_from_site(self, points_m: PointsM) -> PointsPx:
        """(N, 2) grid pixels of site points on the ground, shape (N, 2), through the Earth's true shape."""
        return self.grid.grid_from_projected(self.projected_from_site(points_m))

    def projected_from_site(self, points_m: PointsM) -> PointsM:
        """(N, 2) easting, northing of site points on the ground, shape (N, 2)."""
        points = np.asarray(points_m, dtype=np.float64)
        if not self.grid.crs:
            return points
        latitude_deg, longitude_deg, _ = self.frame.wgs84_from_site(points)
        return Projection(self.grid.crs).projected_from_wgs84(latitude_deg, longitude_deg)

    def tile_centres_m(self, tiles: Iterable[TileIndex]) -> PointsM:
        """(N, 2) the middles of tiles on the ground, site metres, by the affine map around the site's origin."""
        site_from_grid = np.linalg.inv(self.grid_from_site_affine(np.zeros(2), 50.0))
        return apply_homography(site_from_grid, (np.array(sorted(tiles)) + 0.5) * self.grid.tile_px)

    def grid_from_site_affine(self, centre_m: PointsM, reach_m: float) -> Matrix3:
        """(3, 3) affine map from site metres to grid pixels, right around `centre_m`, shape (2,).

        Within a kilometre it departs from `grid_from_site` by less than a hundredth of a millimetre a metre.
        """
        steps = np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]]) * max(reach_m, 1.0)
        px = self.grid_from_site(np.asarray(centre_m) + steps)
        linear = np.column_stack([px[1] - px[2], px[3] - px[4]]) / (2 * max(reach_m, 1.0))
        result = np.eye(3)
        result[:2, :2] = linear
        result[:2, 2] = px[0] - linear @ np.asarray(centre_m)
        return result
