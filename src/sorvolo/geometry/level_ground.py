"""Where image points lie on the ground."""

import numpy as np

from sorvolo.geometry.arrays import PointsM, PointsPx
from sorvolo.geometry.camera import Camera
from sorvolo.geometry.pose import Pose


def ground_from_rays(
    rays: PointsM, site_from_camera: Pose, ground_height_m: float = 0.0
) -> PointsM:
    """Where camera rays, shape (N, 3), meet level ground, (N, 3) in the site frame.

    A ray at or above the horizon meets nothing and comes back as NaN.
    """
    rays_site = rays @ site_from_camera.rotation.T
    origin_m = site_from_camera.translation_m
    with np.errstate(divide="ignore", invalid="ignore"):
        reach = (ground_height_m - origin_m[2]) / rays_site[:, 2]
    reach[~np.isfinite(reach) | (reach <= 0)] = np.nan
    return origin_m + reach[:, None] * rays_site


def footprint(camera: Camera, site_from_camera: Pose, ground_height_m: float = 0.0) -> PointsM:
    """(4, 2) ground points of the image's corners: top-left, top-right, bottom-right, bottom-left; NaN if unseen."""
    return ground_from_pixels(camera, site_from_camera, camera.corners_px, ground_height_m)


def is_on_ground(outline_m: PointsM) -> bool:
    """Whether all points of an outline, (N, 2), lie on the ground: none is at or above the horizon."""
    return bool(np.isfinite(outline_m).all())


def ground_from_pixels(
    camera: Camera, site_from_camera: Pose, points_px: PointsPx, ground_height_m: float = 0.0
) -> PointsM:
    """(N, 2) east, north of distorted image points, shape (N, 2), on level ground; NaN at or above the horizon."""
    rays = camera.rays_from_pixels(points_px)
    return ground_from_rays(rays, site_from_camera, ground_height_m)[:, :2]
