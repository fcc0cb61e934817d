"""The drone as a client: sends a flight to a station over one connection, kept through outages and near live."""

import asyncio
import json
import ssl
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit, urlunsplit

from websockets.asyncio.client import ClientConnection, connect, unix_connect
from websockets.exceptions import ConnectionClosed, InvalidHandshake, InvalidStatus, InvalidURI

from sorvolo import __version__
from sorvolo.capture.live.reconnect import Backoff
from sorvolo.errors import InputError, SettingsError
from sorvolo.missions.watch.cot_sender import trusting
from sorvolo.station.footage import Footage, Format, Remains
from sorvolo.station.messages import (
    REFUSED_CODE,
    Hello,
    Kind,
    Message,
    check_stream,
    hello_from_json,
)
from sorvolo.station.spool import Spool

_TURN_S = 0.02  # how long the sender rests where there is nothing to send
_CONNECT_S = 10.0  # over a weak link; by choice
_ANSWER_S = 10.0  # to a greeting or a flight's end; by choice
_MOST_SENT_BYTES = 4_000_000  # on the way and not acknowledged
# age of what is on the way; more waits in the spool, from where it can be left out
_MOST_WAY_S = 2.0
_CATCH_UP = 0.5  # seconds of an outage that are made up for in a second
_DELAYS_KEPT = 100_000  # acknowledgements: an hour of video at 25 pictures a second
_SAME_FLIGHT_NS = 600_000_000_000  # a client that was away for longer comes with another flight
_PING_S = 5.0  # a link that answers no ping for so long is opened anew


@dataclass(frozen=True)
class StreamSettings:
    """How a flight is sent."""

    speed: float = 1.0  # of a recording: 1 as it was flown, 0 as fast as the link takes it
    latency_s: float = 5.0  # older pictures are dropped to the next key frame; infinite: none are
    spool_bytes: int = 512_000_000  # kept through an outage
    flush_s: float = 10.0  # after a stop, to send what waits
    give_up_s: float = float("inf")  # without a link, once everything was taken
    authority: Path | None = None  # of the station's certificate, PEM
    # the socket of a station on this machine, which is called instead of the address
    door: str = ""

    def __post_init__(self) -> None:
        if not (self.speed == 0 or 0.01 <= self.speed <= 1000):
            raise SettingsError(f"the speed must be 0 or lie in 0.01 to 1000, got {self.speed:g}")
        if not self.latency_s >= 0.2:
            raise SettingsError(f"the latency must be 0.2 s or more, got {self.latency_s:g}")
        if self.spool_bytes < 1_000_000:
            raise SettingsError("the spool must hold 1 MB or more")


@dataclass
class StreamReport:
    """What was sent, dropped and kept so far. Delays are from taking a picture to the station's acknowledgement."""

    stream: str
    frames: int = 0  # acknowledged
    samples: int = 0  # sent
    sent_bytes: int = 0  # over the link, with what was sent twice
    late: int = 0
    overflowed: int = 0
    spooled: int = 0  # pictures that still wait
    outages: int = 0
    outage_s: float = 0.0
    is_linked: bool = False
    words: str = ""  # why there is no link
    delays_s: deque[float] = field(default_factory=lambda: deque(maxlen=_DELAYS_KEPT))


def stream_url(station: str, stream: str) -> str:
    """The WebSocket address of a stream at a station: `http://HOST:PORT`, `https://...`, `ws://...` or `wss://...`.

    Raises SettingsError for what is no such address, InputError for what is no stream's name.
    """
    check_stream(stream)
    schemes = {"http": "ws", "https": "wss", "ws": "ws", "wss": "wss"}
    try:
        parts = urlsplit(station)
        host, _ = parts.hostname, parts.port
    except ValueError as error:
        raise SettingsError(
            f"--to {station}: {error}; give for instance http://192.168.1.5:8750"
        ) from error
    if parts.scheme not in schemes or not host or parts.username or parts.query:
        raise SettingsError(
            f"--to {station} is no station's address; give for instance http://192.168.1.5:8750"
        )
    path = f"{parts.path.rstrip('/')}/api/ingest/{stream}"
    return urlunsplit((schemes[parts.scheme], parts.netloc, path, "", ""))


def remains_of(spool: Spool, now_ns: int) -> Remains | None:
    """What is left of a live flight that an earlier run took, where it is too long ago to go on with that flight."""
    text = spool.stated()
    if not text or spool.is_empty or now_ns - spool.last_taken_ns < _SAME_FLIGHT_NS:
        return None
    hello = hello_from_json(text)
    return Remains(hello.name, Format(hello.codec, hello.width, hello.height, hello.fps))


class StreamClient:
    """Sends one flight. `run` returns when all of it is with the station, or what is left is kept in the spool."""

    def __init__(
        self,
        footage: Footage,
        spool: Spool,
        url: str,
        token: str,
        settings: StreamSettings,
        stop: threading.Event,
    ) -> None:
        self._footage, self._spool, self._url, self._token = footage, spool, url, token
        self._settings, self._stop = settings, stop
        self._is_taken = threading.Event()  # all pieces were taken
        self._failure: BaseException | None = None
        self._allowance = _Allowance(settings.latency_s)
        # what an earlier run left is late, and sent all the same
        if (oldest_ns := spool.oldest_ns) is not None:
            self._allowance.add((time.time_ns() - oldest_ns) / 1e9)
        self._way = _Way()
        self._was_linked = False
        self.report = StreamReport(url.rpartition("/")[2])

    def run(self, show: Callable[[StreamReport], None] = lambda _: None) -> StreamReport:
        """Send everything; `show` is called about once a second.

        Raises InputError where the station refuses the stream, SettingsError for a certificate that cannot be used, and
        what reading the input raises, once all that was read before is sent.
        """
        taking = threading.Thread(target=self._take, name="taking", daemon=True)
        taking.start()
        try:
            asyncio.run(self._send_all(show))
        finally:
            self._stop.set()
            taking.join(5.0)
            self._count()
        if self._failure is not None:
            raise self._failure
        return self.report

    @property
    def is_complete(self) -> bool:
        """Whether the station has the whole flight, but for what was dropped and counted."""
        return self._is_taken.is_set() and self._spool.is_empty

    # ---- the thread that takes pieces -------------------------------------------------------------------------

    def _take(self) -> None:
        try:
            self._take_pieces()
        except BaseException as error:  # raised by `run`, when what was taken before is sent
            self._failure = error
        finally:
            self._is_taken.set()

    def _take_pieces(self) -> None:
        footage, spool = self._footage, self._spool
        already = 0 if footage.is_live else spool.last_seq
        pace = _Pace(0.0 if footage.is_live else self._settings.speed)
        begin_us = 0
        if footage.is_live and spool.last_taken_ns:
            begin_us = spool.last_pts_us + max(1, (time.time_ns() - spool.last_taken_ns) // 1000)
        for number, piece in enumerate(footage.pieces(begin_us, self._stop)):
            if number < already:
                continue
            if not pace.wait(piece.dts_us, self._stop) or not self._wait_for_room():
                return
            spool.append(
                piece.kind,
                piece.pts_us,
                piece.payload,
                is_key=piece.is_key,
                dts_us=piece.dts_us,
                taken_ns=time.time_ns(),
            )

    def _wait_for_room(self) -> bool:
        """A recording without a pace goes as fast as the link: it waits instead of filling the spool."""
        while self._settings.speed == 0 and not self._footage.is_live:
            if self._spool.counts().waiting_bytes < self._settings.spool_bytes // 2:
                break
            if self._stop.wait(0.05):
                return False
        return True

    # ---- the link ---------------------------------------------------------------------------------------------

    async def _send_all(self, show: Callable[[StreamReport], None]) -> None:
        backoff = Backoff()
        is_tls = self._url.startswith("wss:")
        context = trusting(self._settings.authority, "--ca") if is_tls else None
        showing = asyncio.create_task(self._show(show))
        lost_s: float | None = time.monotonic()
        stopped_s: float | None = None
        try:
            while True:
                try:
                    async with self._called(context) as link:
                        await self._greet(link)
                        backoff.reset()
                        if lost_s is not None:
                            # whatever was taken without a link is sent, late as it is
                            outage_s = time.monotonic() - lost_s
                            self._allowance.add(outage_s)
                            if self._was_linked:
                                self.report.outages += 1
                                self.report.outage_s += outage_s
                            self._was_linked = True
                            lost_s = None
                        await self._talk(link)
                        return
                except (OSError, ConnectionClosed, InvalidHandshake, TimeoutError) as error:
                    self._judge(error)
                self.report.is_linked = False
                lost_s = time.monotonic() if lost_s is None else lost_s
                if self._stop.is_set() and stopped_s is None:
                    stopped_s = time.monotonic()
                if self._is_hopeless(lost_s, stopped_s):
                    return
                await asyncio.sleep(min(backoff.next_s(), 0.3 if self._stop.is_set() else 10.0))
        finally:
            showing.cancel()
            show(self._count())

    def _called(self, context: ssl.SSLContext | None) -> connect:
        """A new connection to the station, to be entered."""
        headers = {"Authorization": f"Bearer {self._token}"} if self._token else {}
        ways: dict[str, Any] = {
            "compression": None,
            "open_timeout": _CONNECT_S,
            "ping_interval": _PING_S,
            "ping_timeout": _PING_S,
            "close_timeout": 2.0,
            "max_size": 1_000_000,
        }
        if self._settings.door:
            return unix_connect(self._settings.door, self._url, **ways)
        return connect(self._url, ssl=context, additional_headers=headers, proxy=None, **ways)

    def _is_hopeless(self, lost_s: float, stopped_s: float | None) -> bool:
        """Whether to leave what is not sent in the spool."""
        now_s = time.monotonic()
        if stopped_s is not None and now_s - stopped_s > self._settings.flush_s:
            return True
        return self._is_taken.is_set() and now_s - lost_s > self._settings.give_up_s

    def _judge(self, error: Exception) -> None:
        """Note why there is no link. Raises InputError where trying again is no use."""
        if isinstance(error, InvalidStatus):
            status = error.response.status_code
            if status in (401, 403):
                raise InputError(
                    f"the station at {self._url} refuses the token (HTTP {status}); make one with the role operate "
                    "there: sorvolo token, and give it as --token or SORVOLO_TOKEN"
                )
            if status in (404, 405, 421):
                raise InputError(
                    f"{self._url}: no station takes streams there (HTTP {status}); check --to"
                )
        if isinstance(error, InvalidURI):
            raise InputError(f"{self._url}: no address of a station ({error})") from error
        close = error.rcvd if isinstance(error, ConnectionClosed) else None
        if close is not None and close.code == REFUSED_CODE:
            raise InputError(f"the station refuses the stream: {close.reason}") from error
        if isinstance(error, ssl.SSLCertVerificationError):
            raise InputError(
                f"{self._url}: the station's certificate is not trusted ({error.verify_message}); give its authority "
                "as --ca"
            ) from error
        self.report.words = (
            (close.reason if close is not None else "") or str(error) or type(error).__name__
        )

    async def _greet(self, link: ClientConnection) -> None:
        form = self._footage.format
        hello = Hello(
            self._spool.flight,
            form.codec,
            form.width,
            form.height,
            form.fps,
            self._footage.name,
            f"sorvolo {__version__}",
        )
        text = hello.to_json()
        if not self._spool.stated():
            self._spool.stated(text)
        await link.send(Message(Kind.HELLO, 0, 0, text.encode()).to_bytes())
        welcome = json.loads(await asyncio.wait_for(link.recv(), _ANSWER_S))
        self._spool.rewind()
        self._way = _Way()
        self._acknowledge(int(welcome["seq"]))
        self.report.is_linked, self.report.words = True, ""

    async def _talk(self, link: ClientConnection) -> None:
        """Send until the flight is over and acknowledged."""
        answers = asyncio.create_task(self._listen(link))
        try:
            while not (self._is_taken.is_set() and self._spool.is_empty):
                if answers.done():
                    answers.result()
                if not await self._send_next(link):
                    await asyncio.sleep(_TURN_S)
            await link.send(Message(Kind.END, 0, 0, b"").to_bytes())
            await asyncio.wait_for(answers, _ANSWER_S)
        finally:
            answers.cancel()

    async def _send_next(self, link: ClientConnection) -> bool:
        """Send one message; False where there is none, or the link has enough to do."""
        spool, allowed_s = self._spool, self._allowance.now_s()
        if allowed_s != float("inf"):
            spool.drop_late(time.time_ns() - round(allowed_s * 1e9))
        if self._way.bytes > _MOST_SENT_BYTES or self._way.age_s() > min(
            _MOST_WAY_S, allowed_s / 2
        ):
            return False  # more would only wait in the network's own buffers
        message = spool.next()
        if message is None:
            return False
        data = message.to_bytes()
        self.report.sent_bytes += len(data)
        self.report.samples += message.kind is Kind.TELEMETRY
        self._way.sent(message.seq, len(data))
        await link.send(data)
        return True

    async def _listen(self, link: ClientConnection) -> None:
        """Take the station's acknowledgements until it states that it has all."""
        while True:
            answer = json.loads(await link.recv())
            if answer.get("type") == "ended":
                return
            if answer.get("type") == "ack":
                self._acknowledge(int(answer["seq"]))

    def _acknowledge(self, seq: int) -> None:
        now_ns = time.time_ns()
        self._way.acknowledged(seq)
        taken = self._spool.acknowledge(seq)
        self.report.frames += len(taken)
        self.report.delays_s.extend((now_ns - each) / 1e9 for each in taken)

    async def _show(self, show: Callable[[StreamReport], None]) -> None:
        while True:
            await asyncio.sleep(1.0)
            show(self._count())

    def _count(self) -> StreamReport:
        counts: Any = self._spool.counts()
        self.report.late, self.report.overflowed = counts.late, counts.overflowed
        self.report.spooled = counts.waiting
        return self.report


class _Way:
    """What was sent over this link and not yet acknowledged."""

    def __init__(self) -> None:
        self.bytes = 0
        self._sent: deque[tuple[int, int, float]] = deque()  # number, bytes, when

    def sent(self, seq: int, size: int) -> None:
        """A message goes out now."""
        self.bytes += size
        self._sent.append((seq, size, time.monotonic()))

    def acknowledged(self, seq: int) -> None:
        """The station has everything up to this number."""
        while self._sent and self._sent[0][0] <= seq:
            self.bytes -= self._sent.popleft()[1]

    def age_s(self) -> float:
        """How long the oldest message has been on its way."""
        return time.monotonic() - self._sent[0][2] if self._sent else 0.0


class _Allowance:
    """How far pictures may be behind: the latency, and what is left of an outage, which is made up for step by step."""

    def __init__(self, latency_s: float) -> None:
        self._latency_s = latency_s
        self._debt_s, self._since_s = 0.0, time.monotonic()

    def add(self, outage_s: float) -> None:
        """The link was away for so long: its pictures are sent all the same."""
        self._debt_s, self._since_s = self._left_s() + outage_s, time.monotonic()

    def now_s(self) -> float:
        """The oldest picture that is still sent, s."""
        return self._latency_s + self._left_s()

    def _left_s(self) -> float:
        return max(0.0, self._debt_s - _CATCH_UP * (time.monotonic() - self._since_s))


class _Pace:
    """Lets a recording's pieces through when their time comes; 0 lets all through at once."""

    def __init__(self, speed: float) -> None:
        self._speed = speed
        self._began: tuple[int, float] | None = None

    def wait(self, dts_us: int, stop: threading.Event) -> bool:
        """Wait for a piece's time; False where the flight was stopped meanwhile."""
        if not self._speed:
            return not stop.is_set()
        if self._began is None:
            self._began = dts_us, time.monotonic()
        due_s = self._began[1] + (dts_us - self._began[0]) / 1e6 / self._speed
        left_s = due_s - time.monotonic()
        return not (stop.wait(left_s) if left_s > 0 else stop.is_set())
