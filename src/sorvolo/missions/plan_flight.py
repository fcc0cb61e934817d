"""Planning a flight: from a camera and a task to height, overlap and rate, and over an area to waypoints."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from pathlib import Path

from sorvolo.capture.calibration import camera_from_option
from sorvolo.capture.camera_presets import find_presets
from sorvolo.detection.models import demand_searching, find_model
from sorvolo.detection.session import read_info
from sorvolo.detection.tiling import needed_px_per_m
from sorvolo.errors import InputError, SettingsError, check_choices
from sorvolo.geometry.camera import Camera
from sorvolo.geometry.planning import (
    BOTTOM_CRITICAL_M,
    LEGAL_CEILING_M,
    FlightPlan,
    StripSettings,
    Task,
    footprint_size_m,
    maximum_height_m,
    minimum_frame_rate,
    plan_strips,
    px_per_m,
    required_px_per_m,
    scene_length_m,
)
from sorvolo.paths import AnyPath
from sorvolo.store.exports.waypoints import write_waypoints
from sorvolo.survey.area import Area
from sorvolo.survey.flight import CameraModel
from sorvolo.survey.objects import TYPICAL_SIZE_M

DEFAULT_SIZE_PX = (1920, 1080)
"""Frame size where neither the user nor a preset names one."""


_REFLY_SPEED_M_S = 3.0  # slowly: they are small, and a second hole would cost another battery
_REFLY_FORWARD_OVERLAP = 0.7  # as `sorvolo map` selects frames
REFLY_BESIDE = 0.2  # of the height: how far the passes reach into what was seen
REFLY_MOST_HOLES = 60  # the largest: more waypoints than drones take, and hours of flight
REFLY_LEAST_M2 = 20.0  # of a hole in a search
_MOST_OVERLAP = 0.95  # 45 m high and 50 degrees wide, a picture every 2 m
_TIED_OVERLAP = (
    0.9  # strips 4 m apart there: crowns look too different from farther apart to tie them
)
# between crowns, of each spot: of 144 bodies planted below simulated crowns all were found from 12 on, 9 of 10 from 6
_FREE_VIEWS = 12
REFLY_LOWEST_M = 10.0  # above ground, where a search's pictures were too coarse


@dataclass(frozen=True)
class PlanSettings:
    """What the flight is for. No `height_m` means: as high as task, detector and `max_height_m` allow.

    `critical_m` is the object's smallest decisive dimension as the camera sees it: a person's from above by default.
    `person_m` is the longest side of a person that the camera sees, which the detector `model` must make out; None, or
    the model "none", where no detector has to. Raises SettingsError for a height above `max_height_m`.
    """

    task: Task = Task.RECOGNITION
    critical_m: float = BOTTOM_CRITICAL_M
    height_m: float | None = None
    max_height_m: float = LEGAL_CEILING_M
    model: str = "default"
    person_m: float | None = TYPICAL_SIZE_M["person"][0]
    speed_m_s: float = 5.0
    forward_overlap: float = 0.75
    side_overlap: float = 0.65
    strip_bearing_deg: float | None = None  # clockwise from north; None: along the area

    def __post_init__(self) -> None:
        check_choices(self)
        if not self.max_height_m > 0:
            raise SettingsError(f"--max-height must be positive, got {self.max_height_m} m")
        if self.height_m is not None and self.height_m > self.max_height_m:
            raise SettingsError(
                f"--height {self.height_m:g} is above {self.max_height_m:g} m, the law's limit for small drones in "
                "most countries; with a permit, give --max-height as well"
            )


class Bound(StrEnum):
    """What keeps the flight from going higher."""

    ASKED = "asked"
    TASK = "task"
    DETECTOR = "detector"
    CEILING = "ceiling"


@dataclass(frozen=True)
class FlightAnswers:
    """The plan's numbers. `maximum_heights_m` and `required_px_per_m` are by task name, by resolution alone.

    `height_bounds_m` are the heights that task, detector (if one must see) and ceiling allow, by `Bound`; `bounded_by`
    names the one that `height_m` is.
    """

    camera: CameraModel
    angle_of_view_deg: tuple[float, float]
    required_px_per_m: Mapping[str, float]
    maximum_heights_m: Mapping[str, float]
    height_bounds_m: Mapping[str, float]
    bounded_by: Bound
    height_m: float
    ground_sampling_m: float
    footprint_m: tuple[float, float]
    fulfilled_tasks: tuple[str, ...]
    minimum_frame_rate_hz: float
    photo_spacing_m: float
    strip_spacing_m: float
    views: float  # pictures that show each spot


def camera_to_plan_with(option: str, size_px: tuple[int, int] | None = None) -> CameraModel:
    """Return the camera that `--camera` names.

    Without `size_px` a preset plans with its full photo, anything else with `DEFAULT_SIZE_PX`.
    """
    preset = next(iter(find_presets(option)), None)
    width_px, height_px = size_px or (
        (preset.width_px, preset.height_px) if preset else DEFAULT_SIZE_PX
    )
    return camera_from_option(option, width_px, height_px)


def answer_questions(model: CameraModel, settings: PlanSettings) -> FlightAnswers:
    """Johnson's heights for every task and, at the chosen height, resolution, footprint, spacing and rate."""
    camera = model.camera
    required = {task.value: required_px_per_m(task, settings.critical_m) for task in Task}
    focal_px = min(camera.fx_px, camera.fy_px)
    heights_m = {task: maximum_height_m(focal_px, each) for task, each in required.items()}
    bounds_m: dict[str, float] = {
        Bound.TASK: heights_m[settings.task],
        **_detector_bound(focal_px, settings),
    }
    bounds_m[Bound.CEILING] = settings.max_height_m
    bound = (
        Bound(min(bounds_m, key=lambda each: bounds_m[each]))
        if settings.height_m is None
        else Bound.ASKED
    )
    height_m = bounds_m[bound] if settings.height_m is None else settings.height_m
    strips = _strips(settings, height_m)
    width_m, _ = footprint_size_m(camera, height_m)
    length_m = scene_length_m(height_m, camera.angle_of_view_deg[1])
    return FlightAnswers(
        camera=model,
        angle_of_view_deg=camera.angle_of_view_deg,
        required_px_per_m=required,
        maximum_heights_m=heights_m,
        height_bounds_m=bounds_m,
        bounded_by=bound,
        height_m=height_m,
        ground_sampling_m=1 / px_per_m(height_m, focal_px),
        footprint_m=(width_m, length_m),
        fulfilled_tasks=tuple(
            task for task, highest_m in heights_m.items() if height_m <= highest_m
        ),
        minimum_frame_rate_hz=minimum_frame_rate(
            strips.speed_m_s, length_m, strips.forward_overlap
        ),
        photo_spacing_m=length_m * (1 - strips.forward_overlap),
        strip_spacing_m=width_m * (1 - strips.side_overlap),
        views=1 / ((1 - strips.side_overlap) * (1 - strips.forward_overlap)),
    )


def through_trees(settings: PlanSettings, hidden: float) -> PlanSettings:
    """The flight that `search --through-trees` needs below crowns that hide this share of the floor.

    Pictures overlap as settings ask for, or more: strips tie to each other, and enough pictures show each spot between
    crowns. No detector has to see, unless one is named. Raises SettingsError for a share that no flight looks through.
    """
    most = 1 - _FREE_VIEWS * (1 - _MOST_OVERLAP) ** 2
    if not 0 <= hidden <= most:
        raise SettingsError(
            f"--through-trees {hidden:g}: give the share of the floor that crowns hide, 0 to {most:.2f}; below denser "
            f"crowns no flight shows a spot in {_FREE_VIEWS} pictures"
        )
    apart = min(1 - _TIED_OVERLAP, (1 - hidden) / (_FREE_VIEWS * (1 - _MOST_OVERLAP)))
    return replace(
        settings,
        model="none" if settings.model == PlanSettings.model else settings.model,
        forward_overlap=max(settings.forward_overlap, _MOST_OVERLAP),
        side_overlap=max(settings.side_overlap, 1 - apart),
    )


def plan_over(area: Area, answers: FlightAnswers, settings: PlanSettings) -> FlightPlan:
    """The lawnmower over an area at the answers' height, in the metres of `area.frame`."""
    strips = _strips(settings, answers.height_m)
    return plan_strips(area.polygons_m(area.frame), answers.camera.camera, strips)


def write_plan(path: AnyPath, plan: FlightPlan, area: Area, *, dji_drone: str = "fly") -> None:
    """Write a plan made by `plan_over` as .plan, .kmz (for a DJI drone), .geojson or .kml."""
    path = Path(path)
    write_waypoints(path, plan, area.frame, area.name, dji_drone=dji_drone)


def fly_again(
    area: Area,
    camera: Camera,
    height_m: float,
    files: Sequence[Path],
    *,
    dji_drone: str = "fly",
) -> FlightPlan:
    """Slow passes over what a flight with this camera did not see, written to the files; as high as it was flown."""
    wishes = PlanSettings(
        height_m=min(height_m, LEGAL_CEILING_M),
        model="none",
        speed_m_s=_REFLY_SPEED_M_S,
        forward_overlap=_REFLY_FORWARD_OVERLAP,
    )
    plan = plan_over(
        area, answer_questions(CameraModel(camera, "the mapped flight's", 0.01), wishes), wishes
    )
    for path in files:
        write_plan(path, plan, area, dji_drone=dji_drone)
    return plan


def _detector_bound(focal_px: float, settings: PlanSettings) -> dict[str, float]:
    """The height up to which the detector finds people well; nothing where no detector has to."""
    if settings.model == "none" or settings.person_m is None:
        return {}
    info = read_info(find_model(settings.model))
    demand_searching(info)
    if "person" not in info.best_px:
        raise InputError(
            f"the model {settings.model} does not look for people; give another --model, or none"
        )
    needed = needed_px_per_m(info, "person", settings.person_m)
    return {Bound.DETECTOR: maximum_height_m(focal_px, needed)}


def _strips(settings: PlanSettings, height_m: float) -> StripSettings:
    return StripSettings(
        height_m,
        settings.speed_m_s,
        settings.forward_overlap,
        settings.side_overlap,
        settings.strip_bearing_deg,
    )
