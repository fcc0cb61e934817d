"""How far the thing of a region reaches: with what of it differs little, without the soft shadow that it throws."""

from dataclasses import dataclass, field
from functools import cached_property
from math import ceil, floor

import cv2
import numpy as np

from sorvolo.change.pair.regions import Image, Regions
from sorvolo.change.pair.shade import ShadeSettings, shade_between
from sorvolo.geometry.arrays import ImageGray, Mask
from sorvolo.kernels import held_parts
from sorvolo.survey.findings import Shade

Window = tuple[slice, slice]


@dataclass(frozen=True)
class ExtentSettings:
    """How far a thing reaches from where it differs most (0007). Lengths in px of the half size pictures."""

    reach_px: int = 20  # around a region and half of its length more: the ground that is looked at
    least_levels: float = (
        5.0  # grey levels: what differs less is no part of the thing, nor what differs by less ...
    )
    of_top: float = 0.07  # ... than this part of the region's largest difference, or ...
    of_quiet: float = 2.0  # ... so many times as much as 90 % of the quiet ground
    step: float = 1.4  # factor from limit to limit, up to ...
    highest: float = (
        0.7  # ... this part of the largest difference; what passes it is the thing for sure
    )
    convexity: float = 0.8  # part of its hull that a thing fills
    beside: float = 0.5  # of the limit, that three quarters of what lies beside a thing do not pass: light fades slowly
    shade_of_top: float = (
        0.35  # of the largest difference: what differs less and is darker is the thing's shadow
    )
    shade: ShadeSettings = field(
        default_factory=lambda: ShadeSettings(no_brighter=1.0, alike=0.1)
    )  # 0024
    blurred: float = (
        0.2  # of the largest difference within 5 px: what differs less is a thing's blurred rim
    )


@dataclass(frozen=True, eq=False)
class Views:
    """Two pictures (h, w, 3) uint8 BGR of half size as regions were found in them, both in the light of `after`."""

    lit: Image
    after: Image
    limits: ShadeSettings

    @cached_property
    def shade(self) -> ImageGray:
        """The pair's shade mask (h, w), bits of `Shade`, of both pictures blurred as differences are: made once."""
        lit, after = (
            np.asarray(cv2.blur(each, (3, 3)), np.uint8) for each in (self.lit, self.after)
        )
        return shade_between(lit, after, self.limits)


@dataclass(frozen=True, eq=False)
class Piece:
    """A thing's pixels: `mask` is a part of the picture, whose place is `window`."""

    window: Window
    mask: Mask

    @cached_property
    def box(self) -> tuple[int, int, int, int]:
        """x, y, width, height in the picture."""
        x, y, wide, high = cv2.boundingRect(self.mask.view(np.uint8))
        return x + self.window[1].start, y + self.window[0].start, wide, high


def grown(
    regions: Regions, region: int, came: bool, views: Views, settings: ExtentSettings
) -> Piece | None:
    """The thing that `region` (0 .. N - 1) is a part of; None where it does not stand out from what is around.

    Its difference stands out of that of the quiet ground near: at the lowest limit at which it is one nearly convex
    piece with a sharp rim. Its own soft shadow, in the picture that shows it (the query where it `came`), is left out.
    """
    window = _window(regions, region, settings.reach_px)
    strength, labels = regions.strength[window], regions.labels[window]
    core = labels == region + 1
    quiet = cv2.dilate((labels > 0).view(np.uint8), np.ones((7, 7), np.uint8)) == 0
    if not quiet.any():
        return None
    top = int(strength[core].max())
    surely = np.uint8(255) * (core & (strength >= ceil(settings.highest * top)))
    darker = (views.shade[window] & np.uint8(Shade.LATER if came else Shade.EARLIER)) > 0
    shadow = darker & (strength < ceil(settings.shade_of_top * top)) & ~core
    bare = strength * ~shadow
    limit = max(
        settings.least_levels,
        settings.of_top * top,
        settings.of_quiet * _quantile(bare, quiet, 0.9),
    )
    while limit < settings.highest * top:
        over = cv2.threshold(bare, floor(limit), 255, cv2.THRESH_BINARY)[1]
        above = np.asarray(
            cv2.morphologyEx(over, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8)), np.uint8
        )
        thing = held_parts(above | surely, surely)
        if _is_thing(thing, bare, limit, settings):
            largest_near = cv2.dilate(strength, np.ones((5, 5), np.uint8))
            is_sharp = strength > np.floor(settings.blurred * np.asarray(largest_near, np.float32))
            return Piece(window, (thing > 0) & (is_sharp | (surely > 0)))
        limit *= settings.step
    return None


def with_weak_ground(regions: Regions, region: int, reach_px: int) -> Piece:
    """`region` (0 .. N - 1) with the ground around it that differs weakly, less a rim of blur.

    Weak ground may join many regions, and run on along a cloud's edge. Each pixel of it belongs to the nearest
    region, and to none that is farther away than things are looked for.
    """
    window = _window(regions, region, reach_px)
    weak, core = regions.weak[window], np.uint8(255) * (regions.labels[window] == region + 1)
    # two blurs of 3 px reach two pixels out
    weak = np.asarray(cv2.erode(held_parts(weak | core, core), np.ones((5, 5), np.uint8)), np.uint8)
    return Piece(window, ((weak > 0) & (regions.nearest[window] == region + 1)) | (core > 0))


def _is_thing(mask: Image, strength: Image, limit: float, settings: ExtentSettings) -> bool:
    """Whether a piece is nearly convex, and a few pixels off it the difference is gone: light fades away slowly."""
    outlines, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    if cv2.countNonZero(mask) < settings.convexity * cv2.contourArea(
        cv2.convexHull(np.concatenate(outlines))
    ):
        return False
    inner, outer = (cv2.dilate(mask, np.ones((px, px), np.uint8)) for px in (5, 9))
    beside = np.asarray(outer > inner)
    return not beside.any() or _quantile(strength, beside, 0.75) <= settings.beside * limit


def _window(regions: Regions, region: int, reach_px: int) -> Window:
    x, y, wide, high = (int(each) for each in regions.boxes[region])
    margin = reach_px + max(wide, high) // 2
    height, width = regions.labels.shape
    return np.s_[
        max(0, y - margin) : min(height, y + high + margin),
        max(0, x - margin) : min(width, x + wide + margin),
    ]


def _quantile(values: Image, where: Mask, share: float) -> int:
    """A quantile of uint8 values (h, w) somewhere, in one pixel at least, without the care that np.quantile takes."""
    counts = cv2.calcHist([values], [0], where.view(np.uint8), [256], [0, 256])
    sums = np.asarray(counts).ravel().astype(np.int64).cumsum()
    return int(np.searchsorted(sums, share * sums[-1]))
