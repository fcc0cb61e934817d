"""Live flights whose run was killed: the same command goes on with the stream as one flight of two segments."""

import json
import shutil
import sys
import threading
import warnings
from collections.abc import Callable, Generator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from live_sender import Sender
from test_map_live import _LIVE, Drone, FilmedFlight
from truth_detector import TruthDetector

from killed_copy import copy_as_killed
from sorvolo.capture.live.reconnect import LiveSettings
from sorvolo.capture.live.stream import LiveStream
from sorvolo.capture.source import open_sources
from sorvolo.errors import SorvoloWarning
from sorvolo.geometry.arrays import ImageRGB
from sorvolo.missions.compare.flights import compare_flights
from sorvolo.missions.flight.result_cache import flight_so_far, go_on, note_flight
from sorvolo.missions.flight.settings import CompareSettings, MapSettings
from sorvolo.missions.map.flights import map_flights
from sorvolo.missions.watch.flights import watch
from sorvolo.missions.watch.run import WatchUpdate
from sorvolo.missions.watch.settings import WatchOutputs, WatchSettings
from sorvolo.store.site.journal import Entry, RunJournal
from sorvolo.survey.findings import CompareUpdate
from sorvolo.survey.mosaic import MosaicUpdate
from sorvolo.survey.objects import Detections, no_detections
from waiting import wait_for

_MAP = MapSettings(model="none")
_FILE = LiveSettings(keeps_all=True, silent_s=0.5, give_up_s=1.0, first_s=20.0)


@pytest.fixture(scope="module")
def flight(filmed: Path) -> FilmedFlight:
    return FilmedFlight(filmed)


@pytest.fixture(scope="module")
def followed(flight: FilmedFlight, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A transport stream with metadata that is complete, as the file beside it states."""
    path = tmp_path_factory.mktemp("followed") / "film.ts"
    write_film(path, flight, 40, metadata=True)
    return path


def write_film(path: Path, flight: FilmedFlight, count: int, *, metadata: bool) -> None:
    """A transport stream of the flight's first frames, and beside it that it has ended."""
    drone = Drone(flight, metadata=metadata, count=count)
    drone.fly()
    Sender(
        str(path),
        size=flight.images[0].shape[1::-1],
        klv=metadata,
        image=drone._image,
        klv_of=drone._klv,
        rate=flight.rate,
        speed=1000.0,
    ).run()
    path.with_name("film.ts.ended").touch()


def test_a_disk_that_fills_while_the_flight_goes_on_is_announced_once(
    followed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        shutil, "disk_usage", lambda _: shutil._ntuple_diskusage(10**9, 9 * 10**8, 6 * 10**7)
    )  # type: ignore[attr-defined]
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        assert len(mapped(f"follow:{followed}", tmp_path / "site", _FILE)) > 3
    found = [str(each.message) for each in caught if "more frame" in str(each.message)]
    assert len(found) == 1 and "has 60 MB free" in found[0] and "of film will fit" in found[0]


def mapped(
    source: str,
    site: Path,
    live: LiveSettings,
    killed_at: int = 0,
    fly: Callable[[], None] = lambda: None,
    **kwargs: Any,
) -> list[MosaicUpdate]:
    """Map a live source; after so many frames the site is copied as a kill leaves it, and the run is over.

    `fly` is called when the first new frame is on the map, or after some seconds: where the newest key frame shows the
    same ground, none is needed before the drone has moved.
    """
    updates: list[MosaicUpdate] = []
    mapping = map_flights([source], site, _MAP, live=live, **kwargs)
    standing = threading.Timer(5.0, fly)
    standing.start()
    for each in mapping:
        updates.append(each)
        if not each.is_resumed:
            fly()
        if len(updates) == killed_at:
            copy_as_killed(site, site.with_name("amid"))
            mapping.cancel()
            shutil.rmtree(site)
            shutil.move(site.with_name("amid"), site)
            break
    standing.cancel()
    return updates


def reports(site: Path) -> list[dict[str, Any]]:
    return [
        json.loads(each.read_text()) for each in sorted((site / "flights").glob("*/report.json"))
    ]


@pytest.fixture(scope="module")
def whole(
    flight: FilmedFlight, followed: Path, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, list[MosaicUpdate]]:
    """The file's map, and how it was made."""
    site = tmp_path_factory.mktemp("whole") / "site"
    return site, mapped(f"follow:{followed}", site, _FILE, camera=flight.camera)


def corners_deg(site: Path) -> dict[str, list[list[float]]]:
    """The corners of each frame's footprint, longitude and latitude, by its name."""
    features = json.loads((site / "flights" / "film" / "frames.geojson").read_text())["features"]
    return {each["properties"]["frame"]: each["geometry"]["coordinates"][0] for each in features}


def test_a_followed_file_goes_on(
    flight: FilmedFlight, followed: Path, whole: tuple[Path, list[MosaicUpdate]], tmp_path: Path
) -> None:
    source, site = f"follow:{followed}", tmp_path / "site"
    mapped(source, site, _FILE, killed_at=5, camera=flight.camera)
    resumed = mapped(source, site, _FILE, camera=flight.camera)
    assert [each.is_resumed for each in resumed] == [number < 5 for number in range(len(whole[1]))]
    before, after = (corners_deg(each) for each in (whole[0], site))
    assert list(before) == list(after)
    for (
        name,
        corners,
    ) in before.items():  # what telemetry had sent when a frame came moves it by a millimetre
        np.testing.assert_allclose(after[name], corners, rtol=0, atol=2e-7)
    (report,) = reports(site)
    assert report["georeferenced"] and "segments" not in [
        each["code"] for each in report["notices"]
    ]


def test_a_stream_that_returns_is_a_second_segment(flight: FilmedFlight, tmp_path: Path) -> None:
    site, drone = tmp_path / "site", Drone(flight, metadata=True)
    with drone.sent():
        mapped(
            drone.address,
            site,
            _LIVE,
            killed_at=4,
            fly=drone.fly,
            camera=flight.camera,
            until=drone.landed,
        )
    back = Drone(flight, metadata=True, first=38, later_s=40)
    back.port = drone.port
    with back.sent():
        updates = mapped(
            back.address, site, _LIVE, fly=back.fly, camera=flight.camera, until=back.landed
        )
    assert sum(each.is_resumed for each in updates) == 4 and not updates[-1].is_resumed
    (report,) = reports(site)
    (segments,) = [each for each in report["notices"] if each["code"] == "segments"]
    assert segments["count"] == 2 and "read in 2 segments" in segments["text"]
    frames = json.loads((site / "flights" / report["flight"] / "frames.geojson").read_text())[
        "features"
    ]
    times = [each["properties"]["time"] for each in frames]
    assert len(frames) == len(updates) and times == sorted(times)
    assert report["frames"]["vision"] > 4 and report["georeferenced"]
    names = [int(each["properties"]["frame"]) for each in frames]
    assert names == sorted(set(names))  # numbers go on


def test_a_comparison_of_a_stream_goes_on(
    flight: FilmedFlight,
    followed: Path,
    whole: tuple[Path, list[MosaicUpdate]],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    site, later = Path(shutil.copytree(whole[0], tmp_path / "site")), tmp_path / "later.ts"
    shutil.copy(followed, later)
    later.with_name("later.ts.ended").touch()
    monkeypatch.setattr(
        LiveStream, "is_reread", False
    )  # as a stream, whose frames nobody can read again

    def compared() -> Generator[CompareUpdate]:
        settings = CompareSettings(views_per_second=3.0, model="none")
        return compare_flights(
            [f"follow:{later}"], site, settings, camera=flight.camera, live=_FILE
        )

    comparing = compared()
    before = [each for _, each in zip(range(6), comparing)]
    copy_as_killed(site, tmp_path / "amid")
    comparing.cancel()
    shutil.rmtree(site)
    shutil.move(tmp_path / "amid", site)
    updates = list(compared())
    count = sum(each.is_resumed for each in updates)
    assert count >= 6 and [each.is_resumed for each in updates] == [
        number < count for number in range(len(updates))
    ]
    assert [each.frame_name for each in updates[:6]] == [each.frame_name for each in before]
    times = [each.time_ns for each in updates]
    assert len(updates) > count + 5 and times == sorted(set(times))
    report = json.loads((site / "flights" / "later" / "report.json").read_text())
    assert report["comparison"]["views"]["compared"] == len(updates) == report["frames"]["selected"]
    assert {each["code"]: each["count"] for each in report["notices"]}["segments"] == 2


class Following(TruthDetector):
    """Sees one car that stands, wherever the frames are in the flight; nothing in frames that it does not know."""

    def detect(self, image: ImageRGB, **kwargs: Any) -> Detections:
        """As `ObjectDetector.detect`."""
        self.asked += kwargs.get("tiles") is not None
        return (
            no_detections(self.classes)
            if kwargs.get("tiles") is None
            else Detections(
                np.array([[100, 60, 150, 100]]), np.array([0.9]), np.array([1]), self.classes
            )
        )


@pytest.mark.parametrize("metadata", [True, False])
def test_a_watch_of_a_growing_file_goes_on(
    flight: FilmedFlight,
    filmed: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    *,
    metadata: bool,
) -> None:
    monkeypatch.setattr(LiveStream, "is_reread", False)  # as where the newest frame wins
    path, folder, alerts = tmp_path / "film.ts", tmp_path / "watch", tmp_path / "sent"
    write_film(path, flight, 20, metadata=metadata)
    detector = Following(filmed)
    command = f"{sys.executable} -c \"open('{alerts}', 'a').write('{{id}} ')\""
    outputs = WatchOutputs(folder=folder, save="pictures", labels=("coco",), alert_command=command)
    settings = WatchSettings(frames_per_second=1000)

    def watched() -> Generator[WatchUpdate]:
        return watch(
            f"follow:{path}", settings, outputs, camera=flight.camera, detector=detector, live=_FILE
        )

    watching = watched()
    before = [each for _, each in zip(range(12), watching)]
    sent = sum(len(each.new) for each in before)
    wait_for(
        lambda: (folder / "run.journal").read_bytes().count(b'"receiver"') == sent >= 1
    )  # noted once it is sent
    # a second of film is over in whichever twelve frames, and pictures are written by a thread
    wait_for(lambda: len(list((folder / "labels" / "images").iterdir())) >= 2)
    copy_as_killed(folder, tmp_path / "amid")
    watching.cancel()
    shutil.rmtree(folder)
    shutil.move(tmp_path / "amid", folder)
    asked = detector.asked
    updates = list(watched())
    report = json.loads((folder / "report.json").read_text())
    # what was searched is not searched again, whatever the order in which new ground came
    searched = {int(each.frame_name) for each in before}
    names = {int(each.frame_name) for each in updates}
    assert [int(each.frame_name) for each in updates if each.is_resumed] == sorted(searched)
    assert detector.asked - asked == len(names) - len(searched) and names >= searched
    # what waited as it was killed is lost with its picture, and counts as not looked at
    assert report["frames"]["detected"] == len(names)
    assert report["frames"]["skipped"] == 20 - len(names)
    found = [track.id for each in updates for track in each.new]
    alerted = alerts.read_text().split()
    assert found == sorted(set(found)) and found
    if [int(each.frame_name) for each in before] == list(range(len(before))):
        assert sorted(alerted, key=int) == [str(each) for each in found]
    # where frames were left out at first, the same thing is announced by another frame: it is known by its place
    assert len(alerted) == max(sent, len(found))
    lines = [json.loads(each) for each in (folder / "detections.jsonl").read_text().splitlines()]
    assert {int(each["frame"]) for each in lines} == names
    assert {each["code"]: each["count"] for each in report["notices"]}["segments"] == 2
    # read in order, old frames may agree on an object that they did not as new ground came first: no picture is left
    shown = {int(each.stem) for each in (folder / "objects").glob("*.jpg")}
    had_picture = {track.id for each in updates if not each.is_resumed for track in each.new}
    announced = {track.id for each in before for track in each.new}
    # an id that frames in order do not give again leaves no picture behind
    assert (announced & set(found)) | had_picture <= shown
    assert shown <= set(found) and report["objects"]["total"] >= len(shown)
    labelled = json.loads((folder / "labels" / "coco.json").read_text())["images"]
    assert len(labelled) == len(list((folder / "labels" / "images").iterdir())) > 1
    assert not (folder / "run.journal").exists()


def test_a_stream_that_returns_late_is_another_flight(flight: FilmedFlight, tmp_path: Path) -> None:
    (model,) = (
        each.camera for each in open_sources([flight.truth.parent / "flight1" / "flight1.mp4"])
    )
    begun = SimpleNamespace(
        name="drone",
        fingerprint="f",
        start_ns=0,
        start_origin="the clock",
        camera=model,
        gaps_s=(),
        is_reread=True,
    )
    journal = RunJournal(tmp_path / "run.journal", "key", 0)
    note_flight(journal, begun)  # type: ignore[arg-type]
    assert flight_so_far(RunJournal(tmp_path / "run.journal", "key", 0)) is None  # no frame yet
    journal.append(Entry("step", {"index": 7, "name": "7", "time_ns": 50 * 10**9}))
    late = SimpleNamespace(name="new", start_ns=1_000 * 10**9, is_stream=True)
    with pytest.warns(
        SorvoloWarning,
        match="was stopped 950 s ago, more than 900 s: the stream is another flight now",
    ):
        assert not go_on(late, RunJournal(tmp_path / "run.journal", "key", 0), 900.0)  # type: ignore[arg-type]
    journal.append(
        Entry("telemetry", {}, {"times_ns": np.zeros(2, np.int64), "samples": np.zeros(3)})
    )
    assert flight_so_far(RunJournal(tmp_path / "run.journal", "key", 0)) is None  # damaged
