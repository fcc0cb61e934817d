"""Semi-global matching (Hirschmueller 2008): of the likely heights of each cell those that neighbours agree on."""

from dataclasses import dataclass

import numpy as np

from sorvolo.geometry.arrays import Floats32


@dataclass(frozen=True)
class SmoothingSettings:
    """What heights cost beside their matching cost (0 to 1), in its units."""

    one_level: float = 0.1  # a change of height between neighbours
    more_levels: float = 0.9  # of any larger change: an edge of a roof
    unseen_sigmas: float = (
        1.5  # below a cell's mean cost is that of a height at which fewer than two photos see it
    )
    temperature: float = 0.04  # of a path's total cost, by which a height is e times less likely: fits sigma to errors


def smoothed(cost: Floats32, settings: SmoothingSettings) -> Floats32:
    """(H, D, W) sums over eight paths of a matching cost, (H, D, W) float32: rows, levels, columns."""
    total = np.zeros_like(cost)
    _sweep(cost, total, settings)
    _sweep(cost[::-1], total[::-1], settings)
    turned: Floats32 = np.ascontiguousarray(cost.transpose(2, 1, 0))
    across = np.zeros_like(turned)
    _straight(turned, across, settings)
    _straight(turned[::-1], across[::-1], settings)
    total += across.transpose(2, 1, 0)
    return total


def _sweep(cost: Floats32, total: Floats32, settings: SmoothingSettings) -> None:
    """Add the paths that come from the row above: straight, from the left and from the right."""
    before = [cost[0]] * 3
    total[0] += 3 * cost[0]
    for row in range(1, len(cost)):
        left, right = np.empty_like(before[1]), np.empty_like(before[2])
        left[:, 1:], left[:, :1] = before[1][:, :-1], before[1][:, :1]
        right[:, :-1], right[:, -1:] = before[2][:, 1:], before[2][:, -1:]
        before = [_next(cost[row], each, settings) for each in (before[0], left, right)]
        for each in before:
            total[row] += each


def _straight(cost: Floats32, total: Floats32, settings: SmoothingSettings) -> None:
    before = cost[0]
    total[0] += before
    for row in range(1, len(cost)):
        before = _next(cost[row], before, settings)
        total[row] += before


def _next(cost: Floats32, before: Floats32, settings: SmoothingSettings) -> Floats32:
    """(D, W) the cost of paths that go on from `before`, (D, W), the least of it taken off so that sums stay small."""
    least = before.min(axis=0)
    reached = np.minimum(before, least + np.float32(settings.more_levels))
    step = np.float32(settings.one_level)
    np.minimum(reached[1:], before[:-1] + step, out=reached[1:])
    np.minimum(reached[:-1], before[1:] + step, out=reached[:-1])
    reached += cost
    reached -= least
    return reached
