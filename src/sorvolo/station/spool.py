"""The spool of a drone's client: what is not acknowledged yet, in files that survive a restart."""

import secrets
import struct
import threading
import zlib
from collections import Counter, deque
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, Literal

from sorvolo.errors import InputError
from sorvolo.station.messages import Kind, Message, message_from_bytes
from sorvolo.store.atomic import take_lock

_RECORD = struct.Struct(">IIq")  # length, checksum, when it was taken (UTC, ns)
# of a file; what is acknowledged leaves the disk in such pieces; by choice
_SEGMENT_BYTES = 16_000_000
_FLIGHT, _HELLO, _LOCK = "flight", "hello.json", "lock"

_Reason = Literal["late", "overflow"]


@dataclass(frozen=True)
class _Stored:
    """Where a message lies."""

    seq: int
    is_video: bool
    is_key: bool
    taken_ns: int
    segment: int
    offset: int
    length: int


@dataclass(frozen=True)
class SpoolCounts:
    """What a spool holds, and how many frames it gave up."""

    waiting: int
    waiting_bytes: int
    late: int  # dropped: older than the link may fall behind
    overflowed: int  # dropped: the spool's limit was reached


class Spool:
    """Messages of one flight in order, numbered from 1. Safe to use from two threads: one adds, one sends.

    A message is *waiting* until it was taken by `next`, then *sent* until `acknowledge` lets go of it; `rewind` lets
    everything that is not acknowledged wait again. Only pictures are ever dropped, from one to just before a key frame.
    Raises InputError where another program uses the folder.
    """

    def __init__(self, folder: Path, limit_bytes: int) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self._folder, self._limit_bytes = folder, limit_bytes
        self._locked = _locked(folder / _LOCK)
        self._segment_bytes = max(1, min(_SEGMENT_BYTES, limit_bytes // 8))
        self._lock = threading.Lock()
        self._waiting: deque[_Stored] = deque()
        self._sent: deque[_Stored] = deque()
        self._held: Counter[int] = Counter()  # messages by segment
        self._readers: dict[int, BinaryIO] = {}
        self._bytes = 0
        self._dropped: Counter[_Reason] = Counter()
        self._needs_key: _Reason | None = None  # why pictures are dropped until a key frame comes
        self.failure = ""  # why the disk took no message, last
        self.last_seq, self.last_pts_us, self.last_taken_ns = 0, -1, 0
        self._segment = 0
        # take up what an earlier run left; a record that was cut ends its file
        numbers = sorted(
            int(each.stem) for each in self._folder.glob("*.spool") if each.stem.isdigit()
        )
        self._segment = numbers[-1] + 1 if numbers else 0  # never behind a record that was cut
        for number in numbers:
            for message, taken_ns, offset, length in _records(self._path(number).read_bytes()):
                is_video = message.kind is Kind.VIDEO
                self._keep(
                    _Stored(message.seq, is_video, message.is_key, taken_ns, number, offset, length)
                )
                self.last_seq, self.last_taken_ns = message.seq, taken_ns
                self.last_pts_us = max(self.last_pts_us, message.pts_us)
            self._remove_if_done(number)
        self._file: BinaryIO = self._path(self._segment).open("ab", buffering=0)
        self.flight = self._flight()

    def stated(self, hello: str | None = None) -> str:
        """The flight's hello as the first run with this spool stated it; "" where none did. Given one, keep it."""
        path = self._folder / _HELLO
        if hello is not None:
            path.write_text(hello, encoding="utf-8")
        return path.read_text(encoding="utf-8") if path.exists() else ""

    def append(
        self,
        kind: Kind,
        pts_us: int,
        payload: bytes,
        *,
        taken_ns: int,
        is_key: bool = False,
        dts_us: int | None = None,
    ) -> None:
        """Add a message; the oldest pictures go where the limit is reached, and new ones where the disk is full."""
        with self._lock:
            self.last_seq += 1
            self.last_pts_us, self.last_taken_ns = max(self.last_pts_us, pts_us), taken_ns
            if kind is Kind.VIDEO:
                if self._needs_key is not None and not is_key:
                    self._dropped[self._needs_key] += 1
                    return
                self._needs_key = None
            data = Message(kind, self.last_seq, pts_us, payload, is_key, dts_us).to_bytes()
            try:
                self._store(data, kind, taken_ns, is_key=is_key)
            except OSError as error:
                self.failure = error.strerror or str(error)
                if kind is Kind.VIDEO:
                    self._dropped["overflow"] += 1
                    self._needs_key = "overflow"
            while self._bytes > self._limit_bytes and self._drop_oldest():
                pass

    def next(self) -> Message | None:
        """The next message to send; None while there is none."""
        with self._lock:
            if not self._waiting:
                return None
            stored = self._waiting.popleft()
            self._sent.append(stored)
            return message_from_bytes(self._read(stored))

    def acknowledge(self, seq: int) -> list[int]:
        """The station has everything up to this number; when each picture among it was taken (UTC, ns)."""
        with self._lock:
            done: list[int] = []
            for queue in (self._sent, self._waiting):
                while queue and queue[0].seq <= seq:
                    stored = queue.popleft()
                    self._let_go(stored)
                    done += [stored.taken_ns] if stored.is_video else []
            if seq > self.last_seq:  # a spool that was lost: the numbers go on all the same
                self.last_seq = seq
            return done

    def rewind(self) -> None:
        """The link is new: what was sent and not acknowledged is sent again."""
        with self._lock:
            self._waiting.extendleft(reversed(self._sent))
            self._sent.clear()

    def drop_late(self, before_ns: int) -> None:
        """Where a waiting picture was taken before this moment, drop it and those after it to the next key frame that
        was not; where there is none, to the newest key frame, which is sent, late as it is: the view goes on with it.
        """
        with self._lock:
            first = self._first_picture()
            if first is None or first.taken_ns >= before_ns:
                return
            keys = [(each.taken_ns, each.seq) for each in self._waiting if each.is_key]
            newest = [seq for _, seq in keys[-1:]]
            fresh = [seq for taken_ns, seq in keys if taken_ns >= before_ns]
            self._drop((fresh or newest or [self.last_seq + 1])[0], "late")

    @property
    def oldest_ns(self) -> int | None:
        """When the oldest waiting message was taken (UTC); None where none waits."""
        with self._lock:
            return self._waiting[0].taken_ns if self._waiting else None

    @property
    def is_empty(self) -> bool:
        """Whether everything was acknowledged or dropped."""
        with self._lock:
            return not self._waiting and not self._sent

    def counts(self) -> SpoolCounts:
        """What it holds now, and what was dropped so far."""
        with self._lock:
            waiting = sum(each.is_video for queue in (self._waiting, self._sent) for each in queue)
            return SpoolCounts(
                waiting, self._bytes, self._dropped["late"], self._dropped["overflow"]
            )

    def close(self) -> None:
        """Let go of the files; what is not acknowledged stays in them."""
        with self._lock:
            for file in (self._file, self._locked, *self._readers.values()):
                file.close()
            self._readers.clear()

    def remove(self) -> None:
        """The flight has ended and the station has all of it: take the files away."""
        self.close()
        for path in self._folder.glob("*.spool"):
            path.unlink()
        for name in (_FLIGHT, _HELLO, _LOCK):
            (self._folder / name).unlink(missing_ok=True)
        self._folder.rmdir()

    # ---- inside -----------------------------------------------------------------------------------------------

    def _store(self, data: bytes, kind: Kind, taken_ns: int, *, is_key: bool) -> None:
        if self._file.tell() > self._segment_bytes:
            self._file.close()
            before, self._segment = self._segment, self._segment + 1
            self._file = self._path(self._segment).open("ab", buffering=0)
            self._remove_if_done(before)
        begin = self._file.tell()
        record = _RECORD.pack(len(data), zlib.crc32(data), taken_ns) + data
        try:
            self._file.write(record)
        except OSError:
            self._file.truncate(begin)
            raise
        self._keep(
            _Stored(
                self.last_seq,
                kind is Kind.VIDEO,
                is_key,
                taken_ns,
                self._segment,
                begin + _RECORD.size,
                len(data),
            )
        )

    def _keep(self, stored: _Stored) -> None:
        self._waiting.append(stored)
        self._held[stored.segment] += 1
        self._bytes += stored.length

    def _let_go(self, stored: _Stored) -> None:
        self._held[stored.segment] -= 1
        self._bytes -= stored.length
        self._remove_if_done(stored.segment)

    def _remove_if_done(self, segment: int) -> None:
        if segment != self._segment and not self._held[segment]:
            if reader := self._readers.pop(segment, None):
                reader.close()
            del self._held[segment]
            self._path(segment).unlink(missing_ok=True)

    def _drop_oldest(self) -> bool:
        """Drop the oldest waiting pictures to the next key frame; whether there were any."""
        first = self._first_picture()
        if first is None:
            return False
        until = next(
            (each.seq for each in self._waiting if each.is_key and each.seq > first.seq),
            self.last_seq + 1,
        )
        self._drop(until, "overflow")
        return True

    def _first_picture(self) -> _Stored | None:
        return next((each for each in self._waiting if each.is_video), None)

    def _drop(self, until_seq: int, reason: _Reason) -> None:
        """Drop the waiting pictures before a number."""
        dropped = [each for each in self._waiting if each.is_video and each.seq < until_seq]
        self._waiting = deque(
            each for each in self._waiting if not (each.is_video and each.seq < until_seq)
        )
        for each in dropped:
            self._let_go(each)
        self._dropped[reason] += len(dropped)
        if dropped and until_seq > self.last_seq:
            self._needs_key = reason

    def _read(self, stored: _Stored) -> bytes:
        reader = self._readers.get(stored.segment)
        if reader is None:
            reader = self._readers[stored.segment] = self._path(stored.segment).open("rb")
        reader.seek(stored.offset)
        return reader.read(stored.length)

    def _path(self, segment: int) -> Path:
        return self._folder / f"{segment:08d}.spool"

    def _flight(self) -> str:
        """The flight's id: the same for every run that goes on with this spool."""
        path = self._folder / _FLIGHT
        try:
            return path.read_text(encoding="ascii").strip()
        except OSError:
            made = secrets.token_hex(8)
            path.write_text(made, encoding="ascii")
            return made


def _locked(path: Path) -> BinaryIO:
    """The file, locked until it is closed. Raises InputError where another program holds it."""
    file = path.open("ab")
    if not take_lock(file.fileno()):
        file.close()
        raise InputError(
            f"{path.parent}: another sorvolo stream uses this spool; give this one its own --stream or --spool"
        )
    return file


def _records(data: bytes) -> Iterator[tuple[Message, int, int, int]]:
    at = 0
    while at + _RECORD.size <= len(data):
        length, crc, taken_ns = _RECORD.unpack_from(data, at)
        begin = at + _RECORD.size
        body = data[begin : begin + length]
        if len(body) < length or zlib.crc32(body) != crc:
            return
        try:
            yield message_from_bytes(body), taken_ns, begin, length
        except InputError:
            return
        at = begin + length
