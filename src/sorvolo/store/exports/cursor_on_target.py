"""Tracks, drones and places as Cursor on Target events, version 2.0."""

from collections.abc import Mapping
from dataclasses import dataclass
from math import isfinite, nan
from types import MappingProxyType
from xml.etree.ElementTree import Element, SubElement, tostring

import numpy as np

from sorvolo.store.exports.places import place_deg, printable, wrapped_deg
from sorvolo.store.exports.plain import utc_text
from sorvolo.survey.flight import Site
from sorvolo.survey.objects import Track

COT_TYPES: Mapping[str, str] = MappingProxyType(
    {
        "person": "a-u-G",
        "car": "a-u-G-E-V-C",
        "truck": "a-u-G-E-V-C",
        "bus": "a-u-G-E-V-C",
        "small object": "b-m-p-s-m",
    }
)
"""The event type of each class: unknown on the ground, unknown civilian vehicle, a spot on the map."""

DRONE_TYPE = "a-f-A-M-H-Q"
"""The event type of one's own drone: friendly, in the air, military by the standard's branch, rotary wing, unmanned."""

_OTHER_TYPE = "a-u-G"
UNKNOWN_M = "9999999.0"  # what the schema wants where a height or an error is not known


def cot_type(label: str) -> str:
    """The event type of a class; something unknown on the ground for one that is not named."""
    return COT_TYPES.get(label, _OTHER_TYPE)


def cot_event(
    track: Track,
    site: Site,
    *,
    uid: str,
    now_ns: int,
    stale_s: float,
) -> bytes:
    """One track as one event: an XML element without a declaration, as streams of events want it.

    `uid` is the same for the same object in every event. `now_ns` is the UTC time of sending, and `stale_s` later the
    event is stale. `ce` is one sigma of the place along its worst direction, as the schema has it; `hae` is the
    ground's height above the ellipsoid where the site knows it. Speed and course are sent of what moves. The site must
    be geo-referenced.
    """
    label = printable(track.label)
    event, detail = begin_event(
        uid,
        cot_type(track.label),
        *place_deg(track.position_m, site),
        now_ns=now_ns,
        stale_s=stale_s,
        height=f"{site.origin.height_m:.1f}"
        if site.height_reference == "ellipsoidal"
        else UNKNOWN_M,
        error_m=float(np.sqrt(np.linalg.eigvalsh(track.covariance_m2)[-1])),
        callsign=f"{label} {track.id}",
    )
    east, north = track.velocity_m_s
    if track.moving:
        course_deg = float(np.degrees(np.arctan2(east, north))) % 360
        SubElement(
            detail,
            "track",
            {"course": f"{course_deg:.0f}", "speed": f"{float(np.hypot(east, north)):.1f}"},
        )
    seen = utc_text(track.last_seen_ns)[:19] + "Z"
    SubElement(
        detail, "remarks"
    ).text = (
        f"{label}, score {track.score:.2f}, {track.views} views, last seen {seen}, found by Sorvolo"
    )
    return event_bytes(event)


@dataclass(frozen=True)
class DroneView:
    """Where a drone is and what its camera looks at; NaN where unknown.

    `height_m` is above the ellipsoid; course and azimuth clockwise from north; elevation from the horizon (-90 straight
    down); the fields of view across and down the picture; `range_m` to the ground in the picture's middle.
    """

    latitude_deg: float
    longitude_deg: float
    height_m: float = nan
    course_deg: float = nan
    speed_m_s: float = nan
    azimuth_deg: float = nan
    elevation_deg: float = nan
    across_deg: float = nan
    down_deg: float = nan
    range_m: float = nan
    error_m: float = nan


def cot_drone(view: DroneView, *, uid: str, callsign: str, now_ns: int, stale_s: float) -> bytes:
    """A drone as one event, with its camera's field of view in `<sensor>` where azimuth and angle are known: ATAK and
    WinTAK draw it on the ground."""
    event, detail = begin_event(
        uid,
        DRONE_TYPE,
        view.longitude_deg,
        view.latitude_deg,
        now_ns=now_ns,
        stale_s=stale_s,
        height=_known(view.height_m, ".1f"),
        error_m=view.error_m,
        callsign=printable(callsign),
    )
    if isfinite(view.course_deg):
        speed = f"{view.speed_m_s:.1f}" if isfinite(view.speed_m_s) else "0.0"
        SubElement(detail, "track", {"course": f"{view.course_deg % 360:.0f}", "speed": speed})
    if isfinite(view.azimuth_deg) and isfinite(view.across_deg):
        down_deg = view.down_deg if isfinite(view.down_deg) else view.across_deg
        SubElement(
            detail,
            "sensor",
            {
                "version": "0.6",
                "type": "r-e",
                "model": "Sorvolo",
                "azimuth": f"{view.azimuth_deg % 360:.1f}",
                "elevation": f"{view.elevation_deg if isfinite(view.elevation_deg) else -90.0:.1f}",
                "roll": "0.0",
                "fov": f"{view.across_deg:.1f}",
                "vfov": f"{down_deg:.1f}",
                "range": f"{view.range_m if isfinite(view.range_m) else 100.0:.0f}",
                "north": "0",
                "fovRed": "1.0",
                "fovGreen": "1.0",
                "fovBlue": "0.0",
                "fovAlpha": "0.3",
            },
        )
    return event_bytes(event)


def cot_spot(
    longitude_deg: float,
    latitude_deg: float,
    *,
    uid: str,
    kind: str,
    callsign: str,
    words: str,
    error_m: float,
    now_ns: int,
    stale_s: float,
) -> bytes:
    """Something at a place as one event of the type `kind`; `words` are its remarks."""
    event, detail = begin_event(
        uid,
        kind,
        longitude_deg,
        latitude_deg,
        now_ns=now_ns,
        stale_s=stale_s,
        error_m=error_m,
        callsign=printable(callsign),
    )
    SubElement(detail, "remarks").text = printable(words)
    return event_bytes(event)


def begin_event(
    uid: str,
    kind: str,
    longitude_deg: float,
    latitude_deg: float,
    *,
    now_ns: int,
    stale_s: float,
    height: str = UNKNOWN_M,
    error_m: float = nan,
    callsign: str = "",
) -> tuple[Element, Element]:
    """An event at a place, and its `<detail>`; `height` is in metres above the ellipsoid, with a decimal."""
    now = _milliseconds(now_ns)
    event = Element(
        "event",
        {
            "version": "2.0",
            "uid": uid,
            "type": kind,
            "how": "m-g",
            "time": now,
            "start": now,
            "stale": _milliseconds(now_ns + round(stale_s * 1e9)),
        },
    )
    SubElement(
        event,
        "point",
        {
            "lat": f"{latitude_deg:.7f}",
            "lon": f"{wrapped_deg(longitude_deg):.7f}",
            "hae": height,
            "ce": _known(error_m, ".1f"),
            "le": UNKNOWN_M,
        },
    )
    detail = SubElement(event, "detail")
    if callsign:
        SubElement(detail, "contact", {"callsign": callsign})
    return event, detail


def event_bytes(event: Element) -> bytes:
    """The event as streams of events want it: without a declaration."""
    return bytes(tostring(event, encoding="utf-8"))


def _known(value: float, form: str) -> str:
    return format(value, form) if isfinite(value) else UNKNOWN_M


def cot_removal(uid: str, *, type_: str, now_ns: int) -> bytes:
    """The event that takes another one, of this `uid` and type, off everyone's map: it turned out to be none."""
    event, detail = begin_event(f"{uid}.removed", "t-x-d-d", 0.0, 0.0, now_ns=now_ns, stale_s=60.0)
    point = event[0]
    point.set("lat", "0")
    point.set("lon", "0")
    SubElement(detail, "link", {"uid": uid, "relation": "p-p", "type": type_})
    SubElement(detail, "__forcedelete")
    return event_bytes(event)


def _milliseconds(time_ns: int) -> str:
    return utc_text(time_ns)[:23] + "Z"
