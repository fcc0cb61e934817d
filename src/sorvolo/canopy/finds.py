"""People on the forest floor: warm or odd spots of the integral that only something lying there can cause."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import cv2
import numpy as np

from sorvolo.canopy.integral import (
    LEAST_VIEWS,
    Floor,
    Picture,
    UnderTrees,
    against_surroundings,
    focus,
    integrate,
    lay,
    seeing,
)
from sorvolo.errors import InputError
from sorvolo.geometry.arrays import Floats32, Numbers, PointsM, square
from sorvolo.heights.lattice import Lattice
from sorvolo.heights.views import View

# by choice, after looks at simulated forests and at one real one
LEAST_ANOMALY = 5.0  # sigmas
_APART_M = 1.5  # finds that are nearer are one
_REACH_M = 3.0  # of the ground that is looked at around a find
_AREA_M2 = (0.08, 2.0)  # at half the contrast
_LONGEST_M = 2.5
_HALF = 0.25  # of the contrast that each half of the views shows
_FADED = 0.6  # of the contrast that is left where the views have moved apart ...
_APART_BY_M = 2.4  # ... by this, one sigma
_LEAST_SLOPE = 0.08  # sigma of the views' slopes: from fewer directions all heights look sharp
_BEST_PICTURES = 3


@dataclass(frozen=True, eq=False)
class Find:
    """Something of a person's size on the floor.

    `size_m` is its length and width at half the contrast. `anomaly` is in sigmas of the ground around, `contrast` in the pictures' own levels. `weakest_half` and `faded` are shares of its contrast: what the weakest
    half of the views shows, and what is left above or below the floor. `pictures` names those that show it best.
    """

    place_m: PointsM  # (3,) site
    anomaly: float
    contrast: float
    size_m: tuple[float, float]
    views: int
    weakest_half: float
    faded: float
    pictures: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class Finds:
    """The finds, strongest first, and why other spots are none, counted."""

    people: tuple[Find, ...]
    refused: Mapping[str, int]


def find_people(under: UnderTrees, views: Sequence[View], picture: Picture) -> Finds:
    """The spots of the integral that a person on the floor would leave."""
    lattice, anomaly = under.lattice, np.nan_to_num(under.anomaly)
    side = 2 * round(_APART_M / lattice.cell_m) + 1
    highest = cv2.dilate(anomaly, square(side))
    rows, columns = np.nonzero((anomaly == highest) & (anomaly >= LEAST_ANOMALY))
    people, refused = [], Counter[str]()
    for at in np.argsort(-anomaly[rows, columns]):
        cell = int(columns[at]), int(rows[at])
        window = spot_window(under, cell)
        numbers = seeing(views, window, float(under.floor_m[cell[1], cell[0]]))
        images = [picture(k) for k in numbers]
        found = judge(under, cell, [views[k] for k in numbers], images)
        if isinstance(found, Find):
            people.append(found)
        else:
            refused[found] += 1
    return Finds(tuple(people), MappingProxyType(dict(refused)))


def spot_window(under: UnderTrees, cell: tuple[int, int]) -> Lattice:
    """The cells around one, (column, row)."""
    reach = round(_REACH_M / under.lattice.cell_m)
    return under.lattice.window(*(n - reach for n in cell), *(n + reach + 1 for n in cell))


def judge(
    under: UnderTrees, cell: tuple[int, int], views: Sequence[View], images: Sequence[Floats32]
) -> Find | str:
    """A find, or why the spot is none, by the views that see it and their levelled pictures."""
    window = spot_window(under, cell)
    reach = window.width // 2
    up_m = float(under.floor_m[cell[1], cell[0]])
    place_m = np.append(window.points_m()[reach, reach], up_m)
    mean, laid = _mean(views, images, window, up_m)
    spot = against_surroundings(mean, window.cell_m)
    direction = spot[reach, reach] / np.linalg.norm(spot[reach, reach])
    spot = spot @ direction
    full = spot[reach, reach]

    _, parts = cv2.connectedComponents((spot > full / 2).astype(np.uint8))
    part = (parts == parts[reach, reach]).astype(np.uint8)
    area_m2 = float(part.sum()) * window.cell_m**2
    _, sides, _ = cv2.minAreaRect(np.argwhere(part).astype(np.float32))
    if not _AREA_M2[0] <= area_m2 <= _AREA_M2[1] or max(sides) * window.cell_m > _LONGEST_M:
        return "not a person's size"

    eyes_m = np.array([each.site_from_camera.translation_m for each in views]) - place_m
    slopes = eyes_m[:, :2] / eyes_m[:, 2:]
    shows = np.isfinite(laid[:, reach, reach, 0])
    spread = np.sqrt(slopes[shows].var(axis=0).sum())
    if spread < _LEAST_SLOPE:
        return "seen from one direction"

    near = np.s_[reach - 3 : reach + 4, reach - 3 : reach + 4]

    def share(mean: Floats32) -> float:
        seen = against_surroundings(mean, window.cell_m) @ direction
        return float(np.nanmax(seen[near], initial=-np.inf) / full)

    turns = np.arange(len(views)) % 2 == 0
    splits = [turns, *(slopes > np.median(slopes[shows], axis=0)).T]
    halves = [
        each
        for split in splits
        for each in (split, ~split)
        if (each & shows).sum() >= LEAST_VIEWS // 3
    ]
    weakest = min(share(average(laid[each])) for each in halves)
    if weakest < _HALF:
        return "not in each half of the views"

    step_m = _APART_BY_M / spread
    profile = [
        share(_mean(views, images, window, up_m + k * step_m)[0]) for k in (-1, -0.5, 0.5, 1)
    ]
    faded = max(profile[0], profile[3])
    if faded > _FADED or max(profile) > 1:
        return "at another height than the floor"

    alone = np.array([share(each) for each in laid])
    best = np.argsort(-np.nan_to_num(alone, neginf=-1e9))[:_BEST_PICTURES]
    return Find(
        place_m,
        float(under.anomaly[cell[1], cell[0]]),
        float(full),
        (max(sides) * window.cell_m, min(sides) * window.cell_m),
        int(shows.sum()),
        weakest,
        faded,
        tuple(views[k].name for k in best),
    )


def _mean(
    views: Sequence[View], images: Sequence[Floats32], window: Lattice, up_m: float
) -> tuple[Floats32, Numbers]:
    """(H, W, bands) the views' mean on a window at one height, and (N, H, W, bands) each of them."""
    laid = np.stack([lay(view, image, window, up_m) for view, image in zip(views, images)])
    return average(laid), laid


def average(laid: Floats32) -> Floats32:
    """(H, W, bands) the mean of N, NaN where none shows anything."""
    with np.errstate(invalid="ignore"):
        return np.asarray(np.nansum(laid, axis=0) / np.isfinite(laid).sum(axis=0), np.float32)


def look_under_trees(
    views: Sequence[View], picture: Picture, lattice: Lattice, low_m: float, high_m: float
) -> tuple[UnderTrees, Floor, Finds]:
    """The floor of these cells between two heights (site metres up) by focus, its integral and the people on it.

    Pictures have the size of their views' cameras and no distortion. Cameras must be known to about 0.25 m and 0.3
    degrees. Raises InputError where no floor comes into focus, or too few views show any of it.
    """
    floor = focus(views, picture, lattice, low_m, high_m)
    under = integrate(views, picture, lattice, floor.on(lattice))
    if (most := int(under.views.max())) < LEAST_VIEWS:
        raise InputError(
            f"no spot is in more than {most} pictures, {LEAST_VIEWS} are needed to look through trees; fly strips 2 to 4 m "
            "apart with a picture every 2 m, and map all pictures as photos"
        )
    return under, floor, find_people(under, views, picture)
