"""The kernels of the robust change method in NumPy: the specification of the compiled ones."""

import numpy as np
from numpy.typing import NDArray


def relight(
    image: NDArray[np.uint8], curves: NDArray[np.int32], gains: NDArray[np.uint16]
) -> NDArray[np.uint8]:
    """`image` (h, w, 3) through `curves` (3, 256), 16 a grey level and 8 levels up, times `gains` (h, w, 3), 4096 one.

    The result is rounded, taken 8 levels down again and clipped to 0 .. 255. Curves below 2**14 leave 32 bits enough.
    """
    lifted = np.stack([curves[channel][image[..., channel]] for channel in range(3)], axis=-1)
    product = lifted.astype(np.int64) * gains
    return np.asarray(np.clip(((product + (1 << 15)) >> 16) - 8, 0, 255), np.uint8)


def measure_regions(
    labels: NDArray[np.int32], boxes: NDArray[np.int32], channels: NDArray[np.uint8], margin: int
) -> NDArray[np.int64]:
    """(N, 2, 2 C + 1) count, C sums and C sums of squares of `channels` (h, w, C) for each region 1 .. N of `labels`.

    First over the region's pixels, then over those of no region in its box `boxes` (N, 4) x, y, w, h grown by `margin`.
    """
    height, width = labels.shape
    sums = np.zeros((len(boxes), 2, 2 * channels.shape[2] + 1), np.int64)
    for region, (x, y, wide, high) in enumerate(boxes.tolist()):
        rows = slice(max(y - margin, 0), min(y + high + margin, height))
        window = rows, slice(max(x - margin, 0), min(x + wide + margin, width))
        for part, label in enumerate((region + 1, 0)):
            values = channels[window][labels[window] == label].astype(np.int64)
            sums[region, part] = np.concatenate([[len(values)], values.sum(axis=0), (values * values).sum(axis=0)])
    return sums


def match_regions(
    query: NDArray[np.uint8], reference: NDArray[np.uint8], boxes: NDArray[np.int32], reach: int
) -> NDArray[np.float64]:
    """(N, 6) how well each box (x, y, w, h, N x 4) of `query` (h, w) is found again in `reference`, `reach` px around.

    `reference` is larger by `reach` on each side. Columns: correlation in place, the best one, its shift x and y (the
    first of equals, row by row), mean absolute difference in place, the smallest one. Boxes of 64 px and more are
    looked at in steps.
    """
    found = np.zeros((len(boxes), 6))
    for region, (x, y, wide, high) in enumerate(boxes.tolist()):
        step = max(1, max(wide, high) // 32)
        q = query[y : y + high : step, x : x + wide : step].astype(np.int64)
        best, least = -2.0, 256.0
        for dy in range(-reach, reach + 1):
            for dx in range(-reach, reach + 1):
                top, left = y + reach + dy, x + reach + dx
                t = reference[top : top + high : step, left : left + wide : step].astype(np.int64)
                alike, apart = _correlation(q, t), float(np.abs(q - t).sum()) / q.size
                if dx == 0 and dy == 0:
                    found[region, 0], found[region, 4] = alike, apart
                if alike > best:
                    best = alike
                    found[region, 2:4] = dx, dy
                least = min(least, apart)
        found[region, 1], found[region, 5] = best, least
    return found


def _correlation(q: NDArray[np.int64], t: NDArray[np.int64]) -> float:
    spread_q = int(q.size * (q * q).sum() - q.sum() ** 2)
    spread_t = int(t.size * (t * t).sum() - t.sum() ** 2)
    if spread_q <= 0 or spread_t <= 0:
        return 0.0
    common = int(q.size * (q * t).sum() - q.sum() * t.sum())
    return float(common / (np.sqrt(float(spread_q)) * np.sqrt(float(spread_t))))
