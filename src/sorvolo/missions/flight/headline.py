"""A mapped flight in one line: whether it is a map at all, whether the map can be trusted, and how good it is."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

import numpy as np

from sorvolo.capture.clock_offset import OffsetEstimate
from sorvolo.capture.sync import UNSURE_CLOCK_S
from sorvolo.missions.flight.log import FlightLog
from sorvolo.missions.flight.setup import FlightSetup
from sorvolo.mosaic.consistency import NOTHING_KNOWN, Consistency
from sorvolo.mosaic.flight_figures import FlightFigures
from sorvolo.mosaic.graph_report import GraphReport
from sorvolo.survey.mosaic import PlacedFrame, Status
from sorvolo.survey.wording import counted, plural

OBLIQUE_DEG = 35.0  # pictures that look to opposite sides share too little to be linked
_MANY = 0.1  # share of the frames
_MOST = 0.5  # share of the frames whose loss makes a map one to check; by choice
_BAD_FIT_PX = 3.0  # median residual of a map's matches from which on it is warned of; by choice
_TURNED_DEG = 6.0  # by which all stated angles may be off without a word
_MOST_RIVALS = 4  # clock offsets in a sentence
_FAR_BETTER = 0.7  # of the misfit at the clock's own tie
_MANY_JUMPS = 0.2  # share of the fixes: a receiver that starts loses fewer
_MOVED = 0.3  # pictures that spread so many diagonals of a frame are not those of a hovering drone
_GUESSED = 0.1  # relative: a focal length that is hardly known


def flight_warnings(
    placed: Sequence[PlacedFrame],
    figures: FlightFigures,
    setup: FlightSetup,
    log: FlightLog,
    agreement: Consistency,
    graph: GraphReport | None,
    others: Sequence[str],
) -> list[str]:
    """The warnings of a flight's report; `others` are what `map_headline` takes as such."""
    camera, clock, warnings = (
        setup.source.camera,
        setup.clock,
        [*agreement.faults, *agreement.steps, *others],
    )
    lost = sum(each.status is Status.REJECTED for each in placed)
    if lost > _MANY * len(placed):
        warnings.append(
            f"{lost} of {counted(len(placed), 'frame')} have no place in the map; `reasons` lists why"
        )
    warnings += [*doubts(placed, figures, graph), *agreement.remarks]
    # ground that is not level, where the pictures still fit each other; where they do not, `doubts` reports it
    residual_px = figures.residual_median_px
    fits = residual_px is not None and residual_px <= _BAD_FIT_PX
    if graph is not None and graph.is_uneven and fits:
        warnings.append(
            "the ground is not level, or tall things cover much of it: slopes and tall things lie off their place in the "
            "flat map; `sorvolo heights` measures the ground and makes a true orthophoto"
        )
    # whether telemetry states where the camera or the aircraft looked; else it is taken to have looked down
    has_angles = setup.track is not None and setup.track.attitude != "none"
    warnings += _angle_warnings(placed, graph, has_angles=has_angles)
    if not has_angles and figures.tilt_deg > OBLIQUE_DEG:  # measured from the pictures' perspective
        lack = "there is no telemetry" if setup.track is None else "telemetry has no camera angles"
        warnings.append(
            f"the camera looks {figures.tilt_deg:.0f} deg away from straight down and {lack}: "
            "strips flown in opposite directions may not fit each other; give telemetry with the camera's angles"
        )
    if camera.focal_sigma > _GUESSED:
        warnings.append(f"camera: {camera.origin}; until then the scale is not sure")
    if clock is not None and abs(log.offset_applied_s) > 2 * clock.sigma_s:
        warnings.append(
            f"the pictures fit this telemetry best {log.offset_applied_s:+.1f} s from where its clock puts them, more "
            f"than clocks tied like these differ ({clock.tie}): is it the telemetry of this flight? --offset "
            f"{log.offset_applied_s:.2f} maps it so from its first frame, --offset 0 keeps to its clock"
        )
    return warnings


def clock_doubts(
    setup: FlightSetup, found: OffsetEstimate | None, given_s: float | None
) -> list[str]:
    """Why telemetry may be of another moment than the pictures: several moments fit alike, or another one than was
    given or searched."""
    clock = setup.clock
    if found is None or clock is None:
        return []
    if found.rivals_s and (given_s is None or not found.is_known):
        offsets_s = [(given_s or 0.0) + each for each in found.rivals_s]
        listed = ", ".join(f"{each:+.1f}" for each in offsets_s[:_MOST_RIVALS])
        more = ", ..." if len(found.rivals_s) > _MOST_RIVALS else ""
        tie = f" as with its clock ({clock.tie})" if found.is_known else ""
        return [
            f"the log fits the pictures alike{tie} with other clock offsets ({listed}{more} s): give --offset, or --offset "
            "0 if both clocks were right"
        ]
    if found.is_significant and given_s is not None and abs(found.offset_s) > clock.sigma_s:
        return [
            f"the pictures fit the log best {found.offset_s:+.1f} s from --offset {given_s:g} (1 sigma {found.sigma_s:.2f} "
            f"s), which was kept: try --offset {given_s + found.offset_s:.2f}"
        ]
    if not found.is_known and found.rms_m < _FAR_BETTER * found.rms_at_zero_m:
        return [
            f"the pictures fit the telemetry best far from where its clock puts them ({clock.tie}): is it the telemetry of "
            "this flight?"
        ]
    return []


def clock_remarks(setup: FlightSetup, found: OffsetEstimate | None) -> list[str]:
    """That nothing holds a clock of uncertain tie against the pictures, where the motion shows less than the tie."""
    clock = setup.clock
    if found is None or clock is None or found.rivals_s or clock.sigma_s < UNSURE_CLOCK_S:
        return []
    if found.sigma_s < clock.sigma_s or found.rms_m < _FAR_BETTER * found.rms_at_zero_m:
        return []
    return [
        f"the clock could not be checked ({clock.tie}): the flight has no turn that shows an offset; the stated accuracy "
        f"includes {clock.sigma_s:g} s of it"
    ]


def doubts(
    placed: Sequence[PlacedFrame], figures: FlightFigures, graph: GraphReport | None = None
) -> list[str]:
    """What makes the map doubtful: steps in it, or pictures that fit each other badly; `graph` of a flat map."""
    warnings = []
    by_gps = sum(each.status is Status.GPS_ONLY for each in placed)
    if by_gps > _MANY * len(placed):
        warnings.append(
            f"{counted(by_gps, 'frame')} {plural('is', by_gps)} placed by GPS alone: expect steps of some metres at "
            "their edges"
        )
    if figures.residual_median_px is not None and figures.residual_median_px > _BAD_FIT_PX:
        warnings.append(
            "pictures fit each other badly: the ground is not level, and the map is flat; `sorvolo heights` makes an "
            "upright one"
            if graph is not None and graph.is_uneven
            else "pictures fit each other badly: a wrong camera or a rolling shutter; measure the camera with "
            "`sorvolo calibrate`"
        )
    return warnings


def _most_lost(placed: Sequence[PlacedFrame]) -> list[str]:
    """Why a map is to be checked that most of its flight's frames are not part of."""
    reasons = Counter(each.reason for each in placed if each.status is Status.REJECTED)
    if reasons.total() <= _MOST * len(placed):
        return []
    cause, count = reasons.most_common(1)[0]
    return [
        f"{reasons.total()} of {counted(len(placed), 'frame')} have no place in the map, {count} of them because: "
        f"{cause}; fly in good light, with 75 % overlap and GPS"
    ]


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


def place_doubts(setup: FlightSetup) -> list[str]:
    """Why the flight may be elsewhere: much of its log is, and that the longer part is right is a guess."""
    telemetry = setup.source.telemetry
    left_out = sum(each.count for each in telemetry.notices if each.code == "jump")
    fixes = left_out + int(np.isfinite(telemetry["latitude_deg"]).sum())
    if left_out <= _MANY_JUMPS * fixes:
        return []
    return [
        f"{left_out} of its {fixes} positions are far from the others and were left out: cut the wrong ones out of the "
        "log, and check the place"
    ]


def still_fixes(figures: FlightFigures, setup: FlightSetup) -> list[str]:
    """Why the map has no scale: the fixes, which alone could give it, are one place, and the pictures moved on."""
    telemetry = setup.telemetry
    if telemetry is None or telemetry.knows_ground or setup.known_ground is not None:
        return []
    if not telemetry.track.is_still or figures.reach_m < _MOVED * figures.diagonal_m:
        return []
    return [
        "its positions are all one place, while the pictures moved on (a receiver that had stopped): "
        "nothing gives its scale and north; give another log with --telemetry"
    ]


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


_HOVERING = 0.05  # of a frame's diagonal on the ground: views that spread less are one view


class MapQuality(StrEnum):
    """What a flight's frames make together."""

    MAP = "map"
    DOUBTFUL = "doubtful"  # a map with steps, or of pictures that fit each other badly
    CONTRADICTORY = "contradictory"  # its parts, or pictures and telemetry, exclude each other: nothing builds on it
    ONE_VIEW = "one-view"  # no map: the whole flight shows one piece of ground from one place


_DOUBTED = (MapQuality.DOUBTFUL, MapQuality.CONTRADICTORY, MapQuality.ONE_VIEW)


@dataclass(frozen=True)
class Headline:
    """The first line of a flight's report."""

    quality: MapQuality
    text: str


def map_headline(
    placed: Sequence[PlacedFrame],
    figures: FlightFigures,
    *,
    is_video: bool,
    agreement: Consistency = NOTHING_KNOWN,
    others: Sequence[str] = (),
    graph: GraphReport | None = None,
) -> Headline:
    """The headline of a flight that was mapped; photos were each meant, so that one photo is a map. `others` are
    further doubts about the map, in words; `graph` is of a flat map."""
    seen = sum(each.status is not Status.REJECTED for each in placed)
    if is_video and (seen == 1 or figures.reach_m < _HOVERING * figures.diagonal_m):
        return Headline(MapQuality.ONE_VIEW, f"no map: {_one_view(figures, seen)}")
    if agreement.faults:
        return Headline(
            MapQuality.CONTRADICTORY,
            f"a map that contradicts itself: {'; '.join(agreement.faults)}",
        )
    found = [*_most_lost(placed), *agreement.steps, *doubts(placed, figures, graph), *others]
    if found:  # one cause with its remedy; the warnings have all
        return Headline(MapQuality.DOUBTFUL, f"a map to check before use: {found[0]}")
    matched = sum(each.status is Status.VISION for each in placed)
    return Headline(MapQuality.MAP, f"{matched:,} of {counted(len(placed), 'frame')} matched")


def contradicts_itself(report: Mapping[str, Any]) -> bool:
    """Whether the map of a flight, by its report, contradicts itself."""
    headline = report.get("headline")
    return isinstance(headline, dict) and headline.get("quality") == MapQuality.CONTRADICTORY


def doubt_about(report: Mapping[str, Any]) -> str:
    """The headline of a flight, by its report, where it doubts the map; else nothing."""
    headline = report.get("headline")
    if not isinstance(headline, dict) or headline.get("quality") not in _DOUBTED:
        return ""
    return str(headline.get("text"))


def _one_view(figures: FlightFigures, seen: int) -> str:
    """Why all frames are one view, and what to do."""
    views = "all frames show one view" if seen == 1 else f"{counted(seen, 'frame')} show one view"
    if figures.tilt_deg > OBLIQUE_DEG:
        return (
            f"{views}, and the camera looks {figures.tilt_deg:.0f} deg away from straight down; fly over the ground "
            "with the camera looking down"
        )
    return f"{views}: the drone hovered; fly over the ground in strips"
