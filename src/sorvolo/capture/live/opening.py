"""Opens a stream; where a camera may not lead elsewhere, by way of a relay that reaches its address alone."""

import asyncio
import re
import socket
import ssl
import threading
from asyncio import StreamReader, StreamWriter
from concurrent.futures import Future
from errno import EACCES
from typing import Any
from urllib.parse import SplitResult, urlsplit, urlunsplit

import av

from sorvolo.capture.live.addresses import StreamAddress, shown_address
from sorvolo.capture.live.reconnect import LiveSettings

_PORTS = {"rtsp": 554, "rtsps": 322}
_MOST_BODY_BYTES = 1_000_000  # of an answer: a description has a few thousand; by choice
_PIECE_BYTES = 65_536


def open_stream(address: StreamAddress, within_s: float, settings: LiveSettings) -> Any:
    """The container of a stream.

    Raises FFmpegError or OSError, PermissionError where the camera redirects and the settings do not follow.
    """
    url, relay = address.url, None
    parts = urlsplit(url)
    if not (settings.follows_redirects or address.waits) and parts.scheme in _PORTS:
        relay = _Relay(parts, within_s)
        user = "".join(parts.netloc.rpartition("@")[:2])
        url = urlunsplit(parts._replace(scheme="rtsp", netloc=f"{user}127.0.0.1:{relay.port}"))
    try:
        return av.open(
            url,
            format=address.container,
            options=dict(address.options),
            timeout=(within_s, settings.silent_s),
        )
    except (av.FFmpegError, OSError) as error:
        if relay is not None and relay.refusal:
            raise PermissionError(EACCES, relay.refusal) from error
        raise


class _Relay:
    """One connection of FFmpeg's to one RTSP server; its answers are written anew, as they were understood here.

    FFmpeg itself goes wherever a server redirects it, which nobody checked; it does so before it plays, never later.
    Raises OSError where the server is not reached.
    """

    def __init__(self, server: SplitResult, within_s: float) -> None:
        self.refusal = ""
        self._server, self._within_s, self._plays = server, within_s, False
        listener = socket.create_server(("127.0.0.1", 0))
        listener.setblocking(False)
        self.port = listener.getsockname()[1]
        dialled: Future[None] = Future()
        run = self._run(listener, dialled)
        threading.Thread(target=asyncio.run, args=(run,), daemon=True, name="relay").start()
        dialled.result()

    async def _run(self, listener: socket.socket, dialled: Future[None]) -> None:
        scheme, host = self._server.scheme, self._server.hostname
        # cameras sign their certificates themselves
        tls = ssl._create_unverified_context() if scheme == "rtsps" else None
        with listener:
            try:
                dialling = asyncio.open_connection(
                    host, self._server.port or _PORTS[scheme], ssl=tls
                )
                answers, there = await asyncio.wait_for(dialling, self._within_s)
            except OSError as error:
                dialled.set_exception(error)
                return
            dialled.set_result(None)
            calling = asyncio.get_running_loop().sock_accept(listener)
            try:
                caller, _ = await asyncio.wait_for(calling, self._within_s)
            except TimeoutError:  # FFmpeg refused the address itself
                return
        requests, here = await asyncio.open_connection(sock=caller)
        ways = [
            asyncio.ensure_future(way)
            for way in (self._ask(requests, there), self._answer(answers, here))
        ]
        done, _ = await asyncio.wait(ways, return_when=asyncio.FIRST_COMPLETED)
        for way in done:
            way.exception()  # either side hung up, or sent what is no RTSP: FFmpeg sees the end
        here.close()
        there.close()

    async def _ask(self, requests: StreamReader, there: StreamWriter) -> None:
        while piece := await requests.read(_PIECE_BYTES):
            self._plays |= piece.startswith(b"PLAY ")
            there.write(piece)
            await there.drain()

    async def _answer(self, answers: StreamReader, here: StreamWriter) -> None:
        while piece := await answers.read(1 if not self._plays else _PIECE_BYTES):
            if not self._plays:
                piece = await self._checked(_line(piece + await answers.readline()), answers)
            if self.refusal:
                return
            here.write(piece)
            await here.drain()

    async def _checked(self, status: bytes, answers: StreamReader) -> bytes:
        """An answer before anything is played, as FFmpeg will read it. Raises ValueError for what is none."""
        if not status:
            return b""
        lines, size, location = [status], 0, ""
        while line := _line(await answers.readline()):
            name, _, value = (part.strip() for part in line.lower().partition(b":"))
            if name == b"content-length":
                size = int(value)
                continue
            if name == b"location":
                location = shown_address(line[9:].decode("ascii", "replace").strip()[:200])
            if name == b"transport" and b"interleaved" not in value:
                self.refusal = "the camera sends its pictures past its connection, by UDP"
            lines.append(line)
        if size > _MOST_BODY_BYTES:
            raise ValueError("no answer of RTSP")
        body = await answers.readexactly(size)
        if status.startswith(b"RTSP/") and not re.match(rb"RTSP/\d\.\d [1245]\d\d\b", status):
            self.refusal = f"the camera redirects to {location}, which is not followed"
        return b"\r\n".join([*lines, b"Content-Length: %d" % size, b"", body])


def _line(data: bytes) -> bytes:
    """A line as FFmpeg reads it. Raises ValueError where it would see an end, or a packet of pictures, in it."""
    line = data.replace(b"\r", b"").strip()
    if line.startswith(b"$") or b"\0" in line:
        raise ValueError("no line of RTSP")
    return line
