"""Which sizes on the ground a class can have, what the picture's edge hides of them, and the scale that cars show."""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from math import exp, hypot, inf, log

import numpy as np

from sorvolo.geometry.arrays import BoxesPx, Floats, Mask
from sorvolo.geometry.summary import SIGMA_PER_MEDIAN_DEVIATION
from sorvolo.survey.objects import TYPICAL_SIZE_M, Detections

TOO_SHORT_CUT_PX = 3.0
"""Pieces of cars at the picture's edge end up to so far from it: nearer, their length means nothing."""


_LEAST_LENGTH = 0.4  # of its usual length: what is shorter is none, however sure the detector is
# times its largest dimension: what is wider is none; trucks are as wide as cars are long
_MOST_WIDTH = 2.5
_SCALE_SIGMAS = 2.0  # by which heights may be off before something is called too short or too wide

_SHORTER_SIGMA = {"car": 0.11, "person": inf}  # people sit and crouch
_LARGER_SIGMA = 0.2  # vans, pickups; arms and legs apart
# of a car's area: of labelled cars that a window's edge cut, half are found where so much is left
_HALF_FOUND = 0.23
_PARTLY_SEEN = 0.05  # of a class's members, of which a tree or a roof hides a part; by choice


def impossible_size(
    names: Sequence[str],
    sides_m: Floats,
    cut: Mask,
    scale_sigma: float | Floats = 0.0,
) -> Mask:
    """(N,) bool: what is far too short or far too wide for its class, as a window or a lawn is for a car.

    `sides_m` (N, 2) are the box's sides on the ground, known to the relative error `scale_sigma`, one or (N,); `cut`
    (N, 4) as `cut_edges` gives it with `TOO_SHORT_CUT_PX`: what the picture's edge cuts may look too short, not too
    wide. Seen aslant, a standing person's box is long on the ground, but not wide: the shorter side is compared.
    """
    longest_m = sides_m.max(axis=1, initial=0.0) * (1.0 + _SCALE_SIGMAS * scale_sigma)
    usual_m = np.array([TYPICAL_SIZE_M.get(name, (0.0,))[0] for name in names])
    short = ~cut.any(axis=1) & (longest_m < _LEAST_LENGTH * usual_m)
    shortest_m = sides_m.min(axis=1, initial=np.inf) * np.maximum(
        0.0, 1.0 - _SCALE_SIGMAS * scale_sigma
    )
    largest_m = np.array([max(TYPICAL_SIZE_M.get(name, (np.inf,))) for name in names])
    wide: Mask = shortest_m > _MOST_WIDTH * largest_m
    return np.asarray(short | wide, bool)


def size_log_odds(name: str, sides_m: Floats, scale_sigma: float, *, is_cut: bool = False) -> float:
    """What a box's sides on the ground (2,) count for a thing's being of a class: below 0 where they are unusual.

    The logarithm of how likely members of the class look so short or so wide, beside those of usual size; the sides are
    known to the relative error `scale_sigma`. A piece that the picture's edge leaves is as likely as so little of a car
    is found. 0 where nothing is known of the class's sizes. As in `impossible_size`, the shorter side is the width.
    """
    if name not in _SHORTER_SIGMA:
        return 0.0
    usual_m = TYPICAL_SIZE_M[name]
    width_m, length_m = np.sort(sides_m).clip(1e-3)
    # around what lies slanting
    off = log(width_m / sum(sorted(usual_m)[1:]) * 2**0.5) / hypot(_LARGER_SIGMA, scale_sigma)
    found = 1.0
    if is_cut:
        found /= 1.0 + (_HALF_FOUND * usual_m[0] * usual_m[1] / (width_m * length_m)) ** 3
    else:
        off = max(off, -log(length_m / usual_m[0]) / hypot(_SHORTER_SIGMA[name], scale_sigma))
    return log(found * ((1.0 - _PARTLY_SEEN) * exp(-(max(off, 0.0) ** 2) / 2) + _PARTLY_SEEN))


CUT_PX = 1.5
"""A box so near the picture's edge may go on beyond it."""


_BEYOND = 0.4  # of what lies beyond the edge: by how much the box's middle is off ...
_BEYOND_SIGMA = 0.5  # ... give or take
_CUT_SHARE = 0.06  # of its side: so near the edge it is cut, for edges err
_AS_MUCH_AGAIN = 0.3  # of the visible side, where that is as long as its class usually is


def cut_edges(
    boxes_px: BoxesPx | Floats,
    width_px: int,
    height_px: int,
    least_px: float = CUT_PX,
) -> Mask:
    """(N, 4) bool: whether the left, top, right and bottom edges of boxes (N, 4) lie at the picture's, to `least_px`.

    Those of a detector end there; what reaches beyond was never cut.
    """
    boxes = np.asarray(boxes_px, np.float64).reshape(-1, 4)
    margin_px = np.maximum(least_px, _CUT_SHARE * (boxes[:, 2:] - boxes[:, :2]))
    to_edge_px = np.concatenate(
        [boxes[:, :2], boxes[:, 2:] - np.array([width_px, height_px])], axis=1
    )
    cut: Mask = np.abs(to_edge_px) <= np.tile(margin_px, 2)
    return cut


def beyond_edges(
    names: Sequence[str],
    cut: Mask,
    axes: Floats,
    sides_m: Floats,
    *,
    has_metres: bool = True,
) -> tuple[Floats, Floats]:
    """How far beside its box an object's middle may lie that the picture's edge cuts: (N, 2) m, with (N, 2, 2) m2.

    `cut` as `cut_edges` gives it; `axes` (N, 2, 2) are the directions on the ground, a row each, in which the box's
    width and height grow, and `sides_m` (N, 2) how long they are there. Without this, what comes into view seems to be
    dragged along by the picture's edge.
    """
    outward_m, spread_m2 = np.zeros((len(names), 2)), np.zeros((len(names), 2, 2))
    for row, axis in np.argwhere(cut[:, :2] | cut[:, 2:]):
        beyond_m = _unseen_m(names[row], float(sides_m[row, axis]), has_metres=has_metres)
        out = axes[row, axis]
        outward_m[row] += (
            _BEYOND * (float(cut[row, 2 + axis]) - float(cut[row, axis])) * beyond_m * out
        )
        spread_m2[row] += (_BEYOND_SIGMA * beyond_m) ** 2 * np.outer(out, out)
    return outward_m, spread_m2


def _unseen_m(name: str, side_m: float, *, has_metres: bool) -> float:
    """How much of something may lie beyond the picture's edge: what it lacks to its usual length, or as much again."""
    if not has_metres or name not in TYPICAL_SIZE_M:
        return side_m
    return max(TYPICAL_SIZE_M[name][0] - side_m, _AS_MUCH_AGAIN * side_m)


_CAR, _PERSON = "car", "person"


_LEAST_SCORE = 0.4  # boxes of less are too often none
_LEAST_BOXES = 8  # of a class; fewer may be mistakes, or all of one odd kind
_MOST_BOXES = 400  # the newest: a drone climbs
_LEAST_SPREAD = 0.03  # of the sizes around the fit: boxes are no more exact
# of the sizes around the fit, in logarithms: beyond it boxes are no one kind of thing
_MOST_SPREAD = 0.35
_FLEET_SIGMA = 0.15  # by which a street's cars may be longer or shorter than the usual car
_ROUNDS = 8  # of the robust fit


@dataclass(frozen=True)
class SceneFit:
    """The logarithm of the pixels that a metre of ground covers at the picture's middle, and by how much it grows to
    its lower edge and shrinks to its upper one; `sigma` of the whole, in logarithms."""

    middle: float
    slope: float
    sigma: float

    def m_per_px(self, down: Floats | float) -> Floats:
        """The ground that a pixel covers at places down the picture: -0.5 its upper edge, 0.5 its lower one."""
        return np.exp(-self.middle - self.slope * np.asarray(down, np.float64))


class SceneScale:
    """The scale of a scene, from what was detected in pictures of one camera. Only `see` changes it.

    A car's box in a picture from above is about as long as the car, whichever way it stands. The sizes of cars in the
    newest pictures are fitted by their place down the picture, since an aslant view shows far ones smaller.
    """

    def __init__(self) -> None:
        self._cars, self._people = (
            deque[tuple[float, float]](maxlen=_MOST_BOXES) for _ in range(2)
        )
        self.fit: SceneFit | None = None

    def see(
        self,
        found: Detections,
        size_px: tuple[int, int],
        window_px: tuple[int, int, int, int] | None = None,
    ) -> None:
        """Take in what was detected in a picture, (height, width) `size_px`.

        Where only a window of it was searched, left, top, right and bottom px, boxes that its border cuts do not count.
        """
        height_px, width_px = size_px
        boxes = found.boxes_px.astype(np.float64)
        left, top, right, bottom = window_px or (0, 0, width_px, height_px)
        cut = cut_edges(
            boxes - [left, top, left, top], right - left, bottom - top, TOO_SHORT_CUT_PX
        ).any(axis=1)
        for row in np.flatnonzero(~cut & (found.scores >= _LEAST_SCORE)).tolist():
            kept = {_CAR: self._cars, _PERSON: self._people}.get(found.names[row])
            if kept is not None:
                left, top, right, bottom = boxes[row]
                kept.append(((top + bottom) / 2 / height_px - 0.5, max(right - left, bottom - top)))
        self.fit = self._fitted()

    def m_per_px(self) -> float | None:
        """The ground that a pixel covers in the picture's middle; None where too little is known.

        Where only people show it is the least that it may be: as if each box were as long as a person seen from
        straight above is.
        """
        if self.fit is not None:
            return float(self.fit.m_per_px(0.0))
        if len(self._people) < _LEAST_BOXES:
            return None
        return TYPICAL_SIZE_M[_PERSON][0] / float(np.median([side for _, side in self._people]))

    def impossible(self, found: Detections, size_px: tuple[int, int]) -> Mask:
        """(N,) bool: which detections are of a size that their class cannot have beside the scene's cars."""
        if self.fit is None:
            return np.zeros(len(found), bool)
        boxes = found.boxes_px.astype(np.float64)
        m_per_px = self.fit.m_per_px((boxes[:, 1] + boxes[:, 3]) / 2 / size_px[0] - 0.5)
        sides_m = (boxes[:, 2:] - boxes[:, :2]) * m_per_px[:, None]
        cut = cut_edges(boxes, size_px[1], size_px[0], TOO_SHORT_CUT_PX)
        return impossible_size(found.names, sides_m, cut, self.fit.sigma)

    def _fitted(self) -> SceneFit | None:
        """A robust line through the cars' sizes; None of too few, or where they are no one kind of thing."""
        if len(self._cars) < _LEAST_BOXES:
            return None
        down, side = np.array(self._cars).T
        size = np.log(side / TYPICAL_SIZE_M[_CAR][0])
        columns, off = np.column_stack([np.ones(len(down)), down]), size - np.median(size)
        for _ in range(_ROUNDS):
            spread = max(_spread(off), _LEAST_SPREAD)
            weight = 1.0 / (1.0 + (off / (2.0 * spread)) ** 2)
            # cars at one height in the picture know nothing of the slope: it is then taken as small
            matrix = (columns * weight[:, None]).T @ columns + np.diag([0.0, 1.0])
            middle, slope = np.linalg.solve(matrix, (columns * weight[:, None]).T @ size)
            off = size - middle - slope * down
        spread = _spread(off)
        if spread > _MOST_SPREAD:
            return None
        return SceneFit(
            float(middle),
            float(slope),
            float(np.hypot(_FLEET_SIGMA, spread / len(down) ** 0.5)),
        )


def _spread(off: Floats) -> float:
    """The sigma of what lies around a fit, by the median, (N,) logarithms."""
    return float(SIGMA_PER_MEDIAN_DEVIATION * np.median(np.abs(off)))


def impossible_beside_cars(names: Sequence[str], sides: Floats, is_cut: Mask) -> Mask:
    """(N,) bool: of boxes laid on a map without metres, which have a size that their class cannot have.

    `sides` (N, 2) in the map's units; `is_cut` (N,) by a picture's edge. The map's cars give the unit's length; where
    they are too few, or of too many sizes, nothing is impossible.
    """
    longest = sides.max(axis=1, initial=0.0)
    cars = np.log(
        longest[(np.array(names, object) == _CAR) & ~is_cut & (longest > 0)]
        / TYPICAL_SIZE_M[_CAR][0]
    )
    spread = _spread(cars - np.median(cars)) if len(cars) >= _LEAST_BOXES else inf
    if spread > _MOST_SPREAD:
        return np.zeros(len(names), bool)
    sigma = float(np.hypot(_FLEET_SIGMA, spread / len(cars) ** 0.5))
    cut = np.repeat(is_cut[:, None], 4, axis=1)
    return impossible_size(names, sides * float(np.exp(-np.median(cars))), cut, sigma)
