"""The maps of all sites followed: a site that goes is announced once, whenever its folder is looked at meanwhile."""

import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from sorvolo.station import map_watch, sites
from sorvolo.station.app import Station
from sorvolo.station.settings import StationSettings


@pytest.fixture
def station(root: Path) -> Iterator[Station]:
    """A station whose threads do not run: the tests look."""
    made = Station.open(StationSettings(root))
    yield made
    made.close()


def gone(station: Station) -> list[str]:
    """The sites that were announced to be gone."""
    return [each["site"] for each in station.events.after(0) if each["type"] == "site.gone"]


@pytest.mark.parametrize("looks_again_s", [60.0, 0.0])
def test_a_site_that_goes_is_announced_once(
    station: Station, root: Path, monkeypatch: pytest.MonkeyPatch, looks_again_s: float
) -> None:
    """Whether it is found to be gone when it is opened, or when folders are looked for: every second."""
    monkeypatch.setattr(sites, "_LOOK_EVERY_S", looks_again_s)
    station.map_watch.look()
    shutil.rmtree(root / "field")
    for _ in range(3):
        station.map_watch.look()
    assert gone(station) == ["field"]


def test_a_site_that_is_deleted_file_by_file_is_announced(station: Station, root: Path) -> None:
    """It cannot be read for a while before its catalogue goes."""
    station.map_watch.look()
    station.shelf.forget("field")
    (root / "field" / "site.db").write_bytes(b"no database")
    station.map_watch.look()
    shutil.rmtree(root / "field")
    station.map_watch.look()
    station.map_watch.look()
    assert gone(station) == ["field"]


def test_a_site_deleted_before_the_first_look_is_announced(
    station: Station, root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A page may have listed it by then."""
    monkeypatch.setattr(
        map_watch, "_LOOK_EVERY_S", 60.0
    )  # the station's own thread does not look: the test does
    station.map_watch.start()
    shutil.rmtree(root / "field")
    station.shelf.forget("field")
    station.map_watch.look()
    assert gone(station) == ["field"]
