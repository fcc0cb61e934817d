"""The kernels of the robust change method in NumPy: the specification of the compiled ones."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage


def relight(
    image: NDArray[np.uint8],
    curves: NDArray[np.int32],
    gains: NDArray[np.float32],
    left: int,
    top: int,
    wide: int,
    high: int,
    out: NDArray[np.uint8],
) -> None:
    """Fills a part of `out` with `image` (h, w, 3) through `curves` (3, 256) and times `gains` (H, w, 3), 4096 one.

    The lines of gains are the middles of H stripes over the whole picture; between them gains are interpolated, and
    rounded to whole numbers. Curves give 16 a grey level, 8 levels up. The result is rounded, taken 8 levels down again
    and clipped to 0 .. 255. Curves below 2**14 and gains below 2**16 leave 32 bits enough.
    """
    part = np.s_[top : top + high, left : left + wide]
    lines, height = len(gains), image.shape[0]
    place = ((np.arange(top, top + high) + 0.5) * (lines / height) - 0.5).astype(np.float32)
    above = np.floor(place).astype(np.int64)
    share = (place - above.astype(np.float32))[:, None, None]
    one, other = (gains[each.clip(0, lines - 1), left : left + wide] for each in (above, above + 1))
    fine = np.rint(one * (np.float32(1) - share) + other * share).astype(np.int64)
    lifted = np.stack([curves[channel][image[part][..., channel]] for channel in range(3)], axis=-1)
    out[part] = np.clip(((lifted.astype(np.int64) * fine + (1 << 15)) >> 16) - 8, 0, 255)


def differences(
    reference: NDArray[np.uint8],
    query: NDArray[np.uint8],
    known: NDArray[np.uint8] | None,
    reach: int,
    weight: int,
    out: NDArray[np.uint8],
) -> None:
    """Fills `out` (6, h, w) from two BGR pictures (h, w, 3), blurred by 3 x 3 and taken apart into light and colour.

    A value lies outside as far as it is beyond the other picture's smallest and largest within `reach` px around.
    Planes: difference, the larger of came and went, 0 where not `known`; its colour alone, red and blue together; what
    came, light plus `weight` times colour of the query outside the reference; what went, the other way round; the
    reference's light; the query's light. Sums end at 255.
    """
    before, after = _light_and_colour(reference), _light_and_colour(query)
    (came, came_colour), (went, went_colour) = (
        _outside(values, others, reach, weight)
        for values, others in ((after, before), (before, after))
    )
    difference = np.maximum(came, went)
    if known is not None:
        difference[known == 0] = 0
    out[:] = (
        difference,
        np.maximum(came_colour, went_colour),
        came,
        went,
        before[..., 0],
        after[..., 0],
    )


def _light_and_colour(image: NDArray[np.uint8]) -> NDArray[np.int64]:
    """BT.601 luma, red and blue difference of a picture blurred by 3 x 3 with a mirrored rim, rounded as in OpenCV."""
    blue, green, red = np.moveaxis(_blurred(image), 2, 0)
    half = 1 << 13
    luma = (blue * 1868 + green * 9617 + red * 4899 + half) >> 14
    colours = ((red - luma) * 11682, (blue - luma) * 9241)
    return np.stack(
        [luma, *(np.clip((each + (128 << 14) + half) >> 14, 0, 255) for each in colours)], axis=-1
    )


def _blurred(image: NDArray[np.uint8]) -> NDArray[np.int64]:
    near = np.pad(image.astype(np.int64), ((1, 1), (1, 1), (0, 0)), mode="reflect")
    height, width = image.shape[:2]
    total = sum(near[y : y + height, x : x + width] for y in range(3) for x in range(3))
    return (np.asarray(total) + 4) // 9


def _outside(
    values: NDArray[np.int64], others: NDArray[np.int64], reach: int, weight: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    window, axes = (2 * reach + 1, 2 * reach + 1), (0, 1)
    rim = ((reach, reach), (reach, reach), (0, 0))
    around = np.lib.stride_tricks.sliding_window_view(
        np.pad(others, rim, mode="edge"), window, axes
    )
    most, least = around.max(axis=(-2, -1)), around.min(axis=(-2, -1))
    luma, red, blue = np.moveaxis(np.maximum(np.maximum(values - most, least - values), 0), 2, 0)
    colour = np.minimum(red + blue, 255)
    return np.minimum(luma + weight * colour, 255), colour


def tint(
    reference: NDArray[np.uint8],
    query: NDArray[np.uint8],
    logs: NDArray[np.uint8],
    boxes: NDArray[np.int32],
    margin: int,
    out: NDArray[np.uint8],
) -> None:
    """Fills `out` (h, w) in `boxes` (N, 4) grown by `margin`: how much redder against blue `query` is, 128 where alike.

    A quarter of the steps of `logs` (256,), red and blue each rounded to the nearest whole number, halves to the even.
    """
    before, after = (logs[image].astype(np.float64) for image in (reference, query))
    steps = np.rint(64 + (after - before) / 4)[..., 2] + np.rint(64 - (after - before) / 4)[..., 0]
    for x, y, wide, high in boxes.tolist():
        window = (
            slice(max(y - margin, 0), y + high + margin),
            slice(max(x - margin, 0), x + wide + margin),
        )
        out[window] = np.minimum(steps[window], 255)


def rim_balance(
    labels: NDArray[np.uint8],
    boxes: NDArray[np.int32],
    came: NDArray[np.uint8],
    went: NDArray[np.uint8],
) -> NDArray[np.int64]:
    """(N,) sums of `came` - `went` over the pixels of regions 1 .. N of `labels` (h, w) with a 0 within 2 px around."""
    around = np.lib.stride_tricks.sliding_window_view(np.pad(labels, 2, mode="edge"), (5, 5))
    rim = (labels > 0) & (around == 0).any(axis=(-2, -1))
    balance = came.astype(np.int64) - went
    return np.array(
        [balance[rim & (labels == region + 1)].sum() for region in range(len(boxes))], np.int64
    )


def core_regions(
    values: NDArray[np.uint8],
    thresholds: NDArray[np.uint8],
    strong: float,
    core: float,
    least_area: int,
    most: int,
) -> tuple[NDArray[np.uint8], NDArray[np.int32]]:
    """Where `values` (h, w) lie over `thresholds` (h, w): labels (h, w), 0 none, and boxes (N, 4) x, y, w, h.

    An 8-connected part with two pixels over `strong` times their thresholds counts; it keeps the pixels over `core`
    times its own height (its sum of squares by its sum). What is then connected and has `least_area` pixels is a
    region; the `most` largest sums of values are kept, largest first, equals in the order of their first pixels.
    """
    inside = np.zeros(values.shape, bool)
    for part in _parts(values > thresholds):
        held = values[part].astype(np.int64)
        if np.count_nonzero(held > strong * thresholds[part]) >= 2:
            least = core * float((held * held).sum()) / float(held.sum())
            inside[part[0][held > least], part[1][held > least]] = True
    cores = [part for part in _parts(inside) if len(part[0]) >= least_area]
    cores = sorted(cores, key=lambda part: -int(values[part].astype(np.int64).sum()))[:most]
    labels, boxes = np.zeros(values.shape, np.uint8), np.zeros((len(cores), 4), np.int32)
    for number, (y, x) in enumerate(cores):
        labels[y, x] = number + 1
        boxes[number] = x.min(), y.min(), x.max() - x.min() + 1, y.max() - y.min() + 1
    return labels, boxes


def _parts(mask: NDArray[np.bool_]) -> list[tuple[NDArray[np.int64], NDArray[np.int64]]]:
    """The 8-connected parts of a mask, rows and columns of each, in the order of their first pixels."""
    left = mask.copy()
    parts = []
    for y, x in zip(*np.nonzero(mask), strict=True):
        if not left[y, x]:
            continue
        left[y, x] = False
        part = [(int(y), int(x))]
        for row, column in part:
            rows, columns = slice(max(row - 1, 0), row + 2), slice(max(column - 1, 0), column + 2)
            near = [
                (rows.start + dy, columns.start + dx)
                for dy, dx in np.argwhere(left[rows, columns]).tolist()
            ]
            left[rows, columns] = False
            part += near
        found = np.array(sorted(part), np.int64)
        parts.append((found[:, 0], found[:, 1]))
    return parts


def held_parts(mask: NDArray[np.uint8], seeds: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """(h, w) 255 in the 4-connected parts of `mask` (h, w) that hold a pixel of `seeds` (h, w), else 0."""
    labels, _ = ndimage.label(mask)
    return np.where(np.isin(labels, labels[(mask > 0) & (seeds > 0)]), np.uint8(255), np.uint8(0))


def measure_regions(
    labels: NDArray[np.uint8],
    boxes: NDArray[np.int32],
    channels: Sequence[NDArray[np.uint8]],
    margin: int,
) -> NDArray[np.int64]:
    """(N, 2, 2 C + 1) count, C sums and C sums of squares of `channels` (h, w), for each region 1 .. N of `labels`.

    First over the region's pixels, then over those of no region in its box `boxes` (N, 4) x, y, w, h grown by `margin`.
    """
    height, width = labels.shape
    stack = np.dstack(channels)
    sums = np.zeros((len(boxes), 2, 2 * len(channels) + 1), np.int64)
    for region, (x, y, wide, high) in enumerate(boxes.tolist()):
        rows = slice(max(y - margin, 0), min(y + high + margin, height))
        window = rows, slice(max(x - margin, 0), min(x + wide + margin, width))
        for part, label in enumerate((region + 1, 0)):
            values = stack[window][labels[window] == label].astype(np.int64)
            sums[region, part] = np.concatenate(
                [[len(values)], values.sum(axis=0), (values * values).sum(axis=0)]
            )
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


def tree_margins(
    rows: NDArray[np.float64],
    asked: NDArray[np.int32],
    thresholds: NDArray[np.float64],
    leaves: NDArray[np.float64],
) -> NDArray[np.float64]:
    """(N,) sums over oblivious trees of the leaf that each of `rows` (N, F) comes to, in the order of the trees.

    Level by level a tree asks whether the column `asked` (T, D) passes `thresholds` (T, D); the answers, the first as
    the highest bit, number its `leaves` (T, 2**D).
    """
    answers = rows[:, asked] > thresholds
    place = answers @ (1 << np.arange(asked.shape[1])[::-1])
    return np.asarray(np.cumsum(leaves[np.arange(len(leaves)), place], axis=1)[:, -1])
