"""Planning a flight: from a camera and a task to height, overlap and rate, and over an area to waypoints."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from sorvolo.capture.calibration import camera_from_option
from sorvolo.capture.camera_presets import find_preset
from sorvolo.errors import SettingsError
from sorvolo.geometry.camera import Camera
from sorvolo.geometry.planning import (
    BOTTOM_CRITICAL_M,
    FRONT_CRITICAL_M,
    FlightPlan,
    StripSettings,
    Task,
    focal_px_from_mm,
    footprint_size_m,
    maximum_height_m,
    minimum_frame_rate,
    plan_strips,
    px_per_m,
    required_px_per_m,
    scene_length_m,
)
from sorvolo.store.exports.waypoints import write_waypoints
from sorvolo.survey.area import Area
from sorvolo.survey.flight import CameraModel

DEFAULT_SIZE_PX = (1920, 1080)
"""Frame size where neither the user nor a preset names one."""


@dataclass(frozen=True)
class PlanSettings:
    """What the flight is for. A NaN `height_m` means: as high as the task allows.

    `critical_m` is the object's smallest decisive dimension as the camera sees it; for people Table 3.1 takes
    `FRONT_CRITICAL_M` for a camera that faces them (or people lying) and `BOTTOM_CRITICAL_M` from above.
    """

    task: Task = Task.RECOGNITION
    critical_m: float = BOTTOM_CRITICAL_M
    height_m: float = math.nan
    speed_m_s: float = 5.0
    forward_overlap: float = 0.75
    side_overlap: float = 0.65
    strip_bearing_deg: float = math.nan


@dataclass(frozen=True)
class FlightAnswers:
    """The plan's numbers. `maximum_heights_m` and `required_px_per_m` are by task name."""

    camera: CameraModel
    angle_of_view_deg: tuple[float, float]
    required_px_per_m: Mapping[str, float]
    maximum_heights_m: Mapping[str, float]
    height_m: float
    ground_sampling_m: float
    footprint_m: tuple[float, float]
    fulfilled_tasks: tuple[str, ...]
    minimum_frame_rate_hz: float
    photo_spacing_m: float
    strip_spacing_m: float


def camera_to_plan_with(
    option: str, focal_mm: float, pixel_um: float, size_px: tuple[int, int] | None
) -> CameraModel:
    """The camera from `--camera`, or from a focal length (mm) and pixel size (um); neither is a clear error.

    Without `size_px` a preset plans with its full photo, anything else with `DEFAULT_SIZE_PX`.
    """
    preset = find_preset(option) if option else None
    width_px, height_px = size_px or ((preset.width_px, preset.height_px) if preset else DEFAULT_SIZE_PX)
    if option and not (math.isnan(focal_mm) and math.isnan(pixel_um)):
        raise SettingsError("--camera and --focal-mm/--pixel-um both describe the camera; give one of them")
    if option:
        return camera_from_option(option, width_px, height_px)
    if math.isnan(focal_mm) or math.isnan(pixel_um):
        raise SettingsError(
            "which camera? give --camera (a file, a preset such as 'Mavic 2 Pro', or aov=78.8), or both "
            "--focal-mm "
            "and --pixel-um"
        )
    focal_px = focal_px_from_mm(focal_mm, pixel_um)
    camera = Camera(width_px, height_px, focal_px, focal_px, (width_px - 1) / 2, (height_px - 1) / 2)
    return CameraModel(camera, f"{focal_mm:g} mm lens, {pixel_um:g} um pixels", 0.01)


def answer_questions(model: CameraModel, settings: PlanSettings) -> FlightAnswers:
    """Johnson's heights for every task and, at the chosen height, resolution, footprint, spacing and rate."""
    camera = model.camera
    required = {task.value: required_px_per_m(task, settings.critical_m) for task in Task}
    focal_px = min(camera.fx_px, camera.fy_px)
    heights_m = {task: maximum_height_m(focal_px, each) for task, each in required.items()}
    height_m = heights_m[settings.task] if math.isnan(settings.height_m) else settings.height_m
    strips = _strips(settings, height_m)
    width_m, _ = footprint_size_m(camera, height_m)
    length_m = scene_length_m(height_m, camera.angle_of_view_deg[1])
    return FlightAnswers(
        camera=model,
        angle_of_view_deg=camera.angle_of_view_deg,
        required_px_per_m=required,
        maximum_heights_m=heights_m,
        height_m=height_m,
        ground_sampling_m=1 / px_per_m(height_m, focal_px),
        footprint_m=(width_m, length_m),
        fulfilled_tasks=tuple(task for task, highest_m in heights_m.items() if height_m <= highest_m),
        minimum_frame_rate_hz=minimum_frame_rate(strips.speed_m_s, length_m, strips.forward_overlap),
        photo_spacing_m=length_m * (1 - strips.forward_overlap),
        strip_spacing_m=width_m * (1 - strips.side_overlap),
    )


def plan_over(area: Area, answers: FlightAnswers, settings: PlanSettings) -> FlightPlan:
    """The lawnmower over an area at the answers' height, in the metres of `area.frame`."""
    strips = _strips(settings, answers.height_m)
    return plan_strips(area.polygons_m(area.frame), answers.camera.camera, strips)


def write_plan(path: Path, plan: FlightPlan, area: Area) -> None:
    """Write a plan made by `plan_over` as .plan, .geojson or .kml."""
    write_waypoints(path, plan, area.frame, area.name)


def critical_dimension_m(facing: str, critical_m: float) -> float:
    """The critical dimension as given, else a person's for a camera `facing` front or bottom (Table 3.1)."""
    if not math.isnan(critical_m):
        return critical_m
    return {"front": FRONT_CRITICAL_M, "bottom": BOTTOM_CRITICAL_M}[facing]


def _strips(settings: PlanSettings, height_m: float) -> StripSettings:
    return StripSettings(
        height_m,
        settings.speed_m_s,
        settings.forward_overlap,
        settings.side_overlap,
        settings.strip_bearing_deg,
    )
