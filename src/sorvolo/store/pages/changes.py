"""A flight's changes as one page of HTML: the map, a swipe between the two dates, and each change before and after.

The page needs no other file and no network; its one small script moves the swipe, without it both halves are shown.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from sorvolo.geometry.arrays import Floats, ImageRGBA, PointsPx, size_within
from sorvolo.geometry.grid import SiteGrid
from sorvolo.store.exports.map_pictures import Picture
from sorvolo.store.exports.places import SYSTEMS, place_words
from sorvolo.store.exports.plain import time_words
from sorvolo.store.images import shrink
from sorvolo.store.pages.words import (
    area_words,
    at,
    finite_or_none,
    known,
    length_words,
    number_at,
    picture_uri,
    render,
    with_unit,
)
from sorvolo.store.site.change_records import StoredChange, grouped_changes
from sorvolo.survey.coverage import GAP_WORDS, Gap
from sorvolo.survey.findings import ChangeKind, Verdict
from sorvolo.survey.flight import Site

_MANY = 40  # changes on one map: their numbers become small
_CROP_PX = 320  # longer side of a picture on a page
_CROPS_BYTES = 6_000_000  # of all crops in the page together
_RIM = 0.96  # of the map: where an outline reaches beyond, its number stands on the other side

_Crops = tuple[ImageRGBA | None, ImageRGBA | None]


def changes_page(
    report: Mapping[str, Any],
    changes: Sequence[StoredChange],
    before: Picture | None,
    after: Picture | None,
    site: Site,
    crops: Mapping[str, _Crops],
    *,
    coverage: Sequence[Any] = (),
    before_words: tuple[str, str] = ("before", ""),
    after_words: tuple[str, str] = ("after", ""),
) -> str:
    """changes.html of one flight: `report` as in report.json with its "comparison" (docs/formats.md).

    `before` and `after` are the map's pictures on the same ground, None for a map without tiles; the words name them,
    and the day, which no line breaks. `crops` are the changes' pictures before and after by id, `coverage` the features
    of coverage.geojson. What the report does not hold is left out. All text is escaped.
    """
    most_bytes = int(_CROPS_BYTES / max(2 * len(changes), 1))
    shown = (
        (before, after)
        if before is not None and after is not None and after.rgba.size > 0
        else None
    )
    groups = [
        [
            _listed(
                each,
                site,
                crops.get(each.id, (None, None)),
                most_bytes,
                shown[1] if shown else None,
            )
            for each in group
        ]
        for group in grouped_changes(changes)
    ]
    listed = [each for group in groups for each in group]
    kinds, verdicts = (
        Counter(each.kind for each in changes),
        Counter(each.verdict for each in changes if each.verdict is not None),
    )
    measured = [name for name, _ in listed[0].cells] if listed else []
    residual_px = number_at(report, "comparison", "residual_px", "median")
    rows = [
        ("method", at(report, "comparison", "method")),
        ("misalignment of views and map", with_unit(residual_px, "{:.2f} px median")),
        *(
            (str(name).replace("_", " "), _plain(value))
            for name, value in (at(report, "comparison", "chosen") or {}).items()
        ),
    ]
    page = render(
        "changes.html",
        report,
        title=f"{report.get('flight')} - changes",
        kinds={kind.value: kinds[kind] for kind in ChangeKind if kinds[kind]},
        verdicts={verdict.value: verdicts[verdict] for verdict in Verdict if verdicts[verdict]},
        is_many=len(changes) > _MANY,
        before_words=before_words,
        after_words=after_words,
        map={
            "before": picture_uri(shown[0].rgba),
            "after": picture_uri(shown[1].rgba),
            "width": shown[1].rgba.shape[1],
            "height": shown[1].rgba.shape[0],
        }
        if shown
        else None,
        coverage=coverage_shapes(coverage, site, shown[1]) if shown and not site.is_local else (),
        gap_rows=gap_rows(coverage),
        size_rows=() if site.is_local else size_rows(coverage),
        changes=listed,
        groups=groups,
        has_metres=not site.is_local,
        systems=() if site.is_local else tuple(SYSTEMS.items()),
        columns=["", "kind", *(["verdict"] if verdicts else []), *measured, "place", "id"],
        not_announced=[
            (known(count), words, str(reason))
            for name, words in (
                ("withdrawn", "withdrawn after being announced"),
                ("never_announced", "never announced"),
            )
            for reason, count in (at(report, "comparison", "candidates", name) or {}).items()
        ],
        reasons=[
            (count, why) for why, count in (at(report, "comparison", "reasons") or {}).items()
        ],
        how=[(name, str(value)) for name, value in rows if value is not None],
    )
    return str(page)


@dataclass(frozen=True)
class _Pin:
    """Where a change's number stands on the map, per cent of its sides, and beside which corner."""

    left: str
    top: str
    beside: str


@dataclass(frozen=True)
class _Crop:
    """One picture of a change, "" for one that is missing, with the outline's points on it."""

    when: str
    address: str
    width: int
    height: int
    points: str


@dataclass(frozen=True)
class _Listed:
    """A change as the page shows it."""

    number: int
    id: str
    kind: str
    verdict: str
    classes: str
    points: str
    pin: _Pin | None
    place: tuple[tuple[str, str], ...]
    cells: tuple[tuple[str, str], ...]
    details: tuple[tuple[str, str], ...]
    crops: tuple[_Crop, ...]


def _listed(
    change: StoredChange, site: Site, crops: _Crops, most_bytes: int, shown: Picture | None
) -> _Listed:
    outline_px = None if shown is None else _outline_px(change, site, shown)
    details = [
        (f"{name} (1 sigma)" if name == "position accuracy" else name, value)
        for name, value in _cells(change, site)
    ]
    details.append(("last seen", time_words(change.last_seen_ns)))
    if change.kind in (ChangeKind.DISAPPEARED, ChangeKind.REPLACED):
        details.append(("was", change.class_before or "unknown object"))
    if change.kind in (ChangeKind.APPEARED, ChangeKind.REPLACED, ChangeKind.MOVING):
        details.append(("is now", change.class_after or "unknown object"))
    if not site.is_local and np.isfinite(change.sigma_in_map_m):
        details.append(("position on this map (1 sigma)", _length(change.sigma_in_map_m)))
    if change.height_change is not None:
        risen = change.height_change
        details.append(
            ("height change", f"{risen.rise_m:+.2f} m (accuracy {risen.sigma_m:.2f} m, 1 sigma)")
        )
    if change.kind is ChangeKind.MOVING:
        details.append(("moves", _velocity(change.velocity_m_s, site)))
    if change.note:
        details.append(("note", change.note))
    return _Listed(
        change.number,
        change.id,
        change.kind.value,
        "" if change.verdict is None else change.verdict.value,
        change.kind.value + (" is-rejected" if change.verdict is Verdict.REJECTED else ""),
        "" if outline_px is None else _points(outline_px),
        None if outline_px is None or shown is None else _pin(outline_px, shown),
        tuple(place_words(change.centre_m, site).items()),
        _cells(change, site),
        tuple(details),
        tuple(
            _crop(rgba, change, when, most_bytes) for when, rgba in zip(("before", "after"), crops)
        ),
    )


def _cells(change: StoredChange, site: Site) -> tuple[tuple[str, str], ...]:
    """The columns of the list; without GPS lengths have no unit and are left out."""
    measured = (
        ()
        if site.is_local
        else (
            ("size", _length(change.length_m)),
            ("area", _area(change.area_m2)),
            ("position accuracy", _length(change.sigma_m)),
        )
    )
    return (
        *measured,
        ("views", "1 alone" if change.is_single_view else str(change.views)),
        ("first seen", time_words(change.first_seen_ns)),
        ("score", f"{change.score:.2f}"),
    )


def _crop(rgba: ImageRGBA | None, change: StoredChange, when: str, most_bytes: int) -> _Crop:
    if rgba is None:
        return _Crop(when, "", 0, 0, "")
    height_px, width_px = rgba.shape[:2]
    small = shrink(rgba, *size_within(rgba, _CROP_PX))
    crop = change.crop
    outline_px = (change.outline_m - [crop.west_m, crop.north_m]) * [1, -1] / crop.m_per_px
    return _Crop(when, picture_uri(small, most_bytes), width_px, height_px, _points(outline_px))


def _outline_px(change: StoredChange, site: Site, shown: Picture) -> PointsPx:
    """(N, 2) the outline on the picture, counted from its outer corner."""
    grid = SiteGrid.at(site.origin, site.m_per_px, site.crs)
    pixels: Floats = (grid.grid_from_site(change.outline_m) - shown.corner_px) / shown.step_px
    return pixels


def _pin(outline_px: PointsPx, shown: Picture) -> _Pin | None:
    """Where the change's number stands: beside the outline and within the map; None for one beside the map."""
    height_px, width_px = shown.rgba.shape[:2]
    low, high = outline_px.min(axis=0), outline_px.max(axis=0)
    is_right, is_above = (
        high[0] < _RIM * width_px,
        low[1] > (1 - _RIM) * height_px,
    )  # else the rim would cut it
    x, y = high[0] if is_right else low[0], low[1] if is_above else high[1]
    if not (0 <= x <= width_px and 0 <= y <= height_px):
        return None
    beside = f"{'0' if is_right else '-100%'},{'-100%' if is_above else '0'}"
    return _Pin(f"{100 * x / width_px:.3f}", f"{100 * y / height_px:.3f}", beside)


def _points(outline_px: PointsPx) -> str:
    """The outline as an SVG polygon's points."""
    simple = cv2.approxPolyDP(outline_px.astype(np.float32)[:, None], 0.3, True)[:, 0]
    return " ".join(f"{x:.1f},{y:.1f}" for x, y in (simple if len(simple) > 2 else outline_px))


def _plain(value: Any) -> str:
    """A setting as text, numbers short."""
    if isinstance(value, Mapping):
        return ", ".join(f"{name} {_plain(each)}" for name, each in value.items())
    if isinstance(value, list | tuple):
        return ", ".join(_plain(each) for each in value)
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _velocity(velocity_m_s: Floats, site: Site) -> str:
    if site.is_local:
        return "yes"
    towards = (
        "north",
        "north-east",
        "east",
        "south-east",
        "south",
        "south-west",
        "west",
        "north-west",
    )[round(float(np.arctan2(*velocity_m_s)) / (np.pi / 4)) % 8]
    return f"{float(np.hypot(*velocity_m_s)):.1f} m/s to the {towards}"


def _length(value_m: float) -> str:
    return str(length_words(value_m)) if np.isfinite(value_m) else "unknown"


def _area(value_m2: float) -> str:
    if not np.isfinite(value_m2):
        return "unknown"
    return f"{value_m2:.2g} m²" if value_m2 < 10 else area_words(value_m2)


_PALEST, _DARKEST, _RANGE = (
    0.05,
    0.6,
    8.0,
)  # how dark a size is drawn, over so many times the smallest size


@dataclass(frozen=True)
class CoverageShape:
    """One part of the ground as an SVG path, `opacity` by the size from which things are found there."""

    path: str
    is_compared: bool
    opacity: str


def coverage_shapes(coverage: Sequence[Any], site: Site, shown: Picture) -> list[CoverageShape]:
    """The features of coverage.geojson on the page's picture; features that somebody broke are left out."""
    grid = SiteGrid.at(site.origin, site.m_per_px, site.crs)
    sizes_m = [
        size for each in coverage if (size := finite_or_none(at(each, "properties", "smallest_m")))
    ]
    finest_m = min(sizes_m, default=1.0)
    shapes = []
    for feature in coverage:
        rings = [
            (grid.grid_from_site(np.array(ring, float).reshape(-1, 2)) - shown.corner_px)
            / shown.step_px
            for polygon in at(feature, "rings_m") or ()
            for ring in polygon
        ]
        path = "".join("M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in ring) + "Z" for ring in rings)
        size_m = finite_or_none(at(feature, "properties", "smallest_m")) or _RANGE * finest_m
        share = min(float(np.log(size_m / finest_m) / np.log(_RANGE)), 1.0)
        is_compared = at(feature, "properties", "status") == "compared"
        shapes.append(
            CoverageShape(path, is_compared, f"{_PALEST + (_DARKEST - _PALEST) * share:.2f}")
        )
    return shapes


def gap_rows(coverage: Sequence[Any]) -> list[tuple[str, str]]:
    """Why ground was not compared, and how much of it, the largest part first."""
    areas: dict[tuple[str, str], float] = {}
    for feature in coverage:
        gap, why = at(feature, "properties", "gap"), str(at(feature, "properties", "why") or "")
        if gap in list(Gap):
            areas[gap, why] = areas.get((gap, why), 0.0) + _area_m2(feature)
    largest_first = sorted(areas.items(), key=lambda item: -item[1])
    return [
        (GAP_WORDS[Gap(gap)] + (f": {why}" if why else ""), area_words(area))
        for (gap, why), area in largest_first
    ]


def size_rows(coverage: Sequence[Any]) -> list[tuple[str, str, str]]:
    """From which size on plain and faint things are found, and on how much of the ground."""
    areas: dict[tuple[float, float], float] = {}
    for feature in coverage:
        if at(feature, "properties", "status") == "compared":
            found = (
                finite_or_none(at(feature, "properties", name))
                for name in ("smallest_m", "faint_m")
            )
            plain, faint = (float("inf") if each is None else each for each in found)
            areas[plain, faint] = areas.get((plain, faint), 0.0) + _area_m2(feature)
    return [
        (_size_words(plain), _size_words(faint), area_words(area))
        for (plain, faint), area in sorted(areas.items())
    ]


def _area_m2(feature: Any) -> float:
    return finite_or_none(at(feature, "properties", "area_m2")) or 0.0


def _size_words(size_m: float) -> str:
    return length_words(size_m) or "" if np.isfinite(size_m) else "none of the drawn sizes"
