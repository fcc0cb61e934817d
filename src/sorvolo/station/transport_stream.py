"""A flight as an MPEG transport stream that grows: written message by message, whole again after any interruption."""

import os
import struct
import zlib
from collections.abc import Iterator, Mapping
from math import isfinite
from pathlib import Path
from typing import BinaryIO

from sorvolo.capture.live.klv import ITEMS, encode
from sorvolo.capture.live.klv_telemetry import OWN_TAGS
from sorvolo.errors import StoreError
from sorvolo.station.messages import Kind, Message, MessageSample, sample_from_json, with_delimiter

_PACKET, _BODY = 188, 184
_PIDS = _PAT, _PMT, _VIDEO, _METADATA = 0x0000, 0x1000, 0x0100, 0x0101
_MARK = 0x1FE0
_TYPES = {"h264": 0x1B, "hevc": 0x24}
# the flight's zero, 10 s: pictures that are decoded before they are shown stay above 0
_FIRST_90KHZ = 900_000
_PCR_LEAD_90KHZ = 18_000  # 0.2 s, what a receiver may hold back
_MARK_HEAD = struct.Struct(">4sQqIIcB4B")
_MARK_NAME = b"SVL1"
_SEARCHED_BYTES = 64_000_000  # at a file's end, for the last whole message


class FlightFile:
    """The transport stream of one flight. `append` changes it; safe to be read by others while it grows.

    Each message is written at once, followed by a mark: a packet that other programs pass over, with the message's
    number and checksum. By the marks a file that was cut is brought back to its last whole message (`last_seq`), and
    goes on from there with the very bytes that would have followed.
    """

    def __init__(self, path: Path, codec: str) -> None:
        self._codec = codec
        self._counters = dict.fromkeys(_PIDS, 0)  # of continuity, by PID (ISO 13818-1, 2.4.3.3)
        self.last_seq, self.last_pts_us = 0, -1
        self._file: BinaryIO = path.open("r+b" if path.exists() else "w+b", buffering=0)
        # cut the file behind its last whole message and take up its state
        size = os.fstat(self._file.fileno()).st_size
        first = max(0, (size - _SEARCHED_BYTES) // _PACKET * _PACKET)
        self._file.seek(first)
        tail = self._file.read(size - first) or b""
        end = _whole_end(tail, is_all=not first)
        if end is None and size:
            if first:
                raise StoreError(
                    f"{path}: no message in its last {_SEARCHED_BYTES:,} bytes; move it away"
                )
            end = 0
        if end:
            mark = tail[end - _PACKET : end]
            _, self.last_seq, self.last_pts_us, _, _, _, _, *numbers = _MARK_HEAD.unpack_from(
                mark, 4
            )
            self._counters = dict(zip(_PIDS, numbers))
        keep = first + (end or 0)
        if keep < size:
            self._file.truncate(keep)
        self._file.seek(keep)

    @property
    def size_bytes(self) -> int:
        """How long the file is."""
        return self._file.tell()

    def append(self, message: Message) -> None:
        """Write a video or telemetry message. Raises OSError where the disk does not take it; the file stays whole."""
        before, counted = self._file.tell(), dict(self._counters)
        chunk = self._packets(message)
        body = _MARK_HEAD.pack(
            _MARK_NAME,
            message.seq,
            message.pts_us,
            len(chunk),
            zlib.crc32(chunk),
            message.kind.encode(),
            int(message.is_key),
            *self._counters.values(),
        )
        body += zlib.crc32(body).to_bytes(4, "big")
        mark = struct.pack(">BHB", 0x47, _MARK, 0x10 | message.seq & 15) + body.ljust(
            _BODY, b"\xff"
        )
        try:
            data = chunk + mark
            at = self._file.write(data)
            while at < len(data):
                at += self._file.write(data[at:])
        except OSError:
            self._file.truncate(before)
            self._file.seek(before)
            self._counters = counted
            raise
        self.last_seq, self.last_pts_us = message.seq, max(self.last_pts_us, message.pts_us)

    def sync(self) -> None:
        """Wait until the disk has all that was written."""
        getattr(os, "fdatasync", os.fsync)(self._file.fileno())

    def close(self) -> None:
        """Let go of the file, which the disk then has."""
        if not self._file.closed:
            self.sync()
            self._file.close()

    def _packets(self, message: Message) -> bytes:
        if message.kind is Kind.TELEMETRY:
            packet = local_set(sample_from_json(message.payload))
            return b"".join(self._split(_METADATA, _pes(0xBD, packet, message.pts_us, None), b""))
        unit = with_delimiter(self._codec, message.payload)
        dts_us = message.pts_us if message.dts_us is None else message.dts_us
        # an adaptation field's flags and program clock
        base = (_ticks(dts_us) - _PCR_LEAD_90KHZ) & (1 << 33) - 1
        clock = bytes([0x50 if message.is_key else 0x10]) + (base << 15 | 0x7E00).to_bytes(6, "big")
        pictures = self._split(_VIDEO, _pes(0xE0, unit, message.pts_us, dts_us), clock)
        return b"".join([*(self._tables() if message.is_key else ()), *pictures])

    def _tables(self) -> Iterator[bytes]:
        """The packets that describe the stream: before each key frame, so that a reader may begin there."""
        pat = struct.pack(">HBBBHH", 1, 0xC1, 0, 0, 1, 0xE000 | _PMT)
        yield self._table(_PAT, 0x00, pat)
        streams = struct.pack(">BHH", _TYPES[self._codec], 0xE000 | _VIDEO, 0xF000)
        klva = b"\x05\x04KLVA"
        streams += struct.pack(">BHH", 0x06, 0xE000 | _METADATA, 0xF000 | len(klva)) + klva
        yield self._table(
            _PMT, 0x02, struct.pack(">HBBBHH", 1, 0xC1, 0, 0, 0xE000 | _VIDEO, 0xF000) + streams
        )

    def _table(self, pid: int, table: int, body: bytes) -> bytes:
        section = struct.pack(">BH", table, 0xB000 | len(body) + 4) + body
        # CRC-32 of MPEG-2 tables (ISO 13818-1, annex A): no bit is reversed, nothing is
        # inverted at the end
        crc = 0xFFFFFFFF
        for byte in section:
            crc ^= byte << 24
            for _ in range(8):
                crc = (crc << 1 ^ (0x04C11DB7 if crc & 0x80000000 else 0)) & 0xFFFFFFFF
        section += crc.to_bytes(4, "big")
        head = struct.pack(">BHB", 0x47, 0x4000 | pid, 0x10 | self._next(pid))
        return (head + b"\x00" + section).ljust(_PACKET, b"\xff")

    def _split(self, pid: int, data: bytes, clock: bytes) -> Iterator[bytes]:
        """The data in packets of 188 bytes, the first with the clock, the last filled up."""
        at, start = 0, 0x4000
        while at < len(data):
            left = len(data) - at
            room = _BODY - (1 + len(clock) if clock else 0)
            number = self._next(pid)
            if left >= room and not clock:
                yield struct.pack(">BHB", 0x47, start | pid, 0x10 | number) + data[at : at + _BODY]
                at += _BODY
            else:
                body = data[at : at + room]
                fill = _BODY - len(body) - 1  # of the adaptation field, behind its length
                field = (clock or b"\x00").ljust(fill, b"\xff") if fill else b""
                yield struct.pack(">BHBB", 0x47, start | pid, 0x30 | number, fill) + field + body
                at += len(body)
            start, clock = 0, b""

    def _next(self, pid: int) -> int:
        number = self._counters[pid]
        self._counters[pid] = number + 1 & 15
        return number


def local_set(sample: MessageSample) -> bytes:
    """A sample as a MISB ST 0601 local set; numbers outside their tag's range are left out.

    A gimbal's angles are given as a sensor on a level platform that heads where the camera looks, the aircraft's own
    only where the camera's are unknown. What ST 0601 has no tag for stands in tags that others pass over.
    """
    values = {**sample.stated, **_tagged(sample.columns)}
    if "sensor_longitude_deg" in values:
        values["sensor_longitude_deg"] = (values["sensor_longitude_deg"] + 180) % 360 - 180
    ranges = {item.name: (item.lowest, item.highest) for item in ITEMS.values()}
    usable = {
        name: value
        for name, value in values.items()
        if name in ranges and isfinite(value) and ranges[name][0] <= value <= ranges[name][1]
    }
    return encode(sample.time_ns, usable)


def _tagged(columns: Mapping[str, float]) -> dict[str, float]:
    """Telemetry columns by the names of ST 0601's items."""
    values = {name: columns[column] for name, column in _TAGS.items() if column in columns}
    if all(name in columns for name in ("camera_yaw_deg", "camera_pitch_deg")):
        values |= {
            "platform_heading_deg": columns["camera_yaw_deg"] % 360,
            "platform_pitch_deg": 0.0,
            "platform_roll_deg": 0.0,
            "sensor_relative_azimuth_deg": 0.0,
            "sensor_relative_elevation_deg": columns["camera_pitch_deg"],
            "sensor_relative_roll_deg": columns.get("camera_roll_deg", 0.0) % 360,
        }
    elif "body_yaw_deg" in columns:
        values["platform_heading_deg"] = columns["body_yaw_deg"] % 360
        values["platform_pitch_full_deg"] = columns.get("body_pitch_deg", 0.0)
        values["platform_roll_full_deg"] = columns.get("body_roll_deg", 0.0)
    return values


_TAGS = {
    "sensor_latitude_deg": "latitude_deg",
    "sensor_longitude_deg": "longitude_deg",
    "sensor_true_altitude_m": "orthometric_height_m",
    "sensor_ellipsoid_height_extended_m": "ellipsoidal_height_m",
    **{name: name for name in OWN_TAGS},
}
"""Which column a tag states, by the tag's name."""


def _pes(stream_id: int, data: bytes, pts_us: int, dts_us: int | None) -> bytes:
    """A packetised elementary stream's packet (ISO 13818-1, 2.4.3.6); a length of 0 stands for video's "unbounded"."""
    stamps = (
        _stamp(0x2, pts_us)
        if dts_us in (None, pts_us)
        else _stamp(0x3, pts_us) + _stamp(0x1, dts_us or 0)
    )
    flags = 0x80 if len(stamps) == 5 else 0xC0
    length = 3 + len(stamps) + len(data)
    length = length if length < 65_536 else 0
    return (
        struct.pack(">3sBHBBB", b"\x00\x00\x01", stream_id, length, 0x84, flags, len(stamps))
        + stamps
        + data
    )


def _ticks(time_us: int) -> int:
    return (time_us * 9 // 100 + _FIRST_90KHZ) & (1 << 33) - 1


def _stamp(mark: int, time_us: int) -> bytes:
    ticks = _ticks(time_us)
    return struct.pack(
        ">BHH", mark << 4 | ticks >> 29 & 0xE | 1, ticks >> 14 & 0xFFFE | 1, ticks << 1 & 0xFFFE | 1
    )


def _whole_end(tail: bytes, *, is_all: bool) -> int | None:
    """Where the last message ends that is whole, as are all before it; None where there is none.

    `tail` begins at a packet; `is_all`: with the file, so that its first message must be whole, too.
    """
    end = 0 if is_all else None
    found = False
    for at in range(0, len(tail) - _PACKET + 1, _PACKET):
        if not _is_mark(tail, at):
            continue
        length, crc = struct.unpack_from(">II", tail, at + 24)
        if end is not None:
            if at - length != end or zlib.crc32(tail[at - length : at]) != crc:
                break  # a hole that a power cut left, or bytes of something else
            found = True
        end = at + _PACKET
    return end if found or (not is_all and end is not None) else None


def _is_mark(data: bytes, at: int) -> bool:
    if not (data.startswith(b"\x47\x1f\xe0", at) and data.startswith(_MARK_NAME, at + 4)):
        return False
    body = data[at + 4 : at + 4 + _MARK_HEAD.size]
    return (
        zlib.crc32(body).to_bytes(4, "big")
        == data[at + 4 + _MARK_HEAD.size : at + 8 + _MARK_HEAD.size]
    )
