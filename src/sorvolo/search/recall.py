"""The probability of detection as a function of the conditions, learnt from plants: logistic regression with its
uncertainty.

Few plants lie in any one cell, so cells of like conditions lend each other theirs: the chance that a plant is found is
a logistic function of the conditions, with weights held near zero (Gelman et al. 2008), and its uncertainty follows
from the weights' own (Laplace's approximation).
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from sorvolo.geometry.arrays import Floats, Mask, frozen


@dataclass(frozen=True)
class RecallSettings:
    """What is held for likely before any plant, and how the regression is computed."""

    slope_sigma: float = 0.5  # of a weight, for one standard deviation of its condition
    chance_sigma: float = 2.5  # of the log odds
    # standard deviations: beyond what plants covered, nothing is extrapolated
    farthest: float = 2.5
    least_spread: float = 0.05  # of a condition: what hardly varies explains nothing
    draws: int = 400  # of the weights, for the interval
    steps: int = 40  # of Newton's method, at most


@dataclass(frozen=True, eq=False)
class Recall:
    """A fitted regression: `middle` and `spread` (K,) of the conditions, `weights` (K + 1,) with their covariance."""

    middle: Floats
    spread: Floats
    weights: Floats
    covariance: Floats
    plants: int
    found: int
    settings: RecallSettings = field(default_factory=RecallSettings)

    def __post_init__(self) -> None:
        for name in ("middle", "spread", "weights", "covariance"):
            object.__setattr__(self, name, frozen(getattr(self, name)))

    def of(self, columns: Floats) -> "Chances":
        """The probability of detection under conditions (N, K); NaN where these are."""
        rows = self._rows(columns)
        known = np.isfinite(rows).all(axis=1)
        rng = np.random.default_rng(1)
        drawn = rng.multivariate_normal(
            self.weights, self.covariance, self.settings.draws, method="cholesky"
        )
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
        farthest = self.settings.farthest
        scaled = np.clip((columns - self.middle) / self.spread, -farthest, farthest)
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


def fit_recall(columns: Floats, found: Mask, settings: RecallSettings = RecallSettings()) -> Recall:
    """The regression of which plants were found, (N,), on the conditions of their places, (N, K); N at least 1."""
    middle = columns.mean(axis=0)
    spread = np.maximum(columns.std(axis=0), settings.least_spread)
    scaled = np.clip((columns - middle) / spread, -settings.farthest, settings.farthest)
    rows = np.column_stack([np.ones(len(scaled)), scaled])
    prior = np.diag(
        [1 / settings.chance_sigma**2] + [1 / settings.slope_sigma**2] * columns.shape[1]
    )
    right = found.astype(np.float64)
    weights = np.zeros(rows.shape[1])
    for _ in range(settings.steps):
        chances = _logistic(rows @ weights)
        curvature = (rows * (chances * (1 - chances))[:, None]).T @ rows + prior
        step = np.linalg.solve(curvature, rows.T @ (right - chances) - prior @ weights)
        weights = weights + step * min(1.0, 2.0 / max(float(np.abs(step).max()), 1e-9))
        if np.abs(step).max() < 1e-8:
            break
    chances = _logistic(rows @ weights)
    curvature = (rows * (chances * (1 - chances))[:, None]).T @ rows + prior
    return Recall(
        middle, spread, weights, np.linalg.inv(curvature), len(found), int(found.sum()), settings
    )


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


def held_out_chances(columns: Floats, found: Mask, parts: int = 5) -> Floats:
    """(N,) each plant's probability by a regression on the others: every `parts`-th is left out in turn."""
    chances = np.full(len(found), np.nan)
    for part in range(min(parts, len(found))):
        out = np.arange(len(found)) % parts == part
        if out.any() and not out.all():
            chances[out] = fit_recall(columns[~out], found[~out]).of(columns[out]).mean
    return chances


def _logistic(odds: Floats) -> Floats:
    return np.asarray(1.0 / (1.0 + np.exp(-np.clip(odds, -35, 35))), np.float64)
