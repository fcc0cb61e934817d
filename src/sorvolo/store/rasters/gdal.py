"""GDAL behind a locked door: one driver, plain local files, no network, no neighbours of a file; and its half pixel."""

import re
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import rasterio
from rasterio.crs import CRS
from rasterio.errors import CRSError, NotGeoreferencedWarning, RasterioIOError
from rasterio.transform import Affine

from sorvolo.errors import GeometryError, InputError, SettingsError
from sorvolo.geometry.crs import transformer
from sorvolo.geometry.grid import Grid

# a small cache keeps memory flat; no directory listing keeps GDAL from opening neighbours of a user's file; a curl name
# that nothing has keeps /vsicurl/ and its kin from fetching anything
_ENVIRONMENT = {
    "GDAL_CACHEMAX": 64,
    "GDAL_DISABLE_READDIR_ON_OPEN": "EMPTY_DIR",
    "GDAL_PAM_ENABLED": "NO",
    "CPL_VSIL_CURL_ALLOWED_FILENAME": "/none",
    "CPL_VSIL_CURL_ALLOWED_EXTENSIONS": ".none",
    "GDAL_HTTP_MAX_RETRY": 0,
    "GDAL_HTTP_CONNECTTIMEOUT": 1,
}


def quiet_gdal() -> rasterio.Env:
    """The settings under which every file is opened."""
    return rasterio.Env(**_ENVIRONMENT)


@contextmanager
def open_raster(
    path: Path, what: str, drivers: Sequence[str] = ("GTiff",)
) -> Iterator[rasterio.DatasetReader]:
    """Open a user's GeoTIFF, with these drivers alone: a VRT renamed .tif could name any file or address.

    Raises InputError, naming `what` as needed, for anything but a file on the disk, so that none of GDAL's
    virtual paths (/vsicurl/, /vsizip/) and none of rasterio's (https:, zip:) is followed.
    """
    try:
        whole = Path(path).resolve()
        is_file = whole.is_file()
    except (OSError, ValueError, RuntimeError):
        is_file = False
    if not is_file:
        raise InputError(f"no such file: {path}; {what} was needed")
    if str(whole).startswith("/vsi"):
        raise InputError(
            f"{path}: GDAL would take this for one of its virtual files; move it to another folder"
        )
    with quiet_gdal(), _opened(whole, drivers) as source:
        yield source


def transform_on_grid(grid: Grid, column: int, row: int) -> Affine:
    """The transform of a raster whose top-left pixel is this column and row of the grid.

    GDAL counts from a pixel's outer corner, our grids from its centre: half a pixel lies between them.
    """
    outer_m = grid.projected_from_grid(np.array([[column - 0.5, row - 0.5]]))[0]
    return Affine(grid.m_per_px, 0, outer_m[0], 0, -grid.m_per_px, outer_m[1])


def _opened(path: Path, drivers: Sequence[str]) -> rasterio.DatasetReader:
    """The file, by the first of the drivers that can read it. One without a place is refused by who asked for it."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        for driver in drivers[:-1]:
            try:
                return rasterio.open(path, driver=driver, sharing=False)
            except RasterioIOError:
                continue
        return rasterio.open(path, driver=drivers[-1], sharing=False)


def why_no_place(crs: CRS | None) -> str:
    """Why coordinates are no places on Earth, in words: there is no CRS, a local one, as of a building site's plan, or
    one without a known datum; "" where they are."""
    if crs is None:
        return "no coordinate reference system"
    if not (crs.is_geographic or crs.is_projected):
        return "a local coordinate reference system, of no known place"
    try:
        transformer(crs.to_wkt())
    except GeometryError as error:
        return str(error)
    return ""


def crs_of_epsg(code: str) -> CRS:
    """The CRS of a code such as EPSG:32633. Raises SettingsError for all else: GDAL would fetch an address."""
    match = re.fullmatch(r"(?:EPSG|epsg):([1-9][0-9]{0,8})", code)
    if match is None:
        raise SettingsError(f"{code!r} is no EPSG code; give one such as EPSG:32633")
    try:
        return CRS.from_epsg(int(match[1]))
    except CRSError as error:
        raise SettingsError(
            f"unknown coordinate reference system {code!r}; try one as EPSG:32633"
        ) from error
