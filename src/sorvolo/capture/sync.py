"""Frames and telemetry on one clock: the tie, and telemetry at a frame's time."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from functools import cached_property

import numpy as np

from sorvolo.errors import InputError
from sorvolo.geometry.arrays import Floats, Mask, Matrix3, PointsM, Rows, Vector3
from sorvolo.geometry.geodesy import Geodetic, LocalFrame
from sorvolo.geometry.pose import (
    rotation_between,
    site_from_body_nadir_rotation,
    site_from_gimbal_rotation,
)
from sorvolo.geometry.summary import median_or_nan
from sorvolo.geometry.track import known_points
from sorvolo.geometry.units import DAY_NS
from sorvolo.survey.flight import CameraPrior, Notice, Telemetry
from sorvolo.survey.wording import span_words

PHOTO_TIE = "each photo carries its own fix"
UTC_TIE = "both carry UTC"
FIX_DELAY_S = 0.25
"""How far apart a photo's exposure and the fix that it carries lie, 1 sigma: receivers lag, and shutters wait.

Measured on a senseFly survey of 2013: 0.35 s, which is 3 to 5 m at its speed.
"""
UNSURE_CLOCK_S = 1.0
"""1 sigma of a tie that the motion has to confirm; by choice."""
DEFAULT_HORIZONTAL_SIGMA_M = 1.5  # the thesis's DJI Phantom 3, section 2.2
_LONGEST_DELAY_S = 4 * FIX_DELAY_S  # that a photo's own fix is moved along the flight's path
STARTS_TIED = "first sample tied to first frame"
# by which clocks are set to a wrong time zone, the commonest first ...
_ZONES_S = (
    3600,
    1800,
    900,
)
_FARTHEST_ZONE_S = 14 * 3600  # ... and by how much at most
_STILL_M = 0.01  # fixes no farther apart are the same again and again
DATED_NS = 3650 * 86_400 * 10**9
"""Ten years after 1970: an earlier clock was never set."""


class HeightKind(StrEnum):
    """What telemetry counts its heights from."""

    ABOVE_TAKEOFF = "above take-off"
    ORTHOMETRIC = "orthometric"
    ELLIPSOIDAL = "ellipsoidal"
    NONE = "none"


_HEIGHTS = (
    ("height_above_takeoff_m", HeightKind.ABOVE_TAKEOFF, 1.0),
    ("orthometric_height_m", HeightKind.ORTHOMETRIC, 3.0),
    ("ellipsoidal_height_m", HeightKind.ELLIPSOIDAL, 3.0),
)


@dataclass(frozen=True)
class Clock:
    """How the frames' clock is tied to telemetry's: telemetry time = frame time + the given offset (+ the tie itself).

    `sample_s` are the samples on the frames' clock, seconds since the first frame; `sigma_s` is how far off the tie may
    be. `is_per_photo`: each frame carries its own fix and attitude, so that nothing is interpolated.
    """

    sample_s: Floats
    tie: str
    sigma_s: float
    first_frame_utc_ns: int
    notices: tuple[Notice, ...] = ()
    is_per_photo: bool = False
    covered_share: float = 1.0  # of the frames' time, by the fixes


def tie_clocks(
    telemetry: Telemetry,
    frames_s: Floats,
    *,
    kind: str,
    start_ns: int,
    offset_s: float | None = None,
    name: str = "",
) -> Clock:
    """Put telemetry's samples on the clock of the frames, which were taken at `frames_s` (N,) after the first one.

    How a fix belongs to a frame follows from where it comes from. A photo's own fix is that photo's. A video's subtitles
    count from its first frame. Of a log, UTC decides where frames and log have a date, or the log a time of day at
    which the frames were taken; else its first sample is tied to the first frame. `offset_s` is telemetry's time less
    the frames'.
    Raises InputError where frames and fixes have no time in common, with the offset that would tie them.
    """
    first_ns, given_s = int(telemetry.time_ns[0]), offset_s or 0.0
    given_ns, has_fix = round(given_s * 1e9), np.isfinite(telemetry["latitude_deg"])
    # a log whose clock has no date is stamped from 1970: the pictures' day may be its own
    days_ns = (
        round((start_ns - first_ns) / DAY_NS) * DAY_NS if first_ns < DATED_NS < start_ns else 0
    )
    since_start_s = (telemetry.time_ns + days_ns - start_ns) / 1e9
    is_of_day = days_ns > 0 and _covered(since_start_s[has_fix] - given_s, frames_s).mean() > 0.5
    if telemetry.is_per_photo:
        if abs(given_s) > _LONGEST_DELAY_S:
            raise InputError(
                f"{name}: each photo carries its own fix, which --offset {given_s:g} cannot belong to; leave --offset out, "
                "or give the flight's log with --telemetry"
            )
        return Clock(since_start_s, PHOTO_TIE, FIX_DELAY_S, start_ns, is_per_photo=True)
    if kind == "photos" and not start_ns:
        raise InputError(
            f"{name}: the photos state no time, so that a log cannot be matched to them; give photos whose EXIF has their "
            "time"
        )
    if kind == "video" and (telemetry.video_time_ns >= 0).all():
        zero_ns = int(np.median(telemetry.time_ns - telemetry.video_time_ns)) + given_ns
        zero_ns = start_ns if zero_ns < DATED_NS else zero_ns  # without a date, as below
        words = "telemetry counts from the video's first frame"
        clock = Clock(telemetry.video_time_ns / 1e9 - given_s, words, 0.5, zero_ns)
    elif min(first_ns, start_ns) > DATED_NS or is_of_day:
        clock = Clock(since_start_s - given_s, UTC_TIE, 2.0, start_ns + given_ns)
    else:
        # then the video's own start dates it
        zero_ns = start_ns if first_ns < DATED_NS else first_ns + given_ns
        since_first_s = (telemetry.time_ns - first_ns) / 1e9
        clock = Clock(since_first_s - given_s, STARTS_TIED, 3.0, zero_ns)
    fix_s = clock.sample_s[has_fix]
    covered = _covered(fix_s if len(fix_s) else clock.sample_s, frames_s)
    if not covered.any():
        raise InputError(f"{name}: {_no_time_in_common(fix_s, frames_s, given_s)}")
    share = float(covered.mean())
    if share > 0.98:
        return clock
    text = f"the telemetry covers {100 * share:.0f} % of the frames' time: the others are placed by their overlap alone"
    notice = Notice("partly_covered", int((~covered).sum()), text)
    return replace(clock, notices=(notice,), covered_share=share)


def _covered(fix_s: Floats, frames_s: Floats) -> Mask:
    """(N,) whether each of N moments is within the M fixes, (M,) s, and in none of their gaps."""
    interval_s = float(np.median(np.diff(fix_s))) if len(fix_s) > 1 else 1.0
    after = np.searchsorted(fix_s, frames_s)
    before, at = np.maximum(after - 1, 0), np.minimum(after, len(fix_s) - 1)
    gap_s = fix_s[at] - fix_s[before]
    beyond_s = np.minimum(abs(frames_s - fix_s[before]), abs(frames_s - fix_s[at]))
    is_inside = (gap_s > 0) & (gap_s <= max(4 * interval_s, 3.0))
    return is_inside | (beyond_s <= 1.5 * interval_s + 0.5)


def _no_time_in_common(fix_s: Floats, frames_s: Floats, given_s: float) -> str:
    """By how much pictures and log are apart, and the `--offset` that would tie them: a time zone's if one does."""
    lead_s = float(fix_s[0])
    way = "after" if lead_s > 0 else "before"
    under = f" with --offset {given_s:g}" if given_s else ""
    found = (
        f"the telemetry and the pictures have no time in common{under}: the log begins {span_words(abs(lead_s))} {way} "
        "the pictures"
    )
    for step_s in _ZONES_S:
        zones_s = np.arange(-_FARTHEST_ZONE_S, _FARTHEST_ZONE_S + 1, step_s)
        shares = [float(_covered(fix_s - zone_s, frames_s).mean()) for zone_s in zones_s]
        best = max(range(len(zones_s)), key=lambda k: (shares[k], -abs(zones_s[k])))
        if shares[best] > 0.5:
            tied_s = given_s + float(zones_s[best])
            side = "behind" if tied_s > 0 else "ahead of"
            return (
                f"{found}; give --offset {tied_s:g} if the camera's clock is {span_words(abs(tied_s))} {side} the log's "
                "(a time zone), or give the log of this flight"
            )
    return (
        f"{found}; give the log of this flight, or --offset {round(given_s + lead_s, 2):.10g} if both began together and a "
        "clock was wrong"
    )


@dataclass(frozen=True, eq=False)
class CameraTrack:
    """One flight's telemetry in the site frame, ready to be asked for any moment.

    `up_m` is above the site's ground as telemetry has it; `altitude_offset_sigma_m` is how well the zero of that
    height is known to be the ground (infinite: only differences count).
    """

    sample_s: Floats
    east_north_m: PointsM
    up_m: Floats
    horizontal_sigma_m: Floats
    vertical_sigma_m: float
    altitude_offset_sigma_m: float
    height_kind: HeightKind
    ground_words: str  # what is taken for the ground
    angles_deg: Floats  # (N, 3) yaw, pitch, roll of the camera if known, else the body; NaN where not stated
    attitude: str  # "gimbal" | "body" | "none"
    stated_sigma_deg: tuple[float, float]  # of tilt and heading, NaN where the source states none
    interval_s: float
    longest_gap_s: float = field(default=3.0)

    @property
    def is_still(self) -> bool:
        """Whether all fixes are one place: the drone hovered, or its receiver had stopped."""
        known_m = known_points(self.east_north_m)
        return len(known_m) > 0 and bool(np.ptp(known_m, axis=0).max() < _STILL_M)

    @property
    def height_words(self) -> str:
        """What heights are counted from, and what is taken for the ground."""
        return f"{self.height_kind}, {self.ground_words}"

    def climb_after_m(self, seconds: Sequence[float]) -> float:
        """By how much its usual height is above that at these seconds of the frames' clock; 0 where one is unknown."""
        known = np.isfinite(self.up_m)
        if not known.any() or not len(seconds):
            return 0.0
        then_m = np.interp(seconds, self.sample_s[known], self.up_m[known])
        return float(np.median(self.up_m[known]) - np.median(then_m))

    def prior(self, time_s: float, *, smooth_s: float = 0.0) -> CameraPrior:
        """The camera's position and attitude from telemetry at `time_s` on the frames' clock.

        Between fixes it is linear (eq. 3.18).

        `smooth_s`: fixes within this time to both sides are averaged by a straight line, which uses every one of a
        fast receiver's fixes. Beyond a gap or the ends by more than the receiver's interval, nothing is known.
        """
        place, sigma_m, velocity = self._place(time_s, smooth_s)
        rotation, sigma_deg, words = self._attitude(time_s, velocity)
        known = np.isfinite(place) & ~(
            self._is_below_ground(place[2]) & np.array([False, False, True])
        )
        sigma = np.where(known, sigma_m, np.inf)
        return CameraPrior(
            np.where(known, place, self._nearest(time_s)),
            sigma,
            rotation,
            sigma_deg,
            np.nan_to_num(velocity),
            f"{'GPS' if known[0] else 'no fix'}, {words}",
        )

    def _place(self, time_s: float, smooth_s: float) -> tuple[Vector3, Vector3, Vector3]:
        unknown = np.full(3, np.nan)
        good = np.flatnonzero(np.isfinite(self.east_north_m[:, 0]))
        if not len(good):
            return unknown, unknown, unknown
        times = self.sample_s[good]
        around = self._fixes_around(times, time_s)
        if around is None:
            return unknown, unknown, unknown
        before, after = around
        chosen = np.arange(before, after + 1)
        if smooth_s > 0:
            near = np.flatnonzero(np.abs(times - time_s) <= smooth_s)
            chosen = near if len(near) >= 3 else chosen
        rows = good[chosen]
        values = np.column_stack([self.east_north_m[rows], self.up_m[rows]])
        place, velocity, gain = _line(times[chosen] - time_s, values)
        sigma_h = float(np.median(self.horizontal_sigma_m[rows]))
        if (
            smooth_s == 0
            and times[before] < time_s < times[after]
            and times[after] - times[before] > 1.5
        ):
            # between fixes that lie far apart the path is a guess, and between photos there may be a turn
            sigma_h += (0.15 if self.interval_s else 0.4) * float(
                np.linalg.norm(np.diff(values[[0, -1], :2], axis=0))
            )
        # neighbouring fixes err alike, so averaging many never helps by more than a factor of two
        shrink = max(gain, 0.5)
        return place, np.array([sigma_h, sigma_h, self.vertical_sigma_m]) * shrink, velocity

    def _fixes_around(self, times: Floats, time_s: float) -> tuple[int, int] | None:
        """The fixes before and after a moment, at the ends the last two; None in a gap and too far beyond the ends."""
        after = int(np.searchsorted(times, time_s))
        if 0 < after < len(times):
            is_gap = times[after] - times[after - 1] > self.longest_gap_s and times[after] != time_s
            return None if is_gap else (after - 1, after)
        edge = min(after, len(times) - 1)
        if abs(times[edge] - time_s) > max(1.5 * self.interval_s, 0.3):
            return None
        return (edge - 1, edge) if edge > 0 else (0, min(1, len(times) - 1))

    def _nearest(self, time_s: float) -> Vector3:
        """The fix nearest in time: where to begin the search for a frame of unknown place."""
        good = np.flatnonzero(np.isfinite(self.east_north_m[:, 0]))
        if not len(good):
            return np.array([0.0, 0.0, 40.0])
        row = good[int(np.argmin(np.abs(self.sample_s[good] - time_s)))]
        above = self.up_m[self.up_m > 0]
        usual_m = (
            float(np.median(above)) if self._is_below_ground(self.up_m[row]) and len(above) else 1.0
        )
        return np.array([*self.east_north_m[row], max(self.up_m[row], usual_m)])

    def _is_below_ground(self, up_m: float) -> bool:
        """Whether a height whose zero is not known to be the ground cannot be right: it counts as unknown."""
        return bool(up_m <= 0 and not np.isfinite(self.altitude_offset_sigma_m))

    def _attitude(self, time_s: float, velocity_m_s: Vector3) -> tuple[Floats, Floats, str]:
        if self.attitude != "none" and self.sample_s[0] - 2 <= time_s <= self.sample_s[-1] + 2:
            if self.attitude == "gimbal":
                return self._stated_rotation(time_s), self._sigma_deg(2.0, 4.0), "gimbal attitude"
            words = "body attitude, camera taken as fixed straight down"
            return self._stated_rotation(time_s), self._sigma_deg(5.0, 8.0), words
        course_deg = 0.0
        words = "no attitude: camera taken as looking down"
        if np.isfinite(velocity_m_s[:2]).all() and np.hypot(*velocity_m_s[:2]) > 0.5:
            course_deg = float(np.degrees(np.arctan2(velocity_m_s[0], velocity_m_s[1])))
            words += ", image top taken as the course"
        return (
            site_from_gimbal_rotation(course_deg, -90.0, 0.0),
            np.array([12.0, 12.0, np.inf]),
            words,
        )

    def _stated_rotation(self, time_s: float) -> Matrix3:
        """site_from_camera between the stated samples, by the shortest turn; beyond them that of the nearest.

        Angles are not interpolated one by one: straight down, yaw and roll may both swing by half a turn where the
        camera stands still.
        """
        known, times = self._stated
        after = min(int(np.searchsorted(times, time_s)), len(known) - 1)
        before = max(after - 1, 0)
        turned = (
            site_from_gimbal_rotation
            if self.attitude == "gimbal"
            else site_from_body_nadir_rotation
        )
        last = turned(*self.angles_deg[known[after]])
        passed_s = times[after] - times[before]
        share = (
            float(np.clip((time_s - times[before]) / passed_s, 0.0, 1.0)) if passed_s > 0 else 1.0
        )
        if share == 1.0:
            return last
        return rotation_between(turned(*self.angles_deg[known[before]]), last, share)

    @cached_property
    def _stated(self) -> tuple[Rows, Floats]:
        """The samples that state angles, and their times, s."""
        known = np.flatnonzero(np.isfinite(self.angles_deg[:, 0]))
        return known, self.sample_s[known]

    def _sigma_deg(self, usual_tilt: float, usual_heading: float) -> Vector3:
        """Sigmas about the camera's x, y, z axes: as stated, else what such sources usually reach."""
        tilt, heading = (
            max(stated, 0.1) if np.isfinite(stated) else usual
            for stated, usual in zip(self.stated_sigma_deg, (usual_tilt, usual_heading))
        )
        return np.array([tilt, tilt, heading])


def track_from_telemetry(
    telemetry: Telemetry,
    clock: Clock,
    frame: LocalFrame,
    *,
    ground_elevation_m: float | None = None,
) -> tuple[CameraTrack, tuple[Notice, ...]]:
    """Telemetry in the site frame. `ground_elevation_m` is the ground's height in telemetry's own height reference."""
    up_m, kind, ground, vertical_sigma_m, offset_sigma_m, notices = _heights(
        telemetry, ground_elevation_m
    )
    latitude, longitude = telemetry["latitude_deg"], telemetry["longitude_deg"]
    known = np.isfinite(latitude) & np.isfinite(longitude)
    east_north = np.full((len(telemetry), 2), np.nan)
    # the plane of the site: a drone's own height moves east and north by 1 part in 100,000 only
    east_north[known] = frame.site_from_wgs84(
        latitude[known], longitude[known], np.full(int(known.sum()), frame.origin.height_m)
    )[:, :2]
    sigma = telemetry["horizontal_sigma_m"]
    sigma = np.where(np.isfinite(sigma), sigma, DEFAULT_HORIZONTAL_SIGMA_M)
    attitude, angles = _angles(telemetry)
    times = clock.sample_s[known]
    interval_s = float(np.median(np.diff(times))) if len(times) > 1 else 1.0
    changes = np.any(np.diff(east_north[known], axis=0) != 0, axis=1)
    # a 1 Hz fix repeated at frame rate is still a 1 Hz fix
    if not clock.is_per_photo and changes.any():
        moments = times[1:][changes]
        interval_s = max(
            interval_s, float(np.median(np.diff(moments))) if len(moments) > 1 else interval_s
        )
        keep = np.flatnonzero(known)[1:][~changes]
        if interval_s > 1.8 * float(np.median(np.diff(times))):
            east_north[keep] = np.nan
    gap_s = np.inf if clock.is_per_photo else max(4 * interval_s, 3.0)
    if clock.is_per_photo:
        interval_s = 0.0
    track = CameraTrack(
        clock.sample_s,
        east_north,
        up_m,
        sigma,
        vertical_sigma_m,
        offset_sigma_m,
        kind,
        ground,
        angles,
        attitude,
        (median_or_nan(telemetry["tilt_sigma_deg"]), median_or_nan(telemetry["heading_sigma_deg"])),
        interval_s,
        gap_s,
    )
    return track, notices


def shifted(track: CameraTrack, offset_s: float) -> CameraTrack:
    """The track with telemetry time = frame time + offset_s.

    Photos keep their own attitude. Their fixes came late by `offset_s`, about a second at most: each is where the
    path of all fixes is that much later, and is trusted less where the path bends.
    """
    if track.interval_s:
        return replace(track, sample_s=track.sample_s - offset_s)
    known = np.flatnonzero(np.isfinite(track.east_north_m[:, 0]))
    if len(known) < 2:
        return track
    times_s, places_m = track.sample_s[known], track.east_north_m[known]
    legs_m_s = np.diff(places_m, axis=0) / np.diff(times_s)[:, None]
    before, after = np.vstack([legs_m_s[:1], legs_m_s]), np.vstack([legs_m_s, legs_m_s[-1:]])
    moved_m, sigma_m = track.east_north_m.copy(), track.horizontal_sigma_m.copy()
    moved_m[known] = places_m + offset_s * (after if offset_s > 0 else before)
    bend_m = offset_s * np.linalg.norm(after - before, axis=1) / 2
    sigma_m[known] = np.hypot(sigma_m[known], bend_m)
    return replace(track, east_north_m=moved_m, horizontal_sigma_m=sigma_m)


def site_origin(telemetry: Telemetry) -> Geodetic | None:
    """The first fix of the flight, rounded to a thousandth of an arc second; None without any."""
    known = np.flatnonzero(np.isfinite(telemetry["latitude_deg"]))
    if not len(known):
        return None
    middle = known[0]
    return Geodetic(
        round(float(telemetry["latitude_deg"][middle]), 7),
        round(float(telemetry["longitude_deg"][middle]), 7),
        0.0,
    )


def _line(times_s: Floats, values: Floats) -> tuple[Floats, Floats, float]:
    """Value and slope at time 0 of the straight line through samples, and how much it shrinks their noise."""
    if len(times_s) == 1 or np.ptp(times_s) <= 0:
        return values.mean(axis=0), np.full(values.shape[1], np.nan), 1.0
    centred = times_s - times_s.mean()
    slope = (centred[:, None] * (values - values.mean(axis=0))).sum(0) / (centred**2).sum()
    variance = 1 / len(times_s) + times_s.mean() ** 2 / (centred**2).sum()
    return values.mean(axis=0) - slope * times_s.mean(), slope, float(np.sqrt(variance))


def _heights(
    telemetry: Telemetry, ground_elevation_m: float | None
) -> tuple[Floats, HeightKind, str, float, float, tuple[Notice, ...]]:
    """Return heights above the site's ground, (N,), m; what they count from; what is taken for the ground, in words;
    the sigmas of heights and of their zero, m; and notices."""
    notices: list[Notice] = []
    for column, kind, sigma_m in _HEIGHTS:
        values = telemetry[column]
        known = np.isfinite(values)
        if known.mean() < 0.5 if len(values) else True:
            continue
        stated = telemetry["vertical_sigma_m"]
        sigma_m = float(np.nanmedian(stated)) if np.isfinite(stated).any() else sigma_m
        filled = np.interp(np.arange(len(values)), np.flatnonzero(known), values[known])
        typical = float(np.median(filled))
        if ground_elevation_m is not None:
            up_m = filled - ground_elevation_m
            return up_m, kind, "ground given", sigma_m, 0.5, tuple(notices)
        if kind is HeightKind.ABOVE_TAKEOFF:
            if typical < 0.5:
                text = f"height above take-off is {typical:.1f} m for most of the flight: not used"
                notices.append(Notice("height_of_zero", int(known.sum()), text))
                continue
            words = "ground taken to be at take-off level"
            return filled, kind, words, sigma_m, 1.0, tuple(notices)
        first = float(np.median(filled[: max(1, min(5, len(filled)))]))
        if typical - first > 4.0 and first - float(filled.min()) < 2.0:
            words = "ground taken to be where the telemetry begins"
            return filled - first, kind, words, sigma_m, 2.0, tuple(notices)
        text = f"heights are {kind} and the ground's is unknown: the height above ground is found from the pictures"
        notices.append(Notice("ground_unknown", 1, text))
        words = "ground found from the pictures"
        return filled - typical + 40.0, kind, words, sigma_m, np.inf, tuple(notices)
    text = "telemetry has no height: it is found from the pictures and GPS"
    notices.append(Notice("height_unknown", 1, text))
    up_m = np.full(len(telemetry), 40.0)
    return up_m, HeightKind.NONE, "found from the pictures", np.inf, np.inf, tuple(notices)


def _angles(telemetry: Telemetry) -> tuple[str, Floats]:
    """Whose angles are stated, and these: (N, 3) yaw, pitch, roll, deg; NaN where a sample states none."""
    for kind, prefix in (("gimbal", "camera"), ("body", "body")):
        angles = np.column_stack(
            [telemetry[f"{prefix}_{name}_deg"] for name in ("yaw", "pitch", "roll")]
        )
        known = np.isfinite(angles[:, :2]).all(axis=1)
        if len(telemetry) and known.mean() > 0.5:
            angles[:, 2] = np.where(np.isfinite(angles[:, 2]), angles[:, 2], 0.0)
            angles[~known] = np.nan
            return kind, angles
    return "none", np.full((len(telemetry), 3), np.nan)
