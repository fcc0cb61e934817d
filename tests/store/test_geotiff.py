"""A map written as GeoTIFF lies where it should, to the millimetre, and is read back the same."""

import weakref
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
import pytest
import rasterio
from fake_flights import ORIGIN, tile
from pyproj import Transformer
from rasterio.enums import ColorInterp

from sorvolo.errors import InputError, SettingsError, StoreError
from sorvolo.geometry.geodesy import Geodetic, utm_epsg
from sorvolo.geometry.grid import SiteGrid
from sorvolo.store.rasters.geotiff import read_raster, write_cog


@pytest.fixture
def site_grid() -> SiteGrid:
    return SiteGrid.at(ORIGIN, 0.05, f"EPSG:{utm_epsg(ORIGIN.latitude_deg, ORIGIN.longitude_deg)}")


def marked(pixel: tuple[int, int]) -> dict[tuple[int, int], np.ndarray]:
    """Two by two dark tiles around the grid's origin with one white pixel, given in grid pixels."""
    tiles = {(column, row): tile(10) for column in (-1, 0) for row in (-1, 0)}
    for one in tiles.values():
        one[..., :3] = 10
    x, y = pixel
    tiles[x // 512, y // 512][y % 512, x % 512, :3] = 255
    return tiles


def brightest(dataset: rasterio.DatasetReader) -> tuple[float, float]:
    """Column and row of the brightness' centre of mass above the ground's 10."""
    weight = np.clip(dataset.read(1).astype(float) - 12, 0, None)
    rows, columns = np.indices(weight.shape)
    return (weight * columns).sum() / weight.sum(), (weight * rows).sum() / weight.sum()


@pytest.mark.parametrize("pixel", [(0, 0), (-400, 37), (511, -512)])
def test_a_known_pixel_lies_in_its_place_to_a_millimetre(
    tmp_path: Path, site_grid: SiteGrid, pixel: tuple[int, int]
) -> None:
    write_cog(marked(pixel), site_grid, tmp_path / "mosaic.tif")
    with rasterio.open(tmp_path / "mosaic.tif") as mosaic:
        assert mosaic.crs.to_epsg() == 32633
        column, row = brightest(mosaic)
        place_m = mosaic.xy(round(row), round(column))  # of the pixel's centre
        assert (column, row) == (pixel[0] + 512, pixel[1] + 512)
    expected_m = site_grid.grid.projected_from_grid(np.array([pixel]))[0]
    assert np.abs(np.subtract(place_m, expected_m)).max() < 0.001
    # the same place through the site's own metres and WGS84, apart from the projection's code
    east_north_m = expected_m - site_grid.projected_from_site(np.zeros((1, 2)))[0]
    assert np.abs(east_north_m - np.array(pixel) * [0.05, -0.05]).max() <= 0.025 + 1e-9


def test_it_is_a_cloud_optimized_geotiff(tmp_path: Path, site_grid: SiteGrid) -> None:
    tiles = {(column, row): tile(10 + column, 300) for column in range(3) for row in range(2)}
    del tiles[1, 1]
    write_cog(tiles, site_grid, tmp_path / "mosaic.tif")
    with rasterio.open(tmp_path / "mosaic.tif") as mosaic:
        assert (mosaic.width, mosaic.height, mosaic.count) == (1536, 1024, 4)
        assert mosaic.block_shapes == [(512, 512)] * 4
        assert mosaic.overviews(1) == [2, 4]
        assert mosaic.colorinterp[3] == ColorInterp.alpha
        picture = np.moveaxis(mosaic.read(), 0, 2)
        for (column, row), one in tiles.items():
            window = picture[row * 512 : row * 512 + 512, column * 512 : column * 512 + 512]
            assert np.array_equal(window, one)
        assert not picture[512:, 512:1024].any()
    cogeo = pytest.importorskip("rio_cogeo")
    is_valid, errors, warnings = cogeo.cog_validate(str(tmp_path / "mosaic.tif"), strict=True)
    assert is_valid, (errors, warnings)


def test_each_tile_is_read_once_and_passes_by(tmp_path: Path, site_grid: SiteGrid) -> None:
    tiles = {(column, row): tile(10 + column, 300) for column in range(3) for row in range(2)}
    passed: list[tuple[tuple[int, int], int]] = []
    write_cog(
        tiles,
        site_grid,
        tmp_path / "mosaic.tif",
        pass_by=lambda index, one: passed.append((index, int(one.sum()))),
    )
    assert sorted(passed) == [(index, int(tiles[index].sum())) for index in sorted(tiles)]


def test_overviews_do_not_darken_the_rim_of_what_is_seen(
    tmp_path: Path, site_grid: SiteGrid
) -> None:
    half = np.zeros((512, 512, 4), np.uint8)
    half[:, :255] = (200, 200, 200, 255)  # an odd edge: overview pixels mix seen and unseen
    write_cog({(0, 0): half, (1, 0): half, (2, 0): half}, site_grid, tmp_path / "mosaic.tif")
    with rasterio.open(tmp_path / "mosaic.tif", overview_level=0) as overview:
        red, _, _, alpha = overview.read()
    assert (red[alpha > 0] >= 199).all()


def test_what_is_empty_between_two_places_is_left_out_of_the_overviews_alone(
    tmp_path: Path, site_grid: SiteGrid, monkeypatch: pytest.MonkeyPatch
) -> None:
    rng = np.random.default_rng(4)
    tiles = {}
    for index in ((-3, -2), (-2, -2), (2, 4), (3, 1)):
        tiles[index] = rng.integers(0, 256, tile(0).shape, dtype=np.uint8)
        tiles[index][..., 3] = 255
    write_cog(tiles, site_grid, tmp_path / "skipped.tif")
    monkeypatch.setattr("sorvolo.store.rasters.geotiff._filled_blocks", lambda tiles, grid: None)
    write_cog(tiles, site_grid, tmp_path / "whole.tif")
    assert (tmp_path / "skipped.tif").read_bytes() == (tmp_path / "whole.tif").read_bytes()


@pytest.mark.parametrize("crs", ["EPSG:3857", "EPSG:4326", "EPSG:25833"])
def test_another_crs_keeps_the_place_and_the_alpha(
    tmp_path: Path, site_grid: SiteGrid, crs: str
) -> None:
    pixel = (120, -77)
    write_cog(marked(pixel), site_grid, tmp_path / "mosaic.tif", crs=crs)
    to_utm = Transformer.from_crs(crs, site_grid.grid.crs, always_xy=True)
    with rasterio.open(tmp_path / "mosaic.tif") as mosaic:
        assert mosaic.crs.to_string() == crs
        column, row = brightest(mosaic)
        place_m = to_utm.transform(*(mosaic.transform @ (column + 0.5, row + 0.5)))
        alpha = mosaic.read(4)
    expected_m = site_grid.grid.projected_from_grid(np.array([pixel]))[0]
    assert (
        np.hypot(*np.subtract(place_m, expected_m)) < 0.02
    )  # resampling spreads the pixel over four
    assert (alpha == 255).mean() > 0.8
    if crs != "EPSG:25833":  # the same axes as the site's: nothing is turned, no corner stays empty
        assert (alpha == 0).any()


def test_a_local_map_has_no_crs(tmp_path: Path) -> None:
    local = SiteGrid.at(Geodetic(0, 0), 1.0, "")
    write_cog({(0, 0): tile(1)}, local, tmp_path / "mosaic.tif")
    with rasterio.open(tmp_path / "mosaic.tif") as mosaic:
        assert mosaic.crs is None
        assert (mosaic.transform.c, mosaic.transform.f) == (-0.5, 0.5)
    with pytest.raises(SettingsError, match="no geo-reference"):
        write_cog({(0, 0): tile(1)}, local, tmp_path / "other.tif", crs="EPSG:3857")


def test_what_cannot_be_written_is_named_and_leaves_nothing(
    tmp_path: Path, site_grid: SiteGrid
) -> None:
    with pytest.raises(StoreError, match="no tiles"):
        write_cog({}, site_grid, tmp_path / "mosaic.tif")
    with pytest.raises(SettingsError, match="EPSG:999999"):
        write_cog({(0, 0): tile(1)}, site_grid, tmp_path / "mosaic.tif", crs="EPSG:999999")
    assert not any(tmp_path.iterdir())


class Watched(Mapping[tuple[int, int], np.ndarray]):
    """Tiles made when asked for, which know how many of them are held at once."""

    def __init__(self, side: int) -> None:
        self._indices = [(column, row) for column in range(side) for row in range(side)]
        self._made: list[weakref.ref[np.ndarray]] = []
        self.most = 0

    def __getitem__(self, index: tuple[int, int]) -> np.ndarray:
        if index not in self._indices:
            raise KeyError(index)
        made = tile(index[0] * 8 + index[1])
        self._made.append(weakref.ref(made))
        self.most = max(self.most, sum(one() is not None for one in self._made))
        return made

    def __iter__(self) -> Iterator[tuple[int, int]]:
        return iter(self._indices)

    def __len__(self) -> int:
        return len(self._indices)


def test_few_tiles_are_held_at_a_time(tmp_path: Path, site_grid: SiteGrid) -> None:
    tiles = Watched(4)
    write_cog(tiles, site_grid, tmp_path / "mosaic.tif")
    assert 1 <= tiles.most <= 5  # one is written, another is at hand, three were begun ahead


def test_a_written_map_reads_back_thinned_in_its_place(tmp_path: Path, site_grid: SiteGrid) -> None:
    tiles = {(-1, 0): tile(10), (0, 0): tile(200)}
    write_cog(tiles, site_grid, tmp_path / "mosaic.tif")
    whole = read_raster(tmp_path / "mosaic.tif", 4096)
    assert np.array_equal(whole.rgba, np.concatenate([tiles[-1, 0], tiles[0, 0]], axis=1))
    assert whole.m_per_px == pytest.approx(0.05)
    assert whole.crs == "EPSG:32633"
    expected_m = site_grid.grid.projected_from_grid(np.array([[-512, 0]]))[0]
    assert np.abs(np.subtract(whole.origin_m, expected_m)).max() < 1e-6
    small = read_raster(tmp_path / "mosaic.tif", 300)
    assert small.rgba.shape == (128, 256, 4)
    assert small.m_per_px == pytest.approx(0.2)
    # four pixels became one: its centre lies one and a half pixels further in
    assert np.abs(np.subtract(small.origin_m, expected_m + np.array([0.075, -0.075]))).max() < 1e-6


def write_plain(path: Path, bands: np.ndarray, **profile: object) -> None:
    defaults = {"crs": "EPSG:32633", "transform": rasterio.Affine(0.1, 0, 500, 0, -0.1, 900)}
    with rasterio.open(
        path,
        "w",
        driver="GTiff",
        count=len(bands),
        height=bands.shape[1],
        width=bands.shape[2],
        dtype=bands.dtype,
        **(defaults | profile),
    ) as sink:
        sink.write(bands)


def test_a_reference_map_may_be_grey_and_have_nodata(tmp_path: Path) -> None:
    grey = np.full((1, 40, 60), 90, np.uint8)
    grey[:, :10] = 0
    write_plain(tmp_path / "grey.tif", grey, nodata=0)
    raster = read_raster(tmp_path / "grey.tif", 100)
    assert raster.rgba.shape == (40, 60, 4)
    assert (raster.rgba[10:] == (90, 90, 90, 255)).all()
    assert not raster.rgba[:10, :, 3].any()


@pytest.mark.parametrize(
    ("profile", "dtype", "message"),
    [
        (
            {"crs": "EPSG:4326", "transform": rasterio.Affine(1e-6, 0, 13, 0, -1e-6, 46)},
            np.uint8,
            "degrees",
        ),
        ({"transform": rasterio.Affine(0.1, 0.02, 500, 0.02, -0.1, 900)}, np.uint8, "north-up"),
        ({"transform": rasterio.Affine(0.1, 0, 500, 0, -0.2, 900)}, np.uint8, "square"),
        ({}, np.uint16, "8-bit"),
    ],
)
def test_a_reference_map_that_cannot_be_used_is_named(
    tmp_path: Path, profile: dict[str, object], dtype: type, message: str
) -> None:
    write_plain(tmp_path / "reference.tif", np.ones((3, 20, 20), dtype), **profile)
    with pytest.raises(InputError, match=message):
        read_raster(tmp_path / "reference.tif", 100)


def test_a_reference_map_that_is_no_geotiff_is_refused(tmp_path: Path) -> None:
    write_plain(tmp_path / "secret.tif", np.ones((3, 20, 20), np.uint8))
    # a VRT may name any file on this disk: it must not be opened under another name
    (tmp_path / "trap.tif").write_text(
        '<VRTDataset rasterXSize="20" rasterYSize="20"><VRTRasterBand dataType="Byte" band="1"><SimpleSource>'
        f"<SourceFilename>{tmp_path / 'secret.tif'}</SourceFilename><SourceBand>1</SourceBand>"
        "</SimpleSource></VRTRasterBand></VRTDataset>"
    )
    (tmp_path / "empty.tif").write_bytes(b"")
    for name in ("trap.tif", "empty.tif", "absent.tif"):
        with pytest.raises(InputError, match=name):
            read_raster(tmp_path / name, 100)
    whole = (tmp_path / "secret.tif").read_bytes()
    (tmp_path / "cut.tif").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(InputError, match=r"cut\.tif"):
        read_raster(tmp_path / "cut.tif", 100)
