"""`sorvolo map` from end to end on small simulated flights, against their truth."""

import json
import shutil
from collections import Counter
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
import rasterio
from PIL import Image
from pyproj import Transformer

from sorvolo.capture.source import open_sources
from sorvolo.cli import main as cli
from sorvolo.geometry.geodesy import Geodetic, LocalFrame
from sorvolo.geometry.homography import apply_homography, fit_similarity
from sorvolo.lab.thesis.mapping import ThesisMapping
from sorvolo.lab.thesis.stitching import RoiStitchingSettings
from sorvolo.missions.flight.settings import MapSettings
from sorvolo.missions.flight.setup import prepare
from sorvolo.missions.map.flights import map_flights
from sorvolo.missions.map.ground import MapGround
from sorvolo.missions.map.planar_run import PlanarRun
from sorvolo.missions.site.history import site_history
from sorvolo.store.exports.plain import features_path
from sorvolo.store.site.archive import Archive
from sorvolo.survey.flight import Frame, PosedFrame
from sorvolo.survey.mosaic import Status

_M_PER_PX = 0.075  # of the simulated pictures
_SHAPE_M = 0.05  # as far as a map's shape may be off, usually: less than a pixel
_PROPERTIES = {
    "frame",
    "time",
    "status",
    "reason",
    "camera_longitude_deg",
    "camera_latitude_deg",
    "camera_height_m",
    "height_above_ground_m",
    "residual_px",
    "sigma_m",
}


def run_map(site: Path, *arguments: str | Path) -> None:
    assert cli.main(["map", "--model", "none", *map(str, arguments), "--site", str(site)]) == 0


def report_of(site: Path, flight: str) -> dict[str, Any]:
    return json.loads((site / "flights" / flight / "report.json").read_text())


def frames_of(site: Path, flight: str) -> dict[str, Any]:
    return json.loads(features_path(site / "flights" / flight, "frames").read_text())


def corner_errors_m(site: Path, flight: str, truth: Path) -> tuple[float, float]:
    """Root mean square corner error: absolute, and of the shape, after the best similarity onto the truth."""
    true = json.loads((truth / "frames.geojson").read_text())
    frame = LocalFrame(Geodetic(**true["site"]))
    expected = {each["properties"]["frame"]: _corners_m(each, frame) for each in true["features"]}
    pairs = [
        (_corners_m(each, frame), expected[each["properties"]["frame"]])
        for each in frames_of(site, flight)["features"]
        if each["geometry"] is not None
    ]
    found_m, true_m = (np.concatenate([pair[k] for pair in pairs]) for k in (0, 1))
    moved_m = apply_homography(fit_similarity(true_m, found_m), found_m)
    return _rms_m(found_m - true_m), _rms_m(moved_m - true_m)


def _corners_m(feature: dict[str, Any], frame: LocalFrame) -> np.ndarray:
    lonlat = np.array(feature["geometry"]["coordinates"][0])[:4]
    return frame.site_from_wgs84(lonlat[:, 1], lonlat[:, 0], np.full(4, frame.origin.height_m))[
        :, :2
    ]


def _rms_m(errors_m: np.ndarray) -> float:
    return float(np.sqrt((errors_m**2).sum(axis=1).mean()))


def _film(filmed: Path) -> Path:
    return filmed / "flight1" / "flight1.mp4"


def _telemetry(filmed: Path, name: str) -> Path:
    return filmed / "flight1" / (name if name.endswith("csv") else f"other/{name}")


def _some_photos(photographed: Path, folder: Path, start: int, end: int) -> Path:
    folder.mkdir()
    for photo in sorted((photographed / "flight1" / "photos").glob("*.jpg"))[start:end]:
        shutil.copy(photo, folder)
    return folder


# The telemetry's height decides the map's scale where only it does; seen against the 7.5 cm of a pixel.
@pytest.mark.parametrize(
    "name",
    [
        "flight1.csv",
        pytest.param("flight1.nmea", marks=pytest.mark.long),  # a fix a second, as GPX
        "flight1.srt",
        "flight1.gpx",
    ],
)
def test_a_video_with_telemetry_of_each_format(filmed: Path, tmp_path: Path, name: str) -> None:
    site = tmp_path / "site"
    run_map(
        site,
        _film(filmed),
        "--telemetry",
        _telemetry(filmed, name),
        "--camera",
        filmed / "camera.xml",
    )
    report = report_of(site, "flight1")
    assert (
        report["georeferenced"] and report["frames"]["vision"] == report["frames"]["selected"] > 8
    )
    assert "2.5 s apart" in report["reading"]["whole_because"] and not report["reading"]["skipped"]
    absolute_m, shape_m = corner_errors_m(site, "flight1", filmed / "truth")
    assert shape_m < _SHAPE_M
    assert (
        absolute_m < 0.6
    )  # 1 Hz formats interpolate a fix from two that are 5 m apart, turns included
    seconds = report["seconds"]  # every one is counted, up to the report itself
    assert set(seconds) == {"total", "undistort", "register", "paint", "store", "report"}
    assert seconds["total"] >= sum(value for name, value in seconds.items() if name != "total")


def test_a_video_is_mapped_by_the_key_frames_of_its_stream(
    keyed: Path, filmed: Path, tmp_path: Path
) -> None:
    site, again = tmp_path / "site", tmp_path / "again.kml"
    run_map(site, keyed, "--camera", filmed / "camera.xml", "--refly", again)
    report = report_of(site, "flight1")
    assert report["seen"]["holes"] == 0 and report["seen"]["seen_m2"] > 400 and not again.exists()
    assert report["frames"]["vision"] == report["frames"]["selected"] > 8
    reading = report["reading"]
    assert not reading["whole_because"]
    assert (
        reading["decoded"] + reading["skipped"]
        == report["frames"]["total"]
        < 3.5 * reading["skipped"]
    )
    absolute_m, shape_m = corner_errors_m(site, "flight1", filmed / "truth")
    assert shape_m < _SHAPE_M and absolute_m < 0.6
    assert (
        f"{reading['skipped']} skipped"
        in (site / "flights" / "flight1" / "report.html").read_text()
    )


def test_holes_are_shown_and_planned_while_the_flight_goes_on(
    keyed: Path, filmed: Path, tmp_path: Path
) -> None:
    origin = json.loads((filmed / "truth" / "frames.geojson").read_text())["site"]
    longitude, latitude = origin["longitude_deg"], origin["latitude_deg"]
    east, north = 80 / 111_320 / np.cos(np.radians(latitude)), 80 / 111_320
    corners = [(-1, -1), (1, -1), (1, 1), (-1, 1), (-1, -1)]
    ring = [[longitude + east * x, latitude + north * y] for x, y in corners]
    area, again, site = tmp_path / "area.geojson", tmp_path / "again.geojson", tmp_path / "site"
    area.write_text(json.dumps({"type": "Polygon", "coordinates": [ring]}))
    holes_m2 = []
    settings = MapSettings(model="none", live_s=0.0)
    for _ in map_flights(
        [keyed], site, settings, camera=filmed / "camera.xml", area=area, refly=[again]
    ):
        if (live := site / "live-coverage.geojson").exists():
            parts = [each["properties"] for each in json.loads(live.read_text())["features"]]
            holes_m2.append(sum(each["area_m2"] for each in parts if each["status"] == "hole"))
            assert again.exists() and {
                each["views"] for each in parts if each["status"] == "seen"
            } <= {1, 2, 3, 5}
    assert len(holes_m2) > 5 and holes_m2[-1] < holes_m2[0] - 200
    assert not live.exists()
    found = json.loads((site / "flights" / "flight1" / "coverage.geojson").read_text())["features"]
    total_m2 = sum(each["properties"]["area_m2"] for each in found)
    assert total_m2 == pytest.approx(160 * 160, rel=0.05)  # the flight lies in the area
    seen = report_of(site, "flight1")["seen"]
    assert seen["holes"] == 1 and seen["m_per_px"] == pytest.approx(_M_PER_PX, rel=0.3)
    assert seen["refly"] == [str(again)]
    (path, *_) = json.loads(again.read_text())["features"]
    outline = np.array(ring)
    lonlat = np.array(path["geometry"]["coordinates"])
    assert len(lonlat) > 4
    assert (lonlat > outline.min(axis=0) - 2e-4).all() and (
        lonlat < outline.max(axis=0) + 2e-4
    ).all()


@pytest.mark.long
def test_a_video_that_looks_ahead_by_half_a_right_angle(oblique: Path, tmp_path: Path) -> None:
    site, flight = tmp_path / "site", oblique / "flight1"
    run_map(site, flight / "flight1.mp4", "--camera", oblique / "camera.xml")
    report = report_of(site, "flight1")
    assert report["frames"]["vision"] == report["frames"]["selected"] > 8 and not report["warnings"]
    absolute_m, shape_m = corner_errors_m(site, "flight1", oblique / "truth")
    # The far corners lie 60 m off, where a pixel covers 30 cm: over draws of the camera's noise 1 to 11 cm.
    assert shape_m < 4 * _SHAPE_M and absolute_m < 0.4
    blind = [
        shutil.copy(flight / "flight1.mp4", tmp_path),  # away from its camera's file
        "--telemetry",
        str(flight / "other" / "flight1.gpx"),
        "--model",
        "none",
    ]
    # pictures that look to opposite sides are not tied: a map to check
    assert cli.main(["map", *blind, "--site", str(tmp_path / "blind")]) == 3
    headline = report_of(tmp_path / "blind", "flight1")["headline"]["text"]
    assert headline.startswith("a map to check before use: ")
    (warning,) = (
        each
        for each in report_of(tmp_path / "blind", "flight1")["warnings"]
        if "straight down" in each
    )
    told_deg = float(warning.split(" deg")[0].rpartition(" ")[2])
    assert told_deg == pytest.approx(45, abs=10) and "angles" in warning


def test_an_oblique_video_is_recognised_by_its_pictures_alone(
    oblique: Path, tmp_path: Path
) -> None:
    """Without any telemetry the perspective between the pictures shows how far the camera looks from straight down."""
    shutil.copy(_film(oblique), tmp_path)
    run_map(tmp_path / "site", tmp_path / "flight1.mp4", "--camera", oblique / "camera.xml")
    (warning,) = straight_down_warnings(tmp_path / "site", "flight1")
    assert float(warning.split(" deg")[0].rpartition(" ")[2]) == pytest.approx(45, abs=10)
    assert "there is no telemetry" in warning


def straight_down_warnings(site: Path, flight: str) -> list[str]:
    return [each for each in report_of(site, flight)["warnings"] if "straight down" in each]


def test_a_clock_offset_is_found_from_motion_or_taken_as_given(
    filmed: Path, tmp_path: Path
) -> None:
    lines = _telemetry(filmed, "flight1.csv").read_text().splitlines()
    late = tmp_path / "late.csv"
    late.write_text(
        "\n".join([lines[0], *lines[9:]])
    )  # at 10 Hz: what is tied to the first frame is 0.8 s late
    common = (_film(filmed), "--telemetry", late, "--camera", filmed / "camera.xml")
    run_map(tmp_path / "found", *common)
    found = report_of(tmp_path / "found", "flight1")["time_offset"]
    assert found["origin"] == "estimated" and found["applied_s"] == pytest.approx(-0.8, abs=0.12)
    run_map(tmp_path / "given", *common, "--offset", "-0.8")
    given = report_of(tmp_path / "given", "flight1")["time_offset"]
    assert given["origin"] == "given" and given["applied_s"] == -0.8
    for site in ("found", "given"):
        assert corner_errors_m(tmp_path / site, "flight1", filmed / "truth")[0] < 0.5


def test_photos_whose_fixes_lag_are_put_where_their_motion_shows(
    lagging: Path, tmp_path: Path
) -> None:
    run_map(tmp_path / "site", lagging / "flight1" / "photos", "--camera", lagging / "camera.xml")
    offset = report_of(tmp_path / "site", "photos")["time_offset"]
    assert offset["origin"] == "estimated" and offset["applied_s"] == pytest.approx(0.4, abs=0.1)
    assert (
        corner_errors_m(tmp_path / "site", "photos", lagging / "truth")[0] < 0.3
    )  # the lag alone is 2 m


def test_a_video_without_telemetry_is_mapped_in_a_frame_of_its_own(
    filmed: Path, tmp_path: Path
) -> None:
    alone = tmp_path / "alone"
    alone.mkdir()
    shutil.copy(_film(filmed), alone)
    site = tmp_path / "site"
    run_map(site, alone / "flight1.mp4")
    report, frames = report_of(site, "flight1"), frames_of(site, "flight1")
    assert not report["georeferenced"] and frames["crs"] is None
    assert "no_telemetry" in {each["code"] for each in report["notices"]}
    assert report["frames"]["vision"] >= 0.9 * report["frames"]["selected"]
    with rasterio.open(site / "mosaic.tif") as mosaic:
        assert mosaic.crs is None
    for kind in ("kmz", "geojson", "kml", "gpx"):  # these hold places on Earth
        assert not list(site.rglob(f"*.{kind}"))
    assert "no GPS" in frames["note"]


def test_telemetry_that_ends_before_the_video(filmed: Path, tmp_path: Path) -> None:
    lines = _telemetry(filmed, "flight1.csv").read_text().splitlines()
    short = tmp_path / "short.csv"
    short.write_text("\n".join(lines[: 1 + len(lines) // 2]))
    site = tmp_path / "site"
    run_map(site, _film(filmed), "--telemetry", short, "--camera", filmed / "camera.xml")
    frames = report_of(site, "flight1")["frames"]
    assert frames["vision"] == frames["selected"] > 8  # found again by what they show
    assert corner_errors_m(site, "flight1", filmed / "truth")[1] < 2 * _SHAPE_M


def test_photos_and_what_frames_geojson_states_of_them(photographed: Path, tmp_path: Path) -> None:
    site, photos = tmp_path / "site", photographed / "flight1" / "photos"
    run_map(site, photos, "--camera", photographed / "camera.xml")
    absolute_m, shape_m = corner_errors_m(site, "photos", photographed / "truth")
    assert absolute_m < 2 * _SHAPE_M and shape_m < _SHAPE_M
    frames = frames_of(site, "photos")
    names = [each["properties"]["frame"] for each in frames["features"]]
    assert sorted(names) == sorted(path.name for path in photos.iterdir())
    text = (site / "flights" / "photos" / "frames.geojson").read_text()
    true = json.loads((photographed / "truth" / "frames.geojson").read_text())
    expected = {
        each["properties"]["frame"]: each["geometry"]["coordinates"][0] for each in true["features"]
    }
    decimals: list[int] = []
    for feature in frames["features"]:
        assert set(feature["properties"]) >= _PROPERTIES
        assert feature["properties"]["status"] == "vision" and feature["properties"]["reason"] == ""
        (ring,) = feature["geometry"]["coordinates"]
        assert len(ring) == 5 and ring[0] == ring[4]
        # top-left, top-right, bottom-right, bottom-left: each is nearest to the truth's corner of that name
        distances = np.linalg.norm(
            np.array(ring[:4])[:, None]
            - np.array(expected[feature["properties"]["frame"]][:4])[None],
            axis=2,
        )
        assert list(distances.argmin(axis=1)) == [0, 1, 2, 3]
        decimals += [len(f"{x!r}".partition(".")[2]) for point in ring for x in point]
    assert np.mean(np.array(decimals) >= 9) > 0.8  # one in ten ends in a nought
    assert "NaN" not in text and "Infinity" not in text


def test_mosaic_tif_opens_in_its_place(photographed: Path, tmp_path: Path) -> None:
    site, photos = tmp_path / "site", photographed / "flight1" / "photos"
    run_map(site, photos, "--camera", photographed / "camera.xml", "--gsd", "0.1")
    truth = rasterio.open(photographed / "truth" / "ground.tif")
    with rasterio.open(site / "mosaic.tif") as mosaic, truth:
        assert mosaic.crs.to_epsg() == truth.crs.to_epsg() == 32633
        assert mosaic.count == 4 and mosaic.colorinterp[3].name == "alpha"
        assert mosaic.overviews(1) and mosaic.profile["tiled"]
        assert mosaic.res == pytest.approx((0.1, 0.1))
        rgba = mosaic.read()
        rows, columns = np.nonzero(rgba[3] == 255)
        east_m, north_m = mosaic.transform @ (columns + 0.5, rows + 0.5)
        found = rgba[:3, rows, columns].mean(axis=0)
        ground = truth.read([1, 2, 3]).mean(axis=0)
        scores = {}
        for shift in [(x, y) for x in (-0.2, -0.1, 0, 0.1, 0.2) for y in (-0.2, -0.1, 0, 0.1, 0.2)]:
            x, y = ~truth.transform @ (east_m + shift[0], north_m + shift[1])
            at = np.floor(y).astype(int), np.floor(x).astype(int)
            scores[shift] = np.corrcoef(found, ground[at])[0, 1]
    best = max(scores, key=lambda shift: scores[shift])
    assert np.hypot(*best) <= 0.1 and scores[best] > 0.6  # metres: one pixel of the map


def test_another_crs_for_the_map(photographed: Path, tmp_path: Path) -> None:
    crs, epsg = "EPSG:3857", 3857
    photos = _some_photos(photographed, tmp_path / "few", 0, 6)
    site = tmp_path / "site"
    run_map(site, photos, "--camera", photographed / "camera.xml", "--crs", crs)
    place = frames_of(site, "few")["features"][2]["properties"]
    with rasterio.open(site / "mosaic.tif") as mosaic:
        assert mosaic.crs.to_epsg() == epsg
        x, y = Transformer.from_crs(4326, epsg, always_xy=True).transform(
            place["camera_longitude_deg"], place["camera_latitude_deg"]
        )
        assert next(mosaic.sample([(x, y)]))[3] == 255


def test_frames_outside_the_area_are_not_used(photographed: Path, tmp_path: Path) -> None:
    true = json.loads((photographed / "truth" / "frames.geojson").read_text())
    longitude = {
        each["properties"]["frame"]: each["properties"]["camera_longitude_deg"]
        for each in true["features"]
    }
    latitude = [each["properties"]["camera_latitude_deg"] for each in true["features"]]
    middle, low, high = (
        float(np.median(list(longitude.values()))),
        min(latitude) - 1e-3,
        max(latitude) + 1e-3,
    )
    ring = [
        [middle, low],
        [middle + 1e-2, low],
        [middle + 1e-2, high],
        [middle, high],
        [middle, low],
    ]
    area = tmp_path / "area.kml"
    area.write_text(
        '<kml xmlns="http://www.opengis.net/kml/2.2"><Placemark><Polygon><outerBoundaryIs><LinearRing><coordinates>'
        + " ".join(f"{x!r},{y!r},0" for x, y in ring)
        + "</coordinates></LinearRing></outerBoundaryIs></Polygon></Placemark></kml>"
    )
    site = tmp_path / "site"
    run_map(
        site,
        photographed / "flight1" / "photos",
        "--camera",
        photographed / "camera.xml",
        "--area",
        area,
    )
    used = {
        each["properties"]["frame"]
        for each in frames_of(site, "photos")["features"]
        if each["properties"]["status"] != "rejected"
    }
    well_inside = {name for name, where in longitude.items() if where > middle + 5e-6}
    well_outside = {name for name, where in longitude.items() if where < middle - 5e-6}
    assert well_inside <= used and not well_outside & used and well_inside and well_outside


@pytest.mark.parametrize(
    ("transform", "drifts"),
    [("similarity", True), pytest.param("homography", False, marks=pytest.mark.long)],
)
def test_the_thesis_method(
    photographed: Path,
    tmp_path: Path,
    transform: Literal["similarity", "homography"],
    drifts: bool,
) -> None:
    photos = _some_photos(photographed, tmp_path / "few", 0, 7)
    for photo in sorted(photos.iterdir())[4:] if drifts else []:
        with Image.open(photo) as taken:
            darker = taken.point(lambda level: level * 0.6)
            darker.save(photo, exif=taken.getexif(), xmp=taken.info.get("xmp", b""))
    site = tmp_path / "site"
    stitching = RoiStitchingSettings(transform=transform, max_features=3000)
    settings = MapSettings(ThesisMapping(stitching), model="none", live_s=0)
    updates = list(map_flights([photos], site, settings, camera=photographed / "camera.xml"))
    report = report_of(site, "few")
    assert sum(each.tiles_touched for each in updates)  # while the flight goes on
    assert (
        report["method"] == "thesis"
        and report["settings"]["method"]["stitching"]["transform"] == transform
    )
    assert report["frames"]["vision"] == 7
    assert ("brightness_drifts" in {each["code"] for each in report["notices"]}) == drifts
    assert corner_errors_m(site, "few", photographed / "truth")[1] < 1.0  # metres: its own ceiling


def test_stored_frames_of_a_coarse_map_lie_where_the_frames_do(
    photographed: Path, tmp_path: Path
) -> None:
    photos = _some_photos(photographed, tmp_path / "few", 0, 6)
    site = tmp_path / "site"
    run_map(site, photos, "--camera", photographed / "camera.xml", "--gsd", "0.2")
    with Archive.open(site, write=False) as archive:
        frame = archive.site().frame
        outlines = {
            each["properties"]["frame"]: _corners_m(each, frame)
            for each in frames_of(site, "few")["features"]
        }
        for keyframe in archive.keyframes():
            assert archive.image(keyframe).shape[1] == keyframe.camera.width_px < 240
            centre_m = apply_homography(keyframe.site_from_image, keyframe.camera.corners_px).mean(
                axis=0
            )
            assert (
                np.linalg.norm(centre_m - outlines[keyframe.name].mean(axis=0)) < 0.2
            )  # metres: one pixel


def test_a_second_flight_extends_the_map_and_leaves_the_first_in_its_place(
    photographed: Path, tmp_path: Path
) -> None:
    first = _some_photos(photographed, tmp_path / "first", 0, 9)
    second = _some_photos(photographed, tmp_path / "second", 5, 16)
    site = tmp_path / "site"
    run_map(site, first, "--camera", photographed / "camera.xml")
    before = (site / "flights" / "first" / "frames.geojson").read_bytes()
    with Archive.open(site, write=False) as archive:
        tiles = dict(archive.tiles().items())
    run_map(site, second, "--camera", photographed / "camera.xml")
    assert (site / "flights" / "first" / "frames.geojson").read_bytes() == before
    with Archive.open(site, write=False) as archive:
        extended = dict(archive.tiles().items())
        assert [flight.id for flight in archive.flights()] == ["first", "second"]
    assert sum(int((tile[..., 3] > 0).sum()) for tile in extended.values()) > 1.1 * sum(
        int((tile[..., 3] > 0).sum()) for tile in tiles.values()
    )
    for index, tile in tiles.items():
        known = tile[..., 3] == 255
        assert np.array_equal(extended[index][known], tile[known])
    assert corner_errors_m(site, "second", photographed / "truth")[0] < 3 * _SHAPE_M


def test_the_same_flight_again_doubles_nothing(
    photographed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    photos = _some_photos(photographed, tmp_path / "few", 0, 8)
    site = tmp_path / "site"
    run_map(site, photos, "--camera", photographed / "camera.xml")
    frames = frames_of(site, "few")["features"]
    written = {path: path.read_bytes() for path in site.rglob("*") if path.is_file()}
    run_map(site, photos, "--camera", photographed / "camera.xml")
    assert "few is mapped already (20" in capsys.readouterr().err
    assert written == {path: path.read_bytes() for path in site.rglob("*") if path.is_file()}
    run_map(site, photos, "--camera", photographed / "camera.xml", "--again")
    assert frames_of(site, "few")["features"] == frames
    unlike = {
        path.name for path, data in written.items() if path.is_file() and path.read_bytes() != data
    }
    assert unlike == {
        "site.db",
        "report.json",
        "report.html",
    }  # which hold when it was made, and how quickly
    with Archive.open(site, write=False) as archive:
        assert len(archive.flights()) == 1 and len(archive.keyframes()) == 8
    (notice,) = [each for each in report_of(site, "few")["notices"] if each["code"] == "repeated"]
    assert "few is in this site already (version 1): it was mapped again" in notice["text"]


def test_the_same_flight_under_another_name_is_named_and_a_map_dated_by_its_flight(
    photographed: Path, tmp_path: Path
) -> None:
    site = tmp_path / "site"
    for name in ("few", "card2"):
        run_map(
            site,
            _some_photos(photographed, tmp_path / name, 0, 4),
            "--camera",
            photographed / "camera.xml",
        )
    assert not [each for each in report_of(site, "few")["notices"] if each["code"] == "same_flight"]
    (notice,) = [
        each for each in report_of(site, "card2")["notices"] if each["code"] == "same_flight"
    ]
    assert notice["text"].startswith(
        "card2 begins with the same bytes as few, which is in this site already (ver"
    )
    frames = json.loads((photographed / "truth" / "frames.geojson").read_text())["features"]
    for version in site_history(site):
        assert version.flown_utc[:19] == frames[0]["properties"]["time"][:19]
        assert version.flown_utc[:10] != version.date_utc[:10]


def test_the_map_does_not_depend_on_when_it_was_shown_while_it_grew(
    filmed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    film = tmp_path / "film.mp4"
    shutil.copy(
        _film(filmed), film
    )  # without telemetry, whose offsets would move every frame at last
    maps = []
    for paint_every in (1, 1000):  # keyframes
        monkeypatch.setattr("sorvolo.missions.map.painting._EVERY", paint_every)
        monkeypatch.setattr("sorvolo.missions.map.painting.REST", 0)
        run_map(tmp_path / f"every {paint_every}", film, "--camera", filmed / "camera.xml")
        maps.append((tmp_path / f"every {paint_every}" / "mosaic.tif").read_bytes())
        assert not straight_down_warnings(tmp_path / f"every {paint_every}", "film")
    assert maps[0] == maps[1]


def test_every_selected_frame_ends_once_with_a_reason_unless_by_vision(
    filmed: Path, tmp_path: Path
) -> None:
    site = tmp_path / "site"
    settings = MapSettings(overlap=0.5, model="none")
    list(map_flights([_film(filmed)], site, settings, camera=filmed / "camera.xml"))
    frames, counted = frames_of(site, "flight1")["features"], report_of(site, "flight1")["frames"]
    assert max(Counter(each["properties"]["frame"] for each in frames).values()) == 1
    assert len(frames) == counted["selected"]
    for each in frames:
        assert (each["properties"]["status"] == "vision") or each["properties"]["reason"]
        assert (each["geometry"] is None) == (each["properties"]["status"] == "rejected")


def test_a_planar_run_paints_through_a_writer_that_another_began(
    photographed: Path, tmp_path: Path
) -> None:
    first = _some_photos(photographed, tmp_path / "first", 0, 8)
    second = _some_photos(photographed, tmp_path / "second", 6, 14)
    site = tmp_path / "site"
    run_map(site, first, "--camera", photographed / "camera.xml")
    (source,) = open_sources([second], None, photographed / "camera.xml")
    with Archive.open(site, write=True) as archive:
        setup = prepare(source, MapSettings(), archive.site(), telemetry_named=False)
        known_px = _opaque_px(archive)
        with archive.begin_flight("second", source.fingerprint, {}) as writer:
            with PlanarRun(setup, archive, MapSettings(), writer) as run:
                assert (
                    run.begin() is writer and run.complete(MapGround(None)) == [] and not run.images
                )
                for frame in source.frames(lambda *_: True):
                    assert isinstance(frame, Frame)
                    run.add(PosedFrame(frame, setup.prior(frame, first=False)))
                placed = run.complete(MapGround(None))
            writer.flush()  # the run's end is not the writer's
            assert [each.status for each in placed] == [Status.VISION] * 8 and sorted(
                run.images
            ) == list(range(8))
            writer.commit(placed, run.images, {}, "")
        assert _opaque_px(archive) > 1.1 * known_px
        assert [flight.id for flight in archive.flights()] == ["first", "second"]


def _opaque_px(archive: Archive) -> int:
    return sum(int((tile[..., 3] == 255).sum()) for tile in archive.tiles().values())
