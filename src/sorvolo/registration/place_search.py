"""A picture found on another of the same ground without telemetry: two photos, or a photo on a large map."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from sorvolo.geometry.arrays import ImageGray, ImageRGB, Mask, Matrix3, PointsPx
from sorvolo.geometry.homography import apply_homography
from sorvolo.registration.camera_fit import similar
from sorvolo.registration.features import (
    FeatureSettings,
    filled,
    gray_from_rgb,
    known_only,
    learned_features,
    match_learned,
    normalise_contrast,
    sift_features,
)
from sorvolo.registration.matching import fit_homography, match
from sorvolo.survey.mosaic import Features

_MOST_SCALE = 40.0  # between the two pictures' pixels
_BAND_PX = 6.0  # of pairs that agree: the map's own errors and the ground's relief
_LEAST_PAIRS = 16  # that agree
_LEAST_SHARE = 0.08  # of the pairs; chance leaves a hundredth
_TURN_DEG = 30.0  # learned features bear half of it
_STEP = 1.35  # from scale to scale, of which they bear half as well
_LEAST_SIDE_PX = 64  # of the picture at such a scale: less shows too little
_MOST_SIDE_PX = 2800  # more takes minutes and gigabytes (3.6 at 4000)


def find_place(
    picture: tuple[ImageGray, Mask],
    ground: tuple[ImageGray, Mask],
    scales: Sequence[float] = (),
) -> Matrix3 | None:
    """ground_from_picture (3, 3), a similarity; None where none is sure. Each is a gray image and where it is known.

    SIFT, which knows scale and heading, is asked first; then learned features, turn by turn and at the `scales` (ground
    pixels a picture's pixel) that the picture may have.
    """
    found = _by_sift(picture, ground)
    if found is not None:
        return found
    old = known_only(learned_features(filled(*ground), 6000), ground[1])
    best: tuple[int, Matrix3] | None = None
    # a larger picture would lie beside the ground with more of itself than may disagree
    most_px = min(_MOST_SIDE_PX, max(ground[0].shape) / _LEAST_SHARE**0.5)
    for turned_from_picture, size in _turns(picture[0].shape, scales, most_px):
        gray = cv2.warpPerspective(
            filled(*picture), turned_from_picture, size, flags=cv2.INTER_AREA
        )
        known = cv2.warpPerspective(picture[1].astype(np.uint8), turned_from_picture, size) > 0
        new = known_only(learned_features(gray, 3000), known)  # type: ignore[arg-type]
        pairs = match_learned(new, old)
        agreed = _agreed(new.points_px[pairs[:, 0]], old.points_px[pairs[:, 1]], _STEP**2)
        if agreed is not None and (best is None or agreed[1] > best[0]):
            best = agreed[1], agreed[0] @ turned_from_picture
    return None if best is None else best[1]


def _by_sift(picture: tuple[ImageGray, Mask], ground: tuple[ImageGray, Mask]) -> Matrix3 | None:
    wanted = FeatureSettings(sift_count=4000, detection_side_px=4000)
    new, old = (
        known_only(sift_features(normalise_contrast(filled(*each)), wanted), each[1])
        for each in (picture, ground)
    )
    if min(len(new), len(old)) < _LEAST_PAIRS:
        return None
    pairs = match(new, old, None, 0.0)
    agreed = _agreed(new.points_px[pairs[:, 0]], old.points_px[pairs[:, 1]], _MOST_SCALE)
    return None if agreed is None else agreed[0]


def _agreed(new_px: PointsPx, old_px: PointsPx, most_scale: float) -> tuple[Matrix3, int] | None:
    """old_from_new that enough of the pairs agree on, and how many do."""
    found = similar(old_px, new_px, _BAND_PX, most_scale)
    if found is None:
        return None
    count = int(found[1].sum())
    # pairs that all lie in one spot agree on anything
    spread_px = np.ptp(new_px[found[1]], axis=0).min() if count else 0.0
    if count < max(_LEAST_PAIRS, _LEAST_SHARE * len(new_px)) or spread_px < 4 * _BAND_PX:
        return None
    return found[0], count


def _turns(
    shape: tuple[int, ...], scales: Sequence[float], most_px: float
) -> Iterator[tuple[Matrix3, tuple[int, int]]]:
    """turned_from_picture and the turned picture's width and height, for each scale and heading of a useful size."""
    height, width = shape[:2]
    corners = np.array([[0, 0], [width, 0], [width, height], [0, height]], float)
    for scale in scales:
        for turn in np.arange(0, 2 * np.pi, np.radians(_TURN_DEG)):
            linear = scale * np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
            ends = corners @ linear.T
            low, high = ends.min(axis=0), ends.max(axis=0)
            matrix = np.eye(3)
            matrix[:2, :2], matrix[:2, 2] = linear, -low
            size = np.ceil(high - low).astype(int)
            if size.min() >= _LEAST_SIDE_PX and size.max() <= most_px:
                yield matrix, (int(size[0]), int(size[1]))


def scale_steps(low: float, high: float) -> list[float]:
    """Scales from `low` to `high` near enough for learned features."""
    count = max(1, int(np.ceil(np.log(high / low) / np.log(_STEP))) + 1)
    return [float(each) for each in np.geomspace(low, high, count)]


_SIDE_PX = 640  # pictures are made so small: the answer needs no sub-pixel match
_LEAST_INLIERS = 12  # pairs: four fix a homography; by choice
_THRESHOLD_PX = 3.0  # between the two places of a pair that agrees, at that size; by choice
_POINTS = 48  # cells a side of the grid that is counted


@dataclass(frozen=True, eq=False)
class SmallView:
    """What is kept of a picture of `size_px` (height, width): its SIFT features at a small size, and (3, 3)
    `small_from_picture`."""

    features: Features
    size_px: tuple[int, int]
    small_from_picture: Matrix3


def small_view(image: ImageRGB) -> SmallView:
    """The features of a picture, RGB."""
    gray = gray_from_rgb(image)
    scale = min(1.0, _SIDE_PX / max(gray.shape))
    if scale < 1:
        gray = np.asarray(cv2.resize(gray, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA))
    shift = (scale - 1) / 2  # pixels are counted from the middle of the first one
    small_from_picture = np.array([[scale, 0, shift], [0, scale, shift], [0, 0, 1]])
    return SmallView(sift_features(gray, FeatureSettings()), image.shape[:2], small_from_picture)


def second_from_first(first: SmallView, second: SmallView) -> Matrix3 | None:
    """The homography from pixels of one picture to those of another by matched features; None where too few match."""
    pairs = match(second.features, first.features, None, 0.0)
    new_px, old_px = second.features.points_px[pairs[:, 0]], first.features.points_px[pairs[:, 1]]
    fit = fit_homography(new_px, old_px, _THRESHOLD_PX)
    if fit is None or fit[1].sum() < _LEAST_INLIERS:
        return None
    return np.asarray(
        np.linalg.inv(second.small_from_picture) @ fit[0] @ first.small_from_picture, np.float64
    )


def shared_view(first: ImageRGB, second: ImageRGB) -> float:
    """The share, 0 to 1, of `first` (RGB) that `second` shows, by matched SIFT features; 0 where nothing matches."""
    found = second_from_first(small_view(first), small_view(second))
    if found is None:
        return 0.0
    height, width = first.shape[:2]
    middles = (
        np.arange(_POINTS) + 0.5
    ) / _POINTS  # of cells: points on the rim itself fall out by a hair
    columns, rows = np.meshgrid(width * middles - 0.5, height * middles - 0.5)
    there = apply_homography(found, np.column_stack([columns.ravel(), rows.ravel()]))
    height, width = second.shape[:2]
    inside = (there >= 0).all(axis=1) & (there[:, 0] <= width - 1) & (there[:, 1] <= height - 1)
    return float(inside.mean())
