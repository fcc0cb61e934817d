"""`sorvolo search`: a site's flights measured, and what a search of the area would have found written down."""

from collections.abc import Generator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sorvolo.capture.areas import read_area, read_segments
from sorvolo.errors import InputError, SettingsError
from sorvolo.geometry.arrays import Floats, PointsM
from sorvolo.geometry.grid import SiteGrid
from sorvolo.missions.flight.detector_protocol import ObjectDetector
from sorvolo.missions.flight.map_objects import open_detector, why_not_searched
from sorvolo.missions.search.frames import flights_to_search, heights_for, search_frames
from sorvolo.missions.search.measure import (
    MeasuredFlight,
    SearchFrame,
    SearchProgress,
    measure_flight,
    planted_classes,
)
from sorvolo.missions.search.refly import write_refly
from sorvolo.missions.search.report import Searched, build_search_report, hole_numbers, total_of
from sorvolo.missions.search.settings import SearchSettings
from sorvolo.search.cells import Cells, cell_side_m, cells_over
from sorvolo.search.holes import POD_EDGES, REASONS, flyable, pod_classes
from sorvolo.store.atomic import atomic_write_bytes, writing
from sorvolo.store.exports.map_pictures import picture
from sorvolo.store.exports.plain import feature_collection, geojson_bytes, json_bytes
from sorvolo.store.exports.pod_files import CellGrid, Region, pod_picture, region_features, regions_of, write_pod_tif
from sorvolo.store.exports.waypoints import check_waypoint_files
from sorvolo.store.pages.search import search_page
from sorvolo.store.site.archive import Archive
from sorvolo.survey.area import Area
from sorvolo.survey.flight import Site


@dataclass(frozen=True)
class SearchOutputs:
    """Where results go and what they are counted over.

    `area` is what was to be searched (None: what the frames show and enclose), `poa` a file of segments with the
    probability that the missing is in each, `flights` those that are measured (none: all of the site's), `refly` files
    for waypoints over the holes; a .kmz is for `dji_drone`.
    """

    folder: Path
    area: Path | None = None
    poa: Path | None = None
    flights: tuple[str, ...] = ()
    refly: tuple[Path, ...] = ()
    dji_drone: str = "fly"


@dataclass(frozen=True, eq=False)
class PreparedSearch:
    """What a search needs beside a site, read and checked: the area, the segments with their probabilities, a
    detector."""

    area: Area | None
    segments: Sequence[tuple[str, Area, float]]
    detector: ObjectDetector


def prepare_search(
    settings: SearchSettings, outputs: SearchOutputs, detector: ObjectDetector | None = None
) -> PreparedSearch:
    """Read and check all that a search needs beside a site, before it takes any time.

    Raises InputError for a broken area or file of segments and for a model that is not there, SettingsError for classes
    that cannot be measured, and for a folder or a file of waypoints that cannot be written.
    """
    if outputs.folder.exists() and not outputs.folder.is_dir():
        raise SettingsError(f"--out {outputs.folder} is a file, a folder was needed")
    check_waypoint_files(outputs.refly, outputs.folder, outputs.dji_drone)
    area = None if outputs.area is None else read_area(outputs.area)
    segments = [] if outputs.poa is None else read_segments(outputs.poa)
    looks = open_detector(settings.model) if detector is None else detector
    if looks is None:
        raise InputError(f"nothing to measure: {why_not_searched(settings.model)}")
    planted_classes(looks, settings)
    return PreparedSearch(area, segments, looks)


def search_site(
    site_folder: Path, settings: SearchSettings, outputs: SearchOutputs, detector: ObjectDetector | None = None
) -> Generator[SearchProgress | dict[str, Any]]:
    """Measure the flights of a site, yielding progress and, at last, the report; files appear in `outputs.folder`.

    The probability that a person, or a car, who lay anywhere in the area would have been reported is learnt from ones
    drawn into the flights' own frames. Raises InputError for a site without metres or flights, and for a model that is
    not installed; what `prepare_search` refuses is refused before any work.
    """
    prepared = prepare_search(settings, outputs, detector)
    area, looks = prepared.area, prepared.detector
    with Archive.open(site_folder, write=False) as archive:
        site = _site_with_metres(archive)
        names = flights_to_search(archive, outputs.flights)
        frames = {name: search_frames(archive, name) for name in names}
        if not frames:
            raise InputError(f"{site_folder} has no mapped flight: sorvolo map INPUT --site {site_folder} makes one")
        cells = _cells(site, frames, None if area is None else area.polygons_m(site.frame))
        measured = yield from _measured(frames, cells, archive, looks, settings)
        searched = Searched(
            site, cells, tuple(measured), {name: tuple(own) for name, own in frames.items()}, prepared.segments
        )
        yield _write(searched, archive, settings, outputs, looks)


def _measured(
    frames: Mapping[str, Sequence[SearchFrame]], cells: Cells, archive: Archive, detector: ObjectDetector,
    settings: SearchSettings,
) -> Generator[SearchProgress, None, list[MeasuredFlight]]:
    """Each flight measured, one after the other."""
    site, known_m, measured = archive.site(), _known_places(archive), []
    for name, own in frames.items():
        for each in measure_flight(
            name, own, cells, site, detector, settings, known_m, heights_for(archive, name)
        ):
            if isinstance(each, MeasuredFlight):
                measured.append(each)
            else:
                yield each
    return measured


def _site_with_metres(archive: Archive) -> Site:
    site = archive.site()
    if site.is_local:
        raise InputError(
            f"{archive.folder} was mapped without GPS: its map has no metres, so nobody can be planted to scale; map "
            "the flight with telemetry"
        )
    return site


def _known_places(archive: Archive) -> list[Floats]:
    """Where something stands by the maps."""
    return [each.thing.position_m for each in archive.newest_objects()]


def _cells(
    site: Site, frames: Mapping[str, Sequence[SearchFrame]], area_m: Sequence[Sequence[PointsM]] | None
) -> Cells:
    outlines_m = [each.placed.outline_m for own in frames.values() for each in own]
    side_m = cell_side_m([*outlines_m, *(ring for rings in area_m or () for ring in rings)])
    return cells_over(outlines_m, SiteGrid.at(site.origin, side_m, site.crs), area_m)


def _write(
    searched: Searched, archive: Archive, settings: SearchSettings, outputs: SearchOutputs, detector: ObjectDetector
) -> dict[str, Any]:
    """All files; the report."""
    site, cells = searched.site, searched.cells
    grid = CellGrid(cells.outer_corner_m(), cells.cell_m, site.crs, site.origin.longitude_deg)
    with writing(outputs.folder):
        outputs.folder.mkdir(parents=True, exist_ok=True)
    bands, features, pictures = {}, [], {}
    shown = picture(archive.tiles(), 1200)
    for label in searched.labels:
        total, holes = total_of(searched, label), hole_numbers(searched, label, settings, detector.info)
        classes = cells.as_grid(pod_classes(total, cells.wanted))
        hole_grid = cells.as_grid(holes)
        for name, values in (("pod", total.mean), ("low", total.low), ("high", total.high)):
            bands[f"{label}: {name}"] = cells.as_grid(values)
        features += _features(label, regions_of(classes, grid), regions_of(hole_grid, grid))
        pictures[label] = pod_picture(shown, archive.site_grid(), classes, hole_grid > 0, grid)
        if label == searched.labels[0]:
            again = regions_of(cells.as_grid(flyable(holes)), grid)
    write_pod_tif(outputs.folder / "pod.tif", bands, grid, {"sorvolo": "probability of detection; docs/search.md"})
    collection = feature_collection("pod", features, is_local=False)
    atomic_write_bytes(outputs.folder / "pod.geojson", geojson_bytes(collection))
    refly = write_refly(again, grid, searched, settings, detector.info, outputs.refly, dji_drone=outputs.dji_drone)
    report = build_search_report(searched, settings, detector, refly)
    atomic_write_bytes(outputs.folder / "search.json", json_bytes(report))
    atomic_write_bytes(outputs.folder / "search.html", search_page(report, pictures).encode())
    return report


def _features(label: str, classes: Sequence[Region], holes: Sequence[Region]) -> list[dict[str, Any]]:
    """Polygons of equal classes of probability, then the holes with their reasons."""
    ranges = [(POD_EDGES[each.number - 1], POD_EDGES[each.number]) for each in classes]
    properties = [{"kind": "pod", "class": label, "pod_from": low, "pod_to": high} for low, high in ranges]
    reasons = [
        {"kind": "hole", "class": label, "reason": REASONS[each.number].value} for each in holes
    ]
    return region_features(classes, properties) + region_features(holes, reasons)
