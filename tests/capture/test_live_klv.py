"""MISB ST 0601: published bytes, packets written and read again, noise, and angles composed as worked by hand."""

from collections import Counter
from math import isnan, nan

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from stanag4609.st0601 import decode_uas_local_set
from stanag4609.st0903 import resolve_vtarget_location

from sorvolo.capture.correction import headings_deg
from sorvolo.capture.live.klv import (
    ITEMS,
    UNIVERSAL_KEY,
    LocalSet,
    VmtiTarget,
    checksum,
    encode,
    local_sets,
)
from sorvolo.capture.live.klv_telemetry import (
    camera_of,
    columns_of,
    ground_elevation_m,
    metadata_of,
    packet_of,
    site_from_sensor_rotation,
)
from sorvolo.errors import InputError
from sorvolo.geometry.pose import (
    Pose,
    gimbal_angles_from_rotation,
    rotation_from_vector,
    site_from_gimbal_rotation,
)
from sorvolo.survey.corrected import Bias, CorrectedFrame

_TIME_NS = 1_760_000_000_123_456_000


def one(data: bytes) -> LocalSet:
    (found,) = local_sets(data, Counter())
    return found


def packet(*items: tuple[int, str]) -> bytes:
    """A local set of tags with values in hexadecimal, its checksum right."""
    body = b"".join(bytes([tag, len(value) // 2]) + bytes.fromhex(value) for tag, value in items)
    start = UNIVERSAL_KEY + bytes([len(body) + 4]) + body + bytes([1, 2])
    return start + checksum(start).to_bytes(2, "big")


@pytest.mark.parametrize(
    ("tag", "value", "expected"),
    [
        # the examples that ST 0601 prints beside each tag
        (5, "71C2", 159.974365),
        (6, "FD3D", -0.431531724),
        (7, "08B8", 3.405865657),
        (13, "5595B66D", 60.176822967),
        (14, "5B5360C4", 128.426759042),
        (15, "C221", 14190.719463),
        (16, "CD9C", 144.571298),
        (17, "D917", 152.643625),
        (18, "724A0A20", 160.719211474),
        (19, "87F84B86", -168.792324834),
        (20, "7DC55ECE", 176.865437691),
        (21, "03830926", 68590.983298744),
        (23, "F101A229", -10.542388633),
        (24, "14BC082B", 29.157890123),
        (25, "34F3", 3216.037232),
        (75, "C221", 14190.719463),
        (104, "2F921E", 23456.234375),
    ],
)
def test_published_values(tag: int, value: str, expected: float) -> None:
    assert one(packet((tag, value)))[ITEMS[tag].name] == pytest.approx(
        expected, abs=6e-6 * max(1, abs(expected) / 60)
    )


def test_time_version_and_unknown_tags() -> None:
    found = one(packet((2, "0004596B5FE6B8D8"), (3, "41424344"), (94, "0102"), (65, "13")))
    assert (
        found.time_ns == 0x0004596B5FE6B8D8 * 1000 and found.version == 0x13 and found.values == {}
    )
    assert one(packet((65, "13"))).time_ns == 0


def test_lengths_other_than_the_usual_ones_are_the_same_range_in_other_steps() -> None:
    assert one(packet((13, "55960000")))["sensor_latitude_deg"] == pytest.approx(60.18, abs=0.01)
    assert one(packet((13, "5596")))["sensor_latitude_deg"] == pytest.approx(60.18, abs=0.01)
    assert one(packet((15, "C2210000")))["sensor_true_altitude_m"] == pytest.approx(
        14190.6, abs=0.3
    )


def test_error_values_are_unknown() -> None:
    found = one(packet((6, "8000"), (13, "80000000"), (7, "0000")))
    assert isnan(found["platform_pitch_deg"]) and isnan(found["sensor_latitude_deg"])
    assert found["platform_roll_deg"] == 0 and isnan(found["slant_range_m"])


def test_long_lengths_and_tags_of_two_bytes() -> None:
    body = bytes([0x81, 0x05, 2, 1, 2]) + bytes([15, 0x81, 2, 0xC2, 0x21]) + bytes([1, 2])
    start = UNIVERSAL_KEY + bytes([0x82, 0, len(body) + 2]) + body
    found = one(start + checksum(start).to_bytes(2, "big"))
    assert found["sensor_true_altitude_m"] == pytest.approx(14190.719, abs=1e-3)


def test_sets_are_found_behind_a_header_and_damaged_ones_counted() -> None:
    whole = encode(_TIME_NS, {"sensor_latitude_deg": 46.5})
    flipped = bytearray(whole)
    flipped[30] ^= 4
    counts: Counter[str] = Counter()
    # the access unit header of synchronous metadata stands before each set
    data = (
        b"\x00\x01\xdf\x00\x20"
        + whole
        + bytes(flipped)
        + b"\x00\x02\xdf\x00\x20"
        + whole
        + whole[:-5]
    )
    assert len(list(local_sets(data, counts))) == 2
    assert counts == {"bad_checksum": 1, "damaged": 1}


_VALUES = st.fixed_dictionaries(
    {},
    optional={
        item.name: st.floats(item.lowest if not item.is_signed else -item.highest, item.highest)
        for item in ITEMS.values()
    },
)


@settings(max_examples=150, deadline=None)
@given(st.integers(0, 2**62 // 1000), _VALUES)
def test_what_is_written_is_read_again_within_half_a_step(
    time_us: int, values: dict[str, float]
) -> None:
    found = one(b"..." + encode(time_us * 1000, values) + b"...")
    assert found.time_ns == time_us * 1000 and set(found.values) == set(values)
    for item in ITEMS.values():
        if item.name in values:
            span = 2 * item.highest if item.is_signed else item.highest - item.lowest
            step = 1 / 64 if item.is_imapb else span / (2 ** (8 * item.length) - 2)
            assert abs(found[item.name] - values[item.name]) <= step * 0.51 + 1e-12


@settings(max_examples=120, deadline=None)
@given(st.binary(max_size=80), st.binary(max_size=80), st.integers(0, 60), st.integers(0, 255))
def test_no_bytes_make_it_fail(before: bytes, after: bytes, place: int, value: int) -> None:
    damaged = bytearray(encode(_TIME_NS, {"sensor_latitude_deg": 1.0, "slant_range_m": 3.0}))
    damaged[place % len(damaged)] = value
    for data in (before + UNIVERSAL_KEY + after, before + bytes(damaged) + after):
        for found in local_sets(data, Counter()):
            columns_of(found)


_TAGS = st.one_of(st.sampled_from(sorted(ITEMS)), st.integers(0, 200))


@settings(max_examples=120, deadline=None)
@given(
    st.lists(
        st.lists(st.tuples(_TAGS, st.binary(max_size=12)), max_size=12), min_size=1, max_size=4
    ),
    st.lists(st.integers(-1, 10**11), min_size=4, max_size=4),
)
def test_any_items_with_a_right_checksum_are_read_or_refused(
    sets: list[list[tuple[int, bytes]]], stamps_ns: list[int]
) -> None:
    data = b"".join(
        packet(
            *((tag, value.hex()) for tag, value in items if tag not in (1, 2)),
            (2, f"{_TIME_NS // 1000 + n:016x}"),
        )
        for n, items in enumerate(sets)
    )
    counts: Counter[str] = Counter()
    found = list(local_sets(data, counts))
    assert len(found) + counts["bad_checksum"] + counts["damaged"] >= len(sets)
    for each in found:
        camera_of(each, 1280, 720)
        columns = columns_of(each)
        assert all(np.isfinite(list(columns.values())))
    try:
        metadata = metadata_of(list(zip(stamps_ns, found)), counts, "a.ts")
    except InputError:
        return
    assert (np.diff(metadata.telemetry.time_ns) > 0).all()


def test_values_out_of_range_cannot_be_written() -> None:
    with pytest.raises(InputError, match="outside its tag's"):
        encode(0, {"platform_pitch_deg": 25.0})
    with pytest.raises(InputError, match="no tag for height"):
        encode(0, {"height": 1.0})
    assert isnan(one(encode(0, {"platform_pitch_deg": nan}))["platform_pitch_deg"])


@pytest.mark.parametrize(
    ("platform", "relative", "yaw_pitch_roll"),
    [
        (
            (90, 0, 0),
            (0, -90, 0),
            (90, -90, 0),
        ),  # straight down, the picture's top to the nose, which is east
        ((30, 0, 0), (60, -45, 0), (90, -45, 0)),  # level: headings add up
        # nose 10 up, looking to the right: the horizon is level ahead of the camera, but its own right side, the
        # aircraft's tail, hangs 10 deg down
        ((0, 10, 0), (90, 0, 0), (90, 0, 10)),
        # right wing 20 down, looking to the right: straight along that wing
        ((0, 0, 20), (90, 0, 0), (90, -20, 0)),
        # nose 10 up, looking ahead 90 deg below the nose: 80 deg below the horizon, leaning forward
        ((0, 10, 0), (0, -90, 0), (0, -80, 0)),
    ],
)
def test_the_cameras_angles_are_composed_as_by_hand(
    platform: tuple[float, ...], relative: tuple[float, ...], yaw_pitch_roll: tuple[float, ...]
) -> None:
    found = gimbal_angles_from_rotation(site_from_sensor_rotation(platform, relative))  # type: ignore[arg-type]
    assert np.allclose((np.array(found) - yaw_pitch_roll + 180) % 360, 180, atol=1e-6)


def test_columns() -> None:
    decoded = one(
        encode(
            _TIME_NS,
            {
                "platform_heading_deg": 90.0,
                "platform_pitch_full_deg": 40.0,
                "platform_pitch_deg": nan,
                "platform_roll_deg": 0.0,
                "sensor_relative_azimuth_deg": 0.0,
                "sensor_relative_elevation_deg": -90.0,
                "sensor_latitude_deg": 46.5,
                "sensor_longitude_deg": 11.3,
                "sensor_true_altitude_m": 160.0,
                "sensor_ellipsoid_height_m": 212.0,
                "sensor_ellipsoid_height_extended_m": 210.0,
                "frame_center_elevation_m": 100.0,
            },
        )
    )
    columns = columns_of(decoded)
    assert columns["orthometric_height_m"] == pytest.approx(160, abs=0.2)
    assert columns["ellipsoidal_height_m"] == pytest.approx(210, abs=0.02)  # the finer tag wins
    assert columns["camera_pitch_deg"] == pytest.approx(-50, abs=1e-3)
    assert columns["body_pitch_deg"] == pytest.approx(40, abs=1e-3)
    assert ground_elevation_m(decoded) == pytest.approx(100, abs=0.2)
    bare = columns_of(
        one(encode(_TIME_NS, {"platform_heading_deg": 90.0, "sensor_latitude_deg": 46.5}))
    )
    assert set(bare) == {"latitude_deg", "body_yaw_deg"}


def test_the_lens_from_the_field_of_view() -> None:
    wide = camera_of(one(encode(0, {"sensor_horizontal_fov_deg": 60.0})), 1000, 500)
    assert wide is not None and wide.camera.fx_px == pytest.approx(
        500 / np.tan(np.radians(30)), rel=1e-3
    )
    both = {"sensor_horizontal_fov_deg": 60.0, "sensor_vertical_fov_deg": 33.0}
    measured = camera_of(one(encode(0, both)), 1000, 500)
    assert measured is not None and measured.camera.fy_px == pytest.approx(
        250 / np.tan(np.radians(16.5)), rel=1e-3
    )
    # the vertical angle of the whole sensor does not fit a picture that was cut
    cut = camera_of(one(encode(0, both | {"sensor_vertical_fov_deg": 46.0})), 1000, 500)
    assert cut is not None and cut.camera.fy_px == cut.camera.fx_px
    assert camera_of(one(encode(0, {})), 1000, 500) is None


# ---- corrected metadata ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("tilt_deg", [0.0, 0.5, 20.0, 80.0])
def test_the_aircrafts_heading_stays_and_the_camera_is_read_back_as_it_was(tilt_deg: float) -> None:
    """A straight flight to the east whose camera sways about straight down, or about an oblique view to the south."""
    rng = np.random.default_rng(2)
    for _ in range(20):
        sway = rotation_from_vector(np.radians(rng.normal(0, 0.5, 3)))
        rotation = sway @ site_from_gimbal_rotation(180.0, tilt_deg - 90, 0.0)
        yaw_deg, pitch_deg, roll_deg = gimbal_angles_from_rotation(rotation)
        sample = CorrectedFrame(
            "",
            0,
            _TIME_NS,
            0.0,
            41.9,
            12.6,
            70.0,
            40.0,
            yaw_deg,
            pitch_deg,
            roll_deg,
            nan,
            60.0,
            40.0,
            "",
        )
        found = one(packet_of(sample, 90.0, "ellipsoidal"))
        assert found["platform_heading_deg"] == pytest.approx(90, abs=0.01)
        columns = columns_of(found)
        read = site_from_gimbal_rotation(
            *(columns[f"camera_{name}_deg"] for name in ("yaw", "pitch", "roll"))
        )
        assert np.abs(read - rotation).max() < 2e-4  # 0.01 deg


def test_detections_are_what_another_decoder_reads_of_st_0903() -> None:
    """Boxes as numbers of pixels, score, class, and the place within half a step of 85 cm."""
    sample = CorrectedFrame(
        *("", 0, _TIME_NS, 0.0, 46.5, 7.5, 500.0, 40.0, 30.0, -60.0, 0.0, 1.0, 60.0, 40.0, "")
    )
    person = VmtiTarget(300, "person", 0.873, (100, 50, 110.9, 70), 46.50031, 7.50021)
    unknown = VmtiTarget(1_000_001, "small object", 0.2, (-5, 0, 3, 480), nan, nan)
    stated = decode_uas_local_set(
        packet_of(sample, 90.0, "orthometric", [person, unknown], (640, 480))
    )
    centre_deg = stated.get(23).value, stated.get(24).value
    reach_m = 40 / np.tan(np.radians(60))  # to the north-east of the drone by 30 degrees
    assert (centre_deg[0] - 46.5) * 111_170 == pytest.approx(
        reach_m * np.cos(np.radians(30)), abs=0.1
    )
    found = stated.get(74).value
    assert [found.value(tag) for tag in (4, 5, 6, 8, 9)] == [6, 2, 2, 640, 480]
    first, second = found.targets
    assert [first.target_id, second.target_id] == [300, 1_000_001]
    assert [first.value(tag) for tag in (1, 2, 3, 5)] == [
        60 * 640 + 106,
        50 * 640 + 101,
        70 * 640 + 111,
        87,
    ]
    assert [second.value(tag) for tag in (2, 3)] == [1, 479 * 640 + 4], "inside the picture"
    assert second.value(10) is None, "its place is not known"
    place = resolve_vtarget_location(
        first, frame_center_latitude=centre_deg[0], frame_center_longitude=centre_deg[1]
    )
    assert place is not None
    assert (place.latitude, place.longitude) == pytest.approx((46.50031, 7.50021), abs=4e-6)
    names = {each.ontology_id: each.label for each in found.ontologies}
    assert [names[each.value(107)[0].ontology_id] for each in found.targets] == [
        "person",
        "small object",
    ]
    assert one(packet_of(sample, 90.0, "orthometric"))["frame_center_latitude_deg"] == (
        pytest.approx(centre_deg[0], abs=1e-7)
    )


def _flown(speed_m_s: float) -> tuple[list[float], list[Pose]]:
    """Five seconds to the east, then as many at a standstill, the pictures' top to the south."""
    times_s = [0.2 * each for each in range(50)]
    top_south = site_from_gimbal_rotation(180.0, -90.0, 0.0)
    return times_s, [
        Pose(top_south, np.array([speed_m_s * min(each, 5.0), 0.0, 40.0])) for each in times_s
    ]


def test_the_aircrafts_heading_is_the_logs_less_the_compasss_error() -> None:
    times_s, poses = _flown(5.0)
    stated_deg = np.full(len(times_s), 3.0)
    assert headings_deg(stated_deg, Bias(7.0, 0.2), times_s, poses) == pytest.approx(
        [356.0] * len(times_s)
    )
    assert headings_deg(stated_deg, Bias(7.0, 4.0), times_s, poses) == pytest.approx(
        [3.0] * len(times_s)
    )


def test_without_a_stated_heading_it_is_the_course_and_hovering_keeps_it() -> None:
    unknown = np.full(50, nan)
    times_s, poses = _flown(5.0)
    assert headings_deg(unknown, Bias(7.0, 0.2), times_s, poses) == pytest.approx([90.0] * 50)
    times_s, poses = _flown(0.0)
    assert headings_deg(unknown, Bias(nan, nan), times_s, poses) == pytest.approx([180.0] * 50)
