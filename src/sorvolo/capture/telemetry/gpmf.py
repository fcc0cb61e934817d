"""GPMF, the telemetry inside GoPro's videos: GPS of the cameras themselves, and the Karma drone's own state.

Source: GoPro's "GPMF introduction" (key, type, size and count of each item, nested; GPS5, GPS9, GPSU, GPSF, GPSP), and
the names and units that the Karma writes beside its items (UNIT, TYPE, SCAL).
"""

import struct
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from math import degrees, hypot, isfinite, nan
from pathlib import Path
from typing import Any, TypeAlias

import av
import numpy as np
from av.stream import Discard

from sorvolo.capture.telemetry.cleaning import (
    NO_TIME_NS,
    SMALLEST_HDOP_SIGMA_M,
    clean,
    notice,
    sigma_from_hdop_m,
)
from sorvolo.capture.video_stream import ONE_FILE
from sorvolo.errors import InputError
from sorvolo.geometry.units import SECOND_NS
from sorvolo.survey.flight import Telemetry

FORMAT = "gpmf"
"""The name that `Telemetry.format` carries."""

_CODES = {
    "b": "b",
    "B": "B",
    "s": "h",
    "S": "H",
    "l": "i",
    "L": "I",
    "j": "q",
    "J": "Q",
    "f": "f",
    "d": "d",
}
_HEAD_BYTES = 8  # of an item: key, type, size, repeats
_MOST_ITEMS = 100_000  # of one level; far more than GoPro writes; by choice
_EPOCH_2000_NS = 946_684_800 * SECOND_NS
_DAY_S = 86_400
_DATED_S = (1.2e9, 7e9)  # 2008 to 2191: GoPro's first camera with GPS is of 2016

Values: TypeAlias = list[tuple[float, ...]]


@dataclass(frozen=True)
class Payload:
    """One packet of a video's GPMF stream: what it covers of the video, and its bytes."""

    video_time_ns: int
    duration_ns: int
    data: bytes


@dataclass
class _Stream:
    """The items of one STRM: its data's values by key, and the sticky items that scale them."""

    values: dict[str, Values] = field(default_factory=dict)
    scales: tuple[float, ...] = ()
    texts: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class _Sample:
    video_time_ns: int
    utc_ns: int
    columns: Mapping[str, float]


def is_gpmf(data: bytes) -> bool:
    """Whether a packet's bytes begin with a device's container."""
    return data[:5] == b"DEVC\0"


def read_gpmf_file(path: Path) -> Telemetry | None:
    """The telemetry inside a GoPro video; None for a video without any, or whose camera had no fix.

    `video_time_ns` counts from the video's first frame. Only the telemetry's packets are read, nothing is decoded.
    """
    payloads: list[Payload] = []
    try:
        with av.open(f"file:{path}", options=ONE_FILE) as container:
            payloads.extend(_payloads_in(container))
    except (av.FFmpegError, IndexError, ValueError):
        pass  # a damaged place: what came before it is used, and the video's reader counts the damage
    if not payloads:
        return None
    try:
        found = read_payloads(payloads, path.name)
    except InputError:
        return None  # a camera writes GPMF without a receiver, too: its motion and exposure
    return found if found.has_fixes else None


def read_payloads(payloads: Sequence[Payload], name: str) -> Telemetry:
    """The telemetry of a video's payloads; `video_time_ns` counts as the payloads' does.

    A Karma's fused position goes before the camera's GPS. Samples are spread evenly over their payload, as GoPro asks.
    Heights: GPS5 and GPS9 are above the ellipsoid unless the stream states MSLV; the Karma's are above the sea and
    above take-off. `name` is for messages. Raises InputError when no sample is usable.
    """
    counts: Counter[str] = Counter()
    samples: list[_Sample] = []
    for payload in payloads:
        streams = list(_streams(payload.data, counts))
        samples += _samples_of(payload, streams)
    samples.sort(key=lambda sample: sample.video_time_ns)
    video_ns = np.array([sample.video_time_ns for sample in samples], dtype=np.int64)
    stamps_ns = np.array([sample.utc_ns for sample in samples], dtype=np.int64)
    dated = stamps_ns != NO_TIME_NS
    # the receiver's clock and the video's run together; a median is not led astray by a first wrong second
    zero_ns = int(np.median((stamps_ns - video_ns)[dated])) if dated.any() else 0
    names = sorted({key for sample in samples for key in sample.columns})
    return clean(
        FORMAT,
        name,
        video_ns + zero_ns,
        {key: [each.columns.get(key, nan) for each in samples] for key in names},
        video_ns,
        notices=[
            *notice(
                "unreadable_line",
                counts["damaged"],
                "{} telemetry packets read in part: damaged or cut",
            ),
            *notice(
                "no_date",
                0 if dated.any() else len(samples),
                "{} samples have no date; they are stamped by their place in the video",
            ),
        ],
    )


def _payloads_in(container: Any) -> Iterator[Payload]:
    """The payloads of a container's GPMF stream, if it has one."""
    streams = [
        each for each in container.streams if each.type == "data" and each.name == "bin_data"
    ]
    if not streams or not container.streams.video:
        return
    for each in container.streams:
        each.discard = Discard.default if each in streams else Discard.all
    video = container.streams.video[0]
    first_ns = round((video.start_time or 0) * (video.time_base or 0) * SECOND_NS)
    for packet in container.demux(streams):
        if payload := _payload_of(packet, first_ns):
            yield payload


def _payload_of(packet: Any, first_ns: int) -> Payload | None:
    data = bytes(packet) if packet.size else b""
    if not is_gpmf(data) or packet.pts is None or not packet.time_base:
        return None
    base_ns = packet.time_base * SECOND_NS
    return Payload(
        max(0, round(packet.pts * base_ns) - first_ns),
        round((packet.duration or 0) * base_ns),
        data,
    )


def _samples_of(payload: Payload, streams: Sequence[_Stream]) -> list[_Sample]:
    fused = next((stream for stream in streams if "GLPI" in stream.values), None)
    if fused is not None:
        return _karma_samples(payload, streams, fused)
    for stream in streams:
        for key, sampler in (("GPS9", _gps9_samples), ("GPS5", _gps5_samples)):
            if key in stream.values:
                return sampler(payload, stream)
    return []


def _gps5_samples(payload: Payload, stream: _Stream) -> list[_Sample]:
    """Latitude, longitude, height, speed over ground, speed in space; one time, fix and precision a payload."""
    fix = _single(stream, "GPSF", 3.0)
    dop = _single(stream, "GPSP", nan) / 100
    utc_ns = _utc_of_text(stream.texts.get("GPSU", ""))
    rows = stream.values["GPS5"]
    height = _height_column(stream)
    return [
        _Sample(
            when_ns,
            utc_ns + (when_ns - payload.video_time_ns) if utc_ns != NO_TIME_NS else NO_TIME_NS,
            _fix_columns(row[:2], fix, height, row[2], row[3], dop),
        )
        for when_ns, row in _spread(payload, rows)
        if len(row) >= 4
    ]


def _gps9_samples(payload: Payload, stream: _Stream) -> list[_Sample]:
    """As GPS5, and days since 2000, seconds of the day, precision and fix of each sample."""
    height = _height_column(stream)
    return [
        _Sample(
            when_ns,
            _utc_of_days(row[5], row[6]),
            _fix_columns(row[:2], row[8], height, row[2], row[3], row[7]),
        )
        for when_ns, row in _spread(payload, stream.values["GPS9"])
        if len(row) >= 9
    ]


def _fix_columns(
    place: tuple[float, ...], fix: float, height: str, height_m: float, speed_m_s: float, dop: float
) -> dict[str, float]:
    """The columns of a camera's fix: 0 is none, 2 one without a height."""
    if fix < 2:
        return {}
    columns = {
        "latitude_deg": place[0],
        "longitude_deg": place[1],
        "speed_m_s": speed_m_s,
        "horizontal_sigma_m": sigma_from_hdop_m(dop),
    }
    return columns | ({height: height_m} if fix >= 3 else {})


def _height_column(stream: _Stream) -> str:
    return (
        "orthometric_height_m"
        if stream.texts.get("GPSA", "").startswith("MSL")
        else "ellipsoidal_height_m"
    )


def _karma_samples(payload: Payload, streams: Sequence[_Stream], fused: _Stream) -> list[_Sample]:
    """GLPI: ms since start, latitude, longitude, height above the sea, above take-off, velocity N E D, heading.

    ATTD: ms since start, roll, pitch, yaw (rad). GPRI: us, latitude, longitude, height, eph, epv. SYST: us since start
    and UTC ms.
    """
    # UTC when the drone's counter was zero; None where it does not know
    clocks = (row for stream in streams for row in stream.values.get("SYST", []) if len(row) >= 2)
    utc_from_start_ns = next(
        (
            round((row[1] - row[0]) * 1e6) * 1000
            for row in clocks
            if _DATED_S[0] < row[1] < _DATED_S[1]
        ),
        None,
    )
    attitudes = [
        row for stream in streams for row in stream.values.get("ATTD", []) if len(row) >= 4
    ]
    errors = [
        row[4:6] for stream in streams for row in stream.values.get("GPRI", []) if len(row) >= 6
    ]
    # it states 0.25 m, which no receiver without corrections reaches
    sigma_m = [max(float(np.median(column)), SMALLEST_HDOP_SIGMA_M) for column in zip(*errors)] or [
        nan,
        nan,
    ]
    samples = []
    for when_ns, row in _spread(payload, fused.values["GLPI"]):
        if len(row) < 9:
            continue
        north_m_s, east_m_s = row[5], row[6]
        columns = {
            "latitude_deg": row[1],
            "longitude_deg": row[2],
            "orthometric_height_m": row[3],
            "height_above_takeoff_m": row[4],
            "speed_m_s": hypot(north_m_s, east_m_s),
            "course_deg": degrees(np.arctan2(east_m_s, north_m_s)) % 360,
            "body_yaw_deg": row[8],
            "horizontal_sigma_m": sigma_m[0],
            "vertical_sigma_m": sigma_m[1],
        }
        if attitude := _nearest(attitudes, row[0]):
            columns |= {
                "body_roll_deg": degrees(attitude[1]),
                "body_pitch_deg": degrees(attitude[2]),
                "body_yaw_deg": degrees(attitude[3]) % 360,
            }
        utc_ns = (
            NO_TIME_NS
            if utc_from_start_ns is None
            else utc_from_start_ns + round(row[0] * SECOND_NS)
        )
        samples.append(_Sample(when_ns, utc_ns, columns))
    return samples


def _nearest(rows: Sequence[tuple[float, ...]], time_s: float) -> tuple[float, ...] | None:
    """The row nearest in time, its first value, if it is within half a second."""
    if not rows:
        return None
    row = min(rows, key=lambda each: abs(each[0] - time_s))
    return row if abs(row[0] - time_s) < 0.5 else None


def _spread(payload: Payload, rows: Values) -> Iterator[tuple[int, tuple[float, ...]]]:
    """Each row with its time in the video; rows with values that are no numbers are left out."""
    for index, row in enumerate(rows):
        if all(map(isfinite, row)):
            yield payload.video_time_ns + index * payload.duration_ns // len(rows), row


def _single(stream: _Stream, key: str, otherwise: float) -> float:
    rows = stream.values.get(key)
    return rows[0][0] if rows and rows[0] else otherwise


def _utc_of_text(text: str) -> int:
    """GPSU, "yymmddhhmmss.sss"."""
    try:
        moment = datetime.strptime(text[:12], "%y%m%d%H%M%S").replace(tzinfo=UTC)
        fraction_s = float(f"0{text[12:16]}") if text[12:13] == "." else 0.0
    except ValueError:
        return NO_TIME_NS
    time_ns = int(moment.timestamp()) * SECOND_NS + round(fraction_s * SECOND_NS)
    return time_ns if _DATED_S[0] * SECOND_NS < time_ns else NO_TIME_NS


def _utc_of_days(days: float, seconds: float) -> int:
    if not (0 < days < 1e5 and 0 <= seconds <= _DAY_S):
        return NO_TIME_NS
    time_ns = _EPOCH_2000_NS + int(days) * _DAY_S * SECOND_NS + round(seconds * SECOND_NS)
    return time_ns if _DATED_S[0] * SECOND_NS < time_ns else NO_TIME_NS


# ---- items ------------------------------------------------------------------------------------------------------


def _streams(data: bytes, counts: Counter[str]) -> Iterator[_Stream]:
    """The streams of every device in a payload; what is damaged ends the reading and is counted."""
    try:
        for key, kind, _, _, value in _items(data):
            if key == "DEVC" and not kind:
                for inner, inner_kind, _, _, inner_value in _items(value):
                    if inner == "STRM" and not inner_kind:
                        yield _stream(inner_value)
    except _DamagedError:
        counts["damaged"] += 1


class _DamagedError(Exception):
    """Items that do not end within their container."""


def _items(data: bytes) -> Iterator[tuple[str, str, int, int, bytes]]:
    """Key, type ("" for a container), bytes of a sample, count and value of each item; each begins on four bytes."""
    at = 0
    for _ in range(_MOST_ITEMS):
        if at + _HEAD_BYTES > len(data):
            return
        key, kind, size, count = struct.unpack_from(">4scBH", data, at)
        if key == bytes(4):  # padding up to the end
            return
        end = at + _HEAD_BYTES + size * count
        if end > len(data):
            raise _DamagedError
        yield (
            key.decode("latin-1"),
            "" if kind == b"\0" else kind.decode("latin-1"),
            size,
            count,
            data[at + _HEAD_BYTES : end],
        )
        at = end + -end % 4


def _stream(data: bytes) -> _Stream:
    stream = _Stream()
    for key, kind, size, count, value in _items(data):
        if kind in ("c", "U"):
            stream.texts[key] = value.decode("latin-1").rstrip("\0 ")
        elif key == "SCAL":
            stream.scales = tuple(float(row[0]) for row in _rows(value, kind, size, count))
        elif kind == "?":
            stream.values[key] = _scaled(
                _rows(value, stream.texts.get("TYPE", ""), size, count), stream.scales
            )
        elif kind:
            # samples are scaled; single sticky values (GPSF, GPSP) are not
            is_single = size <= struct.calcsize(f">{_CODES.get(kind, 'b')}")
            stream.values[key] = _scaled(
                _rows(value, kind, size, count), () if is_single else stream.scales
            )
    return stream


def _rows(value: bytes, types: str, size: int, count: int) -> list[tuple[Any, ...]]:
    """The samples' numbers; none for types that are no numbers."""
    if not size or not types or any(each not in _CODES for each in types):
        return []
    codes = "".join(_CODES[each] for each in types)
    if len(codes) == 1:
        codes *= max(1, size // struct.calcsize(f">{codes}"))
    if struct.calcsize(f">{codes}") != size:
        return []
    return [struct.unpack_from(f">{codes}", value, index * size) for index in range(count)]


def _scaled(rows: list[tuple[Any, ...]], scales: tuple[float, ...]) -> Values:
    """The rows divided by one scale for all their values, or one for each; what has none stays as it is."""
    found: Values = []
    for row in rows:
        divisors = scales * len(row) if len(scales) == 1 else (*scales, *[1.0] * len(row))
        found.append(
            tuple(
                float(value) / divisor if divisor else nan for value, divisor in zip(row, divisors)
            )
        )
    return found
