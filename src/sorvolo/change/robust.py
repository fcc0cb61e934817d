"""The robust change method: two aligned pictures -> what changed, whatever the light, leaves and leaning trees do."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache
from importlib.resources import files
from math import ceil, floor
from typing import NamedTuple

import cv2
import numpy as np

from sorvolo.change.light import PairLight, fit_light, relit
from sorvolo.change.outlines import dilated
from sorvolo.change.regions import (
    Image,
    Regions,
    Scratch,
    find_regions,
    scratch_of_thread,
)
from sorvolo.change.settling import Settling, settle
from sorvolo.change.shade import shade_between
from sorvolo.geometry.arrays import (
    Boxes,
    Bytes,
    Floats,
    ImageBGR,
    ImageGray,
    ImageRGB,
    Ints32,
    Mask,
    shrunk,
    square,
)
from sorvolo.kernels import held_parts, tree_margins
from sorvolo.survey.findings import Shade


@dataclass(frozen=True, eq=False)
class Trees:
    """Oblivious trees of one depth: `features` (T, D) columns, `thresholds` (T, D), `leaves` (T, 2**D) log-odds."""

    prior: float
    features: Ints32
    thresholds: Floats
    leaves: Floats


def how_sure(features: Floats, trees: Trees) -> Floats:
    """The chance (N,) from 0 to 1 that each row of `features` (N, F) is a change."""
    if len(features) == 0:
        return np.zeros(0)
    margin = trees.prior + tree_margins(features, trees.features, trees.thresholds, trees.leaves)
    return 1 / (1 + np.exp(-margin))


@lru_cache(maxsize=1)
def trained_trees() -> Trees:
    """The trees that come with the package, trained on the columns of `regions.FEATURES`."""
    stored = json.loads(files("sorvolo.change").joinpath("region_score.json").read_text())
    return Trees(
        float(stored["prior"]),
        np.array(stored["features"], np.int32),
        np.array(stored["thresholds"]),
        np.array(stored["leaves"]),
    )


Window = tuple[slice, slice]


# How far a thing reaches from where it differs most. Lengths in px of the half size pictures.
_REACH_PX = 20  # around a region and half of its length more: the ground that is looked at
# grey levels: what differs less is no part of the thing, nor what differs by less ...
_LEAST_LEVELS = 5.0
_OF_TOP = 0.07  # ... than this part of the region's largest difference, or ...
_OF_QUIET = 2.0  # ... so many times as much as 90 % of the quiet ground
_STEP = 1.4  # factor from limit to limit, up to ...
_HIGHEST = 0.7  # ... this part of the largest difference; what passes it is the thing for sure
_EXTENT_CONVEXITY = 0.8  # part of its hull that a thing fills
# of the limit, that three quarters of what lies beside a thing do not pass: light fades slowly
_BESIDE = 0.5
# of the largest difference: what differs less and is darker is the thing's shadow
_SHADE_OF_TOP = 0.35
_SHADE = (1.0, 0.1)  # what of a thing is its own shadow, as `shade_between` takes it
_BLURRED = 0.2  # of the largest difference within 5 px: what differs less is a thing's blurred rim


@dataclass(frozen=True, eq=False)
class Views:
    """Two pictures (h, w, 3) uint8 BGR of half size as regions were found in them, both in the light of `after`."""

    lit: Image
    after: Image

    @cached_property
    def shade(self) -> ImageGray:
        """The pair's shade mask (h, w), bits of `Shade`, of both pictures blurred as differences are: made once."""
        lit, after = (
            np.asarray(cv2.blur(each, (3, 3)), np.uint8) for each in (self.lit, self.after)
        )
        return shade_between(lit, after, *_SHADE)


@dataclass(frozen=True, eq=False)
class ThingPixels:
    """A thing's pixels: `mask` is a part of the picture, whose place is `window`."""

    window: Window
    mask: Mask

    @cached_property
    def box(self) -> tuple[int, int, int, int]:
        """x, y, width, height in the picture."""
        x, y, wide, high = cv2.boundingRect(self.mask.view(np.uint8))
        return x + self.window[1].start, y + self.window[0].start, wide, high


def grown(regions: Regions, region: int, came: bool, views: Views) -> ThingPixels | None:
    """The thing that `region` (0 .. N - 1) is a part of; None where it does not stand out from what is around.

    Its difference stands out of that of the quiet ground near: at the lowest limit at which it is one nearly convex
    piece with a sharp rim. Its own soft shadow, in the picture that shows it (the query where it `came`), is left out.
    """
    window = _window(regions, region, _REACH_PX)
    strength, labels = regions.strength[window], regions.labels[window]
    core = labels == region + 1
    quiet = ~dilated(labels > 0, 7)
    if not quiet.any():
        return None
    top = int(strength[core].max())
    surely = np.uint8(255) * (core & (strength >= ceil(_HIGHEST * top)))
    darker = (views.shade[window] & np.uint8(Shade.LATER if came else Shade.EARLIER)) > 0
    shadow = darker & (strength < ceil(_SHADE_OF_TOP * top)) & ~core
    bare = strength * ~shadow
    limit = max(
        _LEAST_LEVELS,
        _OF_TOP * top,
        _OF_QUIET * _quantile(bare, quiet, 0.9),
    )
    while limit < _HIGHEST * top:
        over = cv2.threshold(bare, floor(limit), 255, cv2.THRESH_BINARY)[1]
        above = np.asarray(cv2.morphologyEx(over, cv2.MORPH_OPEN, square(3)), np.uint8)
        thing = held_parts(above | surely, surely)
        if _is_thing(thing, bare, limit):
            largest_near = cv2.dilate(strength, square(5))
            is_sharp = strength > np.floor(_BLURRED * np.asarray(largest_near, np.float32))
            return ThingPixels(window, (thing > 0) & (is_sharp | (surely > 0)))
        limit *= _STEP
    return None


def with_weak_ground(regions: Regions, region: int, reach_px: int) -> ThingPixels:
    """`region` (0 .. N - 1) with the ground around it that differs weakly, less a rim of blur.

    Weak ground may join many regions, and run on along a cloud's edge. Each pixel of it belongs to the nearest
    region, and to none that is farther away than things are looked for.
    """
    window = _window(regions, region, reach_px)
    weak, core = regions.weak[window], np.uint8(255) * (regions.labels[window] == region + 1)
    # two blurs of 3 px reach two pixels out
    weak = np.asarray(cv2.erode(held_parts(weak | core, core), square(5)), np.uint8)
    return ThingPixels(window, ((weak > 0) & (regions.nearest[window] == region + 1)) | (core > 0))


def _is_thing(mask: Image, strength: Image, limit: float) -> bool:
    """Whether a piece is nearly convex, and a few pixels off it the difference is gone: light fades away slowly."""
    outlines, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    if cv2.countNonZero(mask) < _EXTENT_CONVEXITY * cv2.contourArea(
        cv2.convexHull(np.concatenate(outlines))
    ):
        return False
    inner, outer = (cv2.dilate(mask, square(px)) for px in (5, 9))
    beside = outer > inner
    return not beside.any() or _quantile(strength, beside, 0.75) <= _BESIDE * limit


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


# How regions become masks. Lengths in px of the half size pictures.
_LEAST_GROWN = 0.5  # score: regions below it keep their raw mask
# part of its hull: what fills more fills all of it, for it may have the ground's colours
_MASK_CONVEXITY = 0.5
# side of the window within which an outline is drawn, where half of the difference is left ...
_RIM_PX = 5
# ... of what it was before the ground's own range, grey levels, was taken off ...
_SLACK_LEVELS = 5.0
_LEAST_SHARE = 0.4  # ... at least this share
_ALONE_SCORE = 0.69  # for a pair on its own; where several views vote less will do
_SAME_PLACE_PX = 0.6  # a reference displaced by more shows what left at its own pixels


# half size; around the unknown nothing is compared: resampling mixes it into what is known
_UNKNOWN_PX = 4


@dataclass(frozen=True, eq=False)
class RobustResult:
    """What changed: `mask` (h, w) uint8 0 or 255, `boxes` (N, 4) x, y, width, height and `scores` (N,) from 0 to 1.

    `light`, `settling` and `noise` are what the pair set itself: the light, the misalignment, and the 95 % quantile
    of differences where nothing changed; lengths of `settling` are in half size pixels. `known` is the share compared.
    """

    mask: ImageGray
    boxes: Boxes
    scores: Floats
    light: PairLight
    settling: Settling
    noise: float
    known: float


def as_bgr(image: ImageRGB) -> ImageBGR:
    """The picture with its channels in OpenCV's order."""
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2BGR), np.uint8)


def compare_robust(
    reference: Bytes,
    query: Bytes,
    valid: Mask | None = None,
    least_score: float = _ALONE_SCORE,
) -> RobustResult:
    """Compare two aligned BGR pictures (h, w, 3) uint8 of at least 32 px; up to about 5 px apart is fine.

    Where `valid` (h, w) is False the answer is unknown: nothing is found there, nor in a thin rim around it.
    """
    scratch = scratch_of_thread()
    examined = examine(reference, query, valid, scratch)
    scores = how_sure(examined.regions.features, trained_trees())
    return _result(examined, scores, least_score, query.shape[1::-1])


class Examined(NamedTuple):
    """The regions that differ at half size, before any is judged; and what the pair set itself."""

    regions: Regions
    light: PairLight
    settling: Settling
    known: float  # share of the picture
    views: Views


def examine(
    reference: Bytes,
    query: Bytes,
    valid: Mask | None,
    scratch: Scratch | None = None,
) -> Examined:
    """Look at a pair of pictures as `compare_robust` does. Pictures and strengths of the result lie in `scratch`, in
    memory of their own without it."""
    scratch = scratch or Scratch()
    height, width = query.shape[:2]
    half = width // 2, height // 2
    size = half[::-1]
    before, after, spare = (scratch.take(name, size, (3,)) for name in ("before", "after", "spare"))
    cv2.resize(reference, half, dst=before, interpolation=cv2.INTER_AREA)
    cv2.resize(query, half, dst=after, interpolation=cv2.INTER_AREA)
    known = _half_known(valid, half)
    if known is not None:
        cv2.copyTo(after, np.logical_not(known).view(np.uint8), before)
    grays = scratch.stack("grays", size, 2)
    for image, gray in zip((before, after), grays, strict=True):
        cv2.cvtColor(image, cv2.COLOR_BGR2GRAY, dst=gray)
    settling = settle(grays[0], grays[1], known)
    if settling.moved_px > 0:
        # OpenCV resamples four bands in half the time that three take it
        four, moved = (scratch.take(name, size, (4,)) for name in ("four", "moved"))
        cv2.cvtColor(before, cv2.COLOR_BGR2BGRA, dst=four)
        cv2.warpPerspective(
            four,
            settling.reference_from_query,
            half,
            dst=moved,
            flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
            borderMode=cv2.BORDER_REPLICATE,
        )
        cv2.cvtColor(moved, cv2.COLOR_BGRA2BGR, dst=before)
    light = fit_light(before, after, known)
    known = (
        None
        if known is None
        else _without_rim(known, _UNKNOWN_PX + int(np.ceil(settling.moved_px)))
    )
    lit = relit(before, light, spare)
    regions = find_regions(lit, after, known, settling.rest_px, light.unevenness, scratch)
    share = 1.0 if known is None else cv2.countNonZero(known.view(np.uint8)) / known.size
    return Examined(regions, light, settling, share, Views(lit, after))


def _half_known(valid: Mask | None, half: tuple[int, int]) -> Mask | None:
    if valid is None or valid.all():
        return None
    height, width = valid.shape
    if height % 2 == 0 and width % 2 == 0:
        pairs = np.ascontiguousarray(valid).view(np.uint16) == 0x0101  # two True side by side
        return np.logical_and(pairs[::2], pairs[1::2])
    return shrunk(valid.astype(np.uint8) * 255, half) == 255


def _without_rim(known: Mask, rim_px: int) -> Mask:
    window = square(2 * rim_px + 1)
    return cv2.erode(known.astype(np.uint8), window, borderValue=1) > 0


def _result(
    examined: Examined,
    scores: Floats,
    least_score: float,
    size: tuple[int, int],
) -> RobustResult:
    """The answer at full `size` (w, h): the regions whose scores (N,) suffice."""
    regions, light, settling, known, views = examined
    sure = scores >= least_score
    if not sure.any():
        nothing = np.zeros(size[::-1], np.uint8), np.zeros((0, 4), np.int64), np.zeros(0)
        return RobustResult(*nothing, light, settling, regions.noise, known)
    went = _went(regions)
    pieces: dict[int, ThingPixels] = {}
    for region in np.flatnonzero(sure & (scores >= _LEAST_GROWN)):
        piece = grown(regions, int(region), not went[region], views)
        if piece is not None:
            pieces[int(region)] = piece
    half = regions.labels.shape[::-1]
    boxes_px = np.array(
        [_around(box, pieces.get(each)) for each, box in enumerate(regions.boxes)], np.float64
    )
    if settling.moved_px < _SAME_PLACE_PX or not (sure & went).any():
        half_mask = _filled(sure, regions, pieces)
    else:  # what disappeared is seen in the reference: it keeps the reference's pixels
        gone = _filled(sure & went, regions, pieces)
        gone = np.asarray(
            cv2.warpPerspective(gone, settling.reference_from_query, half, flags=cv2.INTER_LINEAR),
            np.uint8,
        )
        stays = sure & ~went
        half_mask = gone
        if stays.any():
            here = _filled(stays, regions, pieces)
            half_mask = np.asarray(cv2.max(here, gone), np.uint8)
        middle = boxes_px[:, :2] + boxes_px[:, 2:] / 2
        moved = np.column_stack([middle, np.ones(len(middle))]) @ settling.reference_from_query.T
        boxes_px[went, :2] += (moved[:, :2] / moved[:, 2:] - middle)[went]
    mask = _enlarged(half_mask, size)
    factor = np.array([size[0] / half[0], size[1] / half[1]])
    corners = np.clip(np.rint(boxes_px[sure, :2] * factor), 0, np.array(size) - 1).astype(np.int64)
    sides = np.rint(boxes_px[sure, 2:] * factor).astype(np.int64)
    boxes = np.hstack([corners, np.minimum(sides, np.array(size) - corners)])
    return RobustResult(mask, boxes, scores[sure], light, settling, regions.noise, known)


def _around(box: Ints32, piece: ThingPixels | None) -> tuple[int, int, int, int]:
    """x, y, width, height of what holds a region's box and what it has grown to."""
    x, y, wide, high = (int(each) for each in box)
    if piece is None:
        return x, y, wide, high
    left, top, piece_wide, piece_high = piece.box
    right, bottom = max(x + wide, left + piece_wide), max(y + high, top + piece_high)
    return min(x, left), min(y, top), right - min(x, left), bottom - min(y, top)


def _enlarged(half_mask: ImageGray, size: tuple[int, int]) -> ImageGray:
    """The mask at full `size` (w, h), 255 where the half size one passes 127; only around things where size is even."""
    mask = np.zeros(size[::-1], np.uint8)
    x, y, wide, high = cv2.boundingRect(half_mask)
    top, left, bottom, right = max(0, y - 1), max(0, x - 1), y + high + 1, x + wide + 1
    window, place = half_mask, mask
    if size[0] % 2 == 0 and size[1] % 2 == 0:
        window, place = (
            half_mask[top:bottom, left:right],
            mask[2 * top : 2 * bottom, 2 * left : 2 * right],
        )
    larger = cv2.resize(window, place.shape[::-1], interpolation=cv2.INTER_LINEAR)
    place[:] = cv2.threshold(larger, 127, 255, cv2.THRESH_BINARY)[1]
    return mask


def _went(regions: Regions) -> Mask:
    """Which regions (N,) are things that the reference shows; what touches is one thing."""
    parts = cv2.connectedComponents(regions.weak, connectivity=8)[1]
    part = np.zeros(len(regions.boxes), np.int64)
    for region, (x, y, wide, high) in enumerate(regions.boxes):
        place = slice(y, y + high), slice(x, x + wide)
        part[region] = parts[place].flat[(regions.labels[place] == region + 1).argmax()]
    came = np.bincount(part, regions.came, minlength=1)
    return came[part] < 0


def _filled(chosen: Mask, regions: Regions, pieces: Mapping[int, ThingPixels]) -> ImageGray:
    """The things of the `chosen` (N,) regions: their `pieces`, and where there is none the region with the weakly
    differing ground that is its own; without gaps.

    Where a thing has the ground's own colour nothing differs: what is nearly convex is taken to be so. The outline
    runs, to a part of a pixel, where the result passes 127.
    """
    size = regions.labels.shape[0], regions.labels.shape[1]
    around = np.zeros(size, np.uint8)
    for region in np.flatnonzero(chosen):
        piece = pieces.get(int(region)) or with_weak_ground(regions, int(region), _REACH_PX)
        around[piece.window][piece.mask] = 255
    outlines, _ = cv2.findContours(around, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    for outline in outlines:
        hull = cv2.convexHull(outline)
        is_full = cv2.contourArea(outline) > _MASK_CONVEXITY * cv2.contourArea(hull)
        cv2.drawContours(around, [hull if is_full else outline], -1, 255.0, cv2.FILLED)
    x, y, wide, high = cv2.boundingRect(around)
    things = np.s_[
        max(0, y - _RIM_PX) : y + high + _RIM_PX,
        max(0, x - _RIM_PX) : x + wide + _RIM_PX,
    ]
    outlined = np.zeros(size, np.uint8)
    outlined[things] = _outlined(around[things], regions.strength[things])
    if regions.known is not None:
        outlined[~regions.known] = 0
    return outlined


def _outlined(thing: ImageGray, strength: ImageGray) -> ImageGray:
    """Things (h, w) 0 or 255 whose rim is drawn anew where the difference falls below a part of its height nearby."""
    near = square(_RIM_PX)
    height = np.maximum(cv2.dilate(cv2.min(thing, strength), near), 1).astype(np.float32)
    least = np.float32(_LEAST_SHARE) * height
    limit = np.maximum(np.float32(0.5) * height - np.float32(_SLACK_LEVELS), least)
    rim = np.clip(127.5 + 255 * (strength - limit) / height, 0, 255).astype(np.uint8)
    rim[cv2.dilate(thing, square(3)) == 0] = 0
    return np.asarray(cv2.max(rim, cv2.erode(thing, near)), np.uint8)
