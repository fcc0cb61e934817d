"""Sites of a bucket served by a station, and kept in step with it both ways."""

import os
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
from fake_bucket import BUCKET, served_bucket
from starlette.testclient import TestClient

from ended_work import ended
from sorvolo.missions.site.copy import copy_site
from sorvolo.station.app import station_app
from sorvolo.station.settings import StationSettings
from sorvolo.station.store_root import StoreRoot
from sorvolo.store.copies.bucket import BucketEnd
from sorvolo.store.copies.object_store import open_objects
from sorvolo.store.site.archive import Archive
from sorvolo.store.site.files import lock_folder
from sorvolo.survey.findings import Verdict

ADDRESS = f"s3://{BUCKET}/maps"


@pytest.fixture
def bucket(made_site: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    monkeypatch.setenv("SORVOLO_CACHE", str(tmp_path / "cache"))
    with served_bucket() as endpoint:
        ended(copy_site(str(made_site), f"{ADDRESS}/field"))
        yield endpoint


def reviewed(site: Path, verdict: Verdict) -> str:
    with Archive.open(site, write=True) as archive:
        change = archive.changes()[0].id
        archive.review(change, verdict)
    return change


def verdicts(address: str) -> dict[str, str]:
    return dict(BucketEnd(open_objects(address)).manifest().held.reviews)


def test_a_station_serves_the_sites_of_a_bucket(bucket: str) -> None:
    root = StoreRoot(ADDRESS)
    assert ended(root.step()) == {}
    with TestClient(
        station_app(StationSettings(root.folder)),
        base_url="http://127.0.0.1:8750",
        client=("127.0.0.1", 5000),
    ) as client:
        sites = client.get("/api/sites").json()
        assert [each["id"] for each in sites] == ["field"] and sites[0]["versions"] == 2
        assert not list(root.folder.glob("field/tiles/*/*"))
        with Archive.open(root.folder / "field", write=False) as archive:
            index, tile = next(iter(archive.tiles(1).items()))  # fetched now
            assert tile.shape == (512, 512, 4) and index in archive.tiles(1)
        assert len(list(root.folder.glob("field/tiles/*/*"))) == 1


def test_both_sides_stay_in_step(bucket: str, made_site: Path, tmp_path: Path) -> None:
    root = StoreRoot(ADDRESS)
    ended(root.step())
    change = reviewed(root.folder / "field", Verdict.CONFIRMED)
    assert ended(root.step()) == {} and change in verdicts(f"{ADDRESS}/field")
    generation = BucketEnd(open_objects(f"{ADDRESS}/field")).manifest().generation
    assert ended(root.step()) == {}
    assert BucketEnd(open_objects(f"{ADDRESS}/field")).manifest().generation == generation
    shutil.copytree(made_site, root.folder / "new")  # as a mission of the station makes one
    other = tmp_path / "other"
    ended(copy_site(f"{ADDRESS}/field", str(other)))
    reviewed(other, Verdict.REJECTED)
    ended(copy_site(str(other), f"{ADDRESS}/field"))
    lock = lock_folder(root.folder / "field")  # a mission writes it: it waits
    try:
        assert ended(root.step()) == {}
        with Archive.open(root.folder / "field", write=False) as archive:
            assert archive.changes()[0].verdict is Verdict.CONFIRMED
    finally:
        os.close(lock)
    assert ended(root.step()) == {}
    with Archive.open(root.folder / "field", write=False) as archive:
        assert archive.changes()[0].verdict is Verdict.REJECTED
    assert BucketEnd(open_objects(f"{ADDRESS}/new")).manifest().held.newest == 2


def test_a_station_that_is_overtaken_keeps_its_work(
    bucket: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    root, other = StoreRoot(ADDRESS), tmp_path / "other"
    ended(root.step())
    ended(copy_site(f"{ADDRESS}/field", str(other)))
    reviewed(root.folder / "field", Verdict.CONFIRMED)
    reviewed(other, Verdict.REJECTED)
    ended(copy_site(str(other), f"{ADDRESS}/field"))
    assert ended(root.step()) == {} and "another writer has changed field" in caplog.text
    kept = next(root.folder.glob("field-kept-*"))
    for folder, verdict in ((kept, Verdict.CONFIRMED), (root.folder / "field", Verdict.REJECTED)):
        with Archive.open(folder, write=False) as archive:
            assert archive.changes()[0].verdict is verdict
    assert ended(root.step()) == {}


def test_a_place_that_is_a_site_itself(bucket: str) -> None:
    root = StoreRoot(f"{ADDRESS}/field")
    assert ended(root.step()) == {}
    assert [each.name for each in root.folder.iterdir()] == ["field"]
    assert ended(root.step()) == {}
