"""A site copied to another folder: whole, whatever is killed or written meanwhile, and never over what it lacks."""

import contextlib
import os
import random
import shutil
import signal
import tempfile
import time
from contextlib import AbstractContextManager
from pathlib import Path
from typing import BinaryIO

import fake_flights
import pytest
from fake_flights import hashes, mapped_site

from ended_work import ended
from sorvolo.errors import StoreError
from sorvolo.store.copies.folder import FolderEnd, SiteFile, SiteState
from sorvolo.store.copies.transfer import CopyOutcome, copy, verify
from sorvolo.store.site.archive import Archive
from sorvolo.store.site.files import COPYING
from sorvolo.survey.findings import Verdict


def copied(source: Path, target: Path) -> CopyOutcome:
    return ended(
        copy(FolderEnd(source), FolderEnd(target), Path(tempfile.mkdtemp(dir=target.parent)))
    )


def verified(source: Path, target: Path) -> CopyOutcome:
    return ended(
        verify(FolderEnd(source), FolderEnd(target), Path(tempfile.mkdtemp(dir=target.parent)))
    )


def test_a_copy_has_every_file_of_the_site_and_can_be_worked_in(
    two_flights: Path, tmp_path: Path
) -> None:
    target = tmp_path / "copy"
    outcome = copied(two_flights, target)
    assert outcome.copied == outcome.files and outcome.newest == 2 and not outcome.faults
    assert hashes(target) == hashes(two_flights)
    again = copied(two_flights, target)
    assert again.copied == 0 and again.files == outcome.files
    assert not verified(two_flights, target).faults
    with Archive.open(target, write=True) as archive:
        fake_flights.map_flight(archive, "flight-9", 90, count=2, compared=True)
    fake_flights.check_whole(target)


def test_a_later_copy_takes_what_is_new_and_drops_what_is_gone(site: Path, tmp_path: Path) -> None:
    target = tmp_path / "copy"
    first = copied(site, target)
    with Archive.open(site, write=True) as archive, Archive.open(target, write=False) as reader:
        fake_flights.map_flight(
            archive, "flight-0", 99, count=2, compared=True
        )  # its former pictures are gone
        archive.review(archive.changes()[0].id, Verdict.REJECTED)
        (site / "flights/flight-1/heights.json").write_text("{}")
        second = copied(site, target)
        assert 0 < second.copied < first.files
        assert reader.versions()[-1].id == 3  # it was open meanwhile
    assert hashes(target) == hashes(site)
    fake_flights.check_whole(target)
    assert not verified(site, target).faults


def test_what_a_run_left_unfinished_is_left_out(site: Path, tmp_path: Path) -> None:
    (site / "notes.txt").write_text("mine")
    with Archive.open(site, write=True) as archive:
        before = archive.versions()[-1].id
        with archive.begin_flight("flight-7", "print", {}) as writer:
            writer.save_image(0, fake_flights.image(0))
            writer.tiles[5, 5] = fake_flights.tile(200)
            writer.flush()
            (site / "flights/flight-7/run.journal").write_text("sorvolo journal 1\n")
            outcome = copied(site, tmp_path / "copy")
    assert outcome.newest == before and outcome.left_out == ("notes.txt",)
    names = set(hashes(tmp_path / "copy"))
    assert not any("flight-7" in name or "notes" in name for name in names)
    assert len([name for name in names if name.startswith("tiles/")]) == len(
        list(site.glob("tiles/*/*"))
    )
    with Archive.open(tmp_path / "copy", write=False) as archive:
        assert not archive.is_growing
        assert [each.id for each in archive.flights()] == ["flight-0", "flight-1"]


class _MappedInto(FolderEnd):
    """A site into which flights are mapped while it is copied: one each time a first file is asked for."""

    def __init__(self, folder: Path, flights: int) -> None:
        super().__init__(folder)
        self.left = flights

    def state(self, scratch: Path) -> SiteState:
        self.is_new = True
        return super().state(scratch)

    def opened(self, file: SiteFile) -> AbstractContextManager[BinaryIO]:
        if self.is_new and self.left:
            self.left, self.is_new = self.left - 1, False
            with Archive.open(self.folder, write=True) as archive:
                fake_flights.map_flight(
                    archive, f"flight-{self.left % 2}", 70 + self.left, count=2, compared=True
                )
        return super().opened(file)


def test_a_copy_is_of_one_piece_though_flights_are_mapped_into_the_site_meanwhile(
    site: Path, tmp_path: Path
) -> None:
    source, target = _MappedInto(site, 2), tmp_path / "copy"
    scratch = tmp_path / "scratch"
    scratch.mkdir()
    outcome = ended(copy(source, FolderEnd(target), scratch, threads=1))
    assert source.left == 0 and outcome.newest == 4 and not outcome.faults
    assert hashes(target) == hashes(site)
    fake_flights.check_whole(target)
    with pytest.raises(StoreError, match="changes faster than it can be copied"):
        ended(
            copy(
                _MappedInto(site, 100),
                FolderEnd(tmp_path / "other"),
                scratch,
                threads=1,
                most_rounds=2,
            )
        )
    assert not (tmp_path / "other/site.db").exists()


def _killed(source: Path, target: Path, after_s: float) -> bool:
    """Copy in a process of its own, and kill it so long after its first file is there; whether it was killed."""
    child = os.fork()
    if child == 0:
        with contextlib.suppress(BaseException):
            copied(source, target)
        os._exit(0)
    while not os.waitpid(child, os.WNOHANG)[0]:
        if (target / COPYING).exists():
            time.sleep(after_s)
            os.kill(child, signal.SIGKILL)
            return os.WIFSIGNALED(os.waitpid(child, 0)[1])
        time.sleep(0.001)
    return False


def test_a_copy_that_is_killed_goes_on(site: Path, tmp_path: Path) -> None:
    target, chance, kills = tmp_path / "copy", random.Random(5), 0
    for _ in range(8):
        kills += _killed(site, target, chance.uniform(0, 0.08))
        fake_flights.check_whole(target) if (target / "site.db").exists() else None
        if (target / COPYING).exists():
            with pytest.raises(StoreError, match="not finished; run the same"):
                Archive.open(target, write=True)
    assert kills > 0
    copied(site, target)
    assert hashes(target) == hashes(site)
    fake_flights.check_whole(target)


def test_a_target_with_anything_else_is_refused(site: Path, tmp_path: Path) -> None:
    foreign = tmp_path / "foreign"
    foreign.mkdir()
    (foreign / "thesis.txt").write_text("mine")
    with pytest.raises(StoreError, match=r"holds no site \(there is 'thesis.txt'\)"):
        copied(site, foreign)
    assert list(foreign.iterdir()) == [foreign / "thesis.txt"]
    other = mapped_site(tmp_path / "other")
    before = hashes(other)
    with pytest.raises(StoreError, match="holds another site"):
        copied(site, other)
    with pytest.raises(StoreError, match="holds another site"):
        verified(site, other)
    (tmp_path / "file").write_text("")
    with pytest.raises(StoreError, match="is a file"):
        copied(site, tmp_path / "file")
    outside = tmp_path / "outside"
    outside.mkdir()
    linked = Path(shutil.copytree(site, tmp_path / "linked"))
    (linked / "flights/sneaky").symlink_to(outside)
    with pytest.raises(StoreError, match="is a link"):
        copied(site, linked)
    assert hashes(other) == before and not list(outside.iterdir())


@pytest.mark.parametrize("what", ["version", "review", "heights"])
def test_a_copy_that_was_worked_in_is_not_overwritten(
    site: Path, tmp_path: Path, what: str
) -> None:
    target = tmp_path / "copy"
    copied(site, target)
    if what == "heights":
        (target / "flights/flight-0/heights.tif").write_bytes(b"II*")
    else:
        with Archive.open(target, write=True) as archive:
            if what == "version":
                fake_flights.map_flight(archive, "flight-9", 90, count=2, compared=True)
            else:
                archive.review(archive.changes()[0].id, Verdict.CONFIRMED)
    before = hashes(target)
    with pytest.raises(StoreError, match=f"holds what the source of the copy lacks: .*{what}"):
        copied(site, target)
    assert hashes(target) == before
    copied(target, site)  # the other direction
    assert hashes(site) == before
    assert not verified(target, site).faults


def test_damage_is_found_and_named(site: Path, tmp_path: Path) -> None:
    target = tmp_path / "copy"
    tiles = sorted(site.glob("tiles/*/*.png"))
    damaged, lost = tiles[0], tiles[1]
    flipped = bytearray(damaged.read_bytes())
    flipped[100] ^= 1
    damaged.write_bytes(flipped)
    lost.unlink()
    outcome = copied(site, target)
    name = damaged.relative_to(site).as_posix()
    assert outcome.faults == {name: "damaged", lost.relative_to(site).as_posix(): "missing"}
    assert not (target / name).exists()
    (target / "preview.png").write_bytes(b"x" * (site / "preview.png").stat().st_size)
    (target / "flights/flight-1/report.html").unlink()
    faults = verified(site, target).faults
    assert (
        faults["preview.png"] == "damaged" and faults["flights/flight-1/report.html"] == "missing"
    )
    assert faults[name] == "missing" and len(faults) == 4


def test_a_full_disk_leaves_a_copy_that_can_go_on(
    site: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    target, count = tmp_path / "copy", 0
    replace = os.replace

    def full(one: object, other: object) -> None:
        nonlocal count
        count += 1
        if count > 6:
            raise OSError(28, "No space left on device")
        replace(one, other)  # type: ignore[arg-type]

    with monkeypatch.context() as patched:
        patched.setattr(os, "replace", full)
        with pytest.raises(StoreError, match="disk full"):
            copied(site, target)
    assert not (target / "site.db").exists() and (target / COPYING).exists()
    assert not copied(site, target).faults
    assert hashes(target) == hashes(site)


def test_an_empty_site_has_nothing_to_copy(tmp_path: Path) -> None:
    with Archive.open(tmp_path / "site", write=True) as archive:
        archive.create_site(fake_flights.SITE)
    with pytest.raises(StoreError, match="no map yet"):
        copied(tmp_path / "site", tmp_path / "copy")
    with pytest.raises(StoreError, match="no site at"):
        copied(tmp_path / "nowhere", tmp_path / "copy")
