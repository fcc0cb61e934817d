"""How far off the middle of a change may lie on the map: one sigma per axis."""

from dataclasses import dataclass

import numpy as np

from sorvolo.change.shape.outlines import Measures
from sorvolo.geometry.arrays import PointsM


@dataclass(frozen=True)
class PlaceSettings:
    """What the middle of an outline errs by; fitted to 60 changes of five simulated flights (0038)."""

    map_m: float = 0.05  # the map's own local error, its shift as a whole left out
    middle_up_m: float = 0.6  # a thing's middle stands so high: from aside it lies behind its place
    longest: float = 2.5  # times as long as wide: a longer outline holds a part of a shadow ...
    of_shadow: float = 0.4  # ... and its middle lies off by so much of what it is too long
    of_area: float = 0.03  # of an area's length: its outline is one of cells


def place_sigma_m(
    residual_m: float, cell_m: float, aside: float, settings: PlaceSettings = PlaceSettings()
) -> float:
    """The root of the sum of squares of: the views' alignment residual on the ground; a cell's rounding, its side /
    sqrt(12); the map's local error; and the thing's lean, `aside` (tangent of the angle by which the views together
    look at it from one side) times the height of its middle, per axis. What the outline errs by comes to it when that
    is final (`reported`)."""
    lean_m = settings.middle_up_m * aside / np.sqrt(2)
    return float(np.linalg.norm([residual_m, cell_m / np.sqrt(12), settings.map_m, lean_m]))


def thing_sigma_m(size: Measures, settings: PlaceSettings = PlaceSettings()) -> float:
    """What a thing's outline errs by: the part of a shadow that is left in it."""
    wide_m = size.area_m2 / max(size.length_m, 1e-6)
    return settings.of_shadow * max(size.length_m - settings.longest * wide_m, 0.0)


def area_sigma_m(size: Measures, settings: PlaceSettings = PlaceSettings()) -> float:
    """What an area's outline errs by."""
    return settings.of_area * size.length_m


def aside_of(outline_m: PointsM, cameras_m: PointsM) -> float:
    """From how far aside cameras, (N, 3) site metres, look at an outline, (M, 2), together: their mean way off over
    their height. Cameras all around it cancel out; 0 without any."""
    if not len(cameras_m):
        return 0.0
    off = (outline_m.mean(axis=0) - cameras_m[:, :2]) / np.maximum(cameras_m[:, 2:], 1e-6)
    return float(np.hypot(*off.mean(axis=0)))
