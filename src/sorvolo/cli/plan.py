"""`sorvolo plan`: how high and how fast to fly for a task, and waypoints over an area."""

import json
import math
from dataclasses import asdict
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.table import Table

from sorvolo.errors import SettingsError

if TYPE_CHECKING:
    from sorvolo.geometry.planning import FlightPlan
    from sorvolo.missions.plan_flight import FlightAnswers, PlanSettings

_LEGAL_CEILING_M = 120.0


class Purpose(StrEnum):
    """What must be made out of an object: the names of `geometry.planning.Task`."""

    DETECTION = "detection"
    RECOGNITION = "recognition"
    IDENTIFICATION = "identification"


class Facing(StrEnum):
    """Which side of a person the camera sees (Table 3.1)."""

    FRONT = "front"
    BOTTOM = "bottom"


def plan(
    camera: Annotated[str, typer.Option(help="Calibration file, preset name or EXIF code, or aov=DEG.")] = "",
    focal_mm: Annotated[float, typer.Option(help="Focal length, mm.", show_default="of --camera")] = math.nan,
    pixel_um: Annotated[float, typer.Option(help="Sensor pixel, um.", show_default="of --camera")] = math.nan,
    size: Annotated[str, typer.Option(help="Frame size, such as 1920x1080.")] = "",
    task: Annotated[Purpose, typer.Option(help="What must be made out of an object.")] = Purpose.RECOGNITION,
    facing: Annotated[Facing, typer.Option(help="Side of a person that is seen.")] = Facing.BOTTOM,
    critical_m: Annotated[float, typer.Option(help="Critical size, m.", show_default="person")] = math.nan,
    height: Annotated[float, typer.Option(help="Height above ground, m.", show_default="task")] = math.nan,
    speed: Annotated[float, typer.Option(help="Ground speed, m/s.")] = 5.0,
    overlap: Annotated[float, typer.Option(help="Overlap of consecutive frames, 0 to 0.95.")] = 0.75,
    side_overlap: Annotated[float, typer.Option(help="Overlap of neighbouring strips, 0 to 0.95.")] = 0.65,
    bearing: Annotated[float, typer.Option(help="Strip direction, deg.", show_default="longest")] = math.nan,
    area: Annotated[Path | None, typer.Option(help="Outline to cover: GeoJSON, KML, KMZ or a list.")] = None,
    out: Annotated[list[Path] | None, typer.Option(help="Write .plan, .geojson or .kml; may repeat.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Flight height, overlap and frame rate for a task, and waypoints over an area.

    Example: sorvolo plan --camera "Mavic 2 Pro" --task recognition --area field.geojson --out field.plan

    Example without area: sorvolo plan --focal-mm 1.7 --pixel-um 6.97 --task detection --facing front
    """
    from sorvolo.capture.areas import read_area
    from sorvolo.geometry.planning import Task
    from sorvolo.missions.plan_flight import (
        PlanSettings,
        answer_questions,
        camera_to_plan_with,
        critical_dimension_m,
        plan_over,
        write_plan,
    )

    settings = PlanSettings(
        Task(task.value), critical_dimension_m(facing.value, critical_m), height, speed, overlap, side_overlap, bearing
    )
    if out and area is None:
        raise SettingsError("--out writes waypoints over an area: give --area FILE too")
    answers = answer_questions(camera_to_plan_with(camera, focal_mm, pixel_um, _size(size)), settings)
    flight = None
    if area is not None:
        outline = read_area(area)
        flight = plan_over(outline, answers, settings)
        for path in out or []:
            write_plan(path, flight, outline)
    if as_json:
        typer.echo(json.dumps(_as_json(answers, flight, out or []), indent=1))
    else:
        _show(answers, flight, out or [], settings)


def _size(text: str) -> tuple[int, int] | None:
    if not text:
        return None
    width, _, height = text.lower().partition("x")
    if not (width.isdecimal() and height.isdecimal() and int(width) > 0 and int(height) > 0):
        raise SettingsError(f"--size {text!r}: a frame size looks like 1920x1080")
    return int(width), int(height)


def _show(
    answers: "FlightAnswers", flight: "FlightPlan | None", out: list[Path], settings: "PlanSettings"
) -> None:
    console = Console()
    camera = answers.camera.camera
    table = Table("", "", title="Flight plan", show_header=False, title_justify="left")
    table.add_row("camera", f"{answers.camera.origin}")
    table.add_row("frame", f"{camera.width_px} x {camera.height_px} px, focal length {camera.fx_px:.0f} px")
    table.add_row("angle of view", "{:.1f} x {:.1f} deg".format(*answers.angle_of_view_deg))
    for name, highest_m in answers.maximum_heights_m.items():
        needed = answers.required_px_per_m[name]
        table.add_row(f"height for {name}", f"at most {highest_m:.2f} m ({needed:.2f} px/m)")
    chosen = f"the most for {settings.task.value}" if math.isnan(settings.height_m) else "as asked"
    table.add_row("flight height", f"{answers.height_m:.2f} m ({chosen})")
    table.add_row("ground sampling", f"{100 * answers.ground_sampling_m:.2f} cm/px")
    table.add_row("footprint", "{:.1f} x {:.1f} m".format(*answers.footprint_m))
    table.add_row(
        "frame rate",
        f"at least {answers.minimum_frame_rate_hz:.3g} per s for {settings.forward_overlap:.0%} overlap at "
        f"{settings.speed_m_s:g} m/s: a frame every {answers.photo_spacing_m:.1f} m",
    )
    table.add_row("strips", f"{answers.strip_spacing_m:.1f} m apart for {settings.side_overlap:.0%} overlap")
    if flight is not None:
        table.add_row("passes", f"{len(flight.passes_m)}, at {flight.strip_bearing_deg:.0f} deg and back")
        table.add_row("photos", str(flight.photo_count))
        minutes = flight.duration_s / 60
        table.add_row("path", f"{flight.distance_m:.0f} m, {minutes:.1f} min without take-off and return")
    for path in out:
        table.add_row("written", str(path))
    console.print(table)
    for warning in _warnings(answers, settings):
        console.print(f"Note: {warning}")


def _warnings(answers: "FlightAnswers", settings: "PlanSettings") -> list[str]:
    warnings = []
    if settings.task.value not in answers.fulfilled_tasks:
        warnings.append(
            f"{answers.height_m:.1f} m is too high for {settings.task.value}; fly at most "
            f"{answers.maximum_heights_m[settings.task]:.1f} m"
        )
    if answers.height_m > _LEGAL_CEILING_M:
        warnings.append(f"many countries allow small drones no more than {_LEGAL_CEILING_M:g} m above ground")
    if answers.camera.focal_sigma > 0.1:
        sigma = answers.camera.focal_sigma
        warnings.append(f"the focal length is a guess, good to {sigma:.0%}, and so are the heights")
    return warnings


def _as_json(answers: "FlightAnswers", flight: "FlightPlan | None", out: list[Path]) -> dict[str, Any]:
    camera = answers.camera
    result = asdict(answers) | {
        "camera": {
            "origin": camera.origin,
            "focal_sigma": camera.focal_sigma,
            "focal_px": camera.camera.fx_px,
            "width_px": camera.camera.width_px,
            "height_px": camera.camera.height_px,
        }
    }
    if flight is not None:
        result["plan"] = {
            "passes": len(flight.passes_m),
            "photos": flight.photo_count,
            "distance_m": flight.distance_m,
            "duration_s": flight.duration_s,
            "strip_bearing_deg": flight.strip_bearing_deg,
            "written": [str(path) for path in out],
        }
    return result
