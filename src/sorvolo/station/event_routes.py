"""The routes of live events: a WebSocket, and Server-Sent Events for programs that only listen."""

import asyncio
import json
from collections.abc import AsyncIterator

from fastapi import APIRouter, Header, Query, WebSocket
from fastapi.responses import StreamingResponse
from starlette.websockets import WebSocketDisconnect

from sorvolo.station.events import EventLog
from sorvolo.station.state import compact_json


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
