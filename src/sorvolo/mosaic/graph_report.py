"""What a flight taught the pose graph about itself, and how well its cameras place the ground."""

from dataclasses import dataclass

import numpy as np
from scipy.sparse.linalg import SuperLU

from sorvolo.geometry.arrays import Floats, Matrix3, Rows

_AT_ONCE = 16  # points on the ground: two right-hand sides each, as long as the flight


@dataclass(frozen=True, eq=False)
class GraphReport:
    """What the flight taught about itself; sigmas are one standard deviation."""

    focal_scale: float
    focal_scale_sigma: float
    radial: float
    altitude_offset_m: float
    links: int
    links_dropped: int
    relief_m: float
    rms_px: float
    # frames whose stated angles the pictures rule out: these angles are not used
    angles_contradicted: int = 0
    # tilt and heading that all stated angles are off by
    turned_deg: tuple[float, float] = (
        0.0,
        0.0,
    )
    is_uneven: bool = False  # pictures fit each other as over ground that is not level
    # median of `leans_m`, and how far stated angles leave the ground open themselves
    lean_m: float = 0.0
    lean_stated_m: float = 0.0


def leans_m(rotations: Floats, stated: Floats, heights_m: Floats) -> Floats:
    """(N,) how far cameras of (N, 3, 3) rotations see the ground from where stated ones have it, per axis, m.

    Over a slope a camera that looks straight down takes the same pictures, but for their fixes, as one that leans over
    level ground. Pictures over ground that is not level cannot show which it is: this is what the map errs by then.
    """
    here, there = (
        each[:, :2, 2] / -np.minimum(each[:, 2:, 2], -0.1) for each in (rotations, stated)
    )
    return heights_m * np.linalg.norm(here - there, axis=1) / np.sqrt(2)


def ground_sigmas_m(
    rotations: Floats, heights_m: Floats, starts: Rows, factors: SuperLU
) -> list[float]:
    """One sigma of the ground points at some cameras' image centres, per axis; their unknowns begin at `starts` (M,) of
    `factors`.

    `rotations` (M, 3, 3) are site_from_camera, `heights_m` (M,) the cameras' heights.
    """
    found: list[float] = []
    for first in range(0, len(starts), _AT_ONCE):
        some = slice(first, first + _AT_ONCE)
        blocks = [
            _ground_centre_jacobian(*each)
            for each in zip(rotations[some], heights_m[some], strict=True)
        ]
        unknowns = starts[some, None] + np.arange(6)
        right = np.zeros((factors.shape[0], len(blocks), 2))
        for k, block in enumerate(blocks):
            right[unknowns[k], k] = block.T
        solved = factors.solve(right.reshape(len(right), -1)).reshape(right.shape)
        for k, block in enumerate(blocks):
            found.append(float(np.sqrt(max(0.0, np.trace(block @ solved[unknowns[k], k]) / 2))))
    return found


def _ground_centre_jacobian(rotation: Matrix3, height_m: float) -> Floats:
    """(2, 6) how the ground point at the image's centre moves with the camera's turn and shift."""
    ray = rotation[:, 2]
    slope = ray / min(ray[2], -1e-3)
    flat = np.eye(3)
    flat[:, 2] -= slope
    cross = np.array([[0, -ray[2], ray[1]], [ray[2], 0, -ray[0]], [-ray[1], ray[0], 0]])
    turn = -height_m / min(ray[2], -1e-3) * flat @ -cross
    return np.concatenate([turn, flat], axis=1)[:2]
