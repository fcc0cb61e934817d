"""A whole simulation on disk: the same bytes each time, complete, crash-safe, read by our own readers."""

import hashlib
import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
import rasterio
from PIL import Image

from sorvolo.capture.telemetry import read_telemetry
from sorvolo.errors import SettingsError
from sorvolo.geometry.geodesy import Projection
from sorvolo.geometry.ground import ground_from_pixels
from sorvolo.lab.simulation.flight import SimulatedFlight, simulate_flights
from sorvolo.lab.simulation.presets import preset, preset_names
from sorvolo.lab.simulation.rendering import render_labels
from sorvolo.lab.simulation.settings import (
    ImagingSettings,
    LaterSettings,
    OutputSettings,
    PathSettings,
    SceneSettings,
    SensorSettings,
    SimulationSettings,
)
from sorvolo.lab.simulation.site import simulate_site

SMALL = SimulationSettings(
    seed=7,
    scene=SceneSettings("dirt", people=2, cars=1, small_objects=3),
    path=PathSettings(height_m=12, speed_m_s=4, length_m=8, strips=1),
    imaging=ImagingSettings(320, 240, fps=5),
    sensor=SensorSettings(bad_checksums=2),
    later=LaterSettings(removed=1, moved=1),
    output=OutputSettings("all", truth_step=4),
)


def run(folder: Path, settings: SimulationSettings) -> None:
    for _ in simulate_site(folder, settings):
        pass


def hashes(folder: Path) -> dict[str, str]:
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("simulation") / "site"
    run(folder, SMALL)
    return folder


@pytest.fixture(scope="module")
def flights() -> list[SimulatedFlight]:
    """The same flights, from memory."""
    return list(simulate_flights(SMALL))


WRITE_A_VIDEO = """
import sys
from pathlib import Path
import numpy as np
from sorvolo.lab.simulation.flight_files import video_writer

ground = np.random.default_rng(1).integers(0, 256, (60, 100, 3), np.uint8).repeat(4, axis=0).repeat(4, axis=1)
with video_writer(Path(sys.argv[1]), (320, 180), 10.0, 0, 20) as write:
    for k in range(12):
        write(np.ascontiguousarray(ground[2 * k:2 * k + 180, 3 * k:3 * k + 320]))
"""


def test_a_video_does_not_depend_on_what_lay_in_memory_before(tmp_path):
    written = []
    for filling in ("1", "170"):  # glibc fills new memory with it; elsewhere it does nothing
        path = tmp_path / f"{filling}.mp4"
        subprocess.run(
            [sys.executable, "-c", WRITE_A_VIDEO, str(path)],
            check=True,
            timeout=60,
            env={**os.environ, "MALLOC_PERTURB_": filling},
        )
        written.append(path.read_bytes())
    assert written[0] == written[1]


def test_one_seed_gives_the_same_bytes(site, tmp_path):
    again = tmp_path / "again"
    run(again, SMALL)
    assert hashes(again) == hashes(site)
    another = replace(SMALL, seed=8, flights=1, output=OutputSettings("csv"))
    short = replace(SMALL.path, length_m=2)
    run(again, replace(another, path=short))  # replaces the first one
    other = hashes(again)
    assert "flight2/flight2.mp4" not in other
    assert other["flight1/flight1.mp4"] != hashes(site)["flight1/flight1.mp4"]


def test_everything_is_there(site):
    files = set(hashes(site))
    assert {
        "camera.xml",
        "flight1/camera.xml",
        "flight2/camera.xml",
        "simulation.json",
        "flight1/flight1.mp4",
        "flight1/flight1.csv",
        "flight1/other/flight1.srt",
        "flight1/other/flight1_old_dialect.srt",
        "flight1/other/flight1.nmea",
        "flight1/other/flight1.gpx",
        "truth/frames.geojson",
        "truth/ground.tif",
        "truth/objects.geojson",
        "truth/flight1/boxes.json",
        "truth/flight2/boxes.json",
        "truth/flight2/changes/0.png",
        "truth/flight2/changes/4.png",
    } <= files
    assert not any(name.startswith("truth/flight1/changes") for name in files)
    assert [path.name for path in site.parent.iterdir()] == ["site"]  # nothing half-made is left


def test_the_video_holds_every_frame_at_its_time(site):
    truth = json.loads((site / "truth/frames.geojson").read_text())
    expected = [
        f["properties"]["frame"]
        for f in truth["features"]
        if f["properties"]["flight"] == "flight1"
    ]
    with av.open(str(site / "flight1/flight1.mp4")) as container:
        times = [float(frame.time) for frame in container.decode(video=0)]
        assert container.metadata["creation_time"].startswith("2026-04-02T12:44:00")
    assert len(times) == len(expected) == expected[-1] + 1
    assert np.allclose(times, np.array(expected) / 5, atol=1e-9)


def test_every_format_gives_the_same_place(site, flights):
    flight = flights[0]
    for name in (
        "flight1.csv",
        "other/flight1.srt",
        "other/flight1_old_dialect.srt",
        "other/flight1.nmea",
        "other/flight1.gpx",
    ):
        telemetry = read_telemetry(site / "flight1" / name)
        recorded = flight.telemetry(name.rsplit(".", 1)[1])
        assert len(telemetry) >= len(recorded) - (2 if name.endswith("nmea") else 0)
        # subtitles of the old kind print six decimals, 0.11 m; readers may refine whole-second clocks
        assert np.isin(
            np.round(telemetry["latitude_deg"], 6), np.round(recorded["latitude_deg"], 6)
        ).all()
        assert np.isin(
            np.round(telemetry["longitude_deg"], 6), np.round(recorded["longitude_deg"], 6)
        ).all()


def test_the_table_has_the_thesis_columns(site):
    header = (site / "flight1/flight1.csv").read_text().splitlines()[0].split(",")
    assert len(header) == 60
    assert (header[0], header[3], header[9], header[48]) == (
        "Tick#",
        "Longitude",
        "relativeHeight",
        "Gimbal:yaw",
    )


def test_bad_checksums_are_written_and_found(site):
    notices = read_telemetry(site / "flight1/other/flight1.nmea").notices
    assert sum(notice.count for notice in notices if "checksum" in notice.code) in (
        2,
        4,
    )  # samples or sentences


def test_the_ground_picture_agrees_with_the_frames(site, flights):
    """The GeoTIFF at a frame's ground point shows, in UTM, what the frame shows there."""
    flight = flights[0]
    index = 5
    y, x = np.mgrid[0:240, 0:320]
    pixels = np.column_stack([x.ravel(), y.ravel()]).astype(np.float64)
    ground = ground_from_pixels(flight.camera, flight.true_poses[index], pixels)
    latitude, longitude, _ = flight.site.wgs84_from_site(ground)
    with rasterio.open(site / "truth/ground.tif") as source:
        assert source.crs.to_epsg() == 32633
        places = Projection("EPSG:32633").projected_from_wgs84(latitude, longitude)
        columns, rows = ~source.transform @ places.T
        picture = source.read([1, 2, 3]).mean(axis=0).astype(np.float32)
    columns, rows = (np.float32(each).reshape(x.shape) - 0.5 for each in (columns, rows))
    on_map = cv2.remap(picture, columns, rows, cv2.INTER_LINEAR)
    in_frame = flight.frame(index).image.mean(axis=2).astype(np.float32)
    labels, _ = render_labels(
        flight.day.things,
        flight.day.bodies,
        flight.view(index),
        flight.true_poses[index],
        float(flight.from_middle_s[index]),
    )
    bare = (
        cv2.dilate((labels > 0).astype(np.uint8), np.ones((25, 25))) == 0
    )  # what stands up leans elsewhere

    def agreement(shown: np.ndarray) -> float:
        smooth = [cv2.GaussianBlur(each, (0, 0), 1.0)[bare] for each in (shown, in_frame)]
        return float(np.corrcoef(*smooth)[0, 1])

    assert agreement(on_map) > 0.93
    assert agreement(cv2.remap(picture, columns + 3, rows, cv2.INTER_LINEAR)) < 0.85


def test_boxes_hold_objects_and_masks_hold_changes(site, flights):
    boxes = json.loads((site / "truth/flight2/boxes.json").read_text())
    assert [category["name"] for category in boxes["categories"]] == [
        "person",
        "car",
        "small object",
    ]
    assert boxes["annotations"]
    for box in boxes["annotations"]:
        left, top, width, height = box["bbox"]
        assert left >= 0 and top >= 0 and left + width <= 320 and top + height <= 240
        assert 0 < box["visibility"] <= 1 and box["area"] <= width * height
    added = {thing.id for thing in flights[1].day.things} - {
        thing.id for thing in flights[0].day.things
    }
    assert len(added) == 4
    for image in boxes["images"]:
        mask = cv2.imread(
            str(site / f"truth/flight2/changes/{image['frame']}.png"), cv2.IMREAD_GRAYSCALE
        )
        assert set(np.unique(mask)) <= {0, 255}
        for box in boxes["annotations"]:
            if box["image_id"] == image["id"] and box["object_id"] in added:
                left, top, width, height = box["bbox"]
                assert (
                    np.count_nonzero(mask[top : top + height, left : left + width]) >= box["area"]
                )


def test_photos_carry_place_and_attitude(tmp_path):
    settings = replace(
        SMALL,
        flights=1,
        path=replace(SMALL.path, length_m=5),
        output=OutputSettings("csv", photos=True),
    )
    run(tmp_path / "photos", settings)
    photos = sorted((tmp_path / "photos/flight1/photos").iterdir())
    flight = next(simulate_flights(settings))
    assert [path.name for path in photos] == [flight.frame_name(i) for i in range(len(flight))]
    with Image.open(photos[1]) as photo:
        place = photo.getexif().get_ifd(0x8825)
        xmp = photo.info["xmp"].decode()
    latitude = sum(float(part) / 60**i for i, part in enumerate(place[2]))
    assert latitude == pytest.approx(flight.telemetry()["latitude_deg"][1], abs=1e-8)
    assert "drone-dji:RelativeAltitude" in xmp and "drone-dji:GimbalYawDegree" in xmp


def test_a_folder_of_something_else_is_left_alone(tmp_path):
    (tmp_path / "precious.txt").write_text("mine")
    with pytest.raises(SettingsError, match="not empty"):
        run(tmp_path, SMALL)
    assert (tmp_path / "precious.txt").read_text() == "mine"


def test_an_interrupted_run_leaves_no_half_folder_and_can_be_repeated(tmp_path):
    folder = tmp_path / "site"
    steps = simulate_site(folder, SMALL)
    for step in steps:
        if step.stage == "frames":
            break
    steps.close()
    assert not folder.exists()
    short = replace(SMALL, flights=1, path=replace(SMALL.path, length_m=2))
    run(folder, replace(short, output=OutputSettings("none")))
    assert (folder / "simulation.json").exists()
    assert not (tmp_path / ".site.partial").exists()


def test_every_preset_is_complete():
    names = preset_names()
    assert len(names) == len(set(names)) >= 44
    for name in names:
        settings = preset(name)
        assert settings.preset == name
        if name.startswith("umcd"):
            assert 6 <= settings.path.height_m <= 15 and 2 <= settings.path.speed_m_s <= 12
            assert 24 <= settings.imaging.fps <= 50
    with pytest.raises(SettingsError, match="unknown preset"):
        preset("umcd-moon")
