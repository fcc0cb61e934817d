"""A preflight of the input: what is in it, what is missing or suspicious, and what to do, within seconds."""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any

import numpy as np

from sorvolo.capture.live.stream import LiveStream
from sorvolo.capture.photos import PhotoSource
from sorvolo.capture.source import LiveSource, Source, opened_sources
from sorvolo.capture.video import VideoSource
from sorvolo.geometry.arrays import Floats, PointsM
from sorvolo.geometry.camera import Camera
from sorvolo.geometry.geodesy import Geodetic, LocalFrame
from sorvolo.geometry.planning import footprint_size_m, minimum_frame_rate, px_per_m
from sorvolo.geometry.track import find_strips, length_m, speeds_m_s
from sorvolo.missions.flight.glimpses import glimpses_of
from sorvolo.registration.features import sharpness_and_texture
from sorvolo.survey.flight import CameraModel, Notice, Telemetry

_WANTED_OVERLAP = 0.7
_SECOND_NS = 1_000_000_000
_ZONE_NS = 900 * _SECOND_NS  # time zones differ by quarters of an hour
_BLURRED = 1.5  # registration.features.sharpness at 960 px falls below this when blurred by two pixels
_BARE_LEVELS = 1.5
_MOVING_M_S = 0.5

_INFORMATION = frozenset({
    "repeated_fix", "ignored_file", "resized_photo", "rotated_photo", "duplicate_photo", "time_zone_unknown",
})
_ADVICE = {
    "truncated": "copy the video again; what is there is mapped",
    "decode_error": "copy the video again from the drone's card",
    "corrupt_photo": "copy the photos again from the drone's card",
    "unreadable_photo": "copy the photos again from the drone's card",
    "photo_without_gps": "nothing if most have one: these photos are placed by their overlap alone",
    "time_zone_unknown": "nothing, unless telemetry from another file must fit: then give --offset",
    "empty_telemetry": "copy it from the drone's card again, or give other telemetry with --telemetry",
    "unusable_telemetry": "give a readable file with --telemetry",
    "mixed_cameras": "map each camera's pictures as its own flight",
    "zoom": "map each focal length as its own flight",
    "no_date": "nothing if video and telemetry begin together, else give --offset",
    "jump": "nothing: these fixes are not used",
    "null_fix": "nothing: these fixes are not used",
}


class Level(StrEnum):
    """How much a finding matters."""

    INFO = "info"
    WARNING = "warning"
    PROBLEM = "problem"


@dataclass(frozen=True)
class Finding:
    """Something to know before mapping, and what to do about it."""

    level: Level
    text: str
    advice: str


@dataclass(frozen=True)
class FrameFacts:
    """The pictures. `rate_hz` is NaN for photos, `interval_s` NaN for videos; `start_ns` is 0 if unknown.

    `sharpness` and `texture_levels` (the spread of gray about its surroundings) are medians over a few.
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


@dataclass(frozen=True)
class CameraFacts:
    """The camera that the map would be made with."""

    origin: str
    focal_px: float
    focal_sigma: float
    angle_of_view_deg: tuple[float, float]
    is_distorted: bool


@dataclass(frozen=True)
class TelemetryFacts:
    """The telemetry. `tie` says how it belongs to the frames, `covered_s` how long both run, NaN unknown."""

    format: str
    samples: int
    positions: int
    rate_hz: float
    longest_gap_s: float
    start_ns: int
    end_ns: int
    tie: str
    covered_s: float


@dataclass(frozen=True)
class FlightFacts:
    """The flight, as far as telemetry and camera tell; NaN where they do not.

    `height_reference` says above what `height_m` is. `forward_overlap` is that of consecutive photos;
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


@dataclass(frozen=True)
class Inspection:
    """One flight's preflight."""

    name: str
    kind: str
    inputs: tuple[str, ...]
    frames: FrameFacts
    camera: CameraFacts
    telemetry: TelemetryFacts
    flight: FlightFacts
    findings: tuple[Finding, ...]

    def as_json(self) -> dict[str, Any]:
        """Plain values for JSON; what is unknown is null."""
        plain: dict[str, Any] = _without_nan(asdict(self))
        return plain


def inspect_input(
    inputs: Sequence[Path | str], telemetry: Path | str | None = None, camera: Path | str | None = None
) -> list[Inspection]:
    """Look at each flight among the inputs: all metadata, and a handful of frames; of a live one the next seconds.

    Raises InputError where `open_sources` does.
    """
    with opened_sources(inputs, telemetry, camera) as sources:
        return [_inspect(source) for source in sources]


def _inspect(source: Source) -> Inspection:
    frames = _frame_facts(source)
    telemetry = _telemetry_facts(source, frames)
    flight = _flight_facts(_while_filming(source, frames), source.camera.camera, frames)
    findings = [
        *_frame_findings(frames), *_camera_findings(source.camera, flight),
        *_telemetry_findings(source, frames, telemetry),
        *_flight_findings(source.kind, frames, telemetry, flight),
        *(_finding_of(notice) for notice in (*source.notices(), *source.telemetry.notices)),
    ]
    order = [Level.PROBLEM, Level.WARNING, Level.INFO]
    model = source.camera
    return Inspection(
        source.name, source.kind, source.inputs, frames,
        CameraFacts(
            model.origin, model.camera.fx_px, model.focal_sigma, model.camera.angle_of_view_deg,
            model.camera.is_distorted,
        ),
        telemetry, flight, tuple(sorted(findings, key=lambda finding: order.index(finding.level))),
    )


def _frame_facts(source: Source) -> FrameFacts:
    camera = source.camera.camera
    glimpses = glimpses_of(source)
    seen = [sharpness_and_texture(frame.image) for frame in glimpses]
    sharp, texture = np.median(seen, axis=0).tolist() if seen else (math.nan, math.nan)
    if isinstance(source, VideoSource):
        info = source.info
        return FrameFacts(
            info.frame_count, info.frame_rate_hz, math.nan, info.duration_s, camera.width_px,
            camera.height_px, info.codec, info.container, info.path.stat().st_size, info.start_ns,
            info.start_origin, sharp, texture,
        )
    times_s, suffixes, container, size = np.zeros(0), "", "", 0
    if isinstance(source, LiveSource):
        times_s = np.array([frame.time_ns for frame in glimpses]) / _SECOND_NS
    if isinstance(source, LiveStream):
        suffixes, container = source.facts.codec, source.facts.container
    if isinstance(source, PhotoSource):
        photos = source.album.photos
        times_s = np.array([photo.time_ns for photo in photos]) / _SECOND_NS
        suffixes = ", ".join(sorted({photo.path.suffix.lower().lstrip(".") for photo in photos}))
        size = sum(photo.path.stat().st_size for photo in photos)
    return FrameFacts(
        source.frame_count, source.frame_rate_hz,
        _median(np.diff(times_s)) if source.kind == "photos" else math.nan,
        float(np.ptp(times_s)) if len(times_s) else math.nan, camera.width_px, camera.height_px,
        suffixes, container, size, source.start_ns, source.start_origin, sharp, texture,
    )


def _telemetry_facts(source: Source, frames: FrameFacts) -> TelemetryFacts:
    telemetry = source.telemetry
    placed = telemetry.time_ns[np.isfinite(telemetry["latitude_deg"])]
    steps_s = np.diff(placed) / _SECOND_NS
    tie, covered_s = _tie(source, frames)
    return TelemetryFacts(
        telemetry.format, len(telemetry), len(placed),
        1 / float(np.median(steps_s)) if len(steps_s) else math.nan, float(steps_s.max(initial=0.0)),
        int(telemetry.time_ns[0]) if len(telemetry) else 0,
        int(telemetry.time_ns[-1]) if len(telemetry) else 0, tie, covered_s,
    )


def _tie(source: Source, frames: FrameFacts) -> tuple[str, float]:
    """How telemetry and frames belong together, in words, and for how many seconds both run."""
    telemetry = source.telemetry
    if not len(telemetry):
        return "no telemetry", math.nan
    if isinstance(source, LiveSource):
        return source.telemetry_tie, frames.duration_s
    if telemetry.format == "exif":
        return "in each photo", frames.duration_s
    tied_ns = telemetry.video_time_ns[telemetry.video_time_ns >= 0]
    if len(tied_ns) and source.kind == "video":
        return "by time since the video's start", max(0.0, min(frames.duration_s, tied_ns[-1] / _SECOND_NS))
    if any(notice.code == "no_date" for notice in telemetry.notices):
        return "unknown: the telemetry has no date", math.nan
    if not source.start_ns:
        return "unknown: the video does not say when it began", math.nan
    both_ns = _common_ns(telemetry, source.start_ns, frames.duration_s)
    return "by UTC", both_ns / _SECOND_NS


def _while_filming(source: Source, frames: FrameFacts) -> Telemetry:
    """The telemetry between the first and the last frame; all of it where that cannot be told."""
    telemetry = source.telemetry
    duration_ns = round(frames.duration_s * _SECOND_NS) if frames.duration_s > 0 else 0
    since_start_ns = telemetry.video_time_ns
    if not (since_start_ns >= 0).any() and source.start_ns:
        since_start_ns = telemetry.time_ns - source.start_ns
    during = (since_start_ns >= 0) & (since_start_ns <= duration_ns)
    if source.kind != "video" or not np.isfinite(telemetry["latitude_deg"][during]).any():
        return telemetry
    columns = {name: values[during] for name, values in telemetry.columns.items()}
    return Telemetry(telemetry.format, telemetry.time_ns[during], columns, notices=telemetry.notices)


def _common_ns(telemetry: Telemetry, start_ns: int, duration_s: float) -> int:
    end_ns = start_ns + round(duration_s * _SECOND_NS)
    return max(0, min(end_ns, int(telemetry.time_ns[-1])) - max(start_ns, int(telemetry.time_ns[0])))


def _flight_facts(telemetry: Telemetry, camera: Camera, frames: FrameFacts) -> FlightFacts:
    placed = np.isfinite(telemetry["latitude_deg"])
    points_m = _track_m(telemetry["latitude_deg"][placed], telemetry["longitude_deg"][placed])
    times_s = (telemetry.time_ns[placed] - telemetry.time_ns[placed][:1]) / _SECOND_NS
    height_m, spread_m, reference = _height(telemetry)
    speed_m_s = _speed(telemetry, points_m, times_s)
    footprint_m, gsd_m = (math.nan, math.nan), math.nan
    interval_s = forward = side = math.nan
    strips = find_strips(points_m)
    if height_m > 0.5:
        footprint_m, gsd_m = footprint_size_m(camera, height_m), 1 / px_per_m(height_m, camera.fx_px)
        across_m, along_m = _across_and_along(footprint_m, telemetry, strips.bearing_deg)
        if speed_m_s > _MOVING_M_S:
            interval_s = 1 / minimum_frame_rate(speed_m_s, along_m, _WANTED_OVERLAP)
        if math.isnan(frames.rate_hz) and len(points_m) > 1:
            steps_m = np.linalg.norm(np.diff(points_m, axis=0), axis=1)
            forward = max(0.0, 1 - float(np.median(steps_m)) / along_m)
        side = max(0.0, 1 - strips.spacing_m / across_m) if strips.spacing_m > 0 else math.nan
    return FlightFacts(
        height_m, spread_m, reference, speed_m_s, length_m(points_m), gsd_m, footprint_m, forward, interval_s,
        strips.count, side, _median(telemetry["camera_pitch_deg"]),
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
        return _median(above_takeoff_m), _spread(above_takeoff_m), "above take-off"
    for column, words in (("orthometric_height_m", "sea level"), ("ellipsoidal_height_m", "the ellipsoid")):
        if np.isfinite(telemetry[column]).any():
            usual_m = _median(telemetry[column])
            text = f"unknown: telemetry gives heights above {words} only, median {usual_m:.1f} m"
            return math.nan, _spread(telemetry[column]), text
    return math.nan, math.nan, "unknown: telemetry gives no height"


def _speed(telemetry: Telemetry, points_m: PointsM, times_s: Floats) -> float:
    """Median speed while moving; from positions where telemetry does not tell it."""
    told = telemetry["speed_m_s"]
    speeds = told[np.isfinite(told)] if np.isfinite(told).any() else speeds_m_s(points_m, times_s)
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


def _frame_findings(frames: FrameFacts) -> list[Finding]:
    found = []
    if 0 < frames.count < 3:
        text = f"only {frames.count} frames"
        found.append(Finding(Level.WARNING, text, "a map needs several overlapping ones"))
    if frames.sharpness < _BLURRED:
        found.append(Finding(
            Level.WARNING, f"the pictures are blurred (sharpness {frames.sharpness:.1f}, good from 2)",
            "fly slower, use a shorter exposure, check the focus",
        ))
    if frames.texture_levels < _BARE_LEVELS:
        found.append(Finding(
            Level.WARNING, f"the pictures show hardly any texture ({frames.texture_levels:.1f} gray levels), "
            "as water, snow, fog or a covered lens do", "frames without texture are placed by GPS alone",
        ))
    return found


def _camera_findings(model: CameraModel, flight: FlightFacts) -> list[Finding]:
    found = []
    if model.focal_sigma >= 0.1:
        found.append(Finding(
            Level.WARNING, f"the focal length is uncertain by {100 * model.focal_sigma:.0f} %",
            "give --camera FILE or a preset's name, or calibrate once with `sorvolo calibrate`",
        ))
    pitch_deg = flight.camera_pitch_deg
    if pitch_deg > -45:
        found.append(Finding(
            Level.PROBLEM, f"the camera looks at the horizon (gimbal pitch {pitch_deg:.0f} deg)",
            "fly with the gimbal straight down (-90 deg); such frames cannot be mapped",
        ))
    elif pitch_deg > -75:
        found.append(Finding(
            Level.WARNING, f"the camera looks ahead (gimbal pitch {pitch_deg:.0f} deg)",
            "fly with the gimbal straight down (-90 deg) for an even map",
        ))
    return found


def _telemetry_findings(source: Source, frames: FrameFacts, facts: TelemetryFacts) -> list[Finding]:
    if not facts.positions:
        return [Finding(
            Level.WARNING, "no positions: the map will have no scale and no place on Earth",
            "give the flight's log with --telemetry, or put it beside the video under the same name",
        )]
    if math.isnan(facts.covered_s) or not frames.duration_s > 0:
        if source.kind == "video":
            return [Finding(
                Level.WARNING, f"how video and telemetry fit in time is {facts.tie}",
                "give --offset if you know it; else it is estimated from the motion",
            )]
        return []
    share = facts.covered_s / frames.duration_s
    beyond_s = float(source.telemetry.video_time_ns.max(initial=0)) / _SECOND_NS - frames.duration_s
    if source.kind == "video" and beyond_s > max(5.0, 0.2 * frames.duration_s):
        return [Finding(
            Level.WARNING, f"the telemetry goes on for {beyond_s:.0f} s after the video's end",
            "check that it belongs to this video, and that the video is whole",
        )]
    if share > 0.98 or facts.format == "exif":
        return []
    if share > 0:
        return [Finding(
            Level.WARNING, f"the telemetry covers {100 * share:.0f} % of the frames' time",
            "frames outside it are placed by their overlap alone",
        )]
    apart_ns = facts.start_ns - source.start_ns
    zone_ns = round(apart_ns / _ZONE_NS) * _ZONE_NS
    if abs(zone_ns) <= 14 * 3600 * _SECOND_NS and _common_ns(
        source.telemetry, source.start_ns + zone_ns, frames.duration_s
    ):
        hours = abs(zone_ns) / (3600 * _SECOND_NS)
        way = "behind" if zone_ns > 0 else "ahead of"
        return [Finding(
            Level.PROBLEM, f"the frames' clock is about {hours:g} h {way} the telemetry's: a time zone?",
            "give the difference with --offset",
        )]
    return [Finding(
        Level.PROBLEM,
        f"the telemetry is of another time: it begins {apart_ns / _SECOND_NS:+.0f} s from the frames",
        "give the telemetry of this flight, or --offset if a clock was wrong",
    )]


def _flight_findings(
    kind: str, frames: FrameFacts, telemetry: TelemetryFacts, flight: FlightFacts
) -> list[Finding]:
    if not telemetry.positions:
        return []
    found = []
    if flight.height_m <= 0.5:
        found.append(Finding(
            Level.PROBLEM, f"the height is {flight.height_m:.1f} m {flight.height_reference}",
            "the drone's height was not set; the map's scale then comes from positions alone",
        ))
    elif math.isnan(flight.height_m):
        found.append(Finding(
            Level.WARNING, f"height above ground {flight.height_reference}",
            "ground resolution and overlap cannot be told before mapping",
        ))
    usual_m = flight.height_m if flight.height_m > 0 else 60.0
    if flight.height_spread_m > max(10.0, 0.4 * usual_m):
        found.append(Finding(
            Level.WARNING, f"the height changes by {flight.height_spread_m:.0f} m during the flight",
            "if the drone kept its height, its altitude is wrong and is given little weight",
        ))
    if flight.forward_overlap < 0.6:
        level = Level.PROBLEM if flight.forward_overlap < 0.3 else Level.WARNING
        found.append(Finding(
            level, f"consecutive photos overlap by {100 * flight.forward_overlap:.0f} % only",
            "fly slower or higher, or take photos more often: 70 % is good",
        ))
    if kind == "video" and frames.rate_hz * flight.frame_interval_s < 1:
        found.append(Finding(
            Level.PROBLEM, f"{frames.rate_hz:.1f} frames a second are too few for 70 % overlap at this speed",
            f"at least {1 / flight.frame_interval_s:.1f} are needed: fly slower or higher",
        ))
    if flight.side_overlap < 0.3:
        found.append(Finding(
            Level.WARNING, f"neighbouring strips overlap by {100 * flight.side_overlap:.0f} % only",
            "fly the strips closer: 60 % is good",
        ))
    return found


def _finding_of(notice: Notice) -> Finding:
    level = Level.INFO if notice.code in _INFORMATION else Level.WARNING
    return Finding(level, notice.text, _ADVICE.get(notice.code, ""))


def _median(values: Floats) -> float:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else math.nan


def _spread(values: Floats) -> float:
    low, high = np.nanpercentile(values, [5, 95])
    return float(high - low)


def _without_nan(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _without_nan(each) for key, each in value.items()}
    if isinstance(value, (list, tuple)):
        return [_without_nan(each) for each in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
