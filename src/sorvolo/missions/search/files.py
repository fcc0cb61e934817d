"""What a measured search leaves: maps of the probability, holes, waypoints over them, the page, the numbers."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from sorvolo.geometry.arrays import ImageRGBA, PointsM
from sorvolo.geometry.grid import SiteGrid, TileIndex
from sorvolo.missions.flight.detector_protocol import ObjectDetector
from sorvolo.missions.plan_flight import ReflySettings
from sorvolo.missions.search.refly import write_refly
from sorvolo.missions.search.report import (
    Searched,
    SoFar,
    State,
    build_search_report,
    hole_numbers,
    total_of,
)
from sorvolo.missions.search.settings import FIGURES, SearchOutputs, SearchSettings
from sorvolo.search.holes import POD_EDGES, REASONS, flyable, pod_classes, without_seen
from sorvolo.store.atomic import atomic_write_bytes, writing
from sorvolo.store.exports.map_pictures import picture
from sorvolo.store.exports.plain import feature_collection, geojson_bytes, json_bytes
from sorvolo.store.exports.pod_files import (
    PICTURE_PX,
    CellGrid,
    Region,
    pod_picture,
    region_features,
    regions_of,
    write_pod_tif,
)
from sorvolo.store.pages.search import search_page


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
    with writing(outputs.folder):
        outputs.folder.mkdir(parents=True, exist_ok=True)
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
    write_pod_tif(
        outputs.folder / "pod.tif",
        bands,
        grid,
        {"sorvolo": "probability of detection; docs/search.md"},
    )
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
    report = build_search_report(searched, settings, detector, refly, so_far, warnings)
    atomic_write_bytes(outputs.folder / "search.json", json_bytes(report))
    atomic_write_bytes(outputs.folder / "search.html", search_page(report, pictures).encode())
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
        f"no waypoints were written: no hole of {ReflySettings().least_m2:g} m2 or more is left that another flight "
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
