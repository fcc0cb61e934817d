"""Stations over small made-up sites, which the tests of the station share."""

import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

pytest.importorskip("fastapi", reason="the extra `station` is not installed")

from fake_flights import SITE, map_flight
from starlette.testclient import TestClient

from sorvolo.station.app import station_app
from sorvolo.station.settings import StationSettings
from sorvolo.store.site.archive import Archive

HOST = "http://127.0.0.1:8750"


@pytest.fixture(scope="session")
def made_site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A site with a map and a comparison of four changes; not to be written to."""
    folder = tmp_path_factory.mktemp("made") / "field"
    with Archive.open(folder, write=True) as archive:
        archive.create_site(SITE)
        map_flight(archive, "a", 40)
        map_flight(archive, "b", 90, compared=True)
    return folder


@pytest.fixture
def root(made_site: Path, tmp_path: Path) -> Path:
    """A folder with the site `field` of its own."""
    shutil.copytree(made_site, tmp_path / "maps" / "field")
    return tmp_path / "maps"


@pytest.fixture
def client(root: Path) -> Iterator[TestClient]:
    """A browser on the station's own machine."""
    with TestClient(
        station_app(StationSettings(root)), base_url=HOST, client=("127.0.0.1", 5000)
    ) as client:
        yield client


@pytest.fixture(scope="module")
def reader(made_site: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[TestClient]:
    """A browser at a station that all tests of a module share: for requests that change nothing there."""
    root = tmp_path_factory.mktemp("shared") / "maps"
    shutil.copytree(made_site, root / "field")
    with TestClient(
        station_app(StationSettings(root)), base_url=HOST, client=("127.0.0.1", 5000)
    ) as client:
        yield client
