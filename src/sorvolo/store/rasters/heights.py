"""Height models out and in: float32 bands in metres as a Cloud Optimized GeoTIFF, NaN where nothing is known."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import rasterio
import rasterio.shutil
from rasterio.errors import RasterioError

from sorvolo.errors import NoHeightsError, StoreError
from sorvolo.geometry.arrays import Floats32
from sorvolo.geometry.grid import Grid
from sorvolo.store.atomic import atomic_path, scratch_folder
from sorvolo.store.rasters.gdal import crs_of_epsg, open_raster, quiet_gdal, transform_on_grid

_PLAIN = {
    "driver": "GTiff",
    "tiled": True,
    "compress": "zstd",
    "zstd_level": 1,
    "bigtiff": "IF_SAFER",
}
_COG = {
    "driver": "COG",
    "blocksize": 512,
    "compress": "DEFLATE",
    "level": 1,
    "predictor": "YES",
    "bigtiff": "IF_SAFER",
    "overview_resampling": "AVERAGE",
}


@dataclass(frozen=True, eq=False)
class HeightBands:
    """Bands (H, W) float32 of a raster whose top-left cell is column and row `first` of the grid."""

    bands: tuple[Floats32, ...]
    first: tuple[int, int]


def write_height_cog(
    bands: Sequence[Floats32], names: Sequence[str], first: tuple[int, int], grid: Grid, path: Path
) -> None:
    """Write bands of metres, (H, W) float32, NaN unknown, each with its name, in place of what was at `path`.

    Raises StoreError on a full disk or for a file that reads back differently.
    """
    height, width = bands[0].shape
    profile = _PLAIN | {
        "width": width,
        "height": height,
        "count": len(bands),
        "dtype": "float32",
        "nodata": float("nan"),
        "blockxsize": 512,
        "blockysize": 512,
        "crs": crs_of_epsg(grid.crs) if grid.crs else None,
        "transform": transform_on_grid(grid, *first),
    }
    with scratch_folder(path.parent) as scratch, atomic_path(path) as temporary, quiet_gdal():
        try:
            with rasterio.open(scratch / "plain.tif", "w", **profile) as sink:
                for number, (band, name) in enumerate(zip(bands, names), start=1):
                    sink.write(band.astype(np.float32, copy=False), number)
                    sink.set_band_description(number, name)
                    sink.set_band_unit(number, "metre")
            with rasterio.open(scratch / "plain.tif") as source:
                rasterio.shutil.copy(source, temporary, **_COG)
            with rasterio.open(temporary, driver="GTiff") as written:
                whole = np.array_equal(
                    written.read(1), bands[0].astype(np.float32, copy=False), equal_nan=True
                )
        except RasterioError as error:
            raise StoreError(f"{path} could not be written ({error}); is the disk full?") from error
        if not whole:
            raise StoreError(f"{path} reads back differently; is the disk full?")


def read_height_cog(path: Path, grid: Grid) -> HeightBands:
    """The bands of a file that `write_height_cog` wrote on this grid. Raises InputError for any other."""
    try:
        with open_raster(path, "a height model of `sorvolo heights`") as source:
            if (
                abs(source.transform.a - grid.m_per_px) > 1e-9 * grid.m_per_px
                or source.dtypes[0] != "float32"
            ):
                raise NoHeightsError(
                    f"{path} is no height model of this site; run sorvolo heights again"
                )
            corner = np.array([[source.transform.c, source.transform.f]])
            column, row = grid.grid_from_projected(corner)[0] + 0.5
            return HeightBands(tuple(source.read()), (round(column), round(row)))
    except RasterioError as error:
        raise NoHeightsError(
            f"{path} is no readable GeoTIFF ({error}); run sorvolo heights again"
        ) from error
