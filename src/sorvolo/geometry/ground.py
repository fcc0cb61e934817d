"""Where cameras see the ground: level, or a raster of it on its heights."""

import cv2
import numpy as np

from sorvolo.geometry.arrays import Floats32, Mask, Matrix3, PointsM, PointsPx, Vector3
from sorvolo.geometry.camera import Camera
from sorvolo.geometry.pose import Pose

_LONGER = 1.06  # times: each step along a line of sight


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


def laid_pixels(
    camera: Camera, site_from_camera: Pose, site_from_raster: Matrix3, up_m: Floats32
) -> tuple[Floats32, Floats32]:
    """(H, W) where in the picture of a camera without distortion a raster's pixels are, on their heights; far off what
    is behind it."""
    turn = site_from_camera.rotation.T
    project = camera.matrix @ np.column_stack([turn, -turn @ site_from_camera.translation_m])
    columns, rows = (np.arange(side, dtype=np.float32) for side in up_m.shape[::-1])
    weight, x, y, z = (
        np.float32(a) * columns[None, :] + (np.float32(b) * rows[:, None] + np.float32(c))
        for a, b, c in (site_from_raster[2], *(project[:, [0, 1, 3]] @ site_from_raster))
    )
    x, y, z = (
        level + np.float32(up) * (weight * up_m) for level, up in zip((x, y, z), project[:, 2])
    )
    ahead = z * np.sign(site_from_raster[2, 2]) > 1e-6
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(ahead, x / z, np.float32(-1e6)), np.where(ahead, y / z, np.float32(-1e6))


def hidden(
    up_m: Floats32, x: Floats32, y: Floats32, ground_m: Floats32, eye: Vector3, margin_m: float
) -> Mask:
    """(h, w) which ground heights without holes, (H, W), hide from a camera: they rise by more than a margin above its
    line of sight. The ground, (h, w) m up, is at columns `x` and rows `y` of the heights; `eye` is the camera's column
    and row, and how high it is, m."""
    dx, dy = np.float32(eye[0]) - x, np.float32(eye[1]) - y
    far = np.maximum(np.hypot(dx, dy), 1e-3)
    dx, dy = dx / far, dy / far
    climb = (np.float32(eye[2]) - ground_m) / far  # metres a cell on the way to the camera
    rise_m = float(up_m.max()) - float(ground_m.min())
    reach = min(rise_m / max(float(np.min(climb)), 1e-3), float(far.max()))
    found = np.zeros(ground_m.shape, bool)
    step = 2.0
    while step < reach:
        seen = cv2.remap(
            up_m, x + dx * step, y + dy * step, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
        found |= (seen > ground_m + climb * step + margin_m) & (step < far)
        step = max(step + 1.0, step * _LONGER)
    return found
