"""`sorvolo map --base`: photos tied to a map that exists, with and without GPS; maps that cannot be their base."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from PIL import Image
from rasterio.transform import Affine

from sorvolo.change.alignment import Aligner, NotAligned
from sorvolo.cli import main as cli
from sorvolo.geometry.geodesy import Geodetic, LocalFrame

_GPS_IFD = 0x8825


@pytest.fixture(scope="module")
def base(photographed: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A site folder whose map is right to centimetres, written in Web Mercator."""
    site = tmp_path_factory.mktemp("base") / "site"
    photos = str(photographed / "flight1" / "photos")
    camera = str(photographed / "camera.xml")
    assert (
        cli.main(
            [
                "map",
                photos,
                "--site",
                str(site),
                "--model",
                "none",
                "--camera",
                camera,
                "--crs",
                "EPSG:3857",
            ]
        )
        == 0
    )
    return site


def copied(photographed: Path, folder: Path, shift_m: float | None) -> Path:
    """Every second photo, their fixes `shift_m` to the north, or without any."""
    folder.mkdir()
    for path in sorted((photographed / "flight1" / "photos").glob("*.jpg"))[::2]:
        with Image.open(path) as picture:
            exif = picture.getexif()
            if shift_m is None:
                del exif[_GPS_IFD]
            else:
                place = exif.get_ifd(_GPS_IFD)
                degrees, minutes, seconds = (float(each) for each in place[2])
                place[2] = (degrees, minutes, seconds + shift_m / 30.9)
            picture.save(folder / path.name, "JPEG", exif=exif, quality=95)
    return folder


def run(photos: Path, site: Path, photographed: Path, base: Path) -> int:
    camera = str(photographed / "camera.xml")
    return cli.main(
        [
            "map",
            str(photos),
            "--site",
            str(site),
            "--model",
            "none",
            "--camera",
            camera,
            "--base",
            str(base),
        ]
    )


def report_of(site: Path) -> dict[str, Any]:
    return json.loads(next(site.glob("flights/*/report.json")).read_text())


def absolute_m(site: Path, photographed: Path) -> float:
    truth = json.loads((photographed / "truth" / "frames.geojson").read_text())
    frame = LocalFrame(Geodetic(**truth["site"]))
    true = {each["properties"]["frame"]: each for each in truth["features"]}
    found = json.loads(next(site.glob("flights/*/frames.geojson")).read_text())
    misses = []
    for each in found["features"]:
        pair = [
            np.array(one["geometry"]["coordinates"][0])[:4]
            for one in (each, true[each["properties"]["frame"]])
        ]
        a, b = (frame.ground_from_lonlat(ring) for ring in pair)
        misses.append(a - b)
    return float(np.sqrt((np.concatenate(misses) ** 2).sum(axis=1).mean()))


@pytest.mark.parametrize("shift_m", [6.0, None], ids=["fixes 6 m beside", "no GPS"])
def test_photos_come_to_lie_where_the_base_map_has_them(
    photographed: Path, base: Path, tmp_path: Path, shift_m: float | None
) -> None:
    photos, site = copied(photographed, tmp_path / "photos", shift_m), tmp_path / "site"
    given = base if shift_m else base / "mosaic.tif"
    assert run(photos, site, photographed, given) == 0
    report = report_of(site)
    assert report["georeferenced"] and report["base"]["found"] >= 6
    assert absolute_m(site, photographed) < 0.15
    if shift_m:
        assert report["base"]["moved_m"] == pytest.approx(shift_m, abs=0.5)


def test_photos_that_are_not_found_by_themselves_are_found_as_one(
    photographed: Path, base: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Aligner, "align", lambda *_: NotAligned("months have passed", np.nan))
    photos, site = copied(photographed, tmp_path / "photos", 0.5), tmp_path / "site"
    assert run(photos, site, photographed, base) == 0
    assert report_of(site)["base"]["found"] >= 6
    assert absolute_m(site, photographed) < 0.3


def write_map(path: Path, place: Path, m_per_px: float, shift_m: float, seed: int | None) -> Path:
    """The base map coarser or moved, or noise in its place."""
    with rasterio.open(place) as source:
        step = m_per_px / source.transform.a
        height, width = int(source.height / step), int(source.width / step)
        rgb = source.read(
            [1, 2, 3], out_shape=(3, height, width), resampling=rasterio.enums.Resampling.average
        )
        transform = Affine(
            m_per_px, 0, source.transform.c + shift_m, 0, -m_per_px, source.transform.f
        )
        if seed is not None:
            left, top = max(0, width - 80) // 2, max(0, height - 80) // 2
            transform = transform @ Affine.translation(left, top)
            height, width = (
                min(height, 80),
                min(width, 80),
            )  # large enough to be searched at several scales
            rgb = np.random.default_rng(seed).integers(0, 255, (3, height, width), np.uint8)
        profile = {
            "driver": "GTiff",
            "count": 3,
            "dtype": "uint8",
            "width": width,
            "height": height,
        }
        with rasterio.open(path, "w", crs=source.crs, transform=transform, **profile) as sink:
            sink.write(rgb)
    return path


@pytest.mark.parametrize("has_gps", [True, False], ids=["GPS", "no GPS"])
@pytest.mark.parametrize(
    "m_per_px, shift_m, seed, words",
    [
        (0.1, 5000.0, None, "give a map of its ground"),
        (0.4, 0.0, 5, "found on the base map"),
        (0.9, 0.0, None, "8 times coarser at most"),
    ],
)
def test_a_base_map_of_another_place_or_far_too_coarse_is_refused(
    photographed: Path,
    base: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    has_gps: bool,
    m_per_px: float,
    shift_m: float,
    seed: int | None,
    words: str,
) -> None:
    if not has_gps and shift_m:
        pytest.skip("without GPS a moved map cannot be known to be moved")
    photos = copied(photographed, tmp_path / "photos", 0.0 if has_gps else None)
    for path in sorted(photos.glob("*.jpg"))[3:]:  # three suffice to be refused
        path.unlink()
    given = write_map(tmp_path / "base.tif", base / "mosaic.tif", m_per_px, shift_m, seed)
    assert run(photos, tmp_path / "site", photographed, given) == 1
    error = capsys.readouterr().err
    assert error.count("error:") == 1 and (
        words in error or (not has_gps and "not found on the base map" in error)
    )
    assert not (tmp_path / "site" / "mosaic.tif").exists()


def test_a_file_that_is_no_map_is_refused(
    photographed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    photos = photographed / "flight1" / "photos"
    (tmp_path / "base.tif").write_text("no raster")
    for path in (tmp_path / "base.tif", tmp_path / "nothing.tif", next(photos.glob("*.jpg"))):
        assert run(photos, tmp_path / "site", photographed, path) == 1
        assert "GeoTIFF" in capsys.readouterr().err
