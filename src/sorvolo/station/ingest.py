"""Flights that drones send: taken in message by message, kept on the disk, acknowledged once they are there."""

import asyncio
import json
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Protocol

from sorvolo.capture.live.growing import ENDED_SUFFIX
from sorvolo.errors import InputError, StoreError
from sorvolo.missions.worker import BOXES, MOTION
from sorvolo.paths import Json, JsonView
from sorvolo.station.messages import (
    BUSY_CODE,
    REFUSED_CODE,
    Hello,
    Kind,
    Message,
    MessageSample,
    begins_decoding,
    check_stream,
    has_picture,
    hello_from_json,
    is_stream,
    message_from_bytes,
    sample_from_json,
)
from sorvolo.station.problems import Problem
from sorvolo.station.state import shortage
from sorvolo.station.transport_stream import FlightFile
from sorvolo.station.video import VideoHub
from sorvolo.store.atomic import atomic_write_bytes

_SHOWN_AS = {
    BOXES: "boxes",
    MOTION: "motion",
}  # the messages of a mission's lines, beside the video
_LIVE_NS = 60_000_000_000  # telemetry that is so old was recorded
_MOST_REASON_BYTES = 120  # a close frame holds 123


_HELLO_S = 10.0  # a new link introduces itself within
_SPACE_EVERY_S = 1.0  # how often the disk's free space is asked for
_FLIGHTS_SHOWN = 10  # of a stream, with each of its states: thousands of states are kept


@dataclass(frozen=True)
class IngestLimits:
    """What a station takes from drones."""

    streams: int = 16  # that send at the same time
    message_bytes: int = 8_000_000  # a key frame of 4K has one or two million
    free_bytes: int = 2_000_000_000  # of the disk, which stay free
    sync_s: float = 0.25  # how often the disk is waited for, and what it has acknowledged
    silent_s: float = 30.0  # a link that sends nothing for so long is closed


class LinkClosed(Exception):
    """The other side is gone."""


class DroneLink(Protocol):
    """One connection of a drone."""

    async def receive(self) -> bytes:
        """The next binary message. Raises LinkClosed."""

    async def send(self, text: str) -> None:
        """Send an answer. Raises LinkClosed."""

    async def close(self, code: int, reason: str) -> None:
        """End the connection."""


Announce = Callable[[str, JsonView], None]
"""Called with a stream's id and its state whenever that changes."""


class Refusal(Exception):
    """Why a drone's link is closed. `is_final`: trying again is no use."""

    def __init__(self, reason: str, *, is_final: bool = True) -> None:
        super().__init__(reason)
        self.code = REFUSED_CODE if is_final else BUSY_CODE


class Ingest:
    """All streams of a station, each a folder below `folder`. Used from one event loop."""

    def __init__(
        self,
        folder: Path,
        limits: IngestLimits = IngestLimits(),
        announce: Announce = lambda *_: None,
    ) -> None:
        self._folder, self._limits, self._announce = folder, limits, announce
        self._flights: dict[str, Flight] = {}
        self._links: dict[str, DroneLink] = {}
        self._hubs: dict[str, VideoHub] = {}
        # in which drones and viewers are served
        self._loop: asyncio.AbstractEventLoop | None = None

    async def serve(self, stream: str, link: DroneLink) -> None:
        """Take one connection until it ends; why it was refused is sent to the drone."""
        self._loop = asyncio.get_running_loop()
        try:
            try:
                await self._take_all(stream, await self._greeted(stream, link), link)
            finally:
                await self._let_go(stream, link)
        except Refusal as refusal:
            await _close(link, refusal.code, str(refusal))
        except (InputError, StoreError) as error:
            await _close(link, REFUSED_CODE, f"{error}")
        except LinkClosed:
            pass

    def hub(self, stream: str) -> VideoHub:
        """Where a stream's pictures are shown, whether a drone sends it yet or not. Raises InputError for an
        impossible id."""
        check_stream(stream)
        if stream not in self._hubs:
            for name in [
                name
                for name, hub in self._hubs.items()
                if not hub.viewers and name not in self._links
            ]:
                del self._hubs[name]  # asked for once, perhaps by a name that never was
            self._hubs[stream] = VideoHub()
        return self._hubs[stream]

    def viewers(self, stream: str) -> int:
        """How many watch a stream. Safe to use from other threads."""
        hub = self._hubs.get(stream)
        return 0 if hub is None else hub.viewers

    def streams(self) -> list[Json]:
        """The state of every stream that was ever taken, by name."""
        names = (
            {each.name for each in self._folder.iterdir() if each.is_dir()}
            if self._folder.is_dir()
            else set()
        )
        return [self.state(name) for name in sorted(names) if is_stream(name)]

    def state(self, stream: str) -> Json:
        """A stream at a glance: its newest flights, in order, and what the one that is being sent does."""
        check_stream(stream)
        flight, files = self._flights.get(stream), self._files(stream)
        found = {
            "stream": stream,
            "is_connected": stream in self._links,
            "flight_count": len(files),
            "flights": [_kept(each) for each in files[-_FLIGHTS_SHOWN:]],
        }
        return found | (flight.figures() if flight is not None else {})

    def samples(self) -> dict[str, MessageSample]:
        """The newest telemetry of each drone that sends now, by stream. Safe to use from other threads."""
        found = {
            stream: self._flights[stream].last_sample
            for stream in list(self._links)
            if stream in self._flights
        }
        return {stream: sample for stream, sample in found.items() if sample is not None}

    def newest(self, stream: str) -> Path | None:
        """The file of the stream's newest flight, which a mission follows; None where there is none."""
        files = self._files(stream)
        return files[-1] if files else None

    def kept_bytes(self, stream: str) -> int:
        """How much of a stream's flights lies on the disk."""
        return sum(each.stat().st_size for each in self._files(stream))

    def delete(self, stream: str, flight: str | None = None) -> None:
        """Take a stream's recordings away, or one of them; called in the event loop, where none begins meanwhile.

        Raises Problem: 404 where there is none, 423 where the drone sends it.
        """
        check_stream(stream)
        files = [each for each in self._files(stream) if flight in (None, each.stem)]
        if not files:
            raise Problem(
                404, f"no such recording of the stream {stream}; /api/streams lists those there are"
            )
        now = self._flights.get(stream)
        if stream in self._links and (now is None or now.path in files):
            raise Problem(423, f"the stream {stream} is being sent; wait until its flight is over")
        if now is not None and now.path in files:
            del self._flights[stream]
        for each in files:
            for path in (each, each.with_suffix(".json"), _ended(each)):
                path.unlink(missing_ok=True)
        if not any((self._folder / stream).iterdir()):
            (self._folder / stream).rmdir()

    def show(self, kind: str, found: JsonView) -> None:
        """Give what a mission found in one frame, BOXES or MOTION, to whoever watches the stream; from any thread.

        Their times are UTC; the pictures' own times count from the flight's zero, which telemetry ties to UTC.
        """
        stream = str(found.get("stream") or "")
        flight, hub, loop = self._flights.get(stream), self._hubs.get(stream), self._loop
        if (
            flight is None
            or hub is None
            or loop is None
            or flight.zero_us is None
            or not hub.viewers
        ):
            return
        words = {
            **found,
            "type": _SHOWN_AS[kind],
            "pts_us": _utc_us(found["time"]) - flight.zero_us,
        }
        if kind == MOTION:
            words["from_us"] = _utc_us(found["from_time"]) - flight.zero_us
        try:
            loop.call_soon_threadsafe(hub.note, words)
        except RuntimeError:  # the loop was closed: nobody watches any more
            pass

    async def close(self) -> None:
        """Close every file; the drones' links end with the server."""
        for flight in self._flights.values():
            await asyncio.to_thread(flight.close)

    # ---- inside -----------------------------------------------------------------------------------------------

    async def _let_go(self, stream: str, link: DroneLink) -> None:
        """A link has ended, also one that was refused: where it is still the stream's own, the stream is free again."""
        if self._links.get(stream) is not link:
            return
        flight = self._flights.get(stream)
        try:
            if flight is not None:
                # first: a link that comes meanwhile must not use this file
                await asyncio.to_thread(flight.close)
        finally:
            if self._links.get(stream) is link:
                del self._links[stream]
                self._announce(stream, self.state(stream))

    def _files(self, stream: str) -> list[Path]:
        """The files of a stream's flights, oldest first."""
        folder = self._folder / stream
        return sorted(folder.glob("*.ts")) if folder.is_dir() else []

    async def _greeted(self, stream: str, link: DroneLink) -> "Flight":
        """The flight that a drone comes with, open for writing. Raises Refusal, InputError or StoreError."""
        check_stream(stream)
        try:
            first = message_from_bytes(await asyncio.wait_for(link.receive(), _HELLO_S))
        except TimeoutError:
            raise Refusal(f"no hello within {_HELLO_S:.0f} s", is_final=False) from None
        if first.kind is not Kind.HELLO:
            raise Refusal("the first message must be a hello")
        hello = hello_from_json(first.payload)
        self._check_space()
        await self._make_room(stream, hello, link)
        flight = self._flights.get(stream)
        known = None if flight is None else (flight.hello.flight, flight.hello.codec)
        if flight is None or known != (hello.flight, hello.codec) or not flight.is_open:
            flight = await asyncio.to_thread(open_flight, self._folder / stream, hello)
        self._flights[stream], self._links[stream] = flight, link
        self.hub(stream).begin(hello)
        await link.send(json.dumps({"type": "welcome", "seq": flight.last_seq}))
        self._announce(stream, self.state(stream))
        return flight

    async def _make_room(self, stream: str, hello: Hello, link: DroneLink) -> None:
        """End an older link of the same drone. Raises Refusal where another one sends, or too many do."""
        older = self._links.get(stream)
        if older is None:
            if len(self._links) >= self._limits.streams:
                raise Refusal(
                    f"{len(self._links)} streams are being sent, and no more are taken",
                    is_final=False,
                )
            self._links[stream] = link  # so that two that come at once are not both let in
            return
        before = self._flights.get(stream)
        if before is not None and before.hello.flight != hello.flight:
            raise Refusal(
                f"another drone sends as {stream}; give --stream another name", is_final=False
            )
        self._links[stream] = link
        await _close(older, BUSY_CODE, "the drone opened a newer link")
        if before is not None:
            await asyncio.to_thread(before.close)

    async def _take_all(self, stream: str, flight: "Flight", link: DroneLink) -> None:
        hub = self.hub(stream)
        syncing = asyncio.create_task(self._acknowledge(flight, link))
        space_s = 0.0
        try:
            while True:
                message = await self._received(link)
                if time.monotonic() - space_s > _SPACE_EVERY_S:
                    space_s = time.monotonic()
                    self._check_space()
                if self._links.get(stream) is not link:
                    raise LinkClosed
                if message.kind is Kind.END:
                    await asyncio.to_thread(flight.end)
                    await link.send(json.dumps({"type": "ack", "seq": flight.last_seq}))
                    await link.send(json.dumps({"type": "ended", "seq": flight.last_seq}))
                    await link.close(1000, "the flight is over")
                    return
                if flight.take(message) and message.kind is Kind.VIDEO:
                    hub.show(message)
                elif (
                    flight.last_sample is not None
                    and hub.epoch_us is None
                    # of a flight that goes on, whose delay can be stated, and not of a recorded one
                    and abs(time.time_ns() - flight.last_sample.time_ns) < _LIVE_NS
                ):
                    hub.epoch_us = flight.zero_us
        finally:
            syncing.cancel()

    async def _received(self, link: DroneLink) -> Message:
        try:
            data = await asyncio.wait_for(link.receive(), self._limits.silent_s)
        except TimeoutError:
            raise Refusal(
                f"nothing came for {self._limits.silent_s:.0f} s", is_final=False
            ) from None
        if len(data) > self._limits.message_bytes:
            raise Refusal(
                f"a message of {len(data):,} bytes; {self._limits.message_bytes:,} at most are taken"
            )
        return message_from_bytes(data)

    def _check_space(self) -> None:
        self._folder.mkdir(parents=True, exist_ok=True)
        if short := shortage(self._folder, self._limits.free_bytes / 1e9):
            raise Refusal(f"the station's disk is full: {short}", is_final=False)

    async def _acknowledge(self, flight: "Flight", link: DroneLink) -> None:
        """Acknowledge what the disk has, step by step."""
        done = flight.last_seq
        while True:
            await asyncio.sleep(self._limits.sync_s)
            if flight.last_seq > done:
                done = await asyncio.to_thread(flight.sync)
                try:
                    await link.send(json.dumps({"type": "ack", "seq": done}))
                except LinkClosed:
                    return


class Flight:
    """One flight on the disk. `take` adds a message; `open_flight` makes it."""

    def __init__(self, path: Path, hello: Hello) -> None:
        self.path, self.hello = path, hello
        self._file = FlightFile(path, hello.codec)
        self.is_open = True
        self.frames = self.samples = self.repeated = self.missing = 0
        self.last_sample: MessageSample | None = None
        self.zero_us: int | None = None  # UTC of the flight's zero, as telemetry has it
        self._needs_key = True
        self._taken_s: deque[float] = deque(maxlen=90)
        _ended(path).unlink(missing_ok=True)

    @property
    def last_seq(self) -> int:
        """The number of the last message that was written."""
        return self._file.last_seq

    def take(self, message: Message) -> bool:
        """Write a message; False for one that is there already. Raises Refusal for what is no video or telemetry."""
        if message.kind not in (Kind.VIDEO, Kind.TELEMETRY):
            raise Refusal(f"a message of the kind {message.kind} in the middle of a flight")
        if message.seq <= self._file.last_seq:
            self.repeated += 1
            return False
        self._check(message)
        try:
            self._file.append(message)
        except OSError as error:
            raise Refusal(f"the station cannot write ({error.strerror})", is_final=False) from error
        self.missing += message.seq - self._file.last_seq - 1 if self._file.last_seq else 0
        if message.kind is Kind.VIDEO:
            self.frames += 1
            self._taken_s.append(time.monotonic())
        else:
            self.samples += 1
        return True

    def sync(self) -> int:
        """Wait until the disk has everything up to the number that is given back."""
        seq = self._file.last_seq
        if self.is_open:
            self._file.sync()
        return seq

    def end(self) -> None:
        """The flight is over: who follows the file may stop."""
        self.close()
        atomic_write_bytes(_ended(self.path), b"")

    def close(self) -> None:
        """Let go of the file, which the disk then has."""
        if self.is_open:
            self.is_open = False
            self._file.close()

    def figures(self) -> Json:
        """What a crew wants to know."""
        span_s = self._taken_s[-1] - self._taken_s[0] if len(self._taken_s) > 1 else 0.0
        hello = self.hello
        return {
            "flight": self.path.stem,
            "name": hello.name,
            "codec": hello.codec,
            "width": hello.width,
            "height": hello.height,
            "fps": hello.fps,
            "frames": self.frames,
            "samples": self.samples,
            "repeated": self.repeated,
            "last_seq": self._file.last_seq,
            "last_pts_us": self._file.last_pts_us,
            "frames_per_s": round((len(self._taken_s) - 1) / span_s, 2) if span_s else None,
            "telemetry": None if self.last_sample is None else dict(self.last_sample.columns),
        }

    def _check(self, message: Message) -> None:
        if message.kind is Kind.TELEMETRY:
            self.last_sample = sample_from_json(message.payload)
            self.zero_us = self.last_sample.time_ns // 1000 - message.pts_us
            return
        if not 0 <= message.pts_us < 2**52 or not -(2**40) < (message.dts_us or 0) < 2**52:
            raise Refusal(f"a picture at the time {message.pts_us} us")
        codec = self.hello.codec
        if not has_picture(codec, message.payload):
            raise Refusal(f"what was sent as {codec} is none: it has no pictures with start codes")
        if message.is_key and self._needs_key:
            if not begins_decoding(codec, message.payload):
                raise Refusal(f"what was sent as a key frame of {codec} has no parameter sets")
            self._needs_key = False


def open_flight(folder: Path, hello: Hello) -> Flight:
    """The flight that a drone states, begun or gone on with: its file is found by its id.

    Raises StoreError where the file cannot be used, InputError where the drone comes back with another codec.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        found = next(iter(sorted(folder.glob(f"*_{hello.flight}.ts"))), None)
        if found is None:
            path = folder / f"{datetime.now(UTC):%Y%m%dT%H%M%SZ}_{hello.flight}.ts"
            atomic_write_bytes(path.with_suffix(".json"), hello.to_json().encode())
            return Flight(path, hello)
        before = hello_from_json(found.with_suffix(".json").read_bytes())
        if before.codec != hello.codec:
            raise InputError(
                f"this flight is {before.codec}, and now {hello.codec} comes; begin a new flight"
            )
        return Flight(found, hello)
    except OSError as error:
        raise StoreError(
            f"cannot use {folder} ({error.strerror or error}); check the disk"
        ) from error


def _utc_us(text: Any) -> int:
    return round(datetime.fromisoformat(str(text)).timestamp() * 1e6)


def _kept(path: Path) -> Json:
    """A flight on the disk as it is listed."""
    return {"flight": path.stem, "bytes": path.stat().st_size, "is_over": _ended(path).exists()}


def _ended(path: Path) -> Path:
    return path.with_name(path.name + ENDED_SUFFIX)


async def _close(link: DroneLink, code: int, reason: str) -> None:
    try:
        short = reason.encode()[:_MOST_REASON_BYTES].decode("utf-8", "ignore")
        await link.close(code, short)
    except LinkClosed:
        pass
