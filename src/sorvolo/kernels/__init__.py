"""The few loops that must be fast, compiled; numbers in, numbers out. This module is the only door.

It checks shapes and ranges, since the compiled code in `_native` checks neither. Each kernel has a plain
twin in `tests/kernels/numpy_*.py`: the specification, where its docstring states what it computes.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sorvolo.errors import SorvoloError

try:
    from sorvolo.kernels import _native
except ImportError as error:
    raise SorvoloError(
        f"the compiled kernels are missing ({error}); install Sorvolo from a wheel, or install a C++17 compiler and "
        "reinstall sorvolo"
    ) from error

LARGEST_WINDOW_PX = 127  # the longest side of a window that the kernels take
MOST_REACH_PX = 32  # how far `differences` looks around at most

Bytes = NDArray[np.uint8]
Floats = NDArray[np.float64]


def equalising_tables(image: Bytes, known: Bytes | None = None, threads: int = 1) -> Bytes:
    """The tables (3, 256) that make the histogram of each channel of an image (h, w, 3) flat."""
    _check_image(image)
    return _native.equalising_tables(_bytes(image), _known(known, image), threads)


def averaged(
    image: Bytes, tables: Bytes, width: int, height: int, threads: int = 1
) -> tuple[Bytes, Bytes]:
    """An image (h, w, 3) through `tables` (3, 256), averaged over a window: planes (3, h, w), and their gray (h, w)."""
    _check_image(image)
    _check(tables.shape == (3, 256), "averaged", tables=tables)
    _check_window(width, height)
    return _native.averaged(_bytes(image), _bytes(tables), width, height, threads)


def texture_changes(
    reference: Bytes,
    query: Bytes,
    asked: Bytes,
    width: int,
    height: int,
    most: int,
    threads: int = 1,
) -> Bytes:
    """Where the local binary patterns of planes (3, h, w) differ in more than `most` bits, of the pixels `asked` (h, w)."""
    _check_window(width, height)
    fits = reference.shape == query.shape == (3, *asked.shape) and asked.ndim == 2
    _check(fits, "texture_changes", reference=reference, query=query, asked=asked)
    return _native.texture_changes(
        _bytes(reference), _bytes(query), _bytes(asked), width, height, most, threads
    )


def without_isolations(
    mask: Bytes, width: int, height: int, most_black: int, threads: int = 1
) -> Bytes:
    """A mask (h, w), black wherever the window around has more than `most_black` black pixels, else white."""
    _check_mask(mask)
    _check_window(width, height)
    return _native.without_isolations(_bytes(mask), width, height, most_black, threads)


def region_boxes(mask: Bytes) -> NDArray[np.int64]:
    """The boxes (N, 4) x, y, width, height of a mask's 8-connected regions."""
    _check_mask(mask)
    return _native.region_boxes(_bytes(mask))


def gray_histograms(
    image: Bytes, tables: Bytes, boxes: NDArray[np.int64], known: Bytes | None = None
) -> NDArray[np.int64]:
    """The gray histograms (N, 256) of boxes (N, 4) of an image (h, w, 3) put through `tables` (3, 256)."""
    _check_image(image)
    _check(tables.shape == (3, 256), "gray_histograms", tables=tables)
    boxes = np.ascontiguousarray(boxes, np.int64).reshape(-1, 4)
    height, width = image.shape[:2]
    if (boxes < 0).any() or (boxes[:, :2] + boxes[:, 2:] > [width, height]).any():
        raise ValueError(f"gray_histograms: boxes outside of the {width} x {height} px image")
    return _native.gray_histograms(_bytes(image), _bytes(tables), boxes, _known(known, image))


def relight(
    image: Bytes, curves: NDArray[np.int32], gains: NDArray[np.float32], out: Bytes | None = None
) -> Bytes:
    """A picture (h, w, 3) through curves (3, 256) and times lines of gains (H, w, 3) over it.

    `out` (h, w, 3) is written over where it is given, and returned.
    """
    fits = image.ndim == 3 and image.shape[2] == 3 and curves.shape == (3, 256)
    fits = fits and len(gains) > 0 and gains.shape == (len(gains), image.shape[1], 3)
    _check(fits, "relight", image=image, curves=curves, gains=gains)
    height, width = image.shape[:2]
    out = _target(out, image.shape)
    curves = np.ascontiguousarray(curves, np.int32)
    gains = np.ascontiguousarray(gains, np.float32)
    _native.relight(_bytes(image), curves, gains, 0, 0, width, height, out)
    return out


def differences(
    before: Bytes,
    after: Bytes,
    known: NDArray[np.bool_] | None,
    reach: int,
    weight: int,
    out: Bytes | None = None,
) -> Bytes:
    """How far each value of two pictures (h, w, 3) lies outside the other's within `reach` px, planes (6, h, w).

    `out` (6, h, w) is written over where it is given, and returned.
    """
    height, width = before.shape[:2]
    fits = before.shape == after.shape == (height, width, 3) and min(height, width) >= 2
    _check(fits, "differences", before=before, after=after)
    if not (0 <= reach <= MOST_REACH_PX and 0 <= weight <= 255):
        raise ValueError(f"differences: expected reach 0 .. {MOST_REACH_PX}, weight 0 .. 255")
    out = _target(out, (6, height, width))
    _native.differences(_bytes(before), _bytes(after), _known(known, before), reach, weight, out)
    return out


def tint(
    before: Bytes,
    after: Bytes,
    logs: Bytes,
    boxes: NDArray[np.int32],
    margin: int,
    out: Bytes | None = None,
) -> Bytes:
    """How much redder than blue a picture became, (h, w), in boxes (N, 4) and `margin` px around only.

    `out` (h, w) is written over there where it is given, and returned; elsewhere it keeps what it held.
    """
    fits = before.shape == after.shape and before.shape[2:] == (3,) and logs.shape == (256,)
    _check(fits, "tint", before=before, after=after, logs=logs)
    out = _target(out, before.shape[:2])
    _native.tint(_bytes(before), _bytes(after), _bytes(logs), _boxes(boxes), margin, out)
    return out


def rim_balance(
    labels: Bytes, boxes: NDArray[np.int32], came: Bytes, went: Bytes
) -> NDArray[np.int64]:
    """By how much `came` exceeds `went`, both (h, w), along the rims of the regions of `labels` (h, w), (N,)."""
    boxes = _boxes(boxes, labels.shape)
    fits = labels.shape == came.shape == went.shape and labels.ndim == 2
    _check(fits, "rim_balance", labels=labels, came=came, went=went)
    _check_labels(labels, len(boxes))
    return _native.rim_balance(_bytes(labels), boxes, _bytes(came), _bytes(went))


def tree_margins(
    rows: Floats, asked: NDArray[np.int32], thresholds: Floats, leaves: Floats
) -> Floats:
    """The sums (N,) of oblivious trees, asked and thresholds (T, D), leaves (T, 2**D), for rows (N, F)."""
    trees, depth = asked.shape
    fits = thresholds.shape == asked.shape and leaves.shape == (trees, 1 << depth)
    fits = fits and trees >= 1 and rows.ndim == 2
    fits = fits and asked.min() >= 0 and asked.max() < rows.shape[1]
    _check(fits, "tree_margins", rows=rows, asked=asked, thresholds=thresholds, leaves=leaves)
    return _native.tree_margins(
        np.ascontiguousarray(rows, np.float64),
        np.ascontiguousarray(asked, np.int32),
        np.ascontiguousarray(thresholds, np.float64),
        np.ascontiguousarray(leaves, np.float64),
    )


def core_regions(
    values: Bytes, thresholds: Bytes, strong: float, core: float, least_area: int, most: int
) -> tuple[Bytes, NDArray[np.int32]]:
    """Where values lie over thresholds, both (h, w), each part cut to its core: labels (h, w) and boxes (N, 4)."""
    if not 0 <= most <= 255:
        raise ValueError(f"core_regions: a byte holds labels of at most 255 regions, not of {most}")
    fits = values.shape == thresholds.shape and values.ndim == 2
    _check(fits, "core_regions", values=values, thresholds=thresholds)
    return _native.core_regions(_bytes(values), _bytes(thresholds), strong, core, least_area, most)


def held_parts(mask: Bytes, seeds: Bytes) -> Bytes:
    """The 4-connected parts of a mask (h, w) that hold a pixel of `seeds` (h, w), 255 or 0."""
    _check_mask(mask)
    _check(seeds.shape == mask.shape, "held_parts", mask=mask, seeds=seeds)
    return _native.held_parts(_bytes(mask), _bytes(seeds))


def measure_regions(
    labels: Bytes, boxes: NDArray[np.int32], channels: Sequence[Bytes], margin: int
) -> NDArray[np.int64]:
    """Count, sums and sums of squares of C channels (h, w) over regions and around them, (N, 2, 2 C + 1)."""
    fits = {channel.shape for channel in channels} == {labels.shape} and labels.ndim == 2
    _check(fits, "measure_regions", labels=labels)
    _check_labels(labels, len(boxes))
    return _native.measure_regions(
        _bytes(labels), _boxes(boxes), [_bytes(channel) for channel in channels], margin
    )


def match_regions(query: Bytes, searched: Bytes, boxes: NDArray[np.int32], reach: int) -> Floats:
    """How well boxes (N, 4) of one picture (h, w) are found again within `reach` px in another, (N, 6)."""
    height, width = query.shape
    fits = searched.shape == (height + 2 * reach, width + 2 * reach)
    _check(fits, "match_regions", query=query, searched=searched)
    boxes = _boxes(boxes, query.shape)
    return _native.match_regions(_bytes(query), _bytes(searched), boxes, reach)


def slopes(before: NDArray[np.float32], after: NDArray[np.float32], prior: float) -> Floats:
    """By how much one of two (N, C), N > 0, is spread wider than the other, (C,)."""
    fits = before.shape == after.shape and before.ndim == 2 and len(before) > 0
    _check(fits, "slopes", before=before, after=after)
    if not (np.isfinite(before).all() and np.isfinite(after).all()):
        raise ValueError("slopes: before and after must be finite")
    return _native.slopes(
        np.ascontiguousarray(before, np.float32), np.ascontiguousarray(after, np.float32), prior
    )


def fit_moves(
    rows_x: Floats,
    rows_y: Floats,
    moves: Floats,
    trust: Floats,
    ridge: Floats,
    wide: float,
    high: float,
) -> tuple[Floats, float]:
    """A robust linear fit (8,) of rows (N, 8) to moves (N, 2), trusted (N,), and the median of what remains."""
    count = len(trust)
    fits = rows_x.shape == rows_y.shape == (count, 8) and moves.shape == (count, 2)
    fits = fits and ridge.shape == (8,)
    _check(fits, "fit_moves", rows_x=rows_x, rows_y=rows_y, moves=moves, ridge=ridge)
    if not ((trust >= 0).all() and (trust > 0).any() and (ridge >= 0).all()):
        raise ValueError("fit_moves: trust is 0 or more and somewhere more, a ridge 0 or more")
    if not (np.isfinite(rows_x).all() and np.isfinite(rows_y).all() and np.isfinite(moves).all()):
        raise ValueError("fit_moves: rows and moves must be finite")
    x, y, moved, trusted, damping = (
        np.ascontiguousarray(array, np.float64) for array in (rows_x, rows_y, moves, trust, ridge)
    )
    return _native.fit_moves(x, y, moved, trusted, damping, wide, high)


def detail_products(
    before: Bytes, after: Bytes, table: NDArray[np.float32], window: int, cell: int
) -> NDArray[np.float32]:
    """What the details of two pictures (h, w) have in common in cells, (3, h / cell, w / cell)."""
    fits = before.shape == after.shape and before.ndim == 2 and table.shape == (256,)
    _check(fits, "detail_products", before=before, after=after, table=table)
    least = min(before.shape)
    if not (window % 2 == 1 and 1 <= window <= least and 1 <= cell <= least):
        raise ValueError(
            f"detail_products: window {window}, cell {cell} do not fit pictures {before.shape}"
        )
    table = np.ascontiguousarray(table, np.float32)
    return _native.detail_products(_bytes(before), _bytes(after), table, window, cell)


def flow_on_grid(
    flow: NDArray[np.float32], details: Bytes, rows: int, columns: int
) -> NDArray[np.float32]:
    """A flow (h, w, 2) and how strong details (h, w) are, on a grid (rows, columns, 3)."""
    fits = details.ndim == 2 and flow.shape == (*details.shape, 2)
    _check(fits, "flow_on_grid", flow=flow, details=details)
    if not (1 <= rows <= details.shape[0] and 1 <= columns <= details.shape[1]):
        raise ValueError(
            f"flow_on_grid: a grid of {rows} x {columns} does not fit details {details.shape}"
        )
    flow = np.ascontiguousarray(flow, np.float32)
    return _native.flow_on_grid(flow, _bytes(details), rows, columns)


def agreements(
    pictures: Sequence[NDArray[np.float32]],
    channel: NDArray[np.int64],
    planes: Floats,
    frames: Floats,
    insets: NDArray[np.float32],
    hidden: Sequence[NDArray[np.float32] | None],
    heights: Floats,
    sides: Sequence[int],
    shape: tuple[int, int],
    share: float,
    threads: int = 1,
) -> NDArray[np.float32]:
    """How well V photos laid on L level planes agree, (h, L, w), 0 to 1: NaN where fewer than two show a patch.

    `pictures` (channels, h', w') each, of which two photos compare those that `channel` (V, V) names; `planes`
    (V, 2, 3, 3) map cells to a picture at height 0 and what a unit of height adds; a photo ends at its `frames` (V, 4)
    left, top, right, bottom, and shows a patch of each of S odd `sides` as a whole `insets` (V, S) px within, where
    `hidden` (h, w) does not say that it sees nothing so low. Agreement is the mean of products over patches, the mean
    over the sizes, and over the best `share` of the pairs.
    """
    views = len(pictures)
    fits = channel.shape == (views, views) and planes.shape == (views, 2, 3, 3) and views > 1
    fits = fits and frames.shape == (views, 4) and insets.shape == (views, len(sides))
    fits = fits and all(each is None or each.shape == shape for each in hidden)
    _check(fits and len(hidden) == views, "agreements", planes=planes, frames=frames, insets=insets)
    most = np.array([len(each) for each in pictures])
    small = min(min(each.shape[1:]) for each in pictures) < 2 or min(shape) < 1
    if small or (channel < 0).any() or (channel >= most[:, None]).any():
        raise ValueError("agreements: expected pictures of 2 px a side and channels that they have")
    if not sides or any(side % 2 == 0 or not 1 <= side <= LARGEST_WINDOW_PX for side in sides):
        raise ValueError(f"agreements: sides are odd, 1 to {LARGEST_WINDOW_PX}, got {list(sides)}")
    return _native.agreements(
        [np.ascontiguousarray(each, np.float32) for each in pictures],
        np.ascontiguousarray(channel, np.int64),
        np.ascontiguousarray(planes, np.float64),
        np.ascontiguousarray(frames, np.float64),
        np.ascontiguousarray(insets, np.float32),
        [None if each is None else np.ascontiguousarray(each, np.float32) for each in hidden],
        np.ascontiguousarray(heights, np.float64),
        list(sides),
        *shape,
        share,
        threads,
    )


def path_costs(
    cost: NDArray[np.float32], one_level: float, more_levels: float
) -> NDArray[np.float32]:
    """(h, L, w) sums over eight paths of costs (h, L, w): rows, levels, columns (semi-global, Hirschmueller 2008).

    A path pays `one_level` to go to the next level, and `more_levels` to go to any other.
    """
    _check(cost.ndim == 3 and cost.size > 0, "path_costs", cost=cost)
    return _native.path_costs(np.ascontiguousarray(cost, np.float32), one_level, more_levels)


def _target(out: Bytes | None, shape: tuple[int, ...]) -> Bytes:
    if out is None:
        return np.empty(shape, np.uint8)
    is_writeable = out.flags.c_contiguous and out.flags.writeable
    if out.shape != shape or out.dtype != np.uint8 or not is_writeable:
        raise ValueError(
            f"out: expected writeable uint8 in C order, {shape}, got {out.dtype} {out.shape}"
        )
    return out


def _check(fits: bool, kernel: str, **arrays: NDArray[Any]) -> None:
    if not fits:
        shapes = ", ".join(f"{name} {array.shape}" for name, array in arrays.items())
        raise ValueError(f"{kernel}: {shapes} do not fit")


def _check_labels(labels: Bytes, count: int) -> None:
    if labels.dtype != np.uint8 or count > 255:
        raise ValueError(
            f"labels are bytes of at most 255 regions, got {labels.dtype} and {count} regions"
        )


def _boxes(boxes: NDArray[np.int32], within: tuple[int, ...] | None = None) -> NDArray[np.int32]:
    boxes = np.ascontiguousarray(boxes, np.int32).reshape(-1, 4)
    if within is not None:
        height, width = within
        ends = boxes[:, :2] + boxes[:, 2:]
        if (boxes[:, :2] < 0).any() or (boxes[:, 2:] < 1).any() or (ends > [width, height]).any():
            raise ValueError(f"boxes outside of the {width} x {height} px picture")
    return boxes


def _bytes(array: Bytes) -> Bytes:
    return np.ascontiguousarray(array, np.uint8)


def _known(known: NDArray[Any] | None, image: Bytes) -> Bytes | None:
    if known is None:
        return None
    if known.shape != image.shape[:2]:
        raise ValueError(f"known {known.shape} does not fit the image {image.shape}")
    return _bytes(known.view(np.uint8) if known.dtype == np.bool_ else known)


def _check_image(image: Bytes) -> None:
    if image.ndim != 3 or image.shape[2] != 3 or image.size == 0:
        raise ValueError(f"an image is (height, width, 3) and not empty, got {image.shape}")


def _check_mask(mask: Bytes) -> None:
    if mask.ndim != 2 or mask.size == 0:
        raise ValueError(f"a mask is (height, width) and not empty, got {mask.shape}")


def _check_window(width: int, height: int) -> None:
    if not (1 <= width <= LARGEST_WINDOW_PX and 1 <= height <= LARGEST_WINDOW_PX):
        raise ValueError(
            f"a window is 1 to {LARGEST_WINDOW_PX} px wide and high, got {width} x {height}"
        )
