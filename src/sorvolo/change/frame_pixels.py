"""A flight's frames in two sizes: as they were taken, and as large as they are compared with the map."""

import cv2
import numpy as np
from cv2.typing import MatLike

from sorvolo.geometry.arrays import Boxes, ImageGray, Mask, Matrix3, PointsM, Vector3
from sorvolo.geometry.camera import Camera
from sorvolo.geometry.homography import apply_homography, pose_from_homography
from sorvolo.geometry.level_ground import footprint
from sorvolo.geometry.pose import Pose
from sorvolo.survey.findings import ComparedView
from sorvolo.survey.flight import PosedFrame
from sorvolo.survey.mosaic import PlacedFrame, Status

_LEAST_SIDE_PX = 480  # longer side of a frame, however coarse the map; by choice
_NO_PLACE_M: Vector3 = np.full(3, np.nan)


class FramePixels:
    """The pixels of frames as taken (`full`, with the lens's distortion) and as compared (`small`, without)."""

    def __init__(self, full: Camera, small: Camera) -> None:
        self.full, self.small = full, small
        self._maps: tuple[MatLike, MatLike] | None = None
        sx, sy = small.width_px / full.width_px, small.height_px / full.height_px
        self.small_from_full: Matrix3 = np.array(
            [[sx, 0, (sx - 1) / 2], [0, sy, (sy - 1) / 2], [0, 0, 1.0]]
        )
        """(3, 3) from undistorted pixels of the full size."""

    def outline_m(self, site_from_image: Matrix3) -> PointsM:
        """(4, 2) the frame's corners on the ground, site metres."""
        return apply_homography(site_from_image, self.full.undistort_points(self.full.corners_px))

    def ground_m(self, posed: PosedFrame, site_from_image: Matrix3 | None) -> PointsM | None:
        """(4, 2) the frame's corners on the ground: as it fits the map, else by telemetry; None where neither gives
        all four."""
        if site_from_image is not None:
            outline_m = self.outline_m(site_from_image)
        elif posed.prior.knows_place:
            outline_m = footprint(self.full, Pose(posed.prior.rotation, posed.prior.position_m))
        else:
            return None
        return outline_m if np.isfinite(outline_m).all() else None

    def pose(self, site_from_image: Matrix3 | None) -> Pose | None:
        """The camera over level ground that sees a frame there, by undistorted pixels of the full size; None where it
        lies nowhere or no camera sees it so."""
        return (
            None
            if site_from_image is None
            else pose_from_homography(site_from_image, self.full.undistorted())
        )

    def masks(self, view: ComparedView) -> tuple[ImageGray, Mask]:
        """The change mask and the valid mask in the frame's own pixels, with the lens's distortion."""
        if self._maps is None:
            x, y = np.meshgrid(np.arange(self.full.width_px), np.arange(self.full.height_px))
            ideal = self.full.undistort_points(
                np.column_stack([x.ravel(), y.ravel()]).astype(float)
            )
            small = (
                apply_homography(self.small_from_full, ideal)
                .astype(np.float32)
                .reshape(*x.shape, 2)
            )
            self._maps = cv2.convertMaps(
                small[..., 0], small[..., 1], cv2.CV_16SC2, nninterpolation=True
            )
        x_map, y_map = self._maps
        changed = np.asarray(cv2.remap(view.changed, x_map, y_map, cv2.INTER_NEAREST), np.uint8)
        valid = cv2.remap(view.valid.view(np.uint8), x_map, y_map, cv2.INTER_NEAREST)
        return changed, np.asarray(valid > 0)

    def boxes(self, view: ComparedView) -> Boxes:
        """The view's boxes in the frame's own pixels."""
        result = []
        full_from_small = np.linalg.inv(self.small_from_full)
        for x, y, width, height in view.boxes:
            around = (
                np.array(
                    [
                        [x, y],
                        [x + width / 2, y],
                        [x + width, y],
                        [x + width, y + height / 2],
                        [x + width, y + height],
                        [x + width / 2, y + height],
                        [x, y + height],
                        [x, y + height / 2],
                    ],
                    float,
                )
                - 0.5
            )
            ideal = apply_homography(full_from_small, around)
            corners = self.full.pixels_from_points(self.full.undistorted().rays_from_pixels(ideal))
            limit = [self.full.width_px - 1, self.full.height_px - 1]
            low = np.clip(np.floor(corners.min(axis=0) + 0.5), 0, limit).astype(int)
            high = np.clip(np.ceil(corners.max(axis=0) + 0.5), low + 1, np.array(limit) + 1).astype(
                int
            )
            result.append([*low, *(high - low)])
        return np.array(result, np.int64).reshape(-1, 4)

    def placed(
        self,
        posed: PosedFrame,
        time_ns: int,
        site_from_image: Matrix3 | None,
        reason: str,
        residual_px: float,
        map_sigma_m: float,
    ) -> PlacedFrame:
        """The frame's record: where it fits the map, by pixels of the full size, or rejected with the reason."""
        frame = posed.frame
        if site_from_image is None:
            return PlacedFrame.rejected(
                frame.index, frame.name, time_ns, reason, self.full, residual_px
            )
        pose = self.pose(site_from_image)
        outline_m = self.outline_m(site_from_image)
        if pose is None or not np.isfinite(outline_m).all():
            return PlacedFrame.rejected(
                frame.index, frame.name, time_ns, "the camera looks at the horizon", self.full
            )
        gps_m = (
            pose.translation_m - posed.prior.position_m if posed.prior.knows_place else _NO_PLACE_M
        )
        m_per_px = pose.translation_m[2] / self.full.fx_px
        return PlacedFrame(
            frame.name,
            frame.index,
            time_ns,
            Status.VISION,
            "",
            self.full,
            pose,
            site_from_image,
            outline_m,
            residual_px,
            float(np.hypot(map_sigma_m, residual_px * m_per_px)),
            gps_residual_m=gps_m,
        )


def comparison_camera(
    full: Camera, height_m: float, map_m_per_px: float, side_px: int, finer: float = 1.0
) -> Camera:
    """The camera at the size at which its frames are compared: no longer than `side_px`, and at most `finer` times as
    fine as the frame and as the map.

    `height_m` is the flight's usual height above the ground, NaN where it is not known. Pictures are looked at in half
    of their size: with `finer` 2 nothing that both show is lost.
    """
    side = max(full.width_px, full.height_px)
    share = min(finer, side_px / side)
    if height_m > 1.0:
        share = min(share, max(finer * height_m / full.fx_px / map_m_per_px, _LEAST_SIDE_PX / side))
    return (
        full.resized(round(full.width_px * share), round(full.height_px * share))
        if share != 1
        else full
    )
