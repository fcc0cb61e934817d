"""Coarse tiles of a map from the overviews of its GeoTIFF: a pyramid would have to read every tile for them."""

import os
from pathlib import Path

import numpy as np
from rasterio import DatasetReader
from rasterio.enums import Resampling
from rasterio.errors import RasterioError
from rasterio.windows import Window

from sorvolo.errors import SorvoloError
from sorvolo.geometry.arrays import ImageRGBA
from sorvolo.geometry.grid import Grid, TileIndex
from sorvolo.store.rasters.gdal import crs_of_epsg, open_raster, quiet_gdal

_DEEPEST = 9  # beyond it a tile is wider than the file's blocks are aligned


class MapOverview:
    """The GeoTIFF of one state of a map, as it lies on the disk now; once it was replaced it gives nothing any more."""

    def __init__(self, path: Path, grid: Grid) -> None:
        self._path, self._grid = path, grid
        self._mark = _mark(path)

    def tile(self, level: int, index: TileIndex) -> ImageRGBA | None:
        """A tile of a level, (tile_px, tile_px, 4); None where the file cannot give it."""
        if not 0 < level <= _DEEPEST or not self._grid.crs or self._mark is None:
            return None
        try:
            with quiet_gdal(), open_raster(self._path, "the map's GeoTIFF") as source:
                left, top = self._corner(source)
                if left is None or top is None or _mark(self._path) != self._mark:
                    return None
                if max(source.overviews(1), default=1) < 2 ** (level - 1):  # it would be read whole
                    return None
                return self._read(source, level, index, left, top)
        except (
            RasterioError,
            SorvoloError,
            OSError,
        ):  # damaged or taken away: the tiles themselves have it all
            return None

    def _corner(self, source: DatasetReader) -> tuple[int | None, int | None]:
        """Grid pixel of the file's first pixel; None where the file lies on another grid."""
        transform, grid = source.transform, self._grid
        if (
            source.crs != crs_of_epsg(grid.crs)
            or abs(transform.a - grid.m_per_px) > 1e-6 * grid.m_per_px
        ):
            return None, None
        left = (transform.c - grid.origin_m[0]) / grid.m_per_px + 0.5
        top = (grid.origin_m[1] - transform.f) / grid.m_per_px + 0.5
        if max(abs(left - round(left)), abs(top - round(top))) > 0.01:
            return None, None
        return round(left), round(top)

    def _read(
        self, source: DatasetReader, level: int, index: TileIndex, left: int, top: int
    ) -> ImageRGBA:
        size = self._grid.tile_px
        side = size << level
        x0, y0 = index[0] * side, index[1] * side
        low_x, low_y = max(x0, left), max(y0, top)
        high_x, high_y = min(x0 + side, left + source.width), min(y0 + side, top + source.height)
        result = np.zeros((size, size, 4), np.uint8)
        width, height = (high_x - low_x) >> level, (high_y - low_y) >> level
        if width > 0 and height > 0:
            window = Window(low_x - left, low_y - top, high_x - low_x, high_y - low_y)
            how = {"window": window, "resampling": Resampling.average}
            colours = source.read((1, 2, 3), out_shape=(3, height, width), **how)
            alpha = source.dataset_mask(out_shape=(height, width), **how)
            column, row = (low_x - x0) >> level, (low_y - y0) >> level
            result[row : row + height, column : column + width] = np.dstack([*colours, alpha])
        result.setflags(write=False)
        return result


def _mark(path: Path) -> tuple[int, int] | None:
    """What is another once the file was replaced."""
    try:
        about = os.stat(path)
    except OSError:
        return None
    return about.st_ino, about.st_mtime_ns
