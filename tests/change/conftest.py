"""The ground on which pictures are compared."""

import numpy as np
import pytest

from sorvolo.lab.simulation.ground import GroundKind, paint_ground
from sorvolo.lab.simulation.ground_painting import GroundArea


@pytest.fixture(scope="module")
def ground() -> np.ndarray:
    """A piece of dirt road, 480 x 360 px, BGR."""
    raster = paint_ground(
        GroundKind.DIRT, GroundArea(-12.0, -9.0, 12.0, 9.0), 0.05, np.random.default_rng(3)
    ).raster
    return np.ascontiguousarray(raster.rgb[..., ::-1])
