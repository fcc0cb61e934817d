"""Image to Features: contrast-normalised ORB for speed, SIFT where the ground is nearly bare."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from importlib.resources import files
from itertools import pairwise
from typing import Any

import cv2
import numpy as np
from cv2.typing import MatLike
from numpy.typing import NDArray

from sorvolo.geometry.arrays import (
    Descriptors,
    Floats32,
    ImageGray,
    ImageRGB,
    Mask,
    Matrix3,
    PointsPx,
    shrunk,
    size_within,
    square,
)
from sorvolo.geometry.homography import apply_homography
from sorvolo.survey.mosaic import Features

_CORNER_COUNT = 150  # points that a link is refined on
_CORNER_COLUMNS = 12  # of the grid over a picture in whose cells corners are spread
_TEXTURE_SIDE_PX = 960  # longer side at which sharpness is measured, whatever the camera


@dataclass(frozen=True)
class FeatureSettings:
    """How many points are looked for, and on what."""

    detection_side_px: int = 640  # longest side for ORB: pairs are refined at full size
    orb_count: int = 700  # points of a picture, the strongest
    sift_count: int = 2500  # points where ORB fails: SIFT is slower and surer


def gray_from_rgb(image: ImageRGB) -> ImageGray:
    """Luma, uint8."""
    return cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)  # type: ignore[return-value]


def normalise_contrast(gray: ImageGray) -> ImageGray:
    """The image with its local mean removed and its local contrast made even, uint8 around 128.

    Bare sand spans three gray levels; without this its texture lies below every detector's threshold, and
    Lucas-Kanade, which takes brightness as constant, would follow the camera's exposure instead of the ground
    (0.22 px instead of 0.03 px on a flight whose exposure wanders by 15 %). The window is 31 px; contrast of about
    one gray level is noise and is hardly lifted.
    """
    smooth = cv2.GaussianBlur(gray, (0, 0), 0.8).astype(np.float32)
    smooth -= cv2.boxFilter(smooth, -1, (31, 31))
    spread = cv2.boxFilter(cv2.multiply(smooth, smooth), -1, (31, 31))
    gain = cv2.divide(40.0, cv2.sqrt(spread) + np.float32(1.0))
    return cv2.convertScaleAbs(cv2.multiply(smooth, gain) + np.float32(128.0))  # type: ignore[return-value]


def orb_features(gray: ImageGray, settings: FeatureSettings) -> Features:
    """ORB (Rublee 2011) of a contrast-normalised image."""
    orb = cv2.ORB.create(
        nfeatures=settings.orb_count,
        scaleFactor=1.35,
        nlevels=4,
        edgeThreshold=17,
        patchSize=31,
        fastThreshold=35,
    )
    small, scale = _detection_image(gray, settings)
    keypoints, descriptors = orb.detectAndCompute(small, None)
    return _features("orb", keypoints, descriptors, scale)


def sift_features(gray: ImageGray, settings: FeatureSettings) -> Features:
    """SIFT (Lowe 2004), as RootSIFT (Arandjelovic 2012), of a contrast-normalised image: slow, for weak links."""
    # without the precise upscaling every point lies 0.25 px too far right and down: it shows between turned pictures
    sift = cv2.SIFT.create(
        nfeatures=settings.sift_count,
        nOctaveLayers=3,
        contrastThreshold=0.015,
        edgeThreshold=10,
        sigma=1.6,
        descriptorType=cv2.CV_32F,
        enable_precise_upscale=True,
    )
    keypoints, descriptors = sift.detectAndCompute(gray, None)
    if descriptors is not None and len(descriptors):
        descriptors = np.sqrt(
            descriptors / np.maximum(descriptors.sum(axis=1, keepdims=True), 1e-6)
        )
    return _features("sift", keypoints, descriptors, 1.0)


def _detection_image(gray: ImageGray, settings: FeatureSettings) -> tuple[ImageGray, float]:
    scale = min(1.0, settings.detection_side_px / max(gray.shape))
    if scale < 1.0:
        gray = shrunk(gray, size_within(gray, settings.detection_side_px))
    return gray, scale


def corners(gray: ImageGray) -> PointsPx:
    """(N, 2) well-textured points spread over a contrast-normalised image, for sub-pixel tracking."""
    scale = min(1.0, 0.5 * max(1.0, 640 / max(gray.shape)))
    small = cv2.resize(gray, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    response = cv2.cornerMinEigenVal(small, 5)
    response[response < cv2.dilate(response, square(5))] = -1.0
    columns = _CORNER_COLUMNS
    rows = max(1, round(columns * small.shape[0] / small.shape[1]))
    per_cell = max(1, round(_CORNER_COUNT / (columns * rows)))
    margin = 6
    xs = np.linspace(margin, small.shape[1] - margin, columns + 1).astype(int)
    ys = np.linspace(margin, small.shape[0] - margin, rows + 1).astype(int)
    found = []
    for y0, y1 in pairwise(ys):
        for x0, x1 in pairwise(xs):
            cell = response[y0:y1, x0:x1].ravel()
            best = (
                np.argpartition(-cell, per_cell)[:per_cell]
                if cell.size > per_cell
                else np.arange(cell.size)
            )
            best = best[cell[best] > 0]
            found.append(
                np.column_stack([best % max(1, x1 - x0) + x0, best // max(1, x1 - x0) + y0])
            )
    return (np.concatenate(found) + 0.5) / scale - 0.5


def sharpness_and_texture(image: ImageRGB) -> tuple[float, float]:
    """`sharpness` at 960 px, and the spread of gray about its surroundings, in levels."""
    gray = gray_from_rgb(image)
    scale = min(1.0, _TEXTURE_SIDE_PX / max(gray.shape))
    small = cv2.resize(gray, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    smooth = cv2.GaussianBlur(small, (0, 0), 1.0).astype(np.float64)  # without the sensor's noise
    detail = smooth - cv2.boxFilter(small, cv2.CV_64F, (31, 31))
    return sharpness(np.asarray(small, np.uint8)), float(detail.std())


def sharpness(gray: ImageGray) -> float:
    """Contrast-free sharpness: gradient energy at one pixel over that at three; a blurred frame has little of it."""
    fine, coarse = (  # a fourth of the time that NumPy takes for floats
        float(cv2.meanStdDev(cv2.Laplacian(each, cv2.CV_16S, ksize=1))[1][0, 0])
        for each in (gray, cv2.GaussianBlur(gray, (0, 0), 2.0))
    )
    return fine / (coarse + 0.05)


def _features(
    kind: str, keypoints: Sequence[cv2.KeyPoint], descriptors: MatLike | None, scale: float
) -> Features:
    if descriptors is None or len(keypoints) == 0:
        return Features(kind, np.zeros((0, 2)), np.zeros((0, 32), np.uint8))
    points = np.asarray(cv2.KeyPoint.convert(keypoints), dtype=np.float64)
    as_bytes = kind == "orb"
    packed: Descriptors = (
        np.asarray(descriptors, np.uint8) if as_bytes else np.asarray(descriptors, np.float32)
    )
    return Features(kind, (points + 0.5) / scale - 0.5, packed)


def known_only(features: Features, known: Mask, rim_px: int = 9) -> Features:
    """The features on known ground, (H, W) in their picture, and not at its rim."""
    keep = well_inside(features.points_px, known, rim_px)
    return Features(features.kind, features.points_px[keep], features.descriptors[keep])


def well_inside(points_px: PointsPx, known: Mask, rim_px: int) -> Mask:
    """(N,) whether points lie on known ground, (H, W), with only such around them in a window `rim_px` wide."""
    safe = cv2.erode(known.astype(np.uint8), square(rim_px))
    at = np.rint(points_px).astype(int)
    height, width = known.shape
    return safe[at[:, 1].clip(0, height - 1), at[:, 0].clip(0, width - 1)] > 0


def filled(gray: ImageGray, known: Mask) -> ImageGray:
    """The picture, even gray where nothing is known."""
    result = gray.copy()
    if known.any():
        result[~known] = np.uint8(gray[known].mean())
    return result


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
    ys, xs = np.nonzero((likely > _LEAST_POINT) & (likely == cv2.dilate(likely, square(_APART_PX))))
    points = np.column_stack([xs, ys]).astype(np.float64)
    sure = likely[ys, xs] * _sampled(reliability[0], points)[:, 0]
    points = points[np.argsort(-sure, kind="stable")[:most]]
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
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")  # half the CPU time
    return onnxruntime.InferenceSession(
        files("sorvolo.registration").joinpath("learned_features.onnx").read_bytes(),
        options,
        providers=["CPUExecutionProvider"],
    )
