"""What the kernel of the heights computes, plainly."""

import itertools

import cv2
import numpy as np


def _laid(picture: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """A picture (h, w) between its pixels at u, v; 0 outside of it."""
    high, wide = picture.shape
    inside = (u >= 0) & (u <= wide - 1) & (v >= 0) & (v <= high - 1)
    x, y = np.where(inside, u, 0), np.where(inside, v, 0)
    column, row = np.minimum(x.astype(int), wide - 2), np.minimum(y.astype(int), high - 2)
    dx, dy = x - column, y - row
    above = picture[row, column] * (1 - dx) + picture[row, column + 1] * dx
    below = picture[row + 1, column] * (1 - dx) + picture[row + 1, column + 1] * dx
    return np.where(inside, above * (1 - dy) + below * dy, 0)


def agreements(
    pictures, channel, planes, frames, insets, hidden, heights, sides, shape, share, threads=1
) -> np.ndarray:
    """As `sorvolo.kernels.agreements`."""
    views = range(len(pictures))
    columns, rows = np.meshgrid(np.arange(shape[1]), np.arange(shape[0]))
    cells = np.stack([columns, rows, np.ones(shape)])
    result = np.full((shape[0], len(heights), shape[1]), np.nan)
    for level, height in enumerate(heights):
        laid, within = [], []
        for k in views:
            x, y, z = np.tensordot(planes[k, 0] + height * planes[k, 1], cells, 1)
            u, v = x / np.maximum(z, 1e-6), y / np.maximum(z, 1e-6)
            left, top, right, bottom = frames[k]
            far = np.min([u - left, right - u, v - top, bottom - v], axis=0)
            far[z <= 1e-6] = -1
            if hidden[k] is not None:
                far[np.float32(height) < hidden[k]] = -1
            laid.append([_laid(each, u, v) for each in pictures[k]])
            within.append(far.astype(np.float32))
        scores = []
        for i, j in itertools.combinations(views, 2):
            product = laid[i][channel[i, j]] * laid[j][channel[j, i]]
            both = [
                (within[i] >= np.float32(insets[i, s])) & (within[j] >= np.float32(insets[j, s]))
                for s in range(len(sides))
            ]
            alike = [np.maximum(cv2.boxFilter(product, -1, (side, side)), 0) for side in sides]
            count = np.sum(both, axis=0)
            total = np.sum([a * b for a, b in zip(alike, both, strict=True)], axis=0)
            scores.append(np.where(count > 0, total / np.maximum(count, 1), np.nan))
        for y, x in np.ndindex(shape):
            known = sorted(each[y, x] for each in scores if not np.isnan(each[y, x]))
            if known:
                wanted = int(np.ceil(len(known) * share))
                result[y, level, x] = np.mean(known[-wanted:])
    return result


def path_costs(cost: np.ndarray, one_level: float, more_levels: float) -> np.ndarray:
    """As `sorvolo.kernels.path_costs`: each of the eight paths on its own, cell by cell."""
    rows, _, columns = cost.shape
    total = np.zeros(cost.shape)
    for down, right in ((0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (1, -1), (-1, 1), (-1, -1)):
        path = np.zeros(cost.shape)
        for y in range(rows)[:: -1 if down < 0 else 1]:
            for x in range(columns)[:: -1 if right < 0 else 1]:
                from_y, from_x = y - down, x - right
                path[y, :, x] = cost[y, :, x]
                if not 0 <= from_y < rows or (down == 0 and not 0 <= from_x < columns):
                    continue
                # a slanted path that came in from a side began in the same column
                before = path[from_y, :, min(max(from_x, 0), columns - 1)]
                beside = np.pad(before, 1, constant_values=np.inf)
                beside = np.minimum(beside[:-2], beside[2:]) + one_level
                least = before.min()
                path[y, :, x] += np.minimum(np.minimum(before, beside), least + more_levels) - least
        total += path
    return total
