"""GPX tracks: points with a time; heights are above mean sea level by the format's definition."""

import re
from collections import Counter
from collections.abc import Iterator
from typing import Any
from xml.etree.ElementTree import ParseError

from defusedxml.common import DefusedXmlException
from defusedxml.ElementTree import fromstring

from sorvolo.capture.telemetry.cleaning import (
    NO_TIME_NS,
    clean,
    decimals_of,
    notice,
    sigma_from_hdop_m,
    time_ns_from_text,
)
from sorvolo.errors import InputError
from sorvolo.survey.flight import Telemetry

_ROOT = re.compile(rb"<(?:[A-Za-z_][\w.-]*:)?gpx[\s>]")
_ROOT_WIDE = re.compile("<(?:[A-Za-z_][\\w.-]*:)?gpx[\\s>]")
_END_OF_POINT = re.compile(rb"</((?:[A-Za-z_][\w.-]*:)?)(trkpt|rtept)\s*>")
_TAG_OF_COLUMN = {
    "latitude_deg": "lat",
    "longitude_deg": "lon",
    "orthometric_height_m": "ele",
    "speed_m_s": "speed",
    "course_deg": "course",
}
_CLOSING = {b"trkpt": (b"trkseg", b"trk", b"gpx"), b"rtept": (b"rte", b"gpx")}


def recognises(head: bytes) -> bool:
    """Whether the file's first bytes open a GPX document."""
    if head[:2] in (b"\xff\xfe", b"\xfe\xff"):
        return _ROOT_WIDE.search(head.decode("utf-16", errors="replace")) is not None
    return _ROOT.search(head) is not None


def read(data: bytes, name: str) -> Telemetry:
    """The timed points of a file's tracks, or of its routes where it has no track, in the file's order.

    `ele` is stored as orthometric height, hdop as horizontal sigma like NMEA's, speed and course where GPX
    1.0 or an extension gives them. A document type definition is refused: it can blow a small file up to
    gigabytes. `name` is for messages. Raises InputError for XML that cannot be read or when no point has a
    time.
    """
    counts: Counter[str] = Counter()
    root = _root(data, name, counts)
    points = list(_elements(root, "trkpt")) or list(_elements(root, "rtept"))
    if not points:
        raise InputError(
            f"{name}: a GPX file without track points; export the flight as a track with times"
        )
    texts = [_values(point) for point in points]
    stamps_ns = [_time_ns(each) for each in texts]
    timed = [each for each, stamp_ns in zip(texts, stamps_ns) if stamp_ns != NO_TIME_NS]
    if not timed:
        raise InputError(
            f"{name}: none of its {len(points)} GPX points has a <time>; export the track with its times, "
            "without them no picture can be given a place"
        )
    decimals = max(decimals_of(each.get(axis, "")) for each in timed for axis in ("lat", "lon"))
    columns = {
        column: [_number(each, tag) for each in texts] for column, tag in _TAG_OF_COLUMN.items()
    }
    return clean(
        "gpx",
        name,
        stamps_ns,
        columns
        | {"horizontal_sigma_m": [sigma_from_hdop_m(_number(each, "hdop")) for each in texts]},
        notices=[
            *notice(
                "truncated",
                counts["truncated"],
                "the file is cut off; read up to its last whole point",
            ),
            *notice(
                "unreadable_line", len(points) - len(timed), "{} points dropped: no readable <time>"
            ),
        ],
        position_decimals=decimals or None,
    )


def _time_ns(texts: dict[str, str]) -> int:
    stamp = time_ns_from_text(texts.get("time", ""))
    return stamp[0] if stamp else NO_TIME_NS


def _root(data: bytes, name: str, counts: Counter[str]) -> Any:
    """The document's root; a file that ends early is closed after its last whole point."""
    try:
        try:
            return fromstring(data, forbid_dtd=True)
        except ParseError:
            ends = list(_END_OF_POINT.finditer(data))
            if not ends:
                raise
            counts["truncated"] = 1
            prefix, kind = ends[-1].groups()
            closing = b"".join(b"</" + prefix + tag + b">" for tag in _CLOSING[kind])
            return fromstring(data[: ends[-1].end()] + closing, forbid_dtd=True)
    except DefusedXmlException as error:
        raise InputError(
            f"{name}: a GPX file with a document type definition or entities, which is refused; "
            "remove <!DOCTYPE ...>"
        ) from error
    except (ParseError, ValueError, LookupError) as error:  # the latter two: an unknown encoding
        raise InputError(f"{name}: not readable as GPX: {error}; export it again") from error


def _elements(root: Any, wanted: str) -> Iterator[Any]:
    return (element for element in root.iter() if _local(element.tag) == wanted)


def _values(point: Any) -> dict[str, str]:
    """The texts within a point by tag, whatever its namespace, extensions included; the outermost wins."""
    texts = {"lat": point.get("lat", ""), "lon": point.get("lon", "")}
    for element in point.iter():
        texts.setdefault(_local(element.tag), (element.text or "").strip())
    return texts


def _local(tag: Any) -> str:
    return str(tag).rpartition("}")[2]


def _number(texts: dict[str, str], tag: str) -> float:
    try:
        return float(texts.get(tag, "nan"))
    except ValueError:
        return float("nan")
