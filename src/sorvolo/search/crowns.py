"""Where trees and bushes show in a frame: by colour, by roughness in the light, and by the shadows that they throw.

Shadows of trees are as dark and as rough, over their mean, as a closed forest; only a forest is wide. So dark ground
counts as trees where it is as wide as a wood, and what stands alone is recognised by its lit side.
"""

from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from sorvolo.geometry.arrays import Floats, ImageRGB, Mask

_Grey = NDArray[np.float32]


@dataclass(frozen=True)
class CrownLengths:
    """Metres on the ground over which crowns are recognised: each by choice, since only what all of them give together
    was measured."""

    leaf_m: float = 0.1  # along a pixel on which leaves show ...
    leaves_m: float = 0.5  # ... and over which their roughness is taken
    around_m: float = 1.25  # over which a wood's roughness is taken
    # over which lightness is taken for shadows: grass in one has lighter spots
    even_m: float = 0.75
    shadows_m: tuple[float, ...] = (
        1.0,
        2.0,
        4.0,
    )  # the widths of shadows that are followed to what throws them
    crown_m: float = 1.5  # the narrowest crown, and over which it must be so
    wood_m: float = 8.0  # the narrowest wood: shadows of single trees are narrower
    gap_m: float = 6.0  # a gap among crowns that is no wider is forest: smooth or dark crowns, and their shade ...
    stand_m: float = 2.5  # ... where the crowns themselves are so wide: shrubs on a lawn and rims of things are none


@dataclass(frozen=True)
class CrownSettings:
    """How crowns are recognised on a small picture."""

    green: float = 0.05  # excess green, (2 g - r - b) / (r + g + b), of plants
    plants: float = 0.6  # share of green ground around a place of plants; by choice
    leaves: float = 0.14  # rms of lightness within `leaves_m` over its mean, or the frame's where lighter: lit crowns
    rough: float = 0.2  # rms of lightness over its mean within `around_m`: woods, shadows too
    dark: float = 0.6  # of the frame's lightness: shadows
    # of a shadow's width: how far from within it, towards the sun, what throws it reaches
    thrown: float = 2.5
    least_grey: float = 8.0  # grey levels: below, a mean is noise; by choice
    lengths: CrownLengths = field(default_factory=CrownLengths)


def plants_in(small: _Grey, m_per_px: float, settings: CrownSettings = CrownSettings()) -> Mask:
    """(H, W) where a small colour picture (H, W, 3) shows plants."""
    green = (2 * small[..., 1] - small[..., 0] - small[..., 2]) / np.maximum(small.sum(axis=2), 1)
    wide = _odd_px(settings.lengths.crown_m, m_per_px)
    return np.asarray(
        cv2.blur((green > settings.green).astype(np.float32), (wide, wide)) > settings.plants, bool
    )


def crowns_in(
    image: ImageRGB,
    small: _Grey,
    image_m_per_px: float,
    m_per_px: float,
    sunward: Floats | None,
    settings: CrownSettings = CrownSettings(),
) -> Mask:
    """(H, W) where crowns show in a frame; `small` (H, W, 3) is its small picture, whose pixel covers `m_per_px`.

    `sunward` (2,) is the direction to the sun in the picture, x before y; None where it is unknown or straight above:
    then crowns that are as smooth as grass go unseen.
    """
    lightness, lengths = small.mean(axis=2), settings.lengths
    usual = max(float(np.median(lightness)), settings.least_grey)
    plants, wide = plants_in(small, m_per_px, settings), _odd_px(lengths.crown_m, m_per_px)
    even = _odd_px(lengths.even_m, m_per_px)
    dark = cv2.blur(lightness, (even, even)) < settings.dark * usual
    leaf_roughness = _leaf_roughness(image, image_m_per_px, usual, lightness.shape, lengths)
    leaves = cv2.blur(leaf_roughness, (wide, wide)) > settings.leaves
    single = _opened(plants & leaves & ~dark, lengths.crown_m, m_per_px)
    if sunward is not None:
        thrower = plants & ~dark & _towards_sun(dark, sunward, m_per_px, settings)
        single |= _opened(thrower, lengths.shadows_m[0], m_per_px)
    around = _odd_px(lengths.around_m, m_per_px)
    mean = cv2.blur(lightness, (around, around))
    roughness = _rms(lightness, around) / np.maximum(mean, settings.least_grey)
    is_rough = cv2.blur(roughness, (wide, wide)) > settings.rough
    wood = _wood(plants & (is_rough | single), lengths, m_per_px) & plants
    return _closed(single | wood, lengths, m_per_px)


def _leaf_roughness(
    image: ImageRGB, m_per_px: float, usual: float, shape: tuple[int, ...], lengths: CrownLengths
) -> _Grey:
    """The roughness of leaves, laid on a small picture of (H, W)."""
    scale = max(1.0, lengths.leaf_m / m_per_px)
    size = max(8, round(image.shape[1] / scale)), max(8, round(image.shape[0] / scale))
    fine = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.float32).mean(
        axis=2
    )
    around = _odd_px(lengths.leaves_m, max(m_per_px, lengths.leaf_m))
    # over the frame's lightness where it is darker there: shadows are rough over their own mean by their rims alone
    rough = _rms(fine, around) / np.maximum(cv2.blur(fine, (around, around)), usual)
    return np.asarray(
        cv2.resize(rough, (shape[1], shape[0]), interpolation=cv2.INTER_AREA), np.float32
    )


def _towards_sun(dark: Mask, sunward: Floats, m_per_px: float, settings: CrownSettings) -> Mask:
    """(H, W) where what throws the shadows may stand: about as wide as they are, on their sunny side."""
    found = np.zeros_like(dark)
    for width_m in settings.lengths.shadows_m:
        reach_px = max(1, round(settings.thrown * width_m / m_per_px))
        line = np.zeros((2 * reach_px + 1, 2 * reach_px + 1), np.uint8)
        end_x, end_y = (round(reach_px - reach_px * float(each)) for each in sunward)
        cv2.line(line, (reach_px, reach_px), (end_x, end_y), 1)
        found |= cv2.dilate(_opened(dark, width_m, m_per_px).astype(np.uint8), line) > 0
    return found


def _wood(rough: Mask, lengths: CrownLengths, m_per_px: float) -> Mask:
    """The wide parts of rough plants, with the narrow gaps in them."""
    spare = round(lengths.wood_m / m_per_px)
    # beyond the picture the forest may go on: what lies at its edge is judged by what the picture shows
    wide = cv2.copyMakeBorder(
        rough.astype(np.uint8), spare, spare, spare, spare, cv2.BORDER_REFLECT
    )
    closed = cv2.morphologyEx(wide, cv2.MORPH_CLOSE, _disc(lengths.stand_m, m_per_px))
    return _opened(closed > 0, lengths.wood_m, m_per_px)[spare:-spare, spare:-spare]


def _closed(crowns: Mask, lengths: CrownLengths, m_per_px: float) -> Mask:
    """The crowns (H, W) with the narrow gaps between them, where they are those of a stand of trees."""
    spare = max(3, round(lengths.gap_m / m_per_px))
    wide = cv2.copyMakeBorder(
        crowns.astype(np.uint8), spare, spare, spare, spare, cv2.BORDER_REFLECT
    )
    stand = _opened(wide > 0, lengths.stand_m, m_per_px).astype(np.uint8)
    closed = cv2.morphologyEx(stand, cv2.MORPH_CLOSE, _disc(lengths.gap_m, m_per_px))
    return np.asarray(crowns | (closed[spare:-spare, spare:-spare] > 0), bool)


def _opened(mask: Mask, width_m: float, m_per_px: float) -> Mask:
    return np.asarray(
        cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, _disc(width_m, m_per_px)) > 0, bool
    )


def _disc(width_m: float, m_per_px: float) -> NDArray[np.uint8]:
    side_px = max(3, round(width_m / m_per_px))
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side_px, side_px)), np.uint8)


def _rms(lightness: _Grey, around_px: int) -> _Grey:
    mean = cv2.blur(lightness, (around_px, around_px))
    return np.sqrt(np.maximum(cv2.blur(lightness**2, (around_px, around_px)) - mean**2, 0))


def _odd_px(width_m: float, m_per_px: float) -> int:
    return max(3, 2 * round(width_m / m_per_px / 2) + 1)
