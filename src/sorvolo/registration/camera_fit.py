"""Pairs of image and ground points, most of them perhaps wrong, and telemetry's pose, to the camera's pose."""

from dataclasses import dataclass

import cv2
import numpy as np

from sorvolo.errors import GeometryError
from sorvolo.geometry.arrays import Floats, Mask, Matrix3, PointsM, PointsPx, Vector3
from sorvolo.geometry.camera import Camera
from sorvolo.geometry.homography import apply_homography, site_from_image_homography
from sorvolo.geometry.pose import Pose, rotation_from_vector

_STEP = 1e-4  # of numerical derivatives: metres, radians
_ROUNDS = 24  # of the robust fit, at most
_FAR_PX = 1e4  # for ground behind the camera: any robust loss ignores it


@dataclass(frozen=True, eq=False)
class PosePrior:
    """What is known of a camera before its picture is matched; infinite sigmas where nothing is.

    `rotation_sigma_rad` is about the camera's own axes, `position_sigma_m` east, north, up.
    """

    pose: Pose
    position_sigma_m: Vector3
    rotation_sigma_rad: Vector3


@dataclass(frozen=True, eq=False)
class CameraFit:
    """A camera over level ground that explains pairs. `agree` (N,) marks them; `residual_px` is their median miss."""

    pose: Pose
    site_from_image: Matrix3
    agree: Mask
    residual_px: float


def fit_camera(
    image_px: PointsPx,
    ground_m: PointsM,
    camera: Camera,
    prior: PosePrior,
    *,
    start_px: float,
    band_px: float,
) -> CameraFit | None:
    """The pose that explains the most pairs, (N, 2) each, as near to the prior as they allow; None where none does.

    Six degrees of freedom and telemetry's own weight hold a view that has points in one corner only, where a
    homography would swing. Robust by graduated non-convexity (Geman-McClure, Yang et al. 2020): pairs within
    `start_px` of the prior's pose pull at first, at the end those within `band_px`.
    """
    rotation, place = prior.pose.rotation, prior.pose.translation_m.copy()
    scale_px = start_px
    for _ in range(_ROUNDS):
        miss = _misses(rotation, place, image_px, ground_m, camera)
        if miss is None:
            return None
        square = (miss**2).sum(axis=1)
        weight = (scale_px**2 / (scale_px**2 + square)) ** 2 / band_px**2
        jacobian = _derivatives(rotation, place, miss, image_px, ground_m, camera)
        normal = np.einsum("npi,n,npj->ij", jacobian, weight, jacobian)
        gradient = np.einsum("npi,n,np->i", jacobian, weight, miss)
        away = _from_prior(rotation, place, prior)
        trust = np.concatenate([prior.rotation_sigma_rad, prior.position_sigma_m]) ** -2.0
        normal[np.diag_indices(6)] += trust + 1e-9
        step = -np.linalg.solve(normal, gradient + trust * away)
        rotation, place = rotation @ rotation_from_vector(step[:3]), place + step[3:]
        if place[2] <= 0.5 or not np.isfinite(step).all():
            return None
        scale_px = max(band_px / 2, scale_px * 0.8)
    return _as_fit(rotation, place, image_px, ground_m, camera, band_px)


def similar(
    new_px: PointsPx, old_px: PointsPx, threshold_px: float, most_scale: float
) -> tuple[Matrix3, Mask] | None:
    """new_from_old as a similarity that the most pairs, (N, 2) each, agree on, and which; None where none is likely."""
    if len(new_px) < 4:
        return None
    found, agree = cv2.estimateAffinePartial2D(
        old_px, new_px, ransacReprojThreshold=threshold_px, maxIters=5000, confidence=0.9999
    )
    if found is None:
        return None
    scale = float(np.hypot(found[0, 0], found[1, 0]))
    if not 1 / most_scale <= scale <= most_scale:
        return None
    return np.vstack([found, [0.0, 0.0, 1.0]]), agree.ravel() > 0


def _misses(
    rotation: Matrix3, place_m: Vector3, image_px: PointsPx, ground_m: PointsM, camera: Camera
) -> Floats | None:
    """(N, 2) from where pairs are in the image to where this pose puts them; None below the ground."""
    try:
        site_from_image = site_from_image_homography(camera, Pose(rotation, place_m))
    except GeometryError:
        return None
    return np.nan_to_num(
        apply_homography(np.linalg.inv(site_from_image), ground_m) - image_px, nan=_FAR_PX
    )


def _derivatives(
    rotation: Matrix3,
    place_m: Vector3,
    miss: Floats,
    image_px: PointsPx,
    ground_m: PointsM,
    camera: Camera,
) -> Floats:
    """(N, 2, 6) of the misses by a turn about the camera's axes, radians, and a move in the site, metres."""
    result = np.zeros((*miss.shape, 6))
    for axis in range(6):
        step = np.zeros(6)
        step[axis] = _STEP
        turned = rotation @ rotation_from_vector(step[:3])
        moved = _misses(turned, place_m + step[3:], image_px, ground_m, camera)
        result[..., axis] = 0.0 if moved is None else (moved - miss) / _STEP
    return result


def _from_prior(rotation: Matrix3, place_m: Vector3, prior: PosePrior) -> Floats:
    """(6,) turn about the camera's axes and move since the prior."""
    turn, _ = cv2.Rodrigues(prior.pose.rotation.T @ rotation)
    return np.concatenate([turn.ravel(), place_m - prior.pose.translation_m])


def _as_fit(
    rotation: Matrix3,
    place_m: Vector3,
    image_px: PointsPx,
    ground_m: PointsM,
    camera: Camera,
    band_px: float,
) -> CameraFit | None:
    miss = _misses(rotation, place_m, image_px, ground_m, camera)
    if miss is None:
        return None
    far = np.linalg.norm(miss, axis=1)
    agree = far < band_px
    if not agree.any():
        return None
    pose = Pose(rotation, place_m)
    return CameraFit(
        pose, site_from_image_homography(camera, pose), agree, float(np.median(far[agree]))
    )
