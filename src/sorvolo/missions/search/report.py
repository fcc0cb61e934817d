"""A measured search's report: chances over all flights, holes and their reasons, the figures of a search, in words."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any

from sorvolo.detection.contract import ModelInfo
from sorvolo.detection.tiling import coarsest_m_per_px
from sorvolo.geometry.arrays import ImageRGBA, PointsM
from sorvolo.geometry.camera import Camera
from sorvolo.geometry.grid import SiteGrid, TileIndex
from sorvolo.geometry.summary import calibration_bins, median_of_known, wilson
from sorvolo.missions.flight.detector_protocol import ObjectDetector
from sorvolo.missions.plan_flight import REFLY_LEAST_M2, REFLY_LOWEST_M, REFLY_MOST_HOLES, fly_again
from sorvolo.missions.search.measure import MeasuredClass, MeasuredFlight, SearchFrame
from sorvolo.missions.search.settings import CUT_OUTS, FIGURES, SearchOutputs, SearchSettings
from sorvolo.search.cells import Cells
from sorvolo.search.drawing.cut_outs import CutOut, sheet_of
from sorvolo.search.holes import (
    POD_EDGES,
    REASONS,
    HoleReason,
    Holes,
    flyable,
    hole_areas_m2,
    hole_reasons,
    pod_classes,
    reasons_together,
    without_seen,
)
from sorvolo.search.recall import (
    Chances,
    figures,
    held_out_chances,
    path_length_m,
    segment,
    together,
)
from sorvolo.store.atomic import atomic_write_bytes, make_folder, write_page
from sorvolo.store.exports.map_pictures import picture
from sorvolo.store.exports.plain import feature_collection, geojson_bytes, json_bytes, plain_json
from sorvolo.store.exports.pod_files import (
    PICTURE_PX,
    CellGrid,
    Region,
    pod_picture,
    region_features,
    regions_of,
    swollen_polygons,
    write_pod_tif,
)
from sorvolo.store.images import png_from_rgba
from sorvolo.store.pages.search import search_page
from sorvolo.survey.area import Area, inside_any
from sorvolo.survey.flight import Site
from sorvolo.survey.objects import TYPICAL_SIZE_M
from sorvolo.survey.wording import counted
from sorvolo.tracking.laying import pose_of

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
    """All that was measured of a site; `segments` are names, areas and the probability that the missing is in each.
    `unlooked` are flights in whose own pictures nobody looked for the first class: only their plants were. `unplaced`
    could not be measured: none of their frames has a place."""

    site: Site
    cells: Cells
    flights: tuple[MeasuredFlight, ...]
    frames: Mapping[str, tuple[SearchFrame, ...]]
    segments: Sequence[tuple[str, Area, float]]
    unlooked: Sequence[str] = ()
    unplaced: Sequence[str] = ()
    cut_outs: tuple[CutOut, ...] = ()

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
        poses = [pose_of(each.placed) for each in self.frames[self.flights[-1].name]]
        known_m = [float(pose.translation_m[2]) for pose in poses if pose is not None]
        return median_of_known(known_m) or 0.0

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
            needed_m_per_px=coarsest_m_per_px(label, info),
            length_m=max(TYPICAL_SIZE_M.get(label, (1.0,))),
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


def is_coarse(searched: Searched, settings: SearchSettings, info: ModelInfo) -> bool:
    """Whether any hole is one since its pixels are too coarse."""
    numbers = hole_numbers(searched, searched.labels[0], settings, info)
    return HoleReason.COARSE.value in hole_areas_m2(numbers, searched.cells.cell_m)


def build_search_report(
    searched: Searched,
    settings: SearchSettings,
    detector: ObjectDetector,
    refly: "Refly | None",
    so_far: SoFar | None,
    warnings: Sequence[str],
) -> dict[str, Any]:
    """search.json (docs/formats.md), these warnings first; `so_far` is given while the flight goes on."""
    rows = {
        label: _class_row(searched, label, settings, detector.info) for label in searched.labels
    }
    first = searched.labels[0]
    # the search in one line, and whether all of the area was searched well enough
    row, area_m2 = rows[first], rows[first]["area_m2"]
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
    looked = f"; {row['seen_m2'] / area_m2:.0%} of the area looked at" if area_m2 else ""
    text = f"{by}probability of detection of a {first} anywhere in the area: {chance}{looked}"
    total = sum(shares.values())
    is_complete = total <= _MOST_HOLES
    text += (
        "; no holes"
        if is_complete
        else (
            f"; {total:.0%} of the area is below {settings.enough:g}: {holes or 'in small pieces'}"
        )
    )
    headline = {"text": text, "complete": is_complete, "hole_share": total}
    for flights, lack in (
        (searched.unlooked, f"nobody has looked for a {first} in {{}}: map it again with a model"),
        (
            searched.unplaced,
            "no frame of {} has a place on the ground, so it is left out: map it again",
        ),
    ):
        if flights:
            headline["text"] += "; " + lack.format(", ".join(flights))
            headline["complete"] = False
    report = {
        "site": searched.site.name,
        "model": detector.info.name,
        "settings": asdict(settings),
        "cell_m": searched.cells.cell_m,
        "headline": headline,
        "so_far": None if so_far is None else asdict(so_far),
        "classes": rows,
        "flights": [_flight_row(each) for each in searched.flights],
        "segments": _segment_rows(searched, first),
        "refly": None if refly is None else asdict(refly),
        "cut_outs": [each.name for each in searched.cut_outs],
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
        "under_trees": flight.floor,
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
    for flight in searched.flights:
        if flight.floor is not None:
            warnings.append(
                "{}: {area_m2:,.0f} m2 below crowns count by its look through the trees: {pod:.2f} (90 % interval "
                "{pod_low:.2f} to {pod_high:.2f})".format(flight.name, **flight.floor)
            )
    if any(each.floor is None for each in searched.flights):
        warnings.append(
            "ground under trees counts as not found at all; --through-trees looks below them"
        )
    if "person" in searched.labels and searched.cut_outs:
        gsd_m = searched.height_m / searched.camera.fx_px
        coarse = sum(each.m_per_px > 1.2 * gsd_m for each in searched.cut_outs)
        warnings.append(
            f"plants are {counted(len(searched.cut_outs), 'picture')} of your own people (look at {CUT_OUTS}): the probability is of such "
            f"who dress and lie so{'; ' + str(coarse) + ' of the pictures are coarser than the flight, so that it is too low' * bool(coarse)}"
        )
    elif "person" in searched.labels:
        warnings.append(
            "plants are drawn people, and the detector finds drawn and real people differently well: compare the "
            "probability between places and flights rather than taking it at its word (docs/search.md)"
        )
    return warnings


@dataclass(frozen=True)
class Refly:
    """A second flight: how many holes of which area, how high, how long, and the files."""

    holes: int
    area_m2: float
    height_m: float
    duration_s: float
    files: tuple[str, ...]


def write_refly(
    again: Sequence[Region],
    grid: CellGrid,
    searched: Searched,
    settings: SearchSettings,
    info: ModelInfo,
    files: Sequence[Path],
    *,
    dji_drone: str,
) -> Refly | None:
    """Plan passes over the holes and write them; None where no hole is worth a flight.

    It is flown as high as the first flights, lower where their pictures were too coarse for the detector.
    """
    large = [each for each in again if each.area_m2 >= REFLY_LEAST_M2][:REFLY_MOST_HOLES]
    if not large:
        return None
    rings = swollen_polygons(large, grid, grid.cell_m / 2)
    area = Area(tuple(rings), "holes of the search")
    camera, height_m = searched.camera, searched.height_m
    if is_coarse(searched, settings, info):
        needed = coarsest_m_per_px(searched.labels[0], info)
        height_m = max(REFLY_LOWEST_M, min(height_m, 0.9 * needed * camera.fx_px))
    plan = fly_again(area, camera, height_m, files, dji_drone=dji_drone)
    return Refly(
        len(large),
        sum(each.area_m2 for each in large),
        plan.height_m,
        plan.duration_s,
        tuple(map(str, files)),
    )


def write_search(
    searched: Searched,
    tiles: Mapping[TileIndex, ImageRGBA],
    site_grid: SiteGrid,
    settings: SearchSettings,
    outputs: SearchOutputs,
    detector: ObjectDetector,
    so_far: SoFar | None = None,
    seen_before_m: Sequence[PointsM] = (),
) -> dict[str, Any]:
    """Write all files of a measured search over the map of these `tiles`, and return its report.

    `so_far` is given of a flight that is not mapped whole; what earlier flights' frames of these outlines, (4, 2) site
    metres each, show need not be flown again by it. Files of waypoints are taken away where nothing has to be flown
    (which a warning states), or the flight was stopped. Raises StoreError where the disk is full.
    """
    site, cells = searched.site, searched.cells
    grid = CellGrid(cells.outer_corner_m(), cells.cell_m, site.crs, site.origin.longitude_deg)
    make_folder(outputs.folder)
    bands, features, pictures = {}, [], {}
    shown = picture(tiles, PICTURE_PX)
    for label in searched.labels:
        total, holes = (
            total_of(searched, label),
            hole_numbers(searched, label, settings, detector.info),
        )
        classes = cells.as_grid(pod_classes(total, cells.wanted))
        hole_grid = cells.as_grid(holes)
        for name, values in (("pod", total.mean), ("low", total.low), ("high", total.high)):
            bands[f"{label}: {name}"] = cells.as_grid(values)
        features += _features(label, regions_of(classes, grid), regions_of(hole_grid, grid))
        pictures[label] = pod_picture(shown, site_grid, classes, hole_grid > 0, grid)
        if label == searched.labels[0]:
            again = regions_of(
                cells.as_grid(flyable(without_seen(holes, cells, seen_before_m))), grid
            )
    write_pod_tif(outputs.folder / "pod.tif", bands, grid)
    collection = feature_collection("pod", features, is_local=False)
    atomic_write_bytes(outputs.folder / "pod.geojson", geojson_bytes(collection))
    was_stopped = so_far is not None and so_far.state is State.STOPPED
    refly = (
        None
        if was_stopped
        else write_refly(
            again,
            grid,
            searched,
            settings,
            detector.info,
            outputs.refly,
            dji_drone=outputs.dji_drone,
        )
    )
    warnings = (
        []
        if refly is not None
        else _without_waypoints(
            outputs.refly, was_stopped=was_stopped, leaves_earlier=len(seen_before_m) > 0
        )
    )
    if searched.cut_outs:
        atomic_write_bytes(outputs.folder / CUT_OUTS, png_from_rgba(sheet_of(searched.cut_outs)))
    report = build_search_report(searched, settings, detector, refly, so_far, warnings)
    atomic_write_bytes(outputs.folder / "search.json", json_bytes(report))
    write_page(outputs.folder / "search.html", search_page(report, pictures))
    return report


def remove_figures(outputs: SearchOutputs) -> list[str]:
    """Take away the figures and waypoints of an earlier search: a flight begins whose own come in their place.

    Returns the files of waypoints that there were.
    """
    _removed([outputs.folder / name for name in FIGURES])
    return _removed(outputs.refly)


def _removed(files: Sequence[Path]) -> list[str]:
    """Take these files away; those that there were."""
    there = [str(path) for path in files if path.is_file()]
    for path in files:
        path.unlink(missing_ok=True)
    return there


def _without_waypoints(
    files: Sequence[Path], *, was_stopped: bool, leaves_earlier: bool
) -> list[str]:
    """Take away earlier waypoints at these files, and what a person who asked for some has to know; `leaves_earlier`:
    what earlier flights show was not to be flown."""
    old = _removed(files)
    if not files:
        return []
    if was_stopped:
        return (
            [f"the flight was stopped, and its waypoints were taken away: {', '.join(old)}"]
            if old
            else []
        )
    removed = f"; earlier ones were taken away: {', '.join(old)}" if old else ""
    beside = " and that flights before it do not show" if leaves_earlier else ""
    return [
        f"no waypoints were written: no hole of {REFLY_LEAST_M2:g} m2 or more is left that another flight "
        f"may see{beside}{removed}"
    ]


def _features(
    label: str, classes: Sequence[Region], holes: Sequence[Region]
) -> list[dict[str, Any]]:
    """Polygons of equal classes of probability, then the holes with their reasons."""
    ranges = [(POD_EDGES[each.number - 1], POD_EDGES[each.number]) for each in classes]
    properties = [
        {"kind": "pod", "class": label, "pod_from": low, "pod_to": high} for low, high in ranges
    ]
    reasons = [
        {"kind": "hole", "class": label, "reason": REASONS[each.number].value} for each in holes
    ]
    return region_features(classes, properties) + region_features(holes, reasons)
