"""The ground that a comparison could not speak about, as a layer over the page's map and as a table."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sorvolo.geometry.grid import SiteGrid
from sorvolo.store.exports.map_pictures import Picture
from sorvolo.store.pages.words import area_words, at, finite_or_none, length_words
from sorvolo.survey.coverage import GAP_WORDS, Gap
from sorvolo.survey.flight import Site

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


def coverage_words(comparison: Mapping[str, Any]) -> tuple[str, str] | None:
    """The ground that was compared and the ground that was not: " in 2.1 ha", "; 0.4 ha could not be compared"; None
    for reports that lack it."""
    compared_m2 = finite_or_none(at(comparison, "coverage", "compared_m2"))
    missing_m2 = finite_or_none(at(comparison, "coverage", "not_compared_m2"))
    if compared_m2 is None or missing_m2 is None:
        return None
    return f" in {area_words(compared_m2)}", f"; {area_words(missing_m2)} could not be compared"


def _size_words(size_m: float) -> str:
    return length_words(size_m) or "" if np.isfinite(size_m) else "none of the drawn sizes"
