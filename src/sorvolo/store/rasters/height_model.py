"""A height model of the ground: a GeoTIFF of heights, asked by place."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import rasterio
import rasterio.shutil
from numpy.typing import NDArray
from pyproj import CRS
from rasterio.enums import Resampling
from rasterio.errors import CRSError, RasterioError
from rasterio.transform import Affine
from rasterio.windows import Window
from scipy.ndimage import map_coordinates

from sorvolo.errors import InputError, NoHeightsError, StoreError
from sorvolo.geometry.arrays import Floats, Floats32, Mask
from sorvolo.geometry.crs import WGS84, transformer, vertical_name
from sorvolo.geometry.grid import Grid
from sorvolo.geometry.units import FOOT_M, SURVEY_FOOT_M
from sorvolo.store.atomic import atomic_path, scratch_folder
from sorvolo.store.rasters.geotiff import (
    crs_of_epsg,
    open_raster,
    transform_on_grid,
    why_no_place,
    writing_raster,
)

_LOWEST_M, _HIGHEST_M = (
    -1_000.0,
    10_000.0,
)  # no ground on Earth lies beyond: a hole that its file does not declare
_UNITS_M = (
    dict.fromkeys(("m", "metre", "metres", "meter", "meters"), 1.0)
    | dict.fromkeys(("ft", "foot", "feet", "international foot"), FOOT_M)
    | dict.fromkeys(("us-ft", "ftus", "us survey foot", "us survey feet", "foot_us"), SURVEY_FOOT_M)
)
_MOST_PX = 4096  # a side that is kept: finer models are averaged


@dataclass(frozen=True, eq=False)
class HeightModel:
    """Heights (H, W), m, NaN where unknown, each that of its pixel's middle; `crs_from_pixels` starts at corners.

    `datum` is what the heights count from, as "EGM96 height" or "ellipsoid"; "" where the file does not say.
    """

    heights_m: Floats
    crs_from_pixels: Affine
    crs: str
    datum: str = ""

    def at(self, longitudes_deg: Floats, latitudes_deg: Floats) -> Floats:
        """(N,) heights at places of WGS84, between the four pixels around; NaN outside and beside unknown ones."""
        x, y = transformer(WGS84, self.crs).transform(longitudes_deg, latitudes_deg)
        back = ~self.crs_from_pixels
        columns, rows = (
            a * np.asarray(x) + b * np.asarray(y) + c for a, b, c in (back[:3], back[3:6])
        )
        known = np.isfinite(columns) & np.isfinite(rows)
        heights_m = np.full(len(known), np.nan)
        places = np.array([rows[known], columns[known]]) - 0.5
        heights_m[known] = map_coordinates(self.heights_m, places, order=1, cval=np.nan)
        return heights_m


def read_height_model(path: Path, bounds_deg: tuple[float, float, float, float]) -> HeightModel:
    """The part of a GeoTIFF of heights within west, south, east, north, degrees of WGS84.

    Only the GTiff driver opens it: a VRT renamed .tif could name any other file. Raises InputError for a file that is
    no GeoTIFF with one band and a place on Earth, and for one of other ground.
    """
    try:
        with open_raster(path, "a GeoTIFF of heights") as source:
            if why := why_no_place(source.crs):
                raise InputError(
                    f"{path}: its places are not known: {why}; give it one as EPSG:code"
                )
            if source.count != 1:
                raise InputError(
                    f"{path} has {source.count} bands; a height model has one, of heights (of `sorvolo heights`: "
                    "terrain.tif)"
                )
            to_m = _metres_in_unit(source, path)
            window = _window(source, bounds_deg)
            if window is None:
                to_wgs84 = transformer(source.crs.to_wkt())
                west, south, east, north = to_wgs84.transform_bounds(*source.bounds)
                raise InputError(
                    f"{path} holds ground from {south:.4f}, {west:.4f} to {north:.4f}, {east:.4f}, and the flight is "
                    f"at {bounds_deg[1]:.4f}, {bounds_deg[0]:.4f}: give the height model of its ground"
                )
            step = math.ceil(max(window.width, window.height) / _MOST_PX)
            shape = math.ceil(window.height / step), math.ceil(window.width / step)
            read = source.read(
                1, window=window, out_shape=shape, masked=True, resampling=Resampling.average
            )
            heights_m = np.where(
                np.ma.getmaskarray(read), np.nan, np.asarray(read.data, np.float64)
            )
            heights_m = (heights_m * source.scales[0] + source.offsets[0]) * to_m
            heights_m[(heights_m < _LOWEST_M) | (heights_m > _HIGHEST_M)] = np.nan
            transform = source.window_transform(window)
            wide, high = window.width / shape[1], window.height / shape[0]
            crs_from_pixels = Affine(
                transform.a * wide,
                transform.b * high,
                transform.c,
                transform.d * wide,
                transform.e * high,
                transform.f,
            )
            crs = source.crs.to_wkt()
            datum = vertical_name(CRS.from_user_input(crs))
            return HeightModel(heights_m, crs_from_pixels, crs, datum)
    except (RasterioError, CRSError) as error:
        raise InputError(
            f"{path} is no readable GeoTIFF ({error}); export it as GeoTIFF again"
        ) from error


def _metres_in_unit(source: rasterio.DatasetReader, path: Path) -> float:
    """Of the heights' unit, by the band or by the vertical part of the CRS; metres where neither names one."""
    named = (source.units[0] or "").strip().lower()
    if named:
        if named not in _UNITS_M:
            raise InputError(
                f"{path} has heights in {named!r}; metres or feet were needed: convert it (gdal_calc)"
            )
        return _UNITS_M[named]
    vertical = [each for each in CRS.from_user_input(source.crs).sub_crs_list if each.is_vertical]
    return float(vertical[0].axis_info[0].unit_conversion_factor) if vertical else 1.0


def _window(
    source: rasterio.DatasetReader, bounds_deg: tuple[float, float, float, float]
) -> Window | None:
    """The whole pixels that the bounds touch; None where there are none."""
    crs_from_wgs84 = transformer(WGS84, source.crs.to_wkt())
    left, bottom, right, top = crs_from_wgs84.transform_bounds(*bounds_deg)
    back = ~source.transform
    x, y = np.array([left, left, right, right]), np.array([bottom, top, bottom, top])
    columns, rows = (a * x + b * y + c for a, b, c in (back[:3], back[3:6]))
    first = max(0, math.floor(columns.min())), max(0, math.floor(rows.min()))
    last = min(source.width, math.ceil(columns.max())), min(source.height, math.ceil(rows.max()))
    if first[0] >= last[0] or first[1] >= last[1]:
        return None
    return Window(first[0], first[1], last[0] - first[0], last[1] - first[1])


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
    with (
        scratch_folder(path.parent) as scratch,
        atomic_path(path) as temporary,
        writing_raster(path),
    ):
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


@dataclass(frozen=True, eq=False)
class PointCloud:
    """Points (N, 3) of easting, northing, height, m, with their sigma (N,), colour (N, 3), and whether they are ground."""

    points_m: Floats
    sigma_m: Floats32
    rgb: NDArray[np.uint8]
    is_ground: Mask


def write_laz(parts: Iterable[PointCloud], grid: Grid, height_reference: str, path: Path) -> None:
    """Write points in a grid's CRS as LAZ (LAS 1.4, point format 7): their CRS as WKT, sigma as a dimension of its own.

    Raises InputError without the extra `laz`, StoreError on a full disk.
    """
    try:
        import laspy
        import lazrs
    except ImportError as error:
        raise InputError(
            f"{path.name}: points are written with an extra: pip install 'sorvolo[laz]'; or use heights.tif"
        ) from error
    header = laspy.LasHeader(version="1.4", point_format=7)
    header.add_extra_dim(laspy.ExtraBytesParams("sigma_m", "float32", "1 sigma of the height, m"))
    wkt = CRS.from_user_input(grid.crs).to_wkt("WKT1_GDAL")  # LAS 1.4 asks for the first form
    header.vlrs.append(laspy.vlrs.known.WktCoordinateSystemVlr(wkt))
    header.vlrs.append(laspy.VLR("LASF_Spec", 3, "", f"heights: {height_reference}".encode()))
    header.global_encoding.wkt = True
    header.generating_software = "sorvolo"
    header.scales, header.offsets = np.full(3, 0.001), np.rint([*grid.origin_m, 0])
    try:
        with atomic_path(path) as temporary, laspy.open(temporary, "w", header=header) as sink:
            for part in parts:
                points = laspy.ScaleAwarePointRecord.zeros(len(part.points_m), header=header)
                points.x, points.y, points.z = part.points_m.T
                points.red, points.green, points.blue = part.rgb.T * np.uint16(257)  # of 16 bits
                points.classification = 1 + part.is_ground  # "unclassified" is 1, ground 2
                points.return_number[:] = points.number_of_returns[:] = 1
                points["sigma_m"] = part.sigma_m
                sink.write_points(points)
    except lazrs.LazrsError as error:
        raise StoreError(f"{path} could not be written ({error}); is the disk full?") from error
