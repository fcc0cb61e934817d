"""Medians without the care that np.median takes, which costs several times as much as the medians themselves."""

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from sorvolo.geometry.arrays import Mask

_MOST_ASKED = 8192  # pixels: more do not make a median surer
_LEVELS = np.arange(256, dtype=np.float32)


def middle(values: NDArray[Any]) -> Any:
    """The median of values (N,), N > 0, in their own type."""
    half = len(values) // 2
    if len(values) % 2:
        return np.partition(values, half)[half]
    low, high = np.partition(values, (half - 1, half))[half - 1 : half + 1]
    return (low + high) / values.dtype.type(2)


def median_ratio(
    above: NDArray[np.uint8], below: NDArray[np.uint8], where: Mask, offset: float
) -> NDArray[np.float32]:
    """(3,) the medians of (above + `offset`) / (below + `offset`) by channel of two pictures (h, w, 3 or more).

    `where` (h, w) says in which pixels, in one at least; of many, some are asked. Offsets keep black from weighing
    too much.
    """
    places = np.flatnonzero(where)
    places = places[:: -(-len(places) // _MOST_ASKED)]
    offset32 = np.float32(offset)
    upper, lower = (each.reshape(-1, each.shape[-1])[places, :3] + offset32 for each in (above, below))
    return np.array([middle(each) for each in np.ascontiguousarray((upper / lower).T)], np.float32)


def middle_and_deviation(picture: NDArray[np.uint8], where: Mask) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Medians (3,) of a picture's channels, (h, w, 3), and of how far they stray from these, in some pixels.

    `where` (h, w) says in which pixels, in one at least.
    """
    middles, deviations = np.zeros(3, np.float32), np.zeros(3, np.float32)
    mask = where.view(np.uint8)
    for channel in range(3):
        counts = cv2.calcHist([picture], [channel], mask, [256], [0, 256]).ravel().astype(np.int64)
        middles[channel] = _weighted(_LEVELS, counts)
        away = np.abs(_LEVELS - middles[channel])
        order = np.argsort(away)
        deviations[channel] = _weighted(away[order], counts[order])
    return middles, deviations


def _weighted(values: NDArray[np.float32], counts: NDArray[np.int64]) -> float:
    """The median of `values` (N,), in order, that occur so often."""
    sums = counts.cumsum()
    low, high = np.searchsorted(sums, ((sums[-1] - 1) // 2, sums[-1] // 2), side="right")
    return float(values[low] + values[high]) / 2
