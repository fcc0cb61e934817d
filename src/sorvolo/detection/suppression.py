"""One box for each object where neighbouring tiles of a picture both saw it, or each a part of it."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from sorvolo.detection.session import Seen
from sorvolo.geometry.arrays import BoxesPx, Floats, Labels, Mask, Numbers, Rows
from sorvolo.geometry.box_overlap import areas, cover_matrix, iou_matrix

SAME_IOU = 0.4
"""Two tiles' boxes of a class are one object if they overlap this much in what both tiles show."""

# so much of a cut piece within a box that another tile saw whole: the piece adds nothing
_COVERED = 0.7
_TOUCH_SHARE, _TOUCH_PX = (
    0.2,
    2.0,
)  # a box that ends so near its tile's border may go on beyond; boxes are imprecise
# times the piece's area: a box of its own size is no whole that it is part of; by choice
_MORE = 1.1


@dataclass(frozen=True, eq=False)
class SeenTile:
    """A tile's place in the picture, left, top, right, bottom px, and what was seen there, in the picture's pixels."""

    place_px: tuple[int, int, int, int]
    seen: Seen


@dataclass(frozen=True, eq=False)
class _Views:
    """All tiles' boxes as columns: which tile saw each, which sides a border may have cut, how far borders are."""

    boxes_px: BoxesPx
    scores: Floats
    labels: Labels
    tiles: Rows
    cut: Mask  # (N,)
    room_px: Floats  # (N,) to the nearest border within the picture


def merge_tiles(tiles: Sequence[SeenTile], size_px: tuple[int, int]) -> Seen:
    """What overlapping tiles of a picture, (height, width) `size_px`, saw together, each object once, best first.

    Boxes of one class in two tiles are the same object if, seen through the window that both tiles share, they are
    the same box: so a cut piece finds its whole. At most one box of a tile goes into an object. Where a tile saw it
    whole, the one that saw it most centrally gives its place; where none did (it is longer than the overlap), its
    pieces are joined. The score is the best of all. What is left of cut pieces goes if another tile's box covers it,
    whatever its class: a car's corner that alone looked like something else.
    """
    views = _views(tiles, size_px)
    objects = _gathered(views, tiles)
    boxes = np.zeros((len(objects), 4), np.float32)
    scores, labels, is_piece = (
        np.zeros(len(objects)),
        np.zeros(len(objects), np.int64),
        np.zeros(len(objects), bool),
    )
    for row, members in enumerate(objects):
        whole = members[~views.cut[members]]
        if len(whole):
            boxes[row] = views.boxes_px[whole[np.argmax(views.room_px[whole])]]
        else:
            pieces = views.boxes_px[members]
            boxes[row] = [*pieces[:, :2].min(axis=0), *pieces[:, 2:].max(axis=0)]
        scores[row], labels[row], is_piece[row] = (
            views.scores[members].max(),
            views.labels[members[0]],
            not len(whole),
        )
    kept = _not_covered(
        boxes, is_piece, [set(views.tiles[members].tolist()) for members in objects]
    )
    order = kept[np.argsort(-scores[kept], kind="stable")]
    return Seen(boxes[order], scores[order], labels[order])


def _views(tiles: Sequence[SeenTile], size_px: tuple[int, int]) -> _Views:
    boxes = np.concatenate([np.zeros((0, 4), np.float32), *(tile.seen.boxes_px for tile in tiles)])
    places = np.concatenate(
        [
            np.zeros((0, 4)),
            *(
                np.tile(np.array(tile.place_px, float), (len(tile.seen.scores), 1))
                for tile in tiles
            ),
        ]
    )
    picture = np.array([0, 0, size_px[1], size_px[0]], float)
    room = np.abs(boxes - places)
    room[places == picture] = np.inf  # the picture's own edge cuts nothing that could be seen
    sides = boxes[:, 2:] - boxes[:, :2]
    reach = np.maximum(_TOUCH_PX, _TOUCH_SHARE * np.concatenate([sides, sides], axis=1))
    return _Views(
        boxes,
        np.concatenate([np.zeros(0), *(tile.seen.scores for tile in tiles)]),
        np.concatenate([np.zeros(0, np.int64), *(tile.seen.labels for tile in tiles)]),
        np.repeat(np.arange(len(tiles)), [len(tile.seen.scores) for tile in tiles]),
        (room <= reach).any(axis=1),
        room.min(axis=1, initial=np.inf),
    )


def _gathered(views: _Views, tiles: Sequence[SeenTile]) -> list[Rows]:
    """Indices of the boxes that are one object, most alike first; no two from one tile."""
    pairs = [
        pair
        for first, second in combinations(range(len(tiles)), 2)
        for pair in _alike(views, tiles, first, second)
    ]
    groups = [[each] for each in range(len(views.scores))]
    for _, one, other in sorted(pairs, key=lambda pair: -pair[0]):
        a, b = groups[one], groups[other]
        if a is not b and not {*views.tiles[a].tolist()} & {*views.tiles[b].tolist()}:
            a += b
            for each in b:
                groups[each] = a
    return [np.array(group) for index, group in enumerate(groups) if group[0] == index]


def _alike(
    views: _Views, tiles: Sequence[SeenTile], first: int, second: int
) -> list[tuple[float, int, int]]:
    """Pairs of boxes, one of each tile, that look the same in the window which both tiles share; how much first."""
    a, b = tiles[first].place_px, tiles[second].place_px
    window = np.array(
        [max(a[0], b[0]), max(a[1], b[1]), min(a[2], b[2]), min(a[3], b[3])], np.float32
    )
    if window[0] >= window[2] or window[1] >= window[3]:
        return []
    ones, others = np.flatnonzero(views.tiles == first), np.flatnonzero(views.tiles == second)
    whole = iou_matrix(views.boxes_px[ones], views.boxes_px[others])
    through = iou_matrix(
        _within(views.boxes_px[ones], window), _within(views.boxes_px[others], window)
    )
    has_cut = views.cut[ones][:, None] | views.cut[others][None]
    alike = np.where(has_cut, through, whole)
    alike[views.labels[ones][:, None] != views.labels[others][None]] = 0
    rows, columns = np.nonzero(alike >= SAME_IOU)
    return [
        (float(alike[row, column]), int(ones[row]), int(others[column]))
        for row, column in zip(rows, columns)
    ]


def _not_covered(boxes: BoxesPx, is_piece: Mask, tiles: Sequence[set[int]]) -> Rows:
    """Indices of the objects, without the pieces that lie in a larger box of other tiles."""
    pieces = np.flatnonzero(is_piece)
    cover = cover_matrix(boxes[pieces], boxes)
    area = areas(boxes)
    gone = [
        piece
        for row, piece in enumerate(pieces.tolist())
        if any(
            area[other] > _MORE * area[piece] and not tiles[piece] & tiles[other]
            for other in np.flatnonzero(cover[row] >= _COVERED).tolist()
        )
    ]
    return np.setdiff1d(np.arange(len(boxes)), np.array(gone, np.int64))


def _within(boxes: BoxesPx, window: Numbers) -> BoxesPx:
    return np.concatenate(
        [
            np.clip(boxes[:, :2], window[:2], window[2:]),
            np.clip(boxes[:, 2:], window[:2], window[2:]),
        ],
        axis=1,
    )
