"""A batch whose database and object store go away: nothing lost, nothing doubled, the maps of an undisturbed run."""

import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from urllib.parse import urlsplit

import pytest
from batch_flights import another, content
from fake_bucket import BUCKET, environment, served_bucket
from killed_bucket import KilledBucket

from ended_work import ended
from faulty_link import FaultyLink
from postgres_server import PostgresServer
from sorvolo.cli.main import main
from sorvolo.cluster.batch import (
    BatchReport,
    BatchSettings,
    BatchUpdate,
    RestartSettings,
    run_batch,
)
from sorvolo.cluster.local_executor import LocalExecutor
from sorvolo.cluster.orders import FlightWish
from sorvolo.cluster.table import BatchTable, State
from sorvolo.missions.flight.settings import MapSettings
from sorvolo.missions.map.flights import map_flights
from sorvolo.missions.site.copy import verify_copy
from sorvolo.store.site.archive import Archive
from sorvolo.store.site.catalogue_place import POINTER, VARIABLE


def run(
    folder: Path,
    flown: Path,
    seen: Callable[[BatchUpdate], None],
    copy_to: str = "",
    restarts: RestartSettings = RestartSettings(longest_wait_s=2.0),
) -> BatchReport:
    @contextmanager
    def executor(table: BatchTable) -> Iterator[LocalExecutor]:
        with LocalExecutor(2, 60.0, table.lock) as made:
            yield made

    wish = FlightWish(camera=str(flown / "camera.xml"), model="none", copy_to=copy_to)
    running = run_batch(
        [folder / "in"], folder / "maps", BatchSettings(wish, restarts=restarts), executor
    )
    while True:
        try:
            seen(next(running))
        except StopIteration as end:
            report: BatchReport = end.value
            return report


@pytest.mark.long
def test_a_database_that_comes_late_and_dies_on_the_way(
    flown: Path, tmp_path: Path, postgres: PostgresServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is not there at first; it dies while a flight is mapped, and is there again a second later."""
    for name in ("one", "two"):
        another(flown, tmp_path / "in" / name)
    monkeypatch.setenv(VARIABLE, postgres.url)
    states: list[str] = []

    def seen(update: BatchUpdate) -> None:
        if update.row is None or update.row.state is not State.WAITING:
            return
        states.append(update.row.words)
        if len(states) == 2:
            postgres.start()
            threading.Thread(target=restart_at_work, daemon=True).start()

    def restart_at_work() -> None:
        end_s = time.monotonic() + 30
        while time.monotonic() < end_s and not list(
            (tmp_path / "maps").glob("*/flights/*/run.journal")
        ):
            time.sleep(0.02)
        postgres.stop()
        time.sleep(1.0)
        postgres.start()

    postgres.stop()
    report = run(tmp_path, flown, seen)
    assert [row.state for row in report.rows] == [State.DONE, State.DONE]
    assert report.crashes == 0 and report.tries >= 4
    assert all("no connection to postgresql://127.0.0.1" in words for words in states)
    for name in ("one", "two"):
        with Archive.open(tmp_path / "maps" / name, write=False) as archive:
            assert (len(archive.flights()), len(archive.versions())) == (1, 1)
    monkeypatch.delenv(VARIABLE)
    wanted = tmp_path / "undisturbed" / "one"
    for _ in map_flights(
        [tmp_path / "in" / "one"], wanted, MapSettings(model="none"), camera=flown / "camera.xml"
    ):
        pass
    found = content(tmp_path / "maps" / "one")
    assert found.pop(POINTER) and found == content(wanted)


@pytest.mark.long
def test_an_object_store_that_comes_late_has_every_map(
    flown: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    another(flown, tmp_path / "in" / "one")
    place = f"s3://{BUCKET}/maps"
    with served_bucket() as endpoint, FaultyLink(urlsplit(endpoint).port or 0) as link:
        monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://127.0.0.1:{link.port}")
        link.cut()
        words: list[str] = []

        def seen(update: BatchUpdate) -> None:
            if update.row is not None and update.row.state is State.WAITING:
                words.append(update.row.words)
                link.mend()

        report = run(tmp_path, flown, seen, place)
        (row,) = report.rows
        assert (row.state, row.tries, report.crashes) == (State.DONE, 2, 0)
        assert (
            f"the flight is in {tmp_path / 'maps' / 'one'}, but was not copied: cannot" in words[0]
        )
        assert not ended(verify_copy(str(tmp_path / "maps" / "one"), f"{place}/one")).faults
        again = run(tmp_path, flown, seen, place)
        assert (again.tries, again.counts()) == (0, {"known": 1})

        link.cut()  # and does not come back
        (failed,) = run(
            tmp_path, flown, lambda _: None, f"{place}2", RestartSettings(patience_s=0.0)
        ).rows
        assert (
            failed.state is State.FAILED
            and "was not copied" in failed.words
            and os.fspath(tmp_path) in failed.words
        )


@pytest.mark.long
def test_an_object_store_that_is_killed_in_the_middle_of_a_copy(
    flown: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It dies after its third change, which it acknowledges to nobody, and is there again with all three."""
    another(flown, tmp_path / "in" / "one")
    place = f"s3://{BUCKET}/maps"
    with KilledBucket() as bucket:
        for name, value in environment(bucket.endpoint).items():
            monkeypatch.setenv(name, value)
        bucket.stop()
        bucket.start(dies_after=3)
        signals: list[int] = []

        def restart() -> None:
            signals.append(bucket.wait_for_its_end())
            bucket.start()

        restarting = threading.Thread(target=restart)
        restarting.start()
        report = run(tmp_path, flown, lambda _: None, place)
        restarting.join()
        (row,) = report.rows
        assert (row.state, report.crashes, signals) == (State.DONE, 0, [signal.SIGKILL])
        assert not ended(verify_copy(str(tmp_path / "maps" / "one"), f"{place}/one")).faults


def test_places_that_nothing_is_copied_to(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "in").mkdir()
    (tmp_path / "in" / "1.mp4").write_text("no video")
    for options, words in (
        (
            ["--root", "s3://archive/maps"],
            "a batch works in a folder; give one, and --copy-to s3://BUCKET/PREFIX",
        ),
        (["--root", str(tmp_path), "--copy-to", str(tmp_path)], "is --root itself"),
        (
            ["--root", str(tmp_path / "maps"), "--copy-to", "ftp://archive/maps"],
            "ftp:// is no place of sites",
        ),
        (
            ["--root", str(tmp_path / "maps"), "--copy-to", "s3://a/b", "--mission", "watch"],
            "are for maps",
        ),
    ):
        assert main(["batch", str(tmp_path / "in"), *options]) == 1
        assert words in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "maps").exists()
