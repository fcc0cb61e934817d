"""`sorvolo inspect`: what is in the input, what is missing or suspicious, and what to do."""

import math
from datetime import UTC, datetime
from typing import TYPE_CHECKING

from rich.markup import escape

from sorvolo.cli.options import AsJson, Camera, Inputs, Telemetry
from sorvolo.cli.printing import Console, facts_table, print_json
from sorvolo.survey.wording import counted

if TYPE_CHECKING:
    from sorvolo.missions.inspect import Inspection

_COLOURS = {"info": "blue", "warning": "yellow", "problem": "red"}
_MAX_NAMES = 4  # of files in a line


def inspect(
    inputs: Inputs,
    telemetry: Telemetry = None,
    camera: Camera = "",
    as_json: AsJson = False,
) -> None:
    """Check a flight before it is mapped: what is there, what is missing, and what to do about it.

    Example: sorvolo inspect DJI_0042.MP4

    Example: sorvolo inspect photos/ --camera phantom.xml --json
    """
    from sorvolo.missions.inspect import inspect_input

    inspections = inspect_input(inputs, telemetry, camera or None)
    if as_json:
        plain = [inspection.as_json() for inspection in inspections]
        print_json(plain)
        return
    console = Console()
    for inspection in inspections:
        rows = ((name, escape(text)) for name, text in _rows(inspection))
        console.print(facts_table(f"{inspection.name} ({inspection.kind})", rows))
        for finding in inspection.findings:
            colour = _COLOURS[finding.level]
            advice = f" [dim]-> {escape(finding.advice)}[/dim]" if finding.advice else ""
            console.print(
                f"[{colour}]{finding.level:>8}[/{colour}]  {escape(finding.text)}{advice}",
            )
        if not inspection.findings:
            console.print("[green]nothing is missing or suspicious: ready to map[/green]")


def _rows(inspection: "Inspection") -> list[tuple[str, str]]:
    frames, camera, flight = inspection.frames, inspection.camera, inspection.flight
    names = ", ".join(inspection.inputs[:_MAX_NAMES])
    more = len(inspection.inputs) - _MAX_NAMES
    size = f"{frames.width_px} x {frames.height_px} px, {frames.codec}"
    return [
        (
            "input",
            names
            + (f" and {more} more" if more > 0 else "")
            + f", {frames.size_bytes / 1e6:.1f} MB",
        ),
        (
            "frames",
            f"{frames.count:,}"
            + _with_unit(", {:.2f} a second", frames.rate_hz)
            + _with_unit(", one in {:.1f} s", frames.interval_s)
            + _with_unit(", {:.1f} s in all", frames.duration_s),
        ),
        (
            "pictures",
            size
            + (f" in {frames.container}" if frames.container else "")
            + _with_unit("; sharpness {:.1f}", frames.sharpness),
        ),
        ("begins", f"{_utc(frames.start_ns)}{frames.start_origin}"),
        (
            "camera",
            f"{camera.origin}; focal length {camera.focal_px:.0f} px "
            f"(1 sigma {100 * camera.focal_sigma:.3g} %), "
            f"angle of view {camera.angle_of_view_deg[0]:.1f} x {camera.angle_of_view_deg[1]:.1f} deg",
        ),
        *_telemetry_rows(inspection),
        ("height", _with_unit("{:.1f} m ", flight.height_m) + flight.height_reference),
        (
            "speed",
            (_with_unit("{:.1f} m/s", flight.speed_m_s) or "unknown")
            + (f", {flight.distance_m:.0f} m flown" if flight.distance_m > 0 else ""),
        ),
        (
            "ground resolution",
            (_with_unit("{:.1f} cm a pixel", 100 * flight.gsd_m) or "unknown")
            + _with_unit(", a frame covers {:.0f} x ", flight.footprint_m[0])
            + _with_unit("{:.0f} m", flight.footprint_m[1]),
        ),
        ("overlap", _overlap(inspection)),
        (
            "gimbal",
            _with_unit("pitch {:.0f} deg (-90 is down)", flight.camera_pitch_deg) or "unknown",
        ),
    ]


def _telemetry_rows(inspection: "Inspection") -> list[tuple[str, str]]:
    from sorvolo.capture.sync import DATED_NS

    facts = inspection.telemetry
    if not facts.samples:
        return [("telemetry", "none")]
    first = (
        f"{facts.format}, {counted(facts.samples, 'sample')}, {facts.positions:,} with a position"
    )
    rate = (
        _with_unit(", {:.3g} a second", facts.rate_hz)
        + f", longest gap {facts.longest_gap_s:.1f} s"
    )
    is_dated = facts.start_ns >= DATED_NS
    span = (
        f"{_utc(facts.start_ns)}to {_utc(facts.end_ns).rstrip(' ,')}"
        if is_dated
        else "without a date"
    )
    return [
        ("telemetry", first + rate),
        ("", span),
        ("matched to frames", facts.tie + _with_unit(", {:.1f} s in common", facts.covered_s)),
    ]


def _overlap(inspection: "Inspection") -> str:
    flight = inspection.flight
    parts = [
        _with_unit("{:.0f} % from photo to photo", 100 * flight.forward_overlap),
        _with_unit("70 % with a frame every {:.2f} s", flight.frame_interval_s),
        f"{flight.strips} strips"
        + _with_unit(", {:.0f} % between strips", 100 * flight.side_overlap)
        if flight.strips > 1
        else "",
    ]
    return "; ".join(part for part in parts if part) or "unknown"


def _with_unit(pattern: str, number: float) -> str:
    """The number in its pattern, or nothing when it is unknown."""
    return pattern.format(number) if math.isfinite(number) else ""


def _utc(time_ns: int) -> str:
    return (
        f"{datetime.fromtimestamp(time_ns / 1e9, UTC):%Y-%m-%d %H:%M:%S} UTC, " if time_ns else ""
    )
