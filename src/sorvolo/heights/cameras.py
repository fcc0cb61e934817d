"""Cameras of a flight in 3D: from the map's poses, which take the ground for level, to poses and points in space."""

from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from sorvolo.errors import InputError
from sorvolo.geometry.arrays import Floats, ImageGray, Mask, PointsM, Rows, shrunk, size_within
from sorvolo.geometry.camera import Camera
from sorvolo.geometry.pose import Pose, rotation_from_vector
from sorvolo.geometry.summary import SIGMA_PER_MEDIAN_DEVIATION
from sorvolo.heights.adjustment import (
    LEAST_SIGMA_PX,
    AdjustmentSettings,
    Priors,
    Scene,
    adjust,
    height_deviations,
    matched_deviations,
    triangulate,
)
from sorvolo.heights.smooth_sigma import SmoothSigma
from sorvolo.heights.views import View, overlaps
from sorvolo.registration.features import FeatureSettings, normalise_contrast, sift_features
from sorvolo.survey.mosaic import Features

FEATURES_SIDE_PX = 1600
"""Longest side of the pictures that features are found in."""

_FEATURES = 2500  # a picture
_RATIO = 0.8  # Lowe's
_INLIER_PX = 1.5  # about the epipolar line
_LEAST_INLIERS = 20  # matches of two photos; by choice
_LEAST_OVERLAP = 0.15  # of two views that are matched
_NEIGHBOURS = 14  # views matched with each at most
_MARGIN = 0.2  # of a picture: features so far beside what two views share on level ground may be shared too
_NEARLY_ALL = 0.9  # of two views' features: what these do not share, all of them do not
_REJECTED_PX = (8.0, 3.0)  # observations farther off are dropped, round by round
_LEAST_SIGMA_M = 0.02  # of a fix
# of cameras with one tilt, round by round: sigma of observations and how far off they are dropped, px, and what the
# lens is free by, times its usual sigmas: before the tilt is found it would take that on itself
_STEADY = (
    (4.0, 40.0, 0.1),
    (2.0, 15.0, 0.1),
    (1.0, 6.0, 0.1),
    (0.5, 3.0, 1.5),
    (0.5, 2.5, 1.5),
)
_HEADING_DEG = 3.0  # sigma of a heading that is held
_BESIDE = 7  # views before and after one that have its heading


@dataclass(frozen=True, eq=False)
class Tracks:
    """M observations of P points: `view` and `point` (M,) rows, `seen` (M, 2) normalised rays."""

    view: Rows
    point: Rows
    seen: Floats
    count: int


@dataclass(eq=False)
class Matches:
    """What `find_tracks` found in a flight before: the last views' features, and what any two views share, by name."""

    features: dict[str, "_Found"] = field(default_factory=dict)
    shared: dict[tuple[str, str], NDArray[np.uint16]] = field(default_factory=dict)


def find_tracks(
    views: Sequence[View], gray: Callable[[int], ImageGray], before: Matches | None = None
) -> Tracks:
    """The points that pictures have in common; `gray(i)` is the picture of view i at any size.

    What was found `before` in views that are as they were is not sought again; what is found now is added to it.
    """
    before = before or Matches()
    found = [
        before.features.get(view.name) or _features(gray(number), view)
        for number, view in enumerate(views)
    ]
    before.features = {each.view.name: each for each in found}
    starts = np.concatenate([[0], np.cumsum([len(each.rays) for each in found])])
    left, right = [], []
    for i, j in _pairs(views):
        names = views[i].name, views[j].name
        if (matched := before.shared.get(names)) is None:
            before.shared[names] = matched = _shared(found[i], found[j]).astype(np.uint16)
        if len(matched):
            left.append(starts[i] + matched[:, 0])
            right.append(starts[j] + matched[:, 1])
    return _joined(left, right, starts, np.concatenate([each.rays for each in found]))


@dataclass(frozen=True, eq=False)
class _Found:
    """A view's features; `rays` (N, 2) normalised, `ground_m` (N, 3) where they meet level ground."""

    view: View
    features: Features
    width_px: int
    rays: Floats
    ground_m: PointsM


def _features(gray: ImageGray, view: View) -> _Found:
    gray = shrunk(gray, size_within(gray, FEATURES_SIDE_PX))
    found = sift_features(normalise_contrast(gray), FeatureSettings(sift_count=_FEATURES))
    rays = view.camera.resized(gray.shape[1], gray.shape[0]).rays_from_pixels(found.points_px)[
        :, :2
    ]
    # (N, 3) where rays of a view meet level ground at height 0; NaN for those that never do.
    away = np.column_stack([rays, np.ones(len(rays))]) @ view.site_from_camera.rotation.T
    eye = view.site_from_camera.translation_m
    down = np.where(away[:, 2] < -0.05 * np.linalg.norm(away, axis=1), away[:, 2], np.nan)
    return _Found(
        view, found, gray.shape[1], rays, np.asarray(eye + away * (-eye[2] / down)[:, None])
    )


def _pairs(views: Sequence[View]) -> Iterator[tuple[int, int]]:
    """The pairs of views that overlap, each with its best neighbours."""
    shared = overlaps(list(views))
    shared = np.maximum(shared, shared.T)
    order = np.argsort(-shared, axis=1, kind="stable")[:, :_NEIGHBOURS]
    chosen = {
        (min(i, int(j)), max(i, int(j)))
        for i in range(len(views))
        for j in order[i]
        if shared[i, j] > _LEAST_OVERLAP
    }
    yield from sorted(chosen)


def _shared(left: _Found, right: _Found) -> Rows:
    """(N, 2) the features that two views share; none where they are too few to trust.

    They are sought among those that the map puts near each other, else among all: the map may have a view elsewhere.
    """
    every = np.arange(len(left.rays)), np.arange(len(right.rays))
    near = (
        _near(left.ground_m, right.view, _MARGIN),
        _near(right.ground_m, left.view, _MARGIN),
    )
    threshold = _INLIER_PX * left.view.camera.width_px / left.width_px / left.view.camera.fx_px
    for rows in (near, every):
        matched = _matched(left.features, right.features, rows, _RATIO)
        good = _agreeing(left.rays[matched[:, 0]], right.rays[matched[:, 1]], threshold)
        if good.sum() >= _LEAST_INLIERS:
            return matched[good]
        if sum(map(len, rows)) > _NEARLY_ALL * sum(map(len, every)):
            break
    return matched[:0]


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
    every = np.arange(len(best))
    top = likeness[every, best]
    is_mutual = top >= likeness.max(axis=0)[best]  # the row of a column's maximum costs far more
    likeness[every, best] = -1.0
    second = likeness.max(axis=1)
    # unit vectors: distance^2 = 2 - 2 likeness
    good = is_mutual & (1 - top < ratio**2 * (1 - second))
    return np.column_stack([rows[0][good], rows[1][best[good]]])


def _agreeing(left: Floats, right: Floats, threshold: float) -> Mask:
    """(N,) which pairs of rays fit one relative motion of two cameras."""
    if len(left) < _LEAST_INLIERS:
        return np.zeros(len(left), bool)
    _, inliers = cv2.findEssentialMat(left, right, np.eye(3), cv2.USAC_MAGSAC, 0.999, threshold)
    return np.zeros(len(left), bool) if inliers is None else inliers[:, 0] > 0


def _joined(left: list[Rows], right: list[Rows], starts: Rows, rays: Floats) -> Tracks:
    """Pairs chained into tracks; a chain that meets two features of one picture loses both of them."""
    total = len(rays)
    if not left:
        return Tracks(np.zeros(0, int), np.zeros(0, int), np.zeros((0, 2)), 0)
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
        int(point.max()) + 1 if len(point) else 0,
    )


@dataclass(frozen=True, eq=False)
class Cameras3D:
    """The views where they stand in 3D (those that tracks hold), and the points that they see.

    `radial` is the left-over distortion, of third and fifth order, to be taken out of pictures; the views' cameras have
    the focal length and the optical centre found.
    `lost` are the names of views that no track holds. `points_m` (P, 3), `residual_px` the rms of all observations at
    the views' size, `fix_rms_m` (3,) cameras minus fixes, NaN without; `height_sigma` what heights err by the cameras.
    `point_sigma_m` (P,) is what the points' heights err by their features alone, `point_views` (P,) how many see each;
    `view_residuals_px` (V,) is the median of each view's residuals, `view_pieces` (V,) which views points tie together.
    """

    views: tuple[View, ...]
    lost: tuple[str, ...]
    points_m: PointsM
    residual_px: float
    focal_scale: float
    radial: tuple[float, float]
    fix_rms_m: Floats
    observations: int
    height_sigma: SmoothSigma = field(default_factory=SmoothSigma)
    point_sigma_m: Floats = field(default_factory=lambda: np.zeros(0))
    point_views: Rows = field(default_factory=lambda: np.zeros(0, int))
    view_residuals_px: Floats = field(default_factory=lambda: np.zeros(0))
    view_pieces: Rows = field(default_factory=lambda: np.zeros(0, int))

    def of(self, names: Collection[str]) -> "Cameras3D":
        """These views of them alone, and all points."""
        kept = np.array([each.name in names for each in self.views], bool)
        return replace(
            self,
            views=tuple(each for each, is_kept in zip(self.views, kept) if is_kept),
            lost=tuple(each for each in self.lost if each in names),
            view_residuals_px=self.view_residuals_px[kept],
            view_pieces=self.view_pieces[kept],
        )


def solve_tracks(views: Sequence[View], tracks: Tracks) -> Cameras3D:
    """The cameras of a flight in 3D, by the points of `find_tracks`; attitudes may lean as the map's do on a slope.

    Raises InputError where photos share too little for it.
    """
    held = _held(views, tracks)
    # the attitudes lean alike on a slope: N of them know no more of its tilt than one
    alike_deg = AdjustmentSettings().attitude_sigma_deg * float(np.sqrt(len(views)))
    settings = AdjustmentSettings(attitude_sigma_deg=alike_deg)
    priors = _priors(views)
    scene = _first(views, tracks)
    for limit_px in (*_REJECTED_PX, None):
        scene = adjust(scene, priors, settings)
        if limit_px is not None:
            scene = scene.keeping(_fitting(scene, limit_px))
            priors = _reweighed(scene, priors)
    # The pictures weighed as they fit (their residuals' median), which is better than the
    # settings assume.
    fit_px = SIGMA_PER_MEDIAN_DEVIATION * float(np.nanmedian(np.abs(scene.residuals_px())))
    weighed = replace(settings, sigma_px=max(fit_px, LEAST_SIGMA_PX))
    return replace(
        _solved(views, scene, priors, held),
        height_sigma=SmoothSigma.fitted(
            scene.points_m[:, :2], height_deviations(scene, priors, weighed)
        ),
        point_sigma_m=matched_deviations(scene, priors, weighed),
    )


def solve_steady(views: Sequence[View], tracks: Tracks) -> Cameras3D:
    """The cameras of a flight whose gimbal holds one tilt, unknown, and whose aircraft holds its heading along strips.

    For crowns, which hold no free cameras: few pictures share a point, and none shows points far below. Heights have no
    sigma. Raises InputError where photos share too little for it.
    """
    held, priors = _held(views, tracks), _priors(views)
    centres_m = np.array([each.site_from_camera.translation_m for each in views])
    fixes_m = np.where(np.isfinite(priors.fixes_m), priors.fixes_m, centres_m)
    rotations = _one_tilt(priors.rotations)
    headings = _headings(rotations)
    rotations = _along(rotations, headings)
    began = [
        replace(view, site_from_camera=Pose(*place))
        for view, *place in zip(views, rotations, fixes_m)
    ]
    scene = _first(began, tracks)
    for sigma_px, limit_px, freedom in _STEADY:
        priors = replace(priors, fixes_m=fixes_m, rotations=_along(rotations, headings))
        scene = adjust(
            scene, priors, AdjustmentSettings(sigma_px, _HEADING_DEG, freedom, is_steady=True)
        )
        rotations = _one_tilt(scene.rotations)
        scene = replace(scene, rotations=rotations)
        scene = scene.keeping(_fitting(scene, limit_px))
        priors = _reweighed(scene, priors)
    return _solved(views, scene, priors, held)


def _headings(rotations: Floats) -> Rows:
    """(N,) which of four headings, a quarter turn apart, the pictures about each view have: along, back and across."""
    turns = np.exp(1j * _yaws(rotations))
    turns = np.convolve(np.pad(turns, _BESIDE, mode="edge"), np.ones(2 * _BESIDE + 1), "valid")
    quarters = 2 / np.pi * np.angle(turns)
    return np.round(quarters - np.angle(np.exp(2j * np.pi * quarters).sum()) / (2 * np.pi)) % 4


def _along(rotations: Floats, headings: Rows) -> Floats:
    """(N, 3, 3) the rotations turned about the vertical to what is usual among those of their heading."""
    yaws = _yaws(rotations)
    turns = np.zeros_like(yaws)
    for heading in np.unique(headings):
        at = headings == heading
        middle = np.angle(np.exp(1j * yaws[at]).sum())
        off = np.angle(np.exp(1j * (yaws[at] - middle)))
        turns[at] = np.median(off) - off
    return rotation_from_vector(turns[:, None] * [0.0, 0.0, 1.0]) @ rotations


def _yaws(rotations: Floats) -> Floats:
    return np.arctan2(rotations[:, 1, 0], rotations[:, 0, 0])


def _held(views: Sequence[View], tracks: Tracks) -> Mask:
    """(N,) the views that tracks hold. Raises InputError for fewer than three."""
    held = np.bincount(tracks.view, minlength=len(views)) >= _LEAST_INLIERS
    if held.sum() < 3:
        raise InputError(
            f"only {int(held.sum())} of {len(views)} photos share enough points for heights, 3 were needed; "
            "fly with at least 70 % overlap along and 60 % across the strips"
        )
    return np.asarray(held)


def _one_tilt(rotations: Floats) -> Floats:
    """(N, 3, 3) the rotations site_from_camera with the least turn that gives all of them their usual tilt."""
    usual = np.median(rotations[:, 2], axis=0)
    turn = np.cross(usual / np.linalg.norm(usual), rotations[:, 2])
    return rotations @ rotation_from_vector(turn)


def _first(views: Sequence[View], tracks: Tracks) -> Scene:
    scene = Scene(
        np.array([each.site_from_camera.rotation for each in views]),
        np.array([each.site_from_camera.translation_m for each in views]),
        np.array([each.camera.fx_px for each in views]),
        np.full((tracks.count, 3), np.nan),
        tracks.view,
        tracks.point,
        tracks.seen,
        np.zeros(5),
    )
    scene = replace(scene, points_m=triangulate(scene))
    known = np.asarray(np.isfinite(scene.points_m).all(axis=1))
    scene = scene.keeping(known[scene.point])
    return scene.keeping(np.asarray(np.isfinite(scene.residuals_px()).all(axis=1)))


def _fitting(scene: Scene, limit_px: float) -> Mask:
    with np.errstate(invalid="ignore"):
        return np.linalg.norm(scene.residuals_px(), axis=1) < limit_px


def _priors(views: Sequence[View]) -> Priors:
    """Fixes weighed by how they scatter about the map's cameras; the map's own height is kept in the mean."""
    fixes = np.array([each.fix_m for each in views])
    centres = np.array([each.site_from_camera.translation_m for each in views])
    rotations = np.array([each.site_from_camera.rotation for each in views])
    miss = centres - fixes
    if not np.isfinite(miss).any():
        return Priors(centres, np.full_like(centres, 0.5), rotations)
    middle = np.nanmedian(miss, axis=0)
    return Priors(fixes + middle, _sigmas_m(miss - middle, len(fixes), 1.0), rotations)


def _reweighed(scene: Scene, priors: Priors) -> Priors:
    """The fixes weighed by how they scatter about the cameras in space, what these may lean or stretch left out.

    The map's own cameras, which `_priors` begins with, are off in height where the ground is not level.
    """
    miss = scene.centres_m - priors.fixes_m
    known = np.asarray(np.isfinite(miss).all(axis=1))
    if known.sum() < 2 * 3:
        return priors
    terms = np.column_stack([scene.centres_m[known, :2], np.ones(known.sum())])
    terms[:, :2] -= terms[:, :2].mean(axis=0)
    left = miss[known] - terms @ np.linalg.lstsq(terms, miss[known], rcond=None)[0]
    freedom = len(left) / (len(left) - 3)
    return replace(priors, sigmas_m=_sigmas_m(left, len(miss), freedom))


def _sigmas_m(scatter_m: Floats, count: int, freedom: float) -> Floats:
    """(count, 3) the sigma of each fix from how known ones scatter, (N, 3), by its median; `freedom` is N over what is
    left of it."""
    spread = SIGMA_PER_MEDIAN_DEVIATION * np.nanmedian(np.abs(scatter_m), axis=0) * np.sqrt(freedom)
    return np.broadcast_to(np.maximum(spread, _LEAST_SIGMA_M), (count, 3))


def _solved(views: Sequence[View], scene: Scene, priors: Priors, held: Mask) -> Cameras3D:
    scale = float(np.exp(scene.shared[0]))
    moved = tuple(
        replace(
            view,
            camera=_found(view.camera, scale, scene.shared[3:]),
            site_from_camera=Pose(scene.rotations[k], scene.centres_m[k]),
        )
        for k, view in enumerate(views)
        if held[k]
    )
    residual = scene.residuals_px()
    miss_px = np.linalg.norm(residual, axis=1)
    size = len(views) + len(scene.points_m)
    ties = coo_matrix(
        (np.ones(len(residual), np.int8), (scene.view, len(views) + scene.point)), (size, size)
    )
    pieces = np.asarray(connected_components(ties, directed=False)[1], int)
    with np.errstate(invalid="ignore"):
        off = (scene.centres_m - priors.fixes_m)[held]
    return Cameras3D(
        moved,
        tuple(view.name for k, view in enumerate(views) if not held[k]),
        scene.points_m,
        float(np.sqrt(np.nanmean((residual**2).sum(axis=1)))),
        scale,
        (float(scene.shared[1]), float(scene.shared[2])),
        np.sqrt(np.nanmean(off**2, axis=0)),
        len(scene.view),
        point_views=np.bincount(scene.point, minlength=len(scene.points_m)),
        view_residuals_px=np.array(
            [np.nanmedian(miss_px[scene.view == k]) for k in np.flatnonzero(held)]
        ),
        view_pieces=pieces[: len(views)][held],
    )


def _found(camera: Camera, scale: float, shift: Floats) -> Camera:
    """The camera with the focal length and the optical centre found, for pictures without the left-over distortion."""
    return replace(
        camera.with_focal_px(camera.fx_px * scale),
        cx_px=float(camera.cx_px - camera.fx_px * shift[0]),
        cy_px=float(camera.cy_px - camera.fy_px * shift[1]),
    )
