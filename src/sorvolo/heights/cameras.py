"""Cameras of a flight in 3D: from the map's poses, which take the ground for level, to poses and points in space."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from sorvolo.errors import InputError
from sorvolo.geometry.arrays import Floats, ImageGray, Mask, PointsM, Rows
from sorvolo.geometry.camera import Camera
from sorvolo.geometry.pose import Pose
from sorvolo.geometry.summary import SIGMA_PER_MEDIAN_DEVIATION
from sorvolo.heights.adjustment import (
    AdjustmentSettings,
    Priors,
    Scene,
    adjust,
    height_deviations,
    matched_deviations,
    triangulate,
)
from sorvolo.heights.smooth_sigma import SmoothSigma
from sorvolo.heights.tracks import Tracks, TrackSettings, find_tracks
from sorvolo.heights.views import View


@dataclass(frozen=True)
class CameraSettings:
    """How the cameras in 3D are solved."""

    tracks: TrackSettings = field(default_factory=TrackSettings)
    adjustment: AdjustmentSettings = field(default_factory=AdjustmentSettings)
    rejected_px: tuple[float, ...] = (
        8.0,
        3.0,
    )  # observations farther off are dropped, round by round
    least_sigma_m: float = 0.02  # of a fix


@dataclass(frozen=True, eq=False)
class Cameras3D:
    """The views where they stand in 3D (those that tracks hold), and the points that they see.

    `radial` is the left-over distortion, of third and fifth order, to be taken out of pictures; the views' cameras have
    the focal length and the optical centre found.
    `lost` are the names of views that no track holds. `points_m` (P, 3), `residual_px` the rms of all observations at
    the views' size, `fix_rms_m` (3,) cameras minus fixes, NaN without; `height_sigma` what heights err by the cameras.
    `point_sigma_m` (P,) is what the points' heights err by their features alone, `point_views` (P,) how many see each.
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


def solve_cameras(
    views: Sequence[View],
    gray: Callable[[int], ImageGray],
    settings: CameraSettings = CameraSettings(),
) -> Cameras3D:
    """The cameras of a flight in 3D. Raises InputError where photos share too little for it."""
    tracks = find_tracks(views, gray, settings.tracks)
    held = np.bincount(tracks.view, minlength=len(views)) >= settings.tracks.least_inliers
    if held.sum() < 3:
        raise InputError(
            f"only {int(held.sum())} of {len(views)} photos share enough points for heights, 3 were needed; "
            "fly with at least 70 % overlap along and 60 % across the strips"
        )
    # the attitudes lean alike on a slope: N of them know no more of its tilt than one
    alike_deg = settings.adjustment.attitude_sigma_deg * float(np.sqrt(len(views)))
    settings = replace(
        settings, adjustment=replace(settings.adjustment, attitude_sigma_deg=alike_deg)
    )
    priors = _priors(views, settings)
    scene = _first(views, tracks)
    for limit_px in (*settings.rejected_px, None):
        scene = adjust(scene, priors, settings.adjustment)
        if limit_px is not None:
            scene = scene.keeping(_fitting(scene, limit_px))
            priors = _reweighed(scene, priors, settings)
    return _solved(views, scene, priors, held, settings)


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
    return scene.keeping(_in_front(scene))


def _in_front(scene: Scene) -> Mask:
    return np.asarray(np.isfinite(scene.residuals_px()).all(axis=1))


def _fitting(scene: Scene, limit_px: float) -> Mask:
    with np.errstate(invalid="ignore"):
        return np.asarray(np.linalg.norm(scene.residuals_px(), axis=1) < limit_px)


def _priors(views: Sequence[View], settings: CameraSettings) -> Priors:
    """Fixes weighed by how they scatter about the map's cameras; the map's own height is kept in the mean."""
    fixes = np.array([each.fix_m for each in views])
    centres = np.array([each.site_from_camera.translation_m for each in views])
    rotations = np.array([each.site_from_camera.rotation for each in views])
    miss = centres - fixes
    if not np.isfinite(miss).any():
        return Priors(centres, np.full_like(centres, 0.5), rotations)
    middle = np.nanmedian(miss, axis=0)
    return Priors(fixes + middle, _sigmas_m(miss - middle, len(fixes), 1.0, settings), rotations)


def _reweighed(scene: Scene, priors: Priors, settings: CameraSettings) -> Priors:
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
    return replace(priors, sigmas_m=_sigmas_m(left, len(miss), freedom, settings))


def _sigmas_m(scatter_m: Floats, count: int, freedom: float, settings: CameraSettings) -> Floats:
    """(count, 3) the sigma of each fix from how known ones scatter, (N, 3), by its median; `freedom` is N over what is
    left of it."""
    spread = SIGMA_PER_MEDIAN_DEVIATION * np.nanmedian(np.abs(scatter_m), axis=0) * np.sqrt(freedom)
    return np.asarray(np.broadcast_to(np.maximum(spread, settings.least_sigma_m), (count, 3)))


def _solved(
    views: Sequence[View], scene: Scene, priors: Priors, held: Mask, settings: CameraSettings
) -> Cameras3D:
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
    with np.errstate(invalid="ignore"):
        off = (scene.centres_m - priors.fixes_m)[held]
    weighed = _as_it_fits(residual, settings.adjustment)
    sigma = SmoothSigma.fitted(scene.points_m[:, :2], height_deviations(scene, priors, weighed))
    return Cameras3D(
        moved,
        tuple(view.name for k, view in enumerate(views) if not held[k]),
        scene.points_m,
        float(np.sqrt(np.nanmean((residual**2).sum(axis=1)))),
        scale,
        (float(scene.shared[1]), float(scene.shared[2])),
        np.sqrt(np.nanmean(off**2, axis=0)),
        len(scene.view),
        sigma,
        matched_deviations(scene, priors, weighed),
        np.bincount(scene.point, minlength=len(scene.points_m)),
    )


def _found(camera: Camera, scale: float, shift: Floats) -> Camera:
    """The camera with the focal length and the optical centre found, for pictures without the left-over distortion."""
    return replace(
        camera.with_focal_px(camera.fx_px * scale),
        cx_px=float(camera.cx_px - camera.fx_px * shift[0]),
        cy_px=float(camera.cy_px - camera.fy_px * shift[1]),
    )


def _as_it_fits(residual_px: Floats, settings: AdjustmentSettings) -> AdjustmentSettings:
    """The pictures weighed as they fit (their residuals' median), which is better than the settings assume."""
    fit_px = SIGMA_PER_MEDIAN_DEVIATION * float(np.nanmedian(np.abs(residual_px)))
    return replace(settings, sigma_px=max(fit_px, settings.least_sigma_px))
