"""A map's tiles at a fraction of their pixels: what is painted while frames still move, and painted once more later."""

from collections.abc import Iterator, MutableMapping

import numpy as np

from sorvolo.geometry.arrays import ImageRGBA
from sorvolo.geometry.grid import Grid, SiteGrid, TileIndex
from sorvolo.mosaic.known_ground import KnownGround

_ENOUGH_PX = 400  # of a picture's longer side, to follow a flight by


def coarseness(longest_px: int) -> int:
    """By how much (1, 2, 4 or 8) pictures of this longer side are made smaller for a map that still moves."""
    return next((step for step in (8, 4, 2) if longest_px // step >= _ENOUGH_PX), 1)


def coarse_grid(site_grid: SiteGrid, step: int) -> SiteGrid:
    """The grid whose pixels are `step` of the site's to a side, with tiles on the same ground."""
    grid = site_grid.grid
    beside_m = (step - 1) / 2 * grid.m_per_px  # the centre of the first pixel lies so far into it
    origin_m = grid.origin_m[0] + beside_m, grid.origin_m[1] - beside_m
    return SiteGrid(site_grid.frame, Grid(origin_m, grid.m_per_px * step, grid.tile_px // step, grid.crs))


class CoarseTiles(MutableMapping[TileIndex, ImageRGBA]):
    """Tiles of a `coarse_grid` over those of the site: what is put in is shown there enlarged.

    Every pixel that a tile of the site showed when it was first asked for stays as it is.
    """

    def __init__(self, tiles: MutableMapping[TileIndex, ImageRGBA], grid: Grid, step: int) -> None:
        self._tiles, self._grid, self._step = tiles, grid, step
        self._known = KnownGround(grid, tiles)

    def __getitem__(self, index: TileIndex) -> ImageRGBA:
        self._known.opaque(*self._grid.tile_window(index))  # before it is changed
        return np.ascontiguousarray(self._tiles[index][:: self._step, :: self._step])

    def __setitem__(self, index: TileIndex, coarse: ImageRGBA) -> None:
        known = self._known.opaque(*self._grid.tile_window(index))
        tile = coarse.repeat(self._step, axis=0).repeat(self._step, axis=1)
        if known.any():
            tile[known] = self._tiles[index][known]
        self._tiles[index] = tile

    def __delitem__(self, index: TileIndex) -> None:
        del self._tiles[index]

    def __contains__(self, index: object) -> bool:
        return index in self._tiles

    def __iter__(self) -> Iterator[TileIndex]:
        return iter(self._tiles)

    def __len__(self) -> int:
        return len(self._tiles)
