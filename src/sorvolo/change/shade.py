"""The shade mask of a view, made once: where one date shows ground no brighter than the other, all colours alike."""

from math import ceil

import cv2
import numpy as np
from cv2.typing import MatLike

from sorvolo.change.light import fit_light, relit
from sorvolo.geometry.arrays import ImageGray, ImageRGB, Mask, shrunk
from sorvolo.survey.findings import Shade

_ONE = 128  # of parts in a byte


_BLACK = 8.0  # grey levels: below it a camera shows noise, not light
_DARK = 0.8  # part; clearly darker, a shadow's core


# What is as dark as a shadow. Parts are of the light on the other date; black is lifted first.
_NO_BRIGHTER = 1.08  # part; a shadow's rim, and what is as dark as a shadow, keep so much at most
_ALIKE = (
    0.22  # from the part of one colour to that of another: a shadow takes about the same of each
)


def shade_of_view(reference: ImageRGB, image: ImageRGB, valid: Mask) -> ImageGray:
    """The shade mask (h, w), bits of `Shade`, of a view `image` beside the map's picture `reference`, (h, w, 3) each.

    The map's picture is brought to the view's light first; 0 where not `valid` (h, w).
    """
    before, after = (
        np.asarray(cv2.cvtColor(each, cv2.COLOR_RGB2BGR), np.uint8) for each in (reference, image)
    )
    half = before.shape[1] // 2, before.shape[0] // 2
    known = (
        None
        if valid.all()
        else cv2.resize(valid.view(np.uint8), half, interpolation=cv2.INTER_NEAREST) > 0
    )
    small_before, small_after = (shrunk(each, half) for each in (before, after))
    shade = shade_between(relit(before, fit_light(small_before, small_after, known)), after)
    return np.asarray(cv2.copyTo(shade, valid.view(np.uint8)), np.uint8)


def shade_between(
    before: ImageRGB, after: ImageRGB, no_brighter: float = _NO_BRIGHTER, alike: float = _ALIKE
) -> ImageGray:
    """The shade mask (h, w), bits of `Shade`, of two pictures (h, w, 3) uint8 in the same light."""
    one, other = (cv2.convertScaleAbs(each, alpha=1.0, beta=_BLACK) for each in (before, after))
    shade = np.zeros(before.shape[:2], np.uint8)
    for lighter, darker, bit, dark_bit in (
        (one, other, Shade.LATER, Shade.LATER_DARK),
        (other, one, Shade.EARLIER, Shade.EARLIER_DARK),
    ):
        most, spread = _parts(lighter, darker)
        even = _below(spread, alike * _ONE, 255)
        for limit, marks in ((no_brighter, bit), (_DARK, dark_bit)):
            cv2.bitwise_or(
                shade, cv2.bitwise_and(even, _below(most, limit * _ONE, int(marks))), dst=shade
            )
    return shade


def _below(values: MatLike, limit: float, marks: int) -> MatLike:
    """(h, w) uint8 `marks` where whole values are less than a limit, else 0."""
    return cv2.threshold(values, ceil(limit) - 1, marks, cv2.THRESH_BINARY_INV)[1]


def _parts(lighter: MatLike, darker: MatLike) -> tuple[ImageGray, ImageGray]:
    """What part of the light of one picture another has in the colour that keeps most, and less in the one that keeps
    least: (h, w) each, `_ONE` is all of it; from 255 on they are cut off."""
    parts = cv2.split(cv2.divide(darker, lighter, scale=_ONE))
    most, least = (
        cv2.max(cv2.max(parts[0], parts[1]), parts[2]),
        cv2.min(cv2.min(parts[0], parts[1]), parts[2]),
    )
    return np.asarray(most, np.uint8), np.asarray(cv2.subtract(most, least), np.uint8)
