"""Where people and things are planted: all over the ground that was seen, far enough apart not to meddle."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sorvolo.geometry.arrays import Floats, Mask, PointsM
from sorvolo.search.cells import Cells
from sorvolo.search.conditions import Conditions

_ROOM_M = {"person": 4.0, "car": 10.0, "small object": 3.0}  # around one that is planted, across
_OTHER_ROOM_M = 5.0  # of a class of a user's own model


@dataclass(frozen=True)
class PlaceSettings:
    """How long places are searched for."""

    tries: int = 40  # cells for one plant, until there is no room for it in a round
    most_rounds: int = 40  # by choice: a map without room ends


@dataclass(frozen=True, eq=False)
class PlantPlace:
    """Where one plant of a class stands, (2,) site metres."""

    label: str
    place_m: Floats


def plant_places(
    cells: Cells, seen: Conditions, labels: Sequence[str], plants: int, *, keep_off_m: Sequence[Floats], free_m: float,
    rng: np.random.Generator, usable: Mask, settings: PlaceSettings = PlaceSettings(),
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
    while any(left.values()) and len(rounds) < settings.most_rounds:
        placed: list[PlantPlace] = []
        for label in sorted(left, key=lambda name: -_room_m(name)):
            for _ in range(left[label]):
                place_m = _free_place(cells, chances, label, placed, taken_m, free_m, rng, settings.tries)
                if place_m is None:
                    break
                placed.append(PlantPlace(label, place_m))
                left[label] -= 1
        if not placed:
            break
        rounds.append(placed)
    return rounds


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
    cells: Cells, chances: Floats, label: str, placed: Sequence[PlantPlace], keep_off_m: PointsM, free_m: float,
    rng: np.random.Generator, tries: int,
) -> Floats | None:
    for index in rng.choice(len(chances), tries, p=chances / chances.sum()):
        place_m = cells.centres_m[index] + rng.uniform(-0.5, 0.5, 2) * cells.cell_m
        if len(keep_off_m) and np.hypot(*(keep_off_m - place_m).T).min() < max(free_m, _room_m(label) / 2 + 1.0):
            continue
        if all(
            np.hypot(*(each.place_m - place_m)) > (_room_m(each.label) + _room_m(label)) / 2 for each in placed
        ):
            return np.asarray(place_m, np.float64)
    return None


def _room_m(label: str) -> float:
    return _ROOM_M.get(label, _OTHER_ROOM_M)
