"""Boxes that the picture's edge cuts: which they are, and how much of the object may lie beyond."""

import numpy as np

from sorvolo.geometry.arrays import BoxesPx, Floats, Mask
from sorvolo.survey.objects import TYPICAL_SIZE_M

CUT_PX = 1.5
"""A box so near the picture's edge may go on beyond it."""

_CUT_SHARE = 0.06  # of its side: edges err
_AS_MUCH_AGAIN = 0.3  # of the visible side, where that is as long as its class usually is


def cut_edges(boxes_px: BoxesPx | Floats, width_px: int, height_px: int) -> Mask:
    """(N, 4) bool: whether the left, top, right and bottom edges of boxes (N, 4) lie at the picture's.

    Those of a detector end there; what reaches beyond was never cut.
    """
    boxes = np.asarray(boxes_px, np.float64).reshape(-1, 4)
    margin_px = np.maximum(CUT_PX, _CUT_SHARE * (boxes[:, 2:] - boxes[:, :2]))
    to_edge_px = np.concatenate([boxes[:, :2], boxes[:, 2:] - np.array([width_px, height_px])], axis=1)
    cut: Mask = np.abs(to_edge_px) <= np.tile(margin_px, 2)
    return cut


def unseen_m(name: str, side_m: float, *, has_metres: bool = True) -> float:
    """How much of something may lie beyond the picture's edge: what it lacks to its usual length, or as much again."""
    if not has_metres or name not in TYPICAL_SIZE_M:
        return side_m
    return max(TYPICAL_SIZE_M[name][0] - side_m, _AS_MUCH_AGAIN * side_m)
