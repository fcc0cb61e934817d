"""What a user writes for a live source, and how FFmpeg opens it, by a relay where it may not lead elsewhere."""

import asyncio
import re
import socket
import ssl
import threading
from asyncio import StreamReader, StreamWriter
from collections.abc import Mapping
from concurrent.futures import Future
from dataclasses import dataclass
from errno import EACCES
from pathlib import Path
from types import MappingProxyType
from typing import Any
from urllib.parse import SplitResult, parse_qsl, urlsplit, urlunsplit

import av

from sorvolo.capture.live.reconnect import LiveSettings
from sorvolo.errors import InputError

STREAM_SCHEMES = ("rtsp", "rtsps", "rtmp", "rtmps", "udp", "rtp", "tcp", "srt", "http", "https")
"""Addresses of streams, as `scheme://...`."""

ADDRESS_FORMS = "rtsp://HOST/live, rtmp://HOST/live, udp://:PORT, tcp://:PORT, http://HOST/live, webcam:0, follow:PATH"
"""What a live source looks like, for messages."""

_WAITING = frozenset({"udp", "rtp"})  # a sender may begin at any time; nothing has to be dialled
_OPEN_S = 6.0  # for the other side's first answer and pictures; by choice
_LISTEN_S = (
    3  # a listener that nobody calls is opened anew so often, so that it can be stopped; by choice
)
# without a host: the usual port, and FFmpeg's options to be the server that a drone pushes its video to; what ends is
# the wait for a call, not a call that has come
_LISTENING: Mapping[str, tuple[int, Mapping[str, str]]] = {
    "rtmp": (1935, {"listen": "1", "timeout": f"{_LISTEN_S}"}),
    "tcp": (0, {"listen": "1", "listen_timeout": f"{1000 * _LISTEN_S}"}),
    "rtsp": (554, {"rtsp_flags": "listen", "listen_timeout": f"{_LISTEN_S}"}),
}
# live: nothing is held back for a smoother picture, and a damaged packet does not end the stream; not `nobuffer`, which
# throws away what came while the stream was looked at, and makes what comes later no sooner; twenty pictures for the
# frame rate alone, FFmpeg's own choice, took 3 s at two a second: it is right from a few on
_COMMON = {
    "fflags": "discardcorrupt",
    "flags": "low_delay",
    "analyzeduration": "1000000",
    "probesize": "5000000",
    "fpsprobesize": "2",
}
_BY_SCHEME: Mapping[str, Mapping[str, str]] = {
    "rtsp": {"rtsp_transport": "tcp"},
    "rtsps": {"rtsp_transport": "tcp"},
    "rtmp": {"rtmp_live": "live"},
    "http": {"protocol_whitelist": "http,https,tls,tcp"},  # whatever a playlist may name
    "https": {"protocol_whitelist": "http,https,tls,tcp"},
    "tcp": {"protocol_whitelist": "tcp"},
    "udp": {"fifo_size": "57344", "overrun_nonfatal": "1"},  # 188-byte packets: 10 MB
}

_PORTS = {"rtsp": 554, "rtsps": 322}
_MOST_BODY_BYTES = 1_000_000  # of an answer: a description has a few thousand; by choice
_PIECE_BYTES = 65_536


@dataclass(frozen=True)
class StreamAddress:
    """A stream that can be opened. `shown` has no password in it; `waits`: it is listened to rather than called.

    `opens_s`: how long one attempt to open it may take.
    """

    url: str
    shown: str
    container: str | None
    options: Mapping[str, str]
    waits: bool = False
    opens_s: float = _OPEN_S


@dataclass(frozen=True)
class FollowedPath:
    """A file or folder that is still being written (`follow:PATH`)."""

    path: Path


def is_live_address(text: str) -> bool:
    """Whether an input is a live source rather than a file or folder."""
    return _scheme(text) in (*STREAM_SCHEMES, "webcam", "follow") or text.startswith("/dev/video")


def live_address(text: str) -> StreamAddress | FollowedPath:
    """What `rtsp://...`, `udp://:5000`, `webcam:0`, `/dev/video0`, `follow:PATH` and the like name.

    Without a host (`rtmp://:1935/live`, `tcp://:5000`) a stream is waited for, as drones push theirs.
    `webcam:0?size=1280x720&rate=30` asks a webcam for a size and rate; what stands behind the `?` of a stream's
    address is FFmpeg's. Raises InputError for an address that cannot be, or a protocol that this FFmpeg lacks.
    """
    scheme, _, rest = text.partition(":")
    if scheme == "follow":
        return FollowedPath(
            _existing(rest, "follow:PATH names a file or folder that is being written")
        )
    if text.startswith("/dev/video"):
        return _webcam(text, "")
    if scheme == "webcam":
        number, _, query = rest.partition("?")
        return _webcam(number if number.startswith("/") else f"/dev/video{number or 0}", query)
    return _stream(text)


def shown_address(url: str) -> str:
    """The address without the user's name and password."""
    parts = urlsplit(url)
    return urlunsplit(parts._replace(netloc=parts.netloc.rpartition("@")[2]))


def without_secret(words: str, source: str) -> str:
    """The words of an error without a stream's name and password, and what stands behind its `?`.

    FFmpeg's errors hold the whole address; others may read those of a mission.
    """
    if "://" not in source:
        return words
    parts = urlsplit(source)
    for secret in (parts.netloc.rpartition("@")[0], parts.password, parts.query):
        if secret:
            words = words.replace(secret, "***")
    return words


def _stream(text: str) -> StreamAddress:
    try:
        parts = urlsplit(text)
        port = parts.port
    except ValueError as error:
        raise InputError(
            f"{text}: no address ({error}); give for instance rtsp://192.168.1.10:554/live"
        ) from error
    scheme = parts.scheme.lower()
    # Raises InputError for an address that lacks a part which its scheme needs, or whose scheme
    # is not built in.
    if scheme in ("udp", "rtp", "tcp") and port is None:
        raise InputError(f"{shown_address(text)} has no port; give for instance {scheme}://:5000")
    if not parts.hostname and scheme not in (*_WAITING, *_LISTENING):
        raise InputError(
            f"{shown_address(text)} has no host; give for instance {scheme}://192.168.1.10/live"
        )
    if scheme == "srt" and not _has_protocol("srt"):
        raise InputError(
            "this PyAV was built without SRT; receive it with another program and pass it on, for instance: "
            "srt-live-transmit srt://HOST:PORT udp://127.0.0.1:5000, then give udp://:5000"
        )
    options = {**_COMMON, **_BY_SCHEME.get(scheme, {})}
    url = text
    if not parts.hostname:  # the sender calls us, at whichever address of this machine
        url = urlunsplit(parts._replace(netloc=f"0.0.0.0:{port or _LISTENING[scheme][0]}"))
        options |= _LISTENING[scheme][1] if scheme in _LISTENING else {}
    container = "mpegts" if scheme == "udp" else None
    waits = not parts.hostname or scheme in _WAITING
    opens_s = (_LISTEN_S if waits else 0) + (0 if scheme in _WAITING else _OPEN_S)
    return StreamAddress(url, shown_address(text), container, options, waits, opens_s)


def _webcam(device: str, query: str) -> StreamAddress:
    wanted = dict(parse_qsl(query))
    if unknown := set(wanted) - {"size", "rate"}:
        raise InputError(f"webcam option {sorted(unknown)[0]}: give size=1280x720 or rate=30")
    _existing(device, "no such camera; those there are /dev/video*, and Linux is needed")
    options = {"video_size": wanted.get("size", ""), "framerate": wanted.get("rate", "")}
    return StreamAddress(
        device, device, "v4l2", MappingProxyType({k: v for k, v in options.items() if v})
    )


def _existing(text: str, words: str) -> Path:
    path = Path(text)
    if not text or not path.exists():
        raise InputError(f"no such file or folder: {text or '(nothing)'}; {words}")
    return path


def _has_protocol(name: str) -> bool:
    try:
        av.open(f"{name}://127.0.0.1:1?mode=listener", timeout=0.01)
    except av.error.ProtocolNotFoundError:
        return False
    except (av.FFmpegError, OSError):
        pass
    return True


def _scheme(text: str) -> str:
    return text.partition(":")[0].lower() if ":" in text else ""


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
            except UnicodeError as error:  # of a name that no server can have
                dialled.set_exception(OSError(f"{error}"))
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
