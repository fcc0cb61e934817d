"""The path that a simulated drone really flew: its camera's pose at any moment."""

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.random import Generator
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d

from sorvolo.errors import SettingsError
from sorvolo.geometry.arrays import Floats, Mask, PointsM, TimesNs
from sorvolo.geometry.geodesy import LocalFrame
from sorvolo.geometry.pose import (
    Pose,
    gimbal_angles_from_rotation,
    rotation_from_vector,
    site_from_body_nadir_rotation,
)
from sorvolo.lab.simulation.settings import (
    GEOID_HEIGHT_M,
    LaterSettings,
    MotionSettings,
    PathSettings,
    SensorSettings,
)
from sorvolo.search.drawing.noise import SmoothSeries, smooth_series
from sorvolo.survey.flight import Telemetry

LEAD_S = 5.0
"""The path is known this long before the video starts and after it ends: telemetry runs longer than video."""

_STEP_M = 0.25  # between points of the path before it is rounded
_MOST_BANK_DEG = 35.0  # of a fixed wing in a turn; by choice


@dataclass(frozen=True, eq=False)
class FlownPath:
    """The truth of one flight; times are seconds since the video's first frame."""

    duration_s: float
    plan: CubicSpline  # time -> east, north of the plan
    heading: CubicSpline  # time -> unwrapped degrees, clockwise from north
    height_m: float
    camera_pitch_deg: float
    east: SmoothSeries
    north: SmoothSeries
    up: SmoothSeries
    roll: SmoothSeries
    pitch: SmoothSeries
    yaw: SmoothSeries
    bank: CubicSpline  # time -> degrees of roll that turns need; 0 for rotor drones

    def position_m(self, time_s: Floats) -> PointsM:
        """(N, 3) the camera in the site frame at these times, (N,)."""
        plan = np.asarray(self.plan(time_s))
        return np.column_stack(
            [
                plan[:, 0] + self.east(time_s),
                plan[:, 1] + self.north(time_s),
                self.height_m + self.up(time_s),
            ]
        )

    def velocity_m_s(self, time_s: Floats) -> PointsM:
        """(N, 3) the camera's velocity in the site frame."""
        half_s = 0.05
        return (
            self.position_m(np.asarray(time_s) + half_s)
            - self.position_m(np.asarray(time_s) - half_s)
        ) / (2 * half_s)

    def pose(self, time_s: float) -> Pose:
        """site_from_camera at a time."""
        heading_deg = float(self.heading(time_s)) + float(self.yaw(time_s))
        pitch_deg = float(self.pitch(time_s)) + self.camera_pitch_deg + 90.0
        roll_deg = float(self.roll(time_s)) + float(self.bank(time_s))
        rotation = site_from_body_nadir_rotation(heading_deg, pitch_deg, roll_deg)
        return Pose(rotation, self.position_m(np.array([time_s]))[0])

    def heading_deg(self, time_s: Floats) -> Floats:
        """(N,) the nose's heading, clockwise from north, in [0, 360)."""
        return (np.asarray(self.heading(time_s)) + self.yaw(time_s)) % 360.0


def planned_waypoints(settings: PathSettings) -> PointsM:
    """(N, 2) the corners of the strips, back and forth, the site's origin in their middle."""
    half = settings.length_m / 2
    rows = (np.arange(settings.strips) - (settings.strips - 1) / 2) * settings.strip_spacing_m
    ends = [(-half, half) if i % 2 == 0 else (half, -half) for i in range(settings.strips)]
    # along the heading and to its right
    local = np.array([(along, row) for row, pair in zip(rows, ends) for along in pair])
    heading = np.radians(settings.heading_deg)
    forward = np.array([np.sin(heading), np.cos(heading)])
    right = np.array([np.cos(heading), -np.sin(heading)])
    return local[:, :1] * forward + local[:, 1:] * right


def fly(path: PathSettings, motion: MotionSettings, rng: Generator) -> FlownPath:
    """Fly the plan at constant speed, corners rounded, with smooth random departures from it.

    A rotor drone's speed is that over the ground, a fixed wing's that through the air: wind makes it faster or slower
    over the ground and turns its nose off its course.
    """
    corners_m = planned_waypoints(path)
    pieces = []
    for start, end in pairwise(corners_m):
        count = max(2, int(np.ceil(np.hypot(*end - start) / _STEP_M)))
        pieces.append(start + (end - start) * np.linspace(0, 1, count, endpoint=False)[:, None])
    line = np.concatenate([*pieces, corners_m[-1:]])
    before, after = line[0] - line[1], line[-1] - line[-2]
    lead = np.arange(1, int(np.ceil(LEAD_S * path.speed_m_s / _STEP_M)) + 3)[:, None]
    whole = np.concatenate([(line[0] + before * lead)[::-1], line, line[-1] + after * lead])
    reach_m = min(path.strip_spacing_m / 4, path.length_m / 8) if path.strips > 1 else 0.0
    rounded = gaussian_filter1d(whole, max(reach_m, 0.1) / _STEP_M, axis=0, mode="nearest")
    # the filter pulls the ends in; out there nothing but telemetry looks
    travelled_m = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(rounded, axis=0).T))])
    passed_s = _passed_s(rounded, travelled_m, len(lead), path, motion)
    duration_s = float(passed_s[len(lead) + len(line) - 1])
    keep = np.concatenate([[True], np.diff(travelled_m) > 1e-6])
    times_s = passed_s[keep]
    plan = CubicSpline(times_s, rounded[keep])
    moving = np.asarray(plan(times_s, 1)) - _wind_m_s(motion)
    heading_deg = np.degrees(np.unwrap(np.arctan2(moving[:, 0], moving[:, 1])))
    roll_rms_deg = motion.roll_rms_deg
    smooth = max(1.0, 0.4 * path.speed_m_s / _STEP_M)
    heading = CubicSpline(times_s, gaussian_filter1d(heading_deg, smooth, mode="nearest"))
    span = (-LEAD_S, duration_s + LEAD_S)
    return FlownPath(
        duration_s,
        plan,
        heading,
        path.height_m,
        motion.camera_pitch_deg,
        east=smooth_series(rng, *span, 10.0, motion.drift_rms_m),
        north=smooth_series(rng, *span, 10.0, motion.drift_rms_m),
        up=smooth_series(rng, *span, 8.0, motion.height_rms_m),
        roll=smooth_series(
            rng, *span, 1.2, motion.tilt_rms_deg if roll_rms_deg is None else roll_rms_deg
        ),
        pitch=smooth_series(rng, *span, 1.2, motion.tilt_rms_deg),
        yaw=smooth_series(rng, *span, 4.0, motion.yaw_rms_deg),
        bank=_bank(times_s, heading, path.speed_m_s, motion),
    )


def _wind_m_s(motion: MotionSettings) -> Floats:
    """(2,) east, north: where the wind blows to."""
    towards = np.radians(motion.wind_from_deg + 180.0)
    return motion.wind_m_s * np.array([np.sin(towards), np.cos(towards)])


def _passed_s(
    line_m: PointsM, travelled_m: Floats, first: int, path: PathSettings, motion: MotionSettings
) -> Floats:
    """(N,) seconds at which the points of a line, (N, 2), are passed, counted from one of them.

    Raises SettingsError for too strong a wind.
    """
    if not motion.wind_m_s:
        return (travelled_m - travelled_m[first]) / path.speed_m_s
    steps = np.diff(line_m, axis=0)
    length = np.maximum(np.hypot(*steps.T), 1e-9)
    course = steps / length[:, None]
    wind = _wind_m_s(motion)
    along, across = course @ wind, course[:, 0] * wind[1] - course[:, 1] * wind[0]
    if motion.wind_m_s > 0.8 * path.speed_m_s:
        raise SettingsError(
            f"a wind of {motion.wind_m_s:g} m/s is too strong for a drone of {path.speed_m_s:g} m/s; at most 0.8 of it"
        )
    over_ground_m_s = along + np.sqrt(path.speed_m_s**2 - across**2)
    passed_s = np.concatenate([[0.0], np.cumsum(length / over_ground_m_s)])
    return passed_s - passed_s[first]


def _bank(
    times_s: Floats, heading: CubicSpline, speed_m_s: float, motion: MotionSettings
) -> CubicSpline:
    """Degrees of roll, right side down, of a coordinated turn: tan(bank) = speed x turn rate / g."""
    if not motion.is_fixed_wing:
        return CubicSpline(times_s[[0, -1]], np.zeros(2))
    rate_rad_s = np.radians(np.asarray(heading(times_s, 1)))
    bank_deg = np.degrees(np.arctan(speed_m_s * rate_rad_s / 9.81))
    return CubicSpline(times_s, np.clip(bank_deg, -_MOST_BANK_DEG, _MOST_BANK_DEG))


def path_of_flight(path: PathSettings, later: LaterSettings, flight: int) -> PathSettings:
    """The plan of the flight with this number, counted from 1."""
    if flight == 1:
        return path
    return replace(
        path,
        height_m=path.height_m * later.revisit.height_factor,
        heading_deg=(path.heading_deg + later.revisit.heading_change_deg) % 360.0,
    )


_PLACE = ("latitude_deg", "longitude_deg", "orthometric_height_m")
_CAMERA = ("camera_yaw_deg", "camera_pitch_deg", "camera_roll_deg")
_BODY = ("body_yaw_deg", "body_pitch_deg", "body_roll_deg")
_MOTION = ("course_deg", "speed_m_s")
_COLUMNS = {  # what each format can carry
    "csv": (*_PLACE, "height_above_takeoff_m", *_CAMERA, *_BODY, *_MOTION),
    "srt": (*_PLACE, "height_above_takeoff_m", *_CAMERA),
    "nmea": (*_PLACE, "ellipsoidal_height_m", *_MOTION),
    "gpx": _PLACE,
    "photos": (*_PLACE, "height_above_takeoff_m", *_CAMERA),
}
_RATES_HZ = {"csv": 10.0, "srt": 5.0, "nmea": 1.0, "gpx": 1.0}
_BAROMETER_NOISE_M = 0.2  # one sigma; by choice
_GAP_S = 3.0  # without samples, where a gap is asked for


@dataclass(frozen=True, eq=False)
class Observation:
    """Telemetry as it was recorded, and what is known of it: `true_s` are the moments of its samples
    since the video's first frame, `is_sound` is False for jumps and 0/0 fixes, `corrupt` are the samples
    whose sentences are to be written with a wrong checksum."""

    telemetry: Telemetry
    true_s: Floats
    is_sound: Mask
    corrupt: frozenset[int]

    def fix_at(self, time_s: Floats) -> tuple[Floats, Floats]:
        """Latitude and longitude, each (N,), interpolated between sound fixes at these times: what a perfect map can
        know; NaN without fixes."""
        sound = self.is_sound
        if not sound.any():
            return np.full(len(time_s), np.nan), np.full(len(time_s), np.nan)
        latitude = self.telemetry["latitude_deg"][sound]
        longitude = self.telemetry["longitude_deg"][sound]
        true_s = self.true_s[sound]
        return np.interp(time_s, true_s, latitude), np.interp(time_s, true_s, longitude)


def observe(
    path: FlownPath,
    site: LocalFrame,
    started_ns: int,
    settings: SensorSettings,
    format_name: str,
    rng: Generator,
    at_s: Floats | None = None,
) -> Observation:
    """Sample the flown path as an instrument of this format does.

    `at_s` (N,) samples at these moments, as a camera does for its photos, which carry the fix of `clock_offset_s`
    earlier; else the rate is the settings' or the format's own, on the clock's whole ticks.
    """
    if at_s is None:
        rate_hz = _RATES_HZ[format_name]
        # a table or subtitle track begins with its video; a receiver's log runs on both sides of it
        spare_s = 0.0 if format_name in ("csv", "srt") else 1.0
        ticks = np.arange(
            np.ceil(-spare_s * rate_hz), np.floor((path.duration_s + spare_s) * rate_hz) + 1
        )
        true_s = ticks / rate_hz - settings.clock_offset_s
        keep = np.ones(len(true_s), bool)
        for start in rng.uniform(0.1, 0.8, settings.gaps) * path.duration_s:
            keep &= (true_s < start) | (true_s > start + _GAP_S)
        true_s = true_s[keep]
    else:
        true_s = np.asarray(at_s, dtype=np.float64) - settings.clock_offset_s
    count = len(true_s)
    error_m = rng.standard_normal((count, 3)) * settings.noise_m + np.array(settings.bias_m)
    if settings.wander_m:
        for axis in range(3):
            wander = smooth_series(rng, -LEAD_S, path.duration_s + LEAD_S, 60.0, 1.0)
            # a short flight sees a piece of the wander only, so its spread is not scaled up to the whole
            error_m[:, axis] += settings.wander_m * (rng.standard_normal() + 0.3 * wander(true_s))
    fixes_m = path.position_m(true_s) + error_m
    is_sound = np.ones(count, bool)
    faulty = rng.permutation(count)[: settings.jumps + settings.zero_fixes]
    is_sound[faulty] = False
    jumps = faulty[: settings.jumps]
    fixes_m[jumps, :2] += rng.choice([-1.0, 1.0], (len(jumps), 2)) * rng.uniform(
        150, 900, (len(jumps), 2)
    )
    latitude_deg, longitude_deg, ellipsoidal_m = site.wgs84_from_site(fixes_m)
    zeros = faulty[settings.jumps :]
    latitude_deg[zeros], longitude_deg[zeros] = 0.0, 0.0
    # the camera's angles as a gimbal reports them, and a body that leans into its speed
    turns = rotation_from_vector(
        np.radians(rng.standard_normal((count, 3)) * settings.attitude_noise_deg)
    )
    camera = np.array(
        [
            gimbal_angles_from_rotation(path.pose(float(t)).rotation @ turn)
            for t, turn in zip(true_s, turns)
        ]
    ).reshape(-1, 3)
    speed_m_s = np.hypot(*path.velocity_m_s(true_s)[:, :2].T)
    lean_deg = -np.degrees(np.arctan(0.012 * speed_m_s))
    jitter = rng.standard_normal((count, 3)) * max(settings.attitude_noise_deg, 0.1)
    columns = {
        "latitude_deg": latitude_deg,
        "longitude_deg": longitude_deg,
        "ellipsoidal_height_m": ellipsoidal_m,
        "orthometric_height_m": ellipsoidal_m - GEOID_HEIGHT_M,
        "height_above_takeoff_m": path.position_m(true_s)[:, 2]
        + rng.standard_normal(count) * _BAROMETER_NOISE_M,
        **dict(zip(_CAMERA, camera.T)),
        "body_yaw_deg": (path.heading_deg(true_s) + jitter[:, 0]) % 360.0,
        "body_pitch_deg": lean_deg + jitter[:, 1],
        "body_roll_deg": jitter[:, 2],
    }
    velocity_m_s = path.velocity_m_s(true_s)[:, :2] + rng.standard_normal((count, 2)) * 0.1
    columns["course_deg"] = np.degrees(np.arctan2(*velocity_m_s.T)) % 360.0
    columns["speed_m_s"] = np.hypot(*velocity_m_s.T)
    recorded_s = true_s + settings.clock_offset_s
    telemetry = Telemetry(
        format_name,
        started_ns + _ns(recorded_s),
        {name: columns[name] for name in _COLUMNS[format_name]},
        _ns(recorded_s) if format_name == "srt" else np.full(count, -1),
    )
    corrupt = frozenset(int(i) for i in rng.permutation(count)[: settings.bad_checksums])
    return Observation(
        telemetry, true_s, is_sound, corrupt if format_name == "nmea" else frozenset()
    )


def _ns(time_s: Floats) -> TimesNs:
    return np.round(time_s * 1e9).astype(np.int64)
