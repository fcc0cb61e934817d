"""What a user of a flight's map should know first."""

from collections.abc import Sequence

from sorvolo.missions.flight.log import FlightLog
from sorvolo.missions.flight.setup import FlightSetup
from sorvolo.mosaic.consistency import NOTHING_KNOWN, Consistency
from sorvolo.mosaic.flight_figures import FlightFigures
from sorvolo.mosaic.graph_report import GraphReport
from sorvolo.survey.mosaic import PlacedFrame, Status
from sorvolo.survey.wording import counted, plural

OBLIQUE_DEG = 35.0  # pictures that look to opposite sides share too little to be linked
_MANY = 0.1  # share of the frames
_BAD_FIT_PX = 3.0  # median residual of a map's matches from which on it is warned of; by choice
_TURNED_DEG = 6.0  # by which all stated angles may be off without a word
_GUESSED = 0.1  # relative: a focal length that is hardly known


def flight_warnings(
    placed: Sequence[PlacedFrame],
    figures: FlightFigures,
    setup: FlightSetup,
    log: FlightLog,
    agreement: Consistency = NOTHING_KNOWN,
    graph: GraphReport | None = None,
) -> list[str]:
    """The warnings of a flight's report."""
    return [
        *agreement.faults,
        *agreement.steps,
        *_frame_warnings(placed),
        *doubts(placed, figures),
        *agreement.remarks,
        *_relief_warnings(figures, graph),
        *_angle_warnings(placed, graph, has_angles=_has_angles(setup)),
        *_camera_warnings(figures, setup),
        *_clock_warnings(setup, log),
    ]


def _frame_warnings(placed: Sequence[PlacedFrame]) -> list[str]:
    lost = sum(each.status is Status.REJECTED for each in placed)
    if lost <= _MANY * len(placed):
        return []
    return [
        f"{lost} of {counted(len(placed), 'frame')} have no place in the map; `reasons` lists why"
    ]


def doubts(placed: Sequence[PlacedFrame], figures: FlightFigures) -> list[str]:
    """What makes the map doubtful: steps in it, or pictures that fit each other badly."""
    warnings = []
    by_gps = sum(each.status is Status.GPS_ONLY for each in placed)
    if by_gps > _MANY * len(placed):
        warnings.append(
            f"{counted(by_gps, 'frame')} {plural('is', by_gps)} placed by GPS alone: expect steps of some metres at "
            "their edges"
        )
    if figures.residual_median_px is not None and figures.residual_median_px > _BAD_FIT_PX:
        warnings.append(
            "pictures fit each other badly: high trees or houses (`sorvolo heights` makes an upright map of them), a "
            "wrong camera, or a rolling shutter"
        )
    return warnings


def unlevelled(
    placed: Sequence[PlacedFrame], graph: GraphReport | None, setup: FlightSetup
) -> list[str]:
    """Why the map may be no view from above: pictures look aside, and neither angles nor positions level them."""
    if setup.track is not None or graph is None or graph.angles_contradicted <= _MANY * len(placed):
        return []
    return [
        "the camera looked to the side, and without telemetry nothing shows where level ground is: this is no view "
        "from straight above"
    ]


def _relief_warnings(figures: FlightFigures, graph: GraphReport | None) -> list[str]:
    """Ground that is not level, where the pictures still fit each other; where they do not, `doubts` reports it."""
    residual_px = figures.residual_median_px
    if graph is None or not graph.is_uneven or residual_px is None or residual_px > _BAD_FIT_PX:
        return []
    return [
        "the ground is not level, or tall things cover much of it: slopes and tall things lie off their place in the "
        "flat map; `sorvolo heights` measures the ground and makes a true orthophoto"
    ]


def _has_angles(setup: FlightSetup) -> bool:
    """Whether telemetry states where the camera or the aircraft looked; else it is taken to have looked down."""
    return setup.track is not None and setup.track.attitude != "none"


def _angle_warnings(
    placed: Sequence[PlacedFrame], graph: GraphReport | None, *, has_angles: bool
) -> list[str]:
    """Where the pictures contradict the stated angles of the camera or the aircraft, or the view straight down."""
    warnings = []
    if graph is not None and graph.angles_contradicted > _MANY * len(placed):
        frames = f"{counted(graph.angles_contradicted, 'frame')} of {len(placed)}"
        warnings.append(
            f"the stated angles of {frames} contradict the pictures by 15 deg or more and were not used"
            if has_angles
            else "no angles are stated, so the camera was taken to look straight down; by the pictures it looked 15 "
            f"deg or more to the side in {frames}"
        )
    if graph is not None and max(graph.turned_deg[0], abs(graph.turned_deg[1])) > _TURNED_DEG:
        tilt_deg, heading_deg = graph.turned_deg
        warnings.append(
            f"all stated angles are off from the pictures: tilt by {tilt_deg:.0f} deg, heading by {heading_deg:+.0f} "
            "deg (a compass beside motors, a mount that is not level); the pictures were followed"
        )
    return warnings


def _camera_warnings(figures: FlightFigures, setup: FlightSetup) -> list[str]:
    warnings = []
    if (
        not _has_angles(setup) and figures.tilt_deg > OBLIQUE_DEG
    ):  # measured from the pictures' perspective
        lack = "there is no telemetry" if setup.track is None else "telemetry has no camera angles"
        warnings.append(
            f"the camera looks {figures.tilt_deg:.0f} deg away from straight down and {lack}: "
            "strips flown in opposite directions may not fit each other; give telemetry with the camera's angles"
        )
    if setup.source.camera.focal_sigma > _GUESSED:
        warnings.append(f"camera: {setup.source.camera.origin}; until then the scale is not sure")
    return warnings


def _clock_warnings(setup: FlightSetup, log: FlightLog) -> list[str]:
    clock, applied_s = setup.clock, log.offset_applied_s
    if clock is None or abs(applied_s) <= 2 * clock.sigma_s:
        return []
    return [
        f"the pictures fit this telemetry best {applied_s:+.1f} s from where its clock puts them, more than clocks "
        f"tied like these differ ({clock.tie}): is it the telemetry of this flight? --offset 0 keeps to its clock"
    ]
