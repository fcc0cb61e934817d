"""Which planted things a map would have reported: the rule of `standing`, asked of frames whose answers are known."""

from collections.abc import Mapping, Sequence

import numpy as np

from sorvolo.geometry.arrays import BoxesPx
from sorvolo.survey.mosaic import PlacedFrame
from sorvolo.tracking.laying import LaidSighting
from sorvolo.tracking.standing import Standing, fuse

_AROUND = 0.3  # of a plant's sides: so far beside its box the middle of a detection may lie


def reported_plants(
    laid: Sequence[LaidSighting],
    frames: Sequence[PlacedFrame],
    boxes_px: Mapping[int, BoxesPx],
    labels: Sequence[str],
    least: Mapping[str, float] | None = None,
) -> set[int]:
    """Which plants (rows) are reported as an object of their class, at least half of whose sightings are theirs.

    `least` as `fuse` takes it. `boxes_px` has each frame's boxes of the plants, (N, 4), by the frame's index; NaN where
    a plant is out of sight.
    """
    reported: set[int] = set()
    for each in fuse(laid, frames, least).objects:
        owner = shown_plant(each, laid, boxes_px)
        if owner is not None and labels[owner] == each.label:
            reported.add(owner)
    return reported


def shown_plant(
    each: Standing, laid: Sequence[LaidSighting], boxes_px: Mapping[int, BoxesPx]
) -> int | None:
    """The plant (row) that most of an object's known sightings show, if at least half of all are known."""
    owners = [_owner(laid[k], boxes_px) for k in each.members]
    known = [owner for owner in owners if owner is not None]
    return max(set(known), key=known.count) if known and 2 * len(known) >= len(owners) else None


def _owner(sighting: LaidSighting, boxes_px: Mapping[int, BoxesPx]) -> int | None:
    """The plant that a sighting shows; None for what stood there before."""
    seen = sighting.sighting
    boxes = boxes_px.get(seen.frame_index)
    if boxes is None or not len(boxes):
        return None
    middle = (seen.box_px[:2] + seen.box_px[2:]) / 2
    sides = boxes[:, 2:] - boxes[:, :2]
    apart = np.abs((boxes[:, :2] + boxes[:, 2:]) / 2 - middle) / np.maximum(sides, 1.0)
    with np.errstate(invalid="ignore"):
        inside = (apart < 0.5 + _AROUND).all(axis=1)
    if not inside.any():
        return None
    nearest = np.where(inside, apart.max(axis=1), np.inf)
    return int(nearest.argmin())
