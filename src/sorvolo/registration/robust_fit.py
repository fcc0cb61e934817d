"""Point pairs with outliers to a model and its inliers."""

import cv2
import numpy as np

from sorvolo.geometry.arrays import Mask, Matrix3, PointsPx


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
