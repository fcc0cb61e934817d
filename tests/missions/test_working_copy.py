"""A site in a bucket worked on by commands: fetched, added to, sent back; two machines, and none loses anything."""

import json
import os
import re
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import fake_flights
import numpy as np
import pytest
from fake_bucket import BUCKET, served_bucket

from ended_work import ended
from sorvolo.cli.main import main
from sorvolo.errors import SorvoloWarning, StoreError
from sorvolo.missions.site.copy import copy_site
from sorvolo.missions.site.history import site_history
from sorvolo.missions.site.review import list_changes, review_changes
from sorvolo.missions.site.working_copy import fetch_site, send_site
from sorvolo.store.copies.bucket import BucketEnd
from sorvolo.store.copies.object_store import open_objects
from sorvolo.store.site.archive import Archive
from sorvolo.store.site.files import ORIGIN, UNSENT
from sorvolo.survey.findings import Verdict


@pytest.fixture(scope="module")
def bucket() -> Iterator[str]:
    with served_bucket() as endpoint:
        yield endpoint


@pytest.fixture
def machine(bucket: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str], None]:
    """Go on as another machine, of this name: one with working copies of its own."""

    def become(name: str) -> None:
        monkeypatch.setenv("SORVOLO_CACHE", str(tmp_path / name))

    become("one")
    return become


def fetched(address: str, *, writes: bool = False) -> Path:
    return ended(fetch_site(address, writes=writes))


@pytest.fixture(scope="module")
def states(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A site of one flight, and two later states of it, each with a flight that the other lacks."""
    folder = tmp_path_factory.mktemp("states")
    added(folder / "first", "flight-0", 50)
    for name, colour in (("theirs", 60), ("mine", 70)):
        added(Path(shutil.copytree(folder / "first", folder / name)), name, colour)
    return {each.name: each for each in folder.iterdir()}


def put(state: Path, address: str) -> None:
    """As another machine: make the site in the store this state."""
    ended(copy_site(str(state), address))


def work(state: Path, address: str) -> Path:
    """As a command that writes, up to its end: the working copy holds this state."""
    folder = fetched(address, writes=True)
    shutil.copytree(state, folder, dirs_exist_ok=True)
    return folder


def flights_in(folder: Path) -> list[str]:
    with Archive.open(folder, write=False) as archive:
        return [each.flight_id for each in archive.versions()]


def added(folder: Path, flight: str, colour: int) -> None:
    with Archive.open(folder, write=True) as archive:
        if not archive.has_site:
            archive.create_site(fake_flights.SITE)
        fake_flights.map_flight(archive, flight, colour, count=2, compared=True)


def newest(address: str) -> int:
    return BucketEnd(open_objects(address)).manifest().held.newest


def test_two_machines_add_flights_in_turn(
    machine: Callable[[str], None], states: dict[str, Path]
) -> None:
    address = f"s3://{BUCKET}/turns"
    with pytest.raises(StoreError, match="no site at s3://archive/turns"):
        fetched(address)
    here = work(states["first"], address)
    ended(send_site(address))
    machine("two")
    there = work(states["theirs"], address)
    ended(send_site(address))
    assert there != here and not (there / UNSENT).exists()
    machine("one")
    assert fetched(address) == here and flights_in(here) == ["flight-0", "theirs"]
    fake_flights.check_whole(here)
    before = open_objects(address).sizes("")
    ended(send_site(address))  # nothing is new: nothing is written
    assert (
        BucketEnd(open_objects(address)).manifest().generation == 2
        and open_objects(address).sizes("") == before
    )


def test_a_verdict_that_another_machine_withdrew_is_gone(
    machine: Callable[[str], None], states: dict[str, Path]
) -> None:
    address = f"s3://{BUCKET}/withdrawn"
    here = work(states["first"], address)
    (first, *_) = review_changes(here, [list_changes(here)[0].id], Verdict.CONFIRMED)
    ended(send_site(address))
    machine("two")
    review_changes(fetched(address, writes=True), [first.id], None)
    ended(send_site(address))
    machine("one")
    assert [each.verdict for each in list_changes(fetched(address))] == [None, None]


def test_tiles_and_pictures_come_when_they_are_asked_for(
    machine: Callable[[str], None], states: dict[str, Path], tmp_path: Path
) -> None:
    import obstore

    address, full = f"s3://{BUCKET}/lazy", states["first"]
    put(full, address)
    folder = fetched(address)
    assert not list(folder.glob("tiles/*/*")) and not list(folder.glob("flights/*/keyframes/*/*"))
    assert (folder / "mosaic.tif").is_file() and (folder / "flights/flight-0/report.json").is_file()
    assert [each.bytes_changed for each in site_history(folder)] == [
        each.bytes_changed for each in site_history(full)
    ]
    with Archive.open(folder, write=False) as archive, Archive.open(full, write=False) as whole:
        tiles = archive.tiles()
        for index, tile in whole.tiles().items():
            assert np.array_equal(tiles[index], tile)
        assert np.array_equal(
            archive.image(archive.keyframes()[0]), whole.image(whole.keyframes()[0])
        )
    assert len(list(folder.glob("tiles/*/*"))) == len(list(full.glob("tiles/*/*")))
    # a copy elsewhere asks nobody, whatever a stranger wrote into it
    moved = Path(shutil.copytree(folder, tmp_path / "moved"))
    shutil.rmtree(moved / "tiles")
    assert (moved / ORIGIN).is_file()
    with (
        Archive.open(moved, write=False) as archive,
        pytest.raises(StoreError, match="is missing; restore it"),
    ):
        list(archive.tiles().values())
    # damage in the store is not taken over
    objects = open_objects(address)
    key, size = next(iter(objects.sizes("tiles").items()))
    obstore.put(objects._store, key, b"x" * size)
    shutil.rmtree(folder / "tiles")
    with (
        Archive.open(folder, write=False) as archive,
        pytest.raises(StoreError, match="is damaged in the store"),
    ):
        list(archive.tiles().values())
    assert not list(folder.glob("tiles/*/.tmp-*"))


def test_who_is_overtaken_loses_nothing(
    machine: Callable[[str], None], states: dict[str, Path]
) -> None:
    address = f"s3://{BUCKET}/overtaken"
    put(states["first"], address)
    work(states["mine"], address)
    put(states["theirs"], address)
    with pytest.raises(
        StoreError, match=r"another writer has changed .* kept in (\S+)\. Run the same"
    ) as caught:
        ended(send_site(address))
    kept = Path(re.search(r"kept in (\S+)\. Run", str(caught.value))[1])  # type: ignore[index]
    fake_flights.check_whole(kept)
    assert flights_in(kept) == ["flight-0", "mine"] and newest(address) == 2
    again = fetched(address, writes=True)
    added(again, "mine", 70)
    ended(send_site(address))
    assert flights_in(again) == ["flight-0", "theirs", "mine"] and newest(address) == 3


def test_what_was_not_sent_is_sent_by_the_next_command(
    machine: Callable[[str], None], states: dict[str, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    address = f"s3://{BUCKET}/later"
    put(states["first"], address)
    folder = work(states["mine"], address)
    with monkeypatch.context() as patched:
        patched.setenv("AWS_ENDPOINT_URL_S3", "http://127.0.0.1:9")
        patched.setattr("time.sleep", lambda _: None)
        with pytest.raises(
            StoreError, match=r"no connection, or it was cut.* and sent by the next command"
        ):
            ended(send_site(address))
    assert (folder / UNSENT).is_file() and newest(address) == 1
    fetched(address)
    assert newest(address) == 2 and not (folder / UNSENT).exists()


@pytest.mark.parametrize("is_founded", [True, False])
def test_what_was_not_sent_and_is_overtaken_is_kept(
    machine: Callable[[str], None], states: dict[str, Path], is_founded: bool
) -> None:
    address = f"s3://{BUCKET}/kept-{is_founded}"
    if is_founded:
        put(states["first"], address)
    folder = work(states["mine"], address)
    put(states["theirs"], address)
    with pytest.warns(SorvoloWarning, match="what this machine had added and not sent is kept in"):
        assert fetched(address) == folder
    assert flights_in(folder) == ["flight-0", "theirs"]
    assert [flights_in(each) for each in folder.parent.glob("*-kept-*")] == [["flight-0", "mine"]]


def test_commands_take_a_place_in_a_store(
    machine: Callable[[str], None],
    photographed: Path,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    address = f"s3://{BUCKET}/commands"
    photos = sorted(photographed.rglob("*.jpg"))[:4]
    flights = []
    for name, chosen in (("one", photos[:3]), ("two", photos[1:4]), ("three", photos[2:4])):
        folder = tmp_path / name
        folder.mkdir()
        for photo in chosen:
            os.link(photo, folder / photo.name)
        flights.append(str(folder))
    assert main(["map", flights[0], "--site", address, "--model", "none", "--json"]) in (0, 3)
    capsys.readouterr()
    machine("two")
    assert main(["history", address, "--json"]) == 0
    assert [each["flight"] for each in json.loads(capsys.readouterr().out)["versions"]] == ["one"]
    assert main(["history", address, "--at", "1", "--export", str(tmp_path / "first.tif")]) == 0
    assert (tmp_path / "first.tif").stat().st_size > 1000
    capsys.readouterr()
    assert main(["evaluate", "mosaic", address, "--json"]) == 0
    assert [each["flight"] for each in json.loads(capsys.readouterr().out)["flights"]] == ["one"]
    assert main(["telemetry", address, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["folder"] == "commands-telemetry/one"
    assert (tmp_path / "commands-telemetry" / "one" / "geo.txt").is_file()
    for command, fault in (
        (
            ["measure", "contours", address, "--out", "contours.geojson"],
            "flight one of .* has no heights",
        ),
        (["search", address, "--model", "default", "--flight", "nine"], "nine"),
        (["evaluate", "changes", address, "--truth", "x"], "no such folder: x"),
    ):
        assert main(command) == 1
        assert re.search(fault, capsys.readouterr().err)
    assert main(["compare", *flights[1:], "--site", address, "--model", "none", "--json"]) in (0, 3)
    manifest = BucketEnd(open_objects(address)).manifest()
    assert manifest.generation == 3 and manifest.held.newest == 3  # sent after each flight
    assert main(["review", address]) == 0
    assert main(["review", f"s3://{BUCKET}/nowhere"]) == 1
    assert "no site at s3://archive/nowhere" in capsys.readouterr().err
