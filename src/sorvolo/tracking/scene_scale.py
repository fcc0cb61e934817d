"""How much ground a pixel covers where only the pictures show it: by the cars, else the people, in them."""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sorvolo.geometry.arrays import Floats, Mask
from sorvolo.geometry.summary import SIGMA_PER_MEDIAN_DEVIATION
from sorvolo.survey.objects import TYPICAL_SIZE_M, Detections
from sorvolo.tracking.cut_boxes import cut_edges
from sorvolo.tracking.plausible import TOO_SHORT_CUT_PX, impossible_size

_CAR, _PERSON = "car", "person"


@dataclass(frozen=True)
class SceneSettings:
    """Which boxes show the scale, and how well."""

    least_score: float = 0.4  # boxes of less are too often none
    least_boxes: int = 8  # of a class; fewer may be mistakes, or all of one odd kind
    most_boxes: int = 400  # the newest: a drone climbs
    least_spread: float = 0.03  # of the sizes around the fit: boxes are no more exact
    most_spread: float = (
        0.35  # of the sizes around the fit, in logarithms: beyond it boxes are no one kind of thing
    )
    fleet_sigma: float = (
        0.15  # by which a street's cars may be longer or shorter than the usual car
    )
    rounds: int = 8  # of the robust fit


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

    def __init__(self, settings: SceneSettings = SceneSettings()) -> None:
        self._settings = settings
        self._cars, self._people = (
            deque[tuple[float, float]](maxlen=settings.most_boxes) for _ in range(2)
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
        for row in np.flatnonzero(~cut & (found.scores >= self._settings.least_score)).tolist():
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
        if len(self._people) < self._settings.least_boxes:
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
        settings = self._settings
        if len(self._cars) < settings.least_boxes:
            return None
        down, side = np.array(self._cars).T
        size = np.log(side / TYPICAL_SIZE_M[_CAR][0])
        columns, off = np.column_stack([np.ones(len(down)), down]), size - np.median(size)
        for _ in range(settings.rounds):
            spread = max(_spread(off), settings.least_spread)
            weight = 1.0 / (1.0 + (off / (2.0 * spread)) ** 2)
            # cars at one height in the picture know nothing of the slope: it is then taken as small
            matrix = (columns * weight[:, None]).T @ columns + np.diag([0.0, 1.0])
            middle, slope = np.linalg.solve(matrix, (columns * weight[:, None]).T @ size)
            off = size - middle - slope * down
        spread = _spread(off)
        if spread > settings.most_spread:
            return None
        return SceneFit(
            float(middle),
            float(slope),
            float(np.hypot(settings.fleet_sigma, spread / len(down) ** 0.5)),
        )


def _spread(off: Floats) -> float:
    """The sigma of what lies around a fit, by the median, (N,) logarithms."""
    return float(SIGMA_PER_MEDIAN_DEVIATION * np.median(np.abs(off)))


def impossible_beside_cars(
    names: Sequence[str], sides: Floats, is_cut: Mask, settings: SceneSettings = SceneSettings()
) -> Mask:
    """(N,) bool: of boxes laid on a map without metres, which have a size that their class cannot have.

    `sides` (N, 2) in the map's units; `is_cut` (N,) by a picture's edge. The map's cars give the unit's length; where
    they are too few, or of too many sizes, nothing is impossible.
    """
    longest = sides.max(axis=1, initial=0.0)
    cars = np.log(
        longest[(np.array(names, object) == _CAR) & ~is_cut & (longest > 0)]
        / TYPICAL_SIZE_M[_CAR][0]
    )
    if len(cars) < settings.least_boxes:
        return np.zeros(len(names), bool)
    spread = _spread(cars - np.median(cars))
    if spread > settings.most_spread:
        return np.zeros(len(names), bool)
    sigma = float(np.hypot(settings.fleet_sigma, spread / len(cars) ** 0.5))
    cut = np.repeat(is_cut[:, None], 4, axis=1)
    return impossible_size(names, sides * float(np.exp(-np.median(cars))), cut, sigma)
