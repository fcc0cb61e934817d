"""The thread that reads a stream: connects, decodes, reads the metadata, and begins anew when nothing comes.

A camera that may not lead elsewhere is connected to over a relay.
"""

import asyncio
import re
import socket
import ssl
import threading
import time
from collections import Counter, deque
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import ExitStack, closing
from dataclasses import dataclass
from errno import EACCES
from typing import Any, Protocol
from urllib.parse import SplitResult, urlsplit, urlunsplit

import av

from sorvolo.capture.live.addresses import StreamAddress, shown_address
from sorvolo.capture.live.klv import LocalSet, local_sets
from sorvolo.capture.live.klv_telemetry import klv_streams
from sorvolo.capture.live.reconnect import Backoff, LiveSettings, Outages
from sorvolo.capture.telemetry.cleaning import notice
from sorvolo.capture.video_stream import PIXEL_LIMIT
from sorvolo.geometry.units import SECOND_NS
from sorvolo.survey.flight import Notice

STAMP_JUMP_NS = 10 * SECOND_NS
"""By which a stream's time stamps may step forward; further, its sender began anew or set its clock."""


_MOST_BEHIND_S = 1.5  # so much more than lately: from there on packets are left out
_LATELY_S = 30.0  # the least delay of this time is what the stream itself takes
_LOOKED_AT_S = 0.5  # of packets that are left out: so long their stamps are held against the clock
_LIVE_RATE = 1.5  # stamps that run no faster than that come from the sender, not from what waited


class Backlog:
    """Whether each video packet of a stream is to be decoded; only `decodes` changes it.

    A packet's delay is the time at which it was read against its own stamp: it grows while decoding is slower than the
    stream. Once it has grown too far packets are left out, which takes no time, until nothing more waits to be read.
    Decoding goes on with the key frame after that, since the pictures before it depend on what was left out.
    """

    def __init__(self) -> None:

        # when, and how much: ever more, so the first is the least
        self._delays_s: deque[tuple[float, float]] = deque()
        self._stamp_ns: int | None = None
        self._leaves_out_since: tuple[float, float] | None = None  # the clock and the stamp
        self._has_caught_up = False

    def decodes(self, stamp_ns: int | None, *, is_key: bool, now_s: float) -> bool:
        """Whether a packet that was read at `now_s` is to be decoded; without a stamp it shares the last one's fate."""
        if stamp_ns is None:
            return self._leaves_out_since is None
        if self._stamp_ns is None or abs(stamp_ns - self._stamp_ns) >= STAMP_JUMP_NS:
            self._begin_anew()
        self._stamp_ns, stamp_s = stamp_ns, stamp_ns / SECOND_NS
        # How much a delay exceeds the least one lately.
        delay_s = now_s - stamp_s
        while self._delays_s and self._delays_s[-1][1] >= delay_s:
            self._delays_s.pop()
        self._delays_s.append((now_s, delay_s))
        while self._delays_s[0][0] < now_s - _LATELY_S:
            self._delays_s.popleft()
        behind_s = delay_s - self._delays_s[0][1]
        if self._leaves_out_since is None:
            if behind_s > _MOST_BEHIND_S:
                self._leaves_out_since = now_s, stamp_s
        elif self._catches_up(now_s, stamp_s) and is_key:
            self._begin_anew()
        return self._leaves_out_since is None

    def _begin_anew(self) -> None:
        self._delays_s.clear()
        self._leaves_out_since, self._has_caught_up = None, False

    def _catches_up(self, now_s: float, stamp_s: float) -> bool:
        assert self._leaves_out_since is not None
        began_s, first_s = self._leaves_out_since
        if now_s - began_s >= _LOOKED_AT_S:
            self._has_caught_up |= stamp_s - first_s <= _LIVE_RATE * (now_s - began_s)
            self._leaves_out_since = now_s, stamp_s
        return self._has_caught_up


REFUSALS = (
    av.error.ProtocolNotFoundError,
    av.error.HTTPUnauthorizedError,
    av.error.HTTPForbiddenError,
    av.error.HTTPNotFoundError,
    PermissionError,
)
"""FFmpeg's errors for an other side that will not have us, however often it is asked."""

_WALLCLOCK_BYTES = 8  # that a producer reference time begins with, us since 1970


class StreamListener(Protocol):
    """Receives a stream's frames and metadata; called in the reader's thread."""

    def opened(self, facts: "StreamFacts") -> None:
        """A connection stands; its properties."""

    def frame(self, decoded: av.VideoFrame, stamp_ns: int, arrived_s: float) -> None:
        """A decoded frame with its time stamp on the stream's own clock."""

    def restarted(self) -> None:
        """The stream's time stamps begin anew."""

    def ended(self) -> None:
        """Nothing more comes."""

    def metadata(self, stated: LocalSet, stamp_ns: int) -> None:
        """A metadata packet with its time stamp on the stream's own clock."""

    def reported(self, stamp_ns: int, utc_ns: int) -> None:
        """The sender states the UTC of a time stamp."""


@dataclass(frozen=True)
class StreamFacts:
    """The properties in a stream's header."""

    codec: str
    container: str
    rate_hz: float
    has_metadata: bool


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
        scheme = self._server.scheme
        # cameras sign their certificates themselves
        tls = ssl._create_unverified_context() if scheme == "rtsps" else None
        with listener:
            try:
                dialling = asyncio.open_connection(
                    self._server.hostname, self._server.port or _PORTS[scheme], ssl=tls
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

    async def _ask(self, requests: asyncio.StreamReader, there: asyncio.StreamWriter) -> None:
        while piece := await requests.read(_PIECE_BYTES):
            self._plays |= piece.startswith(b"PLAY ")
            there.write(piece)
            await there.drain()

    async def _answer(self, answers: asyncio.StreamReader, here: asyncio.StreamWriter) -> None:
        while piece := await answers.read(1 if not self._plays else _PIECE_BYTES):
            if not self._plays:
                piece = await self._checked(_line(piece + await answers.readline()), answers)
            if self.refusal:
                return
            here.write(piece)
            await here.drain()

    async def _checked(self, status: bytes, answers: asyncio.StreamReader) -> bytes:
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


class StreamReader:
    """Reads one stream, in a thread of its own, until it has ended for good or `stop` is set.

    A connection that gives no packet for `silent_s` is closed and opened anew, with growing pauses where it has to be
    dialled. The stream has ended when nothing came for `give_up_s`. `refused` is then the reason, where the other side
    will not have us (a wrong name or password) and trying again is no use. `file` opens what is read instead of the
    address: a file that grows. Where the newest frames are wanted rather than all, and they come faster than they can
    be decoded, some are left out up to a key frame.
    """

    def __init__(
        self,
        address: StreamAddress,
        listener: StreamListener,
        settings: LiveSettings,
        stop: threading.Event,
        file: Callable[[Outages], Any] | None = None,
    ) -> None:
        self._address, self._listener, self._settings = address, listener, settings
        self._stop, self._file = stop, file
        self.outages = Outages(address.shown)
        self.refused = ""
        self.failure = ""  # why the last attempt to open it failed
        self.is_over = threading.Event()
        self.counts: Counter[str] = Counter()  # of what is odd in the stream and its metadata
        self._heard_s = time.monotonic()
        self._has_spoken = False
        self._stamp_ns = -1
        self._step_ns = SECOND_NS // 25
        self._thread = threading.Thread(
            target=self._run, name=f"reading {address.shown}", daemon=True
        )

    def start(self) -> None:
        """Begin to read."""
        self._heard_s = time.monotonic()
        self._thread.start()

    def join(self) -> None:
        """Wait until the reader has ended, which it does within `silent_s` of being stopped, or its attempt to open."""
        if self._thread.is_alive():
            self._thread.join(self._address.opens_s + self._settings.silent_s)

    def notices(self) -> list[Notice]:
        """What was found in the stream so far and survived."""
        counts = self.counts
        return [
            *self.outages.notices(),
            *notice("decode_error", counts["packet"], "damaged places in the stream, skipped: {}"),
            *notice("damaged_frame", counts["frame"], "frames damaged in part: {}"),
            *notice(
                "behind",
                counts["behind"],
                "frames that came faster than this computer decodes them, left out up to the next key frame: {}",
            ),
            *notice(
                "missing_pts",
                counts["missing"],
                "frames without a time stamp, set by the usual step: {}",
            ),
        ]

    # ---- inside, in the thread --------------------------------------------------------------------------------

    def _run(self) -> None:
        backoff = Backoff()
        try:
            while not self._stop.is_set() and self._left_s() > 0:
                if self._listen_once():
                    backoff.reset()
                if self.refused or (self._file is not None and self._has_spoken):
                    return
                if not self._address.waits and not self._stop.is_set() and self._left_s() > 0:
                    self._stop.wait(backoff.next_s())
        finally:
            self._listener.ended()
            self.is_over.set()

    def _left_s(self) -> float:
        """How long a silent source is still waited for."""
        limit_s = self._settings.give_up_s if self._has_spoken else self._settings.first_s
        return limit_s - (time.monotonic() - self._heard_s)

    def _listen_once(self) -> bool:
        """One connection from opening to its end; whether any frame came."""
        came = False
        try:
            with ExitStack() as stack:
                container = self._opened(stack)
                if not container.streams.video:
                    raise ValueError("a stream without video")
                video, metadata = container.streams.video[0], klv_streams(container)
                rate = video.average_rate or video.guessed_rate
                name = container.format.name.split(",")[0]
                self._listener.opened(
                    StreamFacts(
                        video.codec_context.name,
                        name,
                        float(rate) if rate else 25.0,
                        bool(metadata),
                    )
                )
                self._listener.restarted()
                self._stamp_ns = -1
                self._step_ns = round(
                    SECOND_NS / float(video.average_rate or video.guessed_rate or 25)
                )
                # frames in threads would hold several back; a stripe each does not
                video.thread_type = "SLICE"
                backlog = Backlog()
                for packet in container.demux([video, *metadata]):
                    if self._stop.is_set():
                        return came
                    if not packet.size:
                        continue
                    # Something came; when a read times out, FFmpeg hands over the packet that it
                    # had held back as well.
                    is_first = not came
                    now_s = time.monotonic()
                    if (
                        is_first
                        or now_s - self._heard_s < self._settings.silent_s
                        or self._file is not None
                    ):
                        self._heard_s = now_s
                        self.outages.back()
                    if self._is_wanted(packet, backlog):
                        came |= self._take(packet)
            self._lost("the sender ended the stream")
        except (av.FFmpegError, OSError, ValueError, IndexError, MemoryError) as error:
            self._lost(self._why(error))
            self.counts["packet"] += self._file is not None and self._has_spoken
            if isinstance(error, REFUSALS) and not self._has_spoken:
                self.refused = self.failure
        return came

    def _opened(self, stack: ExitStack) -> Any:
        """The container, closed when the stack is."""
        if self._file is not None:
            file = stack.enter_context(closing(self._file(self.outages)))
            return stack.enter_context(av.open(file, options=dict(self._address.options)))
        open_s = min(self._address.opens_s, max(0.2, self._left_s()))
        return stack.enter_context(open_stream(self._address, open_s, self._settings))

    def _lost(self, reason: str) -> None:
        self.failure = reason
        if self._has_spoken and not self._stop.is_set() and self._file is None:
            self.outages.lost(self._heard_s, reason)

    def _why(self, error: Exception) -> str:
        if isinstance(error, av.error.ExitError):
            return f"silent for {time.monotonic() - self._heard_s:.1f} s"
        return getattr(error, "strerror", None) or str(error)

    def _is_wanted(self, packet: Any, backlog: Backlog) -> bool:
        """Whether a packet is looked at; video that is not is counted."""
        if packet.stream.type == "data" or self._settings.keeps_all:
            return True
        stamp_ns = _stamp_of(packet, packet.time_base, by_order=True)
        decodes = backlog.decodes(stamp_ns, is_key=packet.is_keyframe, now_s=time.monotonic())
        self.counts["behind"] += not decodes
        return decodes

    def _take(self, packet: Any) -> bool:
        """Give on what is in a packet; whether a frame was."""
        if packet.stream.type == "data":
            stamp_ns = _stamp_of(packet, packet.time_base)
            for stated in local_sets(bytes(packet), self.counts):
                self._listener.metadata(stated, self._stamp_ns if stamp_ns is None else stamp_ns)
            return False
        self._note_sender_report(packet)
        self.counts["packet"] += packet.is_corrupt
        try:
            decoded = packet.decode()
        except (av.FFmpegError, ValueError, MemoryError):
            self.counts["packet"] += 1
            return False
        came = False
        for frame in decoded:
            if frame.width * frame.height <= PIXEL_LIMIT:
                self.counts["frame"] += frame.is_corrupt
                self._has_spoken = came = True
                self._listener.frame(frame, self._next_stamp_ns(frame), time.monotonic())
        return came

    def _next_stamp_ns(self, frame: av.VideoFrame) -> int:
        stamp_ns = _stamp_of(frame, frame.time_base)
        if stamp_ns is None:
            self.counts["missing"] += 1
            stamp_ns = self._stamp_ns + self._step_ns
        elif self._stamp_ns >= 0 and not 0 < stamp_ns - self._stamp_ns < STAMP_JUMP_NS:
            self._listener.restarted()  # the sender began anew, or set its clock
        self._stamp_ns = stamp_ns
        return stamp_ns

    def _note_sender_report(self, packet: Any) -> None:
        """RTP packets carry their sender's clock once an RTCP report came (FFmpeg's producer reference time)."""
        if not packet.has_sidedata("prft"):
            return
        stamp_ns = _stamp_of(packet, packet.time_base)
        microseconds = int.from_bytes(
            bytes(packet.get_sidedata("prft"))[:_WALLCLOCK_BYTES], "little", signed=True
        )
        if stamp_ns is not None and microseconds > 0:
            self._listener.reported(stamp_ns, microseconds * 1000)


def _stamp_of(timed: Any, time_base: Any, *, by_order: bool = False) -> int | None:
    """When a picture is shown or, `by_order`, decoded."""
    first, second = (timed.dts, timed.pts) if by_order else (timed.pts, timed.dts)
    stamp = second if first is None else first
    return None if stamp is None or not time_base else round(stamp * time_base * SECOND_NS)
