"""Control points and how far the map misses them: for the report, and as GeoJSON."""

from math import hypot
from typing import Any

from sorvolo.store.exports.plain import feature_collection, geojson_bytes, rounded
from sorvolo.survey.control import ControlReport, ControlResidual, ControlRole

CONTROL_FILE = "control.geojson"
"""In the flight's folder."""


def control_summary(report: ControlReport) -> dict[str, Any]:
    """The report's part on control points (docs/formats.md)."""
    return {
        "file": report.name,
        "crs": report.crs,
        "sigma_m": report.sigma_m,
        "control_rms_m": report.rms_m(ControlRole.CONTROL),
        "check_rms_m": report.rms_m(ControlRole.CHECK),
        "excluded": [each.point.label for each in report.of(ControlRole.EXCLUDED)],
        "points": [_properties(each) for each in report.residuals],
    }


def control_documents(report: ControlReport) -> dict[str, bytes]:
    """The file of control points for the flight's folder, by its name."""
    features = [
        {
            "type": "Feature",
            "geometry": {
                "type": "Point",
                "coordinates": [
                    round(each.point.longitude_deg, 9),
                    round(each.point.latitude_deg, 9),
                ],
            },
            "properties": _properties(each),
        }
        for each in report.residuals
    ]
    return {CONTROL_FILE: geojson_bytes(feature_collection("control", features, is_local=False))}


def _properties(each: ControlResidual) -> dict[str, Any]:
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
