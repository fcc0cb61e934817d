"""The cleaning step: null and teleporting fixes, clocks, gaps; what it keeps and what it takes out."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sorvolo.capture.telemetry.cleaning import (
    NO_TIME_NS,
    clean,
    fill_stamps,
    increasing,
    refine_clock,
    text_from_bytes,
    time_ns_from_text,
)
from sorvolo.errors import InputError

SECOND_NS = 1_000_000_000
M_PER_DEG = 111_320.0


def track(count: int, speed_m_s: float = 10.0, step_s: float = 1.0):
    times = (np.arange(count) * step_s * SECOND_NS).astype(np.int64)
    north_deg = np.arange(count) * step_s * speed_m_s / M_PER_DEG
    return times, 48.0 + north_deg, np.full(count, 11.0)


def cleaned(times, latitude, longitude, **columns):
    return clean(
        "nmea", "a.log", times, {"latitude_deg": latitude, "longitude_deg": longitude, **columns}
    )


def codes(telemetry) -> dict[str, int]:
    return {notice.code: notice.count for notice in telemetry.notices}


def lost(telemetry) -> list[int]:
    return np.flatnonzero(np.isnan(telemetry["latitude_deg"])).tolist()


def test_a_good_flight_stays_as_it_is():
    times, latitude, longitude = track(50)
    telemetry = cleaned(times, latitude, longitude)
    assert codes(telemetry) == {}
    assert (telemetry["latitude_deg"] == latitude).all()
    assert (telemetry.time_ns == times).all()


@settings(max_examples=60, deadline=None)
@given(
    start=st.integers(0, 40),
    length=st.integers(1, 8),
    step_s=st.sampled_from([0.1, 0.2, 1.0]),
    away_m=st.floats(900, 1e6),
    scattered=st.booleans(),
    seed=st.integers(0, 1000),
)
def test_runs_of_teleported_fixes_are_taken_out_exactly(
    start, length, step_s, away_m, scattered, seed
):
    times, latitude, longitude = track(60, step_s=step_s)
    bad = np.arange(start, min(start + length, 60))
    rng = np.random.default_rng(seed)
    angle = (
        rng.uniform(0, 2 * np.pi, len(bad))
        if scattered
        else np.full(len(bad), rng.uniform(0, 2 * np.pi))
    )
    latitude[bad] += away_m * np.cos(angle) / M_PER_DEG
    longitude[bad] += away_m * np.sin(angle) / M_PER_DEG / np.cos(np.radians(48))
    telemetry = cleaned(times, latitude, longitude)
    # within the run a scattered fix may by chance fit the flight again; none outside may be lost
    assert set(lost(telemetry)) <= set(bad.tolist())
    assert codes(telemetry).get("jump", 0) == len(lost(telemetry))
    if not scattered:
        assert lost(telemetry) == bad.tolist()


def test_a_single_bad_fix_at_either_end():
    for place in (0, 49):
        times, latitude, longitude = track(50)
        latitude[place] += 0.1
        assert lost(cleaned(times, latitude, longitude)) == [place]


@pytest.mark.parametrize("part", [slice(0, 20), slice(20, 50), slice(40, 50)])
def test_a_sign_that_is_lost_on_the_way_is_refused(part):
    """Whichever part is the longer: it says nothing of which hemisphere is right."""
    times, latitude, longitude = track(50)
    longitude[part] *= -1
    with pytest.raises(InputError, match="positions have the other sign of longitude"):
        cleaned(times, latitude, longitude)
    # a glitch is none, nor is a flight across the meridian of Greenwich
    times, latitude, longitude = track(50)
    latitude[[3, 9]] *= -1
    assert lost(cleaned(times, latitude, longitude)) == [3, 9]
    times, latitude, longitude = track(50)
    assert lost(cleaned(times, latitude, longitude - longitude[25])) == []


def test_fast_flight_is_no_jump_and_neither_is_a_long_gap():
    times, latitude, longitude = track(50, speed_m_s=60.0)
    assert codes(cleaned(times, latitude, longitude)) == {}
    times, latitude, longitude = track(50)
    times[25:] += 100 * SECOND_NS
    latitude[25:] += 5000 / M_PER_DEG
    assert set(codes(cleaned(times, latitude, longitude))) == {"gap"}


def test_slow_receivers_behind_fast_clocks_do_not_jump():
    # 20 m/s, a fix a second, repeated at 25 samples a second and rounded to 11 m
    times, latitude, longitude = track(250, speed_m_s=20.0, step_s=0.04)
    held = np.round(latitude[np.arange(250) // 25 * 25], 4)
    telemetry = cleaned(times, held, longitude)
    assert "jump" not in codes(telemetry)
    assert codes(telemetry)["repeated_fix"] == 240
    assert "distinct fixes: 10" in telemetry.notices[0].text


def test_a_jump_after_a_long_hover_is_seen():
    times, latitude, longitude = track(200, speed_m_s=0.0)
    latitude[150:153] += 1000 / M_PER_DEG
    assert lost(cleaned(times, latitude, longitude)) == [150, 151, 152]


@pytest.mark.parametrize("longitude", [179.9995, -179.9995])
def test_the_antimeridian_is_no_jump(longitude):
    times, latitude, _ = track(20)
    east = longitude + np.linspace(-1e-3, 1e-3, 20)
    telemetry = cleaned(times, latitude, east)
    assert lost(telemetry) == []
    assert (np.abs(telemetry["longitude_deg"]) <= 180).all()
    wrapped = cleaned(times, latitude, (east + 180) % 360 - 180)
    assert telemetry["longitude_deg"] == pytest.approx(wrapped["longitude_deg"], abs=1e-9)


def test_null_and_half_and_impossible_positions():
    times, latitude, longitude = track(10)
    latitude[1] = longitude[1] = 0.0
    latitude[2] = np.nan
    latitude[3] = 91.0
    longitude[4] = np.inf
    telemetry = cleaned(times, latitude, longitude, speed_m_s=[np.inf, -1, *[3.0] * 8])
    assert lost(telemetry) == [1, 2, 3, 4]
    assert np.isnan(telemetry["longitude_deg"][2])
    assert codes(telemetry) == {"out_of_range": 4, "no_fix": 3, "null_fix": 1, "gap": 1}
    assert np.isnan(telemetry["speed_m_s"][:2]).all()
    assert telemetry["speed_m_s"][2] == 3.0


def test_backward_and_repeated_clocks():
    times, latitude, longitude = track(10)
    times[4] = times[3]
    times[7] = times[1] + 5
    telemetry = cleaned(times, latitude, longitude)
    assert codes(telemetry)["duplicate_time"] == 1
    assert codes(telemetry)["backward_time"] == 1
    assert telemetry["latitude_deg"] == pytest.approx(latitude[[0, 1, 2, 3, 5, 6, 8, 9]])


def test_samples_with_the_newest_first_are_all_kept():
    times, latitude, longitude = track(50)
    telemetry = cleaned(times[::-1], latitude[::-1], longitude[::-1])
    assert codes(telemetry) == {} and (telemetry["latitude_deg"] == latitude).all()


def test_one_clock_far_ahead_does_not_cost_the_rest():
    times, latitude, longitude = track(20)
    times[5] += 10_000 * SECOND_NS
    assert len(cleaned(times, latitude, longitude)) == 19


@settings(max_examples=100, deadline=None)
@given(st.lists(st.integers(0, 30), max_size=30))
def test_increasing_keeps_the_longest_increasing_run(values):
    times = np.array(values, dtype=np.int64)
    keep = increasing(times)
    kept = times[keep]
    assert (np.diff(kept) > 0).all()
    longest = [0] * len(values)
    for i, value in enumerate(values):
        longest[i] = 1 + max((longest[j] for j in range(i) if values[j] < value), default=0)
    assert len(kept) == max(longest, default=0)


def test_gaps_are_counted_with_the_longest():
    times, latitude, longitude = track(30, speed_m_s=1.0)
    times[10:] += 4 * SECOND_NS
    times[20:] += 6 * SECOND_NS
    telemetry = cleaned(times, latitude, longitude)
    assert codes(telemetry) == {"gap": 2}
    assert "7.0 s" in telemetry.notices[0].text


def test_nothing_usable_is_an_input_error():
    with pytest.raises(InputError, match=r"a\.log: no usable nmea telemetry sample"):
        cleaned([0, SECOND_NS], [0.0, 0.0], [0.0, 0.0])
    with pytest.raises(InputError, match="holds no samples"):
        cleaned([], [], [])
    heights = clean("dji_srt", "a", [0, 1], {"height_above_takeoff_m": [3.0, 4.0]})
    assert not heights.has_fixes


@settings(max_examples=100, deadline=None)
@given(
    st.lists(
        st.tuples(
            st.integers(-(10**15), 10**15), *[st.floats(allow_nan=True, allow_infinity=True)] * 3
        ),
        max_size=25,
    )
)
def test_any_numbers_become_clean_telemetry(rows):
    times, latitude, longitude, yaw = ([row[column] for row in rows] for column in range(4))
    try:
        telemetry = cleaned(times, latitude, longitude, body_yaw_deg=yaw)
    except InputError:
        return
    for name, low, high in (("latitude_deg", -90, 90), ("longitude_deg", -180, 180)):
        known = telemetry[name][np.isfinite(telemetry[name])]
        assert ((known >= low) & (known <= high)).all()
    assert not any(np.isinf(column).any() for column in telemetry.columns.values())


def test_many_random_positions_take_bounded_time():
    rng = np.random.default_rng(1)
    times = np.arange(20_000) * SECOND_NS // 10
    telemetry = cleaned(times, rng.uniform(-80, 80, 20_000), rng.uniform(-180, 180, 20_000))
    assert codes(telemetry)["jump"] > 19_000


@pytest.mark.parametrize(
    "text, expected, zoned",
    [
        ("2021-12-25 12:27:52.373", "2021-12-25T12:27:52.373", False),
        ("2019-09-27 10:28:08,438,904", "2019-09-27T10:28:08.438904", False),
        ("HOME(1,2) 2017.8.5 14:11:51", "2017-08-05T14:11:51", False),
        ("2016/05/04 10:00:00", "2016-05-04T10:00:00", False),
        ("2016-05-04T10:00:00.123456789Z", "2016-05-04T10:00:00.123456789", True),
        ("2016-05-04T10:00:00+02:00", "2016-05-04T08:00:00", True),
        ("2016-05-04T10:00:00-0230", "2016-05-04T12:30:00", True),
    ],
)
def test_dates_in_every_dress(text, expected, zoned):
    assert time_ns_from_text(text) == (int(np.datetime64(expected, "ns").astype(np.int64)), zoned)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "12:27:52",
        "2021-13-25 12:27:52",
        "1905-01-01 00:00:00",
        "2021-02-30 00:00:00",
    ],
)
def test_no_dates(text):
    assert time_ns_from_text(text) is None


def test_missing_stamps_are_filled_and_coarse_ones_refined():
    counter = np.arange(6) * SECOND_NS // 2
    stamps = np.array(
        [NO_TIME_NS, 100 * SECOND_NS, NO_TIME_NS, 101 * SECOND_NS, 101 * SECOND_NS, NO_TIME_NS]
    )
    filled = fill_stamps(stamps, counter)
    assert filled[0] == 100 * SECOND_NS - SECOND_NS // 2
    assert filled[5] == 101 * SECOND_NS + SECOND_NS // 2
    refined, done = refine_clock(np.array([100, 100, 101, 101, 102, 102]) * SECOND_NS, counter)
    assert done and (np.diff(refined) == SECOND_NS // 2).all()
    apart = np.array([100, 100, 101, 151, 152, 152]) * SECOND_NS
    kept, done = refine_clock(apart, counter)
    assert not done and (kept == apart).all()


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "latin-1"])
def test_encodings(encoding):
    assert text_from_bytes("110.1° a".encode(encoding)) == "110.1° a"
