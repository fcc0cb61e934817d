"""`sorvolo plan`: how high and how fast to fly for a task, and waypoints over an area."""

import math
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from sorvolo.cli.options import Area, AsJson, Camera, DjiDrone, FlightHeight, Model, option, size_px
from sorvolo.cli.printing import Console, facts_table, print_json
from sorvolo.errors import SettingsError
from sorvolo.survey.wording import area_text

if TYPE_CHECKING:
    from sorvolo.geometry.planning import FlightPlan
    from sorvolo.missions.plan_flight import FlightAnswers, PlanSettings


TaskOption = Annotated[
    Literal["detection", "recognition", "identification"],
    option("detection: something is there. recognition: it is a person. identification: who."),
]
CriticalDimension = Annotated[
    float | None,
    option("Smallest side of another object to be made out, m.", show_default="a person's"),
]
HighestFlight = Annotated[float, option("Highest flight allowed, m: the law's in most countries.")]
GroundSpeed = Annotated[float, option("Ground speed, m/s.")]
ForwardOverlap = Annotated[float, option("Overlap of consecutive pictures, 0 to 0.95.")]
SideOverlap = Annotated[float, option("Overlap of neighbouring strips, 0 to 0.95.")]
StripBearing = Annotated[
    float | None,
    option("Direction of the strips, deg from north.", show_default="along the area"),
]
ThroughTrees = Annotated[
    float | None,
    option(
        "Plan for `search --through-trees` below crowns that hide this share of the floor, such as 0.6."
    ),
]
PictureSize = Annotated[str, option("Picture size, such as 1920x1080.")]
WaypointFiles = Annotated[
    list[Path] | None,
    option("File to write: .plan (QGroundControl), .kmz (DJI), .geojson or .kml. Can be repeated."),
]


def plan(
    camera: Camera,
    size: PictureSize = "",
    task: TaskOption = "recognition",
    critical_m: CriticalDimension = None,
    height: FlightHeight = None,
    max_height: HighestFlight = 120.0,
    model: Model = "default",
    speed: GroundSpeed = 5.0,
    overlap: ForwardOverlap = 0.75,
    side_overlap: SideOverlap = 0.65,
    bearing: StripBearing = None,
    through_trees: ThroughTrees = None,
    area: Area = None,
    out: WaypointFiles = None,
    dji_drone: DjiDrone = "fly",
    as_json: AsJson = False,
) -> None:
    """Find the flight height, speed and overlap for a task, and write waypoints over an area.

    The height is the lowest of three: what the task needs, what the detector needs, and what the law allows.

    Example: sorvolo plan --camera "Mavic 2 Pro" --area field.geojson --out field.plan --out field.kmz

    Example without an area: sorvolo plan --camera aov=78.8 --size 1920x1080 --task detection
    """
    from sorvolo.capture.areas import read_area
    from sorvolo.geometry.coordinates import place_text
    from sorvolo.geometry.planning import Task
    from sorvolo.missions import plan_flight as planning

    settings = planning.PlanSettings(
        task=Task(task),
        height_m=height,
        max_height_m=max_height,
        model=model,
        speed_m_s=speed,
        forward_overlap=overlap,
        side_overlap=side_overlap,
        strip_bearing_deg=bearing,
    )
    if critical_m is not None:  # another object than a person
        settings = replace(settings, critical_m=critical_m, person_m=None)
    if through_trees is not None:
        settings = planning.through_trees(settings, through_trees)
    if out and area is None:
        raise SettingsError("--out writes waypoints over an area: give --area FILE as well")
    chosen = planning.camera_to_plan_with(camera, size_px(size))
    answers, flight, place = planning.answer_questions(chosen, settings), None, ""
    if area is not None:
        outline = read_area(area)
        centre = outline.centre  # a longitude given first is seen here
        place = f"{area_text(outline.area_m2)} around {place_text(centre.latitude_deg, centre.longitude_deg)}"
        flight = planning.plan_over(outline, answers, settings)
        for path in out or []:
            planning.write_plan(path, flight, outline, dji_drone=dji_drone)
    if as_json:
        print_json(_as_json(answers, flight, out or []))
    else:
        _show(answers, flight, place, out or [], settings, through_trees)


def _show(
    answers: "FlightAnswers",
    flight: "FlightPlan | None",
    place: str,
    out: list[Path],
    settings: "PlanSettings",
    hidden: float | None,
) -> None:
    console = Console()
    camera = answers.camera.camera
    rows = [
        ("camera", answers.camera.origin),
        (
            "picture size",
            f"{camera.width_px} x {camera.height_px} px, focal length {camera.fx_px:.0f} px",
        ),
        ("angle of view", "{:.1f} x {:.1f} deg".format(*answers.angle_of_view_deg)),
    ]
    for name, highest_m in answers.maximum_heights_m.items():
        by_resolution = (
            f"{highest_m:,.2f} m by resolution alone, {answers.required_px_per_m[name]:.2f} px/m"
        )
        bounded_m = min(highest_m, settings.max_height_m)
        rows.append((f"height for {name}", f"at most {bounded_m:,.2f} m ({by_resolution})"))
    detector_m = answers.height_bounds_m.get("detector")
    if detector_m is not None:
        rows.append(
            (
                "height for the detector",
                f"at most {detector_m:,.2f} m (model {settings.model}, for people)",
            )
        )
    reasons = {
        "asked": "as asked",
        "task": f"the most for {settings.task.value}",
        "detector": "the most for the detector",
        "ceiling": "the highest flight allowed",
    }
    rows.append(
        ("flight height", f"{answers.height_m:,.2f} m above ground ({reasons[answers.bounded_by]})")
    )
    rate = (
        f"at least {answers.minimum_frame_rate_hz:.3g} a second for {settings.forward_overlap:.0%} overlap at "
        f"{settings.speed_m_s:g} m/s: one every {answers.photo_spacing_m:.1f} m"
    )
    rows += [
        ("ground resolution", f"{100 * answers.ground_sampling_m:.2f} cm a pixel"),
        ("a picture covers", "{:.1f} x {:.1f} m".format(*answers.footprint_m)),
        ("picture rate", rate),
        (
            "strips",
            f"{answers.strip_spacing_m:.1f} m apart for {settings.side_overlap:.0%} overlap",
        ),
    ]
    if hidden is not None:
        free = f"{answers.views * (1 - hidden):.0f} of them between crowns that hide {hidden:.0%}"
        rows.append(("a spot is in", f"{answers.views:.0f} pictures, {free}"))
    if flight is not None:
        path = f"{flight.distance_m:,.0f} m, {flight.duration_s / 60:.1f} min without take-off and return"
        rows += [
            ("area", place),
            ("passes", f"{len(flight.passes_m)}, at {flight.strip_bearing_deg:.0f} deg and back"),
            ("photos", f"{flight.photo_count:,}"),
            ("path", path),
        ]
    rows += [("written", str(each)) for each in out]
    console.print(facts_table("Flight plan", rows))
    from sorvolo.geometry.planning import LEGAL_CEILING_M

    warnings = []
    if settings.task.value not in answers.fulfilled_tasks:
        warnings.append(
            f"{answers.height_m:.1f} m is too high for {settings.task.value}; fly at most "
            f"{answers.maximum_heights_m[settings.task]:.1f} m"
        )
    detector_m = answers.height_bounds_m.get("detector", math.inf)
    if answers.height_m > detector_m:
        warnings.append(
            f"from {answers.height_m:.1f} m the detector will miss people; fly at most {detector_m:.1f} m"
        )
    if settings.max_height_m > LEGAL_CEILING_M:
        warnings.append(
            f"the law of most countries allows small drones {LEGAL_CEILING_M:.0f} m above ground: to fly higher, get a "
            "permit"
        )
    if answers.camera.focal_sigma > 0.1:
        sigma = answers.camera.focal_sigma
        warnings.append(
            f"the focal length is a guess, uncertain by {sigma:.0%}, so are the heights; calibrate once"
        )
    for warning in warnings:
        console.print(f"[yellow]warning[/yellow]  {warning}")


def _as_json(
    answers: "FlightAnswers", flight: "FlightPlan | None", out: list[Path]
) -> dict[str, Any]:
    camera = answers.camera
    result = vars(answers) | {
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
