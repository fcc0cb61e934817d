"""The error that all sightings of a frame have in common: GPS and tilt shift a whole frame, not one object in it.

Places of tracks are kept in a map that the sightings themselves make; the shift is how far a frame lies beside that
map. It forgets itself over a minute as GPS does, and what a frame's pattern of objects says of it leaves each object's
own place free of it.
"""

from dataclasses import dataclass

import numpy as np

from sorvolo.geometry.arrays import Floats, PointsM
from sorvolo.tracking.motion import log_density

FORGETS_S = 60.0
"""How long a GPS error lasts."""

_FIRST_JITTER = 0.3  # of the shared sigma: what changes from frame to frame, until the frames say it
_LEAST_JITTER = 0.03
_LEARNS = 0.05
_LOST_SHARE = 0.02  # of frames: a wrong match has led the shift astray, and nothing is known of it but its size
_EYE = np.eye(2)


@dataclass(frozen=True, eq=False)
class FittedShift:
    """The shift (2,) with its covariance, and as each of M matched objects' others have it: (M, 2), (M, 2, 2)."""

    shift_m: PointsM
    covariance_m2: Floats
    of_others_m: PointsM
    of_others_m2: Floats


class CommonShift:
    """How far frames lie beside the map, frame after frame. `move_on` and `settle` change it."""

    def __init__(self) -> None:
        self.mean_m = np.zeros(2)
        self.covariance_m2 = np.zeros((2, 2))
        self.limit_m2 = 0.0  # variance per axis of a shift of which nothing else is known
        self._jitter_m2 = -1.0

    def move_on(self, elapsed_s: float, shared_sigma_m: float) -> None:
        """A frame `elapsed_s` later, whose sightings share an error of `shared_sigma_m` per axis."""
        if self._jitter_m2 < 0:
            self._jitter_m2 = (_FIRST_JITTER * shared_sigma_m) ** 2
            return  # the first frame is where the map begins
        keeps = float(np.exp(-elapsed_s / FORGETS_S))
        self.limit_m2 = limit_m2 = 2 * shared_sigma_m**2  # this frame's error and that of those that made the map
        self.mean_m = keeps * self.mean_m
        grown = keeps**2 * self.covariance_m2 + ((1 - keeps**2) * limit_m2 + self._jitter_m2) * _EYE
        self.covariance_m2 = grown * min(1.0, limit_m2 / max(float(np.trace(grown)) / 2, 1e-12))

    def log_prior(self, shifts_m: PointsM) -> Floats:
        """(S,) log density of shifts (S, 2) before the frame's sightings are looked at."""
        usual = log_density(shifts_m - self.mean_m, self.covariance_m2 + 1e-6 * _EYE)
        astray = log_density(shifts_m, (self.limit_m2 + 1e-6) * _EYE)
        return np.logaddexp(np.log(1 - _LOST_SHARE) + usual, np.log(_LOST_SHARE) + astray)

    def forget(self) -> None:
        """Go back to knowing nothing: the shift had gone astray."""
        self.mean_m, self.covariance_m2 = np.zeros(2), self.limit_m2 * _EYE

    def fit(self, gaps_m: PointsM, covariances_m2: Floats) -> FittedShift:
        """The shift by matched objects: M gaps between seen and known places, (M, 2) with (M, 2, 2)."""
        trusts = np.linalg.inv(covariances_m2)
        own = np.linalg.inv(self.covariance_m2 + 1e-8 * _EYE)
        total = own + trusts.sum(axis=0)
        weighted = np.einsum("mab,mb->ma", trusts, gaps_m)
        sum_weighted = own @ self.mean_m + weighted.sum(axis=0)
        covariance = np.linalg.inv(total)
        others_m2 = np.linalg.inv(total - trusts)
        others_m = np.einsum("mab,mb->ma", others_m2, sum_weighted - weighted)
        return FittedShift(covariance @ sum_weighted, covariance, others_m, others_m2)

    def settle(self, fitted: FittedShift, matched: int, shared_sigma_m: float) -> None:
        """Take a frame's shift over; several objects together teach how much it changes between frames."""
        if matched >= 3:
            jump = fitted.shift_m - self.mean_m
            seen_m2 = float(np.clip(jump @ jump / 2 - np.trace(fitted.covariance_m2) / 2, 0, shared_sigma_m**2))
            least_m2 = (_LEAST_JITTER * shared_sigma_m) ** 2
            self._jitter_m2 = max((1 - _LEARNS) * self._jitter_m2 + _LEARNS * seen_m2, least_m2)
        self.mean_m, self.covariance_m2 = fitted.shift_m, fitted.covariance_m2
