"""Section 3.1.1: mosaicking. Each frame against the mosaic's region around the last one.

The baseline: A-KAZE on the frame and on the region, brute-force matching, a similarity by RANSAC. A frame that is
placed never moves. The gains are those of Brown and Lowe (2007), the thesis's [15].
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import cv2
import numpy as np
from scipy.sparse import lil_array
from scipy.sparse.linalg import spsolve

from sorvolo.errors import SettingsError, check_choices
from sorvolo.geometry.arrays import (
    Bytes,
    Descriptors,
    Floats,
    ImageGray,
    ImageRGB,
    Matrix3,
    PointsM,
    PointsPx,
    frozen,
    shrunk,
    square,
)
from sorvolo.geometry.homography import apply_homography, fit_similarity, resized, shifted
from sorvolo.geometry.polygons import polygon_area
from sorvolo.registration.features import gray_from_rgb

_NOISE_LEVELS, _GAIN_SIGMA = 10.0, 0.1  # sigma_N and sigma_g of Brown and Lowe (2007), 4
_SHRINK = 8  # times smaller are the pictures whose overlaps give the gains
# of a frame, the nearest: what a hovering drone sees over and over adds nothing
_MOST_OVERLAPS = 12


SIDE_PX = 1024
"""Longest side of a picture: the thesis stitches at half HD (section 4.1.2)."""

_AKAZE_THRESHOLD = 8e-5  # OpenCV's 1e-3 finds next to nothing on low-contrast ground
_MIN_INLIERS = 12
_ROI_FRAMES = 3.0  # side of the region, in frames ("three times the size of a frame")


@dataclass(frozen=True)
class RoiStitchingSettings:
    """What section 3.1.1 leaves open."""

    # the strongest, in frame and region each: matching costs their product
    max_features: int = 6000
    # homography: the thesis's Figure 3.12a
    transform: Literal["similarity", "homography"] = "similarity"
    ransac_px: float = 3.0  # OpenCV's own for homographies

    def __post_init__(self) -> None:
        check_choices(self)
        if self.max_features < 1:
            raise SettingsError(f"max_features is {self.max_features}; give 1 or more")


@dataclass(frozen=True, eq=False)
class Stitched:
    """A frame that was placed: its pixels to the mosaic's, (3, 3), and how well they fit.

    `residual_px` is the rms of the inliers; the first frame has no matches. `barycentre_px` (2,) is where its
    fix is anchored.
    """

    frame_id: int
    mosaic_from_image: Matrix3
    barycentre_px: Floats
    inliers: int
    residual_px: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "mosaic_from_image", frozen(self.mosaic_from_image))
        object.__setattr__(self, "barycentre_px", frozen(self.barycentre_px))


@dataclass(frozen=True, eq=False)
class _Pasted:
    """A placed frame as the region shows it, and the same small, for its gain."""

    placed: Stitched
    gray: ImageGray
    small: Floats


class RoiStitcher:
    """The thesis's mosaic while it grows. Only `add` changes it.

    The mosaic's frame is the first frame's pixels. The region is put together of the frames themselves, the newest on
    top: blended pixels would lose detail with every frame, and features with it.
    """

    def __init__(self, settings: RoiStitchingSettings = RoiStitchingSettings()) -> None:
        self._settings = settings
        self._pasted: list[_Pasted] = []
        # by frames a and b: pixels that both show (share of a frame), and mean levels in a and in b
        self._overlaps: dict[tuple[int, int], tuple[float, float, float]] = {}
        self._detector: Any = cv2.xfeatures2d.AKAZE_create(  # type: ignore[attr-defined]
            threshold=_AKAZE_THRESHOLD, max_points=settings.max_features
        )

    def add(self, frame_id: int, image: ImageRGB) -> Stitched | str:
        """Place one undistorted frame on top; the first one defines the mosaic's pixels. Why not, in words: it changes nothing."""
        gray = gray_from_rgb(image)
        height, width = gray.shape
        if not self._pasted:
            placed = Stitched(frame_id, np.eye(3), _barycentre(np.eye(3), width, height), 0, 0.0)
        elif isinstance(found := self._register(frame_id, gray, self._pasted[-1].placed), str):
            return found
        else:
            placed = found
        outline = apply_homography(placed.mosaic_from_image, _corners(width, height))
        if reason := _misplaced(outline, width * height):
            return reason
        small = shrunk(gray, (width // _SHRINK, height // _SHRINK)).astype(np.float64)
        new = _Pasted(placed, gray, small)
        reach = float(np.hypot(width, height))
        away = {
            number: float(np.linalg.norm(each.placed.barycentre_px - placed.barycentre_px))
            for number, each in enumerate(self._pasted)
        }
        for number in sorted(away, key=lambda each: away[each])[:_MOST_OVERLAPS]:
            if away[number] < reach:
                self._overlap(self._pasted[number], new)
        self._pasted.append(new)
        return placed

    def gains(self) -> dict[int, float]:
        """The gain of each placed frame, by its id, all overlaps solved together."""
        return solve_gains([each.placed.frame_id for each in self._pasted], self._overlaps)

    def _overlap(self, old: _Pasted, new: _Pasted) -> None:
        height, width = new.small.shape
        mosaic_from_new, mosaic_from_old = (
            each.placed.mosaic_from_image @ resized(_SHRINK, _SHRINK) for each in (new, old)
        )
        under = np.asarray(
            cv2.warpPerspective(
                old.small,
                np.linalg.inv(mosaic_from_new) @ mosaic_from_old,
                (width, height),
                borderMode=cv2.BORDER_CONSTANT,
                borderValue=-1e6,
            )
        )
        both = under >= 0
        if both.any():
            key = old.placed.frame_id, new.placed.frame_id
            self._overlaps[key] = (
                float(both.mean()),
                float(under[both].mean()),
                float(new.small[both].mean()),
            )

    def _register(self, frame_id: int, gray: ImageGray, last: Stitched) -> Stitched | str:
        height, width = gray.shape
        roi, mask, origin = self._roi(last.barycentre_px, width, height)
        in_mosaic = self._features(roi, mask)
        in_frame = self._features(gray, None)
        if min(len(in_mosaic[0]), len(in_frame[0])) < _MIN_INLIERS:
            return f"too few features: {len(in_frame[0])} in the frame, {len(in_mosaic[0])} in the mosaic"
        # "identical patterns", each with one partner: two pictures have none, but mutually nearest ones
        found = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True).match(in_frame[1], in_mosaic[1])
        pairs = np.array([(m.trainIdx, m.queryIdx) for m in found], dtype=np.int64).reshape(-1, 2)
        if len(pairs) < _MIN_INLIERS:
            return f"only {len(pairs)} matches with the mosaic around the last frame"
        mosaic_px, frame_px = in_mosaic[0][pairs[:, 0]] + origin, in_frame[0][pairs[:, 1]]
        # both estimators seed their own generator, so the same points give the same answer
        method, limits = (cv2.RANSAC, self._settings.ransac_px), (5000, 0.999)
        if self._settings.transform == "similarity":
            matrix, kept = cv2.estimateAffinePartial2D(frame_px, mosaic_px, None, *method, *limits)
            matrix = None if matrix is None else np.vstack([matrix, [0.0, 0.0, 1.0]])
        else:
            matrix, kept = cv2.findHomography(frame_px, mosaic_px, *method, None, *limits)
        inliers = np.zeros(0, bool) if matrix is None else kept.ravel().astype(bool)
        if inliers.sum() < _MIN_INLIERS:
            return f"only {int(inliers.sum())} of {len(pairs)} matches agree"
        mosaic_from_image = np.asarray(matrix, np.float64)
        miss = apply_homography(mosaic_from_image, frame_px[inliers]) - mosaic_px[inliers]
        return Stitched(
            frame_id,
            mosaic_from_image,
            _barycentre(mosaic_from_image, width, height),
            int(inliers.sum()),
            float(np.sqrt((miss**2).sum(axis=1).mean())),
        )

    def _roi(self, centre_px: Floats, width: int, height: int) -> tuple[ImageGray, Bytes, Floats]:
        """The mosaic around a point as gray, where it is painted, and its origin in mosaic coordinates."""
        half = _ROI_FRAMES * np.array([width, height]) / 2
        low = np.floor(centre_px - half)
        size: tuple[int, int] = tuple((np.ceil(centre_px + half) - low).astype(int).tolist())
        roi, painted = np.zeros((2, *size[::-1]), np.uint8)
        for each in self._pasted:
            roi_from_image = shifted(*-low) @ each.placed.mosaic_from_image
            outline = apply_homography(roi_from_image, _corners(*each.gray.shape[::-1]))
            if (outline.max(axis=0) <= 0).any() or (outline.min(axis=0) >= size).any():
                continue
            cv2.warpPerspective(
                each.gray, roi_from_image, size, dst=roi, borderMode=cv2.BORDER_TRANSPARENT
            )
            cv2.fillConvexPoly(painted, np.rint(outline).astype(np.int32), 255)
        # a feature on the mosaic's own border describes where it ends, not the ground
        framed = cv2.copyMakeBorder(painted, 1, 1, 1, 1, cv2.BORDER_CONSTANT)
        mask = cv2.erode(framed, square(11))[1:-1, 1:-1]
        return roi, mask, low  # type: ignore[return-value]

    def _features(self, gray: ImageGray, mask: ImageGray | None) -> tuple[PointsPx, Descriptors]:
        keypoints, descriptors = self._detector.detectAndCompute(gray, mask)
        if descriptors is None or not len(keypoints):
            return np.zeros((0, 2)), np.zeros((0, 61), np.uint8)
        return np.array([keypoint.pt for keypoint in keypoints]), descriptors


def _misplaced(outline: PointsPx, frame_px: int) -> str:
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
    return ""


def solve_gains(
    frames: list[int], overlaps: Mapping[tuple[int, int], tuple[float, float, float]]
) -> dict[int, float]:
    """The gain of each frame that makes overlaps alike, with a prior near 1: Brown and Lowe (2007), eq. 29.

    An overlap of frames a and b is its size, the mean level there in a and that in b.
    """
    column = {each: number for number, each in enumerate(frames)}
    normal, right = lil_array((len(frames), len(frames))), np.zeros(len(frames))
    for (a, b), (size, level_a, level_b) in overlaps.items():
        for i, j, own, other in (
            (column[a], column[b], level_a, level_b),
            (column[b], column[a], level_b, level_a),
        ):
            normal[i, i] += size * (2 * own**2 / _NOISE_LEVELS**2 + _GAIN_SIGMA**-2)
            normal[i, j] -= 2 * size * own * other / _NOISE_LEVELS**2
            right[i] += size * _GAIN_SIGMA**-2
    for lonely in np.flatnonzero(right == 0):
        normal[lonely, lonely] = right[lonely] = 1.0
    return dict(zip(frames, np.atleast_1d(spsolve(normal.tocsc(), right)).tolist(), strict=True))


def georeference(barycentres_mosaic_px: PointsPx, fixes_site_m: PointsM) -> Matrix3:
    """site_from_mosaic (3, 3): the least-squares similarity of anchored barycentres, (N, 2) px, onto fixes, (N, 2) m.

    The mosaic's y points down, so it is reflected first. Raises GeometryError for fewer than two different points.
    """
    upright = np.diag([1.0, -1.0, 1.0])
    return fit_similarity(fixes_site_m, apply_homography(upright, barycentres_mosaic_px)) @ upright


def _corners(width: int, height: int) -> PointsPx:
    return np.array(
        [[-0.5, -0.5], [width - 0.5, -0.5], [width - 0.5, height - 0.5], [-0.5, height - 0.5]]
    )


def _barycentre(mosaic_from_image: Matrix3, width: int, height: int) -> Floats:
    """Where the frame's middle lies in the mosaic: for a similarity the barycentre of its outline."""
    return apply_homography(mosaic_from_image, np.array([[(width - 1) / 2, (height - 1) / 2]]))[0]
