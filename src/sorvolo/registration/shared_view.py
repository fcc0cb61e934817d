"""How much of a picture another one shows, without telemetry."""

import cv2
import numpy as np

from sorvolo.geometry.arrays import ImageGray, ImageRGB
from sorvolo.geometry.homography import apply_homography
from sorvolo.registration.features import FeatureSettings, gray_from_rgb, sift_features
from sorvolo.registration.matching import match
from sorvolo.registration.robust_fit import fit_homography

_SIDE_PX = 640  # pictures are made so small: the answer needs no sub-pixel match
_LEAST_INLIERS = 12  # pairs: four fix a homography; by choice
_THRESHOLD_PX = 3.0  # between the two places of a pair that agrees, at that size; by choice
_POINTS = 48  # cells a side of the grid that is counted


def shared_view(first: ImageRGB, second: ImageRGB) -> float:
    """The share, 0 to 1, of `first` (RGB) that `second` shows, by matched SIFT features; 0 where nothing matches."""
    small_first, small_second = _small(first), _small(second)
    settings = FeatureSettings()
    old, new = sift_features(small_first, settings), sift_features(small_second, settings)
    pairs = match(new, old, None, 0.0)
    fit = fit_homography(new.points_px[pairs[:, 0]], old.points_px[pairs[:, 1]], _THRESHOLD_PX)
    if fit is None or fit[1].sum() < _LEAST_INLIERS:
        return 0.0
    height, width = small_first.shape
    middles = (np.arange(_POINTS) + 0.5) / _POINTS  # of cells: points on the rim itself fall out by a hair
    columns, rows = np.meshgrid(width * middles - 0.5, height * middles - 0.5)
    there = apply_homography(fit[0], np.column_stack([columns.ravel(), rows.ravel()]))
    height, width = small_second.shape
    inside = (there >= 0).all(axis=1) & (there[:, 0] <= width - 1) & (there[:, 1] <= height - 1)
    return float(inside.mean())


def _small(image: ImageRGB) -> ImageGray:
    gray = gray_from_rgb(image)
    scale = _SIDE_PX / max(gray.shape)
    return gray if scale >= 1 else np.asarray(cv2.resize(gray, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA))
