"""Meshes drawn as a camera in the air sees them: sun and sky, shadows on themselves and on the ground, no GPU.

World frame: x, y level, z up, in metres; the ground is z = 0. Faces are drawn far to near (the painter's algorithm),
which is good enough for bodies of 20 to 200 pixels.
"""

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from sorvolo.geometry.arrays import Floats, PointsPx

_FINE = 2  # sub-pixels a side
_SHIFT = 4  # binary digits of a pixel's fraction in OpenCV's polygons
_GAMMA = 2.2
_LIGHT_MAP_PX_PER_M, _SAME_SURFACE_M = 60.0, 0.05
_DETAIL_M2 = 2e-5  # twice the area of a face whose shadow is not missed
_BOUNCE = 0.22  # of the light that the ground throws back at what faces down


@dataclass(frozen=True, eq=False)
class Mesh:
    """`vertices` (V, 3) m, `faces` (F, 4), `colours` (F, 3) as shares of light thrown back, `is_sheet` (F,).

    A sheet shows both its sides; of all other faces only those that face the camera are drawn.
    """

    vertices: Floats
    faces: NDArray[np.int64]
    colours: Floats
    is_sheet: NDArray[np.bool_]

    @cached_property
    def middles(self) -> Floats:
        """(F, 3) m."""
        return np.asarray(self.vertices[self.faces].mean(1))

    @cached_property
    def spans(self) -> Floats:
        """(F, 3) across each face, as long as twice its area in square metres."""
        corners = self.vertices[self.faces]
        return np.asarray(np.cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1]))

    @cached_property
    def normals(self) -> Floats:
        """(F, 3) of length one."""
        return np.asarray(
            self.spans / np.maximum(np.linalg.norm(self.spans, axis=1, keepdims=True), 1e-12)
        )

    def casting(self, sun: Floats) -> NDArray[np.int64]:
        """The faces that throw the whole shadow: those that face the sun and are no mere detail."""
        return np.nonzero(
            ((self.normals @ sun > 0) | self.is_sheet) & ((self.spans**2).sum(1) > _DETAIL_M2**2)
        )[0]

    def moved(self, shift: Floats) -> "Mesh":
        """The same elsewhere."""
        return Mesh(self.vertices + shift, self.faces, self.colours, self.is_sheet)


@dataclass(frozen=True, eq=False)
class Light:
    """`sun` (3,) points to it, of length one; `sky` is the share of a level surface's light that comes from the sky."""

    sun: Floats
    sky: float


@dataclass(frozen=True, eq=False)
class View:
    """A camera at `eye` (3,) m; rows of `axes` (3, 3) are its right, its down and its forward."""

    eye: Floats
    axes: Floats
    focal_px: float

    def project(self, points: Floats) -> tuple[PointsPx, Floats]:
        """Pixels (N, 2) from the picture's centre, and depths (N,) m."""
        seen = (points - self.eye) @ self.axes.T
        return np.asarray(self.focal_px * seen[:, :2] / seen[:, 2:]), np.asarray(seen[:, 2])


@dataclass(frozen=True, eq=False)
class Sprite:
    """A thing cut out: `rgba` (H, W, 4), the `shade` (H, W) that it throws on the ground, its `box` (4,) px."""

    rgba: NDArray[np.uint8]
    shade: NDArray[np.uint8]
    box: Floats


def joined(*meshes: Mesh) -> Mesh:
    """All as one."""
    starts = np.cumsum([0, *(len(each.vertices) for each in meshes)])
    return Mesh(
        np.concatenate([each.vertices for each in meshes]),
        np.concatenate([each.faces + start for each, start in zip(meshes, starts)]),
        np.concatenate([each.colours for each in meshes]),
        np.concatenate([each.is_sheet for each in meshes]),
    )


def sprite_of(mesh: Mesh, light: Light, view: View, rough: Floats | None = None) -> Sprite:
    """The mesh drawn alone. `rough` (F, 3) is added to the normals, for folds and grain."""
    corners, depths = view.project(mesh.vertices)
    ground = _on_ground(mesh.vertices, light.sun) if light.sky < 1 else mesh.vertices
    shadow, _ = view.project(ground)
    low = np.floor(np.minimum(corners.min(0), shadow.min(0))).astype(int) - 2
    high = np.ceil(np.maximum(corners.max(0), shadow.max(0))).astype(int) + 2
    size = np.maximum(high - low, 4)
    order = _far_to_near(mesh, view, depths)
    colours = (255 * _lit(mesh, light, rough) ** (1 / _GAMMA)).clip(0, 255)
    canvas = np.zeros((size[1] * _FINE, size[0] * _FINE, 4), np.uint8)
    opaque = np.column_stack([colours[order], np.full(len(order), 255.0)])
    _fill(canvas, (corners - low) * _FINE, mesh.faces[order], opaque)
    fine = canvas.astype(np.float32)
    small = cv2.resize(fine, (int(size[0]), int(size[1])), interpolation=cv2.INTER_AREA)
    alpha = small[..., 3:] / 255
    rgba = (
        np.concatenate([small[..., :3] / np.maximum(alpha, 1e-3), 255 * alpha], 2)
        .clip(0, 255)
        .astype(np.uint8)
    )
    shade = _shade(mesh, light, (shadow - low), size)
    rows, columns = np.nonzero(alpha[..., 0] > 0.4)
    box = (
        np.array([columns.min(), rows.min(), columns.max() + 1, rows.max() + 1], float)
        if len(rows)
        else np.zeros(4)
    )
    return Sprite(rgba, shade, box)


def looking(
    tilt: float, height_m: float, at: Floats, px_per_m: float
) -> tuple[View, Floats] | None:
    """A camera `tilt` radians off straight down, and the point of the ground (3,) that it shows at `at`.

    `at` (2,) are tangents from its axis, right and down; None where they look at the sky or nearly so.
    """
    axes = np.array(
        [[0, -1, 0], [-np.cos(tilt), 0, -np.sin(tilt)], [np.sin(tilt), 0, -np.cos(tilt)]]
    )
    ray = at[0] * axes[0] + at[1] * axes[1] + axes[2]
    if ray[2] > -0.38 * np.linalg.norm(ray):
        return None
    ground = ray * (height_m / -ray[2])
    eye = np.array([0, 0, height_m])
    focal_px = px_per_m * float(ground @ axes[2])
    return View(eye, axes, focal_px), np.array([ground[0], ground[1], 0.0])


def _far_to_near(mesh: Mesh, view: View, depths: Floats) -> NDArray[np.int64]:
    """The faces to draw, in that order."""
    faces_us = ((view.eye - mesh.middles) * mesh.normals).sum(1) > 0
    shown = np.nonzero(faces_us | mesh.is_sheet)[0]
    return shown[np.argsort(-depths[mesh.faces[shown]].mean(1), kind="stable")]


def _lit(mesh: Mesh, light: Light, rough: Floats | None) -> Floats:
    """(F, 3) the light that each face throws back: 1 is a white level surface in the open."""
    normals = mesh.normals
    if rough is not None:
        normals = normals + rough
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    from_sky = light.sky * (_BOUNCE + (1 - _BOUNCE) * (0.5 + 0.5 * normals[:, 2]))
    angle = normals @ light.sun
    angle = np.where(mesh.is_sheet, np.abs(angle), angle.clip(0))
    from_sun = (1 - light.sky) * angle / max(float(light.sun[2]), 0.2)
    if light.sky < 1:
        from_sun = from_sun * _in_sun(mesh, light.sun)
    return np.asarray(mesh.colours * (from_sky + from_sun)[:, None])


def _in_sun(mesh: Mesh, sun: Floats) -> NDArray[np.bool_]:
    """(F,) whether nothing of the mesh stands between a face and the sun."""
    across = np.cross(sun, [0.0, 0.0, 1.0] if abs(sun[2]) < 0.9 else [1.0, 0.0, 0.0])
    across /= np.linalg.norm(across)
    flat = mesh.vertices @ np.stack([across, np.cross(sun, across)]).T * _LIGHT_MAP_PX_PER_M
    low = flat.min(0) - 2
    size = np.ceil(flat.max(0) - low).astype(int) + 3
    near = mesh.vertices @ sun
    towards = mesh.casting(sun)
    order = towards[np.argsort(near[mesh.faces[towards]].mean(1), kind="stable")]
    first = np.full((size[1], size[0]), -1, np.int32)
    _fill(first, flat - low, mesh.faces[order], order[:, None].astype(float))
    cell = np.round(
        mesh.vertices[mesh.faces].mean(1)
        @ np.stack([across, np.cross(sun, across)]).T
        * _LIGHT_MAP_PX_PER_M
        - low
    ).astype(int)
    seen = first[cell[:, 1].clip(0, size[1] - 1), cell[:, 0].clip(0, size[0] - 1)]
    depth = mesh.middles @ sun
    return np.asarray((seen < 0) | (depth[seen] <= depth + _SAME_SURFACE_M))


def _on_ground(vertices: Floats, sun: Floats) -> Floats:
    """Where each vertex's shadow falls."""
    return np.asarray(vertices - vertices[:, 2:] / max(float(sun[2]), 0.2) * sun)


def _shade(
    mesh: Mesh, light: Light, corners: PointsPx, size: NDArray[np.int64]
) -> NDArray[np.uint8]:
    """(H, W) 0 to 255: how much of the sun the ground lacks; under a grey sky what lies close to the thing."""
    mask = np.zeros((size[1], size[0]), np.uint8)
    own = mesh.faces[mesh.casting(light.sun) if light.sky < 1 else mesh.middles[:, 2] < 0.35]
    _fill(mask, corners, own, np.full((len(own), 1), 255.0))
    soft = 0.7 if light.sky < 1 else max(1.0, 0.02 * float(size.max()))
    return np.asarray(cv2.GaussianBlur(mask, (0, 0), soft))


def _fill(canvas: NDArray, corners: PointsPx, faces: NDArray[np.int64], colours: Floats) -> None:
    """Draw faces in their order; corners (V, 2) px."""
    quads = np.round((corners - 0.5) * (1 << _SHIFT)).astype(np.int32)[faces]
    for quad, colour in zip(quads, colours.tolist()):
        cv2.fillConvexPoly(canvas, quad, colour, cv2.LINE_8, _SHIFT)
