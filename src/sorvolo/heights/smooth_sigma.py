"""A sigma that changes smoothly over a site: what heights err by their cameras."""

from dataclasses import dataclass

import numpy as np

from sorvolo.geometry.arrays import Floats, PointsM
from sorvolo.geometry.summary import SIGMA_PER_MEDIAN_DEVIATION
from sorvolo.heights.lattice import Lattice

_TERMS = 6  # of a surface of second degree in x and y
_ROUNDS = 10  # of a robust fit
_BENDS = 2.0  # robust deviations at which the Cauchy loss bends


@dataclass(frozen=True)
class SmoothSigma:
    """The square of a sigma, m^2, as a polynomial of second order in the place, as a tilt and a scale that err make it.

    `terms` are those of 1, x, y, x^2, x y and y^2, x and y counted from `middle_m` in `reach_m` (site metres); no
    terms: no sigma. It is nowhere below `least_m`; beyond `reach_m` it stays as it is at that distance.
    """

    terms: tuple[float, ...] = ()
    middle_m: tuple[float, float] = (0.0, 0.0)
    reach_m: float = 1.0
    least_m: float = 0.0

    @classmethod
    def fitted(cls, places_m: PointsM, sigma_m: Floats) -> "SmoothSigma":
        """Through sigmas (N,) at places (N, 2); a few may be wild, as of points that rays almost in parallel see."""
        if len(places_m) < _TERMS:
            return cls(least_m=float(np.median(sigma_m)) if len(sigma_m) else 0.0)
        low, high = places_m.min(axis=0), places_m.max(axis=0)
        middle, reach_m = (low + high) / 2, max(float((high - low).max()) / 2, 1e-6)
        terms = _robust_terms(_powers((places_m - middle) / reach_m), sigma_m**2)
        middle_m = (float(middle[0]), float(middle[1]))
        return cls(tuple(float(each) for each in terms), middle_m, reach_m, float(sigma_m.min()))

    def at(self, places_m: PointsM) -> Floats:
        """(N,) the sigma at places (N, 2), m."""
        if not self.terms:
            return np.full(len(places_m), self.least_m)
        places = np.clip((places_m - np.array(self.middle_m)) / self.reach_m, -1, 1)
        return np.sqrt(np.maximum(_powers(places) @ np.array(self.terms), self.least_m**2))

    def on(self, lattice: Lattice) -> Floats:
        """(H, W) the sigma of a lattice's cells, m."""
        return self.at(lattice.points_m().reshape(-1, 2)).reshape(lattice.shape)


def _robust_terms(powers: Floats, square: Floats) -> Floats:
    """(6,) the terms of squares (N,) by a Cauchy loss, begun at their median."""
    off = square - np.median(square)
    for _ in range(_ROUNDS):
        spread = max(_BENDS * SIGMA_PER_MEDIAN_DEVIATION * float(np.median(np.abs(off))), 1e-12)
        root = 1 / np.sqrt(1 + (off / spread) ** 2)
        terms = np.linalg.lstsq(powers * root[:, None], square * root, rcond=None)[0]
        off = square - powers @ terms
    return np.asarray(terms)


def _powers(places: PointsM) -> Floats:
    x, y = places.T
    return np.column_stack([np.ones(len(x)), x, y, x**2, x * y, y**2])
