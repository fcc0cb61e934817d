"""Things told from the shadows they throw: a shadow is part of what changed, but not where the thing is."""

from dataclasses import replace

import cv2
import numpy as np

from sorvolo.change.kinds import kind_of
from sorvolo.change.outlines import measures, outline_of
from sorvolo.geometry.arrays import Anything, ImageRGB, Mask
from sorvolo.survey.findings import Change, ChangeKind, Patch

_DARK = 1.08  # of the light before: what is no brighter and of the same colour is a shadow or its rim, or dark itself
_ALIKE = 0.22  # a shadow takes about the same share of each colour
_LEAST_SHARE = 0.02  # of the change: if less is no shadow, all of it is a dark thing
_LEAST_PX = 6
_LEAST_PIECE = 0.15  # of the largest lit piece: smaller ones are specks of the shadow's rim
_TOLERANCE_PX = 0.7
_APART_M = 0.5  # things so far from each other are two ...
_LEAST_THING_M2 = 0.06  # ... if each is as large as a football at least ...
_COMPACT, _CAR_M = 0.8, (1.2, 6.0)  # ... and both together do not fill what may be one dark car with bright parts
_CONTRARY = {ChangeKind.APPEARED: ChangeKind.DISAPPEARED, ChangeKind.DISAPPEARED: ChangeKind.APPEARED}


def without_shadow(change: Change) -> Change:
    """The change with its outline, area and length drawn around the thing alone; the same change where nothing tells.

    The outline is what the convex hull of the pixels that are no shadow holds of the change, so that a dark thing with
    a few bright parts stays whole. The patch keeps the shadow: it belongs into the map.
    """
    patch = change.patch
    thing = thing_of(patch.changed, _shadow(patch, change.kind))
    if thing is patch.changed:
        return change
    outline_m = outline_of(thing, patch.site_from_patch, _TOLERANCE_PX, 3.0)
    if outline_m is None:
        return change
    size = measures(outline_m)
    return replace(change, outline_m=outline_m, area_m2=size.area_m2, length_m=size.length_m)


def thing_of(changed: Mask, shadow: Mask) -> Mask:
    """The part of the change that is the thing, not its shadow; `changed` itself where hardly anything would stay."""
    lit = changed & ~shadow
    opened: Anything = cv2.morphologyEx(lit.view(np.uint8), cv2.MORPH_OPEN, np.ones((2, 2), np.uint8))
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

    They are told apart by the ground or the shadow between them; `changed` alone where it is but one thing. A dark car
    has bright parts far from each other: what fills a rectangle of about its size stays whole.
    """
    shadow = changed & _shadow(patch, kind)
    lit = (changed & ~shadow).view(np.uint8)
    lit = np.asarray(cv2.morphologyEx(lit, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8)), np.uint8)
    reach = 2 * round(_APART_M / 2 / patch.m_per_px) + 1
    padded = cv2.copyMakeBorder(lit, reach, reach, reach, reach, cv2.BORDER_CONSTANT, value=0)
    joined = cv2.dilate(padded, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (reach, reach)))
    count, labels = cv2.connectedComponents(joined[reach:-reach, reach:-reach], connectivity=8)
    areas_m2 = np.bincount(labels[lit > 0], minlength=count) * patch.m_per_px**2
    large = [label for label in np.argsort(-areas_m2) if areas_m2[label] >= max(_LEAST_THING_M2, 1e-9)]
    if len(large) < 2 or _may_be_a_car(changed, patch.m_per_px):
        return [(changed, kind)]
    things = [(labels == each) & (lit > 0) for each in large]
    distances = [cv2.distanceTransform((~each).view(np.uint8), cv2.DIST_L2, 5) for each in things]
    contrary = _CONTRARY.get(kind)
    kinds = [kind_of(replace(patch, changed=_hull(each) & changed)) for each in things]
    if contrary is not None and any(each is not contrary for each in kinds):
        distances = [np.where(shadow & (own is contrary), np.inf, each) for own, each in zip(kinds, distances)]
    nearest = np.argmin(distances, axis=0)
    return [(changed & (nearest == index), own) for index, own in enumerate(kinds)]


def _hull(mask: Anything) -> Mask:
    hull = np.zeros(mask.shape, np.uint8)
    cv2.fillConvexPoly(hull, cv2.convexHull(cv2.findNonZero(mask.view(np.uint8))), (1,))
    return hull.view(bool)


def _may_be_a_car(changed: Mask, m_per_px: float) -> bool:
    hull = cv2.convexHull(cv2.findNonZero(changed.view(np.uint8)))
    short_m, long_m = sorted(float(each) * m_per_px for each in cv2.minAreaRect(hull)[1])
    is_compact = np.count_nonzero(changed) >= _COMPACT * cv2.contourArea(hull)
    return short_m >= _CAR_M[0] and long_m <= _CAR_M[1] and bool(is_compact)


def shadow_of_arrival(before: ImageRGB, after: ImageRGB, changed: Mask) -> Mask:
    """Where what came is dark as its shadow is, in a piece of two aligned pictures of about the same light."""
    ratio = (after.astype(np.float32) + 8) / (before.astype(np.float32) + 8)
    if not changed.all():
        ratio = ratio / np.median(ratio[~changed], axis=0)
    return _is_dark(ratio)


def _shadow(patch: Patch, kind: ChangeKind) -> Mask:
    """Where the change is dark as a shadow is: on the later date where something came, on the earlier where it went."""
    known = (patch.before[..., 3] == 255) & (patch.after[..., 3] == 255)
    around = known & ~patch.changed
    before, after = (each[..., :3].astype(np.float32) + 8 for each in (patch.before, patch.after))
    if np.count_nonzero(around) >= _LEAST_PX:
        before = before * np.median(after[around] / before[around], axis=0)
    nothing = np.zeros(patch.changed.shape, bool)
    came = _is_dark(after / before) if kind is not ChangeKind.DISAPPEARED else nothing
    went = _is_dark(before / after) if kind in (ChangeKind.DISAPPEARED, ChangeKind.REPLACED) else nothing
    return (came | went) & known


def _is_dark(ratio: Anything) -> Mask:
    red, green, blue = np.moveaxis(ratio, -1, 0)
    most, least = np.maximum(np.maximum(red, green), blue), np.minimum(np.minimum(red, green), blue)
    return (most < _DARK) & (most - least < _ALIKE)
