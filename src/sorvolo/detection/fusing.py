"""Detections put together: looks at neighbouring tiles and in several sizes; and scores as shares (Platt 1999)."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy.optimize import minimize

from sorvolo.detection.contract import ModelInfo, Pyramid, ScoreCalibration
from sorvolo.detection.session import Seen
from sorvolo.geometry.arrays import BoxesPx, Floats, ImageRGB, Labels, Mask, Matrix3, Numbers, Rows
from sorvolo.geometry.box_overlap import areas, cover_matrix, iou_matrix

_LEAST = 1e-6  # no score counts for less, nor for more than 1 less this: log-odds stay finite


def calibrated(seen: Seen, info: ModelInfo) -> Seen:
    """What all looks at a picture came to, its scores as the model's `calibration` states them, best first."""
    if not info.calibration:
        return seen
    scores = seen.scores.copy()
    for label, name in enumerate(info.classes):
        if name in info.calibration:
            rows = seen.labels == label
            scores[rows] = platt_scaled(scores[rows], info.calibration[name])
    order = np.argsort(-scores, kind="stable")
    return Seen(seen.boxes_px[order], scores[order], seen.labels[order])


def platt_scaled(scores: Floats | float, how: ScoreCalibration) -> Floats:
    """Scores of any shape, 0 to 1, whose log-odds become `shift` and `slope` times themselves (Platt 1999)."""
    return 1 / (1 + np.exp(-how.shift - how.slope * log_odds(scores, _LEAST)))


def platt_fit(scores: Floats, right: Mask) -> ScoreCalibration | None:
    """The scale by which scores (N,) of the model's own become shares, from what of them is `right` (N,) (Platt 1999).

    A right one aims a little below 1, a wrong one a little above 0, by how few
    there are (eq. 4 there). None where right ones do not score higher than wrong ones, or there are none of either.
    """
    if right.all() or not right.any():
        return None
    hits, misses = np.count_nonzero(right), np.count_nonzero(~right)
    aims = np.where(right, (hits + 1) / (hits + 2), 1 / (misses + 2))
    odds = log_odds(scores, _LEAST)

    def loss(weights: Floats) -> float:
        logits = weights[0] * odds + weights[1]
        return float(np.mean(np.logaddexp(0, logits) - aims * logits))

    slope, shift = minimize(loss, np.array([1.0, 0.0])).x.tolist()
    return ScoreCalibration(slope, shift) if slope > 0 else None


def in_own_scale(info: ModelInfo) -> dict[str, float]:
    """The model's thresholds in its networks' own scale: what reports as much where nothing is calibrated."""
    return {
        name: float(platt_scaled(least, ScoreCalibration(1 / how.slope, -how.shift / how.slope)))
        if (how := info.calibration.get(name))
        else least
        for name, least in info.thresholds.items()
    }


def scaled_thresholds(
    own: Mapping[str, float], calibration: Mapping[str, ScoreCalibration]
) -> dict[str, float]:
    """Thresholds in a model's own scale as they are after its calibration: `in_own_scale` the other way round."""
    return {
        name: float(platt_scaled(least, calibration[name])) if name in calibration else least
        for name, least in own.items()
    }


def log_odds(scores: Floats | float, least: float) -> Floats:
    """log(p / (1 - p)) of scores p of any shape, which count for `least` at least and for 1 - `least` at most."""
    inside = np.clip(scores, least, 1 - least)
    return np.log(inside / (1 - inside))


SAME_IOU = 0.4
"""Two tiles' boxes of a class are one object if they overlap this much in what both tiles show."""

# so much of a cut piece within a box that another tile saw whole: the piece adds nothing
_COVERED = 0.7
# a box that ends so near its tile's border may go on beyond; boxes are imprecise
_TOUCH_SHARE, _TOUCH_PX = 0.2, 2.0
# times the piece's area: a box of its own size is no whole that it is part of; by choice
_MORE = 1.1

# The thresholds on models' cards (`pyramid`) hold for these values.
_LEAST_DOWN = 0.8  # of the optical axis: 37 degrees off straight down or less is from above
_SAME_OBJECT_IOU = 0.5  # boxes of one class that overlap more are one object, as COCO counts them
_UNSEEN_ODDS = -4.5  # log-odds of what a sized look does not show: models report from -3.9 on
_LEAST_SURE = 1e-4  # no score counts for less, nor for more than 1 less this
_LEAST_TRUST = 1e-6  # of a look, beside the best one: it stays above zero, and its logarithm finite


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
    # Indices of the boxes that are one object, most alike first; no two from one tile.
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
    objects = [np.array(group) for index, group in enumerate(groups) if group[0] == index]
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


def is_from_above(site_from_camera: Matrix3) -> bool:
    """Whether a camera of this rotation (3, 3) looks about straight down."""
    return -float(site_from_camera[2, 2]) >= _LEAST_DOWN


def turned(picture: ImageRGB, quarters: int) -> ImageRGB:
    """A picture (H, W, 3) turned counter-clockwise by this many quarters."""
    return np.ascontiguousarray(np.rot90(picture, quarters))


def turned_back(boxes_px: BoxesPx, quarters: int, size_px: tuple[int, int]) -> BoxesPx:
    """Boxes (N, 4) of a turned picture in the picture as it was, (height, width) `size_px`."""
    height, width = size_px
    left, top, right, bottom = boxes_px.T
    columns = {
        0: (left, top, right, bottom),
        1: (width - bottom, left, width - top, right),
        2: (width - right, height - bottom, width - left, height - top),
        3: (top, height - right, bottom, height - left),
    }[quarters % 4]
    return np.column_stack(columns).astype(np.float32).reshape(-1, 4)


def alike(boxes_px: Floats) -> Iterator[Rows]:
    """Rows of boxes (N, 4) that are one object: of what is left the first, and all that overlap it more than so."""
    overlap = iou_matrix(boxes_px, boxes_px)
    is_free = np.ones(len(boxes_px), bool)
    for first in range(len(boxes_px)):
        if is_free[first]:
            others = np.flatnonzero(is_free & (overlap[first] > _SAME_OBJECT_IOU))
            group = np.concatenate([[first], others[others != first]])
            is_free[group] = False
            yield group


def agreed_in_sizes(
    looks: Sequence[Seen],
    times: Sequence[float],
    label: int,
    pyramid: Pyramid,
) -> Seen:
    """What looks at one picture, each `times` as large, saw of one class: each object once, best first.

    All boxes are in the picture's own pixels. Boxes that overlap are one object, at most one of each look. Its
    log-odds are the looks' mean, weighed by how well the model knows an object of the size at which each look shows
    it (`trust`), a logarithmic opinion pool (Genest and Zidek 1986), and `Pyramid.shift`; its box is the mean of the
    looks' boxes by these weights times their scores.
    """
    own = [look.labels == label for look in looks]
    boxes = np.concatenate([look.boxes_px[mine] for look, mine in zip(looks, own)])
    scores = np.concatenate([look.scores[mine] for look, mine in zip(looks, own)])
    of_look = np.repeat(np.arange(len(looks)), [np.count_nonzero(mine) for mine in own])
    odds = log_odds(scores, _LEAST_SURE)
    weights = trust(boxes, np.array(times), pyramid)
    claims = odds + np.log(
        weights[np.arange(len(boxes)), of_look]
    )  # the look that knows the size best leads
    order = np.argsort(-claims, kind="stable")
    found_px, found_odds = [np.zeros((0, 4))], []
    for group in alike(boxes[order]):
        rows, own_weights = order[group], weights[order[group[0]]]
        best = np.full(len(looks), _UNSEEN_ODDS)
        np.maximum.at(best, of_look[rows], odds[rows])
        found_odds.append(float(own_weights @ best) + pyramid.shift)
        found_px.append(
            np.average(boxes[rows], axis=0, weights=own_weights[of_look[rows]] * scores[rows])[None]
        )
    best_first = np.argsort(-np.array(found_odds), kind="stable")
    return Seen(
        np.concatenate(found_px)[best_first].astype(np.float32),
        1 / (1 + np.exp(-np.array(found_odds)[best_first])),
        np.full(len(found_odds), label, np.int64),
    )


def trust(
    boxes_px: BoxesPx,
    times: Floats,
    pyramid: Pyramid,
) -> Floats:
    """(N, looks) shares of the opinion on boxes (N, 4) in looks that show the picture `times` as large.

    The first look shows it as it is. Closer looks count for small objects alone; they hurt large ones.
    """
    area_px = (boxes_px[:, 2] - boxes_px[:, 0]) * (boxes_px[:, 3] - boxes_px[:, 1])
    off = (
        np.log2(np.sqrt(np.maximum(area_px, 1.0))[:, None] * times / pyramid.known_px)
        / pyramid.octaves
    )
    curve = np.exp(-0.5 * (off**2 - (off**2).min(axis=1, keepdims=True))) + _LEAST_TRUST
    is_closer = np.isin(times, times[0] * np.array(pyramid.closer))
    curve[~is_closer[curve.argmax(axis=1)][:, None] & is_closer] = _LEAST_TRUST
    return curve / curve.sum(axis=1, keepdims=True)
