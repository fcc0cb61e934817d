"""Tracks as Cursor on Target events, version 2.0."""

from collections.abc import Mapping
from types import MappingProxyType
from xml.etree.ElementTree import Element, SubElement, tostring

import numpy as np

from sorvolo.store.exports.places import longitude_latitude
from sorvolo.store.exports.plain import utc_text
from sorvolo.survey.flight import Site
from sorvolo.survey.objects import Track

COT_TYPES: Mapping[str, str] = MappingProxyType({
    "person": "a-u-G", "car": "a-u-G-E-V-C", "small object": "b-m-p-s-m",
})
"""The event type of each class: unknown on the ground, unknown civilian vehicle, a spot on the map."""

_OTHER_TYPE = "a-u-G"
_UNKNOWN_M = "9999999.0"  # what the schema wants where a height or an error is not known


def cot_type(label: str, types: Mapping[str, str] = COT_TYPES) -> str:
    """The event type of a class; something unknown on the ground for one that is not named."""
    return types.get(label, _OTHER_TYPE)


def cot_event(
    track: Track, site: Site, *, uid: str, now_ns: int, stale_s: float, types: Mapping[str, str] = COT_TYPES
) -> bytes:
    """One track as one event: an XML element without a declaration, as streams of events want it.

    `uid` is the same for the same object in every event. `now_ns` is the UTC time of sending, and `stale_s` later the
    event is stale. `ce` is one sigma of the place along its worst direction, as the schema has it; `hae` is the
    ground's height above the ellipsoid where the site knows it. Speed and course are sent of what moves. The site must
    be geo-referenced.
    """
    longitude, latitude = (float(each[0]) for each in longitude_latitude(track.position_m[None], site))
    now = _milliseconds(now_ns)
    event = Element("event", {
        "version": "2.0", "uid": uid, "type": cot_type(track.label, types), "how": "m-g",
        "time": now, "start": now, "stale": _milliseconds(now_ns + round(stale_s * 1e9)),
    })
    error_m = float(np.sqrt(np.linalg.eigvalsh(track.covariance_m2)[-1]))
    SubElement(event, "point", {
        "lat": f"{latitude:.7f}", "lon": f"{(longitude + 180) % 360 - 180:.7f}",
        "hae": f"{site.origin.height_m:.1f}" if site.height_reference == "ellipsoidal" else _UNKNOWN_M,
        "ce": f"{error_m:.1f}", "le": _UNKNOWN_M,
    })
    detail = SubElement(event, "detail")
    label = "".join(letter for letter in track.label if letter.isprintable())  # another's model may name anything
    SubElement(detail, "contact", {"callsign": f"{label} {track.id}"})
    east, north = track.velocity_m_s
    if track.moving:
        course_deg = float(np.degrees(np.arctan2(east, north))) % 360
        SubElement(detail, "track", {"course": f"{course_deg:.0f}", "speed": f"{float(np.hypot(east, north)):.1f}"})
    seen = utc_text(track.last_seen_ns)[:19] + "Z"
    SubElement(detail, "remarks").text = (
        f"{label}, score {track.score:.2f}, {track.views} views, last seen {seen}, found by Sorvolo"
    )
    return bytes(tostring(event, encoding="utf-8"))


def cot_removal(uid: str, *, type_: str, now_ns: int) -> bytes:
    """The event that takes another one, of this `uid` and type, off everyone's map: it turned out to be none."""
    now = _milliseconds(now_ns)
    event = Element("event", {
        "version": "2.0", "uid": f"{uid}.removed", "type": "t-x-d-d", "how": "m-g", "time": now, "start": now,
        "stale": _milliseconds(now_ns + 60_000_000_000),
    })
    SubElement(event, "point", {"lat": "0", "lon": "0", "hae": _UNKNOWN_M, "ce": _UNKNOWN_M, "le": _UNKNOWN_M})
    detail = SubElement(event, "detail")
    SubElement(detail, "link", {"uid": uid, "relation": "p-p", "type": type_})
    SubElement(detail, "__forcedelete")
    return bytes(tostring(event, encoding="utf-8"))


def _milliseconds(time_ns: int) -> str:
    return utc_text(time_ns)[:23] + "Z"
