"""The ground that a flight saw, or that a comparison could speak about, and the rest with its reason, as GeoJSON."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from sorvolo.geometry.arrays import Floats, PointsM
from sorvolo.geometry.polygons import signed_area, swollen
from sorvolo.store.exports.places import longitude_latitude
from sorvolo.store.exports.plain import feature_collection, rounded
from sorvolo.survey.coverage import CoveredGround, SeenGround
from sorvolo.survey.flight import Site

COVERAGE = "coverage"
"""The collection's name, and its file's without the ending."""


def coverage_geojson(ground: Sequence[CoveredGround], site: Site) -> dict[str, Any]:
    """The ground under a flight's views as a FeatureCollection, a MultiPolygon for each part (docs/formats.md).

    Outlines turn counter-clockwise, holes clockwise. For a local site it is plain JSON with coordinates in pixels.
    """
    return feature_collection(
        COVERAGE, [_feature(each, site) for each in ground], is_local=site.is_local
    )


def seen_geojson(ground: Sequence[SeenGround], site: Site) -> dict[str, Any]:
    """The ground that a flight's pictures show as `coverage_geojson` has it, and the holes (docs/formats.md)."""
    return feature_collection(
        COVERAGE, [_seen(each, site) for each in ground], is_local=site.is_local
    )


def holes_lonlat(
    ground: Sequence[SeenGround], site: Site, reach_m: float
) -> tuple[tuple[Floats, ...], ...]:
    """Parts of the ground as polygons of longitude and latitude, widened by so many metres; those that then touch are
    one."""
    polygons = [rings for each in ground for rings in each.polygons]
    return tuple(
        tuple(np.column_stack(longitude_latitude(ring, site)) for ring in rings)
        for rings in swollen(polygons, reach_m)
    )


def _seen(ground: SeenGround, site: Site) -> dict[str, Any]:
    return _multipolygon(
        ground.polygons,
        site,
        {
            "status": "seen" if ground.views else "hole",
            "views": ground.views,
            "m_per_px": rounded(ground.m_per_px, 4),
            "area_m2": rounded(ground.area_m2, 1),
        },
    )


def _feature(ground: CoveredGround, site: Site) -> dict[str, Any]:
    properties = {
        "status": "compared" if ground.gap is None else "not-compared",
        "gap": None if ground.gap is None else ground.gap.value,
        "why": ground.why or None,
        "area_m2": rounded(ground.area_m2, 1),
        "smallest_m": rounded(ground.smallest_m, 2),
        "faint_m": rounded(ground.faint_m, 2),
    }
    return _multipolygon(ground.polygons, site, properties)


def _multipolygon(
    polygons_m: Sequence[Sequence[PointsM]], site: Site, properties: dict[str, Any]
) -> dict[str, Any]:
    polygons = [
        [_ring(ring, site, is_hole=place > 0) for place, ring in enumerate(rings)]
        for rings in polygons_m
    ]
    geometry = {"type": "MultiPolygon", "coordinates": polygons}
    rings_m = [[np.round(ring, 3).tolist() for ring in rings] for rings in polygons_m]
    return {"type": "Feature", "geometry": geometry, "properties": properties, "rings_m": rings_m}


def _ring(ring_m: PointsM, site: Site, *, is_hole: bool) -> list[list[float]]:
    corners = ring_m if (signed_area(ring_m) >= 0) != is_hole else ring_m[::-1]
    if not site.is_local:
        corners = np.column_stack(longitude_latitude(corners, site))
    return [[round(float(x), 8), round(float(y), 8)] for x, y in [*corners, corners[0]]]
