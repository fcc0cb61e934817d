"""A map that exists already, as the base of another: its place, its pixels, and any part of it as tiles of a site."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import rasterio
from rasterio.crs import CRS
from rasterio.enums import Resampling
from rasterio.errors import CRSError, RasterioError
from rasterio.transform import Affine
from rasterio.warp import reproject, transform_bounds
from rasterio.windows import Window, from_bounds

from sorvolo.errors import InputError
from sorvolo.geometry.arrays import ImageRGBA, PointsM
from sorvolo.geometry.crs import transformer
from sorvolo.geometry.geodesy import Geodetic, LocalFrame
from sorvolo.geometry.grid import SiteGrid, TileIndex
from sorvolo.store.rasters.geotiff import crs_of_epsg, open_raster, transform_on_grid, why_no_place

_WGS84 = CRS.from_epsg(4326)
_SITE_MAP = "mosaic.tif"
_MOST_PX = 6_000  # longest side of what is read at once


@dataclass(frozen=True)
class BaseMap:
    """A GeoTIFF of 8-bit colours or grey with a place on Earth."""

    path: Path
    middle: Geodetic
    m_per_px: float
    bounds_deg: tuple[float, float, float, float]  # west, south, east, north

    @classmethod
    def open(cls, path: Path) -> "BaseMap":
        """A GeoTIFF, or the map of a site folder. Raises InputError for anything else."""
        path = path / _SITE_MAP if path.is_dir() else path
        try:
            with open_raster(path, "a GeoTIFF, or a site folder with a map,") as source:
                if why := why_no_place(source.crs):
                    raise InputError(
                        f"{path}: its places are not known: {why}; give it one as EPSG:code"
                    )
                if source.count == 2 or set(source.dtypes) != {"uint8"}:
                    raise InputError(
                        f"{path} has {source.count} bands of {'/'.join(sorted(set(source.dtypes)))}; a base map has "
                        "grey, RGB or RGBA of 8 bits: convert it with gdal_translate -ot Byte -scale"
                    )
                if source.transform.e >= 0 or not source.transform.is_rectilinear:
                    raise InputError(
                        f"{path}: its rows do not run from west to east and from north to south: warp it with gdalwarp"
                    )
                to_wgs84 = transformer(source.crs.to_wkt())
                west, south, east, north = to_wgs84.transform_bounds(*source.bounds)
                middle = Geodetic(round((south + north) / 2, 7), round((west + east) / 2, 7))
                return cls(
                    path, middle, _metres_a_pixel(source, middle), (west, south, east, north)
                )
        except (RasterioError, CRSError) as error:
            raise InputError(
                f"{path} is no readable GeoTIFF ({error}); export it as GeoTIFF again"
            ) from error

    @property
    def extent_m(self) -> float:
        """The longer side of its ground."""
        west, south, east, north = self.bounds_deg
        frame = LocalFrame(self.middle)
        return float(np.ptp(frame.ground_from_lonlat([(west, south), (east, north)]), axis=0).max())

    def beside_m(self, places_m: PointsM, frame: LocalFrame) -> float:
        """How far the nearest of places, (N, 2) metres of a site, lies beside the map's bounds; 0 within."""
        west, south, east, north = self.bounds_deg
        corners_m = frame.ground_from_lonlat(
            [(west, south), (east, south), (east, north), (west, north)]
        )
        beside_m = np.maximum(
            np.maximum(corners_m.min(axis=0) - places_m, places_m - corners_m.max(axis=0)), 0.0
        )
        return float(np.linalg.norm(beside_m, axis=1).min())

    def overview(self, site_grid: SiteGrid) -> tuple[ImageRGBA, PointsM]:
        """The whole map in the grid's CRS and pixels, (H, W, 4), and easting, northing of its first pixel's centre."""
        low, high = self._bounds_in(site_grid.grid.crs)
        return self._resampled(site_grid, low, high)

    def tiles(self, site_grid: SiteGrid, outline_m: PointsM) -> dict[TileIndex, ImageRGBA]:
        """The map around places of the site, (N, 2) site metres, as tiles of the grid; none where it shows nothing."""
        places = site_grid.projected_from_site(outline_m)
        own_low, own_high = self._bounds_in(site_grid.grid.crs)
        low, high = (
            np.maximum(places.min(axis=0), own_low),
            np.minimum(places.max(axis=0), own_high),
        )
        if (low >= high).any():
            return {}
        rgba, first_m = self._resampled(site_grid, low, high)
        grid, side = site_grid.grid, site_grid.grid.tile_px
        x, y = np.rint(grid.grid_from_projected(first_m[None])[0]).astype(int)
        left, top = x % side, y % side
        height, width = rgba.shape[:2]
        padded = np.zeros(
            (-(-(height + top) // side) * side, -(-(width + left) // side) * side, 4), np.uint8
        )
        padded[top : top + height, left : left + width] = rgba
        cut = {
            ((x - left + column) // side, (y - top + row) // side): padded[
                row : row + side, column : column + side
            ]
            for row in range(0, padded.shape[0], side)
            for column in range(0, padded.shape[1], side)
        }
        return {index: tile for index, tile in cut.items() if tile[..., 3].any()}

    def _bounds_in(self, crs: str) -> tuple[PointsM, PointsM]:
        west, south, east, north = transform_bounds(_WGS84, crs_of_epsg(crs), *self.bounds_deg)
        return np.array([west, south]), np.array([east, north])

    def _resampled(
        self, site_grid: SiteGrid, low_m: PointsM, high_m: PointsM
    ) -> tuple[ImageRGBA, PointsM]:
        grid = site_grid.grid
        corners = grid.grid_from_projected(np.array([[low_m[0], high_m[1]], [high_m[0], low_m[1]]]))
        (x0, y0), (x1, y1) = np.floor(corners[0]).astype(int), np.ceil(corners[1]).astype(int)
        width, height = int(x1 - x0 + 1), int(y1 - y0 + 1)
        if max(width, height) > _MOST_PX:
            raise InputError(
                f"{self.path}: {width} x {height} pixels of it lie under the flight; give a smaller part"
            )
        first_m = grid.projected_from_grid(np.array([[x0, y0]]))[0]
        target = transform_on_grid(grid, int(x0), int(y0))
        with open_raster(self.path, "a GeoTIFF") as source:
            return _read(
                source, target, width, height, crs_of_epsg(grid.crs), self.m_per_px / grid.m_per_px
            ), first_m


def _read(
    source: rasterio.DatasetReader,
    target: Affine,
    width: int,
    height: int,
    crs: CRS,
    magnified: float,
) -> ImageRGBA:
    """The part of a map under a target raster; thinned first where it has many more pixels."""
    step = max(1, int(1 / max(magnified, 1e-6)))
    ends = target * (0, 0), target * (width, height)
    bounds = transform_bounds(crs, source.crs, ends[0][0], ends[1][1], ends[1][0], ends[0][1])
    window = from_bounds(*bounds, transform=source.transform)
    whole = Window(0, 0, source.width, source.height)
    window = window.round_offsets().round_lengths(op="ceil").intersection(whole)
    shape = max(1, int(window.height) // step), max(1, int(window.width) // step)
    bands = [1, 2, 3] if source.count >= 3 else [1, 1, 1]
    seen = source.dataset_mask(window=window, out_shape=shape)
    rgb = source.read(bands, window=window, out_shape=(3, *shape), resampling=Resampling.average)
    own = source.window_transform(window) * Affine.scale(
        window.width / shape[1], window.height / shape[0]
    )
    result = np.zeros((4, height, width), np.uint8)
    for band, values in enumerate([*rgb, np.where(seen > 0, 255, 0).astype(np.uint8)]):
        reproject(
            values,
            result[band],
            src_transform=own,
            src_crs=source.crs,
            dst_transform=target,
            dst_crs=crs,
            resampling=Resampling.nearest if band == 3 else Resampling.bilinear,
        )
    return np.ascontiguousarray(np.moveaxis(result, 0, 2))


def _metres_a_pixel(source: rasterio.DatasetReader, middle: Geodetic) -> float:
    """On the ground, at its middle."""
    column, row = source.width / 2, source.height / 2
    x, y = zip(
        *(source.transform * each for each in ((column, row), (column + 1, row), (column, row + 1)))
    )
    longitude, latitude = (
        np.radians(each) for each in transformer(source.crs.to_wkt()).transform(x, y)
    )
    east = (longitude - longitude[0]) * np.cos(np.radians(middle.latitude_deg)) * 6378137.0
    north = (latitude - latitude[0]) * 6371000.0
    return float(np.sqrt(abs(east[1] * north[2] - east[2] * north[1])))
