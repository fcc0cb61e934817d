"""Section 3.1.1: mosaicking. Each frame against the mosaic's region around the last one.

Kept faithful as the baseline for ever: A-KAZE on the frame and on the region, brute-force matching, a
similarity by RANSAC, gain compensation and multi-band blending into one growing picture. What is written is
never moved again.
"""

from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from sorvolo.errors import GeometryError, SettingsError
from sorvolo.geometry.arrays import (
    Descriptors,
    Floats,
    ImageGray,
    ImageRGB,
    ImageRGBA,
    Matrix3,
    PointsM,
    PointsPx,
    frozen,
)
from sorvolo.geometry.homography import apply_homography, fit_similarity
from sorvolo.geometry.polygons import polygon_area
from sorvolo.mosaic.blending import fill_invalid
from sorvolo.registration.features import gray_from_rgb

_CHUNK_PX = 1024  # by which the picture grows: fewer copies for some empty ground

MosaicOffset: TypeAlias = tuple[int, int]
"""Mosaic coordinates (x, y) of the picture's pixel (0, 0); the mosaic frame is the first frame's pixels."""


@dataclass(frozen=True)
class RoiStitchingSettings:
    """The choices of section 3.1.1, and those that it leaves open."""

    side_px: int = 1024  # longest side of a picture: the thesis stitches at half HD (section 4.1.2)
    akaze_threshold: float = 8e-5  # OpenCV's 1e-3 finds next to nothing on low-contrast ground
    max_features: int = (
        6000  # the strongest, in frame and region each: matching costs their product
    )
    matching: Literal["cross-check", "ratio"] = (
        "cross-check"  # both read "only identical patterns match"
    )
    ratio: float = 0.8  # Lowe's (2004)
    transform: Literal["similarity", "homography"] = (
        "similarity"  # homography: the thesis's Figure 3.12a
    )
    ransac_px: float = 3.0  # OpenCV's own for homographies
    min_inliers: int = 12
    roi_frames: float = 3.0  # side of the region, in frames ("three times the size of a frame")
    bands: int = 5  # OpenCV's own of its blender
    largest_px: int = 300_000_000  # of the whole picture: beyond, a frame was surely misplaced

    def __post_init__(self) -> None:
        for name, fits, needed in (
            ("side_px", 256 <= self.side_px <= 8192, "256 to 8192"),
            ("akaze_threshold", self.akaze_threshold > 0, "a positive number"),
            ("max_features", self.max_features >= 1, "at least 1"),
            ("matching", self.matching in ("cross-check", "ratio"), "cross-check or ratio"),
            ("ratio", 0 < self.ratio <= 1, "more than 0, at most 1"),
            (
                "transform",
                self.transform in ("similarity", "homography"),
                "similarity or homography",
            ),
            ("ransac_px", self.ransac_px > 0, "a positive number"),
            ("min_inliers", self.min_inliers >= 4, "at least 4"),
            ("roi_frames", self.roi_frames >= 1, "at least 1"),
            ("bands", 1 <= self.bands <= 10, "1 to 10"),
        ):
            if not fits:
                raise SettingsError(
                    f"method thesis: {name} is {getattr(self, name)!r}; give {needed}"
                )


@dataclass(frozen=True, eq=False)
class Stitched:
    """A frame that was placed: its pixels to the mosaic's, (3, 3), and how well they fit.

    `residual_px` is the rms of the inliers; the first frame has no matches. `barycentre_px` (2,) is where its
    fix is anchored.
    """

    frame_id: int
    mosaic_from_image: Matrix3
    barycentre_px: Floats
    matches: int
    inliers: int
    residual_px: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "mosaic_from_image", frozen(self.mosaic_from_image))
        object.__setattr__(self, "barycentre_px", frozen(self.barycentre_px))


@dataclass(frozen=True)
class NotStitched:
    """A frame that was not placed, and why, in words. The region stays where it was."""

    frame_id: int
    reason: str


class RoiStitcher:
    """The thesis's mosaic while it grows. Only `add` changes it."""

    def __init__(self, settings: RoiStitchingSettings = RoiStitchingSettings()) -> None:
        self._settings = settings
        self._picture: ImageRGBA = np.zeros((0, 0, 4), np.uint8)
        self._offset: MosaicOffset = (0, 0)
        self._last: Stitched | None = None
        self._detector: Any = cv2.xfeatures2d.AKAZE_create(  # type: ignore[attr-defined]
            threshold=settings.akaze_threshold, max_points=settings.max_features
        )

    def add(self, frame_id: int, image: ImageRGB) -> Stitched | NotStitched:
        """Place one undistorted frame and blend it in; the first frame defines the mosaic's pixels."""
        height, width = image.shape[:2]
        if self._last is None:
            placed = Stitched(frame_id, np.eye(3), _barycentre(np.eye(3), width, height), 0, 0, 0.0)
        else:
            found = self._register(frame_id, image, self._last)
            if isinstance(found, NotStitched):
                return found
            placed = found
        outline = apply_homography(placed.mosaic_from_image, _corners(width, height))
        if reason := self._misplaced(outline, width * height):
            return NotStitched(frame_id, reason)
        self._grow(outline)
        self._blend(image, placed.mosaic_from_image, outline)
        self._last = placed
        return placed

    def mosaic(self) -> tuple[ImageRGBA, MosaicOffset]:
        """The picture, cut to what is painted (0 x 0 before the first frame), and where it lies."""
        x, y, width, height = cv2.boundingRect(np.ascontiguousarray(self._picture[..., 3]))
        offset = self._offset[0] + x, self._offset[1] + y
        return self._picture[y : y + height, x : x + width].copy(), offset

    def _register(self, frame_id: int, image: ImageRGB, last: Stitched) -> Stitched | NotStitched:
        height, width = image.shape[:2]
        roi, mask, origin = self._roi(last.barycentre_px, width, height)
        in_mosaic = self._features(roi, mask)
        in_frame = self._features(gray_from_rgb(image), None)
        if min(len(in_mosaic[0]), len(in_frame[0])) < self._settings.min_inliers:
            return NotStitched(
                frame_id,
                f"too few features: {len(in_frame[0])} in the frame, {len(in_mosaic[0])} in the mosaic",
            )
        # (N, 2) indices of mosaic and frame features that match, each at most once.
        mosaic = in_mosaic[1]
        frame = in_frame[1]
        if self._settings.matching == "cross-check":
            found = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True).match(frame, mosaic)
        else:
            nearest = cv2.BFMatcher(cv2.NORM_HAMMING).knnMatch(frame, mosaic, k=2)
            best: dict[int, cv2.DMatch] = {}
            for pair in nearest:
                if len(pair) == 2 and pair[0].distance < self._settings.ratio * pair[1].distance:
                    rival = best.get(pair[0].trainIdx)
                    if rival is None or pair[0].distance < rival.distance:
                        best[pair[0].trainIdx] = pair[0]
            found = list(best.values())
        pairs = np.array([(m.trainIdx, m.queryIdx) for m in found], dtype=np.int64).reshape(-1, 2)
        if len(pairs) < self._settings.min_inliers:
            return NotStitched(
                frame_id, f"only {len(pairs)} matches with the mosaic around the last frame"
            )
        mosaic_px, frame_px = in_mosaic[0][pairs[:, 0]] + origin, in_frame[0][pairs[:, 1]]
        mosaic_from_image, inliers = self._fit(mosaic_px, frame_px)
        if mosaic_from_image is None or inliers.sum() < self._settings.min_inliers:
            return NotStitched(frame_id, f"only {int(inliers.sum())} of {len(pairs)} matches agree")
        miss = apply_homography(mosaic_from_image, frame_px[inliers]) - mosaic_px[inliers]
        return Stitched(
            frame_id,
            mosaic_from_image,
            _barycentre(mosaic_from_image, width, height),
            len(pairs),
            int(inliers.sum()),
            float(np.sqrt((miss**2).sum(axis=1).mean())),
        )

    def _roi(
        self, centre_px: Floats, width: int, height: int
    ) -> tuple[ImageGray, NDArray[np.uint8], Floats]:
        """The mosaic around a point as gray, where it is painted, and its origin in mosaic coordinates."""
        half = self._settings.roi_frames * np.array([width, height]) / 2
        limit = np.array(self._picture.shape[1::-1])
        x0, y0 = np.clip(np.floor(centre_px - half) - self._offset, 0, limit).astype(int)
        x1, y1 = np.clip(np.ceil(centre_px + half) - self._offset, 0, limit).astype(int)
        part = self._picture[y0:y1, x0:x1]
        painted = cv2.copyMakeBorder(
            np.ascontiguousarray(part[..., 3]), 1, 1, 1, 1, cv2.BORDER_CONSTANT
        )
        # a feature on the mosaic's own border describes where it ends, not the ground
        mask = cv2.erode(painted, np.ones((11, 11), np.uint8))[1:-1, 1:-1]
        gray = gray_from_rgb(np.ascontiguousarray(part[..., :3]))
        return gray, mask, np.array([x0, y0], dtype=np.float64) + self._offset  # type: ignore[return-value]

    def _features(self, gray: ImageGray, mask: ImageGray | None) -> tuple[PointsPx, Descriptors]:
        keypoints, descriptors = self._detector.detectAndCompute(gray, mask)
        if descriptors is None or not len(keypoints):
            return np.zeros((0, 2)), np.zeros((0, 61), np.uint8)
        return np.array([keypoint.pt for keypoint in keypoints]), descriptors

    def _fit(
        self, mosaic_px: PointsPx, frame_px: PointsPx
    ) -> tuple[Matrix3 | None, NDArray[np.bool_]]:
        # both estimators seed their own generator, so the same points give the same answer
        if self._settings.transform == "similarity":
            affine, inliers = cv2.estimateAffinePartial2D(
                frame_px,
                mosaic_px,
                method=cv2.RANSAC,
                ransacReprojThreshold=self._settings.ransac_px,
                maxIters=5000,
                confidence=0.999,
            )
            matrix = None if affine is None else np.vstack([affine, [0.0, 0.0, 1.0]])
        else:
            matrix, inliers = cv2.findHomography(
                frame_px,
                mosaic_px,
                cv2.RANSAC,
                self._settings.ransac_px,
                maxIters=5000,
                confidence=0.999,
            )
        if matrix is None or inliers is None:
            return None, np.zeros(len(frame_px), dtype=bool)
        return matrix, inliers.ravel().astype(bool)

    def _misplaced(self, outline: PointsPx, frame_px: int) -> str:
        """Why an outline cannot be a frame's, in words; empty when it can."""
        if not np.isfinite(outline).all():
            return "its corners fall beyond the horizon"
        edges = np.roll(outline, -1, axis=0) - outline
        following = np.roll(edges, -1, axis=0)
        turns = edges[:, 0] * following[:, 1] - edges[:, 1] * following[:, 0]
        area_px = polygon_area([outline])
        if not (turns > 0).all():
            return "its outline would be folded"
        if not 0.1 * frame_px <= area_px <= 10 * frame_px:
            return f"it would be {np.sqrt(area_px / frame_px):.2f} times the first frame's size"
        low, high = self._extent(outline)
        if np.prod((high - low).astype(float)) > self._settings.largest_px:
            return f"the mosaic would grow to {high[0] - low[0]}x{high[1] - low[1]} pixels"
        return ""

    def _extent(self, outline: PointsPx) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """The picture's corners in mosaic coordinates once it holds an outline: it grows by whole chunks."""
        low = np.floor(outline.min(axis=0) / _CHUNK_PX).astype(np.int64) * _CHUNK_PX
        high = (np.floor(outline.max(axis=0) / _CHUNK_PX).astype(np.int64) + 1) * _CHUNK_PX
        if self._picture.size:
            size = np.array(self._picture.shape[1::-1])
            low, high = np.minimum(low, self._offset), np.maximum(high, size + self._offset)
        return low, high

    def _grow(self, outline: PointsPx) -> None:
        low, high = self._extent(outline)
        width, height = (high - low).tolist()
        if (height, width) == self._picture.shape[:2]:
            return
        wider = np.zeros((height, width, 4), np.uint8)
        if self._picture.size:
            x, y = (np.array(self._offset) - low).tolist()
            wider[y : y + self._picture.shape[0], x : x + self._picture.shape[1]] = self._picture
        self._picture, self._offset = wider, (int(low[0]), int(low[1]))

    def _blend(self, image: ImageRGB, mosaic_from_image: Matrix3, outline: PointsPx) -> None:
        """Put the frame on top, its gain matched to what it overlaps, its border blended in several bands."""
        apron = 1 << (self._settings.bands + 1)
        limit = np.array(self._picture.shape[1::-1])
        x0, y0 = (
            np.clip(np.floor(outline.min(axis=0)) - apron - self._offset, 0, limit)
            .astype(int)
            .tolist()
        )
        x1, y1 = (
            np.clip(np.ceil(outline.max(axis=0)) + apron - self._offset, 0, limit)
            .astype(int)
            .tolist()
        )
        part = self._picture[y0:y1, x0:x1]
        size = (x1 - x0, y1 - y0)
        move = np.array([[1.0, 0, -x0 - self._offset[0]], [0, 1, -y0 - self._offset[1]], [0, 0, 1]])
        part_from_image = move @ mosaic_from_image
        warped = cv2.warpPerspective(
            image, part_from_image, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT
        )
        full = np.full(image.shape[:2], 255, np.uint8)
        mask = np.asarray(
            cv2.warpPerspective(full, part_from_image, size, flags=cv2.INTER_NEAREST), np.uint8
        )
        painted = np.ascontiguousarray(part[..., 3])
        known = np.ascontiguousarray(part[..., :3])
        shared = (mask > 0) & (painted > 0)
        if shared.any():
            gain = np.clip(known[shared].mean() / max(1.0, warped[shared].mean()), 0.5, 2.0)
            warped = cv2.convertScaleAbs(warped, alpha=float(gain))
        if not painted.any():
            picture, both = warped, mask
        else:
            blender = cv2.detail_MultiBandBlender(0, self._settings.bands)  # type: ignore[attr-defined]
            blender.prepare((0, 0, *size))
            beneath = fill_invalid(known, painted > 0)
            blender.feed(
                beneath.astype(np.int16), cv2.bitwise_and(painted, cv2.bitwise_not(mask)), (0, 0)
            )
            blender.feed(warped.astype(np.int16), mask, (0, 0))
            blended, both = blender.blend(None, None)
            picture = np.clip(blended, 0, 255).astype(np.uint8)
        part[..., :3][both > 0] = picture[both > 0]
        part[..., 3] |= mask


def georeference(
    barycentres_mosaic_px: PointsPx, fixes_site_m: PointsM, *, robust: bool = False
) -> Matrix3:
    """site_from_mosaic (3, 3): the least-squares similarity of anchored barycentres, (N, 2) px, onto fixes,
    (N, 2) m.

    The mosaic's y points down, so it is reflected first. `robust` drops, twice, pairs off by more than three
    times the median; the thesis takes every fix as it is. Raises GeometryError for fewer than two different
    points.
    """
    barycentres = np.asarray(barycentres_mosaic_px, dtype=np.float64)
    fixes_m = np.asarray(fixes_site_m, dtype=np.float64)
    if barycentres.shape != fixes_m.shape or barycentres.shape[1:] != (2,):
        raise GeometryError(
            f"barycentres {barycentres.shape} and fixes {fixes_m.shape} must both be (N, 2)"
        )
    upright = barycentres * [1.0, -1.0]
    keep = np.ones(len(upright), dtype=bool)
    site_from_upright = fit_similarity(fixes_m, upright)
    for _ in range(2 if robust else 0):
        miss_m = np.linalg.norm(apply_homography(site_from_upright, upright) - fixes_m, axis=1)
        keep = miss_m <= 3 * np.median(miss_m[keep]) + 1e-9
        site_from_upright = fit_similarity(fixes_m[keep], upright[keep])
    return site_from_upright @ np.diag([1.0, -1.0, 1.0])


def _corners(width: int, height: int) -> PointsPx:
    return np.array(
        [[-0.5, -0.5], [width - 0.5, -0.5], [width - 0.5, height - 0.5], [-0.5, height - 0.5]]
    )


def _barycentre(mosaic_from_image: Matrix3, width: int, height: int) -> Floats:
    """Where the frame's middle lies in the mosaic: for a similarity the barycentre of its outline."""
    return apply_homography(mosaic_from_image, np.array([[(width - 1) / 2, (height - 1) / 2]]))[0]
