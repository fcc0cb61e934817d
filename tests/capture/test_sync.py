"""Clocks and tracks: interpolation by eq. 3.18, what lies outside is unknown, and offsets that motion shows."""

import re
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from sorvolo.capture.clock_offset import estimate_offset
from sorvolo.capture.sync import (
    Clock,
    shifted,
    site_origin,
    tie_clocks,
    track_from_telemetry,
)
from sorvolo.errors import InputError
from sorvolo.geometry.geodesy import Geodetic, LocalFrame
from sorvolo.geometry.pose import gimbal_angles_from_rotation, site_from_gimbal_rotation
from sorvolo.survey.flight import Telemetry
from sorvolo.survey.wording import span_words

FRAME = LocalFrame(Geodetic(41.9, 12.6, 0.0))
START_NS = 1_778_576_400 * 10**9


def telemetry(times_s, east_north_m, *, start_ns=START_NS, video=False, **columns) -> Telemetry:
    times_s = np.asarray(times_s, float)
    points = np.asarray(east_north_m, float)
    latitude, longitude, _ = FRAME.wgs84_from_site(points)
    time_ns = start_ns + np.round(times_s * 1e9).astype(np.int64)
    made = {"latitude_deg": latitude, "longitude_deg": longitude, **columns}
    video_time_ns = np.round(times_s * 1e9).astype(np.int64) if video else None
    return Telemetry(
        "test",
        time_ns,
        {name: np.broadcast_to(each, len(times_s)) for name, each in made.items()},
        video_time_ns,
    )


def straight(times_s, **columns) -> Telemetry:
    """4 m/s east, 1 m/s north."""
    return telemetry(
        times_s, np.column_stack([4.0 * np.asarray(times_s), 1.0 * np.asarray(times_s)]), **columns
    )


def clock_of(times_s, sigma_s=2.0) -> Clock:
    return Clock(np.asarray(times_s, float), "test", sigma_s, START_NS)


def track_of(samples: Telemetry, *, sigma_s=2.0, **options):
    times_s = (samples.time_ns - START_NS) / 1e9
    return track_from_telemetry(samples, clock_of(times_s, sigma_s), FRAME, **options)


ONE_HZ = np.arange(0, 21.0)


@given(st.floats(0, 20))
def test_linear_motion_is_interpolated_exactly(time_s):
    track, _ = track_of(straight(ONE_HZ, height_above_takeoff_m=np.linspace(10, 30, 21)))
    prior = track.prior(time_s)
    assert np.allclose(prior.position_m, [4 * time_s, time_s, 10 + time_s], atol=1e-3)
    assert np.allclose(prior.velocity_m_s, [4, 1, 1], atol=1e-3)
    assert np.isfinite(prior.position_sigma_m).all()


@given(st.floats(0, 10))
def test_smoothing_keeps_linear_motion_and_uses_every_fix(time_s):
    times_s = np.arange(0, 10.05, 0.1)
    track, _ = track_of(straight(times_s))
    plain, smooth = track.prior(time_s), track.prior(time_s, smooth_s=0.5)
    assert np.allclose(smooth.position_m[:2], [4 * time_s, time_s], atol=1e-3)
    assert smooth.position_sigma_m[0] <= plain.position_sigma_m[0] + 1e-9


def test_a_fix_between_others_far_apart_is_less_sure():
    times_s = np.arange(0, 21.0, 2.0)
    track, _ = track_of(straight(times_s, horizontal_sigma_m=1.0))
    assert track.prior(5.0).position_sigma_m[0] > track.prior(4.0).position_sigma_m[0]


def test_beyond_the_ends_nothing_is_known():
    track, _ = track_of(straight(ONE_HZ, height_above_takeoff_m=20.0))
    assert track.prior(-1.0).knows_place and track.prior(21.0).knows_place
    for time_s in (-2.0, 22.0, 500.0):
        prior = track.prior(time_s)
        assert not prior.knows_place
        assert "no fix" in prior.source


def test_in_a_gap_nothing_is_known():
    times_s = np.concatenate([np.arange(0, 8.0), np.arange(15, 21.0)])
    track, _ = track_of(straight(times_s))
    assert track.prior(7.0).knows_place and track.prior(15.0).knows_place
    assert not track.prior(11.0).knows_place
    # a shorter one is bridged
    short, _ = track_of(straight(np.delete(ONE_HZ, [8, 9])))
    assert np.allclose(short.prior(8.5).position_m[:2], [34, 8.5], atol=1e-3)


def test_a_sample_without_a_fix_is_no_fix():
    samples = straight(ONE_HZ)
    latitude = samples["latitude_deg"].copy()
    latitude[5] = np.nan
    holed = Telemetry("test", samples.time_ns, {**samples.columns, "latitude_deg": latitude})
    track, _ = track_of(holed)
    assert np.allclose(track.prior(5.0).position_m[:2], [20, 5], atol=1e-3)
    assert site_origin(holed) is not None
    assert site_origin(Telemetry("test", samples.time_ns, {})) is None


def own_fixes(times_s) -> Telemetry:
    return replace(straight(times_s), is_per_photo=True)


def tied_photos(samples: Telemetry, times_s, **options) -> Clock:
    options = {"start_ns": START_NS, **options}
    return tie_clocks(samples, np.asarray(times_s, float), kind="photos", **options)


def test_photos_carry_their_own_fixes():
    times_s = np.array([0.0, 4.0, 60.0, 300.0])
    clock = tied_photos(own_fixes(times_s), times_s)
    assert clock.is_per_photo
    track, _ = track_from_telemetry(own_fixes(times_s), clock, FRAME)
    for time_s in times_s:
        assert np.allclose(track.prior(time_s).position_m[:2], [4 * time_s, time_s], atol=1e-3)
    with pytest.raises(InputError, match=r"own fix.*offset_s 7200.*leave offset_s out"):
        tied_photos(own_fixes(times_s), times_s, offset_s=7200.0)


@pytest.mark.parametrize("kind", ["photos", "video"])
@pytest.mark.parametrize("offset_s", [0.0, -7200.0, 7.5])
def test_a_log_is_interpolated_at_the_pictures_own_times_and_ends_where_it_ends(kind, offset_s):
    taken_s = np.array([0.0, 3.3, 9.1, 19.9])
    clock = tie_clocks(
        straight(ONE_HZ),
        taken_s,
        kind=kind,
        start_ns=START_NS - round(offset_s * 1e9),
        offset_s=offset_s,
    )
    assert clock.first_frame_utc_ns == START_NS
    track, _ = track_from_telemetry(straight(ONE_HZ), clock, FRAME)
    for time_s in taken_s:
        assert np.allclose(track.prior(time_s).position_m[:2], [4 * time_s, time_s], atol=1e-3)
    assert not track.prior(25.0).knows_place and not track.prior(-5.0).knows_place


def test_a_log_tells_photos_without_a_time_nothing():
    with pytest.raises(InputError, match="photos state no time"):
        tied_photos(straight(ONE_HZ), [0.0, 1.0], start_ns=0)


def test_a_late_fix_lies_ahead_on_the_path_of_all_fixes_and_is_doubted_where_that_bends():
    times_s = np.arange(0, 50, 10.0)
    turning = own_fixes(times_s)
    track, _ = track_from_telemetry(turning, tied_photos(turning, times_s), FRAME)
    east_m = track.east_north_m.copy()
    east_m[3:, 0] = east_m[2, 0]  # 4 m/s east until the third photo, none after it
    bent = replace(track, east_north_m=east_m)
    moved = shifted(bent, 0.5)
    assert np.allclose((moved.east_north_m - east_m)[:, 0], [2, 2, 0, 0, 0], atol=1e-3)
    assert np.allclose((moved.east_north_m - east_m)[:, 1], 0.5, atol=1e-3)
    back = shifted(bent, -0.5)
    assert np.allclose((back.east_north_m - east_m)[:, 0], [-2, -2, -2, 0, 0], atol=1e-3)
    assert np.allclose(moved.horizontal_sigma_m[[0, 1, 3, 4]], track.horizontal_sigma_m[0])
    assert moved.horizontal_sigma_m[2] == pytest.approx(
        np.hypot(track.horizontal_sigma_m[0], 1.0), abs=1e-3
    )


def test_a_slow_fix_repeated_at_frame_rate_is_a_slow_fix():
    times_s = np.arange(0, 20, 0.04)
    held_s = np.floor(times_s)
    track, _ = track_of(telemetry(times_s, np.column_stack([4 * held_s, held_s])))
    assert track.interval_s == pytest.approx(1.0, abs=0.05)
    assert np.allclose(track.prior(10.5).position_m[:2], [42, 10.5], atol=0.1)


# ---- clocks ---------------------------------------------------------------------------------------------------


def tied(samples: Telemetry, start_ns: int, *, offset_s: float | None = None) -> Clock:
    return tie_clocks(
        samples, np.arange(21.0), kind="video", start_ns=start_ns, offset_s=offset_s, name="f"
    )


def test_utc_decides_where_both_have_it():
    clock = tied(straight(ONE_HZ), START_NS + 3 * 10**9)
    assert clock.sample_s[0] == pytest.approx(-3.0)
    assert clock.tie == "both carry UTC"
    assert clock.first_frame_utc_ns == START_NS + 3 * 10**9


def test_subtitles_count_from_the_first_frame():
    clock = tied(straight(ONE_HZ, video=True), START_NS + 7 * 3600 * 10**9)
    assert (clock.sample_s == ONE_HZ).all()
    assert clock.first_frame_utc_ns == START_NS


@pytest.mark.parametrize("kind", ["video", "photos"])
@pytest.mark.parametrize(
    "ahead_s", [3600, 7202, -9 * 3600, 19800, -14 * 3600 + 3, 500, 3 * 86400, -40 * 86400]
)
def test_without_time_in_common_the_offset_that_would_tie_them_is_named_with_its_sign(
    kind, ahead_s
):
    """The pictures' clock is so far ahead. The number that the message gives puts the cameras where they were."""
    start_ns, taken_s = START_NS + ahead_s * 10**9, np.linspace(0, 20, 9)

    def clock(offset_s: float | None) -> Clock:
        return tie_clocks(
            straight(ONE_HZ), taken_s, kind=kind, start_ns=start_ns, offset_s=offset_s, name="f"
        )

    with pytest.raises(InputError, match="no time in common") as refused:
        clock(None)
    words = f"{refused.value}"
    assert f"begins {span_words(abs(ahead_s))} {'before' if ahead_s > 0 else 'after'}" in words
    offset_s = float(re.search(r"--offset (-?[\d.]+)", words)[1])
    assert offset_s == pytest.approx(-ahead_s, abs=3)
    track, _ = track_from_telemetry(straight(ONE_HZ), clock(offset_s), FRAME)
    for time_s in taken_s[1:-1]:
        east_m = track.prior(time_s).position_m[0]
        assert east_m == pytest.approx(4 * (time_s + ahead_s + offset_s), abs=1e-3)


def test_the_wrong_sign_is_refused_and_names_the_right_one():
    with pytest.raises(InputError, match=r"offset_s -7200 .*2 h ahead of"):
        tied(straight(ONE_HZ), START_NS + 7200 * 10**9, offset_s=7200.0)


def test_frames_beyond_the_log_are_counted():
    clock = tied(straight(ONE_HZ), START_NS + 10 * 10**9)
    assert [each.code for each in clock.notices] == ["partly_covered"]
    assert "covers 62 %" in clock.notices[0].text


def test_a_video_that_does_not_know_its_time_is_tied_by_starts():
    clock = tied(straight(ONE_HZ), 0)
    assert clock.sample_s[0] == 0.0 and clock.notices == ()


@pytest.mark.parametrize("counts_from_first_frame", [False, True])
def test_a_log_without_a_date_is_dated_by_the_video(counts_from_first_frame):
    undated = replace(
        straight(ONE_HZ, video=counts_from_first_frame),
        time_ns=np.round(ONE_HZ * 1e9).astype(np.int64),
    )
    assert tied(undated, START_NS).first_frame_utc_ns == START_NS


@pytest.mark.parametrize("begins_s", [-30.0, 4.0, 86_390.0])
def test_a_log_of_times_of_day_is_tied_by_them(begins_s):
    """START_NS is 09:00 UTC of its day; the log may begin before, and the pictures after a midnight."""
    times_s = np.arange(0, 80.0)
    since_midnight_ns = np.round((9 * 3600 + begins_s + times_s) * 1e9).astype(np.int64)
    of_day = replace(straight(times_s), time_ns=since_midnight_ns)
    clock = tied(of_day, START_NS + round(max(begins_s, 0.0) * 1e9) + 10**10)
    assert clock.sample_s[0] == pytest.approx(min(begins_s, 0.0) - 10)
    # of another time of day than the pictures it says nothing: it begins with them, as far as is known
    assert tied(of_day, START_NS + 3600 * 10**9).sample_s[0] == 0.0


# ---- the offset that motion shows -----------------------------------------------------------------------------


def curved(times_s) -> np.ndarray:
    times_s = np.asarray(times_s)
    return np.column_stack([40 * np.sin(times_s / 6), 25 * np.sin(times_s / 4) + 1.5 * times_s])


def seen_path(path, times_s) -> np.ndarray:
    """The path in a map of its own: turned, scaled and shifted."""
    turn = np.array([[0.6, -0.8], [0.8, 0.6]])
    return 1.7 * path(times_s) @ turn.T + [300, -20]


@pytest.mark.parametrize("offset_s", [0.7, -1.1, 0.0])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_an_offset_is_seen_on_a_curved_path(offset_s, seed):
    rng = np.random.default_rng(seed)
    sample_s = np.arange(0, 60.0, 0.5)
    samples = telemetry(sample_s, curved(sample_s) + rng.normal(0, 0.7, (120, 2)))
    track, _ = track_of(samples)
    frames_s = np.arange(5, 54, 0.8)
    # what a frame at t shows is what telemetry has at t + offset
    found = estimate_offset(track, frames_s, seen_path(curved, frames_s + offset_s), reach_s=4.0)
    assert abs(found.offset_s - offset_s) < 3 * found.sigma_s
    assert 0.005 < found.sigma_s < 0.2
    assert found.is_significant == (offset_s != 0)
    order = rng.permutation(len(frames_s))  # photos that were retried come after later ones
    mixed = estimate_offset(
        track, frames_s[order], seen_path(curved, frames_s + offset_s)[order], reach_s=4.0
    )
    assert mixed == found
    corrected = shifted(track, found.offset_s)
    again = estimate_offset(
        corrected, frames_s, seen_path(curved, frames_s + offset_s), reach_s=4.0
    )
    assert abs(again.offset_s) < 0.05


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_straight_flight_shows_no_offset(seed):
    rng = np.random.default_rng(seed)
    line = lambda t: np.column_stack([4 * np.asarray(t), np.asarray(t)])  # noqa: E731
    samples = telemetry(ONE_HZ, line(ONE_HZ) + rng.normal(0, 0.7, (21, 2)))
    track, _ = track_of(samples)
    frames_s = np.arange(4, 16, 0.8)
    found = estimate_offset(track, frames_s, seen_path(line, frames_s + 0.7), reach_s=3.0)
    assert not found.is_significant


def test_too_little_shows_nothing():
    track, _ = track_of(straight(ONE_HZ))
    few = np.arange(4.0)
    assert np.isinf(estimate_offset(track, few, curved(few), reach_s=3.0).sigma_s)
    many = np.arange(0, 20, 0.5)
    assert np.isinf(estimate_offset(track, many, curved(many), reach_s=0.0).sigma_s)
    assert not estimate_offset(track, many, np.zeros((40, 2)), reach_s=2.0).is_significant


def strips(times_s) -> np.ndarray:
    """Four strips of 50 m, 12 m apart, at 5 m/s."""
    along = np.asarray(times_s) * 5.0
    corners_m = np.array(
        [[0, 0], [50, 0], [50, 12], [0, 12], [0, 24], [50, 24], [50, 36], [0, 36.0]]
    )
    passed_m = np.concatenate(
        [[0.0], np.cumsum(np.linalg.norm(np.diff(corners_m, axis=0), axis=1))]
    )
    return np.column_stack([np.interp(along, passed_m, corners_m[:, k]) for k in range(2)])


def offsets_found(seeds, error_m, *, offset_s) -> tuple[np.ndarray, np.ndarray]:
    """(N,) errors and (N,) stated sigmas, s, of an offset on strips with fixes ten times a second."""
    errors_s, sigmas_s = [], []
    for seed in seeds:
        rng = np.random.default_rng(seed)
        sample_s = np.arange(0, 47.0, 0.1)
        track, _ = track_of(
            telemetry(sample_s, strips(sample_s - offset_s) + error_m(rng, sample_s))
        )
        frames_s = np.round(np.cumsum(rng.choice([0.9, 1.0, 1.1, 1.2], 38)), 1)
        found = estimate_offset(track, frames_s, 1.3 * strips(frames_s), reach_s=2.0)
        errors_s.append(found.offset_s - offset_s)
        sigmas_s.append(found.sigma_s)
    return np.array(errors_s), np.array(sigmas_s)


def test_fixes_in_step_with_the_frames_do_not_pull_the_offset_between_them():
    """Midway between two fixes a straight line from one to the other halves their noise: 0.04 s off, 1 sigma 0.02 s."""
    errors_s, sigmas_s = offsets_found(
        range(24), lambda rng, times_s: rng.normal(0, 0.5, (len(times_s), 2)), offset_s=0.3
    )
    assert np.sqrt(np.mean(errors_s**2)) < 0.02
    assert 0.7 < np.sqrt(np.mean((errors_s / sigmas_s) ** 2)) < 1.4


def test_an_offset_by_fixes_that_wander_is_known_less_well():
    """Errors that last as long as a strip pull all of it one way: they counted as new for each frame, 2.1 sigma rms."""

    def wandering(rng, times_s):
        kept = np.exp(-0.1 / 10.0)
        steps = rng.normal(0, 0.5 * np.sqrt(1 - kept**2), (len(times_s), 2))
        error_m = rng.normal(0, 0.5, 2)
        walked = []
        for step in steps:
            error_m = kept * error_m + step
            walked.append(error_m)
        return np.array(walked) + rng.normal(0, 0.1, (len(times_s), 2))

    errors_s, sigmas_s = offsets_found(range(24), wandering, offset_s=0.0)
    assert 0.6 < np.sqrt(np.mean((errors_s / sigmas_s) ** 2)) < 1.5


# ---- heights --------------------------------------------------------------------------------------------------


def test_height_above_take_off_is_taken_as_height_above_ground():
    track, notices = track_of(
        straight(ONE_HZ, height_above_takeoff_m=25.0, ellipsoidal_height_m=110.0)
    )
    assert (track.up_m == 25.0).all() and notices == ()
    assert "take-off" in track.height_words and np.isfinite(track.altitude_offset_sigma_m)


@pytest.mark.parametrize("column", ["orthometric_height_m", "ellipsoidal_height_m"])
def test_absolute_heights_alone_leave_the_ground_unknown(column):
    track, notices = track_of(straight(ONE_HZ, **{column: 110 + np.linspace(0, 1, 21)}))
    assert [each.code for each in notices] == ["ground_unknown"]
    assert np.isinf(track.altitude_offset_sigma_m)
    assert np.allclose(np.diff(track.up_m), 0.05)


def test_a_height_that_would_be_below_unknown_ground_counts_as_unknown():
    """A poor receiver's height that lags behind the climb: taken as it is, it would draw the camera to the ground."""
    heights = np.concatenate([np.linspace(30, 55, 5), np.full(16, 110.0)])
    track, _ = track_of(straight(ONE_HZ, orthometric_height_m=heights))
    below, above = track.prior(1.0), track.prior(10.0)
    assert np.isinf(below.position_sigma_m[2]) and np.isfinite(below.position_sigma_m[:2]).all()
    assert below.position_m[2] == pytest.approx(40.0) and np.allclose(
        below.position_m[:2], [4.0, 1.0], atol=1e-3
    )
    assert above.position_m[2] == pytest.approx(40.0) and np.isfinite(above.position_sigma_m).all()


@pytest.mark.parametrize("column", ["orthometric_height_m", "ellipsoidal_height_m"])
def test_a_given_ground_makes_them_heights_above_it(column):
    track, notices = track_of(straight(ONE_HZ, **{column: 110.0}), ground_elevation_m=85.0)
    assert (track.up_m == 25.0).all() and notices == ()
    assert np.isfinite(track.altitude_offset_sigma_m)


def test_a_take_off_in_the_telemetry_shows_the_ground():
    heights = np.concatenate([np.full(5, 80.0), np.linspace(80, 105, 6), np.full(10, 105.0)])
    track, notices = track_of(straight(ONE_HZ, orthometric_height_m=heights))
    assert track.up_m[0] == pytest.approx(0.0) and track.up_m[-1] == pytest.approx(25.0)
    assert notices == () and "begins" in track.height_words


def test_how_far_a_flight_climbs_after_its_first_frames_is_known():
    heights = np.concatenate([np.linspace(80, 92, 7), np.full(14, 140.0)])
    track, _ = track_of(straight(ONE_HZ, orthometric_height_m=heights))
    assert track.climb_after_m([0.0, 1.0, 2.0, 3.0]) == pytest.approx(140 - 83)
    assert track.climb_after_m([12.0, 15.0]) == track.climb_after_m([]) == 0.0


def test_a_height_of_zero_is_not_believed():
    track, notices = track_of(straight(ONE_HZ, height_above_takeoff_m=0.0))
    assert [each.code for each in notices] == ["height_of_zero", "height_unknown"]
    assert np.isinf(track.vertical_sigma_m)
    assert np.isinf(track.prior(5.0).position_sigma_m[2]) and track.prior(5.0).knows_place


# ---- attitude -------------------------------------------------------------------------------------------------


def test_yaw_turns_across_north_the_short_way():
    yaw = np.array([350.0, 10.0, 30.0])
    track, _ = track_of(
        straight([0.0, 1, 2], camera_yaw_deg=yaw, camera_pitch_deg=-89.0, camera_roll_deg=0.0)
    )
    for time_s, expected in ((0.25, 355.0), (0.5, 0.0), (1.5, 20.0)):
        found = gimbal_angles_from_rotation(track.prior(time_s).rotation)[0]
        assert abs((found - expected + 180) % 360 - 180) < 1e-6


def test_roll_turns_across_180_degrees_the_short_way():
    """As a gimbal near straight down states it: yaw and roll are wild, and their sum is calm."""
    yaw, roll = np.array([228.0, 282.0]), np.array([-139.0, 167.0])
    track, _ = track_of(
        straight([0.0, 1], camera_yaw_deg=yaw, camera_pitch_deg=-89.5, camera_roll_deg=roll)
    )
    turned = track.prior(0.0).rotation.T @ track.prior(0.5).rotation
    assert np.degrees(np.arccos((np.trace(turned) - 1) / 2)) < 3.0


def test_a_camera_that_sways_across_straight_down_is_not_turned_between_samples():
    """Its yaw and its roll each jump by about half a turn; interpolated one by one, their sum made a full turn."""
    sways_deg = np.random.default_rng(5).normal(0, 0.2, (21, 3)) * [0, 0, 1]
    sways_deg[:, 0] = 0.4 * (-1.0) ** np.arange(21)
    still = site_from_gimbal_rotation(90.0, -90.0, 0.0)
    sways = Rotation.from_rotvec(np.radians(sways_deg)).as_matrix()
    yaw, pitch, roll = np.array([gimbal_angles_from_rotation(each @ still) for each in sways]).T
    track, _ = track_of(
        straight(ONE_HZ, camera_yaw_deg=yaw, camera_pitch_deg=pitch, camera_roll_deg=roll)
    )
    for time_s in np.arange(0, 20.01, 0.25):
        turn = Rotation.from_matrix(track.prior(time_s).rotation @ still.T)
        assert np.degrees(turn.magnitude()) < 1.0
    assert np.allclose(track.prior(7.0).rotation, sways[7] @ still)


def test_a_sample_without_angles_is_bridged_by_its_neighbours():
    yaw_deg = 10.0 * ONE_HZ
    yaw_deg[5] = np.nan
    track, _ = track_of(straight(ONE_HZ, camera_yaw_deg=yaw_deg, camera_pitch_deg=-60.0))
    assert np.allclose(gimbal_angles_from_rotation(track.prior(5.0).rotation)[0], 50.0, atol=0.5)


def test_a_gimbal_is_asked_before_the_body():
    angles = {"body_yaw_deg": 10.0, "body_pitch_deg": 5.0, "body_roll_deg": 0.0}
    body, _ = track_of(straight(ONE_HZ, **angles))
    gimbal, _ = track_of(
        straight(ONE_HZ, **angles, camera_yaw_deg=50.0, camera_pitch_deg=-90.0, camera_roll_deg=0.0)
    )
    assert (body.attitude, gimbal.attitude) == ("body", "gimbal")
    # nose up by 5 deg tilts a camera fixed below the body 5 deg forward of the vertical
    looks = body.prior(3.0).rotation[:, 2]
    assert np.degrees(np.arccos(-looks[2])) == pytest.approx(5.0)
    assert np.all(gimbal.prior(3.0).attitude_sigma_deg < body.prior(3.0).attitude_sigma_deg)


def test_without_angles_the_course_turns_the_picture_but_is_not_trusted():
    track, _ = track_of(straight(ONE_HZ))
    prior = track.prior(5.0)
    forward = prior.rotation @ np.array([0.0, -1.0, 0.0])
    assert np.allclose(forward[:2], np.array([4, 1]) / np.hypot(4, 1), atol=1e-3)
    assert np.isinf(prior.attitude_sigma_deg[2])
