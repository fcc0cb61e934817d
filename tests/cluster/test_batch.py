"""A disturbed batch of small flights: nothing is lost, nothing doubled, and maps have the bytes of undisturbed ones."""

import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from batch_flights import another, content

from ended_work import ended
from small_flights import simulate_into, small_flight
from sorvolo.cluster.batch import BatchReport, BatchSettings, BatchTable, run_batch
from sorvolo.cluster.executors import LocalExecutor
from sorvolo.errors import StoreError
from sorvolo.missions.flight.settings import MapSettings
from sorvolo.missions.map.flights import map_flights
from sorvolo.missions.watch.flights import watch
from sorvolo.missions.watch.settings import WatchOutputs
from sorvolo.missions.worker import Order


class Disturbed(LocalExecutor):
    """A local executor that sends signals to its missions, by the name of their flight: one for each try.

    SIGSEGV at once, others once the flight's first frames are noted.
    """

    def __init__(self, lock: int, signals: dict[str, list[signal.Signals]]) -> None:
        super().__init__(2, lock, stall_s=4.0)
        self.signals = signals

    def start(self, key: str, order: Order) -> None:
        super().start(key, order)
        waiting = self.signals.get(Path(order.source).name)
        if waiting and order.mission != "inspect":
            process, number = self.processes[key], waiting.pop(0)
            if number is signal.SIGSEGV:
                process.send_signal(number)
                return
            threading.Thread(
                target=_at_work, args=(order, lambda: os.kill(process.pid, number)), daemon=True
            ).start()


def _at_work(order: Order, strike: Callable[[], None]) -> None:
    """Strike when the flight's first frames are noted, or it is late."""
    end_s = time.monotonic() + 20
    while time.monotonic() < end_s and not list(Path(order.site).glob("**/run.journal")):
        time.sleep(0.02)
    strike()


def run(
    places: list[Path],
    root: Path,
    camera: Path,
    signals: dict[str, list[signal.Signals]],
    **wish: Any,
) -> BatchReport:
    settings = BatchSettings(camera=str(camera), **{"model": "none", **wish})
    return ended(run_batch(places, root, settings, lambda table: Disturbed(table.lock, signals)))


@pytest.fixture(scope="module")
def batched(flown: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, BatchReport]:
    """A disturbed batch: one flight's process killed, one stopped; one poisoned, one broken, one there twice."""
    folder = tmp_path_factory.mktemp("disturbed")
    for name in ("killed", "stopped", "poisoned"):
        another(flown, folder / "in" / name)
    another(flown, folder / "in" / "sub" / "killed")  # the same bytes: the same flight
    (folder / "in" / "broken.mp4").write_text("no video")
    (folder / "in" / "single").mkdir()
    (folder / "in" / "single" / "DJI_7.JPG").write_bytes(b"one photo")
    signals = {
        "killed": [signal.SIGKILL],
        "stopped": [signal.SIGSTOP],
        "poisoned": [signal.SIGSEGV] * 2,
    }
    return folder, run([folder / "in"], folder / "maps", flown / "camera.xml", signals)


def test_each_flight_is_through_once_or_named(batched: tuple[Path, BatchReport]) -> None:
    folder, report = batched
    rows = {Path(row.source).relative_to(folder / "in").as_posix(): row for row in report.rows}
    assert {name: row.state for name, row in rows.items()} == {
        "broken.mp4": "failed",
        "killed": "done",
        "stopped": "done",
        "sub/killed": "duplicate",
        "poisoned": "set aside",
        "single": "skipped",
    }
    assert rows["single"].words == "a single photo (DJI_7.JPG): a flight needs 2 or more"
    assert "broken.mp4" in rows["broken.mp4"].words
    assert rows["sub/killed"].words == f"the same flight as {folder / 'in' / 'killed'}"
    assert rows["poisoned"].words == "set aside after 2 tries: its process ended by signal 11"
    assert [rows[name].tries for name in ("killed", "stopped", "poisoned")] == [2, 2, 2]
    assert (report.tries, report.crashes) == (6, 4)
    assert rows["killed"].cpu_s > 0.5 and rows["killed"].peak_memory_mb > 50
    sites = sorted(path.name for path in (folder / "maps").iterdir() if path.is_dir())
    assert sites == ["killed", "stopped"]


def test_disturbed_maps_have_the_bytes_of_undisturbed_ones(
    batched: tuple[Path, BatchReport], flown: Path, tmp_path: Path
) -> None:
    folder, _ = batched
    for name in ("killed", "stopped"):
        wanted, flight = tmp_path / "undisturbed" / name, folder / "in" / name
        for _ in map_flights(
            [flight], wanted, MapSettings(model="none"), camera=flown / "camera.xml"
        ):
            pass
        assert content(folder / "maps" / name) == content(wanted)


def test_again_nothing_is_done_twice(batched: tuple[Path, BatchReport], flown: Path) -> None:
    folder, first = batched
    again = run([folder / "in"], folder / "maps", flown / "camera.xml", {})
    assert again.tries == 0
    assert [row.state for row in again.rows] == [row.state for row in first.rows]
    assert again.counts() == {"known": 2, "duplicate": 1, "skipped": 1, "failed": 1, "set aside": 1}


@pytest.mark.long
def test_a_killed_watch_goes_on_and_leaves_what_an_undisturbed_one_leaves(
    flown: Path, tmp_path: Path
) -> None:
    flight = another(flown, tmp_path / "in" / "one")
    another(flown, tmp_path / "in" / "sub" / "one")
    (tmp_path / "out" / "one").mkdir(parents=True)  # a map of the same flight has its own name
    wish = {"mission": "watch", "model": "default"}
    camera, signals = flown / "camera.xml", {"one": [signal.SIGKILL]}
    report = run([tmp_path / "in"], tmp_path / "out", camera, signals, **wish)
    row, copy = sorted(report.rows, key=lambda each: each.state)
    assert (row.state, row.tries, report.crashes, row.site, row.flight) == (
        "done",
        2,
        1,
        "one-watch",
        "one",
    )
    assert (copy.state, copy.words) == ("duplicate", f"the same flight as {flight}")
    # its one person is a few pixels long, which a detector may miss
    words, ground = row.words.split("; ")
    assert words in ("1 car, 1 person", "1 car, no person")
    assert ground == "4 of 4 pictures, 100 % of the ground looked at"

    again = run([tmp_path / "in"], tmp_path / "out", camera, {}, **wish)
    assert (again.tries, again.counts()) == (0, {"known": 1, "duplicate": 1})

    whole = tmp_path / "whole"
    for _ in watch(flight, outputs=WatchOutputs(folder=whole), camera=camera):
        pass
    assert content(tmp_path / "out" / "one-watch") == content(whole)


def test_flights_of_one_place_are_compared_with_the_first(flown: Path, tmp_path: Path) -> None:
    for name in ("one", "two"):
        another(flown, tmp_path / "in" / name)
    report = run(
        [tmp_path / "in"],
        tmp_path / "maps",
        flown / "camera.xml",
        {},
        mission="compare",
        by_place=True,
    )
    assert [(row.site, row.tries) for row in report.rows] == [("one", 1), ("one", 1)]
    assert "matched" in report.rows[0].words and "change" in report.rows[1].words
    assert report.rows[1].flight == "two"


def test_a_video_under_a_second_name_is_the_same_flight(tmp_path: Path) -> None:
    made = simulate_into(tmp_path / "made", small_flight(5, length_m=12, fps=4))
    shutil.copytree(made / "flight1", tmp_path / "in")
    (tmp_path / "in" / "card2").mkdir()
    for ending in (".mp4", ".csv"):
        shutil.copy(
            tmp_path / "in" / f"flight1{ending}", tmp_path / "in" / "card2" / f"DJI_0042{ending}"
        )
    report = run([tmp_path / "in"], tmp_path / "maps", made / "camera.xml", {})
    assert {Path(row.source).name: (row.state, row.words) for row in report.rows} == {
        "DJI_0042.mp4": ("done", "3 of 3 frames matched"),
        "flight1.mp4": (
            "duplicate",
            f"the same flight as {tmp_path / 'in' / 'card2' / 'DJI_0042.mp4'}",
        ),
    }
    assert [path.name for path in (tmp_path / "maps").iterdir() if path.is_dir()] == ["DJI_0042"]


@pytest.mark.long
def test_a_killed_batch_leaves_no_worker_and_the_same_command_goes_on(
    flown: Path, tmp_path: Path
) -> None:
    another(flown, tmp_path / "in" / "one")
    command = [
        sys.executable,
        "-m",
        "sorvolo",
        "batch",
        str(tmp_path / "in"),
        "--root",
        str(tmp_path / "maps"),
        "--camera",
        str(flown / "camera.xml"),
        "--model",
        "none",
        "--json",
    ]
    first = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    journal = tmp_path / "maps" / "one" / "flights" / "one" / "run.journal"
    end_s = time.monotonic() + 60
    while not journal.exists() and first.poll() is None and time.monotonic() < end_s:
        time.sleep(0.02)
    with pytest.raises(
        StoreError, match=f"another batch is running in .*: process {first.pid} on "
    ):
        BatchTable.open(tmp_path / "maps")
    tasks = Path(f"/proc/{first.pid}/task").glob("*/children")
    (worker,) = (int(child) for task in tasks for child in task.read_text().split())
    os.kill(worker, signal.SIGSTOP)  # it cannot end by itself
    first.kill()
    first.wait()
    BatchTable.open(tmp_path / "maps").close()  # not before its worker is gone
    stat = Path(f"/proc/{worker}/stat")
    assert (
        not stat.exists() or stat.read_text().rpartition(")")[2].split()[0] in "ZX"
    )  # dead, if not yet reaped
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    (row,) = json.loads(done.stdout)["flights"]
    assert (row["state"], row["tries"], row["crashes"]) == ("done", 2, 0)
    assert os.path.isfile(tmp_path / "maps" / "one" / "mosaic.tif")
