"""What is believed of the differences that one frame shows against the map and against earlier pictures."""

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np

from sorvolo.geometry.arrays import Boxes, Floats, ImageGray, Mask

LEAST_SURENESS = 0.2  # a picture that shows a difference so surely bears out one that shows it surely
_SURE, _VERY_SURE = 0.5, 0.9
_NEAR_PX = 9  # what leans a little another way lies a few pixels beside
_LEANS_PX = 16  # what leans out of an earlier picture lies so far beside
_SHOWN, _SEEN = 0.3, 0.95  # shares of a difference that another picture shows, and must see to be asked
_MAP = 0  # the first of the opinions


class Difference(NamedTuple):
    """What one comparison of two aligned pictures says: mask (0 or 255), boxes (N, 4), scores (N,) in 0 to 1."""

    mask: ImageGray
    boxes: Boxes
    scores: Floats


def believed(by_map: tuple[Difference, Mask], earlier: Sequence[tuple[Difference, Mask]]) -> Difference:
    """The differences of a frame from the map or from an earlier picture that the others bear out.

    Each opinion comes with the ground (h, w) that it sees, all in the frame's pixels, and with all differences from
    `LEAST_SURENESS` on. One opinion must show a difference surely; all earlier pictures that see its place must show
    it as well, but one that ends right beside it is not asked: what leans out of a picture has no outline there. What
    the map does not show needs two of them, or a single one that is very sure. Nothing is believed where the map knows
    no ground.
    """
    opinions = [by_map, *earlier]
    known = by_map[1]
    window = np.ones((_NEAR_PX, _NEAR_PX), np.uint8)
    near = [cv2.dilate(each.mask, window) > 0 for each, _ in opinions]
    mask = np.zeros_like(by_map[0].mask)
    boxes, scores = [], []
    for own, (opinion, _) in enumerate(opinions):
        told = mask > 0  # by others: two regions of one opinion are two things, though boxes overlap
        for k in np.flatnonzero(opinion.scores >= _SURE):
            x, y, w, h = opinion.boxes[k]
            part = np.s_[y : y + h, x : x + w]
            shown = (opinion.mask[part] > 0) & known[part]
            count = int(np.count_nonzero(shown))
            if count == 0 or np.count_nonzero(shown & told[part]) > _SHOWN * count:
                continue  # believed already
            answers = {}
            for other, (_, sees) in enumerate(opinions):
                if other != own and np.count_nonzero(shown & sees[part]) > _SEEN * count:
                    shows = np.count_nonzero(shown & near[other][part]) > _SHOWN * count
                    if shows or other == _MAP or _ends_far_from(sees, opinion.boxes[k]):
                        answers[other] = shows
            is_on_map = answers.pop(_MAP, own == _MAP)
            if all(answers.values()) and (is_on_map or answers or opinion.scores[k] >= _VERY_SURE):
                mask[part] |= shown.view(np.uint8) * np.uint8(255)
                boxes.append(opinion.boxes[k])
                scores.append(opinion.scores[k])
    return Difference(mask, np.array(boxes, np.int64).reshape(-1, 4), np.array(scores, np.float64))


def _ends_far_from(sees: Mask, box: Sequence[int]) -> bool:
    """Whether what a picture sees (h, w) reaches `_LEANS_PX` beyond a box x, y, w, h all around."""
    x, y, w, h = (int(each) for each in box)
    around = sees[max(0, y - _LEANS_PX) : y + h + _LEANS_PX, max(0, x - _LEANS_PX) : x + w + _LEANS_PX]
    return bool(np.count_nonzero(around) > _SEEN * around.size)
