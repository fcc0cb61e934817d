"""Live events: numbered, kept on the disk, sent by WebSocket and as Server-Sent Events without loss or doubling."""

import asyncio
import json
import sqlite3
import threading
from collections import deque
from collections.abc import AsyncIterator, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

from fastapi import APIRouter, Header, Query, WebSocket
from fastapi.responses import StreamingResponse
from starlette.websockets import WebSocketDisconnect

from sorvolo.paths import Json, JsonView
from sorvolo.station.state import StationState, compact_json, utc_now

_IN_MEMORY = 4000  # for browsers that come back after a break; older ones are read from the disk
_AT_ONCE = 500  # in one answer, some 200 kB; by choice
_MOST_KEPT = 200_000
LOST = "events.lost"
"""What a page gets that asks for events that are no longer kept: it has to load the site anew."""


@dataclass(frozen=True)
class NewEvent:
    """An event before it has its number: its type, the site and the run that it is of, what it holds as plain JSON."""

    type: str
    data: JsonView
    site: str | None = None
    run: str | None = None


class EventLog:
    """All events of a station. `append` adds some, each with the next number; threads may share it."""

    def __init__(self, state: StationState) -> None:
        self._state = state
        self._lock = threading.Lock()
        rows = state.rows("SELECT * FROM events ORDER BY seq DESC LIMIT ?", (_IN_MEMORY,))
        self._recent: deque[Json] = deque(
            (_event(row) for row in reversed(rows)), maxlen=_IN_MEMORY
        )
        last = state.rows("SELECT seq FROM sqlite_sequence WHERE name = 'events'")
        self._last = int(last[0]["seq"]) if last else 0
        self._waiting: set[tuple[asyncio.AbstractEventLoop, asyncio.Event]] = set()

    @property
    def last(self) -> int:
        """The number of the newest event, 0 before the first."""
        return self._last

    def append(self, *events: NewEvent) -> int:
        """Keep events, in order; the number of the last. They are on the disk when this returns."""
        with self.appending(events):
            pass
        return self._last

    @contextmanager
    def appending(self, events: Sequence[NewEvent]) -> Iterator[sqlite3.Connection]:
        """Keep events in one transaction with whatever the block writes: both are on the disk, or neither."""
        at = utc_now()
        with self._lock:
            with self._state.changing() as connection:
                made: list[Json] = []
                for each in events:
                    cursor = connection.execute(
                        "INSERT INTO events (at, type, site, run, data) VALUES (?, ?, ?, ?, ?)",
                        (at, each.type, each.site, each.run, compact_json(each.data)),
                    )
                    made.append({"seq": cursor.lastrowid, "at": at, **vars(each)})
                yield connection
                if made and made[-1]["seq"] % 1000 < len(made):
                    connection.execute(
                        "DELETE FROM events WHERE seq <= ?", (made[-1]["seq"] - _MOST_KEPT,)
                    )
            self._recent.extend(made)
            self._last = made[-1]["seq"] if made else self._last
            waiting = list(self._waiting)
        for loop, event in waiting:
            try:
                loop.call_soon_threadsafe(event.set)
            except RuntimeError:  # the loop was closed: nobody waits there any more
                self._waiting.discard((loop, event))

    def after(self, seq: int) -> list[Json]:
        """The events after a number, oldest first, some hundreds at most; what is lost is reported by one event."""
        with self._lock:
            recent, last = list(self._recent), self._last
        if seq >= last:
            return []
        if recent and recent[0]["seq"] <= seq + 1:
            return recent[seq + 1 - recent[0]["seq"] :][:_AT_ONCE]
        rows = self._state.rows(
            "SELECT * FROM events WHERE seq > ? ORDER BY seq LIMIT ?", (seq, _AT_ONCE)
        )
        found = [_event(row) for row in rows]
        if found and found[0]["seq"] > seq + 1:
            found = [_lost(seq + 1, found[0]["seq"] - 1), *found]
        return found

    def newest(self, kind: str, site: str) -> Json | None:
        """The last event of a kind about a site; None where there was none, or none is kept."""
        rows = self._state.rows(
            "SELECT * FROM events WHERE type = ? AND site = ? ORDER BY seq DESC LIMIT 1",
            (kind, site),
        )
        return _event(rows[0]) if rows else None

    async def follow(self, seq: int, quiet_s: float = 15.0) -> AsyncIterator[list[Json]]:
        """The events after a number as they come, for ever; an empty list where none came for a while."""
        loop, arrived = asyncio.get_running_loop(), asyncio.Event()
        self._waiting.add((loop, arrived))
        try:
            # the numbers of a station whose memory was moved away: no event would come for long
            if seq > self._last:
                seq = self._last
                yield [_lost(1, seq)]
            while True:
                arrived.clear()
                events = await asyncio.to_thread(self.after, seq) if seq < self._last else []
                if events:
                    seq = events[-1]["seq"]
                    yield events
                    continue
                try:
                    await asyncio.wait_for(arrived.wait(), quiet_s)
                except TimeoutError:
                    yield []
        finally:
            self._waiting.discard((loop, arrived))


def _lost(first: int, last: int) -> Json:
    data = {"from": first, "to": last}
    return {"seq": last, "at": utc_now(), **vars(NewEvent(LOST, data))}


def _event(row: sqlite3.Row) -> Json:
    return {
        **{name: row[name] for name in ("seq", "at", "type", "site", "run")},
        "data": json.loads(row["data"]),
    }


def event_routes(events: EventLog) -> APIRouter:
    """`/api/events` as WebSocket and as Server-Sent Events, from any number on."""
    router = APIRouter(tags=["events"])

    @router.get("/api/events", response_class=StreamingResponse)
    async def sse(
        after: int | None = Query(None, ge=0, le=2**62),
        last_event_id: str | None = Header(None, max_length=40),
    ) -> StreamingResponse:
        """Events after a number (Last-Event-ID goes before it; without either: from now on), each once and in order."""
        known = int(last_event_id) if last_event_id and last_event_id.isdecimal() else after
        start = min(events.last if known is None else known, 2**62)
        return StreamingResponse(_lines(events, start), media_type="text/event-stream")

    @router.websocket("/api/events")
    async def socket(websocket: WebSocket) -> None:
        """JSON messages {seq, at, type, site, run, data} after `?after=SEQ`; without it, from now on."""
        text = websocket.query_params.get("after", "")
        seq = int(text) if text.isdecimal() and len(text) < 18 else events.last
        await websocket.accept()
        sending = asyncio.create_task(_send(websocket, events, seq))
        try:
            while True:  # what a page sends is not looked at; reading shows that it went away
                await websocket.receive_text()
        except (WebSocketDisconnect, KeyError, RuntimeError):
            pass
        finally:
            sending.cancel()

    return router


async def _send(websocket: WebSocket, events: EventLog, seq: int) -> None:
    try:
        async for batch in events.follow(seq):
            for event in batch:
                await websocket.send_text(compact_json(event))
            if not batch:
                await websocket.send_text(json.dumps({"type": "alive", "seq": events.last}))
    except (WebSocketDisconnect, RuntimeError):  # it went away while something was on its way
        return


async def _lines(events: EventLog, seq: int) -> AsyncIterator[str]:
    yield ": sorvolo\n\n"
    async for batch in events.follow(seq):
        for event in batch:
            yield f"id: {event['seq']}\nevent: {event['type']}\ndata: {compact_json(event)}\n\n"
        if not batch:
            yield ": alive\n\n"
