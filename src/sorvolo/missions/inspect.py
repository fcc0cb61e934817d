"""A preflight of the input: what is in it, what is missing or suspicious, and what to do, within seconds."""

import math
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

from sorvolo.capture.preflight import (
    FlightFacts,
    FrameFacts,
    TelemetryFacts,
    flight_facts,
    frame_facts,
    telemetry_facts,
    while_filming,
)
from sorvolo.capture.source import Source, opened_sources
from sorvolo.geometry.units import SECOND_NS
from sorvolo.missions.flight.sample_frames import sample_frames
from sorvolo.paths import AnyPath, Inputs, as_text, listed
from sorvolo.store.exports.plain import plain_json
from sorvolo.survey.flight import CameraModel

_BLURRED = (
    1.5  # registration.features.sharpness at 960 px falls below this when blurred by two pixels
)
_BARE_LEVELS = 1.5  # grey levels of `sharpness_and_texture`'s second figure
_STILL_SHARE = 0.7  # of the first picture that all others show: the drone hovers, all flight long
_STILL_M = 3.0  # flown in all, no more than a hovering drone's fixes wander

_INFORMATION = frozenset(
    {
        "repeated_fix",
        "ignored_file",
        "resized_photo",
        "rotated_photo",
        "duplicate_photo",
        "time_zone_unknown",
        "positions_from_file",
        "log_in_folder",
        "unused_telemetry",
    }
)
_ADVICE = {
    "truncated": "copy the video again; what is there is mapped",
    "decode_error": "copy the video again from the drone's card",
    "corrupt_photo": "copy the photos again from the drone's card",
    "unreadable_photo": "copy the photos again from the drone's card",
    "photo_without_gps": "nothing if most have one: these photos are placed by their overlap alone",
    "void_fix_by_xmp": "look whether the map lies at its place",
    "sign_by_xmp": "look whether the map lies at its place: one of the two is wrong",
    "position_contradicted": "look whether the map lies at its place: one of the two is wrong",
    "time_zone_unknown": "nothing, unless telemetry from another file must fit: then give --offset",
    "empty_telemetry": "or give other telemetry with --telemetry",
    "unknown_column": "rename one to height_above_takeoff(m), altitude_msl(m) or gimbal_pitch(deg) if it is that",
    "unknown_telemetry": "see docs/formats-in.md for what is read, or give other telemetry with --telemetry",
    "unusable_telemetry": "give a readable file with --telemetry",
    "other_camera": "map them alone, in a site of their own",
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
class CameraFacts:
    """The camera that the map would be made with."""

    origin: str
    focal_px: float
    focal_sigma: float
    angle_of_view_deg: tuple[float, float]
    is_distorted: bool


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
        return dict(plain_json(self))


def inspect_input(
    inputs: Inputs,
    telemetry: AnyPath | None = None,
    camera: AnyPath | None = None,
) -> list[Inspection]:
    """Look at each flight among the inputs: all metadata, and a handful of frames; of a live one the next seconds.

    Raises InputError where `open_sources` does.
    """
    inputs = listed(inputs)
    telemetry = as_text(telemetry)
    camera = as_text(camera)
    with opened_sources(inputs, telemetry, camera) as sources:
        return [_inspect(source) for source in sources]


def _inspect(source: Source) -> Inspection:
    frames = frame_facts(source, sample_frames(source))
    telemetry = telemetry_facts(source, frames)
    flight = flight_facts(while_filming(source, frames), source.camera.camera, frames)
    findings = [
        *_frame_findings(frames),
        *_camera_findings(source.camera, flight),
        *_telemetry_findings(source, frames, telemetry),
        *_movement_findings(source.kind, frames, telemetry, flight),
        *_flight_findings(source.kind, frames, telemetry, flight),
        *(
            Finding(
                Level.INFO if each.code in _INFORMATION else Level.WARNING,
                each.text,
                _ADVICE.get(each.code, ""),
            )
            for each in (*source.notices(), *source.telemetry.notices)
        ),
    ]
    order = [Level.PROBLEM, Level.WARNING, Level.INFO]
    model = source.camera
    return Inspection(
        source.name,
        source.kind,
        source.inputs,
        frames,
        CameraFacts(
            model.origin,
            model.camera.fx_px,
            model.focal_sigma,
            model.camera.angle_of_view_deg,
            model.camera.is_distorted,
        ),
        telemetry,
        flight,
        tuple(sorted(findings, key=lambda finding: order.index(finding.level))),
    )


def _frame_findings(frames: FrameFacts) -> list[Finding]:
    found = []
    if 0 < frames.count < 3:
        text = f"only {frames.count} frames"
        found.append(Finding(Level.WARNING, text, "a map needs several overlapping ones"))
    if frames.sharpness < _BLURRED:
        found.append(
            Finding(
                Level.WARNING,
                f"the pictures are blurred (sharpness {frames.sharpness:.1f}, good from 2)",
                "fly slower, use a shorter exposure, check the focus",
            )
        )
    if frames.texture_levels < _BARE_LEVELS:
        found.append(
            Finding(
                Level.WARNING,
                f"the pictures show hardly any texture ({frames.texture_levels:.1f} gray levels), "
                "as water, snow, fog or a covered lens do",
                "frames without texture are placed by GPS alone",
            )
        )
    return found


def _camera_findings(model: CameraModel, flight: FlightFacts) -> list[Finding]:
    found = []
    if model.focal_sigma >= 0.1:
        found.append(
            Finding(
                Level.WARNING,
                f"the focal length is uncertain by {100 * model.focal_sigma:.0f} %",
                "give --camera FILE or a preset's name, or calibrate once with `sorvolo calibrate`",
            )
        )
    pitch_deg = flight.camera_pitch_deg
    if pitch_deg > -45:
        found.append(
            Finding(
                Level.PROBLEM,
                f"the camera looks at the horizon (gimbal pitch {pitch_deg:.0f} deg)",
                "fly with the gimbal straight down (-90 deg); such frames cannot be mapped",
            )
        )
    elif pitch_deg > -75:
        found.append(
            Finding(
                Level.WARNING,
                f"the camera looks ahead (gimbal pitch {pitch_deg:.0f} deg)",
                "fly with the gimbal straight down (-90 deg) for an even map",
            )
        )
    return found


def _telemetry_findings(source: Source, frames: FrameFacts, facts: TelemetryFacts) -> list[Finding]:
    if not facts.positions:
        is_video = source.kind == "video"
        return [
            Finding(
                Level.WARNING,
                "no positions: the map will have no scale and no place on Earth",
                "give the flight's log with --telemetry, or put it "
                + (
                    "beside the video under the same name"
                    if is_video
                    else "alone into the photos' folder"
                ),
            )
        ]
    if facts.apart:
        found, _, advice = facts.apart.partition("; ")
        return [Finding(Level.PROBLEM, found, advice)]
    if facts.tie.startswith("unknown"):
        return [
            Finding(
                Level.WARNING,
                f"how the pictures and the telemetry fit in time is {facts.tie}",
                "give --offset if you know it; else it is estimated from the motion",
            )
        ]
    beyond_s = float(source.telemetry.video_time_ns.max(initial=0)) / SECOND_NS - frames.duration_s
    if source.kind == "video" and beyond_s > max(5.0, 0.2 * frames.duration_s):
        return [
            Finding(
                Level.WARNING,
                f"the telemetry continues for {beyond_s:.0f} s after the video's end",
                "check that it belongs to this video, and that the video is whole",
            )
        ]
    share = facts.covered_s / frames.duration_s if frames.duration_s > 0 else 1.0
    if share > 0.98:
        return []
    return [
        Finding(
            Level.WARNING,
            f"the telemetry covers {100 * share:.0f} % of the frames' time",
            "frames outside it are placed by their overlap alone",
        )
    ]


def _movement_findings(
    kind: str, frames: FrameFacts, telemetry: TelemetryFacts, flight: FlightFacts
) -> list[Finding]:
    """Whether it is a flight at all: a drone that hovers shows one picture, however long."""
    advice = (
        "there is nothing to map but one picture: fly strips over the area; `sorvolo watch` finds people and cars in "
        "such a video"
    )
    if telemetry.positions > 1 and flight.distance_m < _STILL_M and frames.count > 1:
        return [
            Finding(
                Level.PROBLEM,
                f"the drone hovers: {flight.distance_m:.1f} m flown in {frames.duration_s:.0f} s",
                advice,
            )
        ]
    if kind == "video" and not telemetry.positions and frames.shared_view > _STILL_SHARE:
        return [
            Finding(
                Level.PROBLEM,
                f"the drone hovers: all pictures show {100 * frames.shared_view:.0f} % or more of what the first one shows",
                advice,
            )
        ]
    return []


def _flight_findings(
    kind: str, frames: FrameFacts, telemetry: TelemetryFacts, flight: FlightFacts
) -> list[Finding]:
    if not telemetry.positions:
        return []
    found = []
    if flight.height_m <= 0.5:
        found.append(
            Finding(
                Level.PROBLEM,
                f"the height is {flight.height_m:.1f} m {flight.height_reference}",
                "the drone's height was not set; the map's scale then comes from positions alone",
            )
        )
    elif math.isnan(flight.height_m):
        found.append(
            Finding(
                Level.WARNING,
                f"height above ground {flight.height_reference}",
                "ground resolution and overlap are unknown before mapping",
            )
        )
    usual_m = flight.height_m if flight.height_m > 0 else 60.0
    if flight.height_spread_m > max(10.0, 0.4 * usual_m):
        found.append(
            Finding(
                Level.WARNING,
                f"the height changes by {flight.height_spread_m:.0f} m during the flight",
                "if the drone kept its height, its altitude is wrong and is given little weight",
            )
        )
    return found + _overlap_findings(kind, frames, flight)


def _overlap_findings(kind: str, frames: FrameFacts, flight: FlightFacts) -> list[Finding]:
    found = []
    if flight.forward_overlap < 0.6:
        level = Level.PROBLEM if flight.forward_overlap < 0.3 else Level.WARNING
        found.append(
            Finding(
                level,
                f"consecutive photos overlap by {100 * flight.forward_overlap:.0f} % only",
                "fly slower or higher, or take photos more often: 70 % is good",
            )
        )
    if kind == "video" and frames.rate_hz * flight.frame_interval_s < 1:
        found.append(
            Finding(
                Level.PROBLEM,
                f"{frames.rate_hz:.1f} frames a second are too few for 70 % overlap at this speed",
                f"at least {1 / flight.frame_interval_s:.1f} are needed: fly slower or higher",
            )
        )
    if flight.side_overlap < 0.3:
        found.append(
            Finding(
                Level.WARNING,
                f"neighbouring strips overlap by {100 * flight.side_overlap:.0f} % only",
                "fly the strips closer: 60 % is good",
            )
        )
    return found
