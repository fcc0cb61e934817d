"""Which differences of one frame are kept: those that the map and earlier pictures confirm."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from sorvolo.change.outlines import dilated
from sorvolo.geometry.arrays import Boxes, Floats, ImageGray, Mask

_MAP = 0  # the first of the opinions


# When differences confirm each other; scores and shares lie in 0 to 1.
LEAST_SCORE = 0.2  # from which on a difference is an opinion: an unsure one may confirm a sure one
SURE = 0.5  # score of a difference that others confirm
_VERY_SURE = 0.9  # score of one that nobody needs to confirm
_NEAR_PX = 9  # what leans a little another way lies a few pixels beside
_SHOWN = 0.3  # share of a difference that another picture must show to confirm it ...
_SEEN = 0.95  # ... and must see to be asked


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
    opinions = [
        _Opinion(each, sees, dilated(each.mask, _NEAR_PX)) for each, sees in (by_map, *earlier)
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
