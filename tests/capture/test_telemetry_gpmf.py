"""GPMF inside GoPro's videos: the cameras' GPS5 and GPS9, the Karma's own state, damage."""

import struct
from datetime import UTC, datetime

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from real_data import real_data
from sorvolo.capture.source import open_sources
from sorvolo.capture.telemetry.gpmf import Payload, is_gpmf, read_payloads
from sorvolo.errors import InputError

S = 10**9
NOON_NS = int(datetime(2023, 5, 4, 12, tzinfo=UTC).timestamp()) * S


def item(key: str, kind: str, size: int, values: bytes) -> bytes:
    head = key.encode() + kind.encode() + struct.pack(">BH", size, len(values) // size)
    return head + values + bytes(-len(values) % 4)


def container(key: str, *items: bytes) -> bytes:
    inside = b"".join(items)
    return key.encode() + b"\0" + struct.pack(">BH", 1, len(inside)) + inside


def text(key: str, value: str) -> bytes:
    return item(key, "c", 1, value.encode())


def gps5(second: int, fix: int = 3, datum: str = "") -> bytes:
    """Ten samples of one second, flying north at 5 m/s."""
    rows = b"".join(
        struct.pack(
            ">5i",
            round((46.5 + (10 * second + i) * 4.5e-6) * 1e7),
            round(11.2e7),
            250_500,
            5000,
            510,
        )
        for i in range(10)
    )
    clock = datetime.fromtimestamp(NOON_NS / 1e9 + second, UTC).strftime("%y%m%d%H%M%S.%f")[:16]
    stream = container(
        "STRM",
        item("GPSF", "L", 4, struct.pack(">I", fix)),
        item("GPSU", "U", 16, clock.encode()),
        item("GPSP", "S", 2, struct.pack(">H", 120)),
        *([text("GPSA", datum)] if datum else []),
        item("SCAL", "l", 4, struct.pack(">5i", 10**7, 10**7, 1000, 1000, 100)),
        item("GPS5", "l", 20, rows),
    )
    other = container(
        "STRM", item("SCAL", "s", 2, struct.pack(">h", 418)), item("ACCL", "s", 6, bytes(60))
    )
    return container("DEVC", text("DVNM", "Hero7 Black"), other, stream)


def gps9(second: int) -> bytes:
    days = (NOON_NS // S - 946_684_800) // 86_400
    rows = b"".join(
        struct.pack(
            ">7i2H",
            round(46.5e7),
            round(11.2e7),
            250_500,
            5000,
            510,
            days,
            (43_200 + second) * 1000 + 100 * i,
            120,
            3,
        )
        for i in range(10)
    )
    scales = struct.pack(">9i", 10**7, 10**7, 1000, 1000, 100, 1, 1000, 100, 1)
    return container(
        "DEVC",
        container(
            "STRM",
            text("TYPE", "lllllllSS"),
            item("SCAL", "l", 4, scales),
            item("GPS9", "?", 32, rows),
        ),
    )


def payloads(make, count: int = 6) -> list[Payload]:
    return [Payload(second * S, S, make(second)) for second in range(count)]


def test_a_cameras_gps5() -> None:
    telemetry = read_payloads(payloads(gps5), "GOPR1.MP4")
    assert telemetry.format == "gpmf" and len(telemetry) == 60
    assert list(telemetry.video_time_ns[:3]) == [0, S // 10, S // 5]
    assert telemetry.time_ns[0] == NOON_NS and (np.diff(telemetry.time_ns) == S // 10).all()
    assert (
        telemetry["latitude_deg"][59] == pytest.approx(46.5 + 59 * 4.5e-6)
        and telemetry["longitude_deg"][0] == 11.2
    )
    assert (
        telemetry["ellipsoidal_height_m"][0] == 250.5
        and np.isnan(telemetry["orthometric_height_m"]).all()
    )
    assert telemetry["speed_m_s"][0] == 5 and telemetry["horizontal_sigma_m"][0] == pytest.approx(
        1.8
    )


def test_heights_above_the_sea_and_fixes_in_the_plane() -> None:
    telemetry = read_payloads(payloads(lambda second: gps5(second, datum="MSLV")), "a")
    assert (
        telemetry["orthometric_height_m"][0] == 250.5
        and np.isnan(telemetry["ellipsoidal_height_m"]).all()
    )
    flat = read_payloads(payloads(lambda second: gps5(second, fix=2)), "a")
    assert flat.has_fixes and np.isnan(flat["ellipsoidal_height_m"]).all()
    with pytest.raises(InputError, match="no usable gpmf"):
        read_payloads(payloads(lambda second: gps5(second, fix=0)), "a")


def test_a_newer_cameras_gps9() -> None:
    telemetry = read_payloads(payloads(gps9), "GX01.MP4")
    assert len(telemetry) == 60 and abs(int(telemetry.time_ns[0]) - NOON_NS) < 1000
    assert telemetry["latitude_deg"][0] == 46.5 and telemetry["ellipsoidal_height_m"][0] == 250.5
    assert telemetry["horizontal_sigma_m"][0] == pytest.approx(1.8)


def test_a_payload_that_is_cut_is_counted_and_the_others_are_read() -> None:
    whole = payloads(gps5)
    whole[3] = Payload(3 * S, S, whole[3].data[:-25])
    telemetry = read_payloads(whole, "a")
    assert len(telemetry) == 50
    assert {notice.code: notice.count for notice in telemetry.notices}["unreadable_line"] == 1


@settings(max_examples=120, deadline=None)
@given(data=st.data())
def test_mutated_payloads_raise_only_input_errors(data: st.DataObject) -> None:
    valid = bytearray(data.draw(st.sampled_from([gps5(0), gps9(0)])))
    for _ in range(data.draw(st.integers(1, 8))):
        place = data.draw(st.integers(0, len(valid) - 1))
        if data.draw(st.booleans()):
            valid[place] = data.draw(st.integers(0, 255))
        else:
            del valid[place : place + data.draw(st.integers(1, 20))]
        if not valid:
            return
    try:
        telemetry = read_payloads([Payload(0, S, bytes(valid)), Payload(S, S, gps5(1))], "a")
    except InputError:
        return
    assert (np.diff(telemetry.time_ns) > 0).all()
    assert not np.isinf(telemetry["latitude_deg"]).any()


@settings(max_examples=100, deadline=None)
@given(st.binary(max_size=300))
def test_any_bytes_raise_only_input_errors(noise: bytes) -> None:
    is_gpmf(noise)
    for data in (noise, b"DEVC\0\1" + struct.pack(">H", len(noise)) + noise):
        with pytest.raises(InputError):
            read_payloads([Payload(0, S, data)], "a")


def test_a_real_karma_video() -> None:
    (source,) = open_sources([real_data("telemetry/gopro_karma/karma.mp4")])
    telemetry = source.telemetry
    assert telemetry.format == "gpmf" and len(telemetry) >= 45
    assert (telemetry.video_time_ns >= 0).all() and telemetry.video_time_ns[-1] < 12.5 * S
    # the drone's clock agrees with the one in the video's header
    assert abs(int(telemetry.time_ns[0]) - source.start_ns) < S
    assert np.ptp(telemetry["latitude_deg"]) * 111_000 == pytest.approx(71, abs=3)
    assert telemetry["longitude_deg"] == pytest.approx(-117.331, abs=0.001)
    assert np.nanmedian(telemetry["orthometric_height_m"]) == pytest.approx(16, abs=4)
    assert (
        np.isfinite(telemetry["height_above_takeoff_m"]).all()
        and np.isfinite(telemetry["body_roll_deg"]).all()
    )
    # it flies forward, in the direction of its nose
    turn = (telemetry["body_yaw_deg"] - telemetry["course_deg"] + 180) % 360 - 180
    assert np.median(np.abs(turn)) < 10 and np.median(telemetry["body_pitch_deg"]) < -5
    steps_s = np.diff(telemetry.time_ns) / S
    assert np.median(steps_s) == pytest.approx(0.25, abs=0.03)
