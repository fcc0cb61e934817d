"""A watch that was killed goes on where it was: the same lists in the end, and nobody is notified twice."""

import json
import shutil
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from truth_detector import TruthDetector

from killed_copy import copy_as_killed
from small_flights import simulate_into, small_flight
from sorvolo.cli.main import main
from sorvolo.errors import SorvoloWarning
from sorvolo.geometry.geodesy import Geodetic
from sorvolo.lab.simulation.settings import OutputSettings
from sorvolo.missions.flight.result_cache import ResultCache
from sorvolo.missions.watch.flights import watch
from sorvolo.missions.watch.notifier import Notifier
from sorvolo.missions.watch.run import WatchUpdate
from sorvolo.missions.watch.settings import WatchOutputs, WatchSettings
from sorvolo.store.site.journal import Entry
from sorvolo.survey.flight import Site
from sorvolo.survey.objects import Sighting, Track
from waiting import wait_for

_EFFORT = ("seconds", "latency_s", "frames_per_second", "peak_memory_mb")
_KILLED_AT = 12  # frames


_FLOWN = small_flight(
    78,
    length_m=24,
    spacing_m=7,
    noise_m=0.1,
    people=4,
    cars=3,
    output=OutputSettings(telemetry="all", truth_step=1),
)


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small flight over people and cars."""
    folder = tmp_path_factory.mktemp("watch") / "flown"
    return simulate_into(folder, _FLOWN)


@pytest.fixture(params=["on the ground", "in the picture"])
def video(request: pytest.FixtureRequest, flown: Path, tmp_path: Path) -> Path:
    """The flight with its telemetry, and without any."""
    source = flown / "flight1" / "flight1.mp4"
    return (
        source
        if request.param == "on the ground"
        else Path(shutil.copy(source, tmp_path / "flight1.mp4"))
    )


def watched(
    video: Path,
    folder: Path,
    detector: TruthDetector,
    alerts: Path,
    then: Callable[[list[WatchUpdate]], None] = lambda _: None,
    settings: WatchSettings = WatchSettings(),
) -> list[WatchUpdate]:
    """Watch a flight, with alerts to a program that writes their ids to a file."""
    command = f"{sys.executable} -c \"open('{alerts}', 'a').write('{{id}} ')\""
    outputs = WatchOutputs(folder=folder, save="pictures", labels=("coco",), alert_command=command)
    updates = []
    for each in watch(video, settings, outputs, camera="aov=70", detector=detector):
        updates.append(each)
        then(updates)
    return updates


def noted(folder: Path) -> int:
    """How many messages that were sent the journal of a watch has noted."""
    return (folder / "run.journal").read_bytes().count(b'"receiver"')


def content(folder: Path) -> dict[str, bytes]:
    """All files but pages, without what a watch took."""
    found = {}
    for path in sorted(folder.rglob("*")):
        if path.is_file() and path.name != "report.html":
            data = path.read_bytes()
            if path.name == "report.json":
                data = json.dumps(
                    {k: v for k, v in json.loads(data).items() if k not in _EFFORT}
                ).encode()
            found[str(path.relative_to(folder))] = data
    return found


def ids(alerts: Path, count: int) -> list[int]:
    """Those sent so far, once there are at least `count`."""

    def sent() -> list[int]:
        return [int(each) for each in alerts.read_text().split()] if alerts.is_file() else []

    wait_for(lambda: len(sent()) >= count)
    return sent()


def test_it_goes_on_and_notifies_nobody_twice(
    video: Path, detector: TruthDetector, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(detector, "night", replace(detector.info, name="night"))
    whole, amid, alerts = tmp_path / "whole", tmp_path / "amid", tmp_path / "sent"
    reported: list[int] = []

    def killed(updates: list[WatchUpdate]) -> None:
        if len(updates) == _KILLED_AT:
            reported.extend(ids(alerts, sum(len(each.new) for each in updates)))
            wait_for(lambda: noted(whole) == len(reported))
            copy_as_killed(whole, amid)

    updates = watched(video, whole, detector, alerts, killed)
    found = [track.id for each in updates for track in each.new]
    assert found == ids(alerts, len(found)) and 1 <= len(reported) < len(found)
    shutil.move(whole, tmp_path / "first")
    shutil.move(amid, whole)
    for name in ("", "annotated", "objects"):  # what was being written
        (whole / name / ".tmp-1-picture.jpg").write_bytes(b"half")
    (whole / "objects" / "999.jpg").write_bytes(b"of a track that does not come again")
    alerts.unlink()
    detector.asked = 0
    monkeypatch.setattr(
        detector, "night", None
    )  # it looked at earlier frames alone, and is in the report all the same
    resumed = watched(video, whole, detector, alerts)
    assert [each.is_resumed for each in resumed] == [
        number < _KILLED_AT for number in range(len(updates))
    ]
    assert detector.asked == len(updates) - _KILLED_AT
    assert ids(alerts, len(found) - len(reported)) == found[len(reported) :]
    assert content(whole) == content(tmp_path / "first")
    assert "run.journal" not in content(whole)
    assert [
        each["name"] for each in json.loads((whole / "report.json").read_text())["other_models"]
    ] == ["night"]


def test_an_alert_that_was_not_sent_is_sent(
    flown: Path, detector: TruthDetector, tmp_path: Path
) -> None:
    video, folder, amid = flown / "flight1" / "flight1.mp4", tmp_path / "watch", tmp_path / "amid"
    (tmp_path / "none").mkdir()  # no file can be written there: each alert fails

    def killed(updates: list[WatchUpdate]) -> None:
        if len(updates) == _KILLED_AT:
            time.sleep(1.0)
            copy_as_killed(folder, amid)

    updates = watched(video, folder, detector, tmp_path / "none", killed)
    shutil.rmtree(folder)
    shutil.move(amid, folder)
    (tmp_path / "none").rmdir()
    watched(video, folder, detector, tmp_path / "none")
    found = [track.id for each in updates for track in each.new]
    assert ids(tmp_path / "none", len(found)) == found


def test_other_settings_begin_anew_and_report_it(
    flown: Path, detector: TruthDetector, tmp_path: Path
) -> None:
    video, folder = flown / "flight1" / "flight1.mp4", tmp_path / "watch"
    updates = watch(
        video, WatchSettings(), WatchOutputs(folder=folder), camera="aov=70", detector=detector
    )
    next(updates)
    copy_as_killed(folder, tmp_path / "amid")
    updates.cancel()
    assert not (folder / "run.journal").exists()
    with pytest.warns(
        SorvoloWarning, match="a watch that was stopped cannot continue: it was of other settings"
    ):
        again = watch(
            video,
            WatchSettings(frames_per_second=2),
            WatchOutputs(folder=tmp_path / "amid"),
            camera="aov=70",
            detector=detector,
        )
        assert not next(again).is_resumed
        again.cancel()


def test_what_was_printed_is_not_printed_again(
    flown: Path,
    detector: TruthDetector,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    video, folder = flown / "flight1" / "flight1.mp4", tmp_path / "watch"
    command = ["watch", str(video), "--out", str(folder), "--camera", "aov=70"]
    monkeypatch.setattr("sorvolo.missions.watch.flights.load_detector", lambda _: detector)
    closing = watch(video, WatchSettings(), WatchOutputs(folder=folder), camera="aov=70")
    new = [track.id for _, each in zip(range(_KILLED_AT), closing) for track in each.new]
    copy_as_killed(folder, tmp_path / "amid")
    closing.cancel()
    shutil.rmtree(folder)
    shutil.move(tmp_path / "amid", folder)
    assert main(command) == 3  # the pixels are too coarse for small objects
    printed = capsys.readouterr().err
    assert new and f"continuing after {_KILLED_AT} frames of a stopped run" in printed
    assert not any(f" {each}  at " in printed for each in new)


def _track(number: int, east_m: float, frame: int, moving: bool, late_m: float = 0.0) -> Track:
    place_m, spread_m2, size_m = np.array([east_m, 0.0]), np.diag([4.0, 1.0]), np.array([1.0, 0.5])
    box = np.array([10, 20, 30, 60], np.float32)
    best = Sighting(frame, str(frame), 0, "person", 0.8, box, place_m, spread_m2, size_m)
    path = place_m[None], np.zeros(1, np.int64)
    seen = True, moving, 0, 10**9, 5, 1
    all_m2 = spread_m2 + np.diag([late_m**2, 0.0])
    return Track(number, "person", 0.8, *seen, place_m, all_m2, np.zeros(2), size_m, best, *path)


class _Noting(ResultCache):
    """Keeps notes as a journal would."""

    def note(self, kind: str, **values: Any) -> None:
        self.notes.append(Entry(kind, json.loads(json.dumps(values))))


@pytest.mark.parametrize("late_m", [0.0, 30.0])
def test_an_alert_is_known_again_by_its_sighting_or_by_what_stands_there(
    late_m: float, tmp_path: Path
) -> None:
    """A watch that left frames out announces a thing by another of them when it goes on; each alert is for one thing.

    A clock that is off moves all things of the flight alike, and makes no two of them one.
    """
    memo, sent = _Noting(), tmp_path / "sent"
    command = f"{sys.executable} -c \"open('{sent}', 'a').write('{{id}} ')\""
    outputs = WatchOutputs(alert_command=command)
    site = Site("field", Geodetic(46.5, 13.25), "EPSG:32633", 0.05)

    def alerted(*places: tuple[int, float, int, bool]) -> list[str]:
        """Report tracks by (id, east, frame of the best sighting, moving) in a new process; what was sent so far."""
        notifier = Notifier("flight", "0" * 16, site, outputs, tmp_path, memo)
        tracks = [_track(*each, late_m) for each in places]
        notifier.report(tracks, [], {}, {})
        notifier.close(20, 1)
        return sorted(sent.read_text().split(), key=int)

    assert alerted((1, 0.0, 5, False), (2, 90.0, 6, True)) == ["1", "2"]
    # the same thing by another frame is known; a second one beside it, and what moves, are not
    assert alerted((3, 1.0, 8, False)) == ["1", "2"]
    assert alerted((4, 1.0, 8, False), (5, 1.5, 9, False)) == ["1", "2", "5"]
    assert alerted((6, 90.0, 7, True), (7, 90.0, 6, True)) == ["1", "2", "5", "6"]
    assert alerted((8, 50.0, 11, False)) == ["1", "2", "5", "6", "8"]
