"""Bad input through the command: each fault has its own clear error or counted value, and no site is spoilt."""

import csv
import json
import os
import resource
import shutil
import signal
import sqlite3
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from PIL import Image

from sorvolo.cli import main as cli
from sorvolo.errors import SettingsError
from sorvolo.missions.flight.settings import MapSettings
from sorvolo.store.site.archive import Archive

_GPS_IFD, _ORIENTATION = 34853, 274


def refused(capsys: pytest.CaptureFixture[str], *arguments: str | Path) -> str:
    """The one line that a command, which must fail with code 1, prints on stderr."""
    capsys.readouterr()
    assert cli.main(["map", "--model", "none", *map(str, arguments)]) == 1
    printed = capsys.readouterr().err.splitlines()
    assert len(printed) == 1 and printed[0].startswith("error: ") and "bug" not in printed[0], (
        printed
    )
    return printed[0]


def mapped(site: Path, *arguments: str | Path, code: int = 0) -> dict[str, Any]:
    """The report of the only flight of a command that must succeed; code 3: with a map to check before use."""
    assert cli.main(["map", "--model", "none", *map(str, arguments), "--site", str(site)]) == code
    (path,) = site.glob("flights/*/report.json")
    return json.loads(path.read_text())


def codes(report: dict[str, Any]) -> dict[str, int]:
    return {each["code"]: each["count"] for each in report["notices"]}


def endings(site: Path) -> dict[str, tuple[str, str]]:
    (path,) = site.glob("flights/*/frames.geojson")
    return {
        str(each["properties"]["frame"]): (
            each["properties"]["status"],
            each["properties"]["reason"],
        )
        for each in json.loads(path.read_text())["features"]
    }


@pytest.fixture
def film(filmed: Path) -> Path:
    return filmed / "flight1" / "flight1.mp4"


@pytest.fixture
def photos(photographed: Path, tmp_path: Path) -> Path:
    """A copy, to be spoilt, of the flight's first twelve photos."""
    folder = tmp_path / "photos"
    folder.mkdir()
    for photo in sorted((photographed / "flight1" / "photos").glob("*.jpg"))[:12]:
        shutil.copy(photo, folder)
    return folder


def _nmea(filmed: Path, change: Callable[[int, list[str]], None]) -> str:
    """The flight's NMEA with its sentences changed, `change(fix, fields)`, and their checksums right again."""
    lines = (filmed / "flight1" / "other" / "flight1.nmea").read_text().splitlines()
    result = []
    for number, line in enumerate(lines):
        fields = line[1:].partition("*")[0].split(",")
        change(number // 2, fields)
        body = ",".join(fields)
        checksum = 0
        for byte in body.encode():
            checksum ^= byte
        result.append(f"${body}*{checksum:02X}\r\n")
    return "".join(result)


def _latitude(fields: list[str]) -> int:
    return 2 if fields[0] == "GPGGA" else 3


# ---- what cannot be read at all ---------------------------------------------------------------------------------


def test_inputs_that_are_not_there_or_hold_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    site = tmp_path / "site"
    assert "no such file" in refused(capsys, tmp_path / "none.mp4", "--site", site)
    empty = tmp_path / "empty"
    empty.mkdir()
    assert "no pictures" in refused(capsys, empty, "--site", site)
    (tmp_path / "zero.mp4").touch()
    assert "0 bytes" in refused(capsys, tmp_path / "zero.mp4", "--site", site)
    (tmp_path / "noise.mp4").write_bytes(np.random.default_rng(1).bytes(4000))
    assert "cannot be read as a video" in refused(capsys, tmp_path / "noise.mp4", "--site", site)
    assert not site.exists()


def test_names_that_are_not_utf_8_are_refused_before_the_work(
    photos: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """What an old disk or zip leaves: no text of ours, nor of the libraries', can hold such a name."""
    broken = os.fsdecode(b"caf\xe9")
    assert "not UTF-8" in refused(capsys, photos, "--site", tmp_path / broken)
    photo = next(photos.iterdir())
    photo.rename(photos / f"{broken}.jpg")
    words = refused(capsys, photos, "--site", tmp_path / "site")
    assert "caf\\udce9.jpg': a name that is not UTF-8" in words
    assert not (tmp_path / "site").exists()


def test_a_video_without_frames(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "sound.mp4"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("aac", rate=44100)
        sound = av.AudioFrame.from_ndarray(np.zeros((1, 1024), np.float32), "fltp", "mono")
        sound.sample_rate = 44100
        for packet in [*stream.encode(sound), *stream.encode(None)]:
            container.mux(packet)
    assert "no video in it" in refused(capsys, path, "--site", tmp_path / "site")


def test_a_cut_video_is_mapped_as_far_as_it_goes(film: Path, filmed: Path, tmp_path: Path) -> None:
    whole, cut = tmp_path / "whole.mkv", tmp_path / "cut.mkv"
    with av.open(str(film)) as source, av.open(str(whole), "w") as target:
        stream = target.add_stream_from_template(source.streams.video[0])
        for packet in source.demux(source.streams.video[0]):
            if packet.dts is not None:
                packet.stream = stream
                target.mux(packet)
    cut.write_bytes(whole.read_bytes()[: whole.stat().st_size // 2])
    report = mapped(
        tmp_path / "site",
        cut,
        "--telemetry",
        filmed / "flight1" / "flight1.csv",
        "--camera",
        filmed / "camera.xml",
    )
    assert "truncated" in codes(report) and report["frames"]["vision"] >= 3


# ---- telemetry --------------------------------------------------------------------------------------------------


def test_telemetry_that_is_none(
    film: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    telemetry = tmp_path / "log.csv"
    for content, words in (
        (b"", "0 bytes"),
        (np.random.default_rng(1).bytes(3000), "binary"),
        (b"a,b\n1,2\n", "text"),
    ):
        telemetry.write_bytes(content)
        assert words in refused(capsys, film, "--telemetry", telemetry, "--site", tmp_path / "site")


def test_telemetry_of_another_day(
    film: Path, filmed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def earlier(_: int, fields: list[str]) -> None:
        if fields[0] == "GPRMC":
            fields[9] = "010120"

    telemetry = tmp_path / "day.nmea"
    telemetry.write_text(_nmea(filmed, earlier))
    words = refused(capsys, film, "--telemetry", telemetry, "--site", tmp_path / "site")
    assert "no time in common: the log begins 2283 d 1 s before the pictures" in words


def test_a_log_that_is_in_two_places_is_doubted(film: Path, filmed: Path, tmp_path: Path) -> None:
    def away(fix: int, fields: list[str]) -> None:
        if fix < 9:
            place = _latitude(fields)
            fields[place] = f"{float(fields[place]) + 4:.7f}"

    telemetry, site = tmp_path / "two.nmea", tmp_path / "site"
    telemetry.write_text(_nmea(filmed, away))
    report = mapped(site, film, "--telemetry", telemetry, "--camera", filmed / "camera.xml", code=3)
    assert "positions are far from the others and were left out" in report["headline"]["text"]


def test_an_area_of_another_place_is_named(
    film: Path, filmed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    area = tmp_path / "swapped.geojson"  # latitude before longitude
    corners = [[41.892, 12.603], [41.893, 12.603], [41.893, 12.604], [41.892, 12.603]]
    area.write_text(json.dumps({"type": "Polygon", "coordinates": [corners]}))
    log = filmed / "flight1" / "flight1.csv"
    site = tmp_path / "site"
    words = refused(capsys, film, "--telemetry", log, "--area", area, "--site", site)
    assert "begins 4,228 km from flight1; is it the right file, and does it have longitude" in words


def test_a_receiver_that_had_stopped_gives_no_scale(film: Path, tmp_path: Path) -> None:
    """All fixes are one place: the pictures that are laid on them shrink to a point, without any misfit."""
    telemetry = tmp_path / "still.csv"
    rows = [f"{0.2 * k:.1f},41.8923377,12.6032935" for k in range(80)]
    telemetry.write_text("\n".join(["offsetTime,latitude,longitude", *rows]) + "\n")
    report = mapped(tmp_path / "site", film, "--telemetry", telemetry, code=3)
    assert report["headline"]["quality"] == "contradictory"
    assert (
        "its positions are all one place, while the pictures moved on" in report["headline"]["text"]
    )


@pytest.mark.parametrize(
    "above_m, code, is_coarse", [(0.0, 0, False), (40.0, 0, True), (300.0, 3, True)]
)
def test_heights_that_count_from_elsewhere(
    film: Path, filmed: Path, tmp_path: Path, above_m: float, code: int, is_coarse: bool
) -> None:
    """Heights above the sea, say, where those above the take-off belong: they decide the grid, and pull at the scale."""
    telemetry = tmp_path / "log.csv"
    with (filmed / "flight1" / "flight1.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    for row in rows:
        row["relativeHeight"] = f"{float(row['relativeHeight']) + above_m:.2f}"
    with telemetry.open("w", newline="") as file:
        writer = csv.DictWriter(file, rows[0].keys())
        writer.writeheader()
        writer.writerows(rows)
    site = tmp_path / "site"
    camera = filmed / "camera.xml"
    report = mapped(site, film, "--telemetry", telemetry, "--camera", camera, code=code)
    native_m = report["native_ground_sampling_distance_m"]
    assert (f"cm: --gsd {native_m:.2g} maps" in " ".join(report["warnings"])) is is_coarse
    assert ("telemetry's heights give" in report["headline"]["text"]) is (code == 3)


def test_half_written_telemetry_with_lost_jumping_and_backward_fixes(
    film: Path, filmed: Path, tmp_path: Path
) -> None:
    def spoil(fix: int, fields: list[str]) -> None:
        place = _latitude(fields)
        if fix == 3:
            fields[place], fields[place + 2] = "0000.0000000", "00000.0000000"
        if fix == 6:
            fields[place] = f"{float(fields[place]) + 2:.7f}"

    text = _nmea(filmed, spoil)
    lines = text.splitlines(keepends=True)
    telemetry = tmp_path / "spoilt.nmea"
    telemetry.write_text("".join([*lines[:16], *lines[8:10], *lines[16:]])[:-9])
    report = mapped(
        tmp_path / "site", film, "--telemetry", telemetry, "--camera", filmed / "camera.xml"
    )
    words = " ".join(each["text"] for each in report["notices"])
    assert "0/0" in words and "jump" in words and "cut off" in words and "same time" in words
    assert report["frames"]["vision"] == report["frames"]["selected"] > 8


def test_telemetry_of_another_path_at_the_same_time(
    film: Path, filmed: Path, tmp_path: Path
) -> None:
    """Without a reference one place is like another, but the motion does not fit, and the report states it."""
    lines = (filmed / "flight1" / "other" / "flight1.nmea").read_text().splitlines()
    places = [line.split(",") for line in lines]

    def reverse(fix: int, fields: list[str]) -> None:
        other = places[len(places) - 2 - 2 * fix + (fields[0] == "GPRMC")]
        at = _latitude(fields)
        fields[at : at + 4] = other[at : at + 4]

    telemetry = tmp_path / "reversed.nmea"
    telemetry.write_text(_nmea(filmed, reverse))
    camera = ("--camera", filmed / "camera.xml")
    alone = mapped(tmp_path / "alone", film, "--telemetry", telemetry, *camera, code=3)
    assert any("telemetry of this flight" in words for words in alone["warnings"])
    right = mapped(tmp_path / "site", film, *camera)
    assert not right["warnings"]
    again = shutil.copy(
        film, tmp_path / "again.mp4"
    )  # over ground that is known the pictures decide
    command = [
        "map",
        "--model",
        "none",
        again,
        "--telemetry",
        telemetry,
        *camera,
        "--site",
        tmp_path / "site",
    ]
    assert cli.main([*map(str, command)]) == 3, "the map is one to check before use"
    report = json.loads((tmp_path / "site" / "flights" / "again" / "report.json").read_text())
    assert any("disagree by" in words for words in report["warnings"])
    assert report["frames"]["vision"] == report["frames"]["selected"]


def test_a_height_of_zero_is_reported_and_not_used(
    film: Path, filmed: Path, tmp_path: Path
) -> None:
    rows = [
        line.split(",") for line in (filmed / "flight1" / "flight1.csv").read_text().splitlines()
    ]
    zeroed = [
        k for k, name in enumerate(rows[0]) if "alt" in name.lower() or "height" in name.lower()
    ]
    for row in rows[1:]:
        for column in zeroed:
            row[column] = "0.0"
    telemetry = tmp_path / "zero.csv"
    telemetry.write_text("\n".join(",".join(row) for row in rows))
    report = mapped(
        tmp_path / "site", film, "--telemetry", telemetry, "--camera", filmed / "camera.xml"
    )
    assert "height_of_zero" in codes(report)
    assert (
        15 < report["height_above_ground_m"] < 26
    )  # flown at 20 m; found from the pictures and GPS


# ---- cameras and options ----------------------------------------------------------------------------------------


def test_a_broken_calibration(
    film: Path, filmed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    good = (filmed / "camera.xml").read_text()
    camera, site = tmp_path / "camera.xml", tmp_path / "site"
    focal = good.partition("<data>")[2].split()[0]
    for text, words in (
        (good.replace(focal, "0.0"), "focal length"),
        (good.replace("<image_height>180", "<image_height>320"), "320x320"),
        (good.replace(focal, "nan"), "no number"),
        (good[: len(good) // 2], "broken XML"),
    ):
        camera.write_text(text)
        assert words in refused(capsys, film, "--camera", camera, "--site", site)
    assert not site.exists()


@pytest.mark.parametrize(
    ("option", "value", "words"),
    [
        ("--crs", "EPSG:99999", "EPSG:32633"),
        ("--crs", "EPSG:4978", "projected"),
        ("--gsd", "0", "sampling distance"),
        ("--gsd", "nan", "sampling distance"),
        ("--offset", "nan", "seconds"),
        ("--refly", "holes.txt", "not as '.txt'"),
        ("--refly", "nowhere/holes.kml", "there is no folder"),
    ],
)
def test_impossible_options_are_refused_before_the_work(
    film: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    option: str,
    value: str,
    words: str,
) -> None:
    assert words in refused(capsys, film, "--site", tmp_path / "site", option, value)
    assert not (tmp_path / "site").exists()


# ---- photos -----------------------------------------------------------------------------------------------------


def test_photos_of_every_bad_kind_among_good_ones(
    photos: Path, photographed: Path, tmp_path: Path
) -> None:
    files = sorted(photos.iterdir())
    for number in (3, 4):  # turned in the file, upright by its tag
        with Image.open(files[number]) as image:
            exif = image.getexif()
            exif[_ORIENTATION] = 6
            image.transpose(Image.Transpose.ROTATE_90).save(
                files[number], exif=exif, quality=95, xmp=image.info["xmp"]
            )
    with Image.open(files[6]) as image:  # no GPS: saved without any metadata
        image.convert("RGB").save(files[6], quality=95)
    files[7].write_bytes(files[7].read_bytes()[: files[7].stat().st_size // 2])
    files[8].write_bytes(b"junk" * 99)
    shutil.copy(files[9], photos / "ZCOPY.jpg")
    report = mapped(tmp_path / "site", photos, "--camera", photographed / "camera.xml")
    ended = endings(tmp_path / "site")
    assert set(ended) == {path.name for path in photos.iterdir()}
    assert ended["ZCOPY.jpg"] == ("rejected", f"duplicate of {files[9].name}")
    assert all("corrupt" in ended[files[number].name][1] for number in (7, 8))
    assert report["frames"]["vision"] == 10 and report["frames"]["rejected"] == 3


def test_teleporting_fixes_among_photos(photos: Path, photographed: Path, tmp_path: Path) -> None:
    for number in (3, 8):
        path = sorted(photos.iterdir())[number]
        with Image.open(path) as image:
            exif, xmp = image.getexif(), image.info["xmp"]
            gps = exif.get_ifd(_GPS_IFD)
            degrees, minutes, seconds = (float(each) for each in gps[2])
            gps[2] = (degrees, minutes + 1.0, seconds)  # 1.9 km to the north
            start = xmp.index(b'Latitude="') + len(b'Latitude="')
            end = xmp.index(b'"', start)
            moved = b"%.*f" % (end - start - 3, float(xmp[start:end]) + 1 / 60)
            image.save(path, exif=exif, quality=95, xmp=xmp[:start] + moved + xmp[end:])
    report = mapped(tmp_path / "site", photos, "--camera", photographed / "camera.xml")
    assert "jump" in " ".join(each["text"] for each in report["notices"])
    assert report["frames"]["vision"] == 12 and report["gps_residual_m"]["median"] < 0.3
    places = [
        (each["properties"]["camera_latitude_deg"], each["geometry"]["coordinates"][0][0][1])
        for each in json.loads(next(tmp_path.glob("site/flights/*/frames.geojson")).read_text())[
            "features"
        ]
    ]
    assert np.ptp(np.array(places)) * 111_000 < 100  # metres: all together


def test_yaw_that_is_half_a_turn_wrong(photos: Path, photographed: Path, tmp_path: Path) -> None:
    for path in sorted(photos.iterdir())[::2]:
        data = path.read_bytes()
        old = data.partition(b'GimbalYawDegree="')[2].partition(b'"')[0]
        new = f"{float(old) % 360 - 180:+.3f}".encode().ljust(len(old), b"0")[: len(old)]
        path.write_bytes(data.replace(b'GimbalYawDegree="' + old, b'GimbalYawDegree="' + new))
    report = mapped(tmp_path / "site", photos, "--camera", photographed / "camera.xml")
    assert report["frames"]["vision"] == 12 and report["gps_residual_m"]["rms"] < 0.5


def test_photos_that_all_state_0_0_are_mapped_without_a_place(photos: Path, tmp_path: Path) -> None:
    for path in photos.iterdir():
        with Image.open(path) as image:
            exif = image.getexif()
            gps = exif.get_ifd(_GPS_IFD)
            gps[2] = gps[4] = (0.0, 0.0, 0.0)
            image.save(path, exif=exif, quality=95)  # and no XMP
    report = mapped(tmp_path / "site", photos)
    assert not report["georeferenced"] and report["frames"]["vision"] == 12
    assert "12 positions are 0/0" in " ".join(each["text"] for each in report["notices"])


@pytest.mark.parametrize("noise_levels", [0.0, 3.0])
def test_a_gray_video_is_refused_as_without_texture(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], noise_levels: float
) -> None:
    rng = np.random.default_rng(0)
    with av.open(str(tmp_path / "gray.mp4"), "w") as container:
        stream = container.add_stream("libx264", rate=5)
        stream.width, stream.height, stream.pix_fmt = 640, 480, "yuv420p"
        for _ in range(15):
            gray = np.clip(128 + rng.normal(0, noise_levels, (480, 640, 1)), 0, 255).astype(
                np.uint8
            )
            container.mux(
                stream.encode(av.VideoFrame.from_ndarray(np.repeat(gray, 3, axis=2), "rgb24"))
            )
        container.mux(stream.encode(None))
    site = tmp_path / "site"
    assert "no texture" in refused(capsys, tmp_path / "gray.mp4", "--site", site)
    with Archive.open(site, write=False) as archive:
        assert not archive.has_site  # nothing is begun that another flight would have to fit


def test_water_is_placed_by_gps_alone(photos: Path, photographed: Path, tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    files = sorted(photos.iterdir())
    for path in files[5:7]:
        with Image.open(path) as image:
            water = np.clip(rng.normal((40, 90, 120), 2, (180, 320, 3)), 0, 255).astype(np.uint8)
            Image.fromarray(water).save(
                path, exif=image.getexif(), xmp=image.info["xmp"], quality=95
            )
    mapped(tmp_path / "site", photos, "--camera", photographed / "camera.xml", code=3)
    ended = endings(tmp_path / "site")
    assert all(ended[path.name][0] == "gps-only" and ended[path.name][1] for path in files[5:7])
    assert sum(status == "vision" for status, _ in ended.values()) == 10


def test_frames_without_overlap_keep_their_own_fixes(
    photos: Path, photographed: Path, tmp_path: Path
) -> None:
    for path in sorted(photos.iterdir()):
        if path.name not in ("IMG_0001.jpg", "IMG_0007.jpg"):
            path.unlink()
    mapped(tmp_path / "site", photos, "--camera", photographed / "camera.xml", code=3)
    ended = endings(tmp_path / "site")
    assert len(ended) == 2 and all(status != "rejected" for status, _ in ended.values())
    assert "gps-only" in {status for status, _ in ended.values()}


def _pitched(photos: Path, names: list[str], pitch: str) -> None:
    for name in names:
        data = (photos / name).read_bytes()
        old = data.partition(b'GimbalPitchDegree="')[2].partition(b'"')[0]
        new = pitch.encode().ljust(len(old), b"0")[: len(old)]
        (photos / name).write_bytes(
            data.replace(b'GimbalPitchDegree="' + old, b'GimbalPitchDegree="' + new)
        )


def test_a_camera_at_the_horizon(
    photos: Path, photographed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    names = sorted(path.name for path in photos.iterdir())
    _pitched(photos, names[4:6], "-10.0")
    mapped(tmp_path / "some", photos, "--camera", photographed / "camera.xml")
    ended = endings(tmp_path / "some")
    assert all(
        ended[name] == ("rejected", "the camera looks at the horizon") for name in names[4:6]
    )
    assert sum(status == "vision" for status, _ in ended.values()) == 10
    _pitched(photos, names, "-10.0")
    assert "80 deg away from straight down" in refused(capsys, photos, "--site", tmp_path / "all")


# ---- the site folder --------------------------------------------------------------------------------------------


def test_a_site_folder_that_cannot_be_used(
    photos: Path, photographed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").write_text("x")
    assert "folder was needed" in refused(capsys, photos, "--site", tmp_path / "file")
    foreign = tmp_path / "foreign"
    foreign.mkdir()
    (foreign / "letter.txt").write_text("dear")
    assert "no site" in refused(capsys, photos, "--site", foreign)
    assert [path.name for path in foreign.iterdir()] == ["letter.txt"]
    sealed = tmp_path / "sealed"
    sealed.mkdir()
    sealed.chmod(0o500)
    try:
        place = (
            sealed / "site" if os.geteuid() else Path("/proc/sorvolo-site")
        )  # root may write anywhere else
        refused(capsys, photos, "--site", place)
    finally:
        sealed.chmod(0o700)

    site = tmp_path / "site"
    mapped(site, photos, "--camera", photographed / "camera.xml")
    before = (site / "preview.png").read_bytes()
    for path in photos.iterdir():
        with Image.open(path) as image:
            exif = image.getexif()
            exif.get_ifd(_GPS_IFD)[2] = (45.0, 0.0, 0.0)
            image.save(path, exif=exif, quality=95)
    assert "site folder of its own" in refused(capsys, photos, "--site", site)
    assert (site / "preview.png").read_bytes() == before
    with sqlite3.connect(site / "site.db") as connection:
        connection.execute("PRAGMA user_version = 999")
    connection.close()
    assert "version 999" in refused(capsys, photos, "--site", site)


def _command(photos: Path, camera: Path, site: Path) -> list[str]:
    options = ["--model", "none", "--camera", str(camera), "--site", str(site)]
    return [sys.executable, "-m", "sorvolo", "map", str(photos), *options]


def test_a_disk_that_fills_up(photos: Path, photographed: Path, tmp_path: Path) -> None:
    def no_large_files() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (400_000, 400_000))

    site, camera = tmp_path / "site", photographed / "camera.xml"
    result = subprocess.run(
        _command(photos, camera, site),
        capture_output=True,
        text=True,
        timeout=120,
        preexec_fn=no_large_files,
    )
    assert result.returncode == 1 and "Traceback" not in result.stderr
    assert "disk full" in result.stderr.splitlines()[-1]
    assert mapped(site, photos, "--camera", camera)["frames"]["vision"] == 12


@pytest.fixture(scope="module")
def undisturbed(photographed: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The site that a run which nobody kills makes of the first twelve photos."""
    folder = tmp_path_factory.mktemp("undisturbed") / "photos"
    folder.mkdir()
    for photo in sorted((photographed / "flight1" / "photos").glob("*.jpg"))[:12]:
        shutil.copy(photo, folder)
    mapped(folder.with_name("site"), folder, "--camera", photographed / "camera.xml")
    return folder.with_name("site")


def is_the_same(path: Path) -> bool:
    """Whether the file of a site holds nothing of when, and how quickly, it was made."""
    return path.is_file() and not path.name.startswith(("site.", "report."))


@pytest.mark.parametrize(
    "sign",
    [
        pytest.param("site.db", marks=pytest.mark.long),
        "flights/*/keyframes/*/000004.jpg",
        pytest.param("tiles/*/*", marks=pytest.mark.long),
        pytest.param("mosaic.tif", marks=pytest.mark.long),
    ],
)
def test_kill_at_any_moment_and_the_same_command_again(
    photos: Path, photographed: Path, undisturbed: Path, tmp_path: Path, sign: str
) -> None:
    camera, site = photographed / "camera.xml", tmp_path / "site"
    with subprocess.Popen(
        _command(photos, camera, site), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    ) as process:
        deadline = time.monotonic() + 60
        while process.poll() is None and not any(site.glob(sign)) and time.monotonic() < deadline:
            time.sleep(0.005)
        process.send_signal(signal.SIGKILL)
    with Archive.open(site, write=False) as archive:  # readable, of one piece
        assert all(len(tile.shape) == 3 for tile in archive.tiles().values())
        assert len(archive.keyframes()) in (0, 12)
    mapped(site, photos, "--camera", camera)
    again, expected = (
        {
            str(path.relative_to(folder)): path.read_bytes()
            for path in folder.rglob("*")
            if is_the_same(path)
        }
        for folder in (site, undisturbed)
    )
    assert again == expected
    assert not list(site.rglob(".tmp-*"))
    with Archive.open(site, write=False) as archive:
        assert len(archive.flights()) == 1 and len(archive.keyframes()) == 12


def test_a_stop_by_the_keyboard_leaves_no_traceback(
    photos: Path, photographed: Path, tmp_path: Path
) -> None:
    site = tmp_path / "site"
    with subprocess.Popen(
        _command(photos, photographed / "camera.xml", site),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        while process.poll() is None and not any(site.glob("flights/*/keyframes/*/*")):
            time.sleep(0.005)
        process.send_signal(signal.SIGINT)
        _, printed = process.communicate(timeout=60)
    assert process.returncode == 130 and "Traceback" not in printed and "stopped" in printed
    with Archive.open(site, write=False) as archive:
        assert not archive.flights() and not archive.tiles() and not archive.has_site


@pytest.mark.long
def test_a_stop_by_the_keyboard_keeps_the_flights_before(
    photos: Path, photographed: Path, tmp_path: Path
) -> None:
    site, second = tmp_path / "site", tmp_path / "second"
    shutil.copytree(photos, second)
    command = _command(photos, photographed / "camera.xml", site)
    command.insert(command.index(str(photos)) + 1, str(second))
    with subprocess.Popen(
        command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
    ) as process:
        while process.poll() is None and not any(site.glob("flights/second/keyframes/*/*")):
            time.sleep(0.005)
        process.send_signal(signal.SIGINT)
        _, printed = process.communicate(timeout=60)
    assert process.returncode == 130 and "Traceback" not in printed and "stopped" in printed
    assert (site / "mosaic.tif").is_file() and not (site / "flights" / "second").exists()
    with Archive.open(site, write=False) as archive:
        assert [flight.id for flight in archive.flights()] == ["photos"] and len(
            archive.keyframes()
        ) == 12
        assert archive.versions() and archive.tiles()


def test_too_little_memory_is_refused() -> None:
    with pytest.raises(SettingsError, match="memory_mb must be at least 64 MB, got 10"):
        MapSettings(memory_mb=10.0)
