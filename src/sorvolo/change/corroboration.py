"""Which differences of one frame are kept: those that the map and earlier pictures confirm."""

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np

from sorvolo.change.light import OCTAVES
from sorvolo.geometry.arrays import Boxes, Floats, Floats32, ImageGray, ImageRGB, Mask

_MAP = 0  # the first of the opinions


# When differences confirm each other; scores and shares lie in 0 to 1.
LEAST_SCORE = 0.2  # from which on a difference is an opinion: an unsure one may confirm a sure one
SURE = 0.5  # score of a difference that others confirm
_VERY_SURE = 0.9  # score of one that nobody needs to confirm
_NEAR_PX = 9  # what leans a little another way lies a few pixels beside
_SHOWN = 0.3  # share of a difference that another picture must show to confirm it ...
_SEEN = 0.95  # ... and must see to be asked


# What leans another way on a picture of the same date. Lengths in px of the small pictures.
_SIDE_PX = 320  # longest side at which pictures are looked at
_WINDOW_PX = 11  # over which structure is compared
_BETWEEN_PX = (1, 7)  # structure is what lies between these sizes
_MOST_DETAIL = 0.2  # octaves: the rim of a shadow is no more than a coarse texture
# grey levels of detail that noise and compression make, in the darker of both pictures
_NOISE_LEVELS = 1.5
_LEANS = 0.3  # likeness below which ground leans ...
_ROUGH = 6.0  # ... where its detail has so many times the power of noise


class Difference(NamedTuple):
    """What differs between two aligned pictures: mask (0 or 255), boxes (N, 4), scores (N,) in 0 to 1."""

    mask: ImageGray
    boxes: Boxes
    scores: Floats


class _Opinion(NamedTuple):
    difference: Difference
    sees: Mask  # (h, w) the ground that it knows
    near: Mask  # (h, w) what differs, and a little around


def believed(
    by_map: tuple[Difference, Mask], earlier: Sequence[tuple[Difference, Mask]]
) -> Difference:
    """The differences of a frame from the map or from an earlier picture that the others confirm.

    Each opinion comes with the ground (h, w) that it sees, all in the frame's pixels, and with all differences from
    the least score on. One opinion must show a difference surely; all earlier pictures that see its place must show
    it as well. What the map does not show needs two of them, or a single one that is very sure. Nothing is kept where
    the map knows no ground.
    """
    window = np.ones((_NEAR_PX, _NEAR_PX), np.uint8)
    opinions = [
        _Opinion(each, sees, cv2.dilate(each.mask, window) > 0) for each, sees in (by_map, *earlier)
    ]
    known = by_map[1]
    mask = np.zeros_like(by_map[0].mask)
    boxes, scores = [], []
    for own, opinion in enumerate(opinions):
        kept = (
            mask > 0
        )  # of others: two regions of one opinion are two things, though boxes overlap
        for k in np.flatnonzero(opinion.difference.scores >= SURE):
            x, y, w, h = opinion.difference.boxes[k]
            part = np.s_[y : y + h, x : x + w]
            shown = (opinion.difference.mask[part] > 0) & known[part]
            count = int(np.count_nonzero(shown))
            if count == 0 or np.count_nonzero(shown & kept[part]) > _SHOWN * count:
                continue
            if _is_confirmed(shown, part, own, opinions, opinion.difference.scores[k]):
                mask[part] |= shown.view(np.uint8) * np.uint8(255)
                boxes.append(opinion.difference.boxes[k])
                scores.append(opinion.difference.scores[k])
    return Difference(mask, np.array(boxes, np.int64).reshape(-1, 4), np.array(scores, np.float64))


def unwitnessed(by_map: Difference, seen: Sequence[Mask]) -> list[tuple[slice, slice]]:
    """The parts of the picture with sure differences from the map that no earlier picture shows whole.

    The map is a mosaic: a seam through a thing tears it, and only a picture in one piece can distinguish that from a
    change. `seen` (h, w) is what each earlier picture shows.
    """
    parts = []
    for x, y, w, h in by_map.boxes[by_map.scores >= SURE]:
        part = np.s_[y : y + h, x : x + w]
        if not any(is_whole(by_map.mask, part, each) for each in seen):
            parts.append(part)
    return parts


def is_whole(mask: ImageGray, part: tuple[slice, slice], seen: Mask) -> bool:
    """Whether a picture that shows the `seen` ground shows all that differs in a part of it."""
    shown = mask[part] > 0
    return bool(np.count_nonzero(shown & seen[part]) > _SEEN * np.count_nonzero(shown))


def _is_confirmed(
    shown: Mask, part: tuple[slice, slice], own: int, opinions: Sequence[_Opinion], score: float
) -> bool:
    """Whether the opinions that see a part of the picture confirm what one, the `own`, shows there."""
    count = np.count_nonzero(shown)
    answers = {
        other: np.count_nonzero(shown & opinion.near[part]) > _SHOWN * count
        for other, opinion in enumerate(opinions)
        if other != own and np.count_nonzero(shown & opinion.sees[part]) > _SEEN * count
    }
    is_on_map = answers.pop(_MAP, own == _MAP)
    return all(answers.values()) and bool(is_on_map or answers or score >= _VERY_SURE)


def level_of(picture: ImageRGB) -> Floats32:
    """How bright a picture, (h, w, 3), is, in octaves, at the small size."""
    height, width = picture.shape[:2]
    scale = min(1.0, _SIDE_PX / max(height, width))
    size = max(1, round(width * scale)), max(1, round(height * scale))
    small = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
    return np.asarray(cv2.LUT(small, OCTAVES).mean(axis=2), np.float32)


def leaning(reference: Floats32, picture: ImageRGB, seen: Mask) -> Mask:
    """(h, w) where two pictures of one date, (h, w, 3), have structure and not the same one: crowns and walls that lean
    another way. Such ground counts as the same. The first is given by its `level_of`, `seen` is where both show
    the ground."""
    height, width = seen.shape
    likeness, rough = _structure(reference, level_of(picture))
    found = (likeness < _LEANS) & (rough > _ROUGH)
    window = np.ones((_WINDOW_PX, _WINDOW_PX), np.uint8)
    whole = cv2.morphologyEx(found.view(np.uint8), cv2.MORPH_CLOSE, window)
    return np.asarray(
        (cv2.resize(whole, (width, height), interpolation=cv2.INTER_NEAREST) > 0) & seen
    )


def _structure(before: Floats32, after: Floats32) -> tuple[Floats32, Floats32]:
    """The best correlation of detail over shifts of a pixel, and how many times as strong as noise it is where there is
    less of it."""
    window, most = (_WINDOW_PX, _WINDOW_PX), np.float32(_MOST_DETAIL)
    fine, coarse = ((side, side) for side in _BETWEEN_PX)
    details = [
        np.clip(cv2.blur(each, fine) - cv2.blur(each, coarse), -most, most)
        for each in (before, after)
    ]
    noise = np.square(np.float32(_NOISE_LEVELS / np.log(2)) * np.exp2(-np.minimum(before, after)))
    power = [cv2.blur(each * each + noise, window) for each in details]
    best = np.full(before.shape, -1.0, np.float32)
    shifted, their_power = (
        cv2.copyMakeBorder(each, 1, 1, 1, 1, cv2.BORDER_REFLECT_101)
        for each in (details[0], power[0])
    )
    height, width = before.shape
    for dy in range(3):
        for dx in range(3):
            part = np.s_[dy : dy + height, dx : dx + width]
            products = cv2.blur(details[1] * shifted[part], window)
            np.maximum(best, products / np.sqrt(power[1] * their_power[part]), out=best)
    return best, np.asarray(np.minimum(*power) / cv2.blur(noise, window), np.float32)
