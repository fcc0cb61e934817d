"""Boxes in a picture laid on the ground: by a camera's prior while it flies, by its final place on a finished map."""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from sorvolo.geometry.arrays import Floats, Mask, PointsM
from sorvolo.geometry.camera import Camera
from sorvolo.geometry.ground import ground_from_pixels
from sorvolo.geometry.homography import pose_from_homography
from sorvolo.geometry.pose import Pose
from sorvolo.survey.flight import CameraPrior
from sorvolo.survey.mosaic import PlacedFrame, Status
from sorvolo.survey.objects import TYPICAL_SIZE_M, Detections, Sighting
from sorvolo.tracking.sizes import (
    TOO_SHORT_CUT_PX,
    beyond_edges,
    cut_edges,
    impossible_size,
    size_log_odds,
)
from sorvolo.tracking.view_evidence import score_from_views

_BOX_SIGMA = 0.06  # of a box's middle, in shares of its side
_LEAST_SIGMA_PX = 1.0  # of a box's middle, however small the box
_LEAST_SIGMA_M = 0.03  # of a place, however fine the map
_HEIGHT_SIGMA = 0.15  # of a class's usual height, along the lean
# of what a cut box is off outwards: along the edge, where a slanting body's corner shows
_ASIDE = 0.4
_FARTHEST = 6.0  # times the height: beyond it, a pixel's error is many metres


@dataclass(frozen=True, eq=False)
class LaidSighting:
    """A sighting as fusing needs it.

    `sighting.position_m` is where the object stands if it is as high as its class usually is; `middle_up_m` the height
    above the ground that its box's middle then has. `lean` (2,) is how far that place moves, east and north, with each
    metre that the middle lies higher: towards the camera. `own_sigma_m` is the place's error against other frames of
    the flight, per axis. `axes` (2, 2) are the directions on the ground, a row each, along which the box's width and
    height are `sides_m` (2,). `beyond_m2` (2, 2) is the covariance of where its middle may lie beyond the picture's
    edge, zero where that does not cut it; all sightings that are cut alike err alike in that. `ground_m` is the ground's
    height there, above the site's level plane.
    """

    sighting: Sighting
    middle_up_m: float
    lean: Floats
    own_sigma_m: float
    axes: Floats
    sides_m: Floats
    beyond_m2: Floats
    ground_m: float = 0.0

    @property
    def is_cut(self) -> bool:
        """Whether the picture's edge cuts it."""
        return bool(np.any(self.beyond_m2))


def lay_on_ground(
    seen: Detections,
    frame: PlacedFrame,
    *,
    has_metres: bool = True,
    ground: "MeasuredGround | None" = None,
) -> list[LaidSighting | None]:
    """Where each detection of a frame stands on the ground (None: level), None where that is at the horizon or unknown.

    None as well for what is of a size that its class cannot have (`sizes`).

    A box's middle is taken as the middle of the body, half its class's usual height above the ground (TYPICAL_SIZE_M);
    without metres it lies on the ground. Boxes are in the frame's own pixels, lens distortion and all.
    """
    pose = pose_of(frame)
    if pose is None:
        return [None] * len(seen)
    camera = frame.camera
    boxes_px = np.asarray(seen.boxes_px, np.float64).reshape(-1, 4)
    cut = cut_edges(boxes_px, camera.width_px, camera.height_px, TOO_SHORT_CUT_PX)
    middles_px = (boxes_px[:, :2] + boxes_px[:, 2:]) / 2 - 0.5
    usual_m = np.array([usual_height_m(name) if has_metres else 0.0 for name in seen.names])
    planes_m, ground_sigmas_m = usual_m / 2, np.zeros(len(seen))
    if ground is not None and len(seen):
        rays = camera.rays_from_pixels(middles_px) @ pose.rotation.T
        reach, on_it_m = _reach(rays, pose.translation_m, planes_m, lambda at_m: ground(at_m)[0])
        planes_m = np.where(np.isfinite(on_it_m), on_it_m, planes_m)
        places_m = pose.translation_m[:2] + np.nan_to_num(reach)[:, None] * rays[:, :2]
        ground_sigmas_m = ground(places_m)[1]
    laid: list[LaidSighting | None] = []
    for row, name in enumerate(seen.names):
        laid.append(None)
        height_m, plane_m = float(usual_m[row]), float(planes_m[row])
        # the box's middle, and the middles of its left, right, top and bottom edges
        left, top, right, bottom = boxes_px[row] - 0.5
        x, y = middles_px[row]
        cross_px = np.array([[x, y], [left, y], [right, y], [x, top], [x, bottom]])
        around_m = ground_from_pixels(camera, pose, cross_px, plane_m)
        place_m = around_m[0]
        reach_m = pose.translation_m[2] - plane_m
        if not np.isfinite(around_m).all() or reach_m <= 0:
            continue
        lean = (pose.translation_m[:2] - place_m) / reach_m
        spans_m = np.array([around_m[2] - around_m[1], around_m[4] - around_m[3]])
        sides_m = np.hypot(*spans_m.T)
        cuts = cut[row : row + 1]
        is_impossible = has_metres and bool(impossible_size((name,), sides_m[None], cuts)[0])
        if float(np.hypot(*lean)) > _FARTHEST or is_impossible:
            continue
        # how well the place is known
        area_px = boxes_px[row, 2:] - boxes_px[row, :2]
        m_per_px = float(np.sqrt(np.prod(sides_m) / max(np.prod(area_px), 1e-6)))
        axes = spans_m / np.maximum(sides_m, 1e-9)[:, None]
        (outward_m,), (beyond_m2,) = beyond_edges(
            (name,), cuts, axes[None], sides_m[None], has_metres=has_metres
        )
        beyond_m2 = beyond_m2 + _ASIDE**2 * np.trace(beyond_m2) * np.eye(2)
        pose_m = frame.residual_px * m_per_px if np.isfinite(frame.residual_px) else 0.0
        if frame.status is Status.GPS_ONLY and np.isfinite(frame.sigma_m):
            pose_m = frame.sigma_m
        parts = [
            _LEAST_SIGMA_M,
            _LEAST_SIGMA_PX * m_per_px,
            _BOX_SIGMA * float(sides_m.mean()),
            pose_m,
        ]
        own_sigma_m = float(np.sqrt(np.sum(np.square(parts))))
        up_sigma_m = np.hypot(_HEIGHT_SIGMA * height_m, ground_sigmas_m[row]) * lean
        sighting = Sighting(
            frame.index,
            frame.name,
            frame.time_ns,
            name,
            float(seen.scores[row]),
            seen.boxes_px[row],
            place_m + outward_m,
            own_sigma_m**2 * np.eye(2) + np.outer(up_sigma_m, up_sigma_m) + beyond_m2,
            np.sort(sides_m)[::-1],
        )
        own_sigma_m = float(np.hypot(own_sigma_m, np.sqrt(np.trace(beyond_m2) / 2)))
        ground_m = plane_m - height_m / 2
        laid[row] = LaidSighting(
            sighting, height_m / 2, lean, own_sigma_m, axes, sides_m, beyond_m2, ground_m
        )
    return laid


def shows(frame: PlacedFrame, places_m: PointsM, up_m: Floats, reach_m: Floats) -> Mask:
    """(N,) bool: which places (N, 2), at heights `up_m` (N,), lie so well within the frame that something reaching
    `reach_m` (N,) about each is seen whole."""
    pose = pose_of(frame)
    if pose is None:
        return np.zeros(len(places_m), bool)
    camera = frame.camera.undistorted()
    points = np.column_stack([places_m, up_m])
    rays = (points - pose.translation_m) @ pose.rotation
    in_front = rays[:, 2] > 1e-6
    x = camera.fx_px * rays[:, 0] / np.where(in_front, rays[:, 2], 1.0) + camera.cx_px
    y = camera.fy_px * rays[:, 1] / np.where(in_front, rays[:, 2], 1.0) + camera.cy_px
    margin_px = reach_m * camera.fx_px / np.where(in_front, rays[:, 2], 1.0) + 2.0
    return np.asarray(
        in_front
        & (x >= margin_px)
        & (y >= margin_px)
        & (x <= camera.width_px - 1 - margin_px)
        & (y <= camera.height_px - 1 - margin_px),
        bool,
    )


def pose_of(frame: PlacedFrame) -> Pose | None:
    """Where the frame's camera was; None for one that has no place, or none over level ground."""
    if frame.status is Status.REJECTED:
        return None
    return frame.site_from_camera or pose_from_homography(
        frame.site_from_image, frame.camera.undistorted()
    )


def usual_height_m(name: str) -> float:
    """How high a class's members usually are; of classes that are not ours a guess between a thing and a person."""
    return TYPICAL_SIZE_M[name][2] if name in TYPICAL_SIZE_M else 1.0


GroundHeight = Callable[[PointsM], Floats]
"""Heights (N,) of the ground above the site's level plane, m, at east, north (N, 2); NaN where it is not known."""

MeasuredGround = Callable[[PointsM], tuple[Floats, Floats]]
"""Heights (N,) of the ground as `GroundHeight` has them, and how well they are known (N,), 1 sigma, m."""

IMPOSSIBLE_SIZE = "of a size that its class cannot have"
"""The words for what could be placed, and is set aside: it is not what the detector took it for."""


_MOST_SIGMA_M = 50.0  # a place known no better is none
_FARTHEST_M = 5000.0  # along the ground
_GROUND_STEPS = 12  # with which a ray's end is searched on a height model ...
_GROUND_SETTLED_M = 0.3  # ... which must move it by no more in the end


@dataclass(frozen=True)
class LocateSettings:
    """How well the parts of a place are known."""

    box_sigma_share: float = 0.08  # of a box's side: how far its middle is off the object's
    least_box_sigma_px: float = 1.0  # however small the box
    height_sigma_share: float = 0.35  # of half a height: people sit and lie, cars are vans
    ground_sigma_m: float = 0.0  # of the ground's height, beside what is in the camera's own height


def locate(
    found: Detections,
    frame_index: int,
    frame_name: str,
    time_ns: int,
    camera: Camera,
    prior: CameraPrior,
    *,
    focal_sigma: float = 0.0,
    ground_height_m: float | GroundHeight = 0.0,
    settings: LocateSettings = LocateSettings(),
) -> tuple[list[Sighting | None], Counter[str]]:
    """Each detection's place on the ground, None for those without; and why they have none, in words, counted.

    The ray through a box's middle meets the level plane that lies half the object's usual height above the ground.
    The covariance is propagated to first order from the camera's place, attitude (about its own axes) and focal
    length (`focal_sigma`, relative), the box's middle and the object's height. An unknown heading leaves a circle
    about the point below the camera: its radius is then the sigma.
    """
    if not len(found):
        return [], Counter()
    if (why_not := _unplaced(prior)) is not None:
        return [None] * len(found), Counter({why_not: len(found)})
    boxes = found.boxes_px.astype(np.float64)
    sides_px = boxes[:, 2:] - boxes[:, :2]
    # rays (N, 3) in camera and in site axes, and how they turn per pixel to the right and down, (N, 3, 2)
    middles_px = (boxes[:, :2] + boxes[:, 2:]) / 2 - 0.5
    steps_px = np.array([[0.0, 0.0], [0.5, 0.0], [-0.5, 0.0], [0.0, 0.5], [0.0, -0.5]])
    points_px = (middles_px + steps_px[:, None, :]).reshape(-1, 2)
    rays, right, left, below, above = camera.rays_from_pixels(points_px).reshape(5, -1, 3)
    slopes = np.stack([right - left, below - above], axis=2)
    rays_site = rays @ prior.rotation.T
    # where they meet the planes of their objects: `away` is how far a place moves with each metre that the plane sinks
    heights_m = np.array([usual_height_m(name) for name in found.names])
    reach, plane_m = _reach(rays_site, prior.position_m, heights_m / 2, ground_height_m)
    is_known, is_downward = np.isfinite(plane_m), rays_site[:, 2] < 0
    meets = is_downward & is_known & (reach > 0)
    reach = np.where(meets, reach, 1.0)
    places_m = prior.position_m[:2] + reach[:, None] * rays_site[:, :2]
    with np.errstate(divide="ignore", invalid="ignore"):
        away = np.where(meets[:, None], rays_site[:, :2] / rays_site[:, 2:], 0.0)
    # (N, 2, 3) a small step of the ray's end, seen along the ray on the plane: in site axes, in the camera's
    flat = np.broadcast_to(np.eye(2), (len(reach), 2, 2))
    onto = np.concatenate([flat, -away[:, :, None]], axis=2)
    along = np.asarray(reach[:, None, None] * onto @ prior.rotation, np.float64)
    # errors that all boxes of the frame share: of camera, attitude, focal length and ground
    shared = onto @ np.diag(prior.position_sigma_m**2) @ onto.transpose(0, 2, 1)
    sigma_rad = np.radians(
        np.where(np.isfinite(prior.attitude_sigma_deg), prior.attitude_sigma_deg, 0.0)
    )
    about_axes = np.cross(np.eye(3)[None, :, :], rays[:, None, :]).transpose(0, 2, 1) * sigma_rad
    moved = along @ about_axes
    turned = moved @ moved.transpose(0, 2, 1)
    if not np.isfinite(prior.attitude_sigma_deg[2]):
        from_nadir_m = reach[:, None] * rays_site[:, :2]
        turned = turned + (from_nadir_m**2).sum(axis=1)[:, None, None] * np.eye(2)
    shared += turned
    focal = along[:, :, :2] @ rays[:, :2, None] * focal_sigma
    shared += focal @ focal.transpose(0, 2, 1)
    shared += (settings.ground_sigma_m**2) * away[:, :, None] @ away[:, None, :]
    # errors of each box alone: of its middle and the object's height
    per_px = along @ slopes  # (N, 2, 2) metres on the ground per pixel
    sigma_px = np.maximum(settings.box_sigma_share * sides_px, settings.least_box_sigma_px)
    own = per_px @ (sigma_px[:, :, None] ** 2 * np.eye(2)) @ per_px.transpose(0, 2, 1)
    up_sigma_m = settings.height_sigma_share * heights_m / 2
    own += (up_sigma_m**2)[:, None, None] * away[:, :, None] @ away[:, None, :]
    # sizes, and what the picture's edge hides
    slopes_m = np.linalg.norm(per_px, axis=1)
    sizes_m = slopes_m * sides_px
    axes = per_px.transpose(0, 2, 1) / np.maximum(slopes_m, 1e-9)[:, :, None]
    cut = cut_edges(boxes, camera.width_px, camera.height_px)
    cut_short = cut_edges(boxes, camera.width_px, camera.height_px, TOO_SHORT_CUT_PX)
    height_sigma_m = np.hypot(prior.position_sigma_m[2], settings.ground_sigma_m)
    drop_m = reach * -rays_site[:, 2]
    scale_sigmas = np.hypot(height_sigma_m / np.maximum(drop_m, 1e-6), focal_sigma)
    is_impossible = impossible_size(found.names, sizes_m, cut_short, scale_sigmas)
    outward_m, beyond_m2 = beyond_edges(found.names, cut, axes, sizes_m)
    places_m, covariances = places_m + outward_m, shared + (own + beyond_m2)
    # which of them are places
    sigmas_m = np.sqrt(np.trace(covariances, axis1=1, axis2=2) / 2)
    apart_m = np.linalg.norm(places_m - prior.position_m[:2], axis=1)
    checks = (
        (~is_downward, "at or above the horizon"),
        (~is_known, "the height model does not cover the ground there"),
        (~meets, "by the telemetry the camera is not above the ground"),
        (apart_m > _FARTHEST_M, f"farther than {_FARTHEST_M:g} m"),
        (~(sigmas_m <= _MOST_SIGMA_M), f"the place is known no better than {_MOST_SIGMA_M:g} m"),
        (is_impossible, IMPOSSIBLE_SIZE),
    )
    shared_sigmas_m = np.sqrt(np.trace(shared, axis1=1, axis2=2) / 2)
    sightings: list[Sighting | None] = []
    reasons: Counter[str] = Counter()
    for row, name in enumerate(found.names):
        if reason := next((words for fails, words in checks if fails[row]), ""):
            reasons[reason] += 1
            sightings.append(None)
            continue
        score = float(found.scores[row])
        if not cut_short[row].any():
            if of_size := size_log_odds(name, sizes_m[row], float(scale_sigmas[row])):
                score = score_from_views([score], 1, name, of_size)
        sightings.append(
            Sighting(
                frame_index,
                frame_name,
                time_ns,
                name,
                score,
                found.boxes_px[row],
                places_m[row],
                covariances[row],
                np.sort(sizes_m[row])[::-1],
                float(shared_sigmas_m[row]),
            )
        )
    return sightings, reasons


def _unplaced(prior: CameraPrior) -> str | None:
    """Why a camera places nothing at all; None where it may."""
    if not prior.knows_place:
        return "no fix for the frame"
    if not np.isfinite(prior.position_sigma_m[2]):
        return "the camera's height is not known"
    if not np.isfinite(prior.attitude_sigma_deg[:2]).all():
        return "the camera's tilt is not known"
    return None


def _reach(
    rays_site: PointsM,
    camera_m: Floats,
    above_ground_m: Floats,
    ground_height_m: float | GroundHeight,
) -> tuple[Floats, Floats]:
    """(N,) how many rays' lengths lead to the plane of each object, and that plane's height; NaN where it is unknown.

    On a height model the plane is found by going there and looking at the height again.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        if not callable(ground_height_m):
            plane_m = ground_height_m + above_ground_m
            return (plane_m - camera_m[2]) / rays_site[:, 2], plane_m
        plane_m = (
            ground_height_m(np.repeat(camera_m[None, :2], len(rays_site), axis=0)) + above_ground_m
        )
        change = np.zeros(len(rays_site))
        for _ in range(_GROUND_STEPS):
            reach = (plane_m - camera_m[2]) / rays_site[:, 2]
            places_m = camera_m[:2] + np.nan_to_num(reach)[:, None] * np.nan_to_num(
                rays_site[:, :2]
            )
            higher = ground_height_m(places_m) + above_ground_m
            change = np.abs(higher - plane_m)
            # half steps settle on slopes towards the camera as well, where full ones would swing about
            plane_m = plane_m + 0.5 * (higher - plane_m)
        plane_m = np.where(change <= _GROUND_SETTLED_M, plane_m, np.nan)
        return (plane_m - camera_m[2]) / rays_site[:, 2], plane_m
