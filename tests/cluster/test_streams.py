"""Live streams side by side: one whose process dies is started again, all are finished when they are asked to end."""

import json
import os
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path

import pytest
from batch_flights import another

from ended_work import ended
from sorvolo.cli.main import main
from sorvolo.cluster.batch import BatchSettings, BatchUpdate
from sorvolo.cluster.cost import Cost
from sorvolo.cluster.local_executor import LocalExecutor
from sorvolo.cluster.orders import Ending, FlightWish, Mission, Order, Outcome
from sorvolo.cluster.streams import Stream, is_stream, run_streams, streams_of
from sorvolo.cluster.table import BatchTable, State
from sorvolo.errors import InputError, SettingsError
from sorvolo.store.site.archive import Archive


class Disturbed(LocalExecutor):
    """A local executor that kills the first try of each stream whose site is named so, and all of a poisoned one."""

    def start(self, key: tuple[str, str], order: Order, cost: Cost) -> None:
        first = not Path(order.site).exists()
        super().start(key, order, cost)
        if order.site.endswith("poisoned") or (order.site.endswith("killed") and first):
            Path(order.site).mkdir(exist_ok=True)
            os.kill(self._running[key][0].pid, signal.SIGKILL)


def test_streams_are_started_again_and_finished_on_request(flown: Path, tmp_path: Path) -> None:
    for name in ("killed", "poisoned"):
        another(flown, tmp_path / "in" / name)
    root, until = tmp_path / "maps", threading.Event()

    @contextmanager
    def executor(table: BatchTable) -> Iterator[LocalExecutor]:
        with Disturbed(2, 900.0, table.lock) as made:
            yield made

    def end() -> None:
        end_s = time.monotonic() + 90
        while time.monotonic() < end_s and not any(
            path.is_file() for path in (root / "killed").glob("flights/**/*")
        ):
            time.sleep(0.05)
        time.sleep(1.0)  # for more than its first picture
        until.set()

    threading.Thread(target=end, daemon=True).start()
    settings = BatchSettings(
        FlightWish(camera=str(flown / "camera.xml"), model="none", give_up_s=600.0)
    )
    streams = streams_of([f"follow:{tmp_path / 'in' / name}" for name in ("killed", "poisoned")])
    running, updates = run_streams(streams, root, settings, executor, until), list[BatchUpdate]()
    while True:
        try:
            updates.append(next(running))
        except StopIteration as ended:
            report = ended.value
            break
    rows = {row.site: row for row in report.rows}
    assert rows["killed"].state is State.DONE and rows["killed"].tries == 2
    assert rows["killed"].words.endswith("frames matched")
    assert rows["poisoned"].state is State.SET_ASIDE and rows["poisoned"].tries == 3
    assert report.crashes == 4
    with Archive.open(root / "killed", write=False) as archive:
        assert [each.status for each in archive.flights()] == ["complete"]


def test_streams_are_named_by_site_or_by_address(tmp_path: Path) -> None:
    (tmp_path / "cards.ts").touch()
    north = "rtsp://ann:secret@10.0.0.1/live?key=x"
    found = streams_of([f"north={north}", "udp://:5000", f"follow:{tmp_path / 'cards.ts'}"])
    assert [each.site for each in found] == ["north", "5000", "cards"]
    assert found[0] == Stream(north, "north")
    assert found[0].shown == "rtsp://10.0.0.1/live"
    found = streams_of(["north=udp://:5000", "south=udp://:5001"], ["south=udp://:10110"])
    assert [each.telemetry for each in found] == ["", "udp://:10110"]
    assert not is_stream("flights/a=b") and is_stream("a=rtsp://10.0.0.1/live")


class Recording:
    """An executor that only keeps what it was given: every try is done at once."""

    cache_mb = 64.0

    def __init__(self) -> None:
        self.orders: list[Order] = []
        self.running: dict[tuple[str, str], Order] = {}

    def has_room(self, cost: Cost) -> bool:
        return True

    def start(self, key: tuple[str, str], order: Order, cost: Cost) -> None:
        self.orders.append(order)
        self.running[key] = order

    def finish(self, key: tuple[str, str]) -> None:
        """Nothing: it is done."""

    def take_found(self) -> list[tuple[tuple[str, str], str]]:
        return []

    def next_ended(self, timeout_s: float | None = None) -> tuple[tuple[str, str], Ending] | None:
        key, _ = self.running.popitem()
        return key, Ending(Outcome.DONE, "done")


def test_the_receiver_of_a_stream_goes_with_its_orders(tmp_path: Path) -> None:
    executor = Recording()
    streams = streams_of(["north=udp://:5000", "south=udp://:5001"], ["south=udp://:10110"])
    settings = BatchSettings(FlightWish(Mission.WATCH))
    ended(
        run_streams(streams, tmp_path, settings, lambda _: nullcontext(executor), threading.Event())
    )
    assert {Path(each.site).name: each.telemetry for each in executor.orders} == {
        "north-watch": "",
        "south-watch": "udp://:10110",
    }
    assert all(Order.of(json.loads(each.line())["order"]) == each for each in executor.orders)


def test_streams_that_cannot_be(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SettingsError, match="two streams would be mapped into the site north"):
        streams_of(["north=udp://:5000", "north=udp://:5001"])
    with pytest.raises(InputError, match="has no port"):
        streams_of(["udp://"])
    for receivers, words in (
        (["east=udp://:10110"], "--telemetry east=...: there are streams of north"),
        (["udp://:10110"], "give each stream's receiver once, as SITE=ADDRESS"),
        (["north=udp://:1", "north=udp://:2"], "give each stream's receiver once"),
        (["north=flight.srt"], "flight.srt is no receiver; give serial:"),
    ):
        with pytest.raises(SettingsError, match=words):
            streams_of(["north=udp://:5000"], receivers)
    root = ["--root", str(tmp_path / "maps")]
    assert main(["batch", str(tmp_path), "--telemetry", "north=udp://:10110", *root]) == 1
    assert "--telemetry is for live sources" in capsys.readouterr().err
    assert main(["batch", "udp://:5000", str(tmp_path), *root]) == 1
    assert "give folders of flights or live sources, not both" in capsys.readouterr().err
    assert main(["batch", "udp://:5000", "udp://:5001", "--workers", "1", *root]) == 1
    assert "--workers 1: 2 live sources need a worker each" in capsys.readouterr().err
    assert main(["batch", "udp://:5000", "--mission", "search", *root]) == 1
    assert "give map, compare or watch for live streams" in capsys.readouterr().err
