"""Detections of a placed frame laid on the ground."""

from dataclasses import dataclass

import numpy as np

from sorvolo.geometry.arrays import BoxesPx, Floats, Mask, PointsM, PointsPx
from sorvolo.geometry.homography import pose_from_homography
from sorvolo.geometry.level_ground import ground_from_pixels
from sorvolo.geometry.pose import Pose
from sorvolo.survey.mosaic import PlacedFrame, Status
from sorvolo.survey.objects import TYPICAL_SIZE_M, Detections, Sighting
from sorvolo.tracking.cut_boxes import beyond_edges, cut_edges
from sorvolo.tracking.plausible import TOO_SHORT_CUT_PX, impossible_size


@dataclass(frozen=True)
class LayingSettings:
    """How well a detection's place on a map is known."""

    box_sigma: float = 0.06  # of a box's middle, in shares of its side
    least_sigma_px: float = 1.0  # of a box's middle, however small the box
    least_sigma_m: float = 0.03  # of a place, however fine the map
    height_sigma: float = 0.15  # of a class's usual height, along the lean
    aside: float = 0.4  # of what a cut box is off outwards: along the edge, where a slanting body's corner shows
    farthest: float = 6.0  # times the height: beyond it, a pixel's error is many metres


@dataclass(frozen=True, eq=False)
class LaidSighting:
    """A sighting as fusing needs it.

    `sighting.position_m` is where the object stands if it is as high as its class usually is; `middle_up_m` the height
    above the ground that its box's middle then has. `lean` (2,) is how far that place moves, east and north, with each
    metre that the middle lies higher: towards the camera. `own_sigma_m` is the place's error against other frames of
    the flight, per axis. `axes` (2, 2) are the directions on the ground, a row each, along which the box's width and
    height are `sides_m` (2,). `beyond_m2` (2, 2) is the covariance of where its middle may lie beyond the picture's
    edge, zero where that does not cut it; all sightings that are cut alike err alike in that.
    """

    sighting: Sighting
    middle_up_m: float
    lean: Floats
    own_sigma_m: float
    axes: Floats
    sides_m: Floats
    beyond_m2: Floats

    @property
    def is_cut(self) -> bool:
        """Whether the picture's edge cuts it."""
        return bool(np.any(self.beyond_m2))


def lay_on_ground(
    seen: Detections,
    frame: PlacedFrame,
    *,
    has_metres: bool = True,
    settings: LayingSettings = LayingSettings(),
) -> list[LaidSighting | None]:
    """Where each detection of a frame stands on level ground, None where that is at the horizon or unknown.

    None as well for what is of a size that its class cannot have (`plausible`).

    A box's middle is taken as the middle of the body, half its class's usual height above the ground (TYPICAL_SIZE_M);
    without metres it lies on the ground. Boxes are in the frame's own pixels, lens distortion and all.
    """
    pose = pose_of(frame)
    if pose is None or not len(seen):
        return [None] * len(seen)
    cut = cut_edges(
        np.asarray(seen.boxes_px, np.float64),
        frame.camera.width_px,
        frame.camera.height_px,
        TOO_SHORT_CUT_PX,
    )
    return [
        _laid(seen, k, cut[k : k + 1], frame, pose, settings, has_metres=has_metres)
        for k in range(len(seen))
    ]


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


def _laid(
    seen: Detections,
    k: int,
    cut: Mask,
    frame: PlacedFrame,
    pose: Pose,
    settings: LayingSettings,
    *,
    has_metres: bool,
) -> LaidSighting | None:
    """Detection `k` on the ground, None where it has no place; `cut` (1, 4) are the edges that cut it."""
    name = seen.names[k]
    box_px = np.asarray(seen.boxes_px, np.float64)[k : k + 1]
    height_m = usual_height_m(name) if has_metres else 0.0
    up_m = height_m / 2
    around_m = ground_from_pixels(frame.camera, pose, _cross(box_px), up_m)
    place_m = around_m[0]
    reach_m = pose.translation_m[2] - up_m
    if not np.isfinite(around_m).all() or reach_m <= 0:
        return None
    lean = (pose.translation_m[:2] - place_m) / reach_m
    spans_m = np.array([around_m[2] - around_m[1], around_m[4] - around_m[3]])
    sides_m = np.hypot(*spans_m.T)
    is_impossible = has_metres and bool(impossible_size((name,), sides_m[None], cut)[0])
    if float(np.hypot(*lean)) > settings.farthest or is_impossible:
        return None
    m_per_px = float(np.sqrt(np.prod(sides_m) / max(np.prod(box_px[0, 2:] - box_px[0, :2]), 1e-6)))
    axes = spans_m / np.maximum(sides_m, 1e-9)[:, None]
    outward_m, beyond_m2 = (
        each[0]
        for each in beyond_edges((name,), cut, axes[None], sides_m[None], has_metres=has_metres)
    )
    beyond_m2 = beyond_m2 + settings.aside**2 * np.trace(beyond_m2) * np.eye(2)
    own_sigma_m = _own_sigma_m(sides_m, m_per_px, frame, settings)
    usual_sigma_m = settings.height_sigma * height_m * lean
    sighting = Sighting(
        frame.index,
        frame.name,
        frame.time_ns,
        name,
        float(seen.scores[k]),
        seen.boxes_px[k],
        place_m + outward_m,
        own_sigma_m**2 * np.eye(2) + np.outer(usual_sigma_m, usual_sigma_m) + beyond_m2,
        np.sort(sides_m)[::-1],
    )
    own_sigma_m = float(np.hypot(own_sigma_m, np.sqrt(np.trace(beyond_m2) / 2)))
    return LaidSighting(sighting, up_m, lean, own_sigma_m, axes, sides_m, beyond_m2)


def _own_sigma_m(
    sides_m: Floats, m_per_px: float, frame: PlacedFrame, settings: LayingSettings
) -> float:
    side_m = float(sides_m.mean())
    pose_m = frame.residual_px * m_per_px if np.isfinite(frame.residual_px) else 0.0
    if frame.status is Status.GPS_ONLY and np.isfinite(frame.sigma_m):
        pose_m = frame.sigma_m
    parts = [
        settings.least_sigma_m,
        settings.least_sigma_px * m_per_px,
        settings.box_sigma * side_m,
        pose_m,
    ]
    return float(np.sqrt(np.sum(np.square(parts))))


def _cross(box_px: BoxesPx | Floats) -> PointsPx:
    """(5, 2) image points of one box (1, 4): its middle, the middles of its left, right, top and bottom edges."""
    left, top, right, bottom = np.asarray(box_px, np.float64)[0] - 0.5
    x, y = (left + right) / 2, (top + bottom) / 2
    return np.array([[x, y], [left, y], [right, y], [x, top], [x, bottom]])
