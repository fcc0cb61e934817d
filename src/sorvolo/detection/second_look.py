"""Reports looked at again: cut out with what is around them, shown at other sizes and turned, to this model or another.

A boulder that looks like a person once seldom does so at other sizes and turned, nor to a judge that
learnt what fools the first look. Only what was reported is looked at again, all of a picture side by
side on one sheet a position, so that it costs little.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from sorvolo.detection.contract import POSITIONS, SecondLook
from sorvolo.detection.log_odds import log_odds
from sorvolo.detection.session import Seen
from sorvolo.detection.turning import turned, turned_back
from sorvolo.geometry.arrays import Floats, ImageRGB
from sorvolo.geometry.box_overlap import iou_matrix

Sees = Callable[[ImageRGB], Seen]
"""What a model finds in a picture, (H, W, 3) RGB, in the labels of the one that reported."""


@dataclass(frozen=True)
class SheetSettings:
    """How cut-outs are laid side by side on one picture. Weights hold for the values that they were fitted with."""

    # a cut-out's side: surroundings count, and a network's last level has 4 cells of it
    cell_px: int = 128
    columns: int = 8  # cut-outs in a row of a sheet
    share: float = 0.25  # of the picture's pixels that a position has at most; in a crowd the others keep their score
    cuts: tuple[int, int] = (
        8,
        96,
    )  # cut-outs of one picture in one position, best first: at least, and at most
    same_iou: float = 0.3  # a box that overlaps the first one so much is the same object
    surest: float = 0.98  # no first score counts for more, so that the second look can overrule it
    # no score counts for less, nor for more than 1 less this: log-odds stay within 7
    least_sure: float = 1e-3
    unseen: float = 0.02  # the score of what a look does not show: models report nothing below it
    filling: int = 114  # beyond the picture's edge, as in training


@dataclass(frozen=True, eq=False)
class _Cut:
    """A report cut out for one look: its row, its label, the picture (cell, cell, 3), its box (4,) px in there."""

    row: int
    label: int
    picture: ImageRGB
    box_px: Floats


def looked_again(
    seen: Seen,
    picture: ImageRGB,
    sees: Sees,
    hows: Mapping[int, SecondLook],
    settings: SheetSettings = SheetSettings(),
) -> Seen:
    """What was `seen` in a picture (H, W, 3), with the scores that a second look leaves, best first.

    `hows` names for labels how their reports are looked at again; others keep their score. Reports below `least` are
    not looked at and count as not seen again, so that they stay behind those that were not.
    """
    scores, again_odds = (
        seen.scores.copy(),
        np.full(len(seen.scores), log_odds(settings.unseen, settings.least_sure)),
    )
    looked_at = opinions(seen, picture, sees, hows, settings)
    for row, again in looked_at.items():
        again_odds[row] = log_odds(again, settings.least_sure).mean()
    for label, how in hows.items():
        rows = (seen.labels == label) & (seen.scores < how.least)
        rows[[row for row in looked_at if seen.labels[row] == label]] = True
        own_odds = log_odds(np.minimum(scores[rows], settings.surest), settings.least_sure)
        odds = how.shift + how.own * own_odds + how.again * again_odds[rows]
        scores[rows] = 1 / (1 + np.exp(-odds))
    order = np.argsort(-scores, kind="stable")
    return Seen(seen.boxes_px[order], scores[order], seen.labels[order])


def opinions(
    seen: Seen,
    picture: ImageRGB,
    sees: Sees,
    hows: Mapping[int, SecondLook],
    settings: SheetSettings = SheetSettings(),
) -> dict[int, Floats]:
    """The scores (looks in all positions,) of each report, by its row, for those that are looked at again."""
    cuts: list[_Cut] = []
    room = _most_cuts(picture, settings)
    for looks in _cuts(seen, picture, hows, settings):
        if len(cuts) + len(looks) > room:
            break
        cuts += looks
    if not cuts:
        return {}
    found: dict[int, list[float]] = {}
    for position in range(max(how.positions for how in hows.values())):
        shown = [
            _cut_in_position(each, position)
            for each in cuts
            if position < hows[each.label].positions
        ]
        for each, score in zip(shown, _scores(shown, sees, settings).tolist()):
            found.setdefault(each.row, []).append(score)
    return {row: np.array(scores) for row, scores in found.items()}


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


def _most_cuts(picture: ImageRGB, settings: SheetSettings) -> int:
    fewest, most = settings.cuts
    room = settings.share * picture.shape[0] * picture.shape[1] / settings.cell_px**2
    return int(min(max(room, fewest), most))


def _cuts(
    seen: Seen, picture: ImageRGB, hows: Mapping[int, SecondLook], settings: SheetSettings
) -> Iterator[list[_Cut]]:
    """The looks at each report that is looked at again, best reports first."""
    for row in np.argsort(-seen.scores, kind="stable").tolist():
        label, box_px = int(seen.labels[row]), seen.boxes_px[row].astype(float)
        how = hows.get(label)
        if how is not None and seen.scores[row] >= how.least:
            sides_px = how.sides_px(float(max(box_px[2:] - box_px[:2])))
            yield [
                _Cut(row, label, *cut_out(picture, box_px, side_px, settings))
                for side_px in sides_px
            ]


def cut_out(
    picture: ImageRGB, box_px: Floats, side_px: float, settings: SheetSettings = SheetSettings()
) -> tuple[ImageRGB, Floats]:
    """A box (4,) of a picture with its surroundings, (cell, cell, 3), its longer side `side_px`; its edges there."""
    cell = settings.cell_px
    reach = 0.5 * cell / side_px * float(max(box_px[2:] - box_px[:2]))
    middle = (box_px[:2] + box_px[2:]) / 2
    low, high = np.floor(middle - reach).astype(int), np.ceil(middle + reach).astype(int)
    size = int(max(high - low))
    start, end = np.maximum(low, 0), np.minimum(low + size, picture.shape[1::-1])
    part = picture[start[1] : end[1], start[0] : end[0]]
    way = cv2.INTER_AREA if size > cell else cv2.INTER_LINEAR
    into, until = np.rint((np.stack([start, end]) - low) * cell / size).astype(int)
    until = np.maximum(until, into + 1)
    shown = np.full((cell, cell, 3), settings.filling, np.uint8)
    width, height = (until - into).tolist()
    shown[into[1] : until[1], into[0] : until[0]] = cv2.resize(
        part, (width, height), interpolation=way
    )
    return shown, (box_px - np.tile(low, 2)) * cell / size


def _scores(cuts: Sequence[_Cut], sees: Sees, settings: SheetSettings) -> Floats:
    """(cuts,) what is made of each cut-out; all on one sheet."""
    cell, columns = settings.cell_px, min(settings.columns, len(cuts))
    rows = math.ceil(len(cuts) / columns)
    sheet = np.full((rows * cell, columns * cell, 3), settings.filling, np.uint8)
    boxes = np.zeros((len(cuts), 4), np.float32)
    for number, each in enumerate(cuts):
        top, left = (cell * place for place in divmod(number, columns))
        sheet[top : top + cell, left : left + cell] = each.picture
        boxes[number] = each.box_px + np.array([left, top, left, top])
    seen = sees(sheet)
    same = iou_matrix(boxes, seen.boxes_px) >= settings.same_iou
    same &= np.array([each.label for each in cuts])[:, None] == seen.labels[None]
    return np.where(same, seen.scores[None], 0.0).max(axis=1, initial=settings.unseen)
