"""A mapped flight in one line: whether it is a map at all, whether the map can be trusted, and how good it is."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

from sorvolo.missions.flight.warnings import OBLIQUE_DEG, doubts
from sorvolo.mosaic.consistency import NOTHING_KNOWN, Consistency
from sorvolo.mosaic.flight_figures import FlightFigures
from sorvolo.survey.mosaic import PlacedFrame, Status
from sorvolo.survey.wording import counted

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
) -> Headline:
    """The headline of a flight that was mapped; photos were each meant, so that one photo is a map. `others` are
    further doubts about the map, in words."""
    seen = sum(each.status is not Status.REJECTED for each in placed)
    if is_video and (seen == 1 or figures.reach_m < _HOVERING * figures.diagonal_m):
        return Headline(MapQuality.ONE_VIEW, f"no map: {_one_view(figures, seen)}")
    if agreement.faults:
        return Headline(
            MapQuality.CONTRADICTORY,
            f"a map that contradicts itself: {'; '.join(agreement.faults)}",
        )
    found = [*agreement.steps, *doubts(placed, figures), *others]
    if found:
        return Headline(MapQuality.DOUBTFUL, f"a map to check before use: {'; '.join(found)}")
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
