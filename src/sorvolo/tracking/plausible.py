"""Whether a detection's size on the ground is one that its class can have."""

from collections.abc import Sequence

import numpy as np

from sorvolo.geometry.arrays import Floats, Mask
from sorvolo.survey.objects import TYPICAL_SIZE_M

TOO_SHORT_CUT_PX = 3.0
"""Pieces of cars at the picture's edge end up to so far from it: nearer, their length says nothing."""

_LEAST_LENGTH = 0.4  # of a class's usual length: what is shorter is none, however sure the detector is
_SCALE_SIGMAS = 2.0  # by which heights may be off before something is called too short


def usual_length_m(name: str) -> float:
    """How long a class's members usually are; 0 for classes that are not ours."""
    return TYPICAL_SIZE_M[name][0] if name in TYPICAL_SIZE_M else 0.0


def far_too_short(names: Sequence[str], sides_m: Floats, cut: Mask, scale_sigma: float | Floats = 0.0) -> Mask:
    """(N,) bool: what is far too short for its class, as a window is for a car, and not cut by the picture's edge.

    `sides_m` (N, 2) are the box's sides on the ground, known to the relative error `scale_sigma`, one or (N,); `cut`
    (N, 4) as `cut_edges` tells it with `TOO_SHORT_CUT_PX`.
    """
    longest_m = sides_m.max(axis=1, initial=0.0) * (1.0 + _SCALE_SIGMAS * scale_sigma)
    usual_m = np.array([usual_length_m(name) for name in names])
    short: Mask = ~cut.any(axis=1) & (longest_m < _LEAST_LENGTH * usual_m)
    return short
