"""The messages of a drone's stream: how they stand on the wire and in a spool."""

import json
import re
import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from math import isfinite
from typing import Any

from sorvolo.capture.live.klv import ITEMS
from sorvolo.capture.small_files import as_number
from sorvolo.errors import InputError
from sorvolo.survey.flight import TELEMETRY_COLUMNS

PROTOCOL = 1
"""The version of the messages; both sides state theirs."""

REFUSED_CODE, BUSY_CODE = 4400, 4503
"""WebSocket close codes: trying again is no use; try again later."""

CODECS = ("h264", "hevc")
"""The pictures that a stream may carry: what a transport stream holds and a browser plays."""

_STREAM = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")
_HEAD = struct.Struct(">cBQqq")
_MOST_TELEMETRY_BYTES = 16_384  # a sample has hundreds; by choice
# a greeting holds a camera and a decoder's head, some kilobytes; by choice
_MOST_HELLO_BYTES = 65_536
_STATED = frozenset(item.name for item in ITEMS.values())


def is_stream(name: str) -> bool:
    """Whether it may be a stream's name: safe as a folder's."""
    return _STREAM.fullmatch(name) is not None and ".." not in name


def check_stream(stream: str) -> None:
    """Raises InputError for a stream's id that is not safe as a folder's name."""
    if not is_stream(stream):
        raise InputError(
            f"{stream[:80]!r} is no stream's name; 1 to 64 letters, digits, dots, dashes and underscores were needed"
        )


class Kind(StrEnum):
    """What a message carries."""

    HELLO = "H"
    VIDEO = "V"
    TELEMETRY = "T"
    END = "E"


@dataclass(frozen=True)
class Message:
    """One message. `seq` increases by one for each message of a flight from 1 on; 0 for hello and end.

    `pts_us` is when a picture is shown, `dts_us` when it is decoded (it differs where pictures refer to later ones),
    both on the flight's own clock, which begins at 0 and never jumps back. Video is one access unit of H.264 or H.265
    with start codes (Annex B); a key frame begins with its parameter sets.
    """

    kind: Kind
    seq: int
    pts_us: int
    payload: bytes
    is_key: bool = False
    dts_us: int | None = None  # None: the same as `pts_us`

    def to_bytes(self) -> bytes:
        """The message as one binary WebSocket message: 26 bytes of head, then the payload."""
        dts_us = self.pts_us if self.dts_us is None else self.dts_us
        return (
            _HEAD.pack(self.kind.encode(), int(self.is_key), self.seq, self.pts_us, dts_us)
            + self.payload
        )


def message_from_bytes(data: bytes) -> Message:
    """The inverse of `Message.to_bytes`. Raises InputError for anything else."""
    if len(data) < _HEAD.size:
        raise InputError(f"a message of {len(data)} bytes; {_HEAD.size} at least were needed")
    letter, flags, seq, pts_us, dts_us = _HEAD.unpack_from(data)
    try:
        kind = Kind(letter.decode("latin-1"))
    except ValueError:
        raise InputError(
            f"a message of the unknown kind {letter!r}; known are H, V, T and E"
        ) from None
    return Message(kind, seq, pts_us, data[_HEAD.size :], bool(flags & 1), dts_us)


@dataclass(frozen=True)
class Hello:
    """What a drone states about its flight when it connects, and again each time it comes back.

    `flight` is the same for one flight, however often the link is lost; letters and digits. `fps` is 0 where unknown.
    """

    flight: str
    codec: str
    width: int
    height: int
    fps: float = 0.0
    name: str = ""
    sent_by: str = ""
    protocol: int = PROTOCOL

    def __post_init__(self) -> None:
        if self.protocol != PROTOCOL:
            raise InputError(
                f"the drone speaks version {self.protocol} of the stream's protocol and the station {PROTOCOL}; "
                "install the same version of sorvolo on both"
            )
        if not (8 <= len(self.flight) <= 64 and self.flight.isascii() and self.flight.isalnum()):
            raise InputError("a flight's id has 8 to 64 letters and digits")
        if self.codec not in CODECS:
            raise InputError(
                f"the pictures are {self.codec[:32]!r}; a stream carries {' or '.join(CODECS)}, so set the camera to "
                "one of them, or convert the recording: ffmpeg -i INPUT -c:v libx264 OUTPUT.mp4"
            )
        if not (
            16 <= self.width <= 16_384 and 16 <= self.height <= 16_384 and 0 <= self.fps <= 1000
        ):
            raise InputError(
                f"pictures of {self.width} x {self.height} at {self.fps:g} a second are none"
            )

    def to_json(self) -> str:
        """The payload of a hello message."""
        return json.dumps(vars(self))


def hello_from_json(text: str | bytes) -> Hello:
    """The inverse of `Hello.to_json`; unknown keys are ignored. Raises InputError for anything else."""
    found = _json_object(text, _MOST_HELLO_BYTES, "a hello")
    try:
        return Hello(
            str(found["flight"]),
            str(found["codec"]),
            int(as_number(found["width"])),
            int(as_number(found["height"])),
            as_number(found.get("fps") or 0.0),
            str(found.get("name", ""))[:200],
            str(found.get("sent_by", ""))[:200],
            int(found.get("protocol", 0)),
        )
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise InputError(
            f"a hello without a usable {error}; flight, codec, width and height were needed"
        ) from error


@dataclass(frozen=True)
class MessageSample:
    """One moment of telemetry. `columns` are named as survey.flight.TELEMETRY_COLUMNS, `stated` as ST 0601 has them.

    `stated` holds what telemetry columns have no name for: the lens's field of view, the ground's height.
    """

    time_ns: int
    columns: Mapping[str, float] = field(default_factory=dict)
    stated: Mapping[str, float] = field(default_factory=dict)

    def to_json(self) -> str:
        """The payload of a telemetry message; numbers that are not known are left out."""
        return json.dumps(
            {
                "time_ns": self.time_ns,
                "columns": {name: value for name, value in self.columns.items() if isfinite(value)},
                "stated": {name: value for name, value in self.stated.items() if isfinite(value)},
            },
            separators=(",", ":"),
        )


def sample_from_json(text: str | bytes) -> MessageSample:
    """The inverse of `MessageSample.to_json`; unknown names are ignored. Raises InputError for anything else."""
    found = _json_object(text, _MOST_TELEMETRY_BYTES, "telemetry")
    try:
        as_number(found["time_ns"])  # raises; a float is too coarse for it
        time_ns = int(found["time_ns"])
        columns = _numbers(found.get("columns") or {}, TELEMETRY_COLUMNS)
        stated = _numbers(found.get("stated") or {}, _STATED)
    except (KeyError, TypeError, ValueError, OverflowError, AttributeError) as error:
        raise InputError(
            f"telemetry without a usable {error}; time_ns and columns were needed"
        ) from error
    if not 0 <= time_ns < 2**63:
        raise InputError(f"telemetry of the time {time_ns} ns; 0 to 2^63 was needed")
    return MessageSample(time_ns, columns, stated)


def _numbers(found: Mapping[str, Any], names: Any) -> dict[str, float]:
    numbers = {name: as_number(value) for name, value in found.items() if name in names}
    return {name: value for name, value in numbers.items() if isfinite(value)}


def _json_object(text: str | bytes, most_bytes: int, what: str) -> Mapping[str, Any]:
    if len(text) > most_bytes:
        raise InputError(f"{what} of {len(text):,} bytes; {most_bytes:,} at most are taken")
    try:
        found = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{what} that is no JSON ({error})") from error
    if not isinstance(found, dict):
        raise InputError(f"{what} that is no JSON object")
    return found


_START = b"\x00\x00\x01"
_AUD = {"h264": b"\x00\x00\x00\x01\x09\xf0", "hevc": b"\x00\x00\x00\x01\x46\x01\x50"}
_SETS = {"h264": frozenset({7, 8}), "hevc": frozenset({32, 33, 34})}  # parameter sets
_SPS = {"h264": 7, "hevc": 33}
_DELIMITER = {"h264": 9, "hevc": 35}
_PICTURES = {"h264": frozenset(range(1, 6)), "hevc": frozenset(range(32))}


def nal_units(data: bytes) -> Iterator[bytes]:
    """The NAL units between the start codes, without them."""
    at = data.find(_START)
    while at >= 0:
        begin = at + 3
        at = data.find(_START, begin)
        unit = data[begin:] if at < 0 else data[begin:at]
        if unit := unit.rstrip(b"\x00"):
            yield unit


def nal_type(codec: str, unit: bytes) -> int:
    """The NAL unit's type: H.264's table 7-1, H.265's table 7-1."""
    return unit[0] & 0x1F if codec == "h264" else unit[0] >> 1 & 0x3F


def nal_types(codec: str, data: bytes) -> frozenset[int]:
    """The types of all NAL units."""
    return frozenset(nal_type(codec, unit) for unit in nal_units(data))


def is_delimiter(codec: str, unit: bytes) -> bool:
    """Whether a NAL unit only states that an access unit begins."""
    return nal_type(codec, unit) == _DELIMITER[codec]


def has_picture(codec: str, data: bytes) -> bool:
    """Whether there is any part of a picture in it: what is no video of this codec mostly has none."""
    return bool(nal_types(codec, data) & _PICTURES[codec])


def begins_decoding(codec: str, data: bytes) -> bool:
    """Whether a decoder can begin with this unit, if it is a key frame: it has all parameter sets and a picture."""
    types = nal_types(codec, data)
    return types >= _SETS[codec] and bool(types & _PICTURES[codec])


def parameter_sets(codec: str, data: bytes) -> bytes:
    """The parameter sets in it, each behind a start code; empty where there are none."""
    return b"".join(
        b"\x00\x00\x00\x01" + unit
        for unit in nal_units(data)
        if nal_type(codec, unit) in _SETS[codec]
    )


def with_parameter_sets(codec: str, data: bytes, sets: bytes) -> bytes:
    """A key frame that begins with its parameter sets: its own where it has them all, else these before it."""
    return data if not sets or nal_types(codec, data) >= _SETS[codec] else sets + data


def with_delimiter(codec: str, data: bytes) -> bytes:
    """The unit behind an access unit delimiter, as transport streams have it (ISO 13818-1, 2.14)."""
    first = next(nal_units(data[:64]), b"\x00")
    return data if is_delimiter(codec, first) else _AUD[codec] + data


def codec_string(codec: str, data: bytes) -> str | None:
    """The codec as browsers name it (RFC 6381), such as avc1.640028, from a key frame; None without parameter sets."""
    sps = next((unit for unit in nal_units(data) if nal_type(codec, unit) == _SPS[codec]), b"")
    if codec == "h264":
        return f"avc1.{sps[1:4].hex()}" if len(sps) > 3 else None
    # ISO 14496-15, E.3: profile, compatibility flags in reverse bit order, tier and level,
    # constraint bytes
    sps = sps.replace(b"\x00\x00\x03", b"\x00\x00")
    if len(sps) < 15:
        return None
    profile, compatible = sps[3], int.from_bytes(sps[4:8], "big")
    reverse = int(f"{compatible:032b}"[::-1], 2)
    tier = "H" if profile & 0x20 else "L"
    constraints = sps[8:14].rstrip(b"\x00")
    space = ("", "A", "B", "C")[profile >> 6]
    known = [f"hvc1.{space}{profile & 0x1F}", f"{reverse:x}", f"{tier}{sps[14]}"]
    return ".".join([*known, *(f"{each:x}" for each in constraints)])
