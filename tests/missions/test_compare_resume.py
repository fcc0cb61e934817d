"""A comparison that was killed goes on where it was, and ends with the bytes of one that was not."""

import json
import shutil
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from test_map_resume import Seeing, content, failing

from killed_copy import copy_as_killed
from small_flights import simulate_into, small_flight
from sorvolo.change.views import ViewMaker
from sorvolo.errors import DiskFullError, SorvoloWarning, StoreError
from sorvolo.lab.simulation.settings import LaterSettings
from sorvolo.missions.compare.flights import compare_flights
from sorvolo.missions.compare.run import CompareRun
from sorvolo.missions.flight.settings import CompareSettings, MapSettings
from sorvolo.missions.map.flights import map_flights
from sorvolo.mosaic.planar import PlanarMapper
from sorvolo.survey.findings import CompareUpdate

_PAIR = replace(
    small_flight(43, height_m=14, speed_m_s=4, length_m=18, cars=1, small_objects=3),
    flights=2,
    later=LaterSettings(people=0, cars=1, small_objects=3, removed=2, moved=0),
)
_SETTINGS = CompareSettings(model="none", writes_masks=True)
_KILLED_AT = 15  # frames


def compared(
    flown: Path,
    site: Path,
    settings: CompareSettings = _SETTINGS,
    then: Callable[[int], None] = lambda _: None,
) -> list[CompareUpdate]:
    """Compare the second flight; `then` is called after each frame, with their number."""
    updates = []
    for each in compare_flights(
        [flown / "flight2"], site, settings, camera=flown / "camera.xml", detector=Seeing(flown)
    ):
        updates.append(each)
        then(len(updates))
    return updates


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two flights along one strip, the second finding other objects."""
    folder = tmp_path_factory.mktemp("pair") / "flown"
    return simulate_into(folder, _PAIR)


@pytest.fixture(scope="module")
def whole(flown: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A site that nobody killed, whose map the second flight extends, and a copy of it amid the comparison."""
    folder = tmp_path_factory.mktemp("resume")
    site, amid = (folder / name / "site" for name in ("whole", "amid"))
    places = np.loadtxt(
        flown / "flight1" / "flight1.csv", delimiter=",", skiprows=1, usecols=(3, 4)
    )
    west, middle, north = places[0, 0] - 1e-3, places[:, 0].mean(), places[0, 1]
    ring = [
        [west, north - 1e-3],
        [middle, north - 1e-3],
        [middle, north + 1e-3],
        [west, north + 1e-3],
    ]
    (folder / "west.geojson").write_text(
        json.dumps({"type": "Polygon", "coordinates": [[*ring, ring[0]]]})
    )
    for _ in map_flights(
        [flown / "flight1"],
        site,
        MapSettings(model="none"),
        camera=flown / "camera.xml",
        area=folder / "west.geojson",
    ):
        pass
    compared(flown, site, then=lambda count: count != _KILLED_AT or copy_as_killed(site, amid))
    return site, amid


@pytest.fixture
def worked(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """What is compared with the map, registered and detected from now on."""
    done: list[str] = []

    def counted(owner: type, name: str) -> None:
        work = getattr(owner, name)

        def noted(*args: object, **kwargs: object) -> object:
            done.append(name)
            return work(*args, **kwargs)

        monkeypatch.setattr(owner, name, noted)

    counted(ViewMaker, "compare_with_map")
    counted(PlanarMapper, "register")
    return done


def copy(site: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(site, tmp_path / "site"))


def test_it_goes_on_where_it_was(
    whole: tuple[Path, Path], flown: Path, tmp_path: Path, worked: list[str]
) -> None:
    site = copy(whole[1], tmp_path)
    updates = compared(flown, site)
    assert [each.is_resumed for each in updates] == [
        number < _KILLED_AT for number in range(len(updates))
    ]
    assert worked.count("compare_with_map") == len(updates) - _KILLED_AT > 3
    assert content(site) == content(whole[0])
    report = json.loads((site / "flights" / "flight2" / "report.json").read_text())
    assert (
        0 < worked.count("register") < report["comparison"]["extension"]["frames"]
    )  # both parts extended the map
    assert report["objects"]["sightings"] and sum(report["comparison"]["changes"].values())
    assert not list(site.rglob("run.journal"))


def test_after_a_full_disk_it_goes_on(
    whole: tuple[Path, Path], flown: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    site = copy(whole[1], tmp_path)
    with monkeypatch.context() as patch:
        failing(patch, DiskFullError("disk full: could not write it"), count=4)
        with pytest.raises(DiskFullError):
            compared(flown, site)
    assert sum(each.is_resumed for each in compared(flown, site)) > _KILLED_AT
    assert content(site) == content(whole[0])
    assert not list(site.rglob("run.journal"))


@pytest.mark.parametrize(
    ("free", "expected"), [(10**8, ""), (10**6, "may become full"), (2 * 10**5, "free some")]
)
def test_a_disk_too_full_for_the_new_version_is_announced(
    whole: tuple[Path, Path],
    flown: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    free: int,
    expected: str,
) -> None:
    monkeypatch.setattr(
        shutil, "disk_usage", lambda _: shutil._ntuple_diskusage(2 * free, free, free)
    )  # type: ignore[attr-defined]
    monkeypatch.setattr(CompareRun, "__enter__", begun)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        with pytest.raises((StoreError, InterruptedError)) as ended:
            compared(flown, copy(whole[1], tmp_path))
    texts = [str(ended.value), *(str(each.message) for each in caught)]
    found = [
        each
        for each in texts
        if "the new version of the map after comparing flight2 needs about" in each
    ]
    assert len(found) == bool(expected) and all(expected in each for each in found), texts
    assert isinstance(ended.value, InterruptedError) == (expected != "free some")


def begun(_: CompareRun) -> CompareRun:
    raise InterruptedError("the work began")


def test_other_settings_begin_anew_and_report_it(
    whole: tuple[Path, Path], flown: Path, tmp_path: Path
) -> None:
    site = copy(whole[1], tmp_path)
    with pytest.warns(
        SorvoloWarning, match="flight2: a run that was stopped cannot continue: .* other settings"
    ):
        updates = compare_flights(
            [flown / "flight2"],
            site,
            CompareSettings(model="none", votes=2),
            camera=flown / "camera.xml",
        )
        assert not next(updates).is_resumed
        updates.cancel()
    assert not (site / "flights" / "flight2").exists()


def test_another_flight_names_whose_run_it_ends(
    whole: tuple[Path, Path], flown: Path, tmp_path: Path
) -> None:
    site = copy(whole[1], tmp_path)
    with pytest.warns(
        SorvoloWarning,
        match="a run of flight2 was stopped before it was complete, and cannot continue",
    ):
        updates = map_flights(
            [flown / "flight1"],
            site,
            MapSettings(model="none"),
            camera=flown / "camera.xml",
            again=True,
        )
        next(updates)
        updates.cancel()
