"""Whether something tall that stands there unchanged explains a difference as well as a change does."""

import numpy as np

from sorvolo.change.earlier_pictures import EarlierPictures, Vantage
from sorvolo.change.levelness import (
    TALLEST_M,
    Sights,
    is_level,
    seen_at_m,
    surroundings,
    width_m,
)
from sorvolo.geometry.arrays import PointsM


class ReliefDoubt:
    """What pictures of both dates show of the ground where candidates lie. `explains` keeps what it found out.

    Something tall lies elsewhere on level ground for each camera: a place that earlier pictures show from another side
    than later ones differs whether anything changed or not. `m_per_px` is a pixel of what is compared.
    """

    def __init__(self, earlier: EarlierPictures, m_per_px: float) -> None:
        self._earlier, self._m_per_px = earlier, m_per_px
        self._known: dict[tuple[int, int, int], bool] = {}

    def explains(self, number: int, outline_m: PointsM, cameras_m: PointsM, sights: Sights) -> bool:
        """Whether relief explains a candidate that lies in an outline, (N, 2), and that later cameras, (V, 3), show.

        It does not where an earlier picture was taken so near to one of them that the tallest thing would not differ
        all over the outline, nor where the pictures of either date show that the ground is level.
        """
        vantage = self._earlier.vantage(outline_m, cameras_m)
        if vantage is None or not self._is_from_aside(vantage, outline_m):
            return False
        asked = number, len(sights.pictures), vantage.shows[0]
        if asked not in self._known:
            self._known[asked] = not self._is_level(vantage, outline_m, sights)
        return self._known[asked]

    def _is_from_aside(self, vantage: Vantage, outline_m: PointsM) -> bool:
        middle_m = outline_m.mean(axis=0)
        tallest_m = min(TALLEST_M, float(vantage.later_m[2]) / 2)
        leans_m = seen_at_m(middle_m, vantage.later_m, tallest_m, vantage.earlier_m) - middle_m
        return float(np.hypot(*leans_m)) > width_m(outline_m)

    def _is_level(self, vantage: Vantage, outline_m: PointsM, sights: Sights) -> bool:
        if is_level(sights.pictures, outline_m, vantage.earlier_m):
            return True
        window = surroundings(outline_m.min(axis=0), outline_m.max(axis=0), self._m_per_px)
        if window is None:
            return False
        earlier = list(self._earlier.laid(vantage, window))
        return is_level(earlier, outline_m, vantage.later_m)
