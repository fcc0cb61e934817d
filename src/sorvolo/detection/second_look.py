"""Reports looked at again: cut out with what is around them, shown at other sizes and turned, to this model or another.

A boulder that looks like a person once seldom does so at other sizes and turned, nor to a judge that
learnt what fools the first look. Only what was reported is looked at again, some side by side on a
sheet, so that it costs little.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from sorvolo.detection.contract import POSITIONS, SecondLook
from sorvolo.detection.fusing import log_odds, turned, turned_back
from sorvolo.detection.session import Seen
from sorvolo.geometry.arrays import Floats, ImageRGB
from sorvolo.geometry.box_overlap import iou_matrix

Sees = Callable[[ImageRGB], Seen]
"""What a model finds in a picture, (H, W, 3) RGB, in the labels of the one that reported."""


# How cut-outs are laid side by side on one picture. Weights hold for the values that they were fitted with.
CELL_PX = 128  # a cut-out's side: surroundings count, and a network's last level has 4 cells of it
_ON_A_SHEET = 8  # cut-outs, in a row; all of a large photo's at once take 0.3 GB and longer
SHARE = 0.25  # of the picture's pixels that a position has at most; in a crowd the others keep their score
_CUTS = (8, 96)  # cut-outs of one picture in one position, best first: at least, and at most
SAME_IOU = 0.3  # a box that overlaps the first one so much is the same object
SUREST = 0.98  # no first score counts for more, so that the second look can overrule it
# no score counts for less, nor for more than 1 less this: log-odds stay within 7
_LEAST_SURE = 1e-3
UNSEEN = 0.02  # the score of what a look does not show: models report nothing below it
_FILLING = 114  # beyond the picture's edge, as in training


@dataclass(frozen=True, eq=False)
class _Cut:
    """A report cut out for one look: its row, its label, the picture (cell, cell, 3), its box (4,) px in there."""

    row: int
    label: int
    picture: ImageRGB
    box_px: Floats


def rescore(
    seen: Seen,
    picture: ImageRGB,
    sees: Sees,
    second_look_by_label: Mapping[int, SecondLook],
) -> Seen:
    """What was `seen` in a picture (H, W, 3), with the scores that a second look leaves, best first.

    `second_look_by_label` names for labels how their reports are looked at again; others keep their score. Reports below `least` are
    not looked at and count as not seen again, so that they stay behind those that were not.
    """
    scores = seen.scores.copy()
    again_odds = np.full(len(scores), log_odds(UNSEEN, _LEAST_SURE))
    looked_at = opinions(seen, picture, sees, second_look_by_label)
    for row, again in looked_at.items():
        again_odds[row] = log_odds(again, _LEAST_SURE).mean()
    for label, how in second_look_by_label.items():
        rows = (seen.labels == label) & (seen.scores < how.least)
        rows[[row for row in looked_at if seen.labels[row] == label]] = True
        own_odds = log_odds(np.minimum(scores[rows], SUREST), _LEAST_SURE)
        odds = how.shift + how.own * own_odds + how.again * again_odds[rows]
        scores[rows] = 1 / (1 + np.exp(-odds))
    order = np.argsort(-scores, kind="stable")
    return Seen(seen.boxes_px[order], scores[order], seen.labels[order])


def opinions(
    seen: Seen,
    picture: ImageRGB,
    sees: Sees,
    second_look_by_label: Mapping[int, SecondLook],
) -> dict[int, Floats]:
    """The scores (looks in all positions,) of each report, by its row, for those that are looked at again."""
    fewest, most = _CUTS
    share = SHARE * picture.shape[0] * picture.shape[1] / CELL_PX**2
    room = int(min(max(share, fewest), most))
    cuts: list[_Cut] = []
    for row in np.argsort(-seen.scores, kind="stable").tolist():
        label, box_px = int(seen.labels[row]), seen.boxes_px[row].astype(float)
        how = second_look_by_label.get(label)
        if how is None or seen.scores[row] < how.least:
            continue
        sides_px = how.sides_px(float(max(box_px[2:] - box_px[:2])))
        if len(cuts) + len(sides_px) > room:
            break
        cuts += [_Cut(row, label, *cut_out(picture, box_px, side_px)) for side_px in sides_px]
    scores: dict[int, list[float]] = {}
    for position in range(max((how.positions for how in second_look_by_label.values()), default=0)):
        shown = [
            _cut_in_position(cut, position)
            for cut in cuts
            if position < second_look_by_label[cut.label].positions
        ]
        for first in range(0, len(shown), _ON_A_SHEET):
            sheet = shown[first : first + _ON_A_SHEET]
            for cut, score in zip(sheet, _scores(sheet, sees).tolist()):
                scores.setdefault(cut.row, []).append(score)
    return {row: np.array(some) for row, some in scores.items()}


def in_position(cell: ImageRGB, position: int) -> ImageRGB:
    """A cut-out (S, S, 3) in one of POSITIONS."""
    quarters, is_mirrored = POSITIONS[position]
    way = turned(cell, quarters)
    return np.ascontiguousarray(way[:, ::-1]) if is_mirrored else way


def _cut_in_position(cut: _Cut, position: int) -> _Cut:
    quarters, is_mirrored = POSITIONS[position]
    side = cut.picture.shape[0]
    left, top, right, bottom = turned_back(
        cut.box_px[None].astype(np.float32), -quarters, (side, side)
    )[0]
    box_px = np.array(
        [side - right, top, side - left, bottom] if is_mirrored else [left, top, right, bottom]
    )
    return _Cut(cut.row, cut.label, in_position(cut.picture, position), box_px)


def cut_out(picture: ImageRGB, box_px: Floats, side_px: float) -> tuple[ImageRGB, Floats]:
    """A box (4,) of a picture with its surroundings, (cell, cell, 3), its longer side `side_px`; its edges there."""
    cell = CELL_PX
    reach = 0.5 * cell / side_px * float(max(box_px[2:] - box_px[:2]))
    middle = (box_px[:2] + box_px[2:]) / 2
    low, high = np.floor(middle - reach).astype(int), np.ceil(middle + reach).astype(int)
    size = int(max(high - low))
    start, end = np.maximum(low, 0), np.minimum(low + size, picture.shape[1::-1])
    part = picture[start[1] : end[1], start[0] : end[0]]
    way = cv2.INTER_AREA if size > cell else cv2.INTER_LINEAR
    into, until = np.rint((np.stack([start, end]) - low) * cell / size).astype(int)
    until = np.maximum(until, into + 1)
    shown = np.full((cell, cell, 3), _FILLING, np.uint8)
    width, height = (until - into).tolist()
    shown[into[1] : until[1], into[0] : until[0]] = cv2.resize(
        part, (width, height), interpolation=way
    )
    return shown, (box_px - np.tile(low, 2)) * cell / size


def _scores(cuts: Sequence[_Cut], sees: Sees) -> Floats:
    """(cuts,) what is made of each cut-out; all on one sheet."""
    sheet = np.concatenate([each.picture for each in cuts], axis=1)
    lefts = CELL_PX * np.arange(len(cuts))
    boxes = np.array([each.box_px for each in cuts])
    boxes[:, 0::2] += lefts[:, None]
    seen = sees(sheet)
    same = iou_matrix(boxes, seen.boxes_px) >= SAME_IOU
    same &= np.array([each.label for each in cuts])[:, None] == seen.labels[None]
    return np.where(same, seen.scores[None], 0.0).max(axis=1, initial=UNSEEN)
