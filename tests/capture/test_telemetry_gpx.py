"""GPX: round trips with an independent writer, missing times, refused bombs, cut files."""

from datetime import UTC, datetime, timedelta

import gpxpy.gpx
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sorvolo.capture.telemetry import gpx
from sorvolo.errors import InputError

START = datetime(2016, 5, 4, 10, 0, 0, tzinfo=UTC)
START_NS = int(START.timestamp()) * 1_000_000_000


def track(places, step_s: float = 1.0, version: str = "1.1") -> str:
    document = gpxpy.gpx.GPX()
    document.tracks.append(gpxpy.gpx.GPXTrack())
    document.tracks[0].segments.append(gpxpy.gpx.GPXTrackSegment())
    for index, (latitude, longitude, height_m) in enumerate(places):
        document.tracks[0].segments[0].points.append(
            gpxpy.gpx.GPXTrackPoint(
                latitude,
                longitude,
                elevation=height_m,
                time=START + timedelta(seconds=step_s * index),
                horizontal_dilution=0.8,
                speed=3.5,
            )
        )
    return document.to_xml(version=version)


PLACES = [(round(41.9028 + 2e-6 * i, 6), 12.496412, 50.25 + i) for i in range(6)]


def codes(telemetry) -> dict[str, int]:
    return {notice.code: notice.count for notice in telemetry.notices}


@settings(max_examples=40, deadline=None)
@given(
    latitude=st.floats(-89, 89),
    longitude=st.floats(-179.99, 179.99),
    height_m=st.floats(-400, 8000),
    version=st.sampled_from(["1.0", "1.1"]),
)
def test_tracks_come_back(latitude, longitude, height_m, version):
    if abs(latitude) < 1e-3 and abs(longitude) < 1e-3:
        return
    places = [
        (round(latitude, 7) + 1e-6 * i, round(longitude, 7), round(height_m, 3)) for i in range(4)
    ]
    data = track(places, 0.2, version).encode()
    assert gpx.recognises(data)
    telemetry = gpx.read(data, "a.gpx")
    assert telemetry["latitude_deg"] == pytest.approx([place[0] for place in places], abs=1e-9)
    assert telemetry["longitude_deg"] == pytest.approx([place[1] for place in places], abs=1e-9)
    assert telemetry["orthometric_height_m"] == pytest.approx([places[0][2]] * 4, abs=1e-3)
    assert np.isnan(telemetry["ellipsoidal_height_m"]).all()
    assert telemetry["horizontal_sigma_m"] == pytest.approx([1.2] * 4)
    assert list(telemetry.time_ns) == [START_NS + 200_000_000 * i for i in range(4)]
    if version == "1.0":
        assert telemetry["speed_m_s"] == pytest.approx([3.5] * 4)


def test_a_time_zone_is_heeded_and_none_is_utc():
    for written in ("10:00:00Z", "12:00:00+02:00", "07:30:00-02:30", "10:00:00"):
        telemetry = gpx.read(track(PLACES[:1]).replace("10:00:00Z", written).encode(), "a.gpx")
        assert telemetry.time_ns[0] == START_NS, written


def test_a_namespace_prefix_and_utf_16():
    text = track(PLACES)
    for tag in ("gpx", "trkpt", "trkseg", "trk", "ele", "time"):
        for opening in ("<", "</"):
            for closing in (">", " "):
                text = text.replace(f"{opening}{tag}{closing}", f"{opening}g:{tag}{closing}")
    text = text.replace("xmlns=", "xmlns:g=")
    for data in (text.encode(), text.replace("UTF-8", "UTF-16").encode("utf-16")):
        assert gpx.recognises(data)
        assert gpx.read(data, "a.gpx")["orthometric_height_m"][0] == 50.25


def test_points_without_a_time():
    text = track(PLACES)
    some = text.replace("<time>2016-05-04T10:00:02Z</time>", "").replace("10:00:04Z", "soon")
    telemetry = gpx.read(some.encode(), "a.gpx")
    assert len(telemetry) == 4
    assert codes(telemetry)["unreadable_line"] == 2
    route = gpxpy.gpx.GPX()
    route.routes.append(gpxpy.gpx.GPXRoute())
    route.routes[0].points.append(gpxpy.gpx.GPXRoutePoint(41.9, 12.5))
    with pytest.raises(InputError, match="<time>"):
        gpx.read(route.to_xml().encode(), "a.gpx")
    with pytest.raises(InputError, match="without track points"):
        gpx.read(gpxpy.gpx.GPX().to_xml().encode(), "a.gpx")


def test_one_bad_point_does_not_cost_the_file():
    text = track(PLACES).replace('lat="41.902804"', 'lat="north"')
    text = text.replace("<ele>53.25</ele>", "<ele>n/a</ele>")
    telemetry = gpx.read(text.encode(), "a.gpx")
    assert len(telemetry) == 6
    assert np.flatnonzero(np.isnan(telemetry["latitude_deg"])).tolist() == [2]
    assert np.flatnonzero(np.isnan(telemetry["orthometric_height_m"])).tolist() == [3]
    assert codes(telemetry)["no_fix"] == 1


def test_bombs_and_external_entities_are_refused():
    bomb = (
        '<!DOCTYPE gpx [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;">]><gpx><trk>&b;</trk></gpx>'
    )
    external = '<?xml version="1.0"?><!DOCTYPE gpx SYSTEM "file:///etc/hostname"><gpx></gpx>'
    for text in (bomb, external):
        with pytest.raises(InputError, match="document type"):
            gpx.read(text.encode(), "a.gpx")


@pytest.mark.parametrize("cut", [1, 10, 40, 80, 120, 200])
def test_a_cut_file_keeps_its_whole_points(cut):
    text = track(PLACES)
    end = text.rindex("</trkpt>")
    telemetry = gpx.read(text[: end - cut].encode(), "a.gpx")
    assert codes(telemetry)["truncated"] == 1
    assert 4 <= len(telemetry) <= 5
    assert list(telemetry["orthometric_height_m"]) == [50.25 + i for i in range(len(telemetry))]


def test_what_cannot_be_read():
    for data in (
        b"<gpx",
        b"<gpx><trk></gpx>",
        b'<?xml version="1.0" encoding="klingon"?><gpx></gpx>',
        b"",
    ):
        with pytest.raises(InputError):
            gpx.read(data, "a.gpx")


@settings(max_examples=100, deadline=None)
@given(data=st.data())
def test_mutated_files_raise_only_input_errors(data):
    valid = bytearray(track(PLACES[:3]).encode())
    for _ in range(data.draw(st.integers(1, 5))):
        place = data.draw(st.integers(0, len(valid) - 1))
        if data.draw(st.booleans()):
            valid[place] = data.draw(
                st.one_of(st.integers(0, 255), st.sampled_from(b'0123456789.-<>/"'))
            )
        else:
            del valid[place : place + data.draw(st.integers(1, 30))]
    try:
        telemetry = gpx.read(bytes(valid), "a.gpx")
    except InputError:
        return
    assert (np.diff(telemetry.time_ns) > 0).all()
    assert all(not np.isinf(column).any() for column in telemetry.columns.values())
