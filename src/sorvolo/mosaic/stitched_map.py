"""A stitched mosaic on the site: anchored to fixes, cut into tiles, its frames placed."""

from collections.abc import MutableMapping, Sequence

import cv2
import numpy as np

from sorvolo.geometry.arrays import Floats, ImageRGBA, Matrix3, PointsM, PointsPx
from sorvolo.geometry.camera import Camera
from sorvolo.geometry.grid import SiteGrid, TileIndex
from sorvolo.geometry.homography import apply_homography
from sorvolo.mosaic.roi_stitching import Stitched, georeference
from sorvolo.survey.flight import PosedFrame
from sorvolo.survey.mosaic import PlacedFrame, Status

MIRROR_Y: Matrix3 = np.diag([1.0, -1.0, 1.0])
"""site_from_mosaic of a mosaic without fixes: mirrored pixels."""


def site_from_mosaic(anchored: Sequence[tuple[Stitched, PosedFrame]]) -> Matrix3:
    """(3, 3) with each fix anchored to its frame's barycentre. Raises GeometryError for too few of them."""
    barycentres = np.array([each.barycentre_px for each, _ in anchored]).reshape(-1, 2)
    fixes_m = np.array([posed.prior.position_m[:2] for _, posed in anchored]).reshape(-1, 2)
    return georeference(barycentres, fixes_m)


def mosaic_m_per_px(site_from_mosaic: Matrix3) -> float:
    """The ground sampling distance of the mosaic, to three digits: a new map's."""
    return float(f"{float(np.sqrt(abs(np.linalg.det(site_from_mosaic[:2, :2])))):.3g}")


def paint_mosaic(
    rgba: ImageRGBA,
    corner_px: tuple[int, int],
    site_from_mosaic: Matrix3,
    site_grid: SiteGrid,
    tiles: MutableMapping[TileIndex, ImageRGBA],
) -> None:
    """Cut the mosaic, whose first pixel is `corner_px` in mosaic coordinates, into tiles; known ground stays."""
    height, width = rgba.shape[:2]
    x, y = corner_px
    corner = np.array([[1.0, 0.0, x], [0.0, 1.0, y], [0.0, 0.0, 1.0]])
    site_from_rgba = site_from_mosaic @ corner
    middle_m = apply_homography(site_from_rgba, np.array([[width / 2, height / 2]]))[0]
    reach_m = float(
        np.linalg.norm(apply_homography(site_from_rgba, np.zeros((1, 2)))[0] - middle_m)
    )
    grid_from_rgba = site_grid.grid_from_site_affine(middle_m, reach_m) @ site_from_rgba
    outline = apply_homography(
        grid_from_rgba, np.array([[0, 0], [width, 0], [width, height], [0, height]], float)
    )
    side = site_grid.grid.tile_px
    for tile in sorted(site_grid.grid.tiles_touched(outline)):
        x0, y0, _, _ = site_grid.grid.tile_window(tile)
        shift = np.array([[1.0, 0.0, -x0], [0.0, 1.0, -y0], [0.0, 0.0, 1.0]])
        painted: ImageRGBA = cv2.warpPerspective(
            rgba, shift @ grid_from_rgba, (side, side), flags=cv2.INTER_LINEAR
        )  # type: ignore[assignment]
        seen = painted[..., 3] == 255
        known = tiles.get(tile)
        result = np.zeros((side, side, 4), np.uint8) if known is None else known.copy()
        seen &= result[..., 3] == 0  # ground that the map knows stays
        if seen.any():
            result[seen] = painted[seen]
            tiles[tile] = result


class StitchedPlaces:
    """Places a flight's frames by the anchored mosaic, one after another: a frame that was not stitched lies as the one
    before, moved to its own fix. Only `place` changes it.

    `full` is the frames' camera, `small` the undistorted one at the size at which they were stitched. Without
    `has_fixes` the first frame's place is the site's own origin, which no frame departs from.
    """

    def __init__(
        self, full: Camera, small: Camera, site_from_mosaic: Matrix3, *, has_fixes: bool = True
    ) -> None:
        self._camera, self._site_from_mosaic, self._has_fixes = full, site_from_mosaic, has_fixes
        self._corners: PointsPx = (
            full.undistort_points(full.corners_px) if full.is_distorted else full.corners_px
        )
        scale = np.diag([small.width_px / full.width_px, small.height_px / full.height_px, 1.0])
        scale[:2, 2] = 0.5 * np.diag(scale)[:2] - 0.5  # pixel centres stay on pixel centres
        self._small_from_full: Matrix3 = scale
        self._barycentre: Floats = np.array([(small.width_px - 1) / 2, (small.height_px - 1) / 2])
        self._last: Matrix3 | None = None

    def place(
        self,
        posed: PosedFrame,
        stitched: Stitched | None,
        time_ns: int,
        status: Status,
        reason: str,
    ) -> PlacedFrame:
        """The frame's record; the first frame of a flight is always stitched."""
        if stitched is not None:
            self._last = self._site_from_mosaic @ stitched.mosaic_from_image
        assert self._last is not None
        site_from_image = (
            self._last
            if stitched is not None
            else self._moved(self._last, posed.prior.position_m[:2])
        )
        outline_m = apply_homography(site_from_image @ self._small_from_full, self._corners)
        centre_m = apply_homography(site_from_image, self._barycentre[None])[0]
        gps = np.full(3, np.nan)
        if self._has_fixes and posed.prior.knows_place:
            gps[:2] = centre_m - posed.prior.position_m[:2]
        sigma_m = (
            float(np.hypot(*posed.prior.position_sigma_m[:2])) if stitched is None else float("nan")
        )
        return PlacedFrame(
            posed.frame.name,
            posed.frame.index,
            time_ns,
            status,
            reason,
            self._camera,
            None,
            site_from_image @ self._small_from_full,
            outline_m,
            stitched.residual_px if stitched else float("nan"),
            sigma_m,
            gps_residual_m=gps,
        )

    def _moved(self, site_from_image: Matrix3, place_m: PointsM) -> Matrix3:
        """Turned and scaled as the last frame, its barycentre at its own fix."""
        now_m = apply_homography(site_from_image, self._barycentre[None])[0]
        shift = np.eye(3)
        shift[:2, 2] = place_m - now_m
        return shift @ site_from_image
