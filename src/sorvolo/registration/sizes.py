"""Pictures made smaller by the mean of what each pixel then covers."""

import cv2
import numpy as np

from sorvolo.geometry.arrays import ImageRGB


def at_size(image: ImageRGB, width_px: int, height_px: int) -> ImageRGB:
    """The picture, (H, W, 3), at this size; the very same where it has it."""
    if image.shape[1::-1] == (width_px, height_px):
        return image
    return np.asarray(
        cv2.resize(image, (width_px, height_px), interpolation=cv2.INTER_AREA), np.uint8
    )


def at_most(image: ImageRGB, longest_px: int) -> ImageRGB:
    """The picture, (H, W, 3), with a longer side of this many pixels at most."""
    height_px, width_px = image.shape[:2]
    longest = max(height_px, width_px)
    if longest <= longest_px:
        return image
    return at_size(
        image, *(max(1, round(side * longest_px / longest)) for side in (width_px, height_px))
    )
