"""What a flight's frames show and where they were, and how far its map misses control points, as GeoJSON."""

from collections.abc import Sequence
from math import hypot
from typing import Any

import numpy as np

from sorvolo.geometry.arrays import Floats, PointsM
from sorvolo.geometry.polygons import signed_area, swollen
from sorvolo.geometry.pose import gimbal_angles_from_rotation
from sorvolo.store.exports.places import longitude_latitude, place_deg, ring
from sorvolo.store.exports.plain import (
    feature,
    feature_collection,
    frame_number,
    geojson_bytes,
    rounded,
    utc_text,
)
from sorvolo.survey.control import ControlReport, ControlResidual, ControlRole
from sorvolo.survey.coverage import CoveredGround, SeenGround
from sorvolo.survey.flight import Site
from sorvolo.survey.mosaic import PlacedFrame

COVERAGE = "coverage"
"""The collection's name, and its file's without the ending."""

CONTROL_FILE = "control.geojson"
"""In the flight's folder."""


def frames_geojson(placed: Sequence[PlacedFrame], site: Site) -> dict[str, Any]:
    """The frames of a flight as a GeoJSON FeatureCollection, one feature each (docs/formats.md).

    Longitudes run on beyond 180 degrees where a flight crosses the antimeridian. For a local site it is plain JSON with
    coordinates in pixels of the site.
    """
    return feature_collection(
        "frames", [_frame(frame, site) for frame in placed], is_local=site.is_local
    )


def _frame(frame: PlacedFrame, site: Site) -> dict[str, Any]:
    longitude_deg = latitude_deg = height_m = up_m = yaw_deg = pitch_deg = roll_deg = np.nan
    local = {}
    if frame.site_from_camera is not None:
        east_m, north_m, up_m = frame.site_from_camera.translation_m
        height_m = site.origin.height_m + up_m
        yaw_deg, pitch_deg, roll_deg = gimbal_angles_from_rotation(frame.site_from_camera.rotation)
        if site.is_local:
            local = {"camera_east": rounded(east_m, 6), "camera_north": rounded(north_m, 6)}
        else:
            longitude_deg, latitude_deg = place_deg(frame.site_from_camera.translation_m, site)
    properties = {
        "frame": frame_number(frame.name),
        "time": utc_text(frame.time_ns),
        "status": frame.status.value,
        "reason": frame.reason,
        "camera_longitude_deg": rounded(longitude_deg, 10),
        "camera_latitude_deg": rounded(latitude_deg, 10),
        **local,
        "camera_height_m": rounded(height_m, 4),
        "height_above_ground_m": rounded(up_m, 4),
        "height_reference": site.height_reference,
        "camera_yaw_deg": rounded(yaw_deg, 5),
        "camera_pitch_deg": rounded(pitch_deg, 5),
        "camera_roll_deg": rounded(roll_deg, 5),
        "residual_px": rounded(frame.residual_px, 4),
        "sigma_m": rounded(frame.sigma_m, 4),
        "gps_residual_east_m": rounded(frame.gps_residual_m[0], 4),
        "gps_residual_north_m": rounded(frame.gps_residual_m[1], 4),
        "gps_residual_up_m": rounded(frame.gps_residual_m[2], 4),
    }
    geometry = None
    if np.isfinite(frame.outline_m).all():
        geometry = {"type": "Polygon", "coordinates": [ring(frame.outline_m, site, 10)]}
    return feature(geometry, properties)


def coverage_geojson(ground: Sequence[CoveredGround], site: Site) -> dict[str, Any]:
    """The ground under a flight's views as a FeatureCollection, a MultiPolygon for each part (docs/formats.md).

    Outlines turn counter-clockwise, holes clockwise. For a local site it is plain JSON with coordinates in pixels.
    """
    return feature_collection(
        COVERAGE, [_covered(each, site) for each in ground], is_local=site.is_local
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
        tuple(np.column_stack(longitude_latitude(corners, site)) for corners in rings)
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


def _covered(ground: CoveredGround, site: Site) -> dict[str, Any]:
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
        [
            ring(corners if (signed_area(corners) >= 0) == (place == 0) else corners[::-1], site, 8)
            for place, corners in enumerate(rings)
        ]
        for rings in polygons_m
    ]
    geometry = {"type": "MultiPolygon", "coordinates": polygons}
    rings_m = [[np.round(corners, 3).tolist() for corners in rings] for rings in polygons_m]
    return feature(geometry, properties) | {"rings_m": rings_m}


def control_summary(report: ControlReport) -> dict[str, Any]:
    """The report's part on control points (docs/formats.md)."""
    return {
        "file": report.name,
        "crs": report.crs,
        "sigma_m": report.sigma_m,
        "control_rms_m": report.rms_m(ControlRole.CONTROL),
        "check_rms_m": report.rms_m(ControlRole.CHECK),
        "excluded": [each.point.label for each in report.of(ControlRole.EXCLUDED)],
        "points": [_residual(each) for each in report.residuals],
    }


def control_documents(report: ControlReport) -> dict[str, bytes]:
    """The file of control points for the flight's folder, by its name."""
    features = [
        feature(
            {
                "type": "Point",
                "coordinates": [
                    round(each.point.longitude_deg, 9),
                    round(each.point.latitude_deg, 9),
                ],
            },
            _residual(each),
        )
        for each in report.residuals
    ]
    return {CONTROL_FILE: geojson_bytes(feature_collection("control", features, is_local=False))}


def _residual(each: ControlResidual) -> dict[str, Any]:
    return {
        "label": each.point.label,
        "role": each.role.value,
        "marks": each.marks,
        "east_m": rounded(each.east_m, 4),
        "north_m": rounded(each.north_m, 4),
        "distance_m": rounded(hypot(each.east_m, each.north_m), 4),
        "marks_scatter_m": rounded(each.sigma_m, 4),
        "height_m": rounded(each.point.height_m, 4),
    }
