"""Where trees and bushes show in a frame: by colour, by roughness in the light, and by the shadows that they throw.

Shadows of trees are as dark and as rough, over their mean, as a closed forest; only a forest is wide. So dark ground
counts as trees where it is as wide as a wood, and what stands alone is recognised by its lit side.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from sorvolo.geometry.arrays import Floats, ImageRGB, Mask

_Grey = NDArray[np.float32]

_LEAF_M, _LEAVES_M = 0.1, 0.5  # along a pixel on which leaves show, and over which their roughness is taken
_AROUND_M = 1.25  # over which a wood's roughness is taken
_EVEN_M = 0.75  # over which lightness is taken for shadows: grass in one has lighter spots
_PLANTS = 0.6  # share of green ground around a place of plants
_SHADOWS_M = (1.0, 2.0, 4.0)  # the widths of shadows that are followed to what throws them
_SPARE = 8  # grey levels: below, a mean is noise


@dataclass(frozen=True)
class CrownSettings:
    """How crowns are recognised on a small picture. Measured by benchmarks/search_crowns.py."""

    green: float = 0.05  # excess green, (2 g - r - b) / (r + g + b), of plants
    leaves: float = 0.14  # rms of lightness within 0.5 m over its mean, or the frame's where lighter: lit crowns
    rough: float = 0.2  # rms of lightness over its mean within 1.25 m: woods, shadows too
    crown_m: float = 1.5  # the narrowest crown, and over which it must be so
    wood_m: float = 8.0  # the narrowest wood: shadows of single trees are narrower
    dark: float = 0.6  # of the frame's lightness: shadows
    thrown: float = 2.5  # of a shadow's width: how far from within it, towards the sun, what throws it reaches
    gap_m: float = 6.0  # a gap among crowns that is no wider is forest: smooth or dark crowns, and their shade ...
    stand_m: float = 2.5  # ... where the crowns themselves are so wide: shrubs on a lawn and rims of things are none


def plants_in(small: _Grey, m_per_px: float, settings: CrownSettings = CrownSettings()) -> Mask:
    """(H, W) where a small colour picture (H, W, 3) shows plants."""
    green = (2 * small[..., 1] - small[..., 0] - small[..., 2]) / np.maximum(small.sum(axis=2), 1)
    wide = _odd_px(settings.crown_m, m_per_px)
    return np.asarray(cv2.blur((green > settings.green).astype(np.float32), (wide, wide)) > _PLANTS, bool)


def crowns_in(
    image: ImageRGB, small: _Grey, image_m_per_px: float, m_per_px: float, sunward: Floats | None,
    settings: CrownSettings = CrownSettings(),
) -> Mask:
    """(H, W) where crowns show in a frame; `small` (H, W, 3) is its small picture, whose pixel covers `m_per_px`.

    `sunward` (2,) is the direction to the sun in the picture, x before y; None where it is unknown or straight above:
    then crowns that are as smooth as grass go unseen.
    """
    lightness = small.mean(axis=2)
    usual = max(float(np.median(lightness)), _SPARE)
    plants, wide = plants_in(small, m_per_px, settings), _odd_px(settings.crown_m, m_per_px)
    even = _odd_px(_EVEN_M, m_per_px)
    dark = cv2.blur(lightness, (even, even)) < settings.dark * usual
    leaves = cv2.blur(_leaf_roughness(image, image_m_per_px, usual, lightness.shape), (wide, wide)) > settings.leaves
    single = _opened(plants & leaves & ~dark, settings.crown_m, m_per_px)
    if sunward is not None:
        thrower = plants & ~dark & _towards_sun(dark, sunward, m_per_px, settings.thrown)
        single |= _opened(thrower, _SHADOWS_M[0], m_per_px)
    around = _odd_px(_AROUND_M, m_per_px)
    mean = cv2.blur(lightness, (around, around))
    is_rough = cv2.blur(_rms(lightness, around) / np.maximum(mean, _SPARE), (wide, wide)) > settings.rough
    wood = _wood(plants & (is_rough | single), settings, m_per_px) & plants
    return _closed(single | wood, settings, m_per_px)


def _leaf_roughness(image: ImageRGB, m_per_px: float, usual: float, shape: tuple[int, ...]) -> _Grey:
    """The roughness of leaves, laid on a small picture of (H, W)."""
    scale = max(1.0, _LEAF_M / m_per_px)
    size = max(8, round(image.shape[1] / scale)), max(8, round(image.shape[0] / scale))
    fine = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.float32).mean(axis=2)
    around = _odd_px(_LEAVES_M, max(m_per_px, _LEAF_M))
    # over the frame's lightness where it is darker there: shadows are rough over their own mean by their rims alone
    rough = _rms(fine, around) / np.maximum(cv2.blur(fine, (around, around)), usual)
    return np.asarray(cv2.resize(rough, (shape[1], shape[0]), interpolation=cv2.INTER_AREA), np.float32)


def _towards_sun(dark: Mask, sunward: Floats, m_per_px: float, thrown: float) -> Mask:
    """(H, W) where what throws the shadows may stand: about as wide as they are, on their sunny side."""
    found = np.zeros_like(dark)
    for width_m in _SHADOWS_M:
        reach_px = max(1, round(thrown * width_m / m_per_px))
        line = np.zeros((2 * reach_px + 1, 2 * reach_px + 1), np.uint8)
        end_x, end_y = (round(reach_px - reach_px * float(each)) for each in sunward)
        cv2.line(line, (reach_px, reach_px), (end_x, end_y), 1)
        found |= cv2.dilate(_opened(dark, width_m, m_per_px).astype(np.uint8), line) > 0
    return found


def _wood(rough: Mask, settings: CrownSettings, m_per_px: float) -> Mask:
    """The wide parts of rough plants, with the narrow gaps in them."""
    spare = round(settings.wood_m / m_per_px)
    # beyond the picture the forest may go on: what lies at its edge is judged by what the picture shows
    wide = cv2.copyMakeBorder(rough.astype(np.uint8), spare, spare, spare, spare, cv2.BORDER_REFLECT)
    closed = cv2.morphologyEx(wide, cv2.MORPH_CLOSE, _disc(settings.stand_m, m_per_px))
    return _opened(closed > 0, settings.wood_m, m_per_px)[spare:-spare, spare:-spare]


def _closed(crowns: Mask, settings: CrownSettings, m_per_px: float) -> Mask:
    """The crowns (H, W) with the narrow gaps between them, where they are those of a stand of trees."""
    spare = max(3, round(settings.gap_m / m_per_px))
    wide = cv2.copyMakeBorder(crowns.astype(np.uint8), spare, spare, spare, spare, cv2.BORDER_REFLECT)
    stand = _opened(wide > 0, settings.stand_m, m_per_px).astype(np.uint8)
    closed = cv2.morphologyEx(stand, cv2.MORPH_CLOSE, _disc(settings.gap_m, m_per_px))
    return np.asarray(crowns | (closed[spare:-spare, spare:-spare] > 0), bool)


def _opened(mask: Mask, width_m: float, m_per_px: float) -> Mask:
    return np.asarray(cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, _disc(width_m, m_per_px)) > 0, bool)


def _disc(width_m: float, m_per_px: float) -> NDArray[np.uint8]:
    side_px = max(3, round(width_m / m_per_px))
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side_px, side_px)), np.uint8)


def _rms(lightness: _Grey, around_px: int) -> _Grey:
    mean = cv2.blur(lightness, (around_px, around_px))
    return np.sqrt(np.maximum(cv2.blur(lightness**2, (around_px, around_px)) - mean**2, 0))


def _odd_px(width_m: float, m_per_px: float) -> int:
    return max(3, 2 * round(width_m / m_per_px / 2) + 1)
