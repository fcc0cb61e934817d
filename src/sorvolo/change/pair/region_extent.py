"""How far the thing of a region reaches: with what of it differs little, without the halo that light left around it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from math import ceil, floor

import cv2
import numpy as np

from sorvolo.change.pair.illumination import Light, light_around, relit_parts
from sorvolo.change.pair.regions import Image, Regions, RegionSettings
from sorvolo.geometry.arrays import Mask
from sorvolo.kernels import darker_alike, differences, held_parts

REACH_PX = 20  # around a region and half of its length more: the ground that is looked at
APART_PX = 7  # windows around regions of any kind are no quiet ground
STANDS_OUT = 0.5  # of a region's largest difference: what passes it is the thing, not a halo of light
LEAST_TAKEN, MOST_LEFT = 0.05, 0.5  # share of a region; share of its difference
LEAST_LIMIT, LIMIT_OF_TOP = 5.0, 0.07  # grey levels; of a region's largest difference
QUIET_QUANTILE, QUIET_FACTOR = 0.9, 2.0  # of the quiet ground's differences
BLUR_PX, BLUR_OF_NEAR = 5, 0.2  # of the largest difference within: less is a thing's blurred rim
STEP, HIGHEST = 1.4, 0.7  # from limit to limit, up to this part of the largest difference
LEAST_CONVEXITY = 0.8
BESIDE_PX, BESIDE_QUANTILE, MOST_BESIDE = (5, 9), 0.75, 0.5  # between these widths around a piece; of the limit
SHADE_OF_TOP, SHADE_SPREAD = 0.35, 0.1  # weaker, and of colours taken alike: a thing's shadow

_BLURRED = np.floor(BLUR_OF_NEAR * np.arange(256)).astype(np.uint8)
Window = tuple[slice, slice]


@dataclass(frozen=True, eq=False)
class Views:
    """Two pictures (h, w, 3) uint8 BGR of half size as regions were found in them.

    `before` is in its own light, `lit` is the same in that of `after`. They were compared where `known` (h, w), None
    everywhere, with `settings`.
    """

    before: Image
    after: Image
    lit: Image
    known: Mask | None
    settings: RegionSettings


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


def without_halos(regions: Regions, chosen: Mask, views: Views, light: Light) -> tuple[Regions, Views]:
    """The `strength` and the `lit` picture anew around `chosen` regions (N,), in a light that knows where things are.

    Where ground has no structure the light is taken from afar, lest a thing be taken for light; at a cloud's rim that
    leaves a halo of false difference. Once a region is known to be a change, what stands out in it is its thing and the
    plain ground beside it tells the light. If that explains the rest of a region only to a part, the rest is a weaker
    part of the thing, and everything stays as it was; nowhere do the pictures differ more than before.
    """
    numbers = [int(each) for each in np.flatnonzero(chosen)]
    things = _standing_out(regions, numbers)
    around = light_around(light, things)
    if around is light:
        return regions, views
    windows = {region: _window(regions, region) for region in numbers}
    place = _around_all(list(windows.values()))
    parts = list(windows.values()) if sum(map(_area, windows.values())) < _area(place) else [place]
    wide = [_widened(each, place, views.settings.reach_px + 2) for each in parts]  # two blurs and the search look there
    lit, anew = relit_parts(views.before, around, wide), np.empty_like(regions.strength)
    for part, within in zip(parts, wide, strict=True):
        anew[part] = _strength(lit, views, within)[_moved(part, within)]
    strength, known_lit = regions.strength.copy(), views.lit.copy()
    clear = cv2.dilate(things, np.ones((5, 5), np.uint8)) == 0
    for region, window in windows.items():
        if _is_weaker_part(regions, region, window, clear, anew):
            continue
        strength[window] = cv2.min(anew[window], strength[window])
        known_lit[window] = lit[window]
    return replace(regions, strength=strength), replace(views, lit=known_lit)


def _standing_out(regions: Regions, numbers: Sequence[int]) -> Image:
    """(h, w) 255 where something stands out in one of these regions."""
    things = np.zeros(regions.labels.shape, np.uint8)
    for region in numbers:
        x, y, wide, high = regions.boxes[region]
        window = np.s_[y : y + high, x : x + wide]
        values = np.where(regions.labels[window] == region + 1, regions.strength[window], 0)
        things[window][values >= max(STANDS_OUT * values.max(), 1)] = 255
    return things


def _around_all(windows: Sequence[Window]) -> Window:
    """The window around all of several."""
    rows, columns = ([each[axis] for each in windows] for axis in (0, 1))
    return (
        slice(min(each.start for each in rows), max(each.stop for each in rows)),
        slice(min(each.start for each in columns), max(each.stop for each in columns)),
    )


def _is_weaker_part(regions: Regions, region: int, window: Window, clear: Mask, anew: Image) -> bool:
    """Whether the new light explains what is `clear` of a region's thing only to a part: it belongs to the thing."""
    core = regions.labels[window] == region + 1
    rest = core & clear[window]
    if np.count_nonzero(rest) <= LEAST_TAKEN * np.count_nonzero(core):
        return False
    left_over, held = (_quantile(each[window], rest, 0.9) for each in (anew, regions.strength))
    return left_over > MOST_LEFT * held


def grown(regions: Regions, region: int, came: bool, views: Views) -> Piece | None:
    """The thing that `region` (0 .. N - 1) is a part of; None where it does not stand out from what is around.

    Its difference stands out of that of the quiet ground near: at the lowest limit at which it is one nearly convex
    piece with a sharp rim. Its own soft shadow, in the picture that shows it (the query where it `came`), is left out.
    """
    window = _window(regions, region)
    strength, labels = regions.strength[window], regions.labels[window]
    core = labels == region + 1
    quiet = cv2.dilate((labels > 0).view(np.uint8), np.ones((APART_PX, APART_PX), np.uint8)) == 0
    if not quiet.any():
        return None
    top = int(strength[core].max())
    surely = np.uint8(255) * (core & (strength >= ceil(HIGHEST * top)))
    shade = _shade(views, window, came) & (strength < ceil(SHADE_OF_TOP * top)) & ~core
    bare = strength * ~shade
    limit = max(LEAST_LIMIT, LIMIT_OF_TOP * top, QUIET_FACTOR * _quantile(bare, quiet, QUIET_QUANTILE))
    while limit < HIGHEST * top:
        over = cv2.threshold(bare, floor(limit), 255, cv2.THRESH_BINARY)[1]
        above = np.asarray(cv2.morphologyEx(over, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8)), np.uint8)
        thing = held_parts(above | surely, surely)
        if _is_thing(thing, bare, limit):
            largest_near = cv2.dilate(strength, np.ones((BLUR_PX, BLUR_PX), np.uint8))
            is_sharp = strength > cv2.LUT(largest_near, _BLURRED)
            return Piece(window, (thing > 0) & (is_sharp | (surely > 0)))
        limit *= STEP
    return None


def _is_thing(mask: Image, strength: Image, limit: float) -> bool:
    """Whether a piece is nearly convex, and a few pixels off it the difference is gone: light fades away slowly."""
    outlines, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    if cv2.countNonZero(mask) < LEAST_CONVEXITY * cv2.contourArea(cv2.convexHull(np.concatenate(outlines))):
        return False
    inner, outer = (cv2.dilate(mask, np.ones((px, px), np.uint8)) for px in BESIDE_PX)
    beside = outer > inner
    return not beside.any() or _quantile(strength, beside, BESIDE_QUANTILE) <= MOST_BESIDE * limit


def _window(regions: Regions, region: int) -> Window:
    x, y, wide, high = (int(each) for each in regions.boxes[region])
    margin = REACH_PX + max(wide, high) // 2
    height, width = regions.labels.shape
    return np.s_[
        max(0, y - margin) : min(height, y + high + margin), max(0, x - margin) : min(width, x + wide + margin)
    ]


def _widened(window: Window, place: Window, by_px: int) -> Window:
    """A window grown by a margin within `place`."""
    rows, columns = (
        slice(max(each.start - by_px, limit.start), min(each.stop + by_px, limit.stop))
        for each, limit in zip(window, place, strict=True)
    )
    return rows, columns


def _moved(window: Window, within: Window) -> Window:
    """Where in the window `within` another one lies."""
    rows, columns = (
        slice(each.start - other.start, each.stop - other.start) for each, other in zip(window, within, strict=True)
    )
    return rows, columns


def _area(window: Window) -> int:
    return (window[0].stop - window[0].start) * (window[1].stop - window[1].start)


def _strength(lit: Image, views: Views, window: Window) -> Image:
    """How much the pictures differ in a part of them, as `find_regions` measures it."""
    before, after = (np.ascontiguousarray(each[window]) for each in (lit, views.after))
    known = None if views.known is None else np.ascontiguousarray(views.known[window])
    difference = differences(before, after, known, views.settings.reach_px, views.settings.chroma_weight)[0]
    return cv2.blur(difference, (3, 3))


def _shade(views: Views, window: Window, came: bool) -> Mask:
    """Where the picture that shows the thing is darker in all colours alike."""
    lighter, darker = (views.lit, views.after) if came else (views.after, views.lit)
    return darker_alike(lighter, darker, window, ceil(128 * SHADE_SPREAD))


def _quantile(values: Image, where: Mask, share: float) -> int:
    """A quantile of uint8 values (h, w) somewhere, in one pixel at least, without the care that np.quantile takes."""
    counts = np.asarray(cv2.calcHist([values], [0], where.view(np.uint8), [256], [0, 256]))
    sums = counts.ravel().astype(np.int64).cumsum()
    return int(np.searchsorted(sums, share * sums[-1]))
