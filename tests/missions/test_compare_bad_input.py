"""Later flights and maps with faults, through the command: nothing changed, so none is reported; what was not compared
is named, and the exit code is 3 where that is most of the ground."""

import json
import shutil
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from sorvolo.cli.main import main
from sorvolo.geometry.arrays import ImageRGB
from sorvolo.geometry.ground import footprint
from sorvolo.geometry.homography import apply_homography, site_from_image_homography
from sorvolo.lab.simulation.flight import SimulatedFlight, simulate_flights
from sorvolo.lab.simulation.flight_files import write_camera, write_photo
from sorvolo.lab.simulation.settings import (
    ImagingSettings,
    LaterSettings,
    OutputSettings,
    PathSettings,
    SceneSettings,
    SensorSettings,
    SimulationSettings,
)
from sorvolo.missions.map.painting import KnownKeyframes
from sorvolo.missions.map.planar_run import PlanarRun
from sorvolo.store.site.archive import Archive

_DAY_NS = 86400 * 10**9
_UNCHANGED = SimulationSettings(
    seed=53,
    flights=2,
    scene=SceneSettings(people=0, cars=1, small_objects=3, moving_share=0.0, has_scenery=False),
    path=PathSettings(height_m=20, speed_m_s=5, length_m=24, strips=2, strip_spacing_m=8),
    imaging=ImagingSettings(width_px=400, height_px=300, fps=5),
    sensor=SensorSettings(noise_m=(0.3, 0.3, 0.3)),
    later=LaterSettings(people=0, cars=0, small_objects=0, removed=0, moved=0),
    output=OutputSettings(photos=True, photo_overlap=0.75),
)


@pytest.fixture(scope="module")
def flights() -> tuple[SimulatedFlight, ...]:
    return tuple(simulate_flights(_UNCHANGED))


@pytest.fixture(scope="module")
def mapped(flights: tuple[SimulatedFlight, ...], tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("unchanged")
    photos = written(flights[0], folder / "first")
    assert (
        main(
            ["map", str(photos), "--site", str(folder / "site"), "--model", "none", *camera(photos)]
        )
        == 0
    )
    return folder / "site"


def written(
    flight: SimulatedFlight,
    folder: Path,
    chosen: Sequence[int] | None = None,
    turned_deg: float = 0.0,
    edit: Callable[[ImageRGB, int], ImageRGB] = lambda image, _: image,
) -> Path:
    """A flight's photos, or the `chosen` ones, with the compass off by `turned_deg`; beside them camera.xml."""
    folder.mkdir(parents=True)
    write_camera(folder.parent / "camera.xml", flight.camera)
    columns = flight.observations["photos"].telemetry.columns
    for index in range(len(flight)) if chosen is None else chosen:
        frame = flight.frame(index)
        row = {name: float(values[index]) for name, values in columns.items()}
        row["camera_yaw_deg"] = (row["camera_yaw_deg"] + turned_deg) % 360
        later = replace(
            frame,
            image=edit(frame.image, index),
            time_ns=frame.time_ns + (flight.number - 1) * _DAY_NS,
        )
        write_photo(folder / flight.frame_name(index), later, flight.camera, row)
    return folder


def camera(photos: Path) -> list[str]:
    return ["--camera", str(photos.parent / "camera.xml")]


def compared(site: Path, photos: Path, code: int) -> dict[str, Any]:
    """The report's part on a comparison that ended with this exit code; nothing may be reported."""
    assert (
        main(["compare", str(photos), "--site", str(site), "--model", "none", *camera(photos)])
        == code
    )
    folder = site / "flights" / photos.name
    assert json.loads((folder / "changes.geojson").read_text())["features"] == []
    return json.loads((folder / "report.json").read_text())["comparison"]


@pytest.fixture
def site(mapped: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(mapped, tmp_path / "site"))


def test_a_compass_that_is_90_degrees_off_costs_no_view(
    flights: tuple[SimulatedFlight, ...], site: Path, tmp_path: Path
) -> None:
    comparison = compared(site, written(flights[1], tmp_path / "turned", turned_deg=90), 0)
    assert comparison["views"]["compared"] == len(flights[1])
    assert comparison["headline"]["quality"] == "compared"


def test_a_wrong_compass_does_not_turn_what_extends_the_map(
    flights: tuple[SimulatedFlight, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The map shows one strip of two. A photo at its rim shows it and new ground: that lies where the map has it.

    No other photo overlaps it that extends the map, nor, as across dates, does the map's own fit it. Ties to the ground
    alone pull such photos back at times and at times not: they are left out here.
    """
    monkeypatch.setattr(KnownKeyframes, "for_graph", lambda _: [])
    monkeypatch.setattr(PlanarRun, "note_found", lambda *_: None)
    first = written(flights[0], tmp_path / "one" / "first", range(len(flights[0]) // 2))
    site = tmp_path / "one" / "site"
    assert main(["map", str(first), "--site", str(site), "--model", "none", *camera(first)]) == 0
    later = flights[1]
    comparison = compared(site, written(later, tmp_path / "turned", [1, 3, 10], turned_deg=90), 0)
    assert comparison["extension"]["frames"] > 0
    with Archive.open(site, write=False) as archive:
        frame = archive.site().frame
        index_of, off_m = {later.frame_name(index): index for index in range(len(later))}, []
        for each in archive.keyframes():
            if each.flight_id == "turned":
                outline_m = footprint(later.camera, later.true_poses[index_of[each.name]])
                latitude, longitude, _ = later.site.wgs84_from_site(
                    np.column_stack([outline_m, np.zeros(4)])
                )
                true_m = frame.ground_from_lonlat(np.column_stack([longitude, latitude]))
                there_m = apply_homography(each.site_from_image, each.camera.corners_px)
                off_m.append(float(np.median(np.linalg.norm(there_m - true_m, axis=1))))
    assert len(off_m) == comparison["extension"]["frames"]
    assert max(off_m) < 2.0  # both flights' GPS is good to 0.3 m an axis


def test_photos_that_mostly_show_water_are_refused_in_one_line_for_one_reason(
    flights: tuple[SimulatedFlight, ...],
    site: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    photos = written(flights[1], tmp_path / "shore", edit=flooded)
    assert (
        main(["compare", str(photos), "--site", str(site), "--model", "none", *camera(photos)]) == 1
    )
    error = capsys.readouterr().err.splitlines()[-1]
    assert "no frame of shore could be compared: more than half of it looks changed (water" in error
    assert not (site / "flights" / "shore").exists()


def test_a_map_of_one_frame_and_a_flight_over_a_corner_leave_the_rest_uncompared(
    flights: tuple[SimulatedFlight, ...], site: Path, tmp_path: Path
) -> None:
    first = written(flights[0], tmp_path / "one" / "first", [2])
    small = tmp_path / "one" / "site"
    assert main(["map", str(first), "--site", str(small), "--model", "none", *camera(first)]) == 0
    later = compared(small, written(flights[1], tmp_path / "whole"), 0)
    assert later["coverage"]["gaps_m2"]["no-map"] > later["compared_area_m2"] > 50
    corner = compared(site, written(flights[1], tmp_path / "corner", [0, 1]), 0)
    assert 50 < corner["compared_area_m2"] < 0.6 * later["coverage"]["gaps_m2"]["no-map"]


def flooded(image: ImageRGB, index: int) -> ImageRGB:
    """The right 60 % of a photo under moving water."""
    rng = np.random.default_rng(index)
    height, width = image.shape[:2]
    waves = cv2.resize(
        rng.normal(size=(height // 6, width // 14)), (width, height), interpolation=cv2.INTER_CUBIC
    )
    water = np.array([60, 84, 92]) + 9 * waves[..., None]
    shore = np.arange(width)[:, None] > 0.4 * width
    return np.clip(np.where(shore, water, image), 0, 255).astype(np.uint8)


def test_ground_that_differs_all_over_is_warned_of(
    flights: tuple[SimulatedFlight, ...], site: Path, tmp_path: Path
) -> None:
    few = [1, 2, 3, 4]
    assert warned(site, written(flights[1], tmp_path / "plain", few)) == []
    snowy = written(
        flights[1],
        tmp_path / "snowy",
        few,
        edit=lambda image, index: snowed(flights[1], image, index),
    )
    (warning,) = warned(site, snowy)
    assert "of the compared ground looks changed (snow" in warning and "same season" in warning


def test_a_map_far_coarser_than_the_flight_is_warned_of(
    flights: tuple[SimulatedFlight, ...], tmp_path: Path
) -> None:
    first = written(flights[0], tmp_path / "first")
    coarse = tmp_path / "coarse"
    assert (
        main(
            [
                "map",
                str(first),
                "--site",
                str(coarse),
                "--model",
                "none",
                "--gsd",
                "0.56",
                *camera(first),
            ]
        )
        == 0
    )
    (warning,) = warned(coarse, written(flights[1], tmp_path / "second", [0, 1, 2]))
    assert warning.startswith("the map's pixels are 9 times as large as the flight's")


def warned(site: Path, photos: Path) -> list[str]:
    """What a comparison warns of, of its ground and its map; it may list changes."""
    assert main(
        ["compare", str(photos), "--site", str(site), "--model", "none", *camera(photos)]
    ) in (0, 3)
    report = json.loads((site / "flights" / photos.name / "report.json").read_text())
    return [each for each in report["warnings"] if "season" in each or "pixels" in each]


def snowed(flight: SimulatedFlight, image: ImageRGB, index: int) -> ImageRGB:
    """The photo with snow on a quarter of the ground, the same in every photo."""
    height, width = image.shape[:2]
    x, y = np.meshgrid(np.arange(width), np.arange(height))
    ground_from_image = site_from_image_homography(
        flight.camera.undistorted(), flight.true_poses[index]
    )
    places = apply_homography(
        ground_from_image, np.column_stack([x.ravel(), y.ravel()]).astype(float)
    )
    drifts = np.sin(places[:, 0] * 1.1) + np.sin(places[:, 1] * 1.3 + 1)
    cover = np.clip(4 * (drifts - 0.7), 0, 1).reshape(height, width, 1)
    return np.asarray(image * (1 - cover) + 228 * cover, np.uint8)
