"""What flights and their telemetry are made of: noise, motion, light and ground as they were asked for."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

from sorvolo.errors import SettingsError
from sorvolo.geometry.geodesy import Geodetic
from sorvolo.geometry.ground import footprint
from sorvolo.geometry.pose import site_from_gimbal_rotation
from sorvolo.geometry.sun import sun_direction
from sorvolo.lab.simulation.flight import simulate_flight, simulate_flights
from sorvolo.lab.simulation.ground import GroundKind, orthophoto_ground, paint_ground
from sorvolo.lab.simulation.ground_painting import GroundArea
from sorvolo.lab.simulation.path import fly, observe, planned_waypoints
from sorvolo.lab.simulation.settings import (
    ImagingSettings,
    MotionSettings,
    OutputSettings,
    PathSettings,
    SceneSettings,
    SensorSettings,
    SimulationSettings,
    WeatherSettings,
)
from sorvolo.lab.simulation.world import needed_area, start_ns, sun_of_flight
from sorvolo.search.drawing.noise import smooth_series

LONG = PathSettings(height_m=30, speed_m_s=5, length_m=100, strips=4, strip_spacing_m=12)
QUICK = SimulationSettings(
    seed=3,
    flights=1,
    scene=SceneSettings("sand", people=1, cars=1, small_objects=1),
    path=PathSettings(height_m=10, speed_m_s=4, length_m=8, strips=1),
    imaging=ImagingSettings(320, 240, fps=4),
)


def site():
    return simulate_flight(QUICK).site


@hypothesis_settings(max_examples=25, deadline=None)
@given(st.floats(0.5, 10), st.floats(0.01, 5), st.integers(0, 10**6))
def test_a_smooth_series_has_its_spread(correlation_s, rms, seed):
    series = smooth_series(np.random.default_rng(seed), -3, 90, correlation_s, rms)
    values = series(np.linspace(-3, 90, 4000))
    assert np.sqrt(np.mean(values**2)) == pytest.approx(rms, rel=0.02)
    assert np.abs(np.diff(values)).max() < rms * 93 / 4000 / correlation_s * 12


def test_the_path_keeps_its_plan():
    path = fly(LONG, MotionSettings(0, 0, 0, 0), np.random.default_rng(1))
    times_s = np.linspace(0, path.duration_s, 2000)
    speeds = np.hypot(*path.velocity_m_s(times_s)[:, :2].T)
    assert speeds == pytest.approx(np.full(2000, 5.0), abs=0.15)
    places = path.position_m(times_s)
    assert np.allclose(places[:, 2], 30)
    for corner in planned_waypoints(LONG):
        assert np.hypot(*(places[:, :2] - corner).T).min() < 4.0  # corners are rounded
    # on the strips the nose points along the first heading or back
    off = np.abs((path.heading_deg(times_s) - 90 + 90) % 180 - 90)
    assert np.median(off) < 0.5


def test_motion_has_its_root_mean_square():
    path = fly(LONG, MotionSettings(1.5, 2.0, 0.5, 0.3), np.random.default_rng(2))
    times_s = np.linspace(0, path.duration_s, 1000)
    tilt_deg = [np.degrees(np.arccos(-path.pose(float(t)).rotation[2, 2])) for t in times_s]
    assert np.sqrt(np.mean(np.square(tilt_deg))) == pytest.approx(1.5 * np.sqrt(2), rel=0.12)


def test_noise_bias_clock_and_faults_are_as_asked():
    path = fly(LONG, MotionSettings(), np.random.default_rng(3))
    sensor = SensorSettings(
        noise_m=(1.0, 0.5, 2.0), bias_m=(3.0, -2.0, 0.0), clock_offset_s=0.7, jumps=3, zero_fixes=4
    )
    frame = site()
    seen = observe(path, frame, 10**18, sensor, "csv", np.random.default_rng(4))
    telemetry = seen.telemetry
    assert telemetry.time_ns[0] == 10**18
    assert seen.true_s[0] == pytest.approx(-0.7)
    sound = seen.is_sound
    assert np.count_nonzero(~sound) == 7
    assert (
        np.count_nonzero((telemetry["latitude_deg"] == 0) & (telemetry["longitude_deg"] == 0)) == 4
    )
    heights = telemetry["orthometric_height_m"] + 48.3
    fixes = frame.site_from_wgs84(telemetry["latitude_deg"], telemetry["longitude_deg"], heights)[
        sound
    ]
    error = fixes - path.position_m(seen.true_s[sound])
    tolerance = 5 / np.sqrt(len(error))
    assert error.mean(axis=0) == pytest.approx([3.0, -2.0, 0.0], abs=2 * tolerance)
    assert error.std(axis=0) == pytest.approx([1.0, 0.5, 2.0], rel=0.15)
    assert np.isnan(telemetry["ellipsoidal_height_m"]).all()  # the table does not carry it


def test_gaps_leave_samples_out():
    path = fly(LONG, MotionSettings(), np.random.default_rng(3))
    seen = observe(path, site(), 0, SensorSettings(gaps=1), "csv", np.random.default_rng(4))
    assert 2.9 < np.diff(seen.true_s).max() < 3.3


def test_attitude_without_noise_is_the_true_rotation():
    path = fly(LONG, MotionSettings(), np.random.default_rng(3))
    seen = observe(
        path, site(), 0, SensorSettings(attitude_noise_deg=0), "csv", np.random.default_rng(4)
    )
    for i in (0, 100, 333):
        angles = [
            float(seen.telemetry[f"camera_{axis}_deg"][i]) for axis in ("yaw", "pitch", "roll")
        ]
        assert np.allclose(
            site_from_gimbal_rotation(*angles), path.pose(float(seen.true_s[i])).rotation, atol=1e-9
        )


def test_frames_do_not_depend_on_their_order():
    first, second = simulate_flight(QUICK), simulate_flight(QUICK)
    forwards = {frame.index: frame.image for frame in first.frames(every=3)}
    for index in sorted(forwards, reverse=True):
        assert np.array_equal(second.frame(index).image, forwards[index])


@pytest.mark.parametrize("kind", list(GroundKind))
def test_grounds_are_textured_and_never_repeat(kind):
    raster = paint_ground(kind, GroundArea(-15, -15, 15, 15), 0.03, np.random.default_rng(5)).raster
    gray = raster.rgb.astype(np.float32).mean(axis=2)
    fine = gray - np.asarray(cv2.GaussianBlur(gray, (0, 0), 10))
    spread = float(fine.std())
    if kind is GroundKind.SAND:
        assert 1.5 < spread < 4.5
    else:
        assert spread > 7
    again = np.corrcoef(gray[:400, :400].ravel(), gray[500:900, 500:900].ravel())[0, 1]
    assert abs(again) < 0.5


def test_all_that_the_camera_sees_is_painted():
    settings = replace(QUICK, path=LONG, motion=MotionSettings(tilt_rms_deg=3.0))
    area = needed_area(settings, planned_waypoints(LONG))
    path = fly(LONG, settings.motion, np.random.default_rng(8))
    times_s = np.linspace(0, path.duration_s, 400)
    outlines = np.concatenate(
        [footprint(settings.imaging.camera, path.pose(float(t))) for t in times_s]
    )
    assert outlines[:, 0].min() > area.west_m and outlines[:, 0].max() < area.east_m
    assert outlines[:, 1].min() > area.south_m and outlines[:, 1].max() < area.north_m


def test_later_flights_find_changes_and_other_light():
    first, second = simulate_flights(replace(QUICK, flights=2))
    before, now = (
        {thing.id for thing in first.day.things},
        {thing.id for thing in second.day.things},
    )
    assert before - now and now - before
    assert not np.allclose(first.day.light.sun, second.day.light.sun)
    assert second.started_ns > first.started_ns


@pytest.mark.parametrize("place", [(41.9, 12.6), (-33.9, 151.2), (64.1, -21.9)])
def test_the_sun_of_a_flight_stands_where_its_time_and_place_put_it(place):
    settings = replace(QUICK, scene=replace(QUICK.scene, origin=Geodetic(*place, 80.0)))
    suns = [sun_of_flight(settings, flight) for flight in (1, 2, 3)]
    times_ns = [start_ns(settings, flight) for flight in (1, 2, 3)]
    assert times_ns == sorted(set(times_ns))
    for sun, time_ns in zip(suns, times_ns):
        assert np.allclose(sun, sun_direction(time_ns, *place)) and sun[2] > 0.3
    same_light = replace(
        settings, later=replace(settings.later, weather=WeatherSettings(has_other_light=False))
    )
    assert np.degrees(np.arccos(suns[0] @ sun_of_flight(same_light, 2))) < 0.2


def test_a_polar_night_is_given_a_low_sun():
    settings = replace(QUICK, scene=replace(QUICK.scene, origin=Geodetic(-89.0, 0.0, 80.0)))
    assert np.degrees(np.arcsin(sun_of_flight(settings, 1)[2])) == pytest.approx(10.0)


def test_an_orthophoto_must_cover_the_flight():
    settings = replace(QUICK, scene=SceneSettings("orthophoto"))
    with pytest.raises(SettingsError, match="orthophoto covers 10 x 10 m"):
        simulate_flight(settings, orthophoto_ground(np.zeros((100, 100, 3), np.uint8), 0.1))
    with pytest.raises(SettingsError, match="none was given"):
        simulate_flight(settings)


@pytest.mark.parametrize(
    "make",
    [
        lambda: SceneSettings("moon"),
        lambda: PathSettings(height_m=-1),
        lambda: ImagingSettings(641, 480),
        lambda: OutputSettings(telemetry="morse"),
        lambda: SensorSettings(clock_offset_s=60.0),
    ],
)
def test_impossible_settings_are_refused(make):
    with pytest.raises(SettingsError):
        make()


def test_a_format_that_was_not_recorded_is_refused():
    with pytest.raises(SettingsError, match="recorded no gpx"):
        simulate_flight(QUICK).telemetry("gpx")
