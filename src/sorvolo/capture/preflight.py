"""What a flight's inputs hold, before it is mapped: its pictures, its telemetry, and how it was flown."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sorvolo.capture.flight_telemetry import tied_clock
from sorvolo.capture.live.stream import LiveStream
from sorvolo.capture.photos import PhotoSource
from sorvolo.capture.source import LiveSource, Source
from sorvolo.capture.sync import STARTS_TIED
from sorvolo.capture.video import VideoSource
from sorvolo.errors import InputError
from sorvolo.geometry.arrays import Floats, PointsM
from sorvolo.geometry.camera import Camera
from sorvolo.geometry.geodesy import Geodetic, LocalFrame
from sorvolo.geometry.planning import footprint_size_m, minimum_frame_rate, px_per_m
from sorvolo.geometry.summary import median_or_nan
from sorvolo.geometry.track import find_strips, length_m, speeds_m_s
from sorvolo.geometry.units import SECOND_NS
from sorvolo.registration.features import sharpness_and_texture
from sorvolo.registration.place_search import shared_view
from sorvolo.survey.flight import Frame, Telemetry

WANTED_OVERLAP = 0.7
"""Of consecutive frames, for a good map."""

_MOVING_M_S = 0.5  # slower is hovering; by choice
_FEWEST_SAMPLES = 3  # different places: two make no track


@dataclass(frozen=True)
class FrameFacts:
    """The pictures. `rate_hz` is NaN for photos, `interval_s` NaN for videos; `start_ns` is 0 if unknown.

    `sharpness` and `texture_levels` (the spread of gray about its surroundings) are medians over a few. `shared_view`
    is the least share of the first of these few that each other one shows, NaN for photos.
    """

    count: int
    rate_hz: float
    interval_s: float
    duration_s: float
    width_px: int
    height_px: int
    codec: str
    container: str
    size_bytes: int
    start_ns: int
    start_origin: str
    sharpness: float
    texture_levels: float
    shared_view: float


@dataclass(frozen=True)
class TelemetryFacts:
    """The telemetry. `tie` states how it belongs to the frames, `covered_s` how long both run, NaN if unknown; `apart`
    is why they do not belong together, "" where they do."""

    format: str
    samples: int
    positions: int
    rate_hz: float
    longest_gap_s: float
    start_ns: int
    end_ns: int
    tie: str
    covered_s: float
    apart: str = ""


@dataclass(frozen=True)
class FlightFacts:
    """The flight, as far as telemetry and camera give it; NaN elsewhere.

    `height_reference` is what `height_m` is counted from. `forward_overlap` is that of consecutive photos;
    `frame_interval_s` the longest time between two frames that keeps 70 % overlap (eqs 3.16-3.17).
    """

    height_m: float
    height_spread_m: float
    height_reference: str
    speed_m_s: float
    distance_m: float
    gsd_m: float
    footprint_m: tuple[float, float]
    forward_overlap: float
    frame_interval_s: float
    strips: int
    side_overlap: float
    camera_pitch_deg: float


def frame_facts(source: Source, samples: Sequence[Frame]) -> FrameFacts:
    """What a source's header and a few of its frames, spread over the flight, show of its pictures."""
    camera = source.camera.camera
    seen = [sharpness_and_texture(frame.image) for frame in samples]
    sharp, texture = np.median(seen, axis=0).tolist() if seen else (math.nan, math.nan)
    codec, container, size = _file_facts(source)
    times_s = _times_s(source, samples)
    is_video = isinstance(source, VideoSource)
    return FrameFacts(
        source.frame_count,
        source.frame_rate_hz,
        median_or_nan(np.diff(times_s)) if source.kind == "photos" else math.nan,
        float(np.ptp(times_s)) if len(times_s) else math.nan,
        camera.width_px,
        camera.height_px,
        codec,
        container,
        size,
        source.start_ns,
        source.start_origin,
        sharp,
        texture,
        _shared_view(samples) if is_video else math.nan,
    )


def _file_facts(source: Source) -> tuple[str, str, int]:
    """Codec or endings, container, and bytes; "" and 0 for what is not known."""
    if isinstance(source, VideoSource):
        return source.info.codec, source.info.container, source.info.path.stat().st_size
    if isinstance(source, LiveStream):
        return source.facts.codec, source.facts.container, 0
    if not isinstance(source, PhotoSource):
        return "", "", 0
    photos = source.album.photos
    suffixes = ", ".join(sorted({photo.path.suffix.lower().lstrip(".") for photo in photos}))
    return suffixes, "", sum(photo.path.stat().st_size for photo in photos)


def _times_s(source: Source, samples: Sequence[Frame]) -> Floats:
    """(N,) when photos were taken, a live source's samples came, or a video begins and ends; none of others."""
    if isinstance(source, LiveSource):
        return np.array([frame.time_ns for frame in samples]) / SECOND_NS
    if isinstance(source, PhotoSource):
        return np.array([photo.time_ns for photo in source.album.photos]) / SECOND_NS
    return np.array([0.0, source.info.duration_s] if isinstance(source, VideoSource) else [])


def _shared_view(samples: Sequence[Frame]) -> float:
    """The least share of the first sample that another one shows; 0 where one shows none.

    NaN where fewer than three are of different times, as in a video with few whole pictures to seek to.
    """
    different = list({frame.index: frame for frame in samples}.values())
    if len(different) < _FEWEST_SAMPLES:
        return math.nan
    shares: list[float] = []
    for other in different[1:]:
        shares.append(shared_view(different[0].image, other.image))
        if not shares[-1] > 0:
            return 0.0
    return min(shares)


def telemetry_facts(source: Source, frames: FrameFacts) -> TelemetryFacts:
    """What the telemetry holds, and how it fits the frames in time."""
    telemetry = source.telemetry
    placed = telemetry.time_ns[np.isfinite(telemetry["latitude_deg"])]
    steps_s = np.diff(placed) / SECOND_NS
    tie, covered_s, apart = _tie(source, frames)
    return TelemetryFacts(
        telemetry.format,
        len(telemetry),
        len(placed),
        1 / float(np.median(steps_s)) if len(steps_s) else math.nan,
        float(steps_s.max(initial=0.0)),
        int(telemetry.time_ns[0]) if len(telemetry) else 0,
        int(telemetry.time_ns[-1]) if len(telemetry) else 0,
        tie,
        covered_s,
        apart,
    )


def _tie(source: Source, frames: FrameFacts) -> tuple[str, float, str]:
    """How telemetry and frames belong together, for how many seconds both run, and why they do not belong together."""
    telemetry = source.telemetry
    if not telemetry.has_fixes:
        return "no telemetry", math.nan, ""
    try:
        clock = tied_clock(source, telemetry)
    except InputError as error:
        return "none", 0.0, f"{error}".removeprefix(f"{source.name}: ")
    if clock.tie == STARTS_TIED:
        lack = (
            "the telemetry has no date"
            if source.start_ns
            else "the video does not state when it began"
        )
        return f"unknown: {lack}", math.nan, ""
    return clock.tie, clock.covered_share * frames.duration_s, ""


def while_filming(source: Source, frames: FrameFacts) -> Telemetry:
    """The telemetry between the first and the last frame; all of it where that is unknown."""
    telemetry = source.telemetry
    duration_ns = round(frames.duration_s * SECOND_NS) if frames.duration_s > 0 else 0
    since_start_ns = telemetry.video_time_ns
    if not (since_start_ns >= 0).any() and source.start_ns:
        since_start_ns = telemetry.time_ns - source.start_ns
    during = (since_start_ns >= 0) & (since_start_ns <= duration_ns)
    if source.kind != "video" or not np.isfinite(telemetry["latitude_deg"][during]).any():
        return telemetry
    columns = {name: values[during] for name, values in telemetry.columns.items()}
    return Telemetry(
        telemetry.format, telemetry.time_ns[during], columns, notices=telemetry.notices
    )


def flight_facts(telemetry: Telemetry, camera: Camera, frames: FrameFacts) -> FlightFacts:
    """How the drone flew while it filmed, as far as telemetry and camera give it."""
    placed = np.isfinite(telemetry["latitude_deg"])
    points_m = _track_m(telemetry["latitude_deg"][placed], telemetry["longitude_deg"][placed])
    times_s = (telemetry.time_ns[placed] - telemetry.time_ns[placed][:1]) / SECOND_NS
    height_m, spread_m, reference = _height(telemetry)
    speed_m_s = _speed(telemetry, points_m, times_s)
    footprint_m, gsd_m = (math.nan, math.nan), math.nan
    interval_s = forward = side = math.nan
    strips = find_strips(points_m)
    if height_m > 0.5:
        footprint_m = footprint_size_m(camera, height_m)
        gsd_m = 1 / px_per_m(height_m, camera.fx_px)
        across_m, along_m = _across_and_along(footprint_m, telemetry, strips.bearing_deg)
        if speed_m_s > _MOVING_M_S:
            interval_s = 1 / minimum_frame_rate(speed_m_s, along_m, WANTED_OVERLAP)
        if math.isnan(frames.rate_hz) and len(points_m) > 1:
            steps_m = np.linalg.norm(np.diff(points_m, axis=0), axis=1)
            forward = max(0.0, 1 - float(np.median(steps_m)) / along_m)
        side = max(0.0, 1 - strips.spacing_m / across_m) if strips.spacing_m > 0 else math.nan
    return FlightFacts(
        height_m,
        spread_m,
        reference,
        speed_m_s,
        length_m(points_m),
        gsd_m,
        footprint_m,
        forward,
        interval_s,
        strips.count,
        side,
        median_or_nan(telemetry["camera_pitch_deg"]),
    )


def _track_m(latitude_deg: Floats, longitude_deg: Floats) -> PointsM:
    """(N, 2) east, north of the track about its first point."""
    if not len(latitude_deg):
        return np.zeros((0, 2))
    frame = LocalFrame(Geodetic(float(latitude_deg[0]), float(longitude_deg[0])))
    return frame.site_from_wgs84(latitude_deg, longitude_deg, np.zeros(len(latitude_deg)))[:, :2]


def _height(telemetry: Telemetry) -> tuple[float, float, str]:
    """Median height above ground and its spread (5 to 95 %), NaN if unknown; and above what it is."""
    above_takeoff_m = telemetry["height_above_takeoff_m"]
    if np.isfinite(above_takeoff_m).any():
        return median_or_nan(above_takeoff_m), _spread(above_takeoff_m), "above take-off"
    for column, words in (
        ("orthometric_height_m", "sea level"),
        ("ellipsoidal_height_m", "the ellipsoid"),
    ):
        if np.isfinite(telemetry[column]).any():
            usual_m = median_or_nan(telemetry[column])
            text = f"unknown: telemetry gives heights above {words} only, median {usual_m:.1f} m"
            return math.nan, _spread(telemetry[column]), text
    return math.nan, math.nan, "unknown: telemetry gives no height"


def _speed(telemetry: Telemetry, points_m: PointsM, times_s: Floats) -> float:
    """Median speed while moving; from positions where telemetry lacks it."""
    logged = telemetry["speed_m_s"]
    speeds = (
        logged[np.isfinite(logged)] if np.isfinite(logged).any() else speeds_m_s(points_m, times_s)
    )
    moving = speeds[speeds > _MOVING_M_S]
    return float(np.median(moving)) if len(moving) else (0.0 if len(speeds) else math.nan)


def _across_and_along(
    footprint_m: tuple[float, float], telemetry: Telemetry, bearing_deg: float
) -> tuple[float, float]:
    """The footprint's size across and along the flight; without a yaw the image's top is forward."""
    yaw_deg = telemetry["camera_yaw_deg"]
    yaw_deg = yaw_deg if np.isfinite(yaw_deg).any() else telemetry["body_yaw_deg"]
    turns = np.radians(yaw_deg[np.isfinite(yaw_deg)] - bearing_deg)
    # half turns change nothing, hence doubled angles: below zero the image lies across the flight
    lies_across = len(turns) > 0 and float(np.cos(2 * turns).mean()) < 0
    width_m, height_m = footprint_m
    return (height_m, width_m) if lies_across else (width_m, height_m)


def _spread(values: Floats) -> float:
    low, high = np.nanpercentile(values, [5, 95])
    return float(high - low)
