"""What stands on the ground, so that an earlier picture is rendered as a later camera sees it."""

from dataclasses import dataclass

import cv2
import numpy as np

from sorvolo.geometry.arrays import Floats, Floats32, Mask, Matrix3, PointsM, Vector3, frozen
from sorvolo.geometry.homography import apply_homography

# How finely rays are followed to what stands on the ground.
_COARSER = 4  # pixels of a picture, either way, for which one ray is followed
_MOST_STEPS = 60  # of a ray through the surface
_LEAST_M = 0.3  # lower things move by less than the comparison's own reach
_SAME_M = 0.5  # heights that differ by less are the same surface


@dataclass(frozen=True, eq=False)
class ReliefMap:
    """`above_m` (H, W) float32, what stands on the bare ground, m above it (0 where that is not known), and the affine
    map (3, 3) from site metres to its columns and rows.

    Places are those of level ground, as the homographies of pictures have them: a view fits the ground that it shows,
    so what stands there counts by its height above it.
    """

    above_m: Floats32
    cells_from_site: Matrix3

    def __post_init__(self) -> None:
        object.__setattr__(self, "above_m", frozen(self.above_m))
        object.__setattr__(self, "cells_from_site", frozen(self.cells_from_site))

    def meet_m(self, ground_m: PointsM, camera_m: Vector3) -> Floats32:
        """(h, w) how high a camera's rays to ground places, (h, w, 2), first meet what stands there; 0: the ground."""
        highest = min(float(self.above_m.max(initial=0)), 0.5 * float(camera_m[2]))
        found = np.zeros(ground_m.shape[:2], np.float32)
        if highest < _LEAST_M:
            return found
        cell_m = 1 / np.sqrt(abs(np.linalg.det(self.cells_from_site[:2, :2])))
        step_m = max(float(cell_m), highest / _MOST_STEPS)
        for up_m in np.arange(highest, 0, -step_m):
            places_m = _raised(ground_m, camera_m, float(up_m))
            affine = self.cells_from_site
            x, y = ((places_m @ row[:2] + row[2]).astype(np.float32) for row in affine[:2])
            stands = np.asarray(
                cv2.remap(self.above_m, x, y, cv2.INTER_LINEAR, borderValue=0.0), np.float32
            )
            meets = (stands >= up_m) & (found == 0)
            # between this step and the last the ray came to the surface
            found[meets] = np.minimum(stands[meets], up_m + step_m)
        return found

    def find_in_earlier(
        self,
        site_from_image: Matrix3,
        camera_m: Vector3,
        picture_from_site: Matrix3,
        earlier_m: Vector3,
        size: tuple[int, int],
    ) -> tuple[Floats32, Floats32, Mask] | None:
        """Where an image's pixels lie in an earlier picture, x and y (h, w), and whether the earlier camera saw there
        what the later one sees. None where nothing stands: then homographies are enough.

        `site_from_image` and `picture_from_site` hold for level ground; `size` is the image's width and height.
        """
        small = max(2, size[0] // _COARSER), max(2, size[1] // _COARSER)
        coarse_m = _grounds(site_from_image, size, small)
        up_m = self.meet_m(coarse_m, camera_m)
        earlier_ground_m = _lowered(_raised(coarse_m, camera_m, up_m), earlier_m, up_m)
        hidden = self.meet_m(earlier_ground_m, earlier_m) > up_m + _SAME_M
        if not hidden.any() and not up_m.any():
            return None
        fine_up_m = np.asarray(cv2.resize(up_m, size, interpolation=cv2.INTER_LINEAR), np.float32)
        sees = cv2.resize(hidden.view(np.uint8), size, interpolation=cv2.INTER_NEAREST) == 0
        places = _raised(_grounds(site_from_image, size, size), camera_m, fine_up_m)
        places = _lowered(places, earlier_m, fine_up_m)
        at = (
            apply_homography(picture_from_site, places.reshape(-1, 2))
            .reshape(places.shape)
            .astype(np.float32)
        )
        return at[..., 0], at[..., 1], sees


def _grounds(site_from_image: Matrix3, size: tuple[int, int], asked: tuple[int, int]) -> PointsM:
    """(h, w, 2) the ground places of an image's pixels, at `asked` (width, height) places across it."""
    x = (np.arange(asked[0]) + 0.5) * size[0] / asked[0] - 0.5
    y = (np.arange(asked[1]) + 0.5) * size[1] / asked[1] - 0.5
    columns, rows = np.meshgrid(x, y)
    found = apply_homography(site_from_image, np.column_stack([columns.ravel(), rows.ravel()]))
    return np.nan_to_num(found, nan=1e9).reshape(*columns.shape, 2)


def _raised(ground_m: PointsM, camera_m: Vector3, up_m: Floats | Floats32 | float) -> PointsM:
    """(h, w, 2) where the rays to ground places are at a height."""
    share = np.asarray(up_m)[..., None] / camera_m[2]
    return ground_m + (camera_m[:2] - ground_m) * share


def _lowered(places_m: PointsM, camera_m: Vector3, up_m: Floats | Floats32) -> PointsM:
    """(h, w, 2) the ground that a camera sees behind places at heights: `_raised` turned round."""
    share = np.asarray(up_m)[..., None] / camera_m[2]
    return (places_m - camera_m[:2] * share) / np.maximum(1 - share, 0.05)
