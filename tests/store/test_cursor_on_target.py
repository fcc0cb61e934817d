"""Cursor on Target: what an event holds."""

from dataclasses import replace
from datetime import datetime
from typing import Any
from xml.etree.ElementTree import fromstring

import numpy as np
import pytest

from sorvolo.geometry.geodesy import Geodetic
from sorvolo.store.exports.cursor_on_target import cot_event, cot_removal
from sorvolo.survey.flight import Site
from sorvolo.survey.objects import Sighting, Track

_NOW_NS = 1_780_000_000_123_456_789
_SITE = Site(
    "field", Geodetic(41.9, 12.6, 131.6), "EPSG:32633", 0.02, height_reference="ellipsoidal"
)


def _track(**changes: Any) -> Track:
    sighting = Sighting(
        3,
        "3",
        _NOW_NS,
        "person",
        0.8,
        np.array([10, 20, 30, 60], np.float32),
        np.array([100.0, 200.0]),
        np.eye(2),
        np.array([1.0, 0.5]),
    )
    track = Track(
        7,
        "person",
        0.82,
        True,
        False,
        _NOW_NS - 10**9,
        _NOW_NS,
        5,
        1,
        np.array([100.0, 200.0]),
        np.diag([4.0, 1.0]),
        np.zeros(2),
        np.array([1.0, 0.5]),
        sighting,
        np.array([[100.0, 200.0]]),
        np.array([_NOW_NS]),
    )
    return replace(track, **changes)


def test_an_event_states_where_what_and_how_long() -> None:
    event = fromstring(cot_event(_track(), _SITE, uid="sorvolo.f.7", now_ns=_NOW_NS, stale_s=120))
    assert event.tag == "event" and event.get("version") == "2.0"
    assert (event.get("uid"), event.get("type"), event.get("how")) == (
        "sorvolo.f.7",
        "a-u-G",
        "m-g",
    )
    time_, start, stale = (
        datetime.fromisoformat(event.get(name, "")) for name in ("time", "start", "stale")
    )
    assert time_ == start and (stale - time_).total_seconds() == pytest.approx(120)
    assert event.get("time") == "2026-05-28T20:26:40.123Z"
    point = event.find("point")
    assert point is not None
    east_m, north_m, _ = _SITE.frame.site_from_wgs84(
        np.array([float(point.get("lat", ""))]),
        np.array([float(point.get("lon", ""))]),
        np.array([131.6]),
    )[0]
    assert (east_m, north_m) == pytest.approx((100.0, 200.0), abs=0.02)
    # one sigma along the worst direction, and the ground's own height
    assert (point.get("ce"), point.get("hae"), point.get("le")) == ("2.0", "131.6", "9999999.0")
    callsign, remarks = event.find("detail/contact"), event.find("detail/remarks")
    assert callsign is not None and callsign.get("callsign") == "person 7"
    assert remarks is not None and "score 0.82" in str(remarks.text)
    assert event.find("detail/track") is None


def test_what_moves_has_course_and_speed() -> None:
    moving = _track(moving=True, velocity_m_s=np.array([-3.0, 0.0]), label="car")
    event = fromstring(cot_event(moving, _SITE, uid="u", now_ns=_NOW_NS, stale_s=9))
    track = event.find("detail/track")
    assert track is not None and (track.get("course"), track.get("speed")) == ("270", "3.0")
    assert event.get("type") == "a-u-G-E-V-C"


def test_names_from_elsewhere_stay_xml() -> None:
    odd = _track(label='<"&\x00\x1bdog>')
    site = replace(_SITE, height_reference="above ground")
    event = fromstring(cot_event(odd, site, uid="u", now_ns=_NOW_NS, stale_s=9))
    contact, point = event.find("detail/contact"), event.find("point")
    assert contact is not None and contact.get("callsign") == '<"&dog> 7'
    assert point is not None and point.get("hae") == "9999999.0"


def test_a_removal_names_what_goes() -> None:
    event = fromstring(cot_removal("sorvolo.f.7", type_="a-u-G", now_ns=_NOW_NS))
    link = event.find("detail/link")
    assert event.get("type") == "t-x-d-d" and event.get("uid") != "sorvolo.f.7"
    assert link is not None and (link.get("uid"), link.get("type")) == ("sorvolo.f.7", "a-u-G")
    assert event.find("detail/__forcedelete") is not None


def test_longitude_beyond_the_antimeridian_comes_back() -> None:
    site = replace(_SITE, origin=Geodetic(-17.0, 179.9999, 0.0))
    point = fromstring(cot_event(_track(), site, uid="u", now_ns=_NOW_NS, stale_s=9)).find("point")
    assert point is not None and -180 <= float(point.get("lon", "")) < -179.99
