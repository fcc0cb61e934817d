"""Things without the shadows they throw: a shadow is part of what changed, but not where the thing is."""

from dataclasses import replace

import cv2
import numpy as np

from sorvolo.change.kinds import kind_of
from sorvolo.change.outlines import dilated, hull_of, measures, opened, outline_of
from sorvolo.geometry.arrays import Bytes, Floats32, Ints32, Mask
from sorvolo.survey.findings import Change, ChangeKind, Patch, Shade

_CONTRARY = {
    ChangeKind.APPEARED: ChangeKind.DISAPPEARED,
    ChangeKind.DISAPPEARED: ChangeKind.APPEARED,
}


# What is a thing in changed ground, and when there are several.
_LEAST_PX = 6  # bare of shadow: with fewer, or less than ...
_LEAST_SHARE = 0.02  # ... this of the change, all of it is a dark thing
_LEAST_PIECE = 0.15  # of the largest lit piece: smaller ones are specks of the shadow's rim
_GAP_M = 0.4  # pieces so far from each other are two
_APART_M = 0.5  # things in one piece so far from each other are two ...
_LEAST_M2 = 0.035  # ... if each is as large as a football at least ...
_SOLID = 0.45  # ... fills so much of its hull, for specks of a dark thing scatter, ...
_CAR_M = (1.2, 6.0)  # ... and all is not as wide and as long as one dark car with bright parts


def without_shadow(change: Change) -> Change:
    """The change with its outline, area and length drawn around the thing alone, where its picture shows which part
    that is.

    The outline is what the convex hull of the pixels that are no shadow holds of the change, so that a dark thing with
    a few bright parts stays whole. The patch keeps the shadow: it belongs into the map.
    """
    patch = change.patch
    thing = thing_of(patch.changed, shadow_of(patch, change.kind))
    if thing is patch.changed:
        return change
    outline_m = outline_of(thing, patch.site_from_patch, tolerance_px=0.7, join_px=3.0)
    if outline_m is None:
        return change
    size = measures(outline_m)
    return replace(change, outline_m=outline_m, area_m2=size.area_m2, length_m=size.length_m)


def shadow_of(patch: Patch, kind: ChangeKind) -> Mask:
    """Where (h, w) it is dark as a shadow is: on the later date where something came, on the earlier where it went."""
    bits = {ChangeKind.DISAPPEARED: Shade.EARLIER, ChangeKind.REPLACED: Shade.LATER | Shade.EARLIER}
    return (patch.shade & np.uint8(bits.get(kind, Shade.LATER))) > 0


def thing_of(changed: Mask, shadow: Mask) -> Mask:
    """The part of the change that is the thing, not its shadow; `changed` itself where hardly anything would stay."""
    lit = changed & ~shadow
    solid = opened(lit, 2)
    if np.count_nonzero(solid) < max(_LEAST_PX, _LEAST_SHARE * np.count_nonzero(changed)):
        return changed
    _, labels, stats, _ = cv2.connectedComponentsWithStats(solid.view(np.uint8), connectivity=8)
    areas = stats[:, cv2.CC_STAT_AREA].copy()
    areas[0] = -1  # the ground: no piece, however small pieces may be
    kept = (areas >= _LEAST_PIECE * areas.max())[labels].view(np.uint8)
    return dilated(_hull(kept), 3) & changed


def things_of(patch: Patch, kind: ChangeKind, changed: Mask) -> list[tuple[Mask, ChangeKind]]:
    """The things in a change, each with its own kind and the part of `changed` that lies nearest to it, the largest
    first; the shadow of what came does not go to what left.

    They are separated by the ground or the shadow between them; `changed` alone where it is but one thing. A dark car
    has bright parts far from each other: what fills a rectangle of about its size stays whole.
    """
    if _may_be_a_car(changed, patch.m_per_px):
        return [(changed, kind)]
    labels = _joined(changed, int((_GAP_M / patch.m_per_px - 1) / 2))
    dark = (patch.shade & np.uint8(Shade.LATER_DARK | Shade.EARLIER_DARK)) > 0
    # what is all shadow is no piece of its own
    bare_m2 = np.bincount(labels[changed & ~dark]) * patch.m_per_px**2
    pieces = [changed & (labels == each) for each in np.flatnonzero(bare_m2 >= _LEAST_M2)]
    if len(pieces) < 2:
        found = _joined_by_shadow(patch, kind, changed)
    else:
        nearest = np.argmin([_distance(each) for each in pieces], axis=0)
        parts = [changed & (nearest == index) for index in range(len(pieces))]
        found = [
            thing
            for part in parts
            for thing in _joined_by_shadow(patch, kind_of(replace(patch, changed=part)), part)
        ]
    return sorted(found, key=lambda each: -np.count_nonzero(each[0]))


def _joined_by_shadow(
    patch: Patch, kind: ChangeKind, changed: Mask
) -> list[tuple[Mask, ChangeKind]]:
    """The things in one piece of a change, as `things_of` gives them."""
    if _may_be_a_car(changed, patch.m_per_px):
        return [(changed, kind)]
    shadow = changed & shadow_of(patch, kind)
    things = _lit_things(changed & ~shadow, patch.m_per_px)
    if len(things) < 2:
        return [(changed, kind)]
    distances = [_distance(each) for each in things]
    contrary = _CONTRARY.get(kind)
    kinds = [kind_of(replace(patch, changed=_hull(each) & changed)) for each in things]
    if contrary is not None and any(each is not contrary for each in kinds):
        distances = [
            np.where(shadow & (own is contrary), np.inf, each)
            for own, each in zip(kinds, distances)
        ]
    nearest = np.argmin(distances, axis=0)
    return [(changed & (nearest == index), own) for index, own in enumerate(kinds)]


def _lit_things(bare: Mask, m_per_px: float) -> list[Mask]:
    """The solid things, the largest first, in the part of a change that is no shadow."""
    lit = opened(bare)
    labels = _joined(lit, round(_APART_M / 2 / m_per_px))
    areas_m2 = np.bincount(labels[lit]) * m_per_px**2
    large = [
        (labels == each) & lit for each in np.argsort(-areas_m2) if areas_m2[each] >= _LEAST_M2
    ]
    return [
        each for each in large if np.count_nonzero(each) >= _SOLID * np.count_nonzero(_hull(each))
    ]


def _distance(mask: Mask) -> Floats32:
    """(h, w) how far each pixel lies from a mask, pixels."""
    return np.asarray(cv2.distanceTransform((~mask).view(np.uint8), cv2.DIST_L2, 5), np.float32)


def _hull(mask: Mask | Bytes) -> Mask:
    hull = np.zeros(mask.shape, np.uint8)
    cv2.fillConvexPoly(hull, hull_of(mask), (1,))
    return hull.view(bool)


def _joined(mask: Mask, near_px: int) -> Ints32:
    """The number from 1 on of the thing that each pixel of a mask (h, w) belongs to, and those near it; else 0."""
    reach = 2 * near_px + 1
    padded = np.pad(mask.view(np.uint8), reach)
    joined = cv2.dilate(padded, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (reach, reach)))
    return np.asarray(
        cv2.connectedComponents(joined[reach:-reach, reach:-reach], connectivity=8)[1], np.int32
    )


def _may_be_a_car(changed: Mask, m_per_px: float) -> bool:
    short_m, long_m = sorted(
        float(each) * m_per_px for each in cv2.minAreaRect(hull_of(changed))[1]
    )
    narrowest_m, longest_m = _CAR_M
    return short_m >= narrowest_m and long_m <= longest_m
