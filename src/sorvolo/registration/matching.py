"""Features of two views to index pairs, and pairs with outliers to a homography and its inliers."""

import cv2
import numpy as np
from numpy.typing import NDArray

from sorvolo.geometry.arrays import Mask, Matrix3, PointsPx
from sorvolo.geometry.homography import apply_homography
from sorvolo.survey.mosaic import Features

_RATIO = 0.85  # Lowe's
_EMPTY = np.zeros((0, 2), np.int64)


def match(
    new: Features,
    old: Features,
    new_from_old: Matrix3 | None,
    search_px: float,
) -> NDArray[np.int64]:
    """(N, 2) index pairs (new, old), nearest neighbours that pass Lowe's ratio test and are mutual.

    With a predicted homography only old points that fall into the new image (within `search_px`), and new points
    that fall into the old one, take part: fewer comparisons, fewer accidental twins.
    """
    if new.kind != old.kind or len(new) < 4 or len(old) < 4:
        return _EMPTY
    keep_new, keep_old = np.arange(len(new)), np.arange(len(old))
    if new_from_old is not None:
        keep_old = _inside(apply_homography(new_from_old, old.points_px), new, search_px)
        keep_new = _inside(
            apply_homography(np.linalg.inv(new_from_old), new.points_px), old, search_px
        )
        if len(keep_new) < 4 or len(keep_old) < 4:
            return _EMPTY
    norm = cv2.NORM_HAMMING if new.descriptors.dtype == np.uint8 else cv2.NORM_L2
    count = min(2, len(keep_old))
    distance, nearest = cv2.batchDistance(
        new.descriptors[keep_new], old.descriptors[keep_old], -1, normType=norm, K=count
    )
    accepted = (
        np.flatnonzero(distance[:, 0] < _RATIO * distance[:, -1])
        if count == 2
        else np.zeros(0, np.int64)
    )
    # mutual: of several new points with the same old one, the nearest stays
    accepted = accepted[np.lexsort((distance[accepted, 0], nearest[accepted, 0]))]
    first = np.diff(nearest[accepted, 0], prepend=-1) != 0
    indices = np.column_stack([accepted[first], nearest[accepted[first], 0]]).astype(np.int64)
    indices = np.column_stack([keep_new[indices[:, 0]], keep_old[indices[:, 1]]])
    if new_from_old is not None:
        miss = (
            apply_homography(new_from_old, old.points_px[indices[:, 1]])
            - new.points_px[indices[:, 0]]
        )
        indices = indices[np.linalg.norm(miss, axis=1) < search_px]
    return indices


def _inside(mapped: PointsPx, other: Features, margin_px: float) -> NDArray[np.int64]:
    low, high = other.points_px.min(axis=0) - margin_px, other.points_px.max(axis=0) + margin_px
    with np.errstate(invalid="ignore"):
        return np.flatnonzero(((mapped >= low) & (mapped <= high)).all(axis=1))


def fit_homography(a: PointsPx, b: PointsPx, threshold_px: float) -> tuple[Matrix3, Mask] | None:
    """a_from_b by MAGSAC++ (Barath 2020) and the inliers, (N,) bool; None when no believable model is found.

    Not believable: fewer than 4 pairs, a mirrored or folded image, or one stretched more than fourfold.
    """
    if len(a) < 4:
        return None
    parameters = cv2.UsacParams()
    parameters.confidence = 0.9999
    parameters.maxIterations = 2000
    parameters.threshold = threshold_px
    parameters.sampler = cv2.SAMPLING_UNIFORM
    parameters.score = cv2.SCORE_METHOD_MAGSAC
    parameters.loMethod = cv2.LOCAL_OPTIM_SIGMA
    parameters.loIterations = 10
    parameters.loSampleSize = 14
    parameters.final_polisher = cv2.MAGSAC
    parameters.final_polisher_iterations = 3
    parameters.randomGeneratorState = 1  # runs repeat
    parameters.isParallel = False
    model, inliers = cv2.findHomography(b.astype(np.float32), a.astype(np.float32), parameters)
    if model is None or not np.isfinite(model).all() or abs(model[2, 2]) < 1e-9:
        return None
    model = model / model[2, 2]
    if not is_believable(model, b[inliers.ravel() > 0]):
        return None
    return model, inliers.ravel() > 0


def is_believable(a_from_b: Matrix3, points_b: PointsPx) -> bool:
    """Whether the homography neither mirrors, folds nor stretches the ground around these points more than fourfold."""
    if len(points_b) < 4:
        return False
    depth = points_b @ a_from_b[2, :2] + a_from_b[2, 2]
    if depth.min() <= 0 or depth.max() > 3 * depth.min():
        return False
    centre = points_b.mean(axis=0)
    depth_centre = a_from_b[2, :2] @ centre + a_from_b[2, 2]
    image_of_centre = (a_from_b[:2, :2] @ centre + a_from_b[:2, 2]) / depth_centre
    jacobian = (a_from_b[:2, :2] - np.outer(image_of_centre, a_from_b[2, :2])) / depth_centre
    stretch = np.linalg.svd(jacobian, compute_uv=False)
    return bool(
        np.linalg.det(jacobian) > 0
        and stretch[0] < 4
        and stretch[1] > 0.25
        and stretch[0] < 2 * stretch[1]
    )
