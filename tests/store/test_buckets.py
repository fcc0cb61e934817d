"""A site copied to an object store and back; two writers, none of whom loses anything."""

import json
import shutil
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import fake_flights
import numpy as np
import pytest
import rasterio
from fake_bucket import BUCKET, served_bucket
from fake_flights import hashes, mapped_site

from ended_work import ended
from sorvolo.errors import StoreError
from sorvolo.store.copies.bucket import MANIFEST, BucketEnd, prune
from sorvolo.store.copies.folder import FolderEnd
from sorvolo.store.copies.object_store import Objects, open_objects
from sorvolo.store.copies.transfer import CopyOutcome, SiteEnd, copy, verify
from sorvolo.store.site.archive import Archive
from sorvolo.survey.findings import Verdict


@pytest.fixture(scope="module")
def bucket() -> Iterator[str]:
    with served_bucket() as endpoint:
        yield endpoint


@pytest.fixture
def memory() -> Objects:
    store = pytest.importorskip(
        "obstore.store", reason="object stores need obstore: pip install 'sorvolo[s3]'"
    )
    return Objects(store.MemoryStore(), "memory://site")


def copied(source: SiteEnd, target: SiteEnd) -> CopyOutcome:
    with tempfile.TemporaryDirectory() as scratch:
        return ended(copy(source, target, Path(scratch)))


def verified(source: SiteEnd, target: SiteEnd) -> CopyOutcome:
    with tempfile.TemporaryDirectory() as scratch:
        return ended(verify(source, target, Path(scratch)))


def map_again(site: Path, flight: str, colour: int) -> None:
    with Archive.open(site, write=True) as archive:
        fake_flights.map_flight(archive, flight, colour, count=2, compared=True)


def test_a_site_goes_to_s3_and_back(bucket: str, site: Path, tmp_path: Path) -> None:
    there = BucketEnd(open_objects(f"s3://{BUCKET}/maps/field"))
    outcome = copied(FolderEnd(site), there)
    assert outcome.copied == outcome.files and not outcome.faults
    assert (
        copied(FolderEnd(site), BucketEnd(open_objects(f"s3://{BUCKET}/maps/field"))).copied_bytes
        < outcome.bytes
    )
    assert not verified(FolderEnd(site), there).faults
    back = tmp_path / "back"
    assert copied(there, FolderEnd(back)).copied == outcome.files
    assert hashes(back) == hashes(site)
    fake_flights.check_whole(back)
    assert copied(there, FolderEnd(back)).copied == 0  # nothing travels twice
    assert not verified(there, FolderEnd(back)).faults
    map_again(back, "flight-2", 80)
    assert copied(FolderEnd(back), there).newest == 3
    manifest = json.loads(open_objects(f"s3://{BUCKET}/maps/field").read(MANIFEST, 1 << 20)[0])
    assert manifest["generation"] == 2 and len(manifest["versions"]) == 3


def test_a_site_goes_from_store_to_store(bucket: str, site: Path, tmp_path: Path) -> None:
    first, second = (
        BucketEnd(open_objects(f"s3://{BUCKET}/{name}/field")) for name in ("first", "second")
    )
    outcome = copied(FolderEnd(site), first)
    assert copied(first, second).copied == outcome.files
    assert not verified(FolderEnd(site), second).faults
    assert copied(first, second).copied == 0
    copied(second, FolderEnd(tmp_path / "back"))
    assert hashes(tmp_path / "back") == hashes(site)


def test_gdal_reads_the_map_where_it_lies(bucket: str, site: Path) -> None:
    copied(FolderEnd(site), BucketEnd(open_objects(f"s3://{BUCKET}/gis")))
    options = {
        "AWS_S3_ENDPOINT": bucket.removeprefix("http://"),
        "AWS_HTTPS": "NO",
        "AWS_VIRTUAL_HOSTING": "FALSE",
        "CPL_VSIL_CURL_ALLOWED_EXTENSIONS": ".tif",
    }
    with (
        rasterio.Env(**options),
        rasterio.open(f"/vsis3/{BUCKET}/gis/mosaic.tif") as there,
        rasterio.open(site / "mosaic.tif") as here,
    ):
        assert there.crs == here.crs and there.transform == here.transform
        assert np.array_equal(there.read(), here.read())


def test_only_new_bytes_travel(memory: Objects, site: Path) -> None:
    first = copied(FolderEnd(site), BucketEnd(memory))
    before = memory.sizes("")
    map_again(site, "flight-1", 120)
    outcome = copied(FolderEnd(site), BucketEnd(memory))
    assert outcome.newest == 3 and outcome.copied_bytes < first.bytes
    new = memory.sizes("").keys() - before.keys()
    assert not any(key.startswith("tiles/") and key in before for key in new)
    assert memory.sizes("")["mosaic.tif"] == (site / "mosaic.tif").stat().st_size
    assert memory.opened("mosaic.tif", 10**6).read(4) == (site / "mosaic.tif").read_bytes()[:4]


class _Overtaken(BucketEnd):
    """A writer who is overtaken by another one just before the manifest is replaced."""

    def __init__(self, objects: Objects, other: Path, base: str | None = None) -> None:
        super().__init__(objects, base)
        self.other = other

    def _swap(self, manifest) -> None:  # type: ignore[no-untyped-def]
        copied(FolderEnd(self.other), BucketEnd(self._objects))
        super()._swap(manifest)


def test_of_two_writers_one_wins_and_the_other_loses_nothing(
    bucket: str, site: Path, tmp_path: Path
) -> None:
    objects = open_objects(f"s3://{BUCKET}/race")
    other = Path(shutil.copytree(site, tmp_path / "other"))
    copied(FolderEnd(site), BucketEnd(objects))
    map_again(site, "mine", 90)
    map_again(other, "theirs", 140)
    mine = hashes(site)
    with pytest.raises(
        StoreError, match="another writer has changed the site at s3://archive/race meanwhile"
    ):
        copied(FolderEnd(site), _Overtaken(objects, other))
    assert not verified(FolderEnd(other), BucketEnd(objects)).faults
    assert hashes(site) == mine
    with pytest.raises(StoreError, match="holds what the source of the copy lacks: version 3"):
        copied(FolderEnd(site), BucketEnd(objects))


def test_of_two_first_writers_one_wins(memory: Objects, site: Path) -> None:
    with pytest.raises(StoreError, match="another writer"):
        copied(FolderEnd(site), _Overtaken(memory, site))
    assert BucketEnd(memory).manifest().generation == 1


def test_a_working_copy_replaces_only_what_it_was_made_of(memory: Objects, site: Path) -> None:
    first = BucketEnd(memory)
    copied(FolderEnd(site), first)
    with Archive.open(site, write=True) as archive:
        change = archive.changes()[0].id
        archive.review(change, Verdict.REJECTED)
    second = BucketEnd(memory, base=first.written.id)
    copied(FolderEnd(site), second)
    with Archive.open(site, write=True) as archive:
        archive.review([change], None)
    with pytest.raises(StoreError, match="another writer"):
        copied(FolderEnd(site), BucketEnd(memory, base=first.written.id))
    with pytest.raises(StoreError, match="lacks: the review of change"):
        copied(FolderEnd(site), BucketEnd(memory))
    copied(FolderEnd(site), BucketEnd(memory, base=second.written.id))
    assert BucketEnd(memory).manifest().held.reviews == {}


class _LostAnswer(Objects):
    """A store whose answer to the replaced manifest is lost."""

    def swap(self, key: str, data: bytes, etag: str) -> None:
        super().swap(key, data, etag)
        raise StoreError("the connection was cut")


def test_a_lost_answer_is_no_conflict(memory: Objects, site: Path) -> None:
    lossy = _LostAnswer(memory._store, "memory://site")
    copied(FolderEnd(site), BucketEnd(lossy))
    assert BucketEnd(memory).manifest().held.newest == 2


def test_other_objects_and_other_sites_are_not_overwritten(
    memory: Objects, site: Path, tmp_path: Path
) -> None:
    import obstore

    obstore.put(memory._store, "holiday.jpg", b"x")
    with pytest.raises(StoreError, match=r"no site \(there is 'holiday.jpg'\)"):
        copied(FolderEnd(site), BucketEnd(memory))
    memory.remove(["holiday.jpg"])
    copied(FolderEnd(site), BucketEnd(memory))
    with pytest.raises(StoreError, match="holds another site"):
        copied(FolderEnd(mapped_site(tmp_path / "another")), BucketEnd(memory))
    with pytest.raises(StoreError, match="no site at memory://site"):
        copied(
            BucketEnd(Objects(obstore.store.MemoryStore(), "memory://site")),
            FolderEnd(tmp_path / "back"),
        )


def test_damage_in_the_store_is_found_and_named(
    memory: Objects, site: Path, tmp_path: Path
) -> None:
    import obstore

    copied(FolderEnd(site), BucketEnd(memory))
    tiles = sorted(memory.sizes("tiles"))
    size = memory.sizes("tiles")[tiles[0]]
    obstore.put(memory._store, tiles[0], b"x" * size)
    memory.remove([tiles[1]])
    expected = {tiles[0]: "damaged", tiles[1]: "missing"}
    assert verified(FolderEnd(site), BucketEnd(memory)).faults == expected
    assert copied(BucketEnd(memory), FolderEnd(tmp_path / "back")).faults == expected


def test_what_no_state_names_is_removed_and_all_else_stays(
    memory: Objects, site: Path, tmp_path: Path
) -> None:
    copied(FolderEnd(site), BucketEnd(memory))
    before = set(memory.sizes(""))
    map_again(site, "flight-1", 120)
    copied(FolderEnd(site), BucketEnd(memory))
    assert prune(memory, 3600.0).objects == 0  # too young
    stored = memory.sizes("")
    counted = prune(memory, -1.0, only_count=True)
    assert memory.sizes("") == stored
    pruned = prune(memory, -1.0)
    assert pruned == counted and pruned.objects == len(stored) - len(memory.sizes("")) > 0
    assert before - set(memory.sizes(""))
    assert not verified(FolderEnd(site), BucketEnd(memory)).faults
    assert prune(memory, -1.0).objects == 0


def test_no_writer_relies_on_what_is_being_removed(memory: Objects, site: Path) -> None:
    copied(FolderEnd(site), BucketEnd(memory))
    map_again(site, "flight-2", 120)

    class Pruned(BucketEnd):
        def _swap(self, manifest) -> None:  # type: ignore[no-untyped-def]
            prune(memory, -1.0)
            super()._swap(manifest)

    with pytest.raises(StoreError, match="another writer"):
        copied(FolderEnd(site), Pruned(memory))
    manifest, etag = BucketEnd(memory).find_manifest()
    assert manifest is not None
    memory.swap(
        MANIFEST, replace(manifest, tidying="2026-11-23T05:00:00+00:00").data(), etag
    )  # a prune was killed
    with pytest.raises(
        StoreError, match=r"has been pruned since 2026-11-23.*sorvolo site prune memory://site"
    ):
        copied(FolderEnd(site), BucketEnd(memory))
    prune(memory, -1.0)
    copied(FolderEnd(site), BucketEnd(memory))
    assert not verified(FolderEnd(site), BucketEnd(memory)).faults


@pytest.mark.parametrize(
    "path",
    [
        "../outside.txt",
        "/etc/passwd",
        "flights/../../x.txt",
        "flights/a/run.journal",
        "site.db",
        "tiles/aa/no.png",
        5,
    ],
)
def test_a_manifest_that_was_made_to_do_harm_is_refused(
    memory: Objects, site: Path, tmp_path: Path, path: object
) -> None:
    copied(FolderEnd(site), BucketEnd(memory))
    data, etag = memory.read(MANIFEST, 1 << 20)
    row = json.loads(data)
    first = next(iter(row["files"].values()))
    row["files"] = dict(row["files"]) | {path: first}  # type: ignore[dict-item]
    if path == 5:
        row["files"] = [1, 2]
    memory.swap(MANIFEST, json.dumps(row).encode(), etag)
    with pytest.raises(StoreError, match=r"made to do harm|is damaged, or no Sorvolo wrote it"):
        copied(BucketEnd(memory), FolderEnd(tmp_path / "back"))
    assert not (tmp_path / "back/site.db").exists()


def test_a_later_format_is_refused(memory: Objects, site: Path, tmp_path: Path) -> None:
    copied(FolderEnd(site), BucketEnd(memory))
    data, etag = memory.read(MANIFEST, 1 << 20)
    memory.swap(MANIFEST, json.dumps(json.loads(data) | {"format_version": 2}).encode(), etag)
    with pytest.raises(StoreError, match="written in format 2, this Sorvolo reads 1"):
        copied(BucketEnd(memory), FolderEnd(tmp_path / "back"))
