"""The files of a measured search: probabilities as GeoTIFF, classes and holes as GeoJSON, a picture over the map."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
import rasterio.features
from numpy.typing import NDArray
from rasterio.transform import Affine

from sorvolo.geometry.arrays import Floats, ImageRGBA, PointsM
from sorvolo.geometry.geodesy import Projection
from sorvolo.geometry.grid import SiteGrid
from sorvolo.geometry.polygons import swollen
from sorvolo.store.atomic import atomic_path
from sorvolo.store.exports.map_pictures import Picture, with_room
from sorvolo.store.exports.places import longitude_latitude, near_longitudes
from sorvolo.store.exports.plain import feature
from sorvolo.store.rasters.geotiff import crs_of_epsg, writing_raster
from sorvolo.survey.flight import Site

PICTURE_PX = 1200
"""The longer side of a picture, at most."""

_COLOURS = np.array(
    [
        [196, 48, 43],
        [232, 126, 60],
        [243, 205, 90],
        [150, 200, 105],
        [26, 130, 92],
    ],
    np.float64,
)  # of the classes of probability, from the lowest
_HOLE = np.array([70.0, 70, 78])
_PAPER = (255, 255, 255)
_STRENGTH = 0.55  # opacity of the colours over the map


@dataclass(frozen=True)
class CellGrid:
    """How a search's cells lie on the Earth: (rows, columns), north up from `corner_m` (easting, northing) of `crs`."""

    corner_m: tuple[float, float]
    cell_m: float
    crs: str
    reference_deg: float  # longitude near which longitudes are given

    @property
    def transform(self) -> Affine:
        """From columns and rows to easting and northing."""
        return Affine(self.cell_m, 0, self.corner_m[0], 0, -self.cell_m, self.corner_m[1])


@dataclass(frozen=True, eq=False)
class Region:
    """A piece of ground of one number: its rings in longitude and latitude, outline first, and its area."""

    number: int
    rings_lonlat: tuple[Floats, ...]
    area_m2: float


def write_pod_tif(path: Path, bands: Mapping[str, Floats], grid: CellGrid) -> None:
    """Write named bands, (rows, columns) each, as a float32 GeoTIFF; NaN, where nothing was seen, is its nodata."""
    rows, columns = next(iter(bands.values())).shape
    profile = {
        "driver": "GTiff",
        "width": columns,
        "height": rows,
        "count": len(bands),
        "dtype": "float32",
        "nodata": float("nan"),
        "crs": crs_of_epsg(grid.crs),
        "transform": grid.transform,
        "compress": "deflate",
        "predictor": 3,
        "tiled": True,
        "blockxsize": 256,
        "blockysize": 256,
    }
    with (
        atomic_path(path) as temporary,
        writing_raster(path),
        rasterio.open(temporary, "w", **profile) as file,
    ):
        for number, (name, values) in enumerate(bands.items(), start=1):
            file.write(values.astype(np.float32), number)
            file.set_band_description(number, name)
        file.update_tags(sorvolo="probability of detection; docs/search.md")


def regions_of(numbers: NDArray[np.uint8], grid: CellGrid) -> list[Region]:
    """The connected pieces, along edges, of each number above 0 in (rows, columns), the largest first."""
    found = rasterio.features.shapes(
        numbers, mask=numbers > 0, connectivity=4, transform=grid.transform
    )
    regions = []
    for shape, number in found:
        rings_m = [np.array(ring, np.float64)[:-1] for ring in shape["coordinates"]]
        areas = []
        for ring in rings_m:
            x, y = (ring - ring[0]).T
            areas.append(0.5 * abs(float(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1)))))
        regions.append(
            Region(
                int(number),
                tuple(_lonlat(ring, grid) for ring in rings_m),
                areas[0] - sum(areas[1:]),
            )
        )
    return sorted(regions, key=lambda each: -each.area_m2)


def swollen_polygons(
    regions: Sequence[Region], grid: CellGrid, by_m: float
) -> list[tuple[Floats, ...]]:
    """Polygons, rings of longitude and latitude, of everything within `by_m` of the regions; what then meets is one."""
    projection = Projection(grid.crs)
    polygons_m = [
        [projection.projected_from_wgs84(ring[:, 1], ring[:, 0]) for ring in each.rings_lonlat]
        for each in regions
    ]
    return [tuple(_lonlat(ring, grid) for ring in rings) for rings in swollen(polygons_m, by_m)]


def region_features(
    regions: Sequence[Region], properties: Sequence[Mapping[str, Any]]
) -> list[dict[str, Any]]:
    """The regions as GeoJSON features with these properties each, their area added."""
    features = []
    for region, own in zip(regions, properties, strict=True):
        rings = [np.round([*ring, ring[0]], 9).tolist() for ring in region.rings_lonlat]
        features.append(
            feature(
                {"type": "Polygon", "coordinates": rings},
                {**own, "area_m2": round(region.area_m2, 1)},
            )
        )
    return features


def point_features(
    places_m: Sequence[Floats], site: Site, properties: Sequence[Mapping[str, Any]]
) -> list[dict[str, Any]]:
    """Places, (2,) site metres each, as GeoJSON features with these properties each."""
    longitudes, latitudes = longitude_latitude(np.reshape(places_m, (-1, 2)), site)
    places = np.round(np.column_stack([longitudes, latitudes]), 9).tolist()
    return [
        feature({"type": "Point", "coordinates": place}, dict(own))
        for place, own in zip(places, properties, strict=True)
    ]


def pod_picture(
    shown: Picture,
    site_grid: SiteGrid,
    classes: NDArray[np.uint8],
    is_hole: NDArray[np.bool_],
    grid: CellGrid,
) -> ImageRGBA:
    """The map with the classes of probability, (rows, columns) from 1, laid over it, and holes grey.

    It has room for all of them, beyond the map too; where nothing was mapped there is paper under the colours.
    """
    shown = _with_all(shown, site_grid, (classes > 0) | is_hole, grid)
    height, width = shown.rgba.shape[:2]
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    on_grid = (
        np.column_stack([x.ravel(), y.ravel()]) * shown.step_px + np.array(shown.corner_px) - 0.5
    )
    easting, northing = site_grid.grid.projected_from_grid(on_grid).T
    columns = np.floor((easting - grid.corner_m[0]) / grid.cell_m).astype(int)
    rows = np.floor((grid.corner_m[1] - northing) / grid.cell_m).astype(int)
    inside = (columns >= 0) & (rows >= 0) & (columns < classes.shape[1]) & (rows < classes.shape[0])
    numbers, holes = np.zeros(len(columns), np.uint8), np.zeros(len(columns), bool)
    numbers[inside], holes[inside] = (
        classes[rows[inside], columns[inside]],
        is_hole[rows[inside], columns[inside]],
    )
    colours = np.where((numbers > 0)[:, None], _COLOURS[np.maximum(numbers, 1) - 1], _HOLE)
    share = np.where((numbers > 0) | holes, _STRENGTH, 0.0).reshape(height, width, 1)
    rgba = np.where(shown.rgba[..., 3:] > 0, shown.rgba, [*_PAPER, 0]).astype(np.float64)
    rgba[..., :3] += share * (colours.reshape(height, width, 3) - rgba[..., :3])
    rgba[..., 3] = np.maximum(rgba[..., 3], 255 * (share[..., 0] > 0))
    return np.round(rgba).astype(np.uint8)


def _with_all(
    shown: Picture, site_grid: SiteGrid, marked: NDArray[np.bool_], grid: CellGrid
) -> Picture:
    """The map with room for all marked cells, (rows, columns)."""
    rows, columns = np.nonzero(marked)
    if not len(rows):
        return shown
    low, high = (columns.min(), rows.min()), (columns.max() + 1, rows.max() + 1)
    x, y = np.array([(low[0], low[1]), (high[0], low[1]), (low[0], high[1]), high]).T * grid.cell_m
    corners_m = np.column_stack([grid.corner_m[0] + x, grid.corner_m[1] - y])
    return with_room(shown, site_grid.grid.grid_from_projected(corners_m), PICTURE_PX)


def _lonlat(ring_m: PointsM, grid: CellGrid) -> Floats:
    latitude, longitude = Projection(grid.crs).wgs84_from_projected(ring_m)
    return np.column_stack([near_longitudes(longitude, grid.reference_deg), latitude])
