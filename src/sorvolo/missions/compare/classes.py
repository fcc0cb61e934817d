"""What a change is, before and after: by objects that stand there, by sightings, by its own pictures."""

import math
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import cv2
import numpy as np

from sorvolo.geometry.arrays import Floats, ImageRGB, ImageRGBA, PointsM
from sorvolo.missions.flight.detector_protocol import ObjectDetector
from sorvolo.store.images import jpeg_from_image
from sorvolo.survey.findings import Change, ChangeKind, Patch
from sorvolo.survey.map_objects import MapObject
from sorvolo.survey.objects import TYPICAL_SIZE_M, Detections, Sighting

# When an object, a sighting or a detection names what a change is.
# an object's place may lie so far outside of the outline, beside a part of its own length
_BESIDE_M = 0.4
_LONGEST_S = 5.0  # before or after the time at which a moving change was where its outline is
_TURN = 0.4  # of the way it goes meanwhile: people turn
_LEAST_SIDE_PX = 160  # of a picture that a detector is shown
_LEAST_SHARE = 0.5  # of the box or of the change, whichever is smaller, that both have in common
# of a class's usual longest side, upright too, and what edges add, m: a change that is longer is more than it
_MOST_LENGTHS, _EDGES_M = 2.5, 1.0
_LEAST_SIDES = 0.5  # times its shortest usual side: a change that is shorter is a part of it
_LIKE_LENGTHS = 1.6  # times the other's, at most
LENIENT = 0.4  # times each class's score: that something is there is known already


def class_at(change: Change, things: Iterable[MapObject | Sighting]) -> str:
    """The class of the objects or sightings in a change's outline, or nearly, by their summed scores: the nearer in
    place and size, the more they count. "" where there is none.

    Objects that move are left out. A change that moves is looked for where it was at each sighting's time.
    """
    sums, moves = defaultdict[str, float](float), change.kind is ChangeKind.MOVING
    for each in things:
        meanwhile_m = np.zeros(2)
        if isinstance(each, MapObject):
            length_m = each.length_m if math.isfinite(each.length_m) else change.length_m
            is_then = not each.moving and not moves
        else:
            length_m, after_s = float(each.size_m[0]), (each.time_ns - change.last_seen_ns) / 1e9
            meanwhile_m = change.velocity_m_s * after_s
            is_then = not moves or abs(after_s) <= _LONGEST_S
        reach_m = _BESIDE_M + length_m / 4 + _TURN * math.hypot(*meanwhile_m)
        outside_m = max(_outside_m(change.outline_m, each.position_m - meanwhile_m), 0.0)
        if is_then and outside_m <= reach_m:
            ratio = abs(math.log(max(length_m, 0.1) / max(change.length_m, 0.1)))
            sums[each.label] += each.score / (1.0 + outside_m + ratio)
    return max(sums, key=sums.__getitem__, default="")


def object_of(change: Change) -> MapObject:
    """What came, or moves, as an object: its picture is the change's own."""
    rgba = change.patch.after
    return MapObject(
        change.id,
        change.class_after,
        change.score,
        change.centre_m,
        change.sigma_m,
        change.length_m,
        math.nan,
        change.views,
        change.views,
        change.first_seen_ns,
        change.last_seen_ns,
        change.kind is ChangeKind.MOVING,
        change.velocity_m_s,
        {change.class_after: 1.0},
        "",
        jpeg_from_image(np.where(rgba[..., 3:] > 0, rgba[..., :3], np.uint8(127))),
    )


def enlarged(rgba: ImageRGBA) -> tuple[ImageRGB, tuple[int, int]]:
    """The picture without alpha, wide enough for a detector; how far it begins to the right of and below its corner.

    What is unknown gets the mean colour of what is known, what lies around is mirrored.
    """
    known = rgba[..., 3] > 0
    rgb = rgba[..., :3].copy()
    rgb[~known] = rgb[known].mean(axis=0).astype(np.uint8)
    height, width = known.shape
    top, left = (max(0, _LEAST_SIDE_PX - side + 1) // 2 for side in (height, width))
    padded = cv2.copyMakeBorder(rgb, top, top, left, left, cv2.BORDER_REFLECT)
    return np.asarray(padded, np.uint8), (left, top)


def class_of_change(
    patch: Patch, seen: Detections, thresholds: Mapping[str, float], offset_px: tuple[int, int]
) -> str:
    """The class of the surest detection that covers the patch's change, in a picture that begins `offset_px` right of
    and below the patch's corner; "" where none does."""
    rows, columns = np.nonzero(patch.changed)
    left_px, top_px = offset_px
    changed_px = np.array([columns.min(), rows.min(), columns.max() + 1, rows.max() + 1], float)
    changed_px += [left_px, top_px, left_px, top_px]
    best, best_score = "", 0.0
    for box_px, name, score in zip(seen.boxes_px, seen.names, seen.scores):
        # What two boxes have in common, as a share of the smaller one.
        one = np.asarray(box_px, np.float64)
        low, high = np.maximum(one[:2], changed_px[:2]), np.minimum(one[2:], changed_px[2:])
        areas = np.prod(one[2:] - one[:2]), np.prod(changed_px[2:] - changed_px[:2])
        share = float(np.prod(np.clip(high - low, 0, None)) / max(min(areas), 1e-9))
        if score < LENIENT * thresholds[name] or share < _LEAST_SHARE:
            continue
        if share * score > best_score:
            best, best_score = name, share * float(score)
    return best


def _outside_m(outline_m: PointsM, place_m: Floats) -> float:
    """How far a place (2,) lies outside of an outline, negative inside."""
    ring = np.ascontiguousarray(outline_m - outline_m[0], np.float32)
    east, north = place_m - outline_m[0]
    return -float(cv2.pointPolygonTest(ring, (float(east), float(north)), True))


def _can_be(change: Change, name: str) -> bool:
    """Whether a thing of a class may be all of a change, and the change all of it: a person in front of a heap is not
    what the heap is, and a mirror's glint no car."""
    usual_m = TYPICAL_SIZE_M.get(name)
    if usual_m is None:
        return True
    least_m, most_m = _LEAST_SIDES * min(usual_m), _MOST_LENGTHS * max(usual_m) + _EDGES_M
    return least_m <= change.length_m <= most_m


_HAS_BEFORE = (ChangeKind.DISAPPEARED, ChangeKind.REPLACED)
_HAS_AFTER = (ChangeKind.APPEARED, ChangeKind.REPLACED, ChangeKind.MOVING)


class ChangeClasses:
    """Names what changes are. `known` are the objects that stood on the map before the flight.

    A change's own pictures are searched for `classes`; without any, for all that the model knows, also those that it
    reports on request alone: there the ground itself shows that something changed.
    """

    def __init__(
        self, detector: ObjectDetector, known: Sequence[MapObject], classes: Sequence[str] = ()
    ) -> None:
        self._detector, self._known, self._wanted = detector, known, tuple(classes) or None

    def final(
        self, change: Change, found: Sequence[MapObject], sightings: Sequence[Sighting]
    ) -> Change:
        """The change with its classes, "" where nothing is recognised: of the objects and sightings that were there before
        or after; else of what the detector finds in the change's own pictures.

        `found` and `sightings` are those of the flight, by its frames' final places. Where something left and a found
        object of about its size stands in its outline, or something came where a known one stood, it was replaced.
        """
        others = {ChangeKind.DISAPPEARED: found, ChangeKind.APPEARED: self._known}.get(
            change.kind, ()
        )
        least_m, most_m = change.length_m / _LIKE_LENGTHS, change.length_m * _LIKE_LENGTHS
        if any(
            not each.moving
            and _outside_m(change.outline_m, each.position_m) <= 0
            and least_m <= each.length_m <= most_m
            for each in others
        ):
            change = replace(change, kind=ChangeKind.REPLACED)
        before = after = ""
        if change.kind in _HAS_BEFORE:
            before = class_at(change, self._known) or self._in_picture(change, change.patch.before)
        if change.kind in _HAS_AFTER:
            after = class_at(change, [*found, *sightings]) or self._in_picture(
                change, change.patch.after
            )
        before, after = (name if _can_be(change, name) else "" for name in (before, after))
        return replace(change, class_before=before, class_after=after)

    def _in_picture(self, change: Change, rgba: ImageRGBA) -> str:
        """The class that the detector finds where a picture of the change shows it; "" where it finds none."""
        if not change.patch.changed.any() or not (rgba[..., 3] > 0).any():
            return ""
        picture, offset_px = enlarged(rgba)
        thresholds = self._detector.thresholds_for(picture)
        seen = self._detector.detect(
            picture,
            tiles="auto",
            m_per_px=change.patch.m_per_px,
            least_score=LENIENT * min(thresholds.values(), default=0.5),
            classes=self._wanted,
            is_part=True,
        )
        return class_of_change(change.patch, seen, thresholds, offset_px)
