"""Points that several photos see: features matched between overlapping photos and joined into tracks."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from sorvolo.geometry.arrays import Floats, ImageGray, PointsM, Rows
from sorvolo.heights.views import View, overlaps
from sorvolo.registration.features import FeatureSettings, normalise_contrast, sift_features
from sorvolo.survey.mosaic import Features


@dataclass(frozen=True)
class TrackSettings:
    """How features are found and matched."""

    side_px: int = 1600  # longest side of the pictures that features are found in
    features: int = 2500  # a picture
    ratio: float = 0.8  # Lowe's
    inlier_px: float = 1.5  # about the epipolar line
    least_inliers: int = 20  # matches of two photos; by choice
    least_overlap: float = 0.15  # of two views that are matched
    neighbours: int = 14  # views matched with each at most
    margin: float = 0.2  # of a picture: features so far beside what two views share on level ground may be shared too


@dataclass(frozen=True, eq=False)
class Tracks:
    """M observations of P points: `view` and `point` (M,) rows, `seen` (M, 2) normalised rays; matched pairs (K, 2)."""

    view: Rows
    point: Rows
    seen: Floats
    pairs: Rows
    count: int


def find_tracks(
    views: Sequence[View], gray: Callable[[int], ImageGray], settings: TrackSettings
) -> Tracks:
    """The points that pictures have in common; `gray(i)` is the picture of view i at any size."""
    found = [_features(gray(number), view, settings) for number, view in enumerate(views)]
    starts = np.concatenate([[0], np.cumsum([len(each.rays) for each in found])])
    left, right, pairs = [], [], []
    for i, j in _pairs(views, settings):
        matched = _shared(found[i], found[j], settings)
        if len(matched):
            left.append(starts[i] + matched[:, 0])
            right.append(starts[j] + matched[:, 1])
            pairs.append((i, j))
    return _joined(left, right, pairs, starts, np.concatenate([each.rays for each in found]))


@dataclass(frozen=True, eq=False)
class _Found:
    """A view's features; `rays` (N, 2) normalised, `ground_m` (N, 3) where they meet level ground."""

    view: View
    features: Features
    width_px: int
    rays: Floats
    ground_m: PointsM


def _features(gray: ImageGray, view: View, settings: TrackSettings) -> _Found:
    scale = min(1.0, settings.side_px / max(gray.shape))
    if scale < 1.0:
        size = (round(gray.shape[1] * scale), round(gray.shape[0] * scale))
        gray = cv2.resize(gray, size, interpolation=cv2.INTER_AREA)  # type: ignore[assignment]
    found = sift_features(normalise_contrast(gray), FeatureSettings(sift_count=settings.features))
    rays = view.camera.resized(gray.shape[1], gray.shape[0]).rays_from_pixels(found.points_px)[
        :, :2
    ]
    return _Found(view, found, gray.shape[1], rays, _on_ground(rays, view))


def _pairs(views: Sequence[View], settings: TrackSettings) -> Iterator[tuple[int, int]]:
    """The pairs of views that overlap, each with its best neighbours."""
    shared = overlaps(list(views))
    shared = np.maximum(shared, shared.T)
    order = np.argsort(-shared, axis=1, kind="stable")[:, : settings.neighbours]
    chosen = {
        (min(i, int(j)), max(i, int(j)))
        for i in range(len(views))
        for j in order[i]
        if shared[i, j] > settings.least_overlap
    }
    yield from sorted(chosen)


def _shared(left: _Found, right: _Found, settings: TrackSettings) -> Rows:
    """(N, 2) the features that two views share; none where they are too few to trust.

    They are sought among those that the map puts near each other, else among all: the map may have a view elsewhere.
    """
    every = np.arange(len(left.rays)), np.arange(len(right.rays))
    near = (
        _near(left.ground_m, right.view, settings.margin),
        _near(right.ground_m, left.view, settings.margin),
    )
    threshold = (
        settings.inlier_px * left.view.camera.width_px / left.width_px / left.view.camera.fx_px
    )
    for rows in (near, every):
        matched = _matched(left.features, right.features, rows, settings.ratio)
        good = _agreeing(left.rays[matched[:, 0]], right.rays[matched[:, 1]], threshold)
        if good.sum() >= settings.least_inliers:
            return matched[good]
    return matched[:0]


def _on_ground(rays: Floats, view: View) -> PointsM:
    """(N, 3) where rays of a view meet level ground at height 0; NaN for those that never do."""
    away = np.column_stack([rays, np.ones(len(rays))]) @ view.site_from_camera.rotation.T
    eye = view.site_from_camera.translation_m
    down = np.where(away[:, 2] < -0.05 * np.linalg.norm(away, axis=1), away[:, 2], np.nan)
    return np.asarray(eye + away * (-eye[2] / down)[:, None])


def _near(ground_m: PointsM, view: View, margin: float) -> Rows:
    """The rows of ground points, (N, 3), that lie in a view's picture or at most a `margin` of it beside."""
    size = np.array([view.camera.width_px, view.camera.height_px])
    away = np.abs(view.pixels_from_site(ground_m) / size - 0.5)
    with np.errstate(invalid="ignore"):
        return np.flatnonzero((away < 0.5 + margin).all(axis=1))


def _matched(
    left: Features, right: Features, rows: tuple[Rows, Rows], ratio: float
) -> NDArray[np.int64]:
    """(N, 2) mutual nearest neighbours, among some rows, of unit descriptors that pass the ratio test."""
    if min(map(len, rows)) < 4:
        return np.zeros((0, 2), np.int64)
    likeness = left.descriptors[rows[0]] @ right.descriptors[rows[1]].T
    best = likeness.argmax(axis=1)
    back = likeness.argmax(axis=0)
    every = np.arange(len(best))
    top = likeness[every, best]
    likeness[every, best] = -1.0
    second = likeness.max(axis=1)
    # unit vectors: distance^2 = 2 - 2 likeness
    good = (back[best] == every) & (1 - top < ratio**2 * (1 - second))
    return np.column_stack([rows[0][good], rows[1][best[good]]])


def _agreeing(left: Floats, right: Floats, threshold: float) -> NDArray[np.bool_]:
    """(N,) which pairs of rays fit one relative motion of two cameras."""
    if len(left) < 8:
        return np.zeros(len(left), bool)
    _, inliers = cv2.findEssentialMat(left, right, np.eye(3), cv2.USAC_MAGSAC, 0.999, threshold)
    return np.zeros(len(left), bool) if inliers is None else inliers[:, 0] > 0


def _joined(
    left: list[Rows], right: list[Rows], pairs: list[tuple[int, int]], starts: Rows, rays: Floats
) -> Tracks:
    """Pairs chained into tracks; a chain that meets two features of one picture loses both of them."""
    total = len(rays)
    if not left:
        return Tracks(
            np.zeros(0, int), np.zeros(0, int), np.zeros((0, 2)), np.zeros((0, 2), int), 0
        )
    a, b = np.concatenate(left), np.concatenate(right)
    _, label = connected_components(
        coo_matrix((np.ones(len(a), np.int8), (a, b)), shape=(total, total)), False
    )
    used = np.unique(np.concatenate([a, b]))
    view, label = np.searchsorted(starts, used, side="right") - 1, label[used]
    _, at, count = np.unique(
        label.astype(np.int64) * len(starts) + view, return_inverse=True, return_counts=True
    )
    single = count[at] == 1
    used, view, label = used[single], view[single], label[single]
    _, point, length = np.unique(label, return_inverse=True, return_counts=True)
    long = length[point] >= 2
    _, point = np.unique(point[long], return_inverse=True)
    return Tracks(
        view[long],
        point,
        rays[used[long]],
        np.array(pairs),
        int(point.max()) + 1 if len(point) else 0,
    )
