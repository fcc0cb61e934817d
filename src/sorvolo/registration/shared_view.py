"""How two pictures of the same ground lie on each other, without telemetry."""

from dataclasses import dataclass

import cv2
import numpy as np

from sorvolo.geometry.arrays import ImageRGB, Matrix3
from sorvolo.geometry.homography import apply_homography
from sorvolo.registration.features import FeatureSettings, gray_from_rgb, sift_features
from sorvolo.registration.matching import match
from sorvolo.registration.robust_fit import fit_homography
from sorvolo.survey.mosaic import Features

_SIDE_PX = 640  # pictures are made so small: the answer needs no sub-pixel match
_LEAST_INLIERS = 12  # pairs: four fix a homography; by choice
_THRESHOLD_PX = 3.0  # between the two places of a pair that agrees, at that size; by choice
_POINTS = 48  # cells a side of the grid that is counted


@dataclass(frozen=True, eq=False)
class SmallView:
    """What is kept of a picture of `size_px` (height, width): its SIFT features at a small size, and (3, 3)
    `small_from_picture`."""

    features: Features
    size_px: tuple[int, int]
    small_from_picture: Matrix3


def small_view(image: ImageRGB) -> SmallView:
    """The features of a picture, RGB."""
    gray = gray_from_rgb(image)
    scale = min(1.0, _SIDE_PX / max(gray.shape))
    if scale < 1:
        gray = np.asarray(cv2.resize(gray, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA))
    shift = (scale - 1) / 2  # pixels are counted from the middle of the first one
    small_from_picture = np.array([[scale, 0, shift], [0, scale, shift], [0, 0, 1]])
    return SmallView(sift_features(gray, FeatureSettings()), image.shape[:2], small_from_picture)


def second_from_first(first: SmallView, second: SmallView) -> Matrix3 | None:
    """The homography from pixels of one picture to those of another by matched features; None where too few match."""
    pairs = match(second.features, first.features, None, 0.0)
    new_px, old_px = second.features.points_px[pairs[:, 0]], first.features.points_px[pairs[:, 1]]
    fit = fit_homography(new_px, old_px, _THRESHOLD_PX)
    if fit is None or fit[1].sum() < _LEAST_INLIERS:
        return None
    return np.asarray(
        np.linalg.inv(second.small_from_picture) @ fit[0] @ first.small_from_picture, np.float64
    )


def shared_view(first: ImageRGB, second: ImageRGB) -> float:
    """The share, 0 to 1, of `first` (RGB) that `second` shows, by matched SIFT features; 0 where nothing matches."""
    found = second_from_first(small_view(first), small_view(second))
    if found is None:
        return 0.0
    height, width = first.shape[:2]
    middles = (
        np.arange(_POINTS) + 0.5
    ) / _POINTS  # of cells: points on the rim itself fall out by a hair
    columns, rows = np.meshgrid(width * middles - 0.5, height * middles - 0.5)
    there = apply_homography(found, np.column_stack([columns.ravel(), rows.ravel()]))
    height, width = second.shape[:2]
    inside = (there >= 0).all(axis=1) & (there[:, 0] <= width - 1) & (there[:, 1] <= height - 1)
    return float(inside.mean())
