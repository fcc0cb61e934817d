"""What lies beside photos: positions by photo (geo.txt, Timestamp.MRK), logs, and files that nothing uses."""

from pathlib import Path

import numpy as np
import pytest
from pyproj import Transformer
from test_photos import DJI, codes, open_photos, write_photo

from sorvolo.capture.photos import PhotoSource
from sorvolo.capture.source import open_sources
from sorvolo.errors import InputError
from sorvolo.geometry.units import SECOND_NS
from sorvolo.store.exports.telemetry_files import geo_txt
from sorvolo.survey.corrected import CorrectedFrame

LATITUDES = 41.89 + 1e-4 * np.arange(5)
GIMBAL = 'drone-dji:GimbalYawDegree="10" drone-dji:GimbalPitchDegree="-90" drone-dji:GimbalRollDegree="0"'


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    """Five photos 2 s apart without GPS, whose clock is two hours east of UTC."""
    for index in range(5):
        write_photo(
            tmp_path / f"DJI_20260402_{index + 1:04d}_V.jpg",
            None,
            local=f"2026:04:02 14:44:{2 * index:02d}",
            xmp=DJI.format(attributes=GIMBAL, elements=""),
            seed=index,
        )
    return tmp_path


def mrk() -> str:
    """DJI's rows of the five photos; their last one is one more, of a photo that was deleted."""
    gps = np.datetime64("2026-04-02T12:44:00") - np.datetime64("1980-01-06")
    seconds = int(gps / np.timedelta64(1, "s")) + 18
    week, second = divmod(seconds, 7 * 86_400)
    return "".join(
        f"{index + 1}\t{second + 2 * index}.25\t[{week}]\t   34,N\t    -1,E\t   193,V\t{41.89 + 1e-4 * index:.8f},Lat\t"
        f"12.6,Lon\t132.5,Ellh\t0.030000, 0.040000, 0.060000\t50,Q\n"
        for index in range(6)
    )


def gpx(folder: Path, name: str = "flight.gpx") -> Path:
    points = "".join(
        f'<trkpt lat="{41.89 + 1e-4 * row:.6f}" lon="12.6"><ele>80</ele><time>2026-04-02T14:44:{2 * row:02d}Z</time></trkpt>'
        for row in range(5)
    )
    text = f'<gpx version="1.1" xmlns="http://www.topografix.com/GPX/1/1"><trk><trkseg>{points}</trkseg></trk></gpx>'
    (folder / name).write_text(text)
    return folder / name


def places(source: PhotoSource) -> np.ndarray:
    return np.column_stack([source.telemetry["latitude_deg"], source.telemetry["longitude_deg"]])


def test_geo_txt_places_photos_by_name(photos: Path) -> None:
    names = [each.name for each in sorted(photos.iterdir())]
    east_north = Transformer.from_crs(4326, 32633, always_xy=True)
    rows = [
        "{} {:.4f} {:.4f} 130.5 0 0 0 0.02 0.04".format(
            name.lower(), *east_north.transform(12.6, latitude)
        )
        for name, latitude in zip(names, LATITUDES)
    ]
    (photos / "geo.txt").write_text("EPSG:32633+5773\n# a comment\n" + "\n".join(rows[::-1]))
    source = open_photos(photos)
    np.testing.assert_allclose(places(source), [(each, 12.6) for each in LATITUDES], atol=1e-8)
    telemetry = source.telemetry
    assert (telemetry["orthometric_height_m"] == 130.5).all()
    assert (telemetry["horizontal_sigma_m"] == 0.02).all() and (
        telemetry["vertical_sigma_m"] == 0.04
    ).all()
    assert (telemetry["camera_yaw_deg"] == 10).all()  # the photo's own
    assert codes(source) == {"positions_from_file": 5, "time_zone_unknown": 5}
    with pytest.raises(InputError, match="is no place in EPSG:4326; name the CRS"):
        (photos / "geo.txt").write_text("EPSG:4326\n" + "\n".join(rows))
        open_sources([photos], photos / "geo.txt")


def test_the_geo_txt_that_sorvolo_writes_is_read(photos: Path) -> None:
    names = [each.name for each in sorted(photos.iterdir())]
    frames = [
        CorrectedFrame(
            name, index, 0, 0.0, latitude, 12.6, 83.0, 48.0, 123.0, -88.0, 0.0, 0.5, 60.0, 45.0, ""
        )
        for index, (name, latitude) in enumerate(zip(names, LATITUDES))
    ]
    (photos / "geo.txt").write_text(geo_txt(frames))
    for name in names:
        write_photo(
            photos / name,
            None,
            local=f"2026:04:02 14:44:{2 * names.index(name):02d}",
            seed=names.index(name),
        )
    source = open_photos(photos)
    np.testing.assert_allclose(places(source), [(each, 12.6) for each in LATITUDES], atol=1e-8)
    np.testing.assert_allclose(source.telemetry["camera_yaw_deg"], 123.0, atol=0.01)
    np.testing.assert_allclose(source.telemetry["camera_pitch_deg"], -88.0, atol=0.01)
    (used,) = [each for each in source.notices() if each.code == "positions_from_file"]
    assert used.text.endswith(
        "5 of 5; its heights state no reference and are taken as above sea level"
    )


@pytest.mark.parametrize("is_named", [False, True])
def test_djis_timestamps_place_photos_by_number(photos: Path, is_named: bool) -> None:
    (photos / "DJI_202604021444_001_Timestamp.MRK").write_text(mrk())
    named = photos / "DJI_202604021444_001_Timestamp.MRK" if is_named else None
    (source,) = open_sources([photos], named)
    assert isinstance(source, PhotoSource)
    np.testing.assert_allclose(places(source), [(each, 12.6) for each in LATITUDES], atol=1e-9)
    assert (source.telemetry["ellipsoidal_height_m"] == 132.5).all()
    np.testing.assert_allclose(source.telemetry["horizontal_sigma_m"], 0.05 / 2**0.5)
    assert (source.telemetry["vertical_sigma_m"] == 0.06).all()
    assert codes(source) == {"positions_from_file": 5, "time_zone_unknown": 5}


def test_timestamps_of_another_flight_place_nothing(photos: Path) -> None:
    """Numbers begin again with each flight: the steps between the exposures tell them apart."""
    strange = [row.split("\t") for row in mrk().splitlines()]
    for index, cells in enumerate(strange):
        cells[1] = str(float(cells[1]) + 7 * index)
    (photos / "Timestamp.MRK").write_text("\n".join("\t".join(cells) for cells in strange))
    source = open_photos(photos)
    assert not source.telemetry.has_fixes and codes(source)["unusable_telemetry"] == 1
    with pytest.raises(InputError, match="none of these photos ends in one of its numbers"):
        open_sources([photos], photos / "Timestamp.MRK")


def test_positions_that_contradict_the_photos_are_counted(tmp_path: Path) -> None:
    for index, latitude in enumerate(LATITUDES):
        place = (latitude + (1e-3 if index == 2 else 0), 12.6, 80)
        write_photo(tmp_path / f"{index}.jpg", place, utc=f"2026:04:02 12:44:0{index}", seed=index)
    rows = [f"{index}.jpg 12.6 {latitude:.8f}" for index, latitude in enumerate(LATITUDES)]
    (tmp_path / "geo.txt").write_text("\n".join(["WGS84", *rows]))
    source = open_photos(tmp_path)
    np.testing.assert_allclose(source.telemetry["latitude_deg"], LATITUDES, atol=1e-9)
    assert codes(source) == {"positions_from_file": 5, "position_contradicted": 1}


def test_the_only_log_in_the_photos_folder_is_used(photos: Path) -> None:
    log = gpx(photos)
    source = open_photos(photos)
    assert source.telemetry.format == "gpx" and len(source.telemetry) == 5
    assert codes(source) == {"time_zone_unknown": 5, "log_in_folder": 1}
    # of two it is not clear which, and photos that have positions need none: both are named
    other = gpx(photos, "other.gpx")
    source = open_photos(photos)
    (named,) = [each for each in source.notices() if each.code == "unused_telemetry"]
    assert not source.telemetry.has_fixes and named.count == 2
    assert "flight.gpx, other.gpx; give one as --telemetry" in named.text
    other.unlink()
    for index, path in enumerate(sorted(photos.glob("*.jpg"))):
        write_photo(path, (41.89, 12.6, 80), utc=f"2026:04:02 12:44:0{index}", seed=index)
    source = open_photos(photos)
    assert source.telemetry.format == "exif" and codes(source) == {"unused_telemetry": 1}
    assert log.name in source.notices()[0].text


@pytest.mark.parametrize(
    "text", ["0.jpg 12.6 41.9 55\n1.jpg 12.6 41.9 55\n", "EPSG:4326\n0.jpg 12,6 41,9 55\n"]
)
def test_a_geo_txt_that_cannot_be_read_is_named(photos: Path, text: str) -> None:
    (photos / "geo.txt").write_text(text)
    texts = {each.code: each.text for each in open_photos(photos).notices()}
    assert (
        texts["unusable_telemetry"].startswith("not used: ")
        and "geo.txt" in texts["unusable_telemetry"]
    )


def test_photos_without_a_time_and_other_files_are_named(tmp_path: Path) -> None:
    for index in range(3):
        write_photo(tmp_path / f"{index}.jpg", None, seed=index)
    gpx(tmp_path)
    (tmp_path / "notes.pdf").write_bytes(b"%PDF")
    source = open_photos(tmp_path)
    texts = {each.code: each.text for each in source.notices()}
    assert not source.telemetry.has_fixes and "state no time" in texts["unused_telemetry"]
    assert texts["ignored_file"].endswith("ignored: 1 (notes.pdf)")
    assert source.start_ns % SECOND_NS == 0
