"""Bodies planted on the floor, hidden by the gaps that each view really has: how many of them a search would find."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from sorvolo.canopy.finds import LEAST_ANOMALY, Find, judge, spot_window
from sorvolo.canopy.integral import (
    LEAST_VIEWS,
    Picture,
    UnderTrees,
    lay,
    pixels_from_cells,
    seeing,
)
from sorvolo.geometry.arrays import Floats, Floats32, PointsM, shrunk
from sorvolo.geometry.summary import wilson
from sorvolo.heights.lattice import Lattice
from sorvolo.heights.views import View

_BODY_M = 1.7, 0.5
_WARMER = (
    35.0,
    140.0,
)  # grey levels above the floor, as people that a search plants into open ground
_SENSOR_SIGMA = 2.0  # grey levels: what one spot of floor differs by in two views, at the least
_COARSE_M, _WINDOW_CELLS = 0.3, 64
_AROUND_M = 3.0  # side of the ground whose crowns are of one density
_FROM_FIND_M = 6.0  # a plant is no find


@dataclass(frozen=True, eq=False)
class PlantedFloor:
    """What was planted and found: `places_m` (N, 2), `found` (N,), `free_share` (N,) of the views that show the floor
    there. `pod`, with a 90 % interval, is of a person somewhere on the floor that enough views show."""

    places_m: PointsM
    found: Floats
    free_share: Floats

    @property
    def pod(self) -> tuple[float, float, float]:
        """The share found, its lower and its upper bound."""
        hits = int(self.found.sum())
        return (hits / max(1, len(self.found)), *wilson(hits, len(self.found)))


def plant_on_floor(
    under: UnderTrees,
    views: Sequence[View],
    picture: Picture,
    finds: Sequence[Find],
    plants: int,
    seed: int = 0,
) -> PlantedFloor:
    """Plant warm bodies on the floor of thermal pictures, each hidden as the floor is, and judge them as finds are."""
    draw = np.random.default_rng(seed)
    lattice = under.lattice
    taken = (under.views < LEAST_VIEWS).astype(np.uint8)
    for find in finds:
        at = lattice.cells_from_site(find.place_m[None, :2])[0]
        cv2.circle(taken, np.round(at).astype(int).tolist(), round(_FROM_FIND_M / lattice.cell_m), 1, -1)  # fmt: skip
    rows, columns = np.nonzero(taken == 0)
    chosen = draw.permutation(len(rows))[:plants]
    found, free = [], []
    for row, column in zip(rows[chosen], columns[chosen]):
        cell = int(column), int(row)
        up_m = float(under.floor_m[row, column])
        window = spot_window(under, cell)
        near = seeing(views, window, up_m)
        laid = np.stack([lay(views[k], picture(k), window, up_m)[..., 0] for k in near])
        floor, shown, share = gaps(laid, window.cell_m)
        # a lying body in the middle of the window: its cover, (H, W), 0 to 1
        side = window.width / 2 - 0.5
        axes = tuple(each / window.cell_m for each in _BODY_M)
        body = np.zeros(window.shape, np.float32)
        cv2.ellipse(body, ((side, side), axes, float(draw.uniform(0, 180))), 1.0, -1)
        added = np.nan_to_num((floor + draw.uniform(*_WARMER) - laid) * shown * body)
        planted = [
            picture(k) + _in_picture(views[k], more, window, up_m) for k, more in zip(near, added)
        ]
        verdict = judge(under, cell, [views[k] for k in near], planted)
        sigma = abs(under.contrast[row, column] / (under.anomaly[row, column] or np.nan))
        found.append(isinstance(verdict, Find) and verdict.contrast >= LEAST_ANOMALY * sigma)
        free.append(float(np.average(np.nan_to_num(share), weights=body)))
    places_m = lattice.points_m()[rows[chosen], columns[chosen]]
    return PlantedFloor(places_m, np.array(found, float), np.array(free))


def free_share(under: UnderTrees, views: Sequence[View], picture: Picture) -> Floats32:
    """(H, W) the share of the views of each cell that crowns leave free; NaN where none sees it."""
    lattice = under.lattice.coarser(max(1, round(_COARSE_M / under.lattice.cell_m)))
    size = lattice.shape[::-1]
    floor_m = shrunk(under.floor_m, size)
    share = np.full(lattice.shape, np.nan, np.float32)
    for x0, y0, x1, y1 in lattice.windows(_WINDOW_CELLS):
        box, window = np.s_[y0:y1, x0:x1], lattice.window(x0, y0, x1, y1)
        numbers = seeing(views, window, floor_m[box])
        laid = [lay(views[k], picture(k), window, floor_m[box]).mean(axis=2) for k in numbers]
        if len(laid) > 1:
            share[box] = gaps(np.stack(laid), window.cell_m)[2]
    return np.asarray(cv2.resize(share, under.lattice.shape[::-1], interpolation=cv2.INTER_NEAREST))


def gaps(laid: Floats32, cell_m: float) -> tuple[Floats32, Floats32, Floats32]:
    """The floor's level, (H, W), each view's chance, (N, H, W), to show it, and the share of the views that do, (H, W).

    `laid` are N views on the floor, NaN outside. Views of the floor agree and those of crowns do not: each half of the
    views is held against the level that most of the other half agree on, and what crowns have at that level by chance
    is taken off.
    """
    levels = np.stack([_mode(laid[k::2]) for k in range(2)])
    off = np.abs(laid - levels[1 - np.arange(len(laid)) % 2])
    near, wide = 2 * _SENSOR_SIGMA, 6 * _SENSOR_SIGMA
    side = (2 * round(_AROUND_M / cell_m / 2) + 1,) * 2
    known, inside, beside = (
        cv2.blur(each.sum(axis=0).astype(np.float32), side)
        for each in (np.isfinite(off), off < near, (off >= near) & (off < wide))
    )
    with np.errstate(invalid="ignore", divide="ignore"):
        free = np.maximum(inside - beside * near / (wide - near), 0)
        chance = np.where(off < near, free / np.maximum(inside, 1e-6), 0)
        share = np.where(np.isfinite(off).any(axis=0), free / known, np.nan)
    return levels.mean(axis=0), chance.astype(np.float32), share.astype(np.float32)


def _mode(laid: Floats32) -> Floats32:
    """(H, W) the level that most of the views agree on, their mean there."""
    if not np.isfinite(laid).any():
        return np.full(laid.shape[1:], np.nan, np.float32)
    known = np.isfinite(laid)
    step = ((laid[known] - np.nanmin(laid)) / _SENSOR_SIGMA).astype(int) + 3
    steps = step.max() + 4  # three empty ones at either end: a level takes two on each side
    cell = np.nonzero(known.reshape(len(laid), -1))[1] * steps + step
    size = laid[0].size
    near, total = (
        each.reshape(size, steps)[:, 4:] - each.reshape(size, steps)[:, :-4]
        for each in (
            np.cumsum(np.bincount(cell, weights, size * steps)) for weights in (None, laid[known])
        )
    )
    best = near.argmax(axis=1)[:, None]
    shown = np.take_along_axis(near, best, 1)
    level = np.take_along_axis(total, best, 1) / np.maximum(shown, 1)
    return level.astype(np.float32).reshape(laid.shape[1:])


def _in_picture(view: View, laid: Floats32, window: Lattice, up_m: float) -> Floats32:
    """(H, W) of the view what lies on the floor of a window."""
    size = view.camera.width_px, view.camera.height_px
    return np.asarray(cv2.warpPerspective(laid, pixels_from_cells(view, window, up_m), size))
