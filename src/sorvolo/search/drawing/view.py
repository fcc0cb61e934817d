"""Views and patches: textured plane pieces in space, drawn exactly and without jagged edges into any view.

A view is projective: it takes site points to rays (x, y, 1), and a camera takes rays to pixels, lens
distortion included. A drone's camera, the straight-down orthophoto and the sun (whose picture is the
shadows) are all views.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar, cast

import cv2
import numpy as np
from cv2.typing import MatLike
from numpy.typing import NDArray

from sorvolo.geometry.arrays import Floats, Floats32, ImageRGBA, Matrix3, PointsM, PointsPx, Vector3
from sorvolo.geometry.camera import Camera
from sorvolo.geometry.pose import Pose

_Scalar = TypeVar("_Scalar", np.uint8, np.float32)
# x and y are in one map; an empty array here instead of None makes OpenCV 5 sample garbage
_NO_SECOND_MAP = cast(Floats32, None)

RaysF32 = NDArray[np.float32]
"""(height, width, 2) float32: x and y of every pixel's ray with z = 1."""

Window = tuple[int, int, int, int]
"""x0, y0, x1, y1 in pixels, ends exclusive."""


def ray_grid(camera: Camera) -> RaysF32:
    """The ray through every pixel's centre; computed once a flight, because undoing distortion is slow."""
    x, y = np.meshgrid(np.arange(camera.width_px), np.arange(camera.height_px))
    rays = camera.rays_from_pixels(np.column_stack([x.ravel(), y.ravel()]).astype(np.float64))
    return rays[:, :2].reshape(camera.height_px, camera.width_px, 2).astype(np.float32)


@dataclass(frozen=True, eq=False)
class DrawnView:
    """How the site is seen: `ray_from_site` (3, 4) is projective; `eye_m` (4,) is homogeneous (0 = at
    infinity).

    `rays` is `ray_grid(camera)`, or None for a camera without distortion, where it costs nothing to compute.
    """

    camera: Camera
    ray_from_site: Floats
    eye_m: Floats
    rays: RaysF32 | None

    def project(self, points_m: PointsM) -> PointsPx:
        """(N, 2) pixels of site points, shape (N, 3); NaN behind the camera."""
        points = np.column_stack([points_m, np.ones(len(points_m))])
        return self.camera.pixels_from_points(points @ self.ray_from_site.T)

    def ray_from_plane(self, origin_m: Vector3, u_m: Vector3, v_m: Vector3) -> Matrix3:
        """The homography from plane coordinates (a, b), the point origin + a u + b v, to rays."""
        plane = np.zeros((4, 3))
        plane[:3, 0], plane[:3, 1], plane[:3, 2], plane[3, 2] = u_m, v_m, origin_m, 1.0
        return self.ray_from_site @ plane

    def rays_in(self, window: Window) -> RaysF32:
        """The rays of a window of the image."""
        x0, y0, x1, y1 = window
        if self.rays is not None:
            return self.rays[y0:y1, x0:x1]
        camera = self.camera
        x = (np.arange(x0, x1, dtype=np.float32) - np.float32(camera.cx_px)) / np.float32(
            camera.fx_px
        )
        y = (np.arange(y0, y1, dtype=np.float32) - np.float32(camera.cy_px)) / np.float32(
            camera.fy_px
        )
        return np.dstack(np.meshgrid(x, y))

    def faces(self, corner_m: Vector3, normal_m: Vector3) -> bool:
        """Whether a face with this outward normal turns its front to the eye."""
        return bool(normal_m @ (self.eye_m[:3] - self.eye_m[3] * corner_m) > 0)


def camera_view(camera: Camera, site_from_camera: Pose, rays: RaysF32 | None) -> DrawnView:
    """What a camera sees from this pose; `rays` is its `ray_grid`, or None without distortion."""
    camera_from_site = site_from_camera.inverse()
    matrix = np.column_stack([camera_from_site.rotation, camera_from_site.translation_m])
    return DrawnView(camera, matrix, np.append(site_from_camera.translation_m, 1.0), rays)


def map_view(
    west_m: float,
    north_m: float,
    m_per_px: tuple[float, float],
    size_px: tuple[int, int],
    sun: Vector3 | None = None,
) -> DrawnView:
    """The site seen straight from above on a raster whose outer top-left corner is (west_m, north_m).

    With `sun`, the unit vector towards it, points slide along its light onto the ground: what is seen is
    shadow.
    """
    slide = np.zeros(2) if sun is None else sun[:2] / sun[2]
    matrix = np.array(
        [
            [1.0, 0.0, -slide[0], -west_m],
            [0.0, -1.0, slide[1], north_m],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )
    fx, fy = 1 / m_per_px[0], 1 / m_per_px[1]
    camera = Camera(size_px[0], size_px[1], fx, fy, -0.5, -0.5)
    direction = np.array([0.0, 0.0, 1.0]) if sun is None else sun
    return DrawnView(camera, matrix, np.append(direction, 0.0), None)


@dataclass(frozen=True, eq=False)
class DrawnPatch:
    """A textured piece of a plane: `corners_m` (4, 3) are where the texture's outer corners lie, in its order
    top-left, top-right, bottom-right, bottom-left; `texture` is RGBA with the colours multiplied by alpha.

    `normal` (3,) points out of a closed body, whose back is never seen; zeros for a leaf that has two sides.
    `texture_from_plane` (3, 3) takes plane coordinates (a, b), the point corner 0 + a (corner 1 - corner 0) +
    b (corner 3 - corner 0), to the texture's pixels; moving the patch does not change it.
    """

    corners_m: PointsM
    texture: ImageRGBA
    normal: Vector3
    texture_from_plane: Matrix3

    @classmethod
    def spanned(cls, corners_m: PointsM, texture: ImageRGBA, normal: Vector3) -> "DrawnPatch":
        """The patch of a texture between four corners in one plane; keystoned if no parallelogram."""
        height, width = texture.shape[:2]
        u, v = corners_m[1] - corners_m[0], corners_m[3] - corners_m[0]
        if np.allclose(corners_m[2] - corners_m[0], u + v, atol=1e-9):
            matrix = np.array([[width, 0.0, -0.5], [0.0, height, -0.5], [0.0, 0.0, 1.0]])
        else:
            far = np.linalg.lstsq(np.column_stack([u, v]), corners_m[2] - corners_m[0], rcond=None)[
                0
            ]
            right, bottom = width - 0.5, height - 0.5
            matrix = cv2.getPerspectiveTransform(
                np.array([[0, 0], [1, 0], far, [0, 1]], np.float32),
                np.array(
                    [[-0.5, -0.5], [right, -0.5], [right, bottom], [-0.5, bottom]], np.float32
                ),
            )
        return cls(corners_m, texture, normal, np.asarray(matrix, np.float64))

    def moved(self, turn: Matrix3, shift_m: Vector3) -> "DrawnPatch":
        """The same patch turned about the origin and then shifted."""
        return replace(self, corners_m=self.corners_m @ turn.T + shift_m, normal=turn @ self.normal)


def sample_patches(
    view: DrawnView, patches: Sequence[DrawnPatch]
) -> Iterator[tuple[Window, ImageRGBA]]:
    """The patches in sight as this view sees them, in order: a window of the image and its RGBA there."""
    facing = [
        patch
        for patch in patches
        if not patch.normal.any() or view.faces(patch.corners_m[0], patch.normal)
    ]
    if not facing:
        return
    # one projection for all corners: a picture has hundreds of patches, many of them out of sight
    corners_px = view.project(np.concatenate([patch.corners_m for patch in facing])).reshape(
        -1, 4, 2
    )
    low, high = corners_px.min(axis=1), corners_px.max(axis=1)
    slack = 2 + 0.02 * (high - low)  # distortion bows edges outwards
    size = np.array([view.camera.width_px, view.camera.height_px])
    with np.errstate(invalid="ignore"):
        is_seen = ((high + slack > 0) & (low - slack < size)).all(
            axis=1
        )  # a corner behind the camera is NaN
    starts = np.maximum(np.floor(low[is_seen] - slack[is_seen]), 0).astype(int)
    ends = np.minimum(np.ceil(high[is_seen] + slack[is_seen]).astype(int) + 1, size)
    for index, (x0, y0), (x1, y1) in zip(np.flatnonzero(is_seen), starts.tolist(), ends.tolist()):
        sample = _sample(view, facing[index], (x0, y0, x1, y1))
        if sample is not None:
            yield (x0, y0, x1, y1), sample


def _sample(view: DrawnView, patch: DrawnPatch, window: Window) -> ImageRGBA | None:
    """The patch within a window; None when it is seen edge-on."""
    corners = patch.corners_m
    ray_from_plane = view.ray_from_plane(
        corners[0], corners[1] - corners[0], corners[3] - corners[0]
    )
    if abs(np.linalg.det(ray_from_plane / np.abs(ray_from_plane).max())) < 1e-9:
        return None
    texture_from_ray = patch.texture_from_plane @ np.linalg.inv(ray_from_plane)
    rays = view.rays_in(window)
    where = cv2.perspectiveTransform(np.ascontiguousarray(rays).reshape(-1, 1, 2), texture_from_ray)
    return remapped(patch.texture, where.reshape(*rays.shape), cv2.BORDER_CONSTANT)


def remapped(picture: NDArray[_Scalar], where: MatLike, border: int) -> NDArray[_Scalar]:
    """The picture at `where`, (height, width, 2) float32 x and y, linear; a constant border is zero."""
    sampled = cv2.remap(picture, where, _NO_SECOND_MAP, cv2.INTER_LINEAR, borderMode=border)
    return np.asarray(sampled, picture.dtype)


def blend(image: NDArray[np.uint8], window: Window, sample: ImageRGBA) -> None:
    """Lay a sampled patch over a picture, in place."""
    x0, y0, x1, y1 = window
    below = image[y0:y1, x0:x1]
    alpha = cv2.merge([255 - sample[..., 3]] * 3)
    image[y0:y1, x0:x1] = cv2.add(sample[..., :3], cv2.multiply(below, alpha, scale=1 / 255))


def opaque(rgb: NDArray[np.uint8]) -> ImageRGBA:
    """A texture without holes."""
    return np.dstack([rgb, np.full(rgb.shape[:2], 255, np.uint8)])


def cut_out(rgb: NDArray[np.uint8], alpha: NDArray[np.float32]) -> ImageRGBA:
    """A texture with holes: `alpha` (height, width) from 0 to 1, multiplied into the colours as patches need."""
    alpha = np.clip(alpha, 0, 1)
    return np.dstack([rgb * alpha[..., None], alpha * 255]).round().astype(np.uint8)
