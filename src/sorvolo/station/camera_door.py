"""Where the station's own readers of cameras send: a socket on the disk, for programs of the station's user alone."""

import asyncio
import logging
import os
import socket
from pathlib import Path

from websockets.asyncio.server import Server, ServerConnection, unix_serve
from websockets.exceptions import ConnectionClosed

from sorvolo.station.ingest import Ingest, LinkClosed
from sorvolo.station.settings import StationSettings

_FOLDER, _NAME = "cameras", "station.sock"
_MOST_MESSAGE_BYTES = 16_000_000  # a key frame of 4K has one or two million; by choice
_MOST_PATH_BYTES = 100  # that the address of a socket surely holds
_LOG = logging.getLogger("sorvolo.station.cameras")


def door_path(settings: StationSettings) -> Path:
    """Where the socket of a station lies, in a folder of its own, which only the station's user may enter."""
    return settings.state_folder / _FOLDER / _NAME


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
