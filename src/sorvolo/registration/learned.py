"""Image to learned Features (XFeat): they match across dates, seasons and light where ORB and SIFT find few."""

from functools import lru_cache
from importlib.resources import files
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from sorvolo.geometry.arrays import Floats32, ImageGray, Matrix3, PointsPx
from sorvolo.geometry.homography import apply_homography
from sorvolo.survey.mosaic import Features

_CELL_PX = 8  # the network gives one descriptor a cell of this side
_WHOLE_PX = 32  # its input's sides are multiples of this
_LEAST_POINT = 0.05  # of a place's probability of being a point, as published
_LEAST_LIKENESS = 0.5  # cosine of two descriptors: less is no pair, however alone
_ROWS = 64  # so many points at a time are compared with all others: what they make stays in the processor's cache
_APART_PX = 5  # side of the window in which a point must be the likeliest

LEARNED = "xfeat"
"""The kind of these features."""


def learned_features(gray: ImageGray, most: int = 2048) -> Features:
    """Up to `most` XFeat points (Potje 2024) of a picture (H, W), the surest first; descriptors (N, 64), unit length.

    No contrast needs to be normalised. About 60 ms for 640 x 360 on one core: for what ORB cannot match.
    """
    height, width = gray.shape
    padded = cv2.copyMakeBorder(
        gray, 0, -height % _WHOLE_PX, 0, -width % _WHOLE_PX, cv2.BORDER_REFLECT_101
    ).astype(np.float32)
    descriptors, likely, reliability = _network().run(
        None, {"gray": padded[None, None] / np.float32(255)}
    )
    likely = likely[0, 0, :height, :width]
    peaks = (likely > _LEAST_POINT) & (
        likely == cv2.dilate(likely, np.ones((_APART_PX, _APART_PX), np.uint8))
    )
    ys, xs = np.nonzero(peaks)
    points = np.column_stack([xs, ys]).astype(np.float64)
    sure = likely[ys, xs] * _sampled(reliability[0], points)[:, 0]
    best = np.argsort(-sure, kind="stable")[:most]
    points = points[best]
    found = _sampled(descriptors[0], points)
    found /= np.maximum(np.linalg.norm(found, axis=1, keepdims=True), 1e-6)
    return Features(LEARNED, points, found.astype(np.float32))


def match_learned(
    new: Features, old: Features, new_from_old: Matrix3 | None = None, radius_px: float = np.inf
) -> NDArray[np.int64]:
    """(N, 2) index pairs (new, old) of learned features that are each other's likest.

    With `new_from_old` only points that it puts within `radius_px` of each other compete: where the place is nearly
    known, many more right pairs survive the competition.
    """
    if not len(new) or not len(old):
        return np.zeros((0, 2), np.int64)
    expected = None
    if new_from_old is not None:
        expected = np.nan_to_num(apply_homography(new_from_old, old.points_px), nan=1e9).astype(
            np.float32
        )
    here = new.points_px.astype(np.float32)
    ours, theirs = (np.asarray(each.descriptors, np.float32) for each in (new, old))
    nearest, likest = np.zeros(len(new), np.int64), np.zeros(len(new), np.float32)
    likest_back = np.full(len(old), -1.0, np.float32)
    for start in range(0, len(new), _ROWS):
        part = slice(start, start + _ROWS)
        likeness = ours[part] @ theirs.T
        if expected is not None:
            across, down = here[part, :1] - expected[:, 0], here[part, 1:] - expected[:, 1]
            np.copyto(likeness, -1.0, where=across * across + down * down > radius_px**2)
        nearest[part], likest[part] = likeness.argmax(axis=1), likeness.max(axis=1)
        np.maximum(likest_back, likeness.max(axis=0), out=likest_back)
    rows = np.flatnonzero((likest == likest_back[nearest]) & (likest > _LEAST_LIKENESS))
    _, first = np.unique(
        nearest[rows], return_index=True
    )  # of new ones that are as like, the first
    rows = rows[np.sort(first)]
    return np.column_stack([rows, nearest[rows]]).astype(np.int64)


def _sampled(planes: Floats32, points_px: PointsPx) -> Floats32:
    """(N, C) values of `planes` (C, rows, columns), one a cell, between cells by distance, at image points (N, 2)."""
    _, rows, columns = planes.shape
    at = np.clip((points_px + 0.5) / _CELL_PX - 0.5, 0, [columns - 1, rows - 1])
    low = np.minimum(at.astype(int), [max(columns - 2, 0), max(rows - 2, 0)])
    high = np.minimum(low + 1, [columns - 1, rows - 1])
    share = (at - low).astype(np.float32)
    x, y = share[:, 0], share[:, 1]
    return (
        planes[:, low[:, 1], low[:, 0]] * ((1 - x) * (1 - y))
        + planes[:, low[:, 1], high[:, 0]] * (x * (1 - y))
        + planes[:, high[:, 1], low[:, 0]] * ((1 - x) * y)
        + planes[:, high[:, 1], high[:, 0]] * (x * y)
    ).T


def release_network() -> None:
    """Put the model out of memory; the next picture opens it again."""
    _network.cache_clear()


@lru_cache(maxsize=1)
def _network() -> Any:
    """The packaged model, opened once; on as many cores as there are."""
    import onnxruntime  # 30 MB of memory, for flights that ORB does not lay

    options = onnxruntime.SessionOptions()
    options.log_severity_level = 3
    stored = files("sorvolo.registration").joinpath("learned_features.onnx").read_bytes()
    return onnxruntime.InferenceSession(stored, options, providers=["CPUExecutionProvider"])
