"""Boxes in a picture laid on the ground: where each detected object stands, and how well that is known."""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sorvolo.errors import SettingsError
from sorvolo.geometry.arrays import Floats, PointsM, PointsPx
from sorvolo.geometry.camera import Camera
from sorvolo.survey.flight import CameraPrior
from sorvolo.survey.objects import TYPICAL_SIZE_M, Detections, Sighting
from sorvolo.tracking.cut_boxes import beyond_edges, cut_edges
from sorvolo.tracking.plausible import (
    TOO_SHORT_CUT_PX,
    impossible_size,
    length_log_odds,
    with_log_odds,
)

GroundHeight = Callable[[PointsM], Floats]
"""Heights (N,) of the ground above the site's level plane, m, at east, north (N, 2); NaN where it is not known."""

IMPOSSIBLE_SIZE = "of a size that its class cannot have"
"""The words for what could be placed, and is set aside: it is not what the detector took it for."""


@dataclass(frozen=True)
class LocateSettings:
    """How well the parts of a place are known, and what is too little to call it a place."""

    box_sigma_share: float = 0.08  # of a box's side: how far its middle is off the object's
    least_box_sigma_px: float = 1.0  # however small the box
    height_sigma_share: float = (
        0.35  # of half an object's height: people sit and lie, cars are vans
    )
    ground_sigma_m: float = 0.0  # of the ground's height, beside what is in the camera's own height
    most_sigma_m: float = 50.0  # a place known no better is none
    farthest_m: float = 5000.0  # along the ground
    other_height_m: float = 1.0  # of a class that nothing is known of
    ground_steps: int = 12  # with which a ray's end is searched on a height model ...
    ground_settled_m: float = 0.3  # ... which must move it by no more in the end

    def __post_init__(self) -> None:
        if (
            min(
                self.box_sigma_share,
                self.least_box_sigma_px,
                self.height_sigma_share,
                self.ground_sigma_m,
            )
            < 0
        ):
            raise SettingsError("the sigmas of a place must not be negative")
        if min(self.most_sigma_m, self.farthest_m) <= 0:
            raise SettingsError("most_sigma_m and farthest_m must be positive")


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
    settings: LocateSettings | None = None,
) -> tuple[list[Sighting | None], Counter[str]]:
    """Each detection's place on the ground, None for those without; and why they have none, in words, counted.

    The ray through a box's middle meets the level plane that lies half the object's usual height above the ground.
    The covariance is propagated to first order from the camera's place, attitude (about its own axes) and focal
    length (`focal_sigma`, relative), the box's middle and the object's height. An unknown heading leaves a circle
    about the point below the camera: its radius is then the sigma.
    """
    settings = settings or LocateSettings()
    if not len(found):
        return [], Counter()
    if (why_not := _unplaced(prior)) is not None:
        return [None] * len(found), Counter({why_not: len(found)})
    boxes = found.boxes_px.astype(np.float64)
    sides_px = boxes[:, 2:] - boxes[:, :2]
    rays, slopes = _rays_with_slopes(camera, (boxes[:, :2] + boxes[:, 2:]) / 2 - 0.5)
    heights_m = np.array(
        [
            TYPICAL_SIZE_M[name][2] if name in TYPICAL_SIZE_M else settings.other_height_m
            for name in found.names
        ]
    )
    ends = _ray_ends(rays, prior, heights_m, ground_height_m, settings)
    along = ends.along(prior)
    shared = _shared_covariances(ends, along, rays, prior, focal_sigma, settings)
    per_px = along @ slopes  # (N, 2, 2) metres on the ground per pixel
    own = _own_covariances(ends, per_px, sides_px, heights_m, settings)
    slopes_m = np.linalg.norm(per_px, axis=1)
    sizes_m = slopes_m * sides_px
    axes = per_px.transpose(0, 2, 1) / np.maximum(slopes_m, 1e-9)[:, :, None]
    cut = cut_edges(boxes, camera.width_px, camera.height_px)
    scale_sigmas = _scale_sigma(prior, ends.reach * -ends.rays_site[:, 2], focal_sigma, settings)
    cut_short = cut_edges(boxes, camera.width_px, camera.height_px, TOO_SHORT_CUT_PX)
    is_impossible = impossible_size(found.names, sizes_m, cut_short, scale_sigmas)
    scores = _scores_by_length(
        found, sizes_m.max(axis=1), np.asarray(cut_short.any(axis=1), bool), scale_sigmas
    )
    outward_m, beyond_m2 = beyond_edges(found.names, cut, axes, sizes_m)
    places_m, covariances = ends.places_m + outward_m, shared + (own + beyond_m2)
    sizes_m = np.sort(sizes_m, axis=1)[:, ::-1]
    shared_sigmas = np.sqrt(np.trace(shared, axis1=1, axis2=2) / 2)
    reasons = _reasons(ends, places_m - prior.position_m[:2], covariances, is_impossible, settings)
    sightings = [
        None
        if reason
        else Sighting(
            frame_index,
            frame_name,
            time_ns,
            label,
            scores[row],
            found.boxes_px[row],
            places_m[row],
            covariances[row],
            sizes_m[row],
            float(shared_sigmas[row]),
        )
        for row, (label, reason) in enumerate(zip(found.names, reasons))
    ]
    return sightings, Counter(reason for reason in reasons if reason)


@dataclass(frozen=True, eq=False)
class _RayEnds:
    """Where N rays meet the planes of their objects.

    `rays_site` (N, 3) in site axes, `reach` (N,) their lengths to the plane (1 where they do not meet it), `places_m`
    (N, 2), `away` (N, 2) how far the place moves with each metre that the plane lies lower. `is_downward`, `is_known`
    (the plane's height) and `meets` are (N,).
    """

    rays_site: PointsM
    reach: Floats
    places_m: PointsM
    away: Floats
    is_downward: NDArray[np.bool_]
    is_known: NDArray[np.bool_]
    meets: NDArray[np.bool_]

    @property
    def onto(self) -> Floats:
        """(N, 2, 3) a small step of the ray's end in space, seen along the ray on the plane."""
        flat = np.broadcast_to(np.eye(2), (len(self.reach), 2, 2))
        return np.concatenate([flat, -self.away[:, :, None]], axis=2)

    def along(self, prior: CameraPrior) -> Floats:
        """(N, 2, 3) how the place moves with a change of the ray in the camera's axes."""
        return np.asarray(self.reach[:, None, None] * self.onto @ prior.rotation, np.float64)


def _ray_ends(
    rays: PointsM,
    prior: CameraPrior,
    heights_m: Floats,
    ground_height_m: float | GroundHeight,
    settings: LocateSettings,
) -> _RayEnds:
    rays_site = rays @ prior.rotation.T
    reach, plane_m = _reach(rays_site, prior.position_m, heights_m / 2, ground_height_m, settings)
    is_known, is_downward = np.isfinite(plane_m), rays_site[:, 2] < 0
    meets = is_downward & is_known & (reach > 0)
    reach = np.where(meets, reach, 1.0)
    places_m = prior.position_m[:2] + reach[:, None] * rays_site[:, :2]
    with np.errstate(divide="ignore", invalid="ignore"):
        away = np.where(meets[:, None], rays_site[:, :2] / rays_site[:, 2:], 0.0)
    return _RayEnds(rays_site, reach, places_m, away, is_downward, is_known, meets)


def _shared_covariances(
    ends: _RayEnds,
    along: Floats,
    rays: PointsM,
    prior: CameraPrior,
    focal_sigma: float,
    settings: LocateSettings,
) -> Floats:
    """(N, 2, 2) of the places, by errors that all boxes of the frame share: of camera, focal length and ground."""
    shared = ends.onto @ np.diag(prior.position_sigma_m**2) @ ends.onto.transpose(0, 2, 1)
    shared += _attitude_part(
        along, rays, prior.attitude_sigma_deg, ends.reach[:, None] * ends.rays_site[:, :2]
    )
    focal = along[:, :, :2] @ rays[:, :2, None] * focal_sigma
    shared += focal @ focal.transpose(0, 2, 1)
    shared += (settings.ground_sigma_m**2) * ends.away[:, :, None] @ ends.away[:, None, :]
    return np.asarray(shared, np.float64)


def _own_covariances(
    ends: _RayEnds, per_px: Floats, sides_px: Floats, heights_m: Floats, settings: LocateSettings
) -> Floats:
    """(N, 2, 2) of the places, by errors of each alone: of the box's middle and the object's height."""
    sigma_px = np.maximum(settings.box_sigma_share * sides_px, settings.least_box_sigma_px)
    own = per_px @ (sigma_px[:, :, None] ** 2 * np.eye(2)) @ per_px.transpose(0, 2, 1)
    up_sigma_m = settings.height_sigma_share * heights_m / 2
    own += (up_sigma_m**2)[:, None, None] * ends.away[:, :, None] @ ends.away[:, None, :]
    return np.asarray(own, np.float64)


def _reasons(
    ends: _RayEnds,
    from_camera_m: PointsM,
    covariances: Floats,
    is_impossible: NDArray[np.bool_],
    settings: LocateSettings,
) -> list[str]:
    """Why each has no place, in words; empty for those that have one."""
    sigmas = np.sqrt(np.trace(covariances, axis1=1, axis2=2) / 2)
    checks = (
        (~ends.is_downward, "at or above the horizon"),
        (~ends.is_known, "the height model does not cover the ground there"),
        (~ends.meets, "by the telemetry the camera is not above the ground"),
        (
            np.linalg.norm(from_camera_m, axis=1) > settings.farthest_m,
            f"farther than {settings.farthest_m:g} m",
        ),
        (
            ~(sigmas <= settings.most_sigma_m),
            f"the place is known no better than {settings.most_sigma_m:g} m",
        ),
        (is_impossible, IMPOSSIBLE_SIZE),
    )
    return [
        next((words for fails, words in checks if fails[row]), "") for row in range(len(sigmas))
    ]


def _unplaced(prior: CameraPrior) -> str | None:
    """Why a camera places nothing at all; None where it may."""
    if not prior.knows_place:
        return "no fix for the frame"
    if not np.isfinite(prior.position_sigma_m[2]):
        return "the camera's height is not known"
    if not np.isfinite(prior.attitude_sigma_deg[:2]).all():
        return "the camera's tilt is not known"
    return None


def _scale_sigma(
    prior: CameraPrior, drop_m: Floats, focal_sigma: float, settings: LocateSettings
) -> Floats:
    """(N,) how well lengths on the ground are known, relative; `drop_m` (N,) is how far it lies below the camera."""
    height_sigma_m = np.hypot(prior.position_sigma_m[2], settings.ground_sigma_m)
    return np.asarray(np.hypot(height_sigma_m / np.maximum(drop_m, 1e-6), focal_sigma), np.float64)


def _scores_by_length(
    found: Detections, lengths_m: Floats, is_cut: NDArray[np.bool_], scale_sigmas: Floats
) -> list[float]:
    """The scores with what each length counts; of what the picture's edge cuts as they are."""
    return [
        score if cut else with_log_odds(score, length_log_odds(name, length_m, sigma))
        for name, score, length_m, cut, sigma in zip(
            found.names,
            found.scores.tolist(),
            lengths_m.tolist(),
            is_cut.tolist(),
            scale_sigmas.tolist(),
        )
    ]


def _rays_with_slopes(camera: Camera, middles_px: PointsPx) -> tuple[PointsM, Floats]:
    """(N, 3) camera rays of image points, and (N, 3, 2) how they turn per pixel to the right and down."""
    steps_px = np.array([[0.0, 0.0], [0.5, 0.0], [-0.5, 0.0], [0.0, 0.5], [0.0, -0.5]])
    points_px = (middles_px + steps_px[:, None, :]).reshape(-1, 2)
    rays, right, left, below, above = camera.rays_from_pixels(points_px).reshape(5, -1, 3)
    return rays, np.stack([right - left, below - above], axis=2)


def _reach(
    rays_site: PointsM,
    camera_m: Floats,
    above_ground_m: Floats,
    ground_height_m: float | GroundHeight,
    settings: LocateSettings,
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
        for _ in range(settings.ground_steps):
            reach = (plane_m - camera_m[2]) / rays_site[:, 2]
            places_m = camera_m[:2] + np.nan_to_num(reach)[:, None] * np.nan_to_num(
                rays_site[:, :2]
            )
            higher = ground_height_m(places_m) + above_ground_m
            change = np.abs(higher - plane_m)
            # half steps settle on slopes towards the camera as well, where full ones would swing about
            plane_m = plane_m + 0.5 * (higher - plane_m)
        plane_m = np.where(change <= settings.ground_settled_m, plane_m, np.nan)
        return (plane_m - camera_m[2]) / rays_site[:, 2], plane_m


def _attitude_part(
    along: Floats, rays: PointsM, sigma_deg: Floats, from_nadir_m: PointsM
) -> Floats:
    """(N, 2, 2) what turning the camera about its own axes does on the ground; `along` (N, 2, 3) from camera axes."""
    sigma_rad = np.radians(np.where(np.isfinite(sigma_deg), sigma_deg, 0.0))
    turned = (
        np.cross(np.eye(3)[None, :, :], rays[:, None, :]).transpose(0, 2, 1) * sigma_rad
    )  # columns: about x, y, z
    moved = along @ turned
    part = moved @ moved.transpose(0, 2, 1)
    if not np.isfinite(sigma_deg[2]):
        part = part + (from_nadir_m**2).sum(axis=1)[:, None, None] * np.eye(2)
    return np.asarray(part)
