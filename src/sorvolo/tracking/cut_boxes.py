"""Boxes that the picture's edge cuts: which they are, and where the object's middle may lie."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sorvolo.geometry.arrays import BoxesPx, Floats, Mask
from sorvolo.survey.objects import TYPICAL_SIZE_M

CUT_PX = 1.5
"""A box so near the picture's edge may go on beyond it."""


@dataclass(frozen=True)
class CutSettings:
    """What a picture's edge hides of a box."""

    beyond: float = 0.4  # of what lies beyond the edge: by how much the box's middle is off ...
    beyond_sigma: float = 0.5  # ... give or take
    cut_share: float = 0.06  # of its side: so near the edge it is cut, for edges err
    as_much_again: float = 0.3  # of the visible side, where that is as long as its class usually is


def cut_edges(
    boxes_px: BoxesPx | Floats,
    width_px: int,
    height_px: int,
    least_px: float = CUT_PX,
    settings: CutSettings = CutSettings(),
) -> Mask:
    """(N, 4) bool: whether the left, top, right and bottom edges of boxes (N, 4) lie at the picture's, to `least_px`.

    Those of a detector end there; what reaches beyond was never cut.
    """
    boxes = np.asarray(boxes_px, np.float64).reshape(-1, 4)
    margin_px = np.maximum(least_px, settings.cut_share * (boxes[:, 2:] - boxes[:, :2]))
    to_edge_px = np.concatenate(
        [boxes[:, :2], boxes[:, 2:] - np.array([width_px, height_px])], axis=1
    )
    cut: Mask = np.abs(to_edge_px) <= np.tile(margin_px, 2)
    return cut


def beyond_edges(
    names: Sequence[str],
    cut: Mask,
    axes: Floats,
    sides_m: Floats,
    *,
    has_metres: bool = True,
    settings: CutSettings = CutSettings(),
) -> tuple[Floats, Floats]:
    """How far beside its box an object's middle may lie that the picture's edge cuts: (N, 2) m, with (N, 2, 2) m2.

    `cut` as `cut_edges` gives it; `axes` (N, 2, 2) are the directions on the ground, a row each, in which the box's
    width and height grow, and `sides_m` (N, 2) how long they are there. Without this, what comes into view seems to be
    dragged along by the picture's edge.
    """
    outward_m, spread_m2 = np.zeros((len(names), 2)), np.zeros((len(names), 2, 2))
    for row, axis in np.argwhere(cut[:, :2] | cut[:, 2:]):
        beyond_m = _unseen_m(
            names[row], float(sides_m[row, axis]), settings.as_much_again, has_metres=has_metres
        )
        out = axes[row, axis]
        outward_m[row] += (
            settings.beyond * (float(cut[row, 2 + axis]) - float(cut[row, axis])) * beyond_m * out
        )
        spread_m2[row] += (settings.beyond_sigma * beyond_m) ** 2 * np.outer(out, out)
    return outward_m, spread_m2


def _unseen_m(name: str, side_m: float, as_much_again: float, *, has_metres: bool) -> float:
    """How much of something may lie beyond the picture's edge: what it lacks to its usual length, or as much again."""
    if not has_metres or name not in TYPICAL_SIZE_M:
        return side_m
    return max(TYPICAL_SIZE_M[name][0] - side_m, as_much_again * side_m)
