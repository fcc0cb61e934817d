"""`sorvolo watch --through-trees` from photos to finds that are announced, and the files of a search."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from shutil import copy
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import rasterio
from PIL import Image
from thermal_forest import fly, make_forest, photograph

from killed_copy import copy_as_killed
from sorvolo.capture.source import open_sources
from sorvolo.detection.contract import ModelInfo
from sorvolo.errors import InputError
from sorvolo.geometry.camera import Camera
from sorvolo.geometry.geodesy import Geodetic, LocalFrame
from sorvolo.geometry.pose import NADIR_CAMERA_NORTH_UP, Pose
from sorvolo.heights.views import View
from sorvolo.lab.simulation.flight_files import write_photo
from sorvolo.missions.flight.result_cache import ResultCache
from sorvolo.missions.flight.settings import MapSettings
from sorvolo.missions.flight.setup import new_site, prepare
from sorvolo.missions.watch.flights import watch
from sorvolo.missions.watch.run import WatchUpdate
from sorvolo.missions.watch.settings import WatchOutputs, WatchSettings
from sorvolo.missions.watch.through_trees import ForestFrame, ThroughTrees
from sorvolo.store.images import jpeg_from_image
from sorvolo.store.site.journal import RunJournal
from sorvolo.survey.flight import Frame
from sorvolo.survey.objects import Detections, Track, no_detections

_FRAME = LocalFrame(Geodetic(48.33, 14.33, 400.0))
_PEOPLE_M = np.array([[-4.0, -3.0], [4.0, 5.0]])


class _Blind:
    """Sees nobody in a single picture."""

    classes = ("person",)
    provider, notices, others = "here", (), ()
    info = ModelInfo("blind", classes, {"person": 0.5}, {"person": (4.0, 60.0)}, licence="CC0-1.0")

    def detect(self, image: Any, **_: object) -> Detections:
        return no_detections(self.classes)


@pytest.fixture(scope="module")
def photos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    forest = make_forest(5, 44, 1.5, _PEOPLE_M)
    camera = Camera.from_angle_of_view(192, 192, 40)
    views = fly(forest, np.arange(-6.0, 7, 3.0), np.arange(-6.0, 7, 3.0), camera=camera)
    folder = tmp_path_factory.mktemp("forest") / "photos"
    folder.mkdir()
    for number, view in enumerate(views):
        place_m = view.site_from_camera.translation_m
        level = replace(view, site_from_camera=Pose(NADIR_CAMERA_NORTH_UP, place_m))
        image = np.dstack([photograph(forest, level)] * 3)
        frame = Frame(number, view.name, 1_700_000_000_000_000_000 + number * 2 * 10**9, image)
        (latitude,), (longitude,), _ = _FRAME.wgs84_from_site(place_m[None])
        row = {"latitude_deg": latitude, "longitude_deg": longitude}
        row |= {"orthometric_height_m": 400 + place_m[2], "height_above_takeoff_m": place_m[2]}
        row |= {"camera_yaw_deg": 0.0, "camera_pitch_deg": -90.0, "camera_roll_deg": 0.0}
        write_photo(folder / view.name, frame, camera, row)
    return folder


def _watched(
    photos: Path, folder: Path, then: Callable[[list[WatchUpdate]], None] = lambda _: None
) -> list[WatchUpdate]:
    updates: list[WatchUpdate] = []
    outputs = WatchOutputs(folder=folder)
    for update in watch(
        photos, WatchSettings(through_trees=True), outputs, camera="aov=40", detector=_Blind()
    ):
        updates.append(update)
        then(updates)
    return updates


def test_people_below_crowns_are_tracks_of_the_watch(photos: Path, tmp_path: Path) -> None:
    folder = tmp_path / "watch"
    updates = _watched(photos, folder)
    assert len(updates) == len(list(photos.iterdir()))
    report = json.loads((folder / "report.json").read_text())
    under = json.loads((folder / "under_trees.json").read_text())
    tracks = json.loads((folder / "tracks.geojson").read_text())["features"]
    assert len(tracks) == len(under["people"]) == len(_PEOPLE_M)
    assert "2 people; " in report["headline"]["text"]
    assert (
        f"2 of the people only through the trees: {under['headline']['text']}"
        in report["headline"]["text"]
    )
    places_m = np.array(
        [
            _FRAME.site_from_wgs84(*(np.array([each]) for each in (latitude, longitude, 0.0)))[
                0, :2
            ]
            for longitude, latitude in (each["geometry"]["coordinates"][:2] for each in tracks)
        ]
    )
    away_m = np.linalg.norm(places_m[:, None] - _PEOPLE_M, axis=2)
    assert away_m.min(axis=0).max() < 3 * under["people"][0]["sigma_m"]
    between_m = np.linalg.norm(places_m[0] - places_m[1])
    assert between_m == pytest.approx(np.linalg.norm(_PEOPLE_M[0] - _PEOPLE_M[1]), rel=0.1)
    assert all((folder / each["properties"]["crop"]).is_file() for each in tracks)
    with rasterio.open(folder / "under_trees.tif") as opened:
        assert opened.read(3).max() >= 24


def test_a_killed_watch_goes_on_and_ends_the_same(photos: Path, tmp_path: Path) -> None:
    few, folder, amid = tmp_path / "photos", tmp_path / "watch", tmp_path / "amid"
    few.mkdir()
    for path in sorted(photos.iterdir())[:8]:
        copy(path, few)

    def kill(updates: list[WatchUpdate]) -> None:
        if len(updates) == 5:
            copy_as_killed(folder, amid)

    _watched(few, folder, kill)
    resumed = _watched(few, amid)
    assert [each.is_resumed for each in resumed] == [True] * 5 + [False] * 3
    headlines = [
        json.loads((each / "report.json").read_text())["headline"] for each in (folder, amid)
    ]
    assert headlines[0] == headlines[1] and not headlines[0]["complete"]
    assert "photos has 8 pictures with a place; to look through trees" in headlines[0]["text"]


def test_frames_that_a_killed_watch_of_a_stream_kept_are_put_together_with_later_ones(
    photos: Path, tmp_path: Path
) -> None:
    """Their pictures and telemetry are gone with the stream."""
    (source,) = open_sources([str(photos)], None, "aov=40")
    setup = prepare(source, MapSettings(), None, telemetry_named=False)
    site = new_site(setup, source.name, 1.0, 0.0)
    journal = RunJournal(tmp_path / "run.journal", "asked", 0)
    frames = [each for each in source.frames(lambda index, _: index < 9) if isinstance(each, Frame)]
    level = NADIR_CAMERA_NORTH_UP
    for frame in frames[:8]:
        pose = Pose(level, setup.prior(frame, first=False).position_m)
        view = View(frame.name, setup.source.camera.camera, pose, np.full(3, np.nan))
        kept = ForestFrame(frame.index, frame.time_ns, view, jpeg_from_image(frame.image))
        ResultCache(journal).keep(frame, "under trees", kept)
    journal.close()
    memo = ResultCache(RunJournal(tmp_path / "run.journal", "asked", 0))
    trees = ThroughTrees(setup, site, tmp_path, memo)
    last = frames[8]
    trees.take(last, Pose(level, setup.prior(last, first=False).position_m))
    trees.finish()
    trees.close()
    assert "photos has 9 pictures with a place" in trees.headline["text"]


class _SeesNobodyAtTheEnd(ThroughTrees):
    def _look_at(self, frames: Any, *, is_quick: bool) -> Any:
        headline = {"text": "nobody under trees", "complete": True}
        nobody = SimpleNamespace(people=())
        return SimpleNamespace(
            report={"headline": headline}, finds=nobody, objects=(), views=(), write=lambda _: None
        )


def test_a_find_that_was_announced_is_not_taken_back(photos: Path, tmp_path: Path) -> None:
    """It may be a person; the headline says that all frames together do not show it."""
    (source,) = open_sources([str(photos)], None, "aov=40")
    setup = prepare(source, MapSettings(), None, telemetry_named=False)
    memo = ResultCache(RunJournal(tmp_path / "run.journal", "asked", 0))
    trees = _SeesNobodyAtTheEnd(setup, new_site(setup, source.name, 1.0, 0.0), tmp_path, memo)
    announced = cast(Track, object())
    trees.tracks[90_001] = announced
    trees.finish()
    trees.close()
    assert trees.tracks == {90_001: announced}
    assert "nobody under trees; 1 find announced before" in trees.headline["text"]


def test_a_flight_without_headings_is_refused(photos: Path, tmp_path: Path) -> None:
    bare = tmp_path / "bare"
    bare.mkdir()
    for path in sorted(photos.iterdir())[:2]:
        Image.open(path).save(bare / path.name)
    with pytest.raises(InputError, match="each frame needs a GPS fix, its height above the ground"):
        _watched(bare, tmp_path / "watch")
