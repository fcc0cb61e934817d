"""A flight's placed frames summed up in the figures that its report has."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sorvolo.geometry.arrays import Floats
from sorvolo.geometry.pose import Pose
from sorvolo.geometry.summary import median_of_known, percentile_of_known, rms_of_known
from sorvolo.survey.mosaic import PlacedFrame, Status


@dataclass(frozen=True)
class FlightFigures:
    """Figures over the frames that have a place; None where nothing is known.

    `gps_*` are distances between the camera and its fix; `sigma_m` is the median error stated per frame; `reach_m` is
    how far the frames' centres spread, `diagonal_m` how long a frame is on the ground; `tilt_deg` how far the camera
    usually looked from straight down.
    """

    residual_median_px: float | None
    residual_p95_px: float | None
    gps_median_m: float | None
    gps_rms_m: float | None
    gps_vertical_median_m: float | None
    sigma_m: float | None
    height_m: float | None
    native_m_per_px: float | None
    reach_m: float
    diagonal_m: float
    tilt_deg: float


def flight_figures(placed: Sequence[PlacedFrame], focal_px: float) -> FlightFigures:
    """The figures of a flight whose camera has this focal length."""
    seen = [each for each in placed if each.status is not Status.REJECTED]
    gps = np.array([each.gps_residual_m for each in seen]).reshape(-1, 3)
    horizontal_m = np.hypot(gps[:, 0], gps[:, 1])
    poses = [each.site_from_camera for each in seen if each.site_from_camera is not None]
    heights_m = [float(each.translation_m[2]) for each in poses]
    residuals = [each.residual_px for each in seen]
    return FlightFigures(
        median_of_known(residuals),
        percentile_of_known(residuals, 95),
        median_of_known(horizontal_m),
        rms_of_known(horizontal_m),
        median_of_known(np.abs(gps[:, 2])),
        median_of_known([each.sigma_m for each in seen]),
        median_of_known(heights_m),
        float(np.median(heights_m) / focal_px) if heights_m else None,
        _reach_m(seen),
        (
            float(
                np.median([np.linalg.norm(each.outline_m[2] - each.outline_m[0]) for each in seen])
            )
            if seen
            else 0.0
        ),
        _tilt_deg(poses),
    )


def track_row(each: PlacedFrame) -> dict[str, Any]:
    """One frame for the report's plots, in site metres."""
    centre = each.outline_m.mean(axis=0)
    camera_m = (
        each.site_from_camera.translation_m
        if each.site_from_camera is not None
        else np.append(centre, np.nan)
    )
    return {
        "frame": each.name,
        "status": each.status.value,
        "east_m": float(camera_m[0]),
        "north_m": float(camera_m[1]),
        "up_m": float(camera_m[2]),
        "residual_px": each.residual_px,
        "sigma_m": each.sigma_m,
        "gps_east_m": float(each.gps_residual_m[0]),
        "gps_north_m": float(each.gps_residual_m[1]),
        "gps_up_m": float(each.gps_residual_m[2]),
    }


def stated_height_m(placed: Sequence[PlacedFrame], altitude_offset_m: float) -> float:
    """The median height above ground that telemetry states for the placed frames, whose residuals count from it less
    the offset that the flight showed; NaN without any."""
    stated = median_of_known(
        [
            float(
                each.site_from_camera.translation_m[2] + altitude_offset_m - each.gps_residual_m[2]
            )
            for each in placed
            if each.site_from_camera is not None
        ]
    )
    return float("nan") if stated is None else stated


def _reach_m(seen: Sequence[PlacedFrame]) -> float:
    if not seen:
        return 0.0
    centres: Floats = np.array([each.outline_m.mean(axis=0) for each in seen])
    return float(np.linalg.norm(centres.std(axis=0)))


def _tilt_deg(poses: Sequence[Pose]) -> float:
    """The angle whose cosine is the median of how far the cameras' axes point down."""
    if not poses:
        return 0.0
    axes_up = [each.rotation[2, 2] for each in poses]
    return float(np.degrees(np.arccos(np.clip(-np.median(axes_up), -1, 1))))


def delay_figures(delays_s: Sequence[float]) -> dict[str, float | int] | None:
    """The spread of the times (s) from a key frame's arrival to its pixels in the map; None without any."""
    if not delays_s:
        return None
    median, p95 = np.percentile(delays_s, [50, 95])
    return {
        "frames": len(delays_s),
        "median": float(median),
        "p95": float(p95),
        "largest": max(delays_s),
    }
