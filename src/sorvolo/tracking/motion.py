"""How objects move on the ground: standing and moving kept side by side, weighted by what was seen.

The interacting multiple model filter (Blom and Bar-Shalom 1988) with two models of one state, east, north and their
speeds: an object stands, or goes on at nearly constant velocity. Arrays hold many objects at once: `means` (N, 2, 4),
`covariances` (N, 2, 4, 4) and `weights` (N, 2), the second axis being standing, moving.
"""

from dataclasses import dataclass, replace

import numpy as np

from sorvolo.geometry.arrays import Floats, PointsM, Rows

STANDS, MOVES = 0, 1
_LEAST_WEIGHT = 1e-4  # of a model: below it, it never came back
_EYE = np.eye(2)


@dataclass(frozen=True)
class Habits:
    """How a class moves: usual speed and how it changes, m/s and m/s per root second; how often it moves at all."""

    speed_m_s: float
    unsteadiness: float
    moving_share: float
    # per root second: people shift their weight, maps of neighbouring strips do not fit
    sway_m: float = 0.05


_STARTS_EVERY_S = 60.0  # of one whose class moves half of the time; seldom movers start more seldom
_STOPS_EVERY_S = 60.0  # by choice, as starts


HABITS = {
    "person": Habits(1.3, 0.15, 0.3),
    "car": Habits(8.0, 0.3, 0.2),
    "small object": Habits(0.6, 0.1, 0.02),
}
OTHER_HABITS = Habits(3.0, 0.3, 0.2)


@dataclass(frozen=True, eq=False)
class Motions:
    """What is known of the motion of N objects; `habits` (N, 4) as `habits_of` gives them."""

    means: Floats
    covariances: Floats
    weights: Floats
    habits: Floats

    def __len__(self) -> int:
        return len(self.means)

    def only(self, rows: Rows | slice) -> "Motions":
        """Some of the objects."""
        return Motions(
            self.means[rows], self.covariances[rows], self.weights[rows], self.habits[rows]
        )

    @property
    def likelier(self) -> Rows:
        """(N,) the likelier model of each."""
        return np.argmax(self.weights, axis=1)

    @property
    def places_m(self) -> PointsM:
        """(N, 2) where they are, by the likelier model: what may move seldom has moved far."""
        return self.means[np.arange(len(self)), self.likelier, :2]

    @property
    def place_covariances_m2(self) -> Floats:
        """(N, 2, 2) how well that is known."""
        return self.covariances[np.arange(len(self)), self.likelier, :2, :2]


def habits_of(label: str, unit_m: float) -> Floats:
    """(4,) a class's habits where one unit of the place is `unit_m` metres: its Habits, and how far it sways."""
    usual = HABITS.get(label, OTHER_HABITS)
    return np.array(
        [
            usual.speed_m_s / unit_m,
            usual.unsteadiness / unit_m,
            usual.moving_share,
            usual.sway_m / unit_m,
        ]
    )


def begun(places_m: PointsM, covariances_m2: Floats, habits: Floats) -> Motions:
    """Objects seen for the first time, (N, 2) with (N, 2, 2): their velocity is their class's guess."""
    count = len(places_m)
    means = np.zeros((count, 2, 4))
    means[:, :, :2] = places_m[:, None, :]
    covariances = np.zeros((count, 2, 4, 4))
    covariances[:, :, :2, :2] = covariances_m2[:, None]
    covariances[:, :, 2:, 2:] = (habits[:, 0] ** 2)[:, None, None, None] * _EYE
    return Motions(means, covariances, np.column_stack([1 - habits[:, 2], habits[:, 2]]), habits)


def predicted(motions: Motions, elapsed_s: Floats) -> Motions:
    """The same objects (N,) seconds later: models mixed as objects start and stop, then each moved on."""
    if not len(motions):
        return motions
    share = motions.habits[:, 2]
    starts = (1 - np.exp(-elapsed_s / _STARTS_EVERY_S)) * np.minimum(2 * share, 1.0)
    stops = 1 - np.exp(-elapsed_s / _STOPS_EVERY_S)
    turns = np.empty((len(motions), 2, 2))  # from, to
    turns[:, STANDS, STANDS], turns[:, STANDS, MOVES] = 1 - starts, starts
    turns[:, MOVES, STANDS], turns[:, MOVES, MOVES] = stops, 1 - stops
    flows = motions.weights[:, :, None] * turns
    weights = np.maximum(flows.sum(axis=1), _LEAST_WEIGHT)
    weights /= weights.sum(axis=1, keepdims=True)
    shares = flows / np.maximum(flows.sum(axis=1, keepdims=True), 1e-12)
    means = np.einsum("njk,nji->nki", shares, motions.means)
    apart = motions.means[:, :, None, :] - means[:, None, :, :]  # (N, from, to, 4)
    covariances = np.einsum("njk,njab->nkab", shares, motions.covariances)
    covariances += np.einsum("njk,njka,njkb->nkab", shares, apart, apart)
    means, covariances = _moved_on(means, covariances, elapsed_s, motions.habits)
    return Motions(means, covariances, weights, motions.habits)


def corrected(motions: Motions, places_m: PointsM, covariances_m2: Floats) -> Motions:
    """The objects once more after each was seen at (N, 2) with (N, 2, 2)."""
    gaps = places_m[:, None, :] - motions.means[:, :, :2]
    spread = motions.covariances[:, :, :2, :2] + covariances_m2[:, None]
    gains = motions.covariances[:, :, :, :2] @ np.linalg.inv(spread)
    means = motions.means + np.einsum("nkab,nkb->nka", gains, gaps)
    covariances = motions.covariances - gains @ motions.covariances[:, :, :2, :]
    covariances = (covariances + covariances.swapaxes(2, 3)) / 2
    fits = np.log(motions.weights) + log_density(gaps, spread)
    weights = np.maximum(np.exp(fits - fits.max(axis=1, keepdims=True)), _LEAST_WEIGHT)
    return replace(
        motions,
        means=means,
        covariances=covariances,
        weights=weights / weights.sum(axis=1, keepdims=True),
    )


def log_density(gaps: Floats, spread: Floats) -> Floats:
    """(...,) log of the Gaussian density of (..., d) with covariances (..., d, d)."""
    squared = np.sum(gaps * np.linalg.solve(spread, gaps[..., None])[..., 0], axis=-1)
    size = gaps.shape[-1]
    return -0.5 * (squared + np.log(np.linalg.det(spread)) + size * np.log(2 * np.pi))


def _moved_on(
    means: Floats, covariances: Floats, elapsed_s: Floats, habits: Floats
) -> tuple[Floats, Floats]:
    """The means (N, 2, 4) and covariances (N, 2, 4, 4) of both models so much later, each by its own motion."""
    means, covariances = means.copy(), covariances.copy()
    t = elapsed_s[:, None, None]
    means[:, STANDS, 2:] = 0.0
    covariances[:, STANDS, :2, 2:] = 0.0
    covariances[:, STANDS, 2:, :2] = 0.0
    covariances[:, STANDS, 2:, 2:] = (habits[:, 0] ** 2)[:, None, None] * _EYE
    covariances[:, STANDS, :2, :2] += (habits[:, 3] ** 2)[:, None, None] * t * _EYE
    means[:, MOVES, :2] += elapsed_s[:, None] * means[:, MOVES, 2:]
    step = np.broadcast_to(np.eye(4), (len(means), 4, 4)).copy()
    step[:, :2, 2:] = t * _EYE
    moved = step @ covariances[:, MOVES] @ step.swapaxes(1, 2)
    noise = (habits[:, 1] ** 2)[:, None, None]
    moved[:, :2, :2] += noise * t**3 / 3 * _EYE
    moved[:, :2, 2:] += noise * t**2 / 2 * _EYE
    moved[:, 2:, :2] += noise * t**2 / 2 * _EYE
    moved[:, 2:, 2:] += noise * t * _EYE
    covariances[:, MOVES] = moved
    return means, covariances
