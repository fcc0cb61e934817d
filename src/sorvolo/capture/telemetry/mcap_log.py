"""MCAP recordings of robots: the fixes of one topic, as ROS 2, protobuf or JSON (mcap and its support packages)."""

import io
import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np

from sorvolo.capture.telemetry.cleaning import clean, notice
from sorvolo.errors import InputError
from sorvolo.survey.flight import Telemetry

_MAGIC = b"\x89MCAP0\r\n"
# ROS 2's message, and Foxglove's, which is the same in protobuf and JSON: both count heights from WGS84's ellipsoid
_FIXES = frozenset(
    {
        "sensor_msgs/msg/NavSatFix",
        "sensor_msgs/NavSatFix",
        "foxglove.LocationFix",
        "foxglove_msgs/msg/LocationFix",
    }
)
# the year 2000: an earlier stamp counts from when a robot was switched on
_DATED_NS = 946_684_800 * 10**9

_LARGEST_CHUNK_BYTES = 50_000_000  # recorders write chunks of about 4 MB

_Row = tuple[int, dict[str, float]]


def recognises(head: bytes) -> bool:
    """Whether the file begins as an MCAP does."""
    return head.startswith(_MAGIC)


def read(data: bytes, name: str) -> Telemetry:
    """One sample a message, at its own stamp, else when it was recorded.

    Raises InputError without the extra `logs`, for a damaged recording and for one without fixes.
    """
    try:
        import mcap.reader  # noqa: F401  # whether it is there
    except ImportError as error:
        raise InputError(
            f"{name} is an MCAP recording, which needs an extra: pip install 'sorvolo[logs]'"
        ) from error
    by_topic: dict[str, list[_Row]] = {}
    unread = is_cut = 0
    try:
        for topic, row in _fixes(data):
            if row is None:
                unread += 1
            else:
                by_topic.setdefault(topic, []).append(row)
    except Exception:  # the library raises whatever damaged bytes lead to
        is_cut = 1
    if not by_topic:
        raise InputError(
            f"{name}: no fix in this MCAP recording{' (it is cut or damaged)' if is_cut else ''}; NavSatFix (ROS 2, "
            "JSON) or foxglove.LocationFix (protobuf, JSON) messages are read"
        )
    topic = max(by_topic, key=lambda each: len(by_topic[each]))
    rows = sorted(by_topic[topic], key=lambda row: row[0])
    others = ", ".join(sorted({*by_topic} - {topic}))
    columns = {key: [row[key] for _, row in rows] for key in rows[0][1]}
    notices = [
        *notice("unreadable_line", unread, "{} messages dropped: not readable"),
        *notice("truncated", is_cut, "the recording is cut or damaged: read as far as it goes"),
        *notice(
            "other_topics",
            len(by_topic) - 1,
            f"other topics with fixes, not used: {{}} ({others}); {topic} is used",
        ),
    ]
    return clean("mcap", name, [time_ns for time_ns, _ in rows], columns, notices=notices)


def _fixes(data: bytes) -> Iterator[tuple[str, _Row | None]]:
    """Each fix with its topic, in the file's order; None for a message that cannot be decoded."""
    decoders: dict[int, Callable[[bytes], Any] | None] = {}
    for schema, channel, message in _messages(data):
        if schema is None or schema.name not in _FIXES:
            continue
        if channel.id not in decoders:
            decoders[channel.id] = _decoder(channel.message_encoding, schema)
        decode = decoders[channel.id]
        try:
            yield channel.topic, decode and _row(decode(message.data), message.log_time)
        except Exception:  # whatever damaged bytes lead the decoders to
            yield channel.topic, None


def _messages(data: bytes) -> Iterator[tuple[Any, Any, Any]]:
    """Each message with its schema and channel, in the file's order; EOFError for a chunk that no recorder writes."""
    import lz4.frame
    import zstandard
    from mcap.records import Channel, Chunk, Message, Schema
    from mcap.stream_reader import StreamReader, breakup_chunk

    known: dict[Any, Any] = {}
    # without the index at the end, which a cut file lacks
    for record in StreamReader(io.BytesIO(data), emit_chunks=True).records:
        inside = [record]
        if isinstance(record, Chunk):
            if opened := {"zstd": zstandard.open, "lz4": lz4.frame.open}.get(record.compression):
                # some kilobytes may hold gigabytes, whatever size the chunk states
                unpacked = opened(io.BytesIO(record.data)).read(_LARGEST_CHUNK_BYTES)
                if len(unpacked) == _LARGEST_CHUNK_BYTES:
                    raise EOFError
                record = replace(record, compression="", data=unpacked)
            inside = breakup_chunk(record)
        for part in inside:
            if isinstance(part, Schema | Channel):
                known[type(part), part.id] = part
            elif isinstance(part, Message):
                channel = known[Channel, part.channel_id]
                yield known.get((Schema, channel.schema_id)), channel, part


def _decoder(encoding: str, schema: Any) -> Callable[[bytes], Any] | None:
    """What decodes a topic's messages; None where nothing here does."""
    if encoding == "json":
        return lambda data: json.loads(data, object_hook=lambda each: SimpleNamespace(**each))
    from mcap_protobuf.decoder import DecoderFactory as Protobuf
    from mcap_ros2.decoder import DecoderFactory as Ros2

    found = (factory().decoder_for(encoding, schema) for factory in (Ros2, Protobuf))
    return next(filter(None, found), None)


def _row(fix: Any, recorded_ns: int) -> _Row:
    """A message as a sample; a receiver without a fix states no place."""
    stamp = fix.header.stamp if hasattr(fix, "header") else getattr(fix, "timestamp", None)
    second = _first(stamp, "sec", "seconds")
    time_ns = int(second) * 10**9 + int(_first(stamp, "nanosec", "nsec", "nanos"))
    status = getattr(getattr(fix, "status", None), "status", 0)
    values: Mapping[str, float] = {
        "latitude_deg": fix.latitude,
        "longitude_deg": fix.longitude,
        "ellipsoidal_height_m": fix.altitude,
    }
    known = status >= 0
    row = {key: float(value) if known else float("nan") for key, value in values.items()}
    covariance = np.asarray(getattr(fix, "position_covariance", ()), np.float64)
    is_stated = getattr(fix, "position_covariance_type", 0) and len(covariance) == 9
    variance = covariance[[0, 4, 8]] if is_stated and covariance[0] > 0 else np.full(3, np.nan)
    row["horizontal_sigma_m"] = float(np.sqrt(variance[:2].mean()))
    row["vertical_sigma_m"] = float(np.sqrt(variance[2]))
    return time_ns if time_ns > _DATED_NS else recorded_ns, row


def _first(record: Any, *names: str) -> float:
    """The first of these fields that a record has; 0 where it has none."""
    return next((getattr(record, name) for name in names if hasattr(record, name)), 0)
