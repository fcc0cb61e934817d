"""A flight's frames laid out small: the whole map in one picture, before it is painted."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from sorvolo.geometry.arrays import ImageGray, ImageRGB, Mask, Matrix3
from sorvolo.geometry.homography import apply_homography
from sorvolo.registration.features import gray_from_rgb


@dataclass(frozen=True, eq=False)
class Overview:
    """A gray picture of the map, x east and y south, and where it shows ground; `site_from_image` (3, 3)."""

    gray: ImageGray
    known: Mask
    site_from_image: Matrix3

    @property
    def unit_per_px(self) -> float:
        """Site metres that a pixel covers (units of its own, for a flight without metres)."""
        return float(self.site_from_image[0, 0])


def lay_out(frames: Sequence[tuple[ImageRGB, Matrix3]], side_px: int) -> Overview | None:
    """Frames (small pictures with their site_from_image) over each other, the later on top, within `side_px`; None
    where none lies on the ground."""
    outlines = [
        apply_homography(site_from_image, _corners(image)) for image, site_from_image in frames
    ]
    flat = [each for each in outlines if np.isfinite(each).all()]
    if not flat:
        return None
    every = np.concatenate(flat)
    low, high = every.min(axis=0), every.max(axis=0)
    unit = float((high - low).max() / side_px)
    width, height = (max(16, int(np.ceil(each / unit))) for each in high - low)
    site_from_image = np.array([[unit, 0.0, low[0]], [0.0, -unit, high[1]], [0.0, 0.0, 1.0]])
    gray, known = np.zeros((height, width), np.uint8), np.zeros((height, width), bool)
    for (image, site_from_frame), outline in zip(frames, outlines, strict=True):
        if not np.isfinite(outline).all():
            continue
        matrix = np.linalg.inv(site_from_image) @ site_from_frame
        seen = (
            cv2.warpPerspective(np.full(image.shape[:2], 255, np.uint8), matrix, (width, height))
            == 255
        )
        laid = cv2.warpPerspective(
            gray_from_rgb(image), matrix, (width, height), flags=cv2.INTER_AREA
        )
        gray[seen], known[seen] = laid[seen], True
    return Overview(gray, known, site_from_image)


def _corners(image: ImageRGB) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    height, width = image.shape[:2]
    return np.array([[0.0, 0.0], [width - 1, 0.0], [width - 1, height - 1], [0.0, height - 1]])
