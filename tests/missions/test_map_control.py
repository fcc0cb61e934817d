"""`sorvolo map --gcp`: simulated photos tied to control points, with and without GPS, and files that are wrong."""

import json
import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from pyproj import Transformer

from sorvolo.capture.calibration import camera_from_option
from sorvolo.capture.control_points import read_control_points
from sorvolo.cli import main as cli
from sorvolo.geometry.camera import Camera
from sorvolo.geometry.geodesy import Geodetic, LocalFrame
from sorvolo.geometry.pose import Pose

_UTM = "EPSG:32633"
_GPS_IFD = 0x8825


@dataclass(frozen=True)
class Mark:
    label: str
    place_m: np.ndarray  # (3,) in the site
    x_px: float
    y_px: float
    photo: str


@dataclass(frozen=True)
class Surveyed:
    """Photos and marks of points on their ground, exact to a tenth of a pixel."""

    photos: Path
    camera: Path
    frame: LocalFrame
    marks: tuple[Mark, ...]
    frames: dict[str, Any]

    def write(
        self, path: Path, crs: str = _UTM, change: Callable[[Mark], Mark] = lambda each: each
    ) -> Path:
        transformer = Transformer.from_crs("EPSG:4326", crs, always_xy=True)
        lines = [crs]
        for mark in map(change, self.marks):
            latitude, longitude, height = (
                float(each[0]) for each in self.frame.wgs84_from_site(mark.place_m[None])
            )
            x, y = transformer.transform(longitude, latitude)
            lines.append(
                f"{x:.9f} {y:.9f} {height:.3f} {mark.x_px:.2f} {mark.y_px:.2f} {mark.photo} {mark.label}"
            )
        path.write_text("\n".join(lines) + "\n")
        return path


@pytest.fixture(scope="module")
def surveyed(photographed: Path) -> Surveyed:
    truth = json.loads((photographed / "truth" / "frames.geojson").read_text())
    frame = LocalFrame(Geodetic(**truth["site"]))
    photos = photographed / "flight1" / "photos"
    with Image.open(next(photos.iterdir())) as first:
        width_px, height_px = first.size
    camera = camera_from_option(str(photographed / "camera.xml"), width_px, height_px).camera
    places = [(x, y) for x in (-14.0, -4.0, 6.0, 16.0) for y in (-7.0, 6.0)]
    names = [f"{'CP' if number in (2, 5) else 'G'}{number}" for number in range(len(places))]
    on_ground = {name: np.array([x, y, 0.0]) for name, (x, y) in zip(names, places, strict=True)}
    made = Surveyed(
        photos, photographed / "camera.xml", frame, marks_of(on_ground, camera, truth), truth
    )
    assert len({each.label for each in made.marks}) >= 7
    return made


def marks_of(
    places_m: dict[str, np.ndarray], camera: Camera, truth: dict[str, Any]
) -> tuple[Mark, ...]:
    """Where photos show these places, right to a tenth of a pixel."""
    frame, rng = LocalFrame(Geodetic(**truth["site"])), np.random.default_rng(4)
    marks = []
    for label, place_m in places_m.items():
        for each in truth["features"]:
            known = each["properties"]
            pixel = camera.pixels_from_points(_pose(known, frame).inverse().apply(place_m[None]))[0]
            if (pixel > 5).all() and (pixel < [camera.width_px - 5, camera.height_px - 5]).all():
                marks.append(Mark(label, place_m, *(pixel + rng.normal(0, 0.1, 2)), known["frame"]))
    return tuple(marks)


def _pose(known: dict[str, Any], frame: LocalFrame) -> Pose:
    place = frame.site_from_wgs84(
        *(
            np.array([known[name]])
            for name in ("camera_latitude_deg", "camera_longitude_deg", "camera_height_m")
        )
    )[0]
    return Pose(np.array(known["rotation"]).reshape(3, 3), place)


@pytest.fixture(scope="module")
def blind(surveyed: Surveyed, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same photos without GPS and attitude."""
    folder = tmp_path_factory.mktemp("blind") / "photos"
    folder.mkdir()
    for path in surveyed.photos.glob("*.jpg"):
        with Image.open(path) as picture:
            exif = picture.getexif()
            if _GPS_IFD in exif:
                del exif[_GPS_IFD]
            picture.save(folder / path.name, "JPEG", exif=exif, quality=95)
    return folder


def run(site: Path, photos: Path, surveyed: Surveyed, gcp: Path, *more: str) -> int:
    return cli.main(
        [
            "map",
            str(photos),
            "--site",
            str(site),
            "--model",
            "none",
            "--camera",
            str(surveyed.camera),
            "--gcp",
            str(gcp),
            *more,
        ]
    )


def control_of(site: Path) -> dict[str, Any]:
    return json.loads(next(site.glob("flights/*/report.json")).read_text())["control"]


def absolute_m(site: Path, surveyed: Surveyed) -> float:
    found = json.loads(next(site.glob("flights/*/frames.geojson")).read_text())
    true = {each["properties"]["frame"]: each for each in surveyed.frames["features"]}
    misses = []
    for each in found["features"]:
        pair = [
            np.array(one["geometry"]["coordinates"][0])[:4]
            for one in (each, true[each["properties"]["frame"]])
        ]
        a, b = (surveyed.frame.ground_from_lonlat(ring) for ring in pair)
        misses.append(a - b)
    return float(np.sqrt((np.concatenate(misses) ** 2).sum(axis=1).mean()))


def test_control_alone_places_photos_without_gps(
    surveyed: Surveyed, blind: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    gcp = surveyed.write(tmp_path / "gcp_list.txt")
    assert run(tmp_path / "site", blind, surveyed, gcp, "--check", "CP*") == 0
    control = control_of(tmp_path / "site")
    roles = {each["label"]: each["role"] for each in control["points"]}
    assert all(
        role == ("check" if label.startswith("CP") else "control") for label, role in roles.items()
    )
    assert control["check_rms_m"] < 0.05 and control["control_rms_m"] < 0.05
    assert absolute_m(tmp_path / "site", surveyed) < 0.1
    assert re.search(
        r"flight height .* \d+ m above the ground, by the control points", capsys.readouterr().out
    )
    report = json.loads(next((tmp_path / "site").glob("flights/*/report.json")).read_text())
    assert report["georeferenced"] and report["headline"]["quality"] == "map"
    listed = json.loads(next((tmp_path / "site").glob("flights/*/control.geojson")).read_text())
    assert {each["properties"]["label"] for each in listed["features"]} == set(roles)
    assert "CP2" in next((tmp_path / "site").glob("flights/*/report.html")).read_text()


def test_control_outweighs_fixes_that_lie_beside(surveyed: Surveyed, tmp_path: Path) -> None:
    def shifted(mark: Mark) -> Mark:
        return Mark(
            mark.label, mark.place_m + np.array([7.0, -4.0, 0.0]), mark.x_px, mark.y_px, mark.photo
        )

    gcp = surveyed.write(tmp_path / "gcp_list.txt", change=shifted)
    assert run(tmp_path / "site", surveyed.photos, surveyed, gcp, "--check", "CP2,CP5") == 0
    control = control_of(tmp_path / "site")
    assert control["check_rms_m"] < 0.05 and not control["excluded"]
    assert absolute_m(tmp_path / "site", surveyed) == pytest.approx(np.hypot(7, 4), abs=0.1)


@pytest.mark.parametrize("has_gps", [True, False], ids=["GPS", "no GPS"])
def test_a_point_that_contradicts_the_others_is_named_and_left_out(
    surveyed: Surveyed,
    blind: Path,
    tmp_path: Path,
    has_gps: bool,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def wrong(mark: Mark) -> Mark:
        off = np.array([3.0, 0.0, 0.0]) * (mark.label == "G3")
        return Mark(mark.label, mark.place_m + off, mark.x_px, mark.y_px, mark.photo)

    gcp = surveyed.write(tmp_path / "gcp_list.txt", change=wrong)
    assert run(tmp_path / "site", surveyed.photos if has_gps else blind, surveyed, gcp) == 0
    control = control_of(tmp_path / "site")
    assert control["excluded"] == ["G3"]
    (row,) = (each for each in control["points"] if each["label"] == "G3")
    assert row["east_m"] == pytest.approx(-3.0, abs=0.15) and row["north_m"] == pytest.approx(
        0.0, abs=0.15
    )
    assert control["control_rms_m"] < 0.05 and "G3" in capsys.readouterr().out


def test_two_points_whose_places_are_exchanged_are_named_and_left_out(
    surveyed: Surveyed, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    place_m = {each.label: each.place_m for each in surveyed.marks}
    other = {"G0": "G6", "G6": "G0"}

    def swapped(mark: Mark) -> Mark:
        return Mark(
            mark.label, place_m[other.get(mark.label, mark.label)], mark.x_px, mark.y_px, mark.photo
        )

    gcp = surveyed.write(tmp_path / "gcp_list.txt", change=swapped)
    assert run(tmp_path / "site", surveyed.photos, surveyed, gcp) == 0
    control = control_of(tmp_path / "site")
    assert sorted(control["excluded"]) == ["G0", "G6"]
    assert control["control_rms_m"] < 0.05 and absolute_m(tmp_path / "site", surveyed) < 0.2
    assert "G0" in capsys.readouterr().out


@pytest.mark.long
def test_heights_of_points_in_feet_are_named(surveyed: Surveyed, tmp_path: Path) -> None:
    """Points on roofs and poles: heights in metres fit, in feet they do not, and the report states which was meant."""
    with Image.open(next(surveyed.photos.iterdir())) as first:
        camera = camera_from_option(str(surveyed.camera), *first.size).camera
    up_m = dict(
        zip(
            sorted({each.label for each in surveyed.marks}),
            (0.0, 2.5, 0.5, 3.0, 1.0, 4.0, 0.0, 1.5),
        )
    )
    places_m = {
        each.label: np.array([*each.place_m[:2], up_m[each.label]]) for each in surveyed.marks
    }
    raised = replace(surveyed, marks=marks_of(places_m, camera, surveyed.frames))

    def in_feet(mark: Mark) -> Mark:
        return replace(mark, place_m=mark.place_m / (1.0, 1.0, 0.3048))

    for name, change, words in (
        ("metres", lambda mark: mark, ""),
        ("feet", in_feet, "fit far better as feet"),
    ):
        gcp = raised.write(tmp_path / f"{name}.txt", change=change)
        assert run(tmp_path / name, raised.photos, raised, gcp) == 0
        report = json.loads(next((tmp_path / name).glob("flights/*/report.json")).read_text())
        missed = [each for each in report["warnings"] if "the control points miss the map" in each]
        assert len(missed) == bool(words) and all(words in each for each in missed), report[
            "warnings"
        ]
        rms_m = report["control"]["control_rms_m"]
        assert report["sigma_m"] > 0.5 * rms_m, "what the points show is in the stated accuracy"


def exchanged(text: str, first: int, second: int) -> str:
    """The lines with two columns exchanged."""
    head, *rows = text.splitlines()
    cells = [row.split() for row in rows]
    for row in cells:
        row[first], row[second] = row[second], row[first]
    return "\n".join([head, *(" ".join(row) for row in cells)])


@pytest.mark.parametrize("words", ["WGS84 UTM 33T", "EPSG:32633+5773"])
def test_other_names_of_a_crs_place_the_points_alike(
    surveyed: Surveyed, tmp_path: Path, words: str
) -> None:
    gcp = surveyed.write(tmp_path / "gcp_list.txt")
    expected = read_control_points(gcp).control
    gcp.write_text(gcp.read_text().replace(_UTM, words))
    control = read_control_points(gcp).control
    assert control.points == expected.points
    assert control.crs.endswith("+ EGM96 height)" if "+" in words else "/ UTM zone 33N)")


@pytest.mark.parametrize("has_gps", [True, False], ids=["GPS", "no GPS"])
@pytest.mark.parametrize(
    "crs, change, words",
    [
        ("EPSG:4326", lambda text: exchanged(text, 0, 1), "x and y are exchanged"),
        (_UTM, lambda text: exchanged(text, 0, 1), "x and y are exchanged"),
        (_UTM, lambda text: text.replace(_UTM, "EPSG:32632"), "UTM zone 33N"),
        (
            _UTM,
            lambda text: "\n".join(re.findall(".*(?:33|G0|G1)$", text, re.M)),
            "2 control points are marked",
        ),
        (_UTM, lambda text: text.replace(".jpg", "_of_another_day.jpg"), "none of its pictures"),
        (_UTM, lambda text: text.replace(_UTM, "Gauss"), "no CRS"),
        (
            _UTM,
            lambda text: text.replace(_UTM, "+proj=pipeline +nadgrids=@/etc/passwd"),
            "nadgrids",
        ),
        (
            _UTM,
            lambda text: text.replace(_UTM, "+proj=tmerc +lon_0=15 +k=0.9996 +ellps=intl"),
            "no datum",
        ),
        (_UTM, lambda text: text.replace(" G0", " G0\nhalf a line"), "columns"),
        (_UTM, lambda text: exchanged(text, 3, 4), "px and py"),
        (
            "EPSG:4326",
            lambda text: text.replace("EPSG:4326", _UTM),
            "x and y are degrees (longitude, latitude)",
        ),
        (_UTM, lambda text: text.replace(_UTM, "EPSG:4326"), "for metres name their CRS, as"),
        ("EPSG:3857", lambda text: text.replace("EPSG:3857", _UTM), "web maps (EPSG:3857)"),
        ("+proj=utm +zone=33 +units=ft", lambda text: text.replace(" +units=ft", ""), "in feet"),
    ],
)
def test_a_wrong_file_ends_in_one_clear_error(
    surveyed: Surveyed,
    blind: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    has_gps: bool,
    crs: str,
    change: Callable[[str], str],
    words: str,
) -> None:
    if words in ("UTM zone 33N", "web maps (EPSG:3857)", "in feet") and not has_gps:
        pytest.skip("nothing shows a wrong zone or scale where there is no GPS")
    gcp = surveyed.write(tmp_path / "gcp_list.txt", crs)
    gcp.write_text(change(gcp.read_text()))
    assert run(tmp_path / "site", surveyed.photos if has_gps else blind, surveyed, gcp) == 1
    error = capsys.readouterr().err
    assert words in error and error.count("error:") == 1
    assert not (tmp_path / "site" / "mosaic.tif").exists()


@pytest.mark.parametrize(
    "more, words",
    [
        (["--check", "X9"], "no such control point"),
        (["--check", "G*,CP2"], "at least 3"),
        (["--method", "thesis"], "method planar only"),
        (["--gcp-accuracy", "0"], "--gcp-accuracy"),
    ],
)
def test_options_that_cannot_be_are_refused(
    surveyed: Surveyed,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    more: list[str],
    words: str,
) -> None:
    gcp = surveyed.write(tmp_path / "gcp_list.txt")
    assert run(tmp_path / "site", surveyed.photos, surveyed, gcp, *more) == 1
    assert words in capsys.readouterr().err
