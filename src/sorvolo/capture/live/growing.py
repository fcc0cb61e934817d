"""A video file that is still being written, read as it grows."""

import threading
import time
from pathlib import Path
from typing import BinaryIO

from sorvolo.capture.live.reconnect import LiveSettings, Outages

ENDED_SUFFIX = ".ended"
"""A file of this name beside a growing one states that nothing more is added."""

_POLL_S = 0.01  # pictures wait for it
_PACKET_BYTES = 188  # ISO/IEC 13818-1
_TABLE = b"\x47\x00\x00"  # a packet of the program association table: its first bytes without their flags
_SEARCHED_PACKETS = 10_000  # at a time
# of a transport stream, some ten seconds: who wants the newest frames begins there
_NEWEST_BYTES = 16_000_000


class GrowingFile:
    """What PyAV reads from: it waits for more at the file's end, until nothing was added for `give_up_s`, or until
    a file beside it (`ENDED_SUFFIX`) states its end.

    There is no seeking, so the container must be one that is written front to back: MPEG-TS, fragmented MP4, MKV. Where
    the newest frames are wanted rather than all, a long transport stream is begun near its end, where it is described:
    between two of these places nothing in it can be decoded.
    """

    def __init__(
        self, path: Path, settings: LiveSettings, outages: Outages, stop: threading.Event
    ) -> None:
        self._file = path.open("rb")
        self._ended = path.with_name(path.name + ENDED_SUFFIX)
        self._settings, self._outages, self._stop = settings, outages, stop
        size = path.stat().st_size
        self.is_whole = True
        """Whether it is read from its beginning."""
        if not settings.keeps_all and size > _NEWEST_BYTES and self._file.read(1) == b"\x47":
            begin = _described_before(self._file, (size - _NEWEST_BYTES) // _PACKET_BYTES)
            self.is_whole = begin == 0
            self._file.seek(begin)
        else:
            self._file.seek(0)

    def read(self, size: int) -> bytes:
        """At most so many bytes; none when the file has ended."""
        began_s = time.monotonic()
        while not self._stop.is_set():
            if data := self._file.read(size):
                self._outages.back()
                return data
            if self._ended.exists():
                return self._file.read(size)
            quiet_s = time.monotonic() - began_s
            if quiet_s > self._settings.give_up_s:
                break
            if quiet_s > self._settings.silent_s:
                self._outages.lost(began_s, f"nothing was added for {quiet_s:.1f} s")
            self._stop.wait(_POLL_S)
        return b""

    def close(self) -> None:
        """Let go of the file."""
        self._file.close()


def _described_before(file: BinaryIO, packet: int) -> int:
    """Where a transport stream is described last, at this packet or before; its beginning where it is nowhere."""
    end = packet + 1
    while end > 0:
        first = max(0, end - _SEARCHED_PACKETS)
        file.seek(first * _PACKET_BYTES)
        data = file.read((end - first) * _PACKET_BYTES)
        for at in range(len(data) - _PACKET_BYTES, -1, -_PACKET_BYTES):
            if bytes((data[at], data[at + 1] & 0x1F, data[at + 2])) == _TABLE:
                return first * _PACKET_BYTES + at
        end = first
    return 0
