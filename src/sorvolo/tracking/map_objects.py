"""From a flight's sightings, laid on the ground by its frames' final places, to the objects on its map."""

import math
from collections.abc import Mapping, Sequence

import numpy as np

from sorvolo.geometry.arrays import BoxesPx, Floats
from sorvolo.survey.map_objects import MapObject
from sorvolo.survey.mosaic import PlacedFrame
from sorvolo.tracking.laying import LaidSighting
from sorvolo.tracking.sizes import impossible_beside_cars
from sorvolo.tracking.standing import Standing, fuse


def objects_on_map(
    laid: Sequence[LaidSighting],
    crops: Sequence[bytes],
    frames: Sequence[PlacedFrame],
    flight_id: str,
    *,
    has_metres: bool,
    least: Mapping[str, float] | None = None,
) -> tuple[tuple[MapObject, ...], int]:
    """Each object once, and how many sightings belong to none of them.

    `crops` are the pictures, JPEG, around each sighting; `least` is the score from which on a frame reports each class:
    weaker sightings are evidence only.

    Without metres sizes are left out, and so are sightings of a size that their class cannot have beside the cars.
    """
    if not has_metres and laid:
        sides = np.array([each.sides_m for each in laid])
        out = impossible_beside_cars(
            [each.sighting.label for each in laid], sides, np.array([each.is_cut for each in laid])
        )
        kept = np.flatnonzero(~out).tolist()
        laid, crops = [laid[k] for k in kept], [crops[k] for k in kept]
    fused = fuse(laid, frames, least)
    # How far the frames lie from their fixes, per axis: what is known of a place where the method
    # gives none.
    apart_m: Floats = np.array([each.gps_residual_m[:2] for each in frames]).reshape(-1, 2)
    apart_m = apart_m[np.isfinite(apart_m).all(axis=1)]
    flight_sigma_m = (
        float(np.sqrt((apart_m**2).sum(axis=1).mean() / 2)) if len(apart_m) else math.nan
    )
    sigmas_m = {
        each.index: each.sigma_m if math.isfinite(each.sigma_m) else flight_sigma_m
        for each in frames
    }
    objects = (
        _map_object(each, f"{flight_id}-o{number}", laid, crops, sigmas_m, has_metres=has_metres)
        for number, each in enumerate(fused.objects, start=1)
    )
    return tuple(objects), fused.dropped


def _map_object(
    each: Standing,
    object_id: str,
    laid: Sequence[LaidSighting],
    crops: Sequence[bytes],
    sigmas_m: Mapping[int, float],
    *,
    has_metres: bool,
) -> MapObject:
    sightings = [laid[k].sighting for k in each.members]
    frames = {sighting.frame_index for sighting in sightings}
    shared_m = float(np.median([sigmas_m[index] for index in frames]))
    length_m, width_m = each.size_m if has_metres else (math.nan, math.nan)
    sigma_m = math.hypot(shared_m, each.sigma_m) if has_metres else math.nan
    return MapObject(
        object_id,
        each.label,
        each.score,
        each.position_m,
        sigma_m,
        float(length_m),
        float(width_m),
        len(frames),
        each.possible_views,
        min(sighting.time_ns for sighting in sightings),
        max(sighting.time_ns for sighting in sightings),
        each.moves,
        each.velocity_m_s,
        each.class_scores,
        laid[each.best].sighting.frame_name,
        crops[each.best],
    )


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
