"""The heights below a true orthophoto: where its ground lies in the pictures that cameras took of it."""

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np

from sorvolo.geometry.arrays import Bytes, Floats, Floats32, Mask, Matrix3, PointsM, Vector3, frozen
from sorvolo.geometry.camera import Camera
from sorvolo.geometry.homography import apply_homography
from sorvolo.geometry.pose import Pose

_COARSER = 4  # pixels of a raster, either way, for which one line of sight is followed
_HIDES_M = 0.3  # what rises less above a line of sight hides nothing
_STEEP_M, _WALL_M = 1.5, 0.6  # what rises so much within this is no ground that pictures share
_STEPS = 8  # of a ray to the surface
_LONGER = 1.15  # times: each step along a line of sight


@dataclass(frozen=True, eq=False)
class OrthoSurface:
    """The heights that a map is a true orthophoto over: `up_m` (H, W) float32, m above the site's zero, without holes,
    and the affine map (3, 3) from site metres to its columns and rows."""

    up_m: Floats32
    cells_from_site: Matrix3

    def __post_init__(self) -> None:
        object.__setattr__(self, "up_m", frozen(self.up_m))
        object.__setattr__(self, "cells_from_site", frozen(self.cells_from_site))

    @property
    def _cell_m(self) -> float:
        return float(np.abs(np.linalg.det(self.cells_from_site[:2, :2])) ** -0.5)

    @cached_property
    def _steep(self) -> Bytes:
        """(H, W) 1 by walls, eaves and the rims of crowns: heights are off there, and a wall has no place on a map."""
        side = max(1, round(_WALL_M / self._cell_m)) | 1
        window = np.ones((side, side), np.uint8)
        rise_m = cv2.subtract(cv2.dilate(self.up_m, window), cv2.erode(self.up_m, window))
        return (np.asarray(rise_m) >= _STEEP_M).view(np.uint8)

    def under(self, site_from_raster: Matrix3, size: tuple[int, int]) -> Floats32:
        """(h, w) the heights below a raster's pixels; `size` is its width and height."""
        raster_from_cells = np.linalg.inv(self.cells_from_site @ site_from_raster)
        return np.asarray(
            cv2.warpPerspective(
                self.up_m, raster_from_cells, size, borderMode=cv2.BORDER_REPLICATE
            ),
            np.float32,
        )

    def met(self, eye_m: Vector3, rays: PointsM) -> PointsM:
        """(N, 3) where rays (N, 3) from a camera meet the surface; by steps, each to the height below the last one's end,
        so that by walls they may end beside it; NaN beyond it."""
        ends_m = eye_m + rays * ((np.median(self.up_m) - eye_m[2]) / rays[:, 2:])
        for _ in range(_STEPS):
            up_m = self._at(ends_m[None, :, :2])[0]
            ends_m = eye_m + rays * ((up_m - eye_m[2]) / rays[:, 2])[:, None]
        affine = self.cells_from_site
        cells = ends_m[:, :2] @ affine[:2, :2].T + affine[:2, 2]
        inside = ((cells >= 0) & (cells < self.up_m.shape[::-1])).all(axis=1)
        return np.where(inside[:, None], ends_m, np.nan)

    def lay(
        self, site_from_raster: Matrix3, size: tuple[int, int], camera: Camera, pose: Pose
    ) -> tuple[Floats32, Floats32, Mask]:
        """Where the ground of a raster's pixels lies in the picture of a camera without distortion, x and y (h, w), and
        whether the camera sees it there: it is in the picture, no wall, and nothing stands between."""
        turn = pose.rotation.T
        project = camera.matrix @ np.column_stack([turn, -turn @ pose.translation_m])
        level = project[:, [0, 1, 3]] @ site_from_raster
        columns, rows = (np.arange(each, dtype=np.float32) for each in size)
        weight = _form(site_from_raster[2], columns, rows) * self.under(site_from_raster, size)
        x, y, z = (
            _form(line, columns, rows) + np.float32(up) * weight
            for line, up in zip(level, project[:, 2])
        )
        ahead = z * np.sign(site_from_raster[2, 2]) > 1e-6
        with np.errstate(divide="ignore", invalid="ignore"):
            x, y = (np.where(ahead, each / z, np.float32(-1e6)) for each in (x, y))
        inside = (
            (x > -0.5) & (x < camera.width_px - 0.5) & (y > -0.5) & (y < camera.height_px - 0.5)
        )
        raster_from_cells = np.linalg.inv(self.cells_from_site @ site_from_raster)
        steep = cv2.warpPerspective(self._steep, raster_from_cells, size, flags=cv2.INTER_NEAREST)
        hidden = self._hidden(site_from_raster, size, pose.translation_m)
        return x, y, inside & (steep == 0) & ~hidden

    def _hidden(self, site_from_raster: Matrix3, size: tuple[int, int], eye_m: Vector3) -> Mask:
        """(h, w) whether something stands between the ground of a raster's pixels and a camera."""
        coarse = max(2, size[0] // _COARSER), max(2, size[1] // _COARSER)
        ground_m = _grounds(site_from_raster, size, coarse)
        up_m = self._at(ground_m)
        away_m = eye_m[:2] - ground_m
        far_m = np.maximum(np.linalg.norm(away_m, axis=2), 1e-3)
        along, climb = away_m / far_m[..., None], (float(eye_m[2]) - up_m) / far_m
        highest_m = float(self.up_m.max()) - float(up_m.min())
        reach_m = min(highest_m / max(float(climb.min()), 1e-3), float(far_m.max()))
        hidden, step_m = np.zeros(up_m.shape, bool), 2 * self._cell_m
        while step_m < reach_m:
            rises_m = self._at(ground_m + along * step_m) - (up_m + climb * step_m)
            hidden |= (rises_m > _HIDES_M) & (step_m < far_m)
            step_m *= _LONGER
        whole = cv2.resize(hidden.view(np.uint8), size, interpolation=cv2.INTER_NEAREST)
        return np.asarray(whole > 0)

    def _at(self, places_m: PointsM) -> Floats32:
        """(h, w) heights at places (h, w, 2)."""
        affine = self.cells_from_site
        x, y = ((places_m @ row[:2] + row[2]).astype(np.float32) for row in affine[:2])
        up_m = cv2.remap(self.up_m, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(up_m, np.float32)


def _form(line: Floats, columns: Floats32, rows: Floats32) -> Floats32:
    """(h, w) a linear form (3,) of a raster's columns (w,) and rows (h,)."""
    a, b, c = (np.float32(each) for each in line)
    return np.asarray(a * columns[None, :] + (b * rows[:, None] + c), np.float32)


def _grounds(site_from_image: Matrix3, size: tuple[int, int], asked: tuple[int, int]) -> PointsM:
    """(h, w, 2) the ground places of an image's pixels, at `asked` (width, height) places across it."""
    x = (np.arange(asked[0]) + 0.5) * size[0] / asked[0] - 0.5
    y = (np.arange(asked[1]) + 0.5) * size[1] / asked[1] - 0.5
    columns, rows = np.meshgrid(x, y)
    found = apply_homography(site_from_image, np.column_stack([columns.ravel(), rows.ravel()]))
    return np.nan_to_num(found, nan=1e9).reshape(*columns.shape, 2)
