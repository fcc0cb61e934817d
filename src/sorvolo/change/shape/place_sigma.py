"""How far off the middle of a change may lie on the map: one sigma per axis."""

from dataclasses import dataclass

import numpy as np

from sorvolo.geometry.arrays import PointsM


@dataclass(frozen=True)
class PlaceSettings:
    """What the middle of an outline errs by; fitted to 33 changes of three simulated flights (0038)."""

    map_m: float = 0.04  # the map's own local error, its shift as a whole left out
    of_length: float = 0.03  # outlines include rims and bits of shadow
    middle_up_m: float = 0.8  # a thing's middle stands so high, a person's say: from aside it lies behind its place


def place_sigma_m(
    residual_m: float, cell_m: float, length_m: float, aside: float, settings: PlaceSettings = PlaceSettings()
) -> float:
    """The root of the sum of squares of: the views' alignment residual on the ground; a cell's rounding, its side /
    sqrt(12); the map's local error; a part of the change's length; and its lean, `aside` (tangent of the angle by which
    the views together look at it from one side) times the height of its middle, per axis."""
    return float(np.sqrt(
        residual_m**2 + cell_m**2 / 12 + settings.map_m**2 + (settings.of_length * length_m) ** 2
        + (settings.middle_up_m * aside) ** 2 / 2
    ))


def aside_of(outline_m: PointsM, cameras_m: PointsM) -> float:
    """From how far aside cameras, (N, 3) site metres, look at an outline, (M, 2), together: their mean way off over
    their height. Cameras all around it cancel out; 0 without any."""
    if not len(cameras_m):
        return 0.0
    off = (outline_m.mean(axis=0) - cameras_m[:, :2]) / np.maximum(cameras_m[:, 2:], 1e-6)
    return float(np.hypot(*off.mean(axis=0)))
