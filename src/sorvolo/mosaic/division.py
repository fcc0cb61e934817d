"""A flight's pictures divided into blocks of ground, each with the pictures around it that tie it to the others."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from sorvolo.geometry.arrays import Floats, Mask, PointsM, Rows


@dataclass(frozen=True)
class Block:
    """Pictures by number: those of the block (`home`), and earlier ones of other blocks near them (`margin`).

    All earlier pictures that one of `home` overlaps are in the block: what ties it to the map can be measured there.
    """

    home: frozenset[int]
    margin: frozenset[int]


def divide(outlines_m: Sequence[PointsM], count: int) -> list[Block]:
    """`count` blocks of nearly as many pictures each; fewer where there are fewer pictures.

    `outlines_m` are the pictures' outlines on the ground by telemetry, (4, 2) each, in the order of the flight; one
    that is not on the ground (NaN) goes with the picture before it. Blocks halve the ground along its longer side,
    again and again (a k-d tree). The margin is the usual diagonal of a picture: pictures farther apart share nothing.
    """
    centres_m = _known(np.array([each.mean(axis=0) for each in outlines_m]))
    diagonals_m = np.array([np.linalg.norm(each[2] - each[0]) for each in outlines_m])
    known = diagonals_m[np.isfinite(diagonals_m)]
    reach_m = float(np.median(known)) if len(known) else np.inf
    every = np.arange(len(centres_m))
    homes = _halved(every, centres_m, max(1, min(count, len(every))))
    return [Block(frozenset(home.tolist()), _margin(home, centres_m, reach_m)) for home in homes]


def _known(centres_m: Floats) -> Floats:
    """(N, 2) places, those of unknown ones taken from the one before; all 0 where none is known."""
    known: Mask = np.isfinite(centres_m).all(axis=1)  # type: ignore[assignment]
    if not known.any():
        return np.zeros_like(centres_m)
    before = np.maximum.accumulate(np.where(known, np.arange(len(known)), -1))
    return centres_m[np.where(before < 0, np.argmax(known), before)]


def _halved(ids: Rows, centres_m: Floats, count: int) -> list[Rows]:
    if count == 1:
        return [np.sort(ids)]
    low, high = centres_m[ids].min(axis=0), centres_m[ids].max(axis=0)
    axis = int(np.argmax(high - low))
    ordered = ids[np.argsort(centres_m[ids, axis], kind="stable")]
    at = round(len(ids) * (count // 2) / count)
    return [
        *_halved(ordered[:at], centres_m, count // 2),
        *_halved(ordered[at:], centres_m, count - count // 2),
    ]


def _margin(home: Rows, centres_m: Floats, reach_m: float) -> frozenset[int]:
    """The pictures of other blocks that a later one of `home` may overlap."""
    others: NDArray[np.int64] = np.setdiff1d(np.arange(int(home.max())), home)
    if not len(others):
        return frozenset()
    if not np.isfinite(reach_m):
        return frozenset(others.tolist())
    near = cKDTree(centres_m[home]).query_ball_point(centres_m[others], reach_m)
    return frozenset(
        int(other) for other, found in zip(others, near) if found and home[max(found)] > other
    )
