"""What a flight's instruments report: the true path, sampled, with noise, bias, a wrong clock and faults."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sorvolo.geometry.arrays import Floats, TimesNs
from sorvolo.geometry.geodesy import LocalFrame
from sorvolo.geometry.pose import gimbal_angles_from_rotation, rotation_from_vector
from sorvolo.lab.simulation.path import LEAD_S, FlownPath
from sorvolo.lab.simulation.settings import GEOID_HEIGHT_M, SensorSettings
from sorvolo.search.drawing.noise import smooth_series
from sorvolo.survey.flight import Telemetry

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
    is_sound: NDArray[np.bool_]
    corrupt: frozenset[int]

    def fix_at(self, time_s: Floats) -> tuple[Floats, Floats]:
        """Latitude and longitude, each (N,), interpolated between sound fixes at these times: what a perfect map can
        know; NaN without fixes."""
        sound = self.is_sound
        if not sound.any():
            return np.full(len(time_s), np.nan), np.full(len(time_s), np.nan)
        latitude, longitude = (
            self.telemetry["latitude_deg"][sound],
            self.telemetry["longitude_deg"][sound],
        )
        true_s = self.true_s[sound]
        return np.interp(time_s, true_s, latitude), np.interp(time_s, true_s, longitude)


def observe(
    path: FlownPath,
    site: LocalFrame,
    started_ns: int,
    settings: SensorSettings,
    format_name: str,
    rng: np.random.Generator,
    at_s: Floats | None = None,
) -> Observation:
    """Sample the flown path as an instrument of this format does.

    `at_s` (N,) samples at these moments, as a camera does for its photos, which carry the fix of `clock_offset_s`
    earlier; else the rate is the settings' or the format's own, on the clock's whole ticks.
    """
    if at_s is None:
        rate_hz = settings.rate_hz or _RATES_HZ[format_name]
        # a table or subtitle track begins with its video; a receiver's log runs on both sides of it
        spare_s = 0.0 if format_name in ("csv", "srt") else 1.0
        ticks = np.arange(
            np.ceil(-spare_s * rate_hz), np.floor((path.duration_s + spare_s) * rate_hz) + 1
        )
        true_s = ticks / rate_hz - settings.clock_offset_s
        true_s = true_s[_outside_gaps(true_s, settings.gaps, path.duration_s, rng)]
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
    columns = {
        "latitude_deg": latitude_deg,
        "longitude_deg": longitude_deg,
        "ellipsoidal_height_m": ellipsoidal_m,
        "orthometric_height_m": ellipsoidal_m - GEOID_HEIGHT_M,
        "height_above_takeoff_m": path.position_m(true_s)[:, 2]
        + rng.standard_normal(count) * _BAROMETER_NOISE_M,
        **_attitudes(path, true_s, settings.attitude_noise_deg, rng),
        **_motion(path, true_s, rng),
    }
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


def _outside_gaps(
    time_s: Floats, gaps: int, duration_s: float, rng: np.random.Generator
) -> NDArray[np.bool_]:
    keep = np.ones(len(time_s), bool)
    for start in rng.uniform(0.1, 0.8, gaps) * duration_s:
        keep &= (time_s < start) | (time_s > start + _GAP_S)
    return keep


def _attitudes(
    path: FlownPath, time_s: Floats, noise_deg: float, rng: np.random.Generator
) -> dict[str, Floats]:
    """The camera's angles as a gimbal reports them, and a body that leans into its speed."""
    turns = rotation_from_vector(np.radians(rng.standard_normal((len(time_s), 3)) * noise_deg))
    camera = np.array(
        [
            gimbal_angles_from_rotation(path.pose(float(t)).rotation @ turn)
            for t, turn in zip(time_s, turns)
        ]
    ).reshape(-1, 3)
    speed_m_s = np.hypot(*path.velocity_m_s(time_s)[:, :2].T)
    lean_deg = -np.degrees(np.arctan(0.012 * speed_m_s))
    jitter = rng.standard_normal((len(time_s), 3)) * max(noise_deg, 0.1)
    return {
        "camera_yaw_deg": camera[:, 0],
        "camera_pitch_deg": camera[:, 1],
        "camera_roll_deg": camera[:, 2],
        "body_yaw_deg": (path.heading_deg(time_s) + jitter[:, 0]) % 360.0,
        "body_pitch_deg": lean_deg + jitter[:, 1],
        "body_roll_deg": jitter[:, 2],
    }


def _motion(path: FlownPath, time_s: Floats, rng: np.random.Generator) -> dict[str, Floats]:
    velocity = path.velocity_m_s(time_s)[:, :2] + rng.standard_normal((len(time_s), 2)) * 0.1
    return {
        "course_deg": np.degrees(np.arctan2(velocity[:, 0], velocity[:, 1])) % 360.0,
        "speed_m_s": np.hypot(velocity[:, 0], velocity[:, 1]),
    }
