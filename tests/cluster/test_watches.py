"""Watches as a mission of a batch: recorded flights and live streams, through kills, with what they found and where."""

import json
import re
import shlex
import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, closing, contextmanager
from dataclasses import replace
from pathlib import Path

import pytest
from batch_flights import another, content

from ended_work import ended
from sorvolo.cli.main import main
from sorvolo.cluster.batch import BatchSettings, BatchUpdate, run_batch
from sorvolo.cluster.cost import Cost
from sorvolo.cluster.executor import Executor
from sorvolo.cluster.local_executor import LocalExecutor
from sorvolo.cluster.orders import FlightWish, Mission, Order, WatchWish
from sorvolo.cluster.scout import find_flights
from sorvolo.cluster.streams import run_streams, streams_of
from sorvolo.cluster.table import BatchTable, State
from sorvolo.cluster.watches import existing_watches, headline, is_watched
from sorvolo.errors import SettingsError
from sorvolo.missions.watch.flights import watch
from sorvolo.missions.watch.settings import WatchOutputs
from sorvolo.store.exports.detection_files import claimed_folder


def killing_once(flag: Path, alerts: Path) -> str:
    """An alert command that kills the watch that runs it, the first time; later it writes down whom it is about."""
    script = 'if mkdir "$0"; then kill -9 $PPID; else echo $2 $3 >> "$1"; fi'
    return f"sh -c {shlex.quote(script)} {flag} {alerts} {{flight}} {{class}}"


def wished(flown: Path, **watch_wish: str) -> BatchSettings:
    return BatchSettings(
        FlightWish(
            Mission.WATCH,
            camera=str(flown / "camera.xml"),
            give_up_s=2.0,
            watch=WatchWish(**watch_wish),
        )
    )


class Crowded(LocalExecutor):
    """A local executor that has room only when asked for the third time."""

    asked = 0

    def has_room(self, cost: Cost) -> bool:
        self.asked += 1
        return self.asked > 2 and super().has_room(cost)


def local(
    kind: type[LocalExecutor] = LocalExecutor,
) -> Callable[[BatchTable], AbstractContextManager[Executor]]:
    @contextmanager
    def executor(table: BatchTable) -> Iterator[Executor]:
        with kind(2, 60.0, table.lock) as made:
            yield made

    return executor


def test_a_killed_watch_goes_on_and_leaves_what_an_undisturbed_one_leaves(
    flown: Path, tmp_path: Path
) -> None:
    flight = another(flown, tmp_path / "in" / "one")
    another(flown, tmp_path / "in" / "sub" / "one")
    (tmp_path / "out" / "one").mkdir(parents=True)  # a map of the same flight has its own name
    alerts = tmp_path / "alerts"
    settings = wished(flown, alert_command=killing_once(tmp_path / "killed", alerts))
    report = ended(run_batch([tmp_path / "in"], tmp_path / "out", settings, local()))
    row, copy = sorted(report.rows, key=lambda each: each.state)
    assert (row.state, row.tries, report.crashes, row.site, row.flight) == (
        State.DONE,
        2,
        1,
        "one-watch",
        "one",
    )
    assert (copy.state, copy.words) == (State.DUPLICATE, f"the same flight as {flight}")
    assert row.words == "1 car, 1 person found in 4 frames"
    assert alerts.read_text().split("\n") == ["one person", "one car", ""]

    again = ended(run_batch([tmp_path / "in"], tmp_path / "out", settings, local()))
    assert (again.tries, again.counts()) == (0, {"known": 1, "duplicate": 1})

    whole = tmp_path / "whole"
    for _ in watch(flight, outputs=WatchOutputs(folder=whole), camera=flown / "camera.xml"):
        pass
    assert content(tmp_path / "out" / "one-watch") == content(whole)


@pytest.mark.long
def test_a_stream_whose_watch_dies_goes_on_in_the_same_folder(flown: Path, tmp_path: Path) -> None:
    another(flown, tmp_path / "in" / "one")
    settings = wished(flown, alert_command=killing_once(tmp_path / "killed", tmp_path / "alerts"))
    streams = streams_of([f"north=follow:{tmp_path / 'in' / 'one'}"])
    updates: list[BatchUpdate] = []
    executor = local(Crowded)
    running = run_streams(streams, tmp_path / "out", settings, executor, threading.Event())
    with closing(running):
        while True:
            try:
                updates.append(next(running))
            except StopIteration as end:
                (row,) = end.value.rows
                break
    assert [each.row.words for each in updates[:2] if each.row] == [
        "waits for memory or cores that others have; it starts when they are known to be free",
        "",
    ]
    assert (row.state, row.tries, row.site, row.flight) == (State.DONE, 2, "north-watch", "one")
    assert row.words == "1 car, 1 person found in 4 frames"
    assert [path.name for path in (tmp_path / "out" / "north-watch").iterdir()] == ["one"]
    folder = tmp_path / "out" / "north-watch" / "one"
    lines = (folder / "detections.jsonl").read_text().splitlines()
    assert {json.loads(line)["frame"] for line in lines} >= {"IMG_0002.jpg", "IMG_0004.jpg"}
    assert not (folder / "run.journal").exists()
    found = [each.found for each in updates if each.found]
    assert any(re.match(r"car \d at 41\.89.*\(accuracy", each) for each in found)
    assert all(each.row is not None and each.row.site == "north-watch" for each in updates)


def test_each_flight_of_a_stream_has_a_folder_of_its_own(flown: Path, tmp_path: Path) -> None:
    """Also where its name, a followed file's or folder's, is that of an earlier one."""
    photos, outputs = another(flown, tmp_path / "in" / "one"), WatchOutputs(below=tmp_path / "out")
    until = threading.Event()
    for _ in range(2):
        for _ in watch(
            f"follow:{photos}", outputs=outputs, camera=flown / "camera.xml", until=until
        ):
            until.set()
        until.clear()
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["one", "one-2"]


def test_orders_of_watches_reach_the_worker_whole() -> None:
    wish = FlightWish(
        Mission.WATCH,
        watch=WatchWish(("person",), 0.5, 2.0, "video", "udp://tak:6969", alert_url="u"),
    )
    order = Order("in", "out", wish)
    assert Order.of(json.loads(order.line())["order"]) == order


def test_whose_watch_a_folder_holds(tmp_path: Path) -> None:
    with claimed_folder(tmp_path / "one-watch", "one", "abc"):
        assert not is_watched(tmp_path / "one-watch", "abc")
    (tmp_path / "one-watch" / "report.json").write_text("{}")
    (tmp_path / "site").mkdir()
    (tmp_path / "batch.jsonl").touch()
    assert is_watched(tmp_path / "one-watch", "abc") and not is_watched(
        tmp_path / "one-watch", "abd"
    )
    assert existing_watches(tmp_path) == {"abc": "one-watch"}
    (tmp_path / "one-watch" / "objects").mkdir()
    for name in ("in/1.jpg", "in/2.jpg", "one-watch/objects/1.jpg", "one-watch/objects/2.jpg"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    assert [each.path.name for each in find_flights([tmp_path], tmp_path / "maps")] == [
        "in"
    ]  # crops are no flight


def test_what_nobody_got_stands_in_the_headline() -> None:
    notices = [
        {"code": "alert_url_failed", "text": "the alert to http://x failed 2 times, last: refused"},
        {"code": "lost_frames", "text": "1 frame could not be used"},
    ]
    report = {
        "objects": {"by_class": {"person": 2}},
        "frames": {"detected": 30},
        "georeferenced": False,
        "notices": notices,
    }
    assert headline(report) == (
        "2 people found in 30 frames, without a place on the ground; "
        "the alert to http://x failed 2 times, last: refused"
    )


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (
            ["--cot", "udp://tak:6969"],
            "are for --mission watch; leave them out, --mission map takes none",
        ),
        (
            ["--mission", "watch", "--site-by", "place"],
            "--mission watch makes no sites: leave --site-by out",
        ),
        (["--mission", "watch", "--model", "none"], "--mission watch needs a detector"),
        (["--mission", "watch", "--gsd", "0.1"], "--gsd and --copy-to are for maps"),
        (["--mission", "watch", "--cot", "tak.local"], "udp://host:port"),
        (["--mission", "watch", "--alert-command", "no-such-program"], "no program"),
        (["--mission", "watch", "--fps", "0"], "frames a second"),
    ],
)
def test_options_that_cannot_be(
    tmp_path: Path, options: list[str], words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["batch", "udp://:5000", "--root", str(tmp_path / "out"), *options]) == 1
    assert words in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "out").exists()


def test_settings_of_watches_are_refused_for_other_missions() -> None:
    with pytest.raises(SettingsError, match="--mission compare takes none"):
        BatchSettings(replace(FlightWish(Mission.COMPARE), watch=WatchWish(classes=("person",))))
