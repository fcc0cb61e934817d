"""How streams come in and go out: a drone's connection, the socket of the station's own cameras, pictures for browsers."""

import asyncio
import logging
import os
import socket
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Annotated, Literal

from fastapi import APIRouter, Query, WebSocket
from starlette.websockets import WebSocketDisconnect, WebSocketState
from websockets.asyncio.server import Server, ServerConnection, unix_serve
from websockets.exceptions import ConnectionClosed

from sorvolo.errors import InputError
from sorvolo.paths import Json, JsonView
from sorvolo.station.events import EventLog, NewEvent
from sorvolo.station.ingest import Announce, Ingest, LinkClosed
from sorvolo.station.messages import REFUSED_CODE
from sorvolo.station.runs import Runs
from sorvolo.station.security import FOR_OPERATORS, FOR_VIEWERS, needs
from sorvolo.station.tokens import Role
from sorvolo.station.video import Viewer


def stream_routes(ingest: Ingest, runs: Runs) -> APIRouter:
    """`/api/streams`, `/api/ingest/{stream}` and `/api/streams/{stream}/video`."""
    router = APIRouter(tags=["streams"])

    @router.get("/api/streams", dependencies=FOR_VIEWERS)
    def streams() -> list[Json]:
        """Every stream of which flights are kept, how many bytes those are, and what those do that are being sent."""
        return [each | {"bytes": ingest.kept_bytes(each["stream"])} for each in ingest.streams()]

    @router.get("/api/streams/{stream}", dependencies=FOR_VIEWERS)
    def one_stream(stream: str) -> Json:
        """One stream: its flights, and how the one goes that is being sent."""
        kept = {"viewers": ingest.viewers(stream), "bytes": ingest.kept_bytes(stream)}
        return ingest.state(stream) | kept | {"time_us": time.time_ns() // 1000}

    @router.delete("/api/streams/{stream}", status_code=204, dependencies=FOR_OPERATORS)
    async def delete_all(stream: str) -> None:
        """Take all recordings of a stream away. 423 while a drone sends it, or a mission reads it."""
        with runs.unused_stream(stream):
            ingest.delete(stream)

    @router.delete(
        "/api/streams/{stream}/flights/{flight}",
        status_code=204,
        dependencies=FOR_OPERATORS,
    )
    async def delete_one(stream: str, flight: str) -> None:
        """Take one recording of a stream away. 423 while a drone sends it, or a mission reads the stream."""
        with runs.unused_stream(stream):
            ingest.delete(stream, flight)

    @router.websocket("/api/ingest/{stream}")
    async def take(
        websocket: WebSocket, stream: str, _: Annotated[object, needs(Role.OPERATE)]
    ) -> None:
        """A drone's connection: binary messages as station/messages.py has them, acknowledged by number."""
        await websocket.accept()
        await ingest.serve(stream, _WebSocketLink(websocket))

    @router.websocket("/api/streams/{stream}/video")
    async def show(
        websocket: WebSocket,
        stream: str,
        _: Annotated[object, needs(Role.VIEW)],
        mode: Annotated[Literal["annexb", "fmp4"], Query()] = "annexb",
    ) -> None:
        """The pictures as they came: JSON about the format first, then each picture, from the last key frame on."""
        await websocket.accept()
        try:
            hub = ingest.hub(stream)
        except InputError as error:
            await websocket.close(REFUSED_CODE, f"{error}"[:120])
            return
        viewer = hub.join(mode)
        sending = asyncio.create_task(_send(websocket, viewer))
        try:
            while True:  # what a page sends is not looked at; reading shows that it went away
                await websocket.receive_text()
        except (WebSocketDisconnect, KeyError, RuntimeError):
            pass
        finally:
            hub.leave(viewer)
            sending.cancel()

    return router


def announcing(events: EventLog) -> Announce:
    """Stream states as live events; written beside the event loop, as the disk is waited for, and in order.

    An event names the newest flight alone: thousands of events are kept in memory.
    """
    # two threads could swap coming and going
    writing = ThreadPoolExecutor(1, thread_name_prefix="stream states")

    def announce(stream: str, state: JsonView) -> None:
        event = NewEvent(
            "stream.state", {**state, "stream": stream, "flights": list(state["flights"])[-1:]}
        )
        writing.submit(events.append, event)

    return announce


async def _send(websocket: WebSocket, viewer: Viewer) -> None:
    try:
        while True:
            item = await viewer.next()
            if isinstance(item, bytes):
                await websocket.send_bytes(item)
            else:
                await websocket.send_text(item)
    except (WebSocketDisconnect, RuntimeError):  # it went away while a picture was on its way
        pass


class _WebSocketLink:
    """A drone's WebSocket as `ingest.Link`."""

    def __init__(self, websocket: WebSocket) -> None:
        self._websocket = websocket

    async def receive(self) -> bytes:
        """The next binary message. Raises LinkClosed."""
        try:
            message = await self._websocket.receive()
        except (WebSocketDisconnect, RuntimeError) as error:
            raise LinkClosed from error
        if message["type"] != "websocket.receive":
            raise LinkClosed
        return message.get("bytes") or (message.get("text") or "").encode()

    async def send(self, text: str) -> None:
        """Send an answer. Raises LinkClosed."""
        try:
            await self._websocket.send_text(text)
        except (WebSocketDisconnect, RuntimeError) as error:
            raise LinkClosed from error

    async def close(self, code: int, reason: str) -> None:
        """End the connection."""
        if self._websocket.application_state is not WebSocketState.DISCONNECTED:
            try:
                await self._websocket.close(code, reason)
            except (WebSocketDisconnect, RuntimeError) as error:
                raise LinkClosed from error


_MOST_MESSAGE_BYTES = 16_000_000  # a key frame of 4K has one or two million; by choice
_MOST_PATH_BYTES = 100  # that the address of a socket surely holds
_LOG = logging.getLogger("sorvolo.station.cameras")


class CameraDoor:
    """Takes the streams of the station's own cameras as `Ingest` takes those of drones; asks for no token."""

    def __init__(self, path: Path, ingest: Ingest) -> None:
        self._path, self._ingest = path, ingest
        self._server: Server | None = None

    async def open(self) -> None:
        """Listen from now on. Where the disk holds no sockets missions read cameras by themselves, without video."""
        try:
            listening = _listening(self._path)
        except OSError as error:
            _LOG.warning(
                "no socket can be made in %s (%s): cameras' video is not shown",
                self._path.parent,
                error,
            )
            return
        self._server = await unix_serve(
            self._take,
            sock=listening,
            compression=None,
            max_size=_MOST_MESSAGE_BYTES,
            close_timeout=2.0,
        )

    async def close(self) -> None:
        """Listen no more; who sends waits for the next station."""
        if self._server is not None:
            self._server.close()
            await self._server.wait_closed()
            self._path.unlink(missing_ok=True)

    async def _take(self, connection: ServerConnection) -> None:
        stream = (
            connection.request.path.rpartition("/")[2] if connection.request is not None else ""
        )
        await self._ingest.serve(stream, SocketLink(connection))


class SocketLink:
    """A `websockets` connection as `ingest.Link`."""

    def __init__(self, connection: ServerConnection) -> None:
        self._connection = connection

    async def receive(self) -> bytes:
        """See `Link`."""
        try:
            found = await self._connection.recv(decode=False)
        except ConnectionClosed as error:
            raise LinkClosed from error
        return bytes(found)

    async def send(self, text: str) -> None:
        """See `Link`."""
        try:
            await self._connection.send(text)
        except ConnectionClosed as error:
            raise LinkClosed from error

    async def close(self, code: int, reason: str) -> None:
        """See `Link`."""
        closing = asyncio.ensure_future(self._connection.close(code, reason))
        try:
            while True:  # the sender's answer stands behind what it sent before
                await self._connection.recv(decode=False)
        except ConnectionClosed:
            await closing


def _listening(path: Path) -> socket.socket:
    """A socket that listens at a path of any length. Raises OSError."""
    path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    path.parent.chmod(0o700)
    path.unlink(missing_ok=True)  # of a station that was killed
    folder = os.open(path.parent, os.O_RDONLY)
    listening = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        is_short = len(os.fsencode(path)) <= _MOST_PATH_BYTES
        listening.bind(str(path) if is_short else f"/proc/self/fd/{folder}/{path.name}")
        listening.listen(16)
        return listening
    except OSError:
        listening.close()
        raise
    finally:
        os.close(folder)
