"""One flight's telemetry in the site frame, received so far, and predictions from it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from sorvolo.capture.clock_offset import OffsetEstimate, estimate_offset
from sorvolo.capture.photos import PhotoSource
from sorvolo.capture.source import LiveSource, Source
from sorvolo.capture.sync import (
    STARTS_TIED,
    UTC_TIE,
    CameraTrack,
    Clock,
    shifted,
    tie_clocks,
    track_from_telemetry,
)
from sorvolo.capture.video import VideoSource
from sorvolo.errors import InputError
from sorvolo.geometry.arrays import Floats, PointsM
from sorvolo.geometry.camera import Camera
from sorvolo.geometry.geodesy import LocalFrame
from sorvolo.survey.flight import CameraPrior, Notice, Telemetry

# of a flight: the speed of one that hovers would ask for no second frame; by choice
_SLOWEST_M_S = 0.3
_LOWEST_M = 2.0  # above ground: a height of zero, as before take-off, would divide by nothing
_PLACES_ASKED = 200  # of a flight
# how far a clock offset is searched, first and after one was found
_SEARCHED_SIGMAS = 4
_SEARCHED_AGAIN_S = 1.0
_LARGELY = 0.5  # share of samples that have a height: then it is the one that the flight counts in


@dataclass(frozen=True)
class TelemetryWishes:
    """The user's options for a flight's telemetry: seconds to add to the frames' time (None: not given), the ground's
    height in telemetry's own reference (None: not given)."""

    offset_s: float | None = None
    ground_elevation_m: float | None = None


class FlightTelemetry:
    """A flight's telemetry tied to its frames and laid into the site frame. Only `renew` changes it: a live flight's
    goes on.

    `samples` and `track` are of all that is known at first; of a live flight that goes on, of its newest samples: to
    lay two hours anew for each frame takes 20 ms, and ever more memory. What concerns the whole flight asks for all.
    """

    def __init__(
        self, source: Source, samples: Telemetry, frame: LocalFrame, wishes: TelemetryWishes
    ) -> None:
        self._source, self._frame = source, frame
        self.samples, self._offset_s = samples, wishes.offset_s
        self.version = source.telemetry_version if isinstance(source, LiveSource) else 0
        self._ground_m = wishes.ground_elevation_m
        if self._ground_m is None and np.isfinite(source.ground_elevation_m):
            self._ground_m = source.ground_elevation_m
        self.clock = tied_clock(source, samples, wishes.offset_s)
        self.track, notices = self._laid(samples, self.clock)
        self.notices: tuple[Notice, ...] = (*self.clock.notices, *notices)

    def renew(self, time_ns: int) -> None:
        """Take in what a live flight's telemetry has by now, once the fix after `time_ns` came or is late.

        The zero of heights stays where it was, so that all frames are counted from the same.
        """
        source = self._source
        if not isinstance(source, LiveSource):
            return
        source.wait_for_telemetry(time_ns)
        if source.telemetry_version == self.version:
            return
        self.version, self.samples = source.telemetry_version, source.latest_telemetry
        if np.isfinite(self.samples["latitude_deg"]).mean() < _LARGELY:
            # fixes failed for minutes: heights are tied to what was before
            self.samples = source.telemetry
        self.clock = tied_clock(source, self.samples, self._offset_s)
        self.track = _continued(self.track, self._laid(self.samples, self.clock)[0])

    @property
    def height_m(self) -> float:
        """The flight's usual height above the ground."""
        return max(float(np.median(self.track.up_m[self._known])), _LOWEST_M)

    @property
    def usual_sigma_m(self) -> float:
        """The median of the fixes' stated sigma, horizontal."""
        return float(np.nanmedian(self.track.horizontal_sigma_m[self._known]))

    @property
    def speed_m_s(self) -> float:
        """The speed that three quarters of the flight stay below, over steps of a second or more."""
        path_s = self.track.sample_s[self._known]
        path_m = self.track.east_north_m[self._known]
        if len(path_s) < 2:
            return 1.0
        times = np.arange(path_s[0], path_s[-1], max(1.0, float(np.median(np.diff(path_s)))))
        if len(times) < 2:
            return 1.0
        steps = np.column_stack([np.interp(times, path_s, path_m[:, k]) for k in range(2)])
        speeds = np.linalg.norm(np.diff(steps, axis=0), axis=1) / np.diff(times)
        return max(_SLOWEST_M_S, float(np.percentile(speeds, 75)))

    def offset_seen(
        self, seconds: Sequence[float], seen_m: PointsM, applied_s: float
    ) -> OffsetEstimate:
        """The clock offset, beyond `applied_s`, that makes the fixes fit the path seen in the pictures: places (N, 2+)
        at N seconds of the video, NaN where a picture has none. See `estimate_offset`."""
        tied = np.isfinite(seen_m[:, 0])
        reach_s = _SEARCHED_AGAIN_S if applied_s else _SEARCHED_SIGMAS * self.clock.sigma_s
        return estimate_offset(
            shifted(self._whole(), applied_s),
            np.array(seconds)[tied],
            seen_m[tied, :2],
            reach_s=reach_s,
            is_free=self.clock.tie in (UTC_TIE, STARTS_TIED) and not applied_s,
        )

    def prior(self, seconds: float, smooth_s: float) -> CameraPrior:
        """What telemetry gives of the camera at this second of the video. See `CameraTrack.prior`."""
        track = self.track if seconds >= self.track.sample_s[0] else self._whole()
        return track.prior(seconds, smooth_s=smooth_s)

    def priors(
        self, seconds: Sequence[float], offset_s: float, smooth_s: float
    ) -> list[CameraPrior]:
        """What telemetry gives of the camera at these seconds of the video, under another clock offset."""
        moved = shifted(self._whole(), offset_s)
        return [moved.prior(each, smooth_s=smooth_s) for each in seconds]

    def body_headings_deg(self, seconds: Sequence[float], offset_s: float) -> Floats:
        """(N,) the aircraft's own heading as telemetry states it at N seconds of the video, under another clock offset,
        clockwise from north; NaN where it largely states none."""
        stated = self.samples["body_yaw_deg"]
        known = np.isfinite(stated)
        if known.mean() < _LARGELY:
            return np.full(len(seconds), np.nan)
        pointing = np.exp(1j * np.radians(stated[known]))
        times_s = shifted(self.track, offset_s).sample_s[known]
        return np.degrees(np.angle(np.interp(seconds, times_s, pointing))) % 360.0

    def ground_height(self, ground_up_m: float) -> tuple[float, str]:
        """The height of ground that lies at `ground_up_m` by the track's heights, in telemetry's reference; which that
        is. 0 "above ground" where telemetry has heights above take-off alone."""
        for column, stated in (
            ("ellipsoidal_height_m", "ellipsoidal"),
            ("orthometric_height_m", "orthometric"),
        ):
            heights = self.samples[column]
            if np.isfinite(heights).mean() > _LARGELY:
                return float(np.nanmedian(heights - self.track.up_m)) + ground_up_m, stated
        return 0.0, "above ground"

    @property
    def knows_ground(self) -> bool:
        """Whether the zero of heights is known to be the ground, however well."""
        return bool(np.isfinite(self.track.altitude_offset_sigma_m))

    def _whole(self) -> CameraTrack:
        """The track of all samples so far, its heights counted from the same zero."""
        source = self._source
        if not isinstance(source, LiveSource) or len(samples := source.telemetry) == len(
            self.samples
        ):
            return self.track
        found, _ = self._laid(samples, tied_clock(source, samples, self._offset_s))
        return _continued(self.track, found)

    def _laid(self, samples: Telemetry, clock: Clock) -> tuple[CameraTrack, tuple[Notice, ...]]:
        """The samples in the site frame; photos' own fixes where they are by the given delay."""
        track, notices = track_from_telemetry(
            samples, clock, self._frame, ground_elevation_m=self._ground_m
        )
        delay_s = (self._offset_s or 0.0) if clock.is_per_photo else 0.0
        return (shifted(track, delay_s) if delay_s else track), notices

    @property
    def _known(self) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
        return np.isfinite(self.track.east_north_m[:, 0])


def duration_s(source: Source) -> float:
    """How long a video lasts, s; 0 for photos."""
    return source.frame_count / source.frame_rate_hz if source.frame_rate_hz > 0 else 0.0


def frame_times_s(source: Source) -> Floats:
    """(N,) when photos were taken, or each second of a video and its end, after the first frame."""
    if isinstance(source, PhotoSource):
        times_ns = np.array([photo.time_ns for photo in source.album.photos])
        return (times_ns - times_ns[0]) / 1e9
    seconds = duration_s(source)
    return np.append(np.arange(0.0, seconds, 1.0), seconds)


def tied_clock(source: Source, samples: Telemetry, offset_s: float | None = None) -> Clock:
    """How telemetry's samples are tied to a source's frames. See `tie_clocks`; a live source ties its own itself."""
    if isinstance(source, LiveSource):
        is_per_photo = source.kind == "photos"
        shift_s = 0.0 if is_per_photo else offset_s or 0.0
        return Clock(
            (samples.time_ns - source.start_ns) / 1e9 - shift_s,
            source.telemetry_tie,
            source.telemetry_sigma_s,
            source.start_ns,
            is_per_photo=is_per_photo,
        )
    doubt = source.start_doubt if isinstance(source, VideoSource) else ""
    if doubt and offset_s is None and not (samples.video_time_ns >= 0).all():
        raise InputError(doubt)
    return tie_clocks(
        samples,
        frame_times_s(source),
        kind=source.kind,
        start_ns=source.start_ns,
        offset_s=offset_s,
        name=source.name,
    )


def distance_m(track: CameraTrack, ground_m: PointsM | None) -> float:
    """How near the flight comes to any of these places, (N, 2) site metres; None: to the site's origin."""
    ground_m = np.zeros((1, 2)) if ground_m is None else ground_m
    known = track.east_north_m[np.isfinite(track.east_north_m[:, 0])]
    some = known[:: -(-len(known) // _PLACES_ASKED)]
    return min(float(np.hypot(*(ground_m - place).T).min()) for place in some)


def local_prior(camera: Camera, *, first: bool) -> CameraPrior:
    """Without telemetry the first frame defines the frame: one unit is one of its pixels, its top is "north"."""
    rotation = np.diag([1.0, -1.0, -1.0])
    position_m = np.array([0.0, 0.0, camera.fx_px])
    sigma = np.full(3, 1e-3 * camera.fx_px) if first else np.full(3, np.inf)
    attitude = np.array([4.0, 4.0, 0.1]) if first else np.array([12.0, 12.0, np.inf])
    return CameraPrior(position_m, sigma, rotation, attitude, source="no telemetry")


def _continued(before: CameraTrack, now: CameraTrack) -> CameraTrack:
    """The track as it is known now, its heights counted from the same zero as before."""
    same_m = np.interp(before.sample_s, now.sample_s, now.up_m)
    return replace(
        now,
        up_m=now.up_m + np.median(before.up_m - same_m),
        height_kind=before.height_kind,
        ground_words=before.ground_words,
        vertical_sigma_m=before.vertical_sigma_m,
        altitude_offset_sigma_m=before.altitude_offset_sigma_m,
    )
