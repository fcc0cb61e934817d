"""Features of two views to index pairs: brute force inside the area that the prediction allows."""

import cv2
import numpy as np
from numpy.typing import NDArray

from sorvolo.geometry.arrays import Matrix3, PointsPx
from sorvolo.geometry.homography import apply_homography
from sorvolo.survey.mosaic import Features

_EMPTY = np.zeros((0, 2), np.int64)


def match(
    new: Features,
    old: Features,
    new_from_old: Matrix3 | None,
    search_px: float,
    ratio: float = 0.85,
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
        np.flatnonzero(distance[:, 0] < ratio * distance[:, -1])
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
