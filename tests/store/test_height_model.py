"""Heights of the ground by place, from models of several kinds, and what is no model of the ground asked for."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from pyproj import Transformer
from rasterio.transform import Affine

from sorvolo.errors import InputError
from sorvolo.store.rasters import height_model
from sorvolo.store.rasters.height_model import read_height_model

_BOUNDS_DEG = (12.60, 41.89, 12.61, 41.90)
_LONGITUDES, _LATITUDES = np.array([12.602, 12.6071]), np.array([41.8931, 41.8982])


def plane_m(east_m: np.ndarray, north_m: np.ndarray) -> np.ndarray:
    """A slope in UTM: what lies between pixels is exact by interpolation."""
    return 100 + 0.05 * (east_m - 300_000) - 0.02 * (north_m - 4_640_000)


def written(path: Path, crs: str, transform: Affine, heights: np.ndarray, **profile: Any) -> Path:
    bands = np.atleast_3d(heights.T).T
    with rasterio.open(
        path, "w", driver="GTiff", width=bands.shape[2], height=bands.shape[1], count=len(bands), crs=crs,
        dtype=bands.dtype.name, transform=transform, **profile,
    ) as sink:
        sink.write(bands)
    return path


def slope(path: Path, step_m: float = 10.0, **profile: Any) -> Path:
    """The plane on 3 km of UTM 33 around the bounds."""
    count = round(3000 / step_m)
    east_m = 299_500 + step_m * (np.arange(count) + 0.5)
    north_m = 4_642_500 - step_m * (np.arange(count) + 0.5)
    heights_m = plane_m(*np.meshgrid(east_m, north_m)).astype(np.float32)
    return written(path, "EPSG:32633", Affine(step_m, 0, 299_500, 0, -step_m, 4_642_500), heights_m, **profile)


def truth_m() -> np.ndarray:
    return plane_m(*Transformer.from_crs(4326, 32633, always_xy=True).transform(_LONGITUDES, _LATITUDES))


def test_between_pixels_a_slope_is_met_exactly(tmp_path: Path) -> None:
    model = read_height_model(slope(tmp_path / "utm.tif"), _BOUNDS_DEG)
    assert np.abs(model.at(_LONGITUDES, _LATITUDES) - truth_m()).max() < 0.01
    assert np.isnan(model.at(np.array([12.7, np.nan]), np.array([41.895, 41.895]))).all()


def test_a_large_model_is_read_coarser_and_says_the_same(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
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


@pytest.mark.parametrize(("make", "words"), [
    (lambda path: path, "no such file"),
    (lambda path: path.write_text("heights") and path, "no readable GeoTIFF"),
    (lambda path: written(path, "", Affine.scale(2.0, -2.0), np.zeros((9, 9), np.float32)), "coordinate reference"),
    (lambda path: written(path, "EPSG:4326", Affine(0.01, 0, 12, 0, -0.01, 42), np.zeros((3, 9, 9))), "3 bands"),
    (lambda path: written(path, "EPSG:4326", Affine(0.01, 0, -70, 0, -0.01, 42), np.zeros((9, 9))), "its ground"),
])
def test_what_is_no_model_of_this_ground(make: Any, words: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=words):
        read_height_model(make(tmp_path / "model.tif"), _BOUNDS_DEG)
