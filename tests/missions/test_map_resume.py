"""A mapping that was killed goes on where it was, and ends with the bytes of one that was not."""

import errno
import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from truth_detector import TruthDetector

from killed_copy import copy_as_killed
from sorvolo.cli.main import main
from sorvolo.errors import DiskFullError, InputError
from sorvolo.geometry.arrays import ImageRGB
from sorvolo.missions.flight.settings import MapSettings
from sorvolo.missions.map.flights import map_flights
from sorvolo.missions.map.planar_run import PlanarRun
from sorvolo.mosaic.planar import PlanarMapper
from sorvolo.store.site.database import ConnectionLostError
from sorvolo.store.site.flight_writer import FlightWriter
from sorvolo.store.site.journal import Entry, RunJournal, _packed
from sorvolo.survey.flight import PosedFrame
from sorvolo.survey.mosaic import MosaicUpdate, Status
from sorvolo.survey.objects import Detections

_EFFORT = ("seconds", "cpu_s", "registration_cpu_s_per_keyframe", "peak_memory_mb", "reading")
_KILLED_AT = 9  # frames


class Seeing(TruthDetector):
    """Sees a car somewhere in every picture, the same place in the same picture."""

    def detect(self, image: ImageRGB, **_: object) -> Detections:  # type: ignore[override]
        """One box."""
        x = 40 + float(image.mean()) % 100
        return Detections(
            np.array([[x, 60, x + 60, 100]]), np.array([0.9]), np.array([1]), self.classes
        )


class Stopping(PlanarRun):
    """Stops when the first frame comes."""

    def add(self, posed: PosedFrame) -> tuple[Status, str, int]:
        raise InputError("the work began")


def content(site: Path) -> dict[str, bytes]:
    """All files but the catalogue, without what a run took."""
    found = {}
    for path in sorted(site.rglob("*")):
        if path.is_file() and not path.name.startswith("site.") and path.name != "report.html":
            data = path.read_bytes()
            if path.name == "report.json":
                report = json.loads(data)
                report["objects"].pop("seconds", None)
                data = json.dumps(
                    {key: value for key, value in report.items() if key not in _EFFORT}
                ).encode()
            found[str(path.relative_to(site))] = data
    return found


def mapped(
    filmed: Path,
    site: Path,
    settings: MapSettings = MapSettings(),
    then: Callable[[int], None] = lambda _: None,
) -> list[MosaicUpdate]:
    """Map the flight; `then` is called after each frame, with their number."""
    updates = []
    for each in map_flights(
        [filmed / "flight1" / "flight1.mp4"],
        site,
        settings,
        camera="aov=70",
        detector=Seeing(filmed),
    ):
        updates.append(each)
        then(len(updates))
    return updates


def failing(patch: pytest.MonkeyPatch, fault: Exception, count: int) -> None:
    """Entries of journals fail from the `count`-th on, in the middle of being written."""
    begun, appended = RunJournal._begun, []

    def half(self: RunJournal, entry: Entry) -> None:
        appended.append(entry)
        with self._lock:
            file = self._file or begun(self)
            data = _packed(entry)
            file.write(data if len(appended) < count else data[: len(data) // 2])
            file.flush()
        if len(appended) >= count:
            raise fault

    patch.setattr(RunJournal, "append", half)


def copy_at(count: int, site: Path, amid: Path) -> None:
    """Copy the site in the middle of the flight."""
    if count == _KILLED_AT:
        copy_as_killed(site, amid)


@pytest.fixture(scope="module")
def whole(filmed: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, Path]:
    """A site that nobody killed, and copies of it amid the flight and just before the commit: what a kill leaves."""
    folder = tmp_path_factory.mktemp("resume")
    site, amid, late = (folder / name / "site" for name in ("whole", "amid", "late"))
    commit = FlightWriter.commit

    def copied(self: FlightWriter, *args: object, **kwargs: object) -> int:
        copy_as_killed(site, late)
        return commit(self, *args, **kwargs)  # type: ignore[arg-type]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(FlightWriter, "commit", copied)
        mapped(filmed, site, then=lambda count: copy_at(count, site, amid))
    return site, amid, late


@pytest.fixture
def registered(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The frames that are registered from now on."""
    ids: list[int] = []
    register = PlanarMapper.register

    def counted(self: PlanarMapper, keyframe_id: int, *args: object) -> object:
        ids.append(keyframe_id)
        return register(self, keyframe_id, *args)  # type: ignore[arg-type]

    monkeypatch.setattr(PlanarMapper, "register", counted)
    return ids


def copy(site: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(site, tmp_path / "site"))


def test_it_goes_on_where_it_was(
    whole: tuple[Path, ...], filmed: Path, tmp_path: Path, registered: list[int]
) -> None:
    site = copy(whole[1], tmp_path)
    updates = mapped(filmed, site)
    assert [each.is_resumed for each in updates] == [
        number < _KILLED_AT for number in range(len(updates))
    ]
    assert len(registered) == len(updates) - _KILLED_AT > 3
    assert content(site) == content(whole[0])
    assert not list(site.rglob("run.journal")) and not list(site.rglob(".tmp-*"))


FAULTS = (
    DiskFullError("disk full: could not write it"),
    OSError(errno.ENOSPC, "No space left on device"),
    ConnectionLostError("no connection to the catalogue"),
)


def test_after_a_full_disk_or_a_lost_catalogue_it_goes_on(
    whole: tuple[Path, ...], filmed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One run after the other ends early, each with another fault, until the last one is complete."""
    site = tmp_path / "site"
    for fault, count in zip(FAULTS, (9, 4, 4), strict=True):
        with monkeypatch.context() as patch:
            failing(patch, fault, count)
            with pytest.raises(type(fault)):
                mapped(filmed, site)
        assert not (site / "mosaic.tif").exists()
    assert sum(each.is_resumed for each in mapped(filmed, site)) > 1
    assert content(site) == content(whole[0])
    assert not list(site.rglob("run.journal")) and not list(site.rglob(".tmp-*"))


def test_it_goes_on_among_the_key_frames_of_a_stream(keyed: Path, tmp_path: Path) -> None:
    settings, amid = MapSettings(model="none"), tmp_path / "amid" / "site"
    for number, _ in enumerate(
        map_flights([keyed], tmp_path / "site", settings, camera="aov=70"), 1
    ):
        copy_at(number, tmp_path / "site", amid)
    assert any([each.is_resumed for each in map_flights([keyed], amid, settings, camera="aov=70")])
    assert content(amid) == content(tmp_path / "site")


def test_killed_before_the_commit_nothing_is_registered_again(
    whole: tuple[Path, ...], filmed: Path, tmp_path: Path, registered: list[int]
) -> None:
    assert list(
        whole[2].rglob(".tmp-original-*")
    )  # pictures were straightened, and the first ones kept
    site = copy(whole[2], tmp_path)
    assert all(each.is_resumed for each in mapped(filmed, site))
    assert not registered
    assert content(site) == content(whole[0])


def test_a_picture_that_is_damaged_is_stored_again(
    whole: tuple[Path, ...], filmed: Path, tmp_path: Path, registered: list[int]
) -> None:
    site = copy(whole[1], tmp_path)
    sorted(site.glob("flights/*/keyframes/*/*.jpg"))[5].write_bytes(b"")
    updates = mapped(filmed, site)
    assert sum(each.is_resumed for each in updates) == _KILLED_AT
    assert len(registered) == sum(not each.is_resumed for each in updates)
    assert content(site) == content(whole[0])


def test_another_command_begins_anew(whole: tuple[Path, ...], filmed: Path, tmp_path: Path) -> None:
    site = copy(whole[1], tmp_path)
    left = set(site.glob("flights/*/keyframes/*/*"))
    updates = map_flights(
        [filmed / "flight1" / "flight1.mp4"],
        site,
        MapSettings(overlap=0.6, model="none"),
        camera="aov=70",
    )
    assert not next(updates).is_resumed
    assert left and not set(site.glob("flights/*/keyframes/*/*"))
    updates.cancel()
    assert not list(site.glob("flights/*"))


@pytest.mark.parametrize(
    ("free", "expected"),
    [(1_000_000_000, ""), (20_000_000, "may become full"), (5_000_000, "free some")],
)
def test_a_disk_too_full_is_announced_before_the_work_begins(
    filmed: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    free: int,
    expected: str,
) -> None:
    monkeypatch.setattr(
        shutil, "disk_usage", lambda _: shutil._ntuple_diskusage(2 * free, free, free)
    )  # type: ignore[attr-defined]
    video, site = filmed / "flight1" / "flight1.mp4", tmp_path / "site"
    run = "sorvolo.missions.map.flights.PlanarRun"
    monkeypatch.setattr(run, Stopping)
    assert (
        main(["map", str(video), "--site", str(site), "--camera", "aov=70", "--model", "none"]) == 1
    )
    printed = capsys.readouterr().err
    if expected:
        figures = rf"has {free // 1_000_000} MB free, and the map of flight1 needs about \d+ MB "
        assert re.search(rf"{figures}.*{expected}", printed)
    assert ("the work began" in printed) == (expected != "free some")
