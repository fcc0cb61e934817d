"""Reports looked at again: cut out with what is around them, shown at other sizes and turned, to this model or another.

A boulder that looks like a person once seldom does so at other sizes (decision 0049) and turned, nor to a judge that
learnt what fools the first look (decision 0082). Shown larger, a person's box is seen better too, and what the first
look took for two is one (decision 0083). Only what was reported is looked at again, all of a picture side by side on
one sheet a position, so that it costs little.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from sorvolo.detection.contract import POSITIONS, SecondLook
from sorvolo.detection.session import Seen
from sorvolo.detection.turning import turned, turned_back
from sorvolo.geometry.arrays import Floats, ImageRGB, Mask
from sorvolo.geometry.box_overlap import iou_matrix

Sees = Callable[[ImageRGB], Seen]
"""What a model finds in a picture, (H, W, 3) RGB, in the labels of the one that reported."""


@dataclass(frozen=True)
class SheetSettings:
    """How cut-outs are laid side by side on one picture. Weights hold for the values that they were fitted with."""

    cell_px: int = 128  # a cut-out's side: surroundings count, and a network's last level has 4 cells of it
    columns: int = 8  # cut-outs in a row of a sheet
    share: float = 0.25  # of the picture's pixels that a position has at most; in a crowd the others keep their score
    cuts: tuple[int, int] = (8, 96)  # cut-outs of one picture in one position, best first: at least, and at most
    same_iou: float = 0.15  # the same object: seen larger, a box may be another in size and place (decision 0083)
    one_iou: float = 0.5  # boxes that overlap more are of one object, as COCO counts them
    surest: float = 0.98  # no first score counts for more, so that the second look can overrule it (decision 0075)
    unseen: float = 0.02  # the score of what a look does not show: models report nothing below it
    filling: int = 114  # beyond the picture's edge, as in training


@dataclass(frozen=True, eq=False)
class _Cut:
    """A report cut out for one look: its row, its label, the picture (cell, cell, 3), its box (4,) px in there."""

    row: int
    label: int
    picture: ImageRGB
    box_px: Floats


@dataclass(frozen=True, eq=False)
class Opinion:
    """What the looks see of a report: scores (looks,), and boxes (looks, 4) px in the picture.

    Where a look does not see it, the box is the report's own.
    """

    scores: Floats
    boxes_px: Floats


def looked_again(
    seen: Seen, picture: ImageRGB, sees: Sees, hows: Mapping[int, SecondLook],
    settings: SheetSettings = SheetSettings(),
) -> Seen:
    """What was `seen` in a picture (H, W, 3), with the scores and boxes that a second look leaves, best first.

    `hows` names for labels how their reports are looked at again; others stay as they are. Reports below `least` are
    not looked at and count as not seen again, so that they stay behind those that were not.
    """
    scores, again_odds = seen.scores.copy(), np.full(len(seen.scores), _odds(settings.unseen))
    looked_at = opinions(seen, picture, sees, hows, settings)
    for row, opinion in looked_at.items():
        again_odds[row] = _odds(opinion.scores).mean()
    for label, how in hows.items():
        rows = (seen.labels == label) & (seen.scores < how.least)
        rows[[row for row in looked_at if seen.labels[row] == label]] = True
        own_odds = _odds(np.minimum(scores[rows], settings.surest))
        odds = how.shift + how.own * own_odds + how.again * again_odds[rows]
        scores[rows] = 1 / (1 + np.exp(-odds))
    placed = placed_again(seen, looked_at, hows, settings)
    order = np.argsort(-scores, kind="stable")
    found = Seen(placed.boxes_px[order], scores[order], seen.labels[order])
    kept = _each_once(found, (placed.boxes_px != seen.boxes_px).any(axis=1)[order], settings.one_iou)
    return Seen(found.boxes_px[kept], found.scores[kept], found.labels[kept])


def opinions(
    seen: Seen, picture: ImageRGB, sees: Sees, hows: Mapping[int, SecondLook],
    settings: SheetSettings = SheetSettings(),
) -> dict[int, Opinion]:
    """What all looks in all positions make of each report, by its row, for those that are looked at again."""
    cuts: list[_Cut] = []
    room = _most_cuts(picture, settings)
    for looks in _cuts(seen, picture, hows, settings):
        if len(cuts) + len(looks) > room:
            break
        cuts += looks
    if not cuts:
        return {}
    found: dict[int, list[tuple[float, Floats]]] = {}
    for position in range(max(how.positions for how in hows.values())):
        mine = [each for each in cuts if position < hows[each.label].positions]
        shown = [
            _Cut(each.row, each.label, in_position(each.picture, position),
                 box_in_position(each.box_px, position, settings.cell_px))
            for each in mine
        ]
        for cut, score, there_px in zip(mine, *_seen_on_sheet(shown, sees, settings)):
            there_px = box_back(there_px, position, settings.cell_px)
            box_px = _box_from_cut(there_px, cut, seen.boxes_px[cut.row], picture)
            found.setdefault(cut.row, []).append((float(score), box_px))
    return {
        row: Opinion(np.array([score for score, _ in looks]), np.stack([box_px for _, box_px in looks]))
        for row, looks in found.items()
    }


def placed_again(
    seen: Seen, looked_at: Mapping[int, Opinion], hows: Mapping[int, SecondLook],
    settings: SheetSettings = SheetSettings(),
) -> Seen:
    """What was seen, with new boxes for reports that are large enough and that the looks of `opinions` see elsewhere.

    Where the looks' mean box is the report's own, near enough, the own one is the better of both.
    """
    boxes = seen.boxes_px.copy()
    for row, opinion in looked_at.items():
        if _longer_px(seen.boxes_px[row]) >= hows[int(seen.labels[row])].placed_from_px:
            box_px = opinion.boxes_px.mean(axis=0, keepdims=True)
            if iou_matrix(boxes[row : row + 1], box_px)[0, 0] <= settings.one_iou:
                boxes[row] = box_px[0]
    return Seen(boxes, seen.scores, seen.labels)


def _each_once(seen: Seen, is_placed: Mask, one_iou: float) -> list[int]:
    """Rows of what is seen, best first, without those that a better one of their label covers since either has a new
    box."""
    kept: list[int] = []
    overlaps = iou_matrix(seen.boxes_px, seen.boxes_px) > one_iou
    for row in range(len(seen.scores)):
        better = [each for each in kept if overlaps[row, each] and seen.labels[row] == seen.labels[each]]
        if not any(is_placed[row] or is_placed[each] for each in better):
            kept.append(row)
    return kept


def in_position(cell: ImageRGB, position: int) -> ImageRGB:
    """A cut-out (S, S, 3) in one of POSITIONS."""
    quarters, is_mirrored = POSITIONS[position]
    way = turned(cell, quarters)
    return np.ascontiguousarray(way[:, ::-1]) if is_mirrored else way


def box_in_position(box_px: Floats, position: int, side_px: int) -> Floats:
    """A box (4,) px of a cut-out of this side, where it lies once that is in one of POSITIONS."""
    quarters, is_mirrored = POSITIONS[position]
    there_px = turned_back(box_px[None].astype(np.float32), -quarters, (side_px, side_px))[0]
    return _mirrored(there_px, side_px) if is_mirrored else there_px


def box_back(box_px: Floats, position: int, side_px: int) -> Floats:
    """A box (4,) px of a cut-out in one of POSITIONS, where it lies in the cut-out as it was."""
    quarters, is_mirrored = POSITIONS[position]
    box_px = _mirrored(box_px, side_px) if is_mirrored else box_px
    return turned_back(box_px[None].astype(np.float32), quarters, (side_px, side_px))[0]


def _mirrored(box_px: Floats, side: int) -> Floats:
    left, top, right, bottom = box_px
    return np.array([side - right, top, side - left, bottom])


def _box_from_cut(box_px: Floats, cut: _Cut, own_px: Floats, picture: ImageRGB) -> Floats:
    """A box (4,) px of a cut-out in the picture that it was cut from, where the report's lies at `own_px`."""
    scale = _longer_px(own_px) / _longer_px(cut.box_px)
    height, width = picture.shape[:2]
    return np.clip(own_px + (box_px - cut.box_px) * scale, 0, [width, height, width, height])


def _longer_px(box_px: Floats) -> float:
    return float(max(box_px[2:] - box_px[:2]))


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
            sides_px = how.sides_px(_longer_px(box_px))
            yield [_Cut(row, label, *cut_out(picture, box_px, side_px, settings)) for side_px in sides_px]


def cut_out(
    picture: ImageRGB, box_px: Floats, side_px: float, settings: SheetSettings = SheetSettings()
) -> tuple[ImageRGB, Floats]:
    """A box (4,) of a picture with its surroundings, (cell, cell, 3), its longer side `side_px`; its edges there."""
    cell = settings.cell_px
    reach = 0.5 * cell / side_px * _longer_px(box_px)
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
    shown[into[1] : until[1], into[0] : until[0]] = cv2.resize(part, (width, height), interpolation=way)
    return shown, (box_px - np.tile(low, 2)) * cell / size


def _seen_on_sheet(cuts: Sequence[_Cut], sees: Sees, settings: SheetSettings) -> tuple[Floats, Floats]:
    """What is seen of each cut-out, all on one sheet: (cuts,) scores and (cuts, 4) boxes px in the cut-outs."""
    cell, columns = settings.cell_px, min(settings.columns, len(cuts))
    rows = math.ceil(len(cuts) / columns)
    sheet = np.full((rows * cell, columns * cell, 3), settings.filling, np.uint8)
    corners = np.zeros((len(cuts), 4), np.float32)
    for number, each in enumerate(cuts):
        top, left = (cell * place for place in divmod(number, columns))
        sheet[top : top + cell, left : left + cell] = each.picture
        corners[number] = [left, top, left, top]
    own = np.array([each.box_px for each in cuts], np.float32)
    seen = sees(sheet)
    same = iou_matrix(own + corners, seen.boxes_px) >= settings.same_iou
    same &= np.array([each.label for each in cuts])[:, None] == seen.labels[None]
    scores, boxes = np.full(len(cuts), settings.unseen), own.astype(float)
    for row in np.flatnonzero(same.any(axis=1)):
        best = int(np.where(same[row], seen.scores, -1.0).argmax())
        scores[row] = max(float(seen.scores[best]), settings.unseen)
        boxes[row] = seen.boxes_px[best] - corners[row]
    return scores, boxes


def _odds(scores: Floats | float) -> Floats:
    inside = np.clip(scores, 1e-3, 1 - 1e-3)
    return np.asarray(np.log(inside / (1 - inside)))
