"""The photos of a flight as heights are made from them: where each camera stands and what it is good for."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from sorvolo.errors import GeometryError
from sorvolo.geometry.arrays import (
    Floats,
    Mask,
    PointsM,
    PointsPx,
    Vector3,
    frozen,
)
from sorvolo.geometry.camera import Camera
from sorvolo.geometry.ground import footprint
from sorvolo.geometry.pose import Pose

_SAMPLES = 12  # each way, of a picture


@dataclass(frozen=True, eq=False)
class View:
    """One photo: a camera without distortion, where it stands, and where its GPS fix is (NaN: none), site metres."""

    name: str
    camera: Camera
    site_from_camera: Pose
    fix_m: Vector3

    def __post_init__(self) -> None:
        if self.camera.is_distorted:
            raise GeometryError(f"{self.name}: heights need pictures without distortion")
        object.__setattr__(self, "fix_m", frozen(self.fix_m))

    def smaller(self, share: float) -> "View":
        """The view with its picture made smaller by a share, 32 px wide and high at least."""
        camera = self.camera
        sides = (max(32, round(side * share)) for side in (camera.width_px, camera.height_px))
        return replace(self, camera=camera.resized(*sides))

    def pixels_from_site(self, points_m: PointsM) -> PointsPx:
        """(N, 2) where site points, (N, 3), are seen; NaN behind the camera."""
        return self.camera.pixels_from_points(
            (points_m - self.site_from_camera.translation_m) @ self.site_from_camera.rotation
        )


def outline_m(view: View, up_m: float = 0.0) -> PointsM:
    """(4, 2) the picture's corners on level ground at a height; NaN where a corner looks beyond the horizon."""
    pose = Pose(
        view.site_from_camera.rotation, view.site_from_camera.translation_m - [0.0, 0.0, up_m]
    )
    return footprint(view.camera, pose)


def overlaps(views: list[View]) -> Floats:
    """(N, N) the share of view i's ground that view j sees, on level ground at height 0."""
    shares = np.zeros((len(views), len(views)))
    for i, view in enumerate(views):
        grid = np.linspace(0.02, 0.98, _SAMPLES)
        x, y = np.meshgrid(grid * (view.camera.width_px - 1), grid * (view.camera.height_px - 1))
        rays = (
            view.camera.rays_from_pixels(np.column_stack([x.ravel(), y.ravel()]))
            @ view.site_from_camera.rotation.T
        )
        down = rays[:, 2] < -0.05 * np.linalg.norm(rays, axis=1)
        origin = view.site_from_camera.translation_m
        ground = origin + rays[down] * (-origin[2] / rays[down, 2])[:, None]
        for j, other in enumerate(views):
            if j != i and len(ground):
                shares[i, j] = (
                    inside(other.pixels_from_site(ground), other.camera).sum() / _SAMPLES**2
                )
    return shares


def inside(pixels: PointsPx, camera: Camera) -> Mask:
    """(N,) which points, (N, 2), lie in the picture."""
    with np.errstate(invalid="ignore"):
        low = (pixels >= 0).all(axis=-1)
        return (
            low & (pixels[..., 0] <= camera.width_px - 1) & (pixels[..., 1] <= camera.height_px - 1)
        )


def pixels_wide(view: View, size_m: float) -> int:
    """How wide the view's picture is when a pixel covers `size_m` of ground at height 0; no wider than it is."""
    share = view.site_from_camera.translation_m[2] / view.camera.fx_px / size_m
    # a few sizes for all photos of a flight: steps of an eighth
    return int(
        max(
            32,
            min(
                view.camera.width_px,
                round(view.camera.width_px * 2 ** (round(8 * np.log2(share)) / 8)),
            ),
        )
    )


def ground_outlines_m(views: Sequence[View], up_m: float = 0.0) -> PointsM:
    """(M, 2) the corners of all pictures on level ground at a height; those beyond the horizon are left out.

    A corner counts as far as three times the camera's height from the camera.
    """
    corners = []
    for view in views:
        eye = view.site_from_camera.translation_m
        away = outline_m(view, up_m) - eye[:2]
        away = away[np.isfinite(away).all(axis=1)]
        far = np.linalg.norm(away, axis=1, keepdims=True)
        corners.append(eye[:2] + away * np.minimum(1, 3 * (eye[2] - up_m) / np.maximum(far, 1e-9)))
    return np.concatenate(corners)


def fix_from_residual(site_from_camera: Pose, residual_m: Sequence[float | None]) -> Vector3:
    """(3,) a GPS fix, NaN where unknown, from the camera's place and camera minus fix."""
    return site_from_camera.translation_m - np.array(
        [np.nan if each is None else each for each in residual_m]
    )
