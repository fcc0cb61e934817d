"""What became of a flight's frames, as GeoJSON."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from sorvolo.geometry.pose import gimbal_angles_from_rotation
from sorvolo.store.exports.places import longitude_latitude
from sorvolo.store.exports.plain import feature_collection, rounded, utc_text
from sorvolo.survey.flight import Site
from sorvolo.survey.mosaic import PlacedFrame


def frames_geojson(placed: Sequence[PlacedFrame], site: Site) -> dict[str, Any]:
    """The frames of a flight as a GeoJSON FeatureCollection, one feature each (docs/formats.md).

    Longitudes run on beyond 180 degrees where a flight crosses the antimeridian. For a local site it is plain JSON with
    coordinates in pixels of the site.
    """
    return feature_collection(
        "frames", [_feature(frame, site) for frame in placed], is_local=site.is_local
    )


def _feature(frame: PlacedFrame, site: Site) -> dict[str, Any]:
    # a video's frames are named by their index, photos by their file
    is_indexed = frame.name == str(frame.index)
    properties = {
        "frame": frame.index if is_indexed else frame.name,
        "time": utc_text(frame.time_ns),
        "status": frame.status.value,
        "reason": frame.reason,
        **_camera_place(frame, site),
        "residual_px": rounded(frame.residual_px, 4),
        "sigma_m": rounded(frame.sigma_m, 4),
        "gps_residual_east_m": rounded(frame.gps_residual_m[0], 4),
        "gps_residual_north_m": rounded(frame.gps_residual_m[1], 4),
        "gps_residual_up_m": rounded(frame.gps_residual_m[2], 4),
    }
    return {"type": "Feature", "geometry": _outline(frame, site), "properties": properties}


def _outline(frame: PlacedFrame, site: Site) -> dict[str, Any] | None:
    if not np.isfinite(frame.outline_m).all():
        return None
    corners = frame.outline_m
    if not site.is_local:
        corners = np.column_stack(longitude_latitude(frame.outline_m, site))
    ring = [[round(float(x), 10), round(float(y), 10)] for x, y in [*corners, corners[0]]]
    return {"type": "Polygon", "coordinates": [ring]}


def _camera_place(frame: PlacedFrame, site: Site) -> dict[str, Any]:
    longitude_deg = latitude_deg = height_m = up_m = yaw_deg = pitch_deg = roll_deg = np.nan
    local = {}
    if frame.site_from_camera is not None:
        east_m, north_m, up_m = frame.site_from_camera.translation_m
        height_m = site.origin.height_m + up_m
        yaw_deg, pitch_deg, roll_deg = gimbal_angles_from_rotation(frame.site_from_camera.rotation)
        if site.is_local:
            local = {"camera_east": rounded(east_m, 6), "camera_north": rounded(north_m, 6)}
        else:
            longitudes, latitudes = longitude_latitude(
                frame.site_from_camera.translation_m[None], site
            )
            longitude_deg, latitude_deg = longitudes[0], latitudes[0]
    return {
        "camera_longitude_deg": rounded(longitude_deg, 10),
        "camera_latitude_deg": rounded(latitude_deg, 10),
        **local,
        "camera_height_m": rounded(height_m, 4),
        "height_above_ground_m": rounded(up_m, 4),
        "height_reference": site.height_reference,
        "camera_yaw_deg": rounded(yaw_deg, 5),
        "camera_pitch_deg": rounded(pitch_deg, 5),
        "camera_roll_deg": rounded(roll_deg, 5),
    }
