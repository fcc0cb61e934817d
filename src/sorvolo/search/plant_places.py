"""Where people and things are planted: all over the ground that was seen, far enough apart not to meddle; or, while a
flight goes on, all over the ground that it may come to see."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sorvolo.geometry.arrays import Floats, Mask, PointsM
from sorvolo.search.cells import Cells
from sorvolo.search.conditions import Conditions

_ROOM_M = {"person": 4.0, "car": 10.0, "small object": 3.0}  # around one that is planted, across
_OTHER_ROOM_M = 5.0  # of a class of a user's own model


_TRIES = 40  # cells for one plant, until there is no room for it in a round
_MOST_ROUNDS = 40  # by choice: a map without room ends


@dataclass(frozen=True, eq=False)
class PlantPlace:
    """Where one plant of a class stands, (2,) site metres."""

    label: str
    place_m: Floats

    @classmethod
    def at(cls, label: str, x_m: float, y_m: float) -> "PlantPlace":
        """One at these site metres."""
        return cls(label, np.array([x_m, y_m], np.float64))


def plant_places(
    cells: Cells,
    seen: Conditions,
    labels: Sequence[str],
    plants: int,
    *,
    keep_off_m: Sequence[Floats],
    free_m: float,
    rng: np.random.Generator,
    usable: Mask,
) -> list[list[PlantPlace]]:
    """Rounds of places: this many of each class in all, those of a round so far apart that all stand at once.

    Places lie in `usable` cells (N,) and `free_m` away from all of `keep_off_m`. Cells with few views are taken as
    often as those with many, which most ground has. Fewer are given where the ground has no room for more in 40 rounds.
    """
    chances = _chances(seen, usable)
    if not chances.sum():
        return []
    left, taken_m = dict.fromkeys(labels, plants), np.reshape(keep_off_m, (-1, 2))
    rounds: list[list[PlantPlace]] = []
    while any(left.values()) and len(rounds) < _MOST_ROUNDS:
        placed: list[PlantPlace] = []
        for label in sorted(left, key=lambda name: -_room_m(name)):
            for _ in range(left[label]):
                place_m = _free_place(cells, chances, label, placed, taken_m, free_m, rng, _TRIES)
                if place_m is None:
                    break
                placed.append(PlantPlace(label, place_m))
                left[label] -= 1
        if not placed:
            break
        rounds.append(placed)
    return rounds


# How dense a field of plants is; all by choice.
# of the side: plants stand in the middle of their square, so far from those of the next
_FREE = 0.5
_MOST_IN_VIEW = 80.0  # squares that a picture shows: from high up they are larger
_SQUARE_M = 7.0  # the side of the square that holds one plant, at least


class PlantField:
    """Places of plants all over endless ground, one in each square of it, whether anybody has seen it yet or not.

    So a frame that comes later shows the plants that stand where an earlier one looked. What needs more room than a
    square gives, as cars do, stands in every fourth square, the other classes of `labels` in the others. Nothing stands
    within `free_m` of `keep_off_m`. The squares fit `outline_m` (4, 2), the ground of a usual frame.
    """

    def __init__(
        self,
        labels: Sequence[str],
        outline_m: PointsM,
        *,
        keep_off_m: Sequence[Floats],
        free_m: float,
        seed: int,
        square_m: float = _SQUARE_M,
    ) -> None:
        self._seed, self._square_m = seed, square_m
        self._keep_off_m, self._free_m = np.reshape(keep_off_m, (-1, 2)), free_m
        self._side_m = _side_m(outline_m, square_m)
        self._wide = tuple(each for each in labels if _room_m(each) > self._side_m)
        self._others = tuple(each for each in labels if each not in self._wide)
        self._numbers: dict[
            tuple[int, int], int | None
        ] = {}  # by square; None: nothing stands there
        self.places: list[PlantPlace] = []
        """All that any frame came near, in the order of their numbers."""

    def fits(self, outline_m: PointsM) -> bool:
        """Whether a frame of this outline shows no more than twice as many plants as it should."""
        return _side_m(outline_m, self._square_m) <= 2**0.5 * self._side_m

    def near(self, outline_m: PointsM, reach_m: float) -> list[int]:
        """The numbers of the plants of all squares that lie within `reach_m` of the box around this ground (N, 2)."""
        low = np.floor((np.min(outline_m, axis=0) - reach_m) / self._side_m).astype(int)
        high = np.floor((np.max(outline_m, axis=0) + reach_m) / self._side_m).astype(int)
        numbers = [
            self._number(column, row)
            for row in range(low[1], high[1] + 1)
            for column in range(low[0], high[0] + 1)
        ]
        return [each for each in numbers if each is not None]

    def _number(self, column: int, row: int) -> int | None:
        if (column, row) not in self._numbers:
            place = self._sown(column, row)
            self._numbers[column, row] = None if place is None else len(self.places)
            if place is not None:
                self.places.append(place)
        return self._numbers[column, row]

    def _sown(self, column: int, row: int) -> PlantPlace | None:
        """What stands in a square."""
        labels = self._wide if self._wide and column % 2 == row % 2 == 0 else self._others
        if not labels:
            return None
        rng = np.random.default_rng([self._seed, 43, column & 0xFFFFFFFF, row & 0xFFFFFFFF])
        place_m = (np.array([column, row]) + 0.5 + _FREE * rng.uniform(-0.5, 0.5, 2)) * self._side_m
        label = labels[int(rng.integers(len(labels)))]
        least_m = max(self._free_m, _room_m(label) / 2 + 1.0)
        if len(self._keep_off_m) and np.hypot(*(self._keep_off_m - place_m).T).min() < least_m:
            return None
        return PlantPlace(label, place_m)


def _side_m(outline_m: PointsM, square_m: float) -> float:
    """The side of squares of which a frame shows as many as it should."""
    wide_m2 = float(np.prod(np.ptp(outline_m, axis=0)))
    return max(square_m, (wide_m2 / _MOST_IN_VIEW) ** 0.5)


def seeded(seed: int) -> np.random.Generator:
    """The random numbers that places are drawn by."""
    return np.random.default_rng([seed, 41])


def _chances(seen: Conditions, usable: Mask) -> Floats:
    """(N,) how often each cell is taken: half by area, half evenly over the numbers of views."""
    chosen = usable & seen.seen
    if not chosen.any():
        return np.zeros(len(usable))
    bins = np.floor(2 * np.log2(np.maximum(seen.views, 1))).astype(int)
    counts = np.bincount(bins[chosen], minlength=bins.max() + 1)
    by_views = np.where(chosen, 1.0 / np.maximum(counts[bins], 1), 0.0)
    return 0.5 * chosen / chosen.sum() + 0.5 * by_views / by_views.sum()


def _free_place(
    cells: Cells,
    chances: Floats,
    label: str,
    placed: Sequence[PlantPlace],
    keep_off_m: PointsM,
    free_m: float,
    rng: np.random.Generator,
    tries: int,
) -> Floats | None:
    for index in rng.choice(len(chances), tries, p=chances / chances.sum()):
        place_m = cells.centres_m[index] + rng.uniform(-0.5, 0.5, 2) * cells.cell_m
        if len(keep_off_m) and np.hypot(*(keep_off_m - place_m).T).min() < max(
            free_m, _room_m(label) / 2 + 1.0
        ):
            continue
        if all(
            np.hypot(*(each.place_m - place_m)) > (_room_m(each.label) + _room_m(label)) / 2
            for each in placed
        ):
            return np.asarray(place_m, np.float64)
    return None


def _room_m(label: str) -> float:
    return _ROOM_M.get(label, _OTHER_ROOM_M)
