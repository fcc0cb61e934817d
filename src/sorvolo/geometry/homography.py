"""Plane-to-plane maps: apply, compose, fit, and the one that level ground induces between image and site."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sorvolo.errors import GeometryError
from sorvolo.geometry.arrays import Floats, Matrix3, PointsM
from sorvolo.geometry.camera import Camera
from sorvolo.geometry.pose import Pose


def apply_homography(a_from_b: NDArray[np.floating[Any]], points_b: Floats) -> Floats:
    """Points of plane b, shape (N, 2), in plane a by a (3, 3) matrix; NaN where the third coordinate is not positive.

    All homographies here are scaled so that it is positive for points in front of the camera.
    """
    points = np.asarray(points_b, dtype=np.float64).reshape(-1, 2)
    mapped = points @ a_from_b[:, :2].T + a_from_b[:, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        result = mapped[:, :2] / mapped[:, 2:]
    result[mapped[:, 2] <= 0] = np.nan
    return result


def site_from_image_homography(
    camera: Camera, site_from_camera: Pose, ground_height_m: float = 0.0
) -> Matrix3:
    """The homography from undistorted pixels to level ground (east, north in metres) at `ground_height_m`.

    Scaled so that the third coordinate is positive for pixels that see the ground in front of the camera.
    Raises GeometryError when the camera stands on or below that ground.
    """
    height_m = site_from_camera.translation_m[2] - ground_height_m
    if height_m <= 0:
        raise GeometryError(f"the camera is {height_m:.2f} m above the ground; it must be above it")
    image_from_site = np.column_stack(
        [
            site_from_camera.rotation.T[:, :2],
            site_from_camera.rotation.T
            @ (np.array([0.0, 0.0, ground_height_m]) - site_from_camera.translation_m),
        ]
    )
    inverse = np.asarray(np.linalg.inv(camera.matrix @ image_from_site), dtype=np.float64)
    # depth > 0 in front of the camera: the inverse's third row gives 1 / depth
    centre_depth = inverse[2] @ np.array([camera.cx_px, camera.cy_px, 1.0])
    return inverse / (abs(centre_depth) or 1.0) if centre_depth > 0 else inverse


def fit_similarity(points_a: PointsM, points_b: PointsM) -> Matrix3:
    """Least-squares similarity a_from_b (3x3, 4 DoF) of paired points, shape (N, 2) each (Umeyama 1991).

    Raises GeometryError for fewer than two points or when all points of b coincide.
    """
    a, b = np.asarray(points_a, dtype=np.float64), np.asarray(points_b, dtype=np.float64)
    if len(a) < 2:
        raise GeometryError(f"a similarity needs at least 2 point pairs, got {len(a)}")
    centre_a, centre_b = a.mean(axis=0), b.mean(axis=0)
    za = (a - centre_a) @ np.array([1, 1j])
    zb = (b - centre_b) @ np.array([1, 1j])
    spread = np.vdot(zb, zb).real
    if spread <= 0:
        raise GeometryError("a similarity needs points that differ")
    turn = np.vdot(zb, za) / spread
    linear = np.array([[turn.real, -turn.imag], [turn.imag, turn.real]])
    result = np.eye(3)
    result[:2, :2] = linear
    result[:2, 2] = centre_a - linear @ centre_b
    return result


def pose_from_homography(site_from_image: Matrix3, camera: Camera) -> Pose | None:
    """The camera over level ground whose view induces this homography (closed form); None if there is none."""
    try:
        image_from_site = np.linalg.inv(site_from_image)
    except np.linalg.LinAlgError:
        return None
    columns = np.linalg.inv(camera.matrix) @ image_from_site
    scale = np.sqrt(np.linalg.norm(columns[:, 0]) * np.linalg.norm(columns[:, 1]))
    if not np.isfinite(scale) or scale <= 0:
        return None
    columns = columns / scale
    if columns[2, 2] < 0:
        columns = -columns
    u, _, vt = np.linalg.svd(
        np.column_stack([columns[:, 0], columns[:, 1], np.cross(columns[:, 0], columns[:, 1])])
    )
    camera_from_site = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
    centre_m = -camera_from_site.T @ columns[:, 2]
    if centre_m[2] <= 0 or camera_from_site[2, 2] > -0.1:
        return None
    return Pose(camera_from_site.T, centre_m)


def shifted(x: float, y: float) -> Matrix3:
    """(3, 3) by which points go so far to the right and down."""
    return np.array([[1.0, 0, x], [0, 1, y], [0, 0, 1]])


def resized(x: float, y: float) -> Matrix3:
    """(3, 3) from pixels to those of the picture made x and y times as large: to = (from + 1/2) x - 1/2."""
    return np.array([[x, 0, (x - 1) / 2], [0, y, (y - 1) / 2], [0, 0, 1.0]])
