"""Heights of the ground by place, from models of several kinds, and what is no model of the ground asked for."""

import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from pyproj import Transformer
from rasterio.transform import Affine

from sorvolo.errors import InputError
from sorvolo.store.rasters import height_model
from sorvolo.store.rasters.base_map import BaseMap
from sorvolo.store.rasters.height_model import read_height_model

_BOUNDS_DEG = (12.60, 41.89, 12.61, 41.90)
_LONGITUDES, _LATITUDES = np.array([12.602, 12.6071]), np.array([41.8931, 41.8982])


def plane_m(east_m: np.ndarray, north_m: np.ndarray) -> np.ndarray:
    """A slope in UTM: what lies between pixels is exact by interpolation."""
    return 100 + 0.05 * (east_m - 300_000) - 0.02 * (north_m - 4_640_000)


def written(path: Path, crs: str, transform: Affine, heights: np.ndarray, **profile: Any) -> Path:
    bands = np.atleast_3d(heights.T).T
    with rasterio.open(
        path,
        "w",
        driver="GTiff",
        width=bands.shape[2],
        height=bands.shape[1],
        count=len(bands),
        crs=crs,
        dtype=bands.dtype.name,
        transform=transform,
        **profile,
    ) as sink:
        sink.write(bands)
    return path


def slope(path: Path, step_m: float = 10.0, **profile: Any) -> Path:
    """The plane on 3 km of UTM 33 around the bounds."""
    count = round(3000 / step_m)
    east_m = 299_500 + step_m * (np.arange(count) + 0.5)
    north_m = 4_642_500 - step_m * (np.arange(count) + 0.5)
    heights_m = plane_m(*np.meshgrid(east_m, north_m)).astype(np.float32)
    return written(
        path, "EPSG:32633", Affine(step_m, 0, 299_500, 0, -step_m, 4_642_500), heights_m, **profile
    )


def truth_m() -> np.ndarray:
    return plane_m(
        *Transformer.from_crs(4326, 32633, always_xy=True).transform(_LONGITUDES, _LATITUDES)
    )


def test_between_pixels_a_slope_is_met_exactly(tmp_path: Path) -> None:
    model = read_height_model(slope(tmp_path / "utm.tif"), _BOUNDS_DEG)
    assert np.abs(model.at(_LONGITUDES, _LATITUDES) - truth_m()).max() < 0.01
    assert np.isnan(model.at(np.array([12.7, np.nan]), np.array([41.895, 41.895]))).all()


def test_a_large_model_is_read_coarser_and_gives_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(height_model, "_MOST_PX", 40)
    model = read_height_model(slope(tmp_path / "fine.tif"), _BOUNDS_DEG)
    assert max(model.heights_m.shape) <= 40
    assert np.abs(model.at(_LONGITUDES, _LATITUDES) - truth_m()).max() < 0.5


def test_degrees_whole_numbers_and_holes(tmp_path: Path) -> None:
    heights = np.full((20, 20), 55, np.int16)
    heights[:10] = -32768
    transform = Affine(0.001, 0, 12.595, 0, -0.001, 41.905)
    model = read_height_model(
        written(tmp_path / "srtm.tif", "EPSG:4326", transform, heights, nodata=-32768), _BOUNDS_DEG
    )
    assert model.at(np.array([12.605]), np.array([41.892]))[0] == pytest.approx(55)
    assert np.isnan(model.at(np.array([12.605]), np.array([41.898]))[0])


@pytest.mark.parametrize(
    ("unit", "crs", "in_m"),
    [
        ("metre", "EPSG:32633", 1.0),
        ("ft", "EPSG:32633", 0.3048),
        ("US survey foot", "EPSG:32633", 1200 / 3937),
        ("", "EPSG:32633+5703", 1.0),
        ("", "EPSG:32633+6360", 1200 / 3937),  # NAVD88 in metres and in feet
    ],
)
def test_feet_are_read_as_feet_where_the_file_names_them(
    tmp_path: Path, unit: str, crs: str, in_m: float
) -> None:
    path = written(
        tmp_path / "model.tif",
        crs,
        Affine(10, 0, 299_500, 0, -10, 4_642_500),
        np.full((300, 300), 330, np.float32),
    )
    with rasterio.open(path, "r+") as file:
        file.units = (unit,)
    assert read_height_model(path, _BOUNDS_DEG).at(_LONGITUDES, _LATITUDES) == pytest.approx(
        330 * in_m, abs=1e-3
    )


def test_heights_of_no_ground_on_earth_are_holes(tmp_path: Path) -> None:
    heights = np.full((300, 300), 55, np.float32)
    heights[:, :180] = -9999
    heights[:, 299:] = np.inf
    path = written(
        tmp_path / "model.tif", "EPSG:32633", Affine(10, 0, 299_500, 0, -10, 4_642_500), heights
    )
    found = read_height_model(path, _BOUNDS_DEG).at(
        np.array([12.602, 12.6095]), np.array([41.895, 41.895])
    )
    assert np.isnan(found[0]) and found[1] == pytest.approx(55)


def in_fathoms(path: Path) -> Path:
    with rasterio.open(slope(path), "r+") as file:
        file.units = ("fathom",)
    return path


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (in_fathoms, "heights in 'fathom'"),
        (
            lambda path: written(
                path, "EPSG:4326", Affine(0.01, 0, 12, 0, -0.01, 42), np.zeros((2, 9, 9))
            ),
            "terrain.tif",
        ),
        (lambda path: path, "no such file"),
        (lambda path: path.write_text("heights") and path, "no readable GeoTIFF"),
        (
            lambda path: written(path, "", Affine.scale(2.0, -2.0), np.zeros((9, 9), np.float32)),
            "coordinate reference",
        ),
        (
            lambda path: written(
                path, "EPSG:4326", Affine(0.01, 0, 12, 0, -0.01, 42), np.zeros((3, 9, 9))
            ),
            "3 bands",
        ),
        (
            lambda path: written(
                path, "EPSG:4326", Affine(0.01, 0, -70, 0, -0.01, 42), np.zeros((9, 9))
            ),
            "its ground",
        ),
        (
            lambda path: written(
                path, "EPSG:4326", Affine(float("nan"), 0, 12, 0, -0.01, 42), np.zeros((9, 9))
            ),
            "places no pixel",
        ),
    ],
)
def test_what_is_no_model_of_this_ground(make: Any, words: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=words):
        read_height_model(make(tmp_path / "model.tif"), _BOUNDS_DEG)


NO_DATUM = "+proj=tmerc +lat_0=0 +lon_0=15 +k=0.9996 +x_0=2520000 +y_0=0 +ellps=intl +units=m"


@pytest.mark.parametrize(
    "crs, words",
    [
        (NO_DATUM, "International 1924.* but no datum: .*EPSG code"),
        ("EPSG:4004", "Bessel 1841.* but no datum"),
    ],
)
def test_a_raster_of_no_known_datum_is_refused(crs: str, words: str, tmp_path: Path) -> None:
    path = written(
        tmp_path / "model.tif",
        crs,
        Affine(10, 0, 2_320_000, 0, -10, 4_642_000),
        np.ones((9, 9), np.uint8),
    )
    for read in (lambda path: read_height_model(path, _BOUNDS_DEG), BaseMap.open):
        with pytest.raises(InputError, match=words):
            read(path)


def test_a_named_datum_and_that_of_the_heights_are_kept(tmp_path: Path) -> None:
    """The same slope in the Italian grid, 73 m off if its datum were taken as WGS84, with heights above the sea."""
    model = read_height_model(slope(tmp_path / "utm.tif"), _BOUNDS_DEG)
    assert model.datum == ""
    east_m, north_m = Transformer.from_crs(32633, 3004, always_xy=True).transform(
        *np.meshgrid(np.linspace(299_500, 302_500, 3), np.linspace(4_639_500, 4_642_500, 3))
    )
    columns = np.arange(east_m.min(), east_m.max(), 10.0) + 5
    rows = np.arange(north_m.max(), north_m.min(), -10.0) - 5
    back = Transformer.from_crs(3004, 32633, always_xy=True)
    heights_m = plane_m(*back.transform(*np.meshgrid(columns, rows)))
    transform = Affine(10, 0, columns[0] - 5, 0, -10, rows[0] + 5)
    path = written(tmp_path / "italian.tif", "EPSG:3004+5773", transform, heights_m)
    model = read_height_model(path, _BOUNDS_DEG)
    assert model.datum == "EGM96 height"
    assert np.abs(model.at(_LONGITUDES, _LATITUDES) - truth_m()).max() < 0.2


def test_a_file_without_a_place_is_refused_in_one_line(tmp_path: Path) -> None:
    with rasterio.open(
        tmp_path / "plain.tif", "w", driver="GTiff", width=9, height=9, count=1, dtype="uint8"
    ) as sink:
        sink.write(np.ones((1, 9, 9), np.uint8))
    for read in (lambda path: read_height_model(path, _BOUNDS_DEG), BaseMap.open):
        with warnings.catch_warnings():
            warnings.simplefilter(
                "error"
            )  # rasterio's warning names lines of Python, which help nobody
            with pytest.raises(InputError, match=r"coordinate reference|no place on Earth"):
                read(tmp_path / "plain.tif")
