"""A picture of unknown place, scale and heading found on a large one of the ground, both at a coarse scale."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from sorvolo.geometry.arrays import ImageGray, Mask, Matrix3, PointsPx
from sorvolo.registration.camera_fit import similar
from sorvolo.registration.features import (
    FeatureSettings,
    filled,
    known_only,
    normalise_contrast,
    sift_features,
)
from sorvolo.registration.learned import learned_features, match_learned
from sorvolo.registration.matching import match


@dataclass(frozen=True)
class PlaceSettings:
    """How a picture is searched, and what counts as found."""

    most_scale: float = 40.0  # between the two pictures' pixels
    band_px: float = 6.0  # of pairs that agree: the map's own errors and the ground's relief
    least_pairs: int = 16  # that agree
    least_share: float = 0.08  # of the pairs; chance leaves a hundredth
    turn_deg: float = 30.0  # learned features bear half of it
    step: float = 1.35  # from scale to scale, of which they bear half as well
    least_side_px: int = 64  # of the picture at such a scale: less shows too little
    most_side_px: int = 2800  # more takes minutes and gigabytes (3.6 at 4000)


def find_place(
    picture: tuple[ImageGray, Mask],
    ground: tuple[ImageGray, Mask],
    scales: Sequence[float] = (),
    settings: PlaceSettings = PlaceSettings(),
) -> Matrix3 | None:
    """ground_from_picture (3, 3), a similarity; None where none is sure. Each is a gray image and where it is known.

    SIFT, which knows scale and heading, is asked first; then learned features, turn by turn and at the `scales` (ground
    pixels a picture's pixel) that the picture may have.
    """
    found = _by_sift(picture, ground, settings)
    if found is not None:
        return found
    old = known_only(learned_features(filled(*ground), 6000), ground[1])
    best: tuple[int, Matrix3] | None = None
    # a larger picture would lie beside the ground with more of itself than may disagree
    most_px = min(settings.most_side_px, max(ground[0].shape) / settings.least_share**0.5)
    for turned_from_picture, size in _turns(picture[0].shape, scales, most_px, settings):
        gray = cv2.warpPerspective(
            filled(*picture), turned_from_picture, size, flags=cv2.INTER_AREA
        )
        known = cv2.warpPerspective(picture[1].astype(np.uint8), turned_from_picture, size) > 0
        new = known_only(learned_features(gray, 3000), known)  # type: ignore[arg-type]
        pairs = match_learned(new, old)
        agreed = _agreed(
            new.points_px[pairs[:, 0]], old.points_px[pairs[:, 1]], settings, settings.step**2
        )
        if agreed is not None and (best is None or agreed[1] > best[0]):
            best = agreed[1], agreed[0] @ turned_from_picture
    return None if best is None else best[1]


def _by_sift(
    picture: tuple[ImageGray, Mask], ground: tuple[ImageGray, Mask], settings: PlaceSettings
) -> Matrix3 | None:
    wanted = FeatureSettings(sift_count=4000, detection_side_px=4000)
    new, old = (
        known_only(sift_features(normalise_contrast(filled(*each)), wanted), each[1])
        for each in (picture, ground)
    )
    if min(len(new), len(old)) < settings.least_pairs:
        return None
    pairs = match(new, old, None, 0.0)
    agreed = _agreed(
        new.points_px[pairs[:, 0]], old.points_px[pairs[:, 1]], settings, settings.most_scale
    )
    return None if agreed is None else agreed[0]


def _agreed(
    new_px: PointsPx, old_px: PointsPx, settings: PlaceSettings, most_scale: float
) -> tuple[Matrix3, int] | None:
    """old_from_new that enough of the pairs agree on, and how many do."""
    found = similar(old_px, new_px, settings.band_px, most_scale)
    if found is None:
        return None
    count = int(found[1].sum())
    # pairs that all lie in one spot agree on anything
    spread_px = np.ptp(new_px[found[1]], axis=0).min() if count else 0.0
    if (
        count < max(settings.least_pairs, settings.least_share * len(new_px))
        or spread_px < 4 * settings.band_px
    ):
        return None
    return found[0], count


def _turns(
    shape: tuple[int, ...], scales: Sequence[float], most_px: float, settings: PlaceSettings
) -> Iterator[tuple[Matrix3, tuple[int, int]]]:
    """turned_from_picture and the turned picture's width and height, for each scale and heading of a useful size."""
    height, width = shape[:2]
    corners = np.array([[0, 0], [width, 0], [width, height], [0, height]], float)
    for scale in scales:
        for turn in np.arange(0, 2 * np.pi, np.radians(settings.turn_deg)):
            linear = scale * np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
            ends = corners @ linear.T
            low, high = ends.min(axis=0), ends.max(axis=0)
            matrix = np.eye(3)
            matrix[:2, :2], matrix[:2, 2] = linear, -low
            size = np.ceil(high - low).astype(int)
            if size.min() >= settings.least_side_px and size.max() <= most_px:
                yield matrix, (int(size[0]), int(size[1]))


def scale_steps(low: float, high: float, settings: PlaceSettings = PlaceSettings()) -> list[float]:
    """Scales from `low` to `high` near enough for learned features."""
    count = max(1, int(np.ceil(np.log(high / low) / np.log(settings.step))) + 1)
    return [float(each) for each in np.geomspace(low, high, count)]
