"""Two keyframes to a Link or a NoLink: the registration room's one front door."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from sorvolo.geometry.arrays import Floats, Floats32, ImageGray, Mask, Matrix3, PointsPx
from sorvolo.geometry.homography import apply_homography
from sorvolo.geometry.summary import SIGMA_PER_MEDIAN_DEVIATION
from sorvolo.registration.features import (
    FeatureSettings,
    corners,
    known_only,
    learned_features,
    match_learned,
    sift_features,
)
from sorvolo.registration.matching import fit_homography, is_believable, match
from sorvolo.survey.mosaic import Features, Keyframe, Link, NoLink

_REFINE_WINDOW_PX = 15  # side of the patch around a corner (Lucas and Kanade)
_REFINE_REACH_PX = 8.0  # a refined point may leave the first fit by this much
_LEAST_LEARNED = 0.35  # share of learned pairs that agree, for them to link by themselves


@dataclass(frozen=True)
class LinkSettings:
    """When two keyframes count as linked."""

    features: FeatureSettings = field(default_factory=FeatureSettings)
    min_inliers: int = 18  # below this a wrong homography is not rare
    threshold_px: float = 3.0  # inlier band of the first fit; trees' parallax stays inside
    max_pairs: int = 40  # pairs kept per link, spread over the overlap
    min_correlation: float = 0.35  # of the overlaid images: the last check against a false fit


@dataclass(frozen=True, eq=False)
class LinkPrediction:
    """Where the old keyframe's pixels should fall in the new one, and how far off that may be.

    `is_tight`: known to a few pixels, from links that hold already, so that refinement may begin at once.
    """

    new_from_old: Matrix3
    search_px: float
    is_tight: bool = False


_Kept = TypeVar("_Kept")


class LinkCache:
    """Remembers what is costly to extract from a keyframe and is needed by several links."""

    def __init__(self, settings: FeatureSettings, capacity: int = 64) -> None:
        self._settings, self._capacity = settings, capacity
        self._corners: dict[int, PointsPx] = {}
        self._sift: dict[int, Features] = {}
        self._learned: dict[int, Features] = {}

    def corners(self, keyframe: Keyframe) -> PointsPx:
        """Well-textured points of the keyframe, (N, 2)."""
        return self._of(self._corners, keyframe, corners)

    def sift(self, keyframe: Keyframe) -> Features:
        """The keyframe's SIFT features."""
        return self._of(self._sift, keyframe, lambda gray: sift_features(gray, self._settings))

    def learned(self, keyframe: Keyframe) -> Features:
        """The keyframe's learned features."""
        return self._of(self._learned, keyframe, learned_features)

    def _of(
        self, kept: dict[int, _Kept], keyframe: Keyframe, extract: Callable[[ImageGray], _Kept]
    ) -> _Kept:
        if keyframe.id not in kept:
            kept[keyframe.id] = extract(keyframe.gray)
            while len(kept) > self._capacity:
                kept.pop(next(iter(kept)))
        return kept[keyframe.id]


class Effort(StrEnum):
    """Which fits `link` tries, for a caller with several pictures to ask: the dear ones cost fifty times the cheap."""

    CHEAP = "cheap"
    DEAR = "dear"  # only what cheap leaves out
    ALL = "all"


def link(
    new: Keyframe,
    old: Keyframe,
    prediction: LinkPrediction | None,
    settings: LinkSettings,
    cache: LinkCache,
    effort: Effort = Effort.ALL,
) -> Link | NoLink:
    """How `new` fits `old`.

    Fits are tried from cheap to dear: a tight prediction as it is, ORB, then SIFT, then, where a prediction exists,
    learned features. The first believable one is
    refined to sub-pixel pairs (Lucas-Kanade on the old image warped into the new one) and must make the overlaid images
    correlate; where it cannot be, pairs of SIFT and learned features of which enough agree are a link as they are.
    """
    reason = "too few matching points"
    for found in _candidates(new, old, prediction, settings, cache, effort):
        refined = refine(new, old, found.new_from_old, settings, cache)
        if isinstance(refined, Link):
            return refined
        if found.is_sub_pixel:
            return _as_link(new, old, found, settings)
        reason = refined
    return NoLink(new.id, old.id, reason)


@dataclass(frozen=True, eq=False)
class _Fit:
    """A first fit: the map and the pairs, (N, 2) each, that agree with it."""

    new_from_old: Matrix3
    new_px: PointsPx
    old_px: PointsPx
    is_sub_pixel: bool = False


def _candidates(
    new: Keyframe,
    old: Keyframe,
    prediction: LinkPrediction | None,
    settings: LinkSettings,
    cache: LinkCache,
    effort: Effort,
) -> Iterator[_Fit]:
    """First fits from cheap to dear; the last ones are those that only a prediction allows."""
    if effort is not Effort.DEAR:
        if prediction is not None and prediction.is_tight:
            yield _Fit(prediction.new_from_old, np.zeros((0, 2)), np.zeros((0, 2)))
        if (fit := _fit(new.features, old.features, prediction, settings)) is not None:
            yield fit
    if effort is Effort.CHEAP:
        return
    if (fit := _fit(cache.sift(new), cache.sift(old), prediction, settings)) is not None:
        yield fit
    if prediction is not None:
        fit = _fit_learned(new, old, prediction, settings, cache)
        if fit is not None:
            yield fit


def _fit(
    new: Features, old: Features, prediction: LinkPrediction | None, settings: LinkSettings
) -> _Fit | None:
    predicted = prediction.new_from_old if prediction else None
    pairs = match(new, old, predicted, prediction.search_px if prediction else 0.0)
    found = _agreed(new, old, pairs, settings)
    if found is None:
        return None
    fit, share = found
    return replace(fit, is_sub_pixel=new.kind == "sift" and share > 0.25)


def _fit_learned(
    new: Keyframe,
    old: Keyframe,
    prediction: LinkPrediction,
    settings: LinkSettings,
    cache: LinkCache,
) -> _Fit | None:
    """Fit learned features of the old picture, warped as predicted: robust to low texture and noise, not to rotation."""
    size = (new.gray.shape[1], new.gray.shape[0])
    laid = np.asarray(
        cv2.warpPerspective(old.gray, prediction.new_from_old, size, borderValue=128), np.uint8
    )
    seen = (
        cv2.warpPerspective(np.full(old.gray.shape, 255, np.uint8), prediction.new_from_old, size)
        > 0
    )
    ours, theirs = cache.learned(new), known_only(learned_features(laid), np.asarray(seen))
    pairs = match_learned(ours, theirs, np.eye(3), prediction.search_px)
    found = _agreed(ours, theirs, pairs, settings)
    if found is None:
        return None
    fit, share = found
    return _Fit(
        fit.new_from_old @ prediction.new_from_old,
        fit.new_px,
        apply_homography(np.linalg.inv(prediction.new_from_old), fit.old_px),
        is_sub_pixel=bool(share > _LEAST_LEARNED and _are_spread(fit.new_px, size)),
    )


def _agreed(
    new: Features, old: Features, pairs: NDArray[np.int64], settings: LinkSettings
) -> tuple[_Fit, float] | None:
    """The fit to index pairs, (N, 2), and the share of them that agree with it; None where too few do."""
    if len(pairs) < settings.min_inliers:
        return None
    new_px, old_px = new.points_px[pairs[:, 0]], old.points_px[pairs[:, 1]]
    found = fit_homography(new_px, old_px, settings.threshold_px)
    if found is None or found[1].sum() < settings.min_inliers:
        return None
    agree = found[1]
    return _Fit(found[0], new_px[agree], old_px[agree]), float(agree.mean())


def _are_spread(points_px: PointsPx, size: tuple[int, int]) -> bool:
    """Whether points span enough of a picture to hold it."""
    return bool((points_px.std(axis=0) > 0.05 * np.array(size)).all())


def _as_link(new: Keyframe, old: Keyframe, found: _Fit, settings: LinkSettings) -> Link:
    """The pairs of a sub-pixel detector as they are: trees and roofs leave little that one plane could refine."""
    miss = np.linalg.norm(apply_homography(found.new_from_old, found.old_px) - found.new_px, axis=1)
    chosen = _spread(found.new_px, miss, np.isfinite(miss), settings.max_pairs)
    sigma_px = max(0.3, float(np.median(miss) / 1.1774))
    return Link(
        new.id, old.id, found.new_px[chosen], found.old_px[chosen], found.new_from_old, sigma_px
    )


def refine(
    new: Keyframe, old: Keyframe, new_from_old: Matrix3, settings: LinkSettings, cache: LinkCache
) -> Link | str:
    """Sub-pixel pairs around a first fit that is right to `refine_reach_px`, or in words why there are none."""
    points = cache.corners(new)
    old_guess = apply_homography(np.linalg.inv(new_from_old), points)
    margin = _REFINE_WINDOW_PX / 2
    high = np.array([old.gray.shape[1], old.gray.shape[0]]) - margin
    with np.errstate(invalid="ignore"):
        points = points[((old_guess > margin) & (old_guess < high)).all(axis=1)]
    if len(points) < settings.min_inliers:
        return "the overlap is too small"
    size = (new.gray.shape[1], new.gray.shape[0])
    overlaid = old.gray.shape == new.gray.shape and np.array_equal(new_from_old, np.eye(3))
    warped = old.gray
    if not overlaid:
        warped = np.asarray(
            cv2.warpPerspective(old.gray, new_from_old, size, flags=cv2.INTER_LINEAR), np.uint8
        )
    start = points.astype(np.float32).reshape(-1, 1, 2)
    window = (_REFINE_WINDOW_PX, _REFINE_WINDOW_PX)
    stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 30, 0.01)
    ahead, found, _ = cv2.calcOpticalFlowPyrLK(
        new.gray,
        warped,
        start,
        start.copy(),
        winSize=window,
        maxLevel=1,
        criteria=stop,
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
        minEigThreshold=1e-7,
    )
    good = (found.ravel() > 0) & (np.linalg.norm((ahead - start)[:, 0], axis=1) < _REFINE_REACH_PX)
    if good.sum() < settings.min_inliers:
        return f"only {int(good.sum())} points could be followed from one image to the other"
    good[good] = (
        _correlation(new.gray, warped, start[good, 0], ahead[good, 0]) > settings.min_correlation
    )
    if good.sum() < settings.min_inliers:
        return f"the overlaid images agree at only {int(good.sum())} points"
    new_px = points[good]
    old_px = apply_homography(np.linalg.inv(new_from_old), ahead[good, 0].astype(np.float64))
    fitted = fit_homography(new_px, old_px, 2.0)
    if fitted is None or fitted[1].sum() < settings.min_inliers:
        return "no single plane fits the refined points"
    homography, inliers = fitted
    if inliers.mean() < 0.3 or not is_believable(homography, old_px):
        return f"only {inliers.mean():.0%} of the refined points fit one plane"
    miss = np.linalg.norm(apply_homography(homography, old_px) - new_px, axis=1)
    near = miss < _REFINE_REACH_PX
    chosen = _spread(new_px, miss, near, settings.max_pairs)
    # Rayleigh's median to a per-axis sigma
    sigma_px = float(SIGMA_PER_MEDIAN_DEVIATION * np.median(miss[inliers]) / 1.1774)
    return Link(new.id, old.id, new_px[chosen], old_px[chosen], homography, max(sigma_px, 0.05))


def _correlation(
    new: ImageGray, warped: ImageGray, at_new: Floats32, at_warped: Floats32
) -> Floats32:
    """(N,) normalised cross-correlation of 15 px patches around paired points."""
    offsets = np.arange(-7, 8, dtype=np.float32)
    dy, dx = np.meshgrid(offsets, offsets, indexing="ij")

    def patches(image: ImageGray, at: Floats32) -> Floats32:
        x = (at[:, :1] + dx.ravel()).astype(np.float32)
        y = (at[:, 1:] + dy.ravel()).astype(np.float32)
        remapped = cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        values = np.asarray(remapped, np.float32)
        values -= values.mean(axis=1, keepdims=True)
        return values / (np.linalg.norm(values, axis=1, keepdims=True) + 1.0)

    return (patches(new, at_new) * patches(warped, at_warped)).sum(axis=1)


def _spread(points: PointsPx, miss: Floats, usable: Mask, count: int) -> NDArray[np.intp]:
    """Indices of at most `count` usable points, taken in turn from the cells of a 6 x 6 grid over the points."""
    indices = np.flatnonzero(usable)
    if len(indices) <= count:
        return indices
    low, high = points[indices].min(axis=0), points[indices].max(axis=0)
    cell = np.minimum((points[indices] - low) / (high - low + 1e-9) * 6, 5).astype(int) @ np.array(
        [1, 6]
    )
    order = np.lexsort((miss[indices], cell))
    rank = np.zeros(len(indices), int)
    starts = np.flatnonzero(np.diff(cell[order], prepend=-1))
    rank[order] = np.arange(len(indices)) - np.repeat(
        starts, np.diff(np.append(starts, len(indices)))
    )
    return np.sort(indices[np.lexsort((cell, rank))[:count]])
