"""Things without the shadows they throw: a shadow is part of what changed, but not where the thing is."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from itertools import combinations

import cv2
import numpy as np
from numpy.typing import NDArray

from sorvolo.change.shape.kinds import kind_of, median_ratio
from sorvolo.change.shape.outlines import measures, outline_of
from sorvolo.geometry.arrays import Floats32, ImageRGB, Mask
from sorvolo.survey.findings import Change, ChangeKind, Patch

_DARK = 1.08  # of the light before: what is no brighter and of the same colour is a shadow or its rim, or dark itself
_ALIKE = 0.22  # a shadow takes about the same share of each colour
_LEAST_SHARE = 0.02  # of the change: if less is no shadow, all of it is a dark thing
_LEAST_PX = 6
_RIM_PX = 4  # around a change: outlines are drawn a little beside the masks that they are drawn of
_BLACK = 8.0  # grey levels: light that black has, so that ratios of dark pictures mean something
_LEAST_PIECE = 0.15  # of the largest lit piece: smaller ones are specks of the shadow's rim
_TOLERANCE_PX = 0.7
_APART_M = 0.5  # things so far from each other are two ...
_NECK_M, _GAP_M = 0.25, 0.4  # what hangs together by less, or lies so far apart, is not one piece
_LEAST_THING_M2 = 0.035  # ... if each is as large as a football at least ...
_COMPACT, _CAR_M = 0.8, (1.2, 6.0)  # ... and both together do not fill what may be one dark car with bright parts
_SOLID = 0.45  # a thing fills so much of its hull: specks of a dark thing scatter
_CLEARLY, _SHADE = 0.8, 0.7  # of the light: darker is a shadow's core; and so much of a piece of shade is
_SPECK_M2 = 0.2  # what is smaller may be a speck of shade
_CONTRARY = {ChangeKind.APPEARED: ChangeKind.DISAPPEARED, ChangeKind.DISAPPEARED: ChangeKind.APPEARED}


def without_shadow(change: Change) -> Change:
    """The change with its outline, area and length drawn around the thing alone; the same change where nothing tells.

    The outline is what the convex hull of the pixels that are no shadow holds of the change, so that a dark thing with
    a few bright parts stays whole. The patch keeps the shadow: it belongs into the map.
    """
    patch = change.patch
    thing = thing_of(patch.changed, _OneLight(patch).shadow(change.kind))
    if thing is patch.changed:
        return change
    outline_m = outline_of(thing, patch.site_from_patch, _TOLERANCE_PX, 3.0)
    if outline_m is None:
        return change
    size = measures(outline_m)
    return replace(change, outline_m=outline_m, area_m2=size.area_m2, length_m=size.length_m)


def is_mostly_shade(change: Change) -> bool:
    """Whether most of a small change is ground that all colours show darker or brighter: a shadow came or left."""
    if change.area_m2 >= _SPECK_M2:
        return False
    came, left = _OneLight(change.patch).shades()
    changed = change.patch.changed
    return bool(np.count_nonzero(changed & (came | left)) >= _SHADE * np.count_nonzero(changed))


def thing_of(changed: Mask, shadow: Mask) -> Mask:
    """The part of the change that is the thing, not its shadow; `changed` itself where hardly anything would stay."""
    lit = changed & ~shadow
    opened = cv2.morphologyEx(lit.view(np.uint8), cv2.MORPH_OPEN, np.ones((2, 2), np.uint8))
    if np.count_nonzero(opened) < max(_LEAST_PX, _LEAST_SHARE * np.count_nonzero(changed)):
        return changed
    _, labels, stats, _ = cv2.connectedComponentsWithStats(opened, connectivity=8)
    areas = stats[:, cv2.CC_STAT_AREA].copy()
    areas[0] = 0  # the ground
    kept = (areas >= _LEAST_PIECE * areas.max())[labels].view(np.uint8)
    return np.asarray((cv2.dilate(_hull(kept).view(np.uint8), np.ones((3, 3), np.uint8)) > 0) & changed)


def things_of(patch: Patch, kind: ChangeKind, changed: Mask) -> list[tuple[Mask, ChangeKind]]:
    """The things in a change, each with its own kind and the part of `changed` that lies nearest to it, the largest
    first; the shadow of what came does not go to what left.

    They are separated by the ground or the shadow between them, what left from what came also where they touch;
    `changed` alone where it is but one thing. A dark car has bright parts far from each other: what fills a rectangle
    of about its size stays whole, unless something left beside what came.
    """
    light = _OneLight(patch)
    groups = _groups(patch, changed, light)
    found = [each for group, own in groups or [(changed, kind)] for each in _things_of_group(patch, own, group, light)]
    return sorted(found, key=lambda each: -np.count_nonzero(each[0]))


def _groups(patch: Patch, changed: Mask, light: "_OneLight") -> list[tuple[Mask, ChangeKind]]:
    """The pieces of a change that lie apart, or where one came and the other left hang together by a neck, with their
    kinds; nothing where it is but one piece. What is all shadow is no piece of its own."""
    side = 2 * round(_NECK_M / 2 / patch.m_per_px) + 1
    disk = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))
    count, labels = cv2.connectedComponents(cv2.morphologyEx(changed.view(np.uint8), cv2.MORPH_OPEN, disk))
    if count < 3 or _may_be_a_car(changed, patch.m_per_px):
        return []
    new_shade, old_shade = light.shades()
    bare_m2 = np.bincount(labels[~(new_shade | old_shade)], minlength=count) * patch.m_per_px**2
    pieces = [labels == each for each in range(1, count) if bare_m2[each] >= _LEAST_THING_M2]
    if len(pieces) < 2:
        return []
    distances = [_distance(each) * patch.m_per_px for each in pieces]
    group = _group_of_pieces(patch, pieces, distances)
    if len(set(group)) < 2:
        return []
    nearest = np.array(group)[np.argmin(distances, axis=0)]
    found = [changed & (nearest == each) for each in dict.fromkeys(group)]
    return [(each, kind_of(replace(patch, changed=each))) for each in found]


def _group_of_pieces(patch: Patch, pieces: Sequence[Mask], distances_m: Sequence[Floats32]) -> list[int]:
    """The group of each piece: those near each other are one, unless one came and the other left."""
    kinds = [kind_of(replace(patch, changed=each)) for each in pieces]
    group = list(range(len(pieces)))
    for first, second in combinations(range(len(pieces)), 2):
        is_contrary = _CONTRARY.get(kinds[first]) is kinds[second]
        if not is_contrary and float(distances_m[first][pieces[second]].min()) < _GAP_M:
            group = [group[first] if each == group[second] else each for each in group]
    return group


def _things_of_group(
    patch: Patch, kind: ChangeKind, changed: Mask, light: "_OneLight"
) -> list[tuple[Mask, ChangeKind]]:
    """The things in one piece of a change, as `things_of` gives them."""
    if _may_be_a_car(changed, patch.m_per_px):
        return [(changed, kind)]
    shadow = changed & light.shadow(kind)
    things = _lit_things(changed & ~shadow, patch.m_per_px)
    if len(things) < 2:
        return [(changed, kind)]
    distances = [_distance(each) for each in things]
    contrary = _CONTRARY.get(kind)
    kinds = [kind_of(replace(patch, changed=_hull(each) & changed)) for each in things]
    if contrary is not None and any(each is not contrary for each in kinds):
        distances = [np.where(shadow & (own is contrary), np.inf, each) for own, each in zip(kinds, distances)]
    nearest = np.argmin(distances, axis=0)
    return [(changed & (nearest == index), own) for index, own in enumerate(kinds)]


def _lit_things(bare: Mask, m_per_px: float) -> list[Mask]:
    """The solid things, the largest first, in the part of a change that is no shadow."""
    lit = cv2.morphologyEx(bare.view(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    labels = _joined(np.asarray(lit > 0), m_per_px)
    areas_m2 = np.bincount(labels[lit > 0]) * m_per_px**2
    large = [(labels == each) & (lit > 0) for each in np.argsort(-areas_m2) if areas_m2[each] >= _LEAST_THING_M2]
    return [each for each in large if np.count_nonzero(each) >= _SOLID * np.count_nonzero(_hull(each))]


def _distance(mask: Mask) -> Floats32:
    """(h, w) how far each pixel lies from a mask, pixels."""
    return np.asarray(cv2.distanceTransform((~mask).view(np.uint8), cv2.DIST_L2, 5), np.float32)


def _hull(mask: Mask | NDArray[np.uint8]) -> Mask:
    hull = np.zeros(mask.shape, np.uint8)
    cv2.fillConvexPoly(hull, cv2.convexHull(cv2.findNonZero(mask.view(np.uint8))), (1,))
    return hull.view(bool)


def _joined(mask: Mask, m_per_px: float) -> NDArray[np.int32]:
    """The number from 1 on of the thing that each pixel of a mask (h, w) belongs to, and those near it; else 0."""
    reach = 2 * round(_APART_M / 2 / m_per_px) + 1
    padded = cv2.copyMakeBorder(mask.view(np.uint8), reach, reach, reach, reach, cv2.BORDER_CONSTANT, value=0)
    joined = cv2.dilate(padded, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (reach, reach)))
    return np.asarray(cv2.connectedComponents(joined[reach:-reach, reach:-reach], connectivity=8)[1], np.int32)


def _may_be_a_car(changed: Mask, m_per_px: float) -> bool:
    hull = cv2.convexHull(cv2.findNonZero(changed.view(np.uint8)))
    short_m, long_m = sorted(float(each) * m_per_px for each in cv2.minAreaRect(hull)[1])
    is_compact = np.count_nonzero(changed) >= _COMPACT * cv2.contourArea(hull)
    return short_m >= _CAR_M[0] and long_m <= _CAR_M[1] and bool(is_compact)


def shadow_of_arrival(before: ImageRGB, after: ImageRGB, changed: Mask) -> Mask:
    """Where what came is dark as its shadow is, in a piece of two aligned pictures of about the same light."""
    ratio = (after.astype(np.float32) + _BLACK) / (before.astype(np.float32) + _BLACK)
    if not changed.all():
        ratio = ratio / median_ratio(after, before, ~changed, _BLACK)
    return _darkest(ratio)[0]


class _OneLight:
    """Both pictures of a patch in and close around what changed, the earlier in the later one's light.

    Masks are (h, w) of the patch, nothing where they do not reach.
    """

    def __init__(self, patch: Patch) -> None:
        self._changed = patch.changed
        known = (patch.before[..., 3] == 255) & (patch.after[..., 3] == 255)
        x, y, wide, high = cv2.boundingRect(patch.changed.view(np.uint8))
        margin = _RIM_PX
        self._part = np.s_[max(0, y - margin) : y + high + margin, max(0, x - margin) : x + wide + margin]
        self._known = known[self._part]
        self._before, self._after = (
            np.ascontiguousarray(each[self._part][..., :3]).astype(np.float32) + _BLACK
            for each in (patch.before, patch.after)
        )
        around = known & ~patch.changed
        if np.count_nonzero(around) >= _LEAST_PX:
            self._before *= median_ratio(patch.after, patch.before, around, _BLACK)

    def shadow(self, kind: ChangeKind) -> Mask:
        """Where it is dark as a shadow is: on the later date where something came, on the earlier where it went."""
        came, went = (dark for dark, _ in self._dark)
        if kind is ChangeKind.DISAPPEARED:
            return self._whole(went)
        return self._whole(came | went if kind is ChangeKind.REPLACED else came)

    def shades(self) -> tuple[Mask, Mask]:
        """Where what changed is clearly darker on the later date, all colours alike, and where on the earlier."""
        came, left = (self._whole(dark & (most < _CLEARLY)) & self._changed for dark, most in self._dark)
        return came, left

    @cached_property
    def _dark(self) -> tuple[tuple[Mask, Floats32], tuple[Mask, Floats32]]:
        return _darkest(self._after / self._before), _darkest(self._before / self._after)

    def _whole(self, mask: Mask) -> Mask:
        whole = np.zeros(self._changed.shape, bool)
        whole[self._part] = mask & self._known
        return whole


def _darkest(ratio: Floats32) -> tuple[Mask, Floats32]:
    """Where (h, w) pictures of a ratio (h, w, 3) have a shadow, and the ratio of the colour it takes least of."""
    red, green, blue = cv2.split(ratio)
    most, least = cv2.max(cv2.max(red, green), blue), cv2.min(cv2.min(red, green), blue)
    return np.asarray((most < _DARK) & (most - least < _ALIKE)), np.asarray(most, np.float32)
