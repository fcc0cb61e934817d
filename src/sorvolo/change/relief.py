"""The heights below a true orthophoto: where its ground lies in the pictures that cameras took of it."""

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np

from sorvolo.geometry.arrays import Bytes, Floats32, Mask, Matrix3, PointsM, Vector3, frozen, square
from sorvolo.geometry.camera import Camera
from sorvolo.geometry.ground import hidden, laid_pixels
from sorvolo.geometry.homography import apply_homography
from sorvolo.geometry.pose import Pose

_COARSER = 4  # pixels of a raster, either way, for which one line of sight is followed
_HIDES_M = 0.3  # what rises less above a line of sight hides nothing
_STEEP_M, _WALL_M = 1.5, 0.6  # what rises so much within this is no ground that pictures share
_STEPS = 8  # of a ray to the surface


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
        window = square(side)
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
            cells = apply_homography(self.cells_from_site, ends_m[:, :2])
            up_m = self._at(*cells.astype(np.float32).T[:, None])[0]
            ends_m = eye_m + rays * ((up_m - eye_m[2]) / rays[:, 2])[:, None]
        cells = apply_homography(self.cells_from_site, ends_m[:, :2])
        inside = ((cells >= 0) & (cells < self.up_m.shape[::-1])).all(axis=1)
        return np.where(np.asarray(inside)[:, None], ends_m, np.nan)

    def lay(
        self, site_from_raster: Matrix3, size: tuple[int, int], camera: Camera, pose: Pose
    ) -> tuple[Floats32, Floats32, Mask]:
        """Where the ground of a raster's pixels lies in the picture of a camera without distortion, x and y (h, w), and
        whether the camera sees it there: it is in the picture, no wall, and nothing stands between."""
        x, y = laid_pixels(camera, pose, site_from_raster, self.under(site_from_raster, size))
        inside = (
            (x > -0.5) & (x < camera.width_px - 0.5) & (y > -0.5) & (y < camera.height_px - 0.5)
        )
        raster_from_cells = np.linalg.inv(self.cells_from_site @ site_from_raster)
        steep = cv2.warpPerspective(self._steep, raster_from_cells, size, flags=cv2.INTER_NEAREST)
        hidden = self._hidden(site_from_raster, size, pose.translation_m)
        return x, y, inside & (steep == 0) & ~hidden

    def _hidden(self, site_from_raster: Matrix3, size: tuple[int, int], eye_m: Vector3) -> Mask:
        """(h, w) whether something stands between the ground of a raster's pixels and a camera."""
        places = [
            (np.arange(count) + 0.5) * side / count - 0.5
            for side in size
            for count in [max(2, side // _COARSER)]
        ]
        columns, rows = np.meshgrid(*places)
        cells_from_raster = self.cells_from_site @ site_from_raster
        cells = apply_homography(
            cells_from_raster, np.column_stack([columns.ravel(), rows.ravel()])
        )
        x, y = np.nan_to_num(cells, nan=1e9).astype(np.float32).T.reshape(2, *columns.shape)
        eye = np.append(apply_homography(self.cells_from_site, eye_m[None, :2])[0], eye_m[2])
        found = hidden(self.up_m, x, y, self._at(x, y), eye, _HIDES_M)
        whole = cv2.resize(found.view(np.uint8), size, interpolation=cv2.INTER_NEAREST)
        return whole > 0

    def _at(self, x: Floats32, y: Floats32) -> Floats32:
        """(h, w) heights at columns and rows."""
        up_m = cv2.remap(self.up_m, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(up_m, np.float32)
