"""The probability of detection as a function of the conditions, learnt from plants: logistic regression with its
uncertainty.

Few plants lie in any one cell, so cells of like conditions lend each other theirs: the chance that a plant is found is
a logistic function of the conditions, with weights held near zero (Gelman et al. 2008), and its uncertainty follows
from the weights' own (Laplace's approximation).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sorvolo.geometry.arrays import Floats, Mask, frozen

_SLOPE_SIGMA = 0.5  # of a weight, for one standard deviation of its condition
_CHANCE_SIGMA = 2.5  # of the log odds
_FARTHEST = 2.5  # standard deviations: beyond what plants covered, nothing is extrapolated
_LEAST_SPREAD = 0.05  # of a condition: what hardly varies explains nothing
_DRAWS = 400  # of the weights, for the interval
_STEPS = 40  # of Newton's method, at most
_PARTS = 5


@dataclass(frozen=True, eq=False)
class Recall:
    """A fitted regression: `middle` and `spread` (K,) of the conditions, `weights` (K + 1,) with their covariance."""

    middle: Floats
    spread: Floats
    weights: Floats
    covariance: Floats
    plants: int
    found: int

    def __post_init__(self) -> None:
        for name in ("middle", "spread", "weights", "covariance"):
            object.__setattr__(self, name, frozen(getattr(self, name)))

    def of(self, columns: Floats) -> "Chances":
        """The probability of detection under conditions (N, K); NaN where these are."""
        rows = self._rows(columns)
        known = np.isfinite(rows).all(axis=1)
        rng = np.random.default_rng(1)
        drawn = rng.multivariate_normal(self.weights, self.covariance, _DRAWS, method="cholesky")
        mean, low, high = (np.full(len(rows), np.nan) for _ in range(3))
        for part in np.array_split(np.flatnonzero(known), max(1, int(known.sum()) // 5000)):
            chances = _logistic(rows[part] @ drawn.T)
            mean[part] = chances.mean(axis=1)
            low[part], high[part] = np.percentile(chances, (5, 95), axis=1)
        return Chances(mean, low, high)

    def pulls(self, columns: Floats) -> Floats:
        """(N, K) by how much each condition lowers (below 0) or raises the log odds from the plants' usual ones."""
        return self._rows(columns)[:, 1:] * self.weights[1:]

    def _rows(self, columns: Floats) -> Floats:
        scaled = np.clip((columns - self.middle) / self.spread, -_FARTHEST, _FARTHEST)
        return np.column_stack([np.ones(len(scaled)), scaled])


@dataclass(frozen=True, eq=False)
class Chances:
    """(N,) probabilities, and the bounds of the interval that holds the true one in nine of ten cases."""

    mean: Floats
    low: Floats
    high: Floats

    def __post_init__(self) -> None:
        for name in ("mean", "low", "high"):
            object.__setattr__(self, name, frozen(getattr(self, name)))

    def at(self, rows: NDArray[np.intp]) -> "Chances":
        """Of M of them, by their numbers (M,); below 0: unknown."""
        return Chances(
            *(np.where(rows >= 0, each[rows], np.nan) for each in (self.mean, self.low, self.high))
        )


def fit_recall(columns: Floats, found: Mask) -> Recall:
    """The regression of which plants were found, (N,), on the conditions of their places, (N, K); N at least 1."""
    middle = columns.mean(axis=0)
    spread = np.maximum(columns.std(axis=0), _LEAST_SPREAD)
    scaled = np.clip((columns - middle) / spread, -_FARTHEST, _FARTHEST)
    rows = np.column_stack([np.ones(len(scaled)), scaled])
    prior = np.diag([1 / _CHANCE_SIGMA**2] + [1 / _SLOPE_SIGMA**2] * columns.shape[1])
    right = found.astype(np.float64)
    weights = np.zeros(rows.shape[1])
    for _ in range(_STEPS):
        chances = _logistic(rows @ weights)
        curvature = (rows * (chances * (1 - chances))[:, None]).T @ rows + prior
        step = np.linalg.solve(curvature, rows.T @ (right - chances) - prior @ weights)
        weights = weights + step * min(1.0, 2.0 / max(float(np.abs(step).max()), 1e-9))
        if np.abs(step).max() < 1e-8:
            break
    chances = _logistic(rows @ weights)
    curvature = (rows * (chances * (1 - chances))[:, None]).T @ rows + prior
    return Recall(middle, spread, weights, np.linalg.inv(curvature), len(found), int(found.sum()))


def map_chances(recall: Recall | None, columns: Floats, hidden: Mask) -> Chances:
    """The chances of cells under conditions (N, K): 0 where crowns hide the ground, unknown without a regression."""
    unknown = np.full(len(columns), np.nan)
    open_ground = Chances(unknown, unknown, unknown) if recall is None else recall.of(columns)
    return Chances(
        *(
            np.where(hidden, 0.0, each)
            for each in (open_ground.mean, open_ground.low, open_ground.high)
        )
    )


def held_out_chances(columns: Floats, found: Mask) -> Floats:
    """(N,) each plant's probability by a regression on the others: a fifth is left out in turn."""
    chances = np.full(len(found), np.nan)
    for part in range(min(_PARTS, len(found))):
        out = np.arange(len(found)) % _PARTS == part
        if out.any() and not out.all():
            chances[out] = fit_recall(columns[~out], found[~out]).of(columns[out]).mean
    return chances


def _logistic(odds: Floats) -> Floats:
    return 1.0 / (1.0 + np.exp(-np.clip(odds, -35, 35)))


@dataclass(frozen=True)
class SearchFigures:
    """Of one class over the wanted ground. Chances count unseen ground as 0.

    `pod` with its interval is the chance that one who lay anywhere in the area was found, by all flights together.
    `swept_m2` is the ground times its chance, summed over the flights: effort adds up, even over the same ground.
    `coverage` is that over the area, so it may exceed 1. `sweep_width_m` is all ground that the flights saw, within the
    area or not, times its chance, over the path of all flights; NaN without a path, or where no cell was seen.
    `random_pod` is what Koopman's formula of random search, 1 - exp(-coverage), makes of it.
    """

    area_m2: float
    seen_m2: float
    pod: float
    pod_low: float
    pod_high: float
    swept_m2: float
    sweep_width_m: float
    coverage: float
    random_pod: float


@dataclass(frozen=True)
class Segment:
    """A piece of the area with the probability that the missing is in it: POA, POD and POS = POA x POD.

    `left` is the probability that the missing is in it and was not found.
    """

    name: str
    poa: float
    pod: float
    pos: float
    left: float
    area_m2: float
    seen_m2: float


def together(flights: Sequence[Chances]) -> Chances:
    """One or more flights over the same cells: 1 - prod(1 - p), the flights taken as independent looks.

    What no flight saw stays NaN. The bounds are those of all flights being as bad, or as good, as they may be.
    """
    seen = np.any([np.isfinite(each.mean) for each in flights], axis=0)
    mean, low, high = (
        np.where(
            seen,
            1 - np.prod([1 - np.nan_to_num(getattr(each, name)) for each in flights], axis=0),
            np.nan,
        )
        for name in ("mean", "low", "high")
    )
    return Chances(mean, low, high)


def figures(
    flights: Sequence[Chances], wanted: Mask, cell_m: float, path_m: float
) -> SearchFigures:
    """The figures of the wanted cells, (N,), of one or more flights; `path_m` is how far their cameras flew in all."""
    cell_m2 = cell_m**2
    inside = np.asarray(wanted, bool)
    area_m2 = float(inside.sum()) * cell_m2
    total = together(flights)
    mean, low, high = (np.nan_to_num(each[inside]) for each in (total.mean, total.low, total.high))
    swept_m2 = sum(float(np.nansum(each.mean[inside])) for each in flights) * cell_m2
    anywhere_m2 = sum(float(np.nansum(each.mean)) for each in flights) * cell_m2
    is_seen = any(np.isfinite(each.mean).any() for each in flights)
    width_m = anywhere_m2 / path_m if path_m > 0 and is_seen else float("nan")
    coverage = swept_m2 / area_m2 if area_m2 else 0.0
    pod, pod_low, pod_high = (
        float(each.mean()) if len(each) else 0.0 for each in (mean, low, high)
    )
    return SearchFigures(
        area_m2,
        float(np.isfinite(total.mean[inside]).sum()) * cell_m2,
        pod,
        pod_low,
        pod_high,
        swept_m2,
        width_m,
        coverage,
        float(1 - np.exp(-coverage)),
    )


def segment(
    name: str, poa: float, chances: Chances, inside: Mask, cell_m: float, area_m2: float
) -> Segment:
    """A segment's figures. `inside` (N,) are its cells; ground of it beyond all cells, of `area_m2`, was not seen."""
    sum_of_chances = float(np.nansum(chances.mean[inside])) * cell_m**2
    pod = min(1.0, sum_of_chances / area_m2) if area_m2 else 0.0
    seen_m2 = float(np.isfinite(chances.mean[inside]).sum()) * cell_m**2
    return Segment(name, poa, pod, poa * pod, poa * (1 - pod), area_m2, min(seen_m2, area_m2))


def path_length_m(places_m: Sequence[Floats]) -> float:
    """The length over ground of a way over places, (2,) or (3,) each, in order."""
    return (
        float(np.hypot(*np.diff(np.array(places_m)[:, :2], axis=0).T).sum())
        if len(places_m) > 1
        else 0.0
    )
