"""A map's tiles at a fraction of their pixels: what is painted while frames still move, and painted once more later."""

from collections import OrderedDict
from collections.abc import Iterator, MutableMapping

import numpy as np

from sorvolo.geometry.arrays import ImageRGBA, Mask
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
    return SiteGrid(
        site_grid.frame, Grid(origin_m, grid.m_per_px * step, grid.tile_px // step, grid.crs)
    )


class CoarseTiles(MutableMapping[TileIndex, ImageRGBA]):
    """Tiles of a `coarse_grid` over those of the site; `save` shows there, enlarged, what was put in.

    Every pixel that a tile of the site showed when it was first asked for stays as it is. Up to `most_bytes` stay in
    memory as they are here, so that a tile painted again and again is enlarged once for all that `save` is called.
    """

    def __init__(
        self,
        tiles: MutableMapping[TileIndex, ImageRGBA],
        grid: Grid,
        step: int,
        most_bytes: int = 16 << 20,
    ) -> None:
        self._tiles, self._grid, self._step = tiles, grid, step
        self._known = KnownGround(grid, tiles)
        self._near: OrderedDict[TileIndex, ImageRGBA] = OrderedDict()
        self._unsaved: set[TileIndex] = set()
        self._most = max(1, most_bytes // (4 * (grid.tile_px // step) ** 2))

    def __getitem__(self, index: TileIndex) -> ImageRGBA:
        if index not in self._near:
            self._opaque(index)
            self._keep(
                index, np.ascontiguousarray(self._tiles[index][:: self._step, :: self._step])
            )
        self._near.move_to_end(index)
        return self._near[index]

    def __setitem__(self, index: TileIndex, coarse: ImageRGBA) -> None:
        self._unsaved.add(index)
        self._keep(index, coarse)

    def __delitem__(self, index: TileIndex) -> None:
        if self._near.pop(index, None) is None or index in self._tiles:
            del self._tiles[index]
        self._unsaved.discard(index)

    def __contains__(self, index: object) -> bool:
        return index in self._near or index in self._tiles

    def __iter__(self) -> Iterator[TileIndex]:
        return iter(self._near.keys() | set(self._tiles))

    def __len__(self) -> int:
        return len(self._near.keys() | set(self._tiles))

    def save(self) -> None:
        """Put into the site's tiles what changed since the last call."""
        for index in sorted(self._unsaved):
            self._save(index)

    def release(self) -> None:
        """Forget what is in memory."""
        self._near.clear()
        self._unsaved.clear()

    def _keep(self, index: TileIndex, coarse: ImageRGBA) -> None:
        self._near[index] = coarse
        self._near.move_to_end(index)
        while len(self._near) > self._most:
            oldest = next(iter(self._near))
            if oldest in self._unsaved:
                self._save(oldest)
            del self._near[oldest]

    def _save(self, index: TileIndex) -> None:
        known = self._opaque(index)
        tile = self._near[index].repeat(self._step, axis=0).repeat(self._step, axis=1)
        if known.any():
            tile[known] = self._tiles[index][known]
        self._tiles[index] = tile
        self._unsaved.discard(index)

    def _opaque(self, index: TileIndex) -> Mask:
        """What the site's tile showed before it was first changed."""
        return self._known.opaque(*self._grid.tile_window(index))
