"""Events are numbered, kept, and come to whoever asks from any number on: none lost, none twice."""

import asyncio
import threading
from pathlib import Path
from typing import Any

import pytest
from starlette.testclient import TestClient

from sorvolo.station import events as events_module
from sorvolo.station.events import LOST, EventLog, NewEvent
from sorvolo.station.state import StationState


def logged(folder: Path, count: int, start: int = 0) -> EventLog:
    """A log with some events."""
    log = EventLog(StationState.open(folder))
    log.append(
        *[NewEvent("run.progress", {"n": n}, "field", "r") for n in range(start, start + count)]
    )
    return log


def test_numbers_go_on_after_a_restart(tmp_path: Path) -> None:
    """A page that asks a restarted server from its last number misses nothing."""
    assert logged(tmp_path, 3).last == 3
    log = logged(tmp_path, 2, start=3)
    assert [(each["seq"], each["data"]["n"]) for each in log.after(1)] == [
        (2, 1),
        (3, 2),
        (4, 3),
        (5, 4),
    ]
    assert log.after(5) == []


def test_what_is_written_with_events_is_written_or_neither(tmp_path: Path) -> None:
    """The place in a mission's journal moves in the same transaction as its events."""
    log = logged(tmp_path, 1)
    with pytest.raises(RuntimeError), log.appending([NewEvent("x", {})]):
        raise RuntimeError
    assert log.last == 1 and [
        each["seq"] for each in EventLog(StationState.open(tmp_path)).after(0)
    ] == [1]


def test_events_older_than_memory_come_from_the_disk_and_lost_ones_are_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A browser that slept for long loads anew instead of missing something silently."""
    monkeypatch.setattr(events_module, "_IN_MEMORY", 2)
    log = logged(tmp_path, 8)
    assert [each["seq"] for each in log.after(2)] == [3, 4, 5, 6, 7, 8]
    with log._state.changing() as connection:
        connection.execute("DELETE FROM events WHERE seq <= 4")
    found = log.after(1)
    assert (
        found[0]["type"] == LOST
        and found[0]["data"] == {"from": 2, "to": 4}
        and found[0]["seq"] == 4
    )
    assert [each["seq"] for each in found[1:]] == [5, 6, 7, 8]


def test_a_page_of_an_earlier_station_loads_anew(tmp_path: Path) -> None:
    """Its last number is above all of ours, where the station's memory was moved away: it would wait for ever."""
    log = logged(tmp_path, 3)

    async def first_two() -> list[dict[str, Any]]:
        found: list[dict[str, Any]] = []
        async for batch in log.follow(5000, quiet_s=0.2):
            found += batch
            if len(found) == 2 or not batch:
                return found
            log.append(NewEvent("x", {}))
        raise AssertionError

    found = asyncio.run(first_two())
    assert [(each["seq"], each["type"]) for each in found] == [(3, LOST), (4, "x")]


def test_many_threads_write_and_a_follower_sees_each_once(tmp_path: Path) -> None:
    """In order, without a gap, from the middle on."""
    log = logged(tmp_path, 5)

    def write() -> None:
        for n in range(20):
            log.append(NewEvent("x", {"n": n}))

    async def follow() -> list[int]:
        seen: list[int] = []
        async for batch in log.follow(2):
            seen += [each["seq"] for each in batch]
            if len(seen) >= 63:
                return seen
        raise AssertionError

    threads = [threading.Thread(target=write) for _ in range(3)]

    async def both() -> list[int]:
        following = asyncio.create_task(follow())
        for each in threads:
            each.start()
        return await asyncio.wait_for(following, 20)

    assert asyncio.run(both()) == list(range(3, 66))


def test_websocket_and_sse_from_any_number(client: TestClient) -> None:
    """A page asks after its last; a program by Last-Event-ID."""
    log: EventLog = client.app.state.station.events  # type: ignore[attr-defined]
    log.append(*[NewEvent("review.changed", {"n": n}, "field") for n in range(4)])
    with client.websocket_connect("ws://127.0.0.1:8750/api/events?after=2") as socket:
        assert [socket.receive_json()["seq"] for _ in range(2)] == [3, 4]
        log.append(NewEvent("review.changed", {"n": 4}))
        assert socket.receive_json() == {**log.after(4)[0]}
    with client.websocket_connect("ws://127.0.0.1:8750/api/events") as socket:
        log.append(NewEvent("review.changed", {"n": 5}))
        assert socket.receive_json()["seq"] == 6
