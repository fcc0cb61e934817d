"""A measured search's report: chances over all flights, holes and their reasons, the figures of a search, in words."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from enum import StrEnum
from typing import TYPE_CHECKING, Any

from sorvolo.detection.contract import ModelInfo
from sorvolo.detection.tiling import TASK
from sorvolo.geometry.camera import Camera
from sorvolo.geometry.planning import BOTTOM_CRITICAL_M
from sorvolo.geometry.summary import calibration_bins, median_of_known, wilson
from sorvolo.missions.flight.detector_protocol import ObjectDetector
from sorvolo.missions.search.measure import MeasuredClass, MeasuredFlight, SearchFrame
from sorvolo.missions.search.settings import SearchSettings
from sorvolo.search.cells import Cells
from sorvolo.search.holes import HoleReason, Holes, hole_areas_m2, hole_reasons, reasons_together
from sorvolo.search.recall import (
    Chances,
    figures,
    held_out_chances,
    path_length_m,
    segment,
    together,
)
from sorvolo.store.exports.plain import plain_json
from sorvolo.survey.area import Area, inside_any
from sorvolo.survey.flight import Site
from sorvolo.survey.objects import TYPICAL_SIZE_M
from sorvolo.survey.wording import counted
from sorvolo.tracking.laying import pose_of

if TYPE_CHECKING:
    from sorvolo.missions.search.refly import Refly

_FEW_PLANTS = 25  # fewer outcomes of a class leave its probability a guess
_WIDE_CELL_M = 10.0  # of a cell: a path, a hedge, a hole that is worth a flight
_MOST_HOLES = 0.01  # of the area: more is reported in the headline and the exit code


class State(StrEnum):
    """What a flight does that is measured before it is mapped whole."""

    FLYING = "flying"
    LANDED = "landed"
    STOPPED = "stopped"


@dataclass(frozen=True)
class SoFar:
    """A flight that is not mapped whole: how many pictures were measured of those that have a place, by when (ISO 8601,
    UTC), what it does, and the flights before it that count as well."""

    flight: str
    measured: int
    placed: int
    as_of: str
    state: State
    earlier: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class Searched:
    """All that was measured of a site; `segments` are names, areas and the probability that the missing is in each."""

    site: Site
    cells: Cells
    flights: tuple[MeasuredFlight, ...]
    frames: Mapping[str, tuple[SearchFrame, ...]]
    segments: Sequence[tuple[str, Area, float]]

    @property
    def labels(self) -> tuple[str, ...]:
        """The classes that were measured, people first."""
        return tuple(each.label for each in self.flights[0].classes)

    @property
    def camera(self) -> Camera:
        """The camera of the last flight's frames."""
        return self.frames[self.flights[-1].name][0].placed.camera

    @property
    def height_m(self) -> float:
        """The last flight's usual height above the ground."""
        return median_of_known(self._heights_m()) or 0.0

    @property
    def path_m(self) -> float:
        """How far the cameras flew, all flights together, by straight ways between their frames."""
        return sum(
            path_length_m(
                [pose.translation_m for each in own if (pose := pose_of(each.placed)) is not None]
            )
            for own in self.frames.values()
        )

    @property
    def unseen_from_m(self) -> float | None:
        """How far the area is from the ground that was seen, where none of the area was seen; else None."""
        cells = self.cells
        if any(
            (each.seen.seen & cells.wanted).any()
            for flight in self.flights
            for each in flight.classes
        ):
            return None
        places_m = [
            corner_m
            for own in self.frames.values()
            for each in own
            for corner_m in each.placed.outline_m
        ]
        return cells.wanted_from_m(places_m)

    def of_class(self, label: str) -> list[MeasuredClass]:
        """What each flight measured of a class."""
        return [each for flight in self.flights for each in flight.classes if each.label == label]

    def _heights_m(self) -> list[float]:
        poses = [pose_of(each.placed) for each in self.frames[self.flights[-1].name]]
        return [float(pose.translation_m[2]) for pose in poses if pose is not None]


def total_of(searched: Searched, label: str) -> Chances:
    """The chances of a class by all flights together."""
    return together([each.chances for each in searched.of_class(label)])


def hole_numbers(
    searched: Searched, label: str, settings: SearchSettings, info: ModelInfo
) -> Holes:
    """(N,) why each wanted cell has less than enough of a chance, as numbers of REASONS."""
    own = searched.of_class(label)
    reasons = [
        hole_reasons(
            searched.cells,
            each.seen,
            each.chances,
            each.recall,
            enough=settings.enough,
            needed_m_per_px=needed_m_per_px(label, info),
            length_m=_length_m(label),
        )
        for each in own
    ]
    return reasons_together(
        reasons,
        [each.chances for each in own],
        total_of(searched, label),
        searched.cells,
        settings.enough,
    )


def needed_m_per_px(label: str, info: ModelInfo) -> float:
    """The coarsest pixel at which a class is recognised: by Johnson's criteria, at its smallest decisive side."""
    critical_m = BOTTOM_CRITICAL_M if label == "person" else TYPICAL_SIZE_M[label][1]
    return critical_m / TASK.pixels if label in info.classes else critical_m


def is_coarse(searched: Searched, settings: SearchSettings, info: ModelInfo) -> bool:
    """Whether any hole is one since its pixels are too coarse."""
    numbers = hole_numbers(searched, searched.labels[0], settings, info)
    return HoleReason.COARSE.value in hole_areas_m2(numbers, searched.cells.cell_m)


def build_search_report(
    searched: Searched,
    settings: SearchSettings,
    detector: ObjectDetector,
    refly: "Refly | None",
    so_far: SoFar | None = None,
    warnings: Sequence[str] = (),
) -> dict[str, Any]:
    """search.json (docs/formats.md), these warnings first; `so_far` is given while the flight goes on."""
    rows = {
        label: _class_row(searched, label, settings, detector.info) for label in searched.labels
    }
    first = searched.labels[0]
    report = {
        "site": searched.site.name,
        "model": detector.info.name,
        "settings": asdict(settings),
        "cell_m": searched.cells.cell_m,
        "headline": _headline(first, rows[first], settings, so_far),
        "so_far": None if so_far is None else asdict(so_far),
        "classes": rows,
        "flights": [_flight_row(each) for each in searched.flights],
        "segments": _segment_rows(searched, first),
        "refly": None if refly is None else asdict(refly),
        "notices": [asdict(each) for each in detector.notices],
        "warnings": [*warnings, *_warnings(searched, settings, is_over=so_far is None)],
    }
    return dict(plain_json(report))


def _class_row(
    searched: Searched, label: str, settings: SearchSettings, info: ModelInfo
) -> dict[str, Any]:
    cells = searched.cells
    chances = [each.chances for each in searched.of_class(label)]
    found = figures(chances, cells.wanted, cells.cell_m, searched.path_m)
    numbers = hole_numbers(searched, label, settings, info)
    return {**asdict(found), "holes_m2": hole_areas_m2(numbers, cells.cell_m)}


def _flight_row(flight: MeasuredFlight) -> dict[str, Any]:
    classes = {}
    for each in flight.classes:
        own, hits = each.outcomes, int(each.outcomes.found.sum())
        held_out = held_out_chances(own.columns, own.found)
        classes[each.label] = {
            "planted": len(own),
            "found": hits,
            "interval": wilson(hits, len(own)),
            "calibration": [asdict(row) for row in calibration_bins(held_out, own.found)],
        }
    return {
        "name": flight.name,
        "frames": flight.frames,
        "searched_pictures": flight.searched.looked,
        "rounds": flight.searched.rounds,
        "seconds": round(flight.searched.seconds, 1),
        "measured_before": flight.is_earlier,
        "shadows": flight.has_shadows,
        "heights": flight.has_heights,
        "thermal": flight.is_thermal,
        "blur_px": round(flight.blur_px, 2),
        "classes": classes,
    }


def _segment_rows(searched: Searched, label: str) -> list[dict[str, Any]]:
    cells, total, site = searched.cells, total_of(searched, label), searched.site
    return [
        asdict(
            segment(
                name,
                poa,
                total,
                inside_any(area.polygons_m(site.frame), cells.centres_m),
                cells.cell_m,
                area.area_m2,
            )
        )
        for name, area, poa in searched.segments
    ]


def _headline(
    label: str, row: Mapping[str, Any], settings: SearchSettings, so_far: SoFar | None
) -> dict[str, Any]:
    """The search in one line, and whether all of the area was searched well enough."""
    area_m2 = row["area_m2"]
    shares = (
        {reason: holes_m2 / area_m2 for reason, holes_m2 in row["holes_m2"].items()}
        if area_m2
        else {}
    )
    holes = ", ".join(f"{share:.0%} {reason}" for reason, share in shares.items() if share >= 0.005)
    chance = f"{row['pod']:.2f} (90 % interval {row['pod_low']:.2f} to {row['pod_high']:.2f})"
    by = (
        ""
        if so_far is None
        else (
            f"so far, by {so_far.measured} of {counted(so_far.placed, 'picture')} of the flight {so_far.flight} "
            f"{'and ' + counted(len(so_far.earlier), 'flight') + ' before it' if so_far.earlier else 'alone'}: "
        )
    )
    text = f"{by}probability of detection of a {label} anywhere in the area: {chance}"
    total = sum(shares.values())
    is_complete = total <= _MOST_HOLES
    text += (
        "; no holes"
        if is_complete
        else (
            f"; {total:.0%} of the area is below {settings.enough:g}: {holes or 'in small pieces'}"
        )
    )
    return {"text": text, "complete": is_complete, "hole_share": total}


def _warnings(searched: Searched, settings: SearchSettings, *, is_over: bool) -> list[str]:
    warnings, how = [], " (--plants, and room on open ground)" if is_over else ""
    if (away_m := searched.unseen_from_m) is not None:
        distance = f"{away_m / 1000:.1f} km" if away_m >= 1000 else f"{away_m:.0f} m"
        warnings.append(
            f"no picture{'' if is_over else ' so far'} shows any of the area, which begins {distance} "
            "from what they show: is it the right --area?"
        )
    if searched.cells.cell_m >= _WIDE_CELL_M:
        warnings.append(
            f"the area is so wide that it is counted in cells of {searched.cells.cell_m:g} m; what is narrower is lost"
        )
    for flight in searched.flights if away_m is None else ():
        few = [each for each in flight.classes if len(each.outcomes) < _FEW_PLANTS]
        warnings += [
            f"{flight.name}: {'only ' * bool(len(each.outcomes))}{counted(len(each.outcomes), 'plant')} of the class "
            f"{each.label}{how}; its probability is a guess, as its interval shows"
            for each in few
        ]
        if not flight.has_shadows and not flight.is_thermal:
            warnings.append(
                f"{flight.name}: its clock has no date, so the sun is unknown and plants throw no shadow"
            )
    if any(not each.has_heights and not each.is_thermal for each in searched.flights):
        warnings.append(
            "trees were recognised in the pictures, which miss some that stand alone, and roofs count as ground: "
            "`sorvolo heights` measures both, for the next search"
        )
    if settings.through_crowns == 0:
        warnings.append(
            "ground under trees counts as not found at all; --through-crowns assumes gaps in crowns"
        )
    if "person" in searched.labels:
        warnings.append(
            "plants are drawn people, and the detector finds drawn and real people differently well: compare the "
            "probability between places and flights rather than taking it at its word (docs/search.md)"
        )
    return warnings


def _length_m(label: str) -> float:
    return max(TYPICAL_SIZE_M[label]) if label in TYPICAL_SIZE_M else 1.0
