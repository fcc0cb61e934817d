"""The few loops that must be fast; numbers in, numbers out. This module is the only door.

Each kernel exists twice with one signature: compiled in `_native`, and in NumPy in `numpy_*.py`, which specify what it
computes. Both give the same numbers, sums of real numbers but for their rounding. Where nothing was compiled the slow
ones are used, with one warning.
"""

import warnings
from collections.abc import Sequence
from types import ModuleType

import numpy as np
from numpy.typing import NDArray

from sorvolo.errors import SorvoloWarning
from sorvolo.kernels import numpy_light, numpy_robust, numpy_thesis

_native: ModuleType | None
try:
    from sorvolo.kernels import _native
except ImportError:
    _native = None
    warnings.warn(
        "the compiled kernels are missing, so change detection will be some 100 times slower; install a C++17 compiler "
        "and reinstall sorvolo",
        SorvoloWarning,
        stacklevel=2,
    )

COMPILED = _native is not None
"""Whether the compiled kernels are in use."""

LARGEST_WINDOW_PX = 127
"""The longest side of a window that the kernels take."""

MOST_REACH_PX = 32
"""How far `differences` looks around at most."""

_thesis = numpy_thesis if _native is None else _native

Bytes = NDArray[np.uint8]


def equalising_tables(image: Bytes, known: Bytes | None = None, threads: int = 1) -> Bytes:
    """The tables (3, 256) that equalise an image's channels, (h, w, 3): see numpy_thesis."""
    _check_image(image)
    tables: Bytes = _thesis.equalising_tables(_bytes(image), _known(known, image), threads)
    return tables


def averaged(
    image: Bytes, tables: Bytes, width: int, height: int, threads: int = 1
) -> tuple[Bytes, Bytes]:
    """An equalised image's window means as planes (3, h, w), and their gray (h, w): see numpy_thesis."""
    _check_image(image)
    _check_tables(tables)
    _check_window(width, height)
    result: tuple[Bytes, Bytes] = _thesis.averaged(
        _bytes(image), _bytes(tables), width, height, threads
    )
    return result


def texture_changes(
    reference: Bytes,
    query: Bytes,
    asked: Bytes,
    width: int,
    height: int,
    most: int,
    threads: int = 1,
) -> Bytes:
    """Which of the pixels `asked` (h, w) differ in their patterns, planes being (3, h, w): see numpy_thesis."""
    _check_window(width, height)
    if not reference.shape == query.shape == (3, *asked.shape) or asked.ndim != 2:
        raise ValueError(
            f"texture_changes: {reference.shape}, {query.shape} and asked {asked.shape} do not fit"
        )
    mask: Bytes = _thesis.texture_changes(
        _bytes(reference), _bytes(query), _bytes(asked), width, height, most, threads
    )
    return mask


def without_isolations(
    mask: Bytes, width: int, height: int, most_black: int, threads: int = 1
) -> Bytes:
    """A mask (h, w) black wherever the window around has more than `most_black` black, else white: see numpy_thesis."""
    _check_mask(mask)
    _check_window(width, height)
    kept: Bytes = _thesis.without_isolations(_bytes(mask), width, height, most_black, threads)
    return kept


def region_boxes(mask: Bytes) -> NDArray[np.int64]:
    """The boxes (N, 4) x, y, width, height of a mask's 8-connected regions: see numpy_thesis."""
    _check_mask(mask)
    boxes: NDArray[np.int64] = _thesis.region_boxes(_bytes(mask))
    return boxes


def gray_histograms(
    image: Bytes, tables: Bytes, boxes: NDArray[np.int64], known: Bytes | None = None
) -> NDArray[np.int64]:
    """The gray histograms (N, 256) of boxes of an equalised image: see numpy_thesis."""
    _check_image(image)
    _check_tables(tables)
    boxes = np.ascontiguousarray(boxes, np.int64).reshape(-1, 4)
    height, width = image.shape[:2]
    if (boxes < 0).any() or (boxes[:, :2] + boxes[:, 2:] > [width, height]).any():
        raise ValueError(f"gray_histograms: boxes outside of the {width} x {height} px image")
    counts: NDArray[np.int64] = _thesis.gray_histograms(
        _bytes(image), _bytes(tables), boxes, _known(known, image)
    )
    return counts


_robust = numpy_robust if _native is None else _native


def relight(
    image: NDArray[np.uint8],
    curves: NDArray[np.int32],
    gains: NDArray[np.float32],
    out: NDArray[np.uint8] | None = None,
) -> NDArray[np.uint8]:
    """A picture (h, w, 3) through curves (3, 256) and times lines of gains (H, w, 3) over it: see numpy_robust.

    `out` (h, w, 3) is written over where it is given, and returned.
    """
    if image.ndim != 3 or image.shape[2] != 3 or curves.shape != (3, 256):
        raise ValueError(f"relight: image {image.shape} and curves {curves.shape} do not fit")
    height, width = image.shape[:2]
    if gains.shape != (len(gains), width, 3) or len(gains) == 0:
        raise ValueError(f"relight: gains are lines (H, {width}, 3), got {gains.shape}")
    out = _target(out, image.shape)
    image, curves = np.ascontiguousarray(image, np.uint8), np.ascontiguousarray(curves, np.int32)
    gains = np.ascontiguousarray(gains, np.float32)
    _robust.relight(image, curves, gains, 0, 0, width, height, out)
    return out


def differences(
    before: NDArray[np.uint8],
    after: NDArray[np.uint8],
    known: NDArray[np.bool_] | None,
    reach: int,
    weight: int,
    out: NDArray[np.uint8] | None = None,
) -> NDArray[np.uint8]:
    """How far each value of two pictures (h, w, 3) lies outside the other's, planes (6, h, w): see numpy_robust.

    `out` (6, h, w) is written over where it is given, and returned.
    """
    height, width = before.shape[:2]
    if before.shape != (height, width, 3) or after.shape != before.shape or min(height, width) < 2:
        raise ValueError(f"differences: pictures {before.shape} and {after.shape} do not fit")
    if known is not None and known.shape != (height, width):
        raise ValueError(f"differences: known {known.shape} does not fit pictures {before.shape}")
    if not (0 <= reach <= MOST_REACH_PX and 0 <= weight <= 255):
        raise ValueError(
            f"differences: reach {reach} or weight {weight} out of 0 .. {MOST_REACH_PX} and 0 .. 255"
        )
    out = _target(out, (6, height, width))
    marked = None if known is None else np.ascontiguousarray(known, np.bool_).view(np.uint8)
    _robust.differences(
        np.ascontiguousarray(before, np.uint8),
        np.ascontiguousarray(after, np.uint8),
        marked,
        reach,
        weight,
        out,
    )
    return out


def tint(
    before: NDArray[np.uint8],
    after: NDArray[np.uint8],
    logs: NDArray[np.uint8],
    boxes: NDArray[np.int32],
    margin: int,
    out: NDArray[np.uint8] | None = None,
) -> NDArray[np.uint8]:
    """How much redder than blue a picture became, (h, w), in boxes and `margin` around only: see numpy_robust.

    `out` (h, w) is written over there where it is given, and returned; elsewhere it keeps what it held.
    """
    if before.shape != after.shape or before.shape[2:] != (3,) or logs.shape != (256,):
        raise ValueError(
            f"tint: pictures {before.shape}, {after.shape} and logs {logs.shape} do not fit"
        )
    boxes = np.ascontiguousarray(boxes, np.int32).reshape(-1, 4)
    out = _target(out, before.shape[:2])
    _robust.tint(
        np.ascontiguousarray(before, np.uint8),
        np.ascontiguousarray(after, np.uint8),
        np.ascontiguousarray(logs, np.uint8),
        boxes,
        margin,
        out,
    )
    return out


def rim_balance(
    labels: NDArray[np.uint8],
    boxes: NDArray[np.int32],
    came: NDArray[np.uint8],
    went: NDArray[np.uint8],
) -> NDArray[np.int64]:
    """By how much `came` exceeds `went` along the rims of regions, (N,): see numpy_robust."""
    boxes = np.ascontiguousarray(boxes, np.int32).reshape(-1, 4)
    _check_boxes("rim_balance", boxes, labels.shape)
    if not labels.shape == came.shape == went.shape or labels.ndim != 2:
        raise ValueError(
            f"rim_balance: labels {labels.shape}, came {came.shape}, went {went.shape} do not fit"
        )
    _check_labels("rim_balance", labels, len(boxes))
    balance: NDArray[np.int64] = _robust.rim_balance(
        np.ascontiguousarray(labels, np.uint8),
        boxes,
        np.ascontiguousarray(came, np.uint8),
        np.ascontiguousarray(went, np.uint8),
    )
    return balance


def tree_margins(
    rows: NDArray[np.float64],
    asked: NDArray[np.int32],
    thresholds: NDArray[np.float64],
    leaves: NDArray[np.float64],
) -> NDArray[np.float64]:
    """The sums of trees for rows (N, F), (N,): see numpy_robust."""
    trees, depth = asked.shape
    if (
        thresholds.shape != asked.shape
        or leaves.shape != (trees, 1 << depth)
        or trees < 1
        or rows.ndim != 2
    ):
        raise ValueError(
            f"tree_margins: rows {rows.shape}, asked {asked.shape}, thresholds {thresholds.shape} and leaves "
            f"{leaves.shape} do not fit"
        )
    if int(asked.min()) < 0 or int(asked.max()) >= rows.shape[1]:
        raise ValueError(
            f"tree_margins: rows have {rows.shape[1]} columns, asked is one of {int(asked.max())}"
        )
    margins: NDArray[np.float64] = _robust.tree_margins(
        np.ascontiguousarray(rows, np.float64),
        np.ascontiguousarray(asked, np.int32),
        np.ascontiguousarray(thresholds, np.float64),
        np.ascontiguousarray(leaves, np.float64),
    )
    return margins


def core_regions(
    values: NDArray[np.uint8],
    thresholds: NDArray[np.uint8],
    strong: float,
    core: float,
    least_area: int,
    most: int,
) -> tuple[NDArray[np.uint8], NDArray[np.int32]]:
    """Where values lie over thresholds, both (h, w), each part cut to its core: see numpy_robust."""
    if not 0 <= most <= 255:
        raise ValueError(
            f"core_regions: a byte holds the labels of 0 .. 255 regions, not of {most}"
        )
    if values.shape != thresholds.shape or values.ndim != 2:
        raise ValueError(
            f"core_regions: values {values.shape} and thresholds {thresholds.shape} do not fit"
        )
    found: tuple[NDArray[np.uint8], NDArray[np.int32]] = _robust.core_regions(
        np.ascontiguousarray(values, np.uint8),
        np.ascontiguousarray(thresholds, np.uint8),
        strong,
        core,
        least_area,
        most,
    )
    return found


def held_parts(mask: Bytes, seeds: Bytes) -> Bytes:
    """The parts of a mask (h, w) that hold a pixel of `seeds` (h, w), 255 or 0: see numpy_robust."""
    _check_mask(mask)
    if seeds.shape != mask.shape:
        raise ValueError(f"held_parts: mask {mask.shape} and seeds {seeds.shape} do not fit")
    parts: Bytes = _robust.held_parts(_bytes(mask), _bytes(seeds))
    return parts


def measure_regions(
    labels: NDArray[np.uint8],
    boxes: NDArray[np.int32],
    channels: Sequence[NDArray[np.uint8]],
    margin: int,
) -> NDArray[np.int64]:
    """Sums over regions and over what is around them, (N, 2, 2 C + 1): see numpy_robust."""
    shapes = {each.shape for each in channels}
    if shapes != {labels.shape} or labels.ndim != 2:
        raise ValueError(f"measure_regions: labels {labels.shape} and channels {shapes} do not fit")
    _check_labels("measure_regions", labels, len(boxes))
    sums: NDArray[np.int64] = _robust.measure_regions(
        np.ascontiguousarray(labels, np.uint8),
        np.ascontiguousarray(boxes, np.int32).reshape(-1, 4),
        [np.ascontiguousarray(each, np.uint8) for each in channels],
        margin,
    )
    return sums


def match_regions(
    query: NDArray[np.uint8], searched: NDArray[np.uint8], boxes: NDArray[np.int32], reach: int
) -> NDArray[np.float64]:
    """How well boxes of one picture are found again in another, (N, 6): see numpy_robust."""
    boxes = np.ascontiguousarray(boxes, np.int32).reshape(-1, 4)
    height, width = query.shape
    if searched.shape != (height + 2 * reach, width + 2 * reach):
        raise ValueError(
            f"match_regions: searched {searched.shape}, query {query.shape}, reach {reach} do not fit"
        )
    _check_boxes("match_regions", boxes, query.shape)
    found: NDArray[np.float64] = _robust.match_regions(
        np.ascontiguousarray(query, np.uint8),
        np.ascontiguousarray(searched, np.uint8),
        boxes,
        reach,
    )
    return found


_light = numpy_light if _native is None else _native


def slopes(
    before: NDArray[np.float32], after: NDArray[np.float32], prior: float
) -> NDArray[np.float64]:
    """By how much one of two (N, C), N > 0, is spread wider than the other, (C,): see numpy_light."""
    if before.shape != after.shape or before.ndim != 2 or len(before) == 0:
        raise ValueError(f"slopes: before {before.shape} and after {after.shape} do not fit")
    if not (np.isfinite(before).all() and np.isfinite(after).all()):
        raise ValueError("slopes: before and after must be finite")
    found: NDArray[np.float64] = _light.slopes(
        np.ascontiguousarray(before, np.float32), np.ascontiguousarray(after, np.float32), prior
    )
    return found


def fit_moves(
    rows_x: NDArray[np.float64],
    rows_y: NDArray[np.float64],
    moves: NDArray[np.float64],
    trust: NDArray[np.float64],
    ridge: NDArray[np.float64],
    wide: float,
    high: float,
) -> tuple[NDArray[np.float64], float]:
    """A robust linear fit (8,) of displacements (N, 2), and its median rest: see numpy_light."""
    count = len(trust)
    if (
        not rows_x.shape == rows_y.shape == (count, 8)
        or moves.shape != (count, 2)
        or ridge.shape != (8,)
    ):
        raise ValueError(
            f"fit_moves: rows {rows_x.shape}, {rows_y.shape} and moves {moves.shape} do not fit"
        )
    if not ((trust >= 0).all() and (trust > 0).any() and (ridge >= 0).all()):
        raise ValueError("fit_moves: trust is 0 or more and somewhere more, a ridge 0 or more")
    if not (np.isfinite(rows_x).all() and np.isfinite(rows_y).all() and np.isfinite(moves).all()):
        raise ValueError("fit_moves: rows and moves must be finite")
    x, y, moved, trusted, damping = (
        np.ascontiguousarray(each, np.float64) for each in (rows_x, rows_y, moves, trust, ridge)
    )
    found: tuple[NDArray[np.float64], float] = _light.fit_moves(
        x, y, moved, trusted, damping, wide, high
    )
    return found


def detail_products(
    before: Bytes, after: Bytes, table: NDArray[np.float32], window: int, cell: int
) -> NDArray[np.float32]:
    """What the details of two pictures (h, w) have in common in cells, (3, h / cell, w / cell): see numpy_light."""
    if before.shape != after.shape or before.ndim != 2 or table.shape != (256,):
        raise ValueError(
            f"detail_products: pictures {before.shape}, {after.shape}, table {table.shape} do not fit"
        )
    if not (
        window % 2 == 1 and 1 <= window <= min(before.shape) and 1 <= cell <= min(before.shape)
    ):
        raise ValueError(
            f"detail_products: window {window}, cell {cell} do not fit pictures {before.shape}"
        )
    found: NDArray[np.float32] = _light.detail_products(
        _bytes(before), _bytes(after), np.ascontiguousarray(table, np.float32), window, cell
    )
    return found


def flow_on_grid(
    flow: NDArray[np.float32], details: NDArray[np.uint8], rows: int, columns: int
) -> NDArray[np.float32]:
    """A flow (h, w, 2) and how strong details (h, w) are, on a grid (rows, columns, 3): see numpy_light."""
    if details.ndim != 2 or flow.shape != (*details.shape, 2):
        raise ValueError(f"flow_on_grid: flow {flow.shape} and details {details.shape} do not fit")
    if not (1 <= rows <= details.shape[0] and 1 <= columns <= details.shape[1]):
        raise ValueError(
            f"flow_on_grid: a grid of {rows} x {columns} does not fit details {details.shape}"
        )
    found: NDArray[np.float32] = _light.flow_on_grid(
        np.ascontiguousarray(flow, np.float32), _bytes(details), rows, columns
    )
    return found


def _target(out: NDArray[np.uint8] | None, shape: tuple[int, ...]) -> NDArray[np.uint8]:
    if out is None:
        return np.empty(shape, np.uint8)
    if (
        out.shape != shape
        or out.dtype != np.uint8
        or not (out.flags.c_contiguous and out.flags.writeable)
    ):
        raise ValueError(
            f"out: found {out.dtype} of shape {out.shape}; give writeable uint8 in C order, {shape}"
        )
    return out


def _check_labels(kernel: str, labels: NDArray[np.uint8], count: int) -> None:
    if labels.dtype != np.uint8 or count > 255:
        raise ValueError(
            f"{kernel}: labels are bytes of at most 255 regions, got {labels.dtype} and {count} regions"
        )


def _check_boxes(name: str, boxes: NDArray[np.int32], shape: tuple[int, ...]) -> None:
    height, width = shape[:2]
    ends = boxes[:, :2] + boxes[:, 2:]
    if (boxes[:, :2] < 0).any() or (boxes[:, 2:] < 1).any() or (ends > [width, height]).any():
        raise ValueError(f"{name}: boxes outside of the {width} x {height} px picture")


def _bytes(array: Bytes) -> Bytes:
    return np.ascontiguousarray(array, np.uint8)


def _known(known: Bytes | None, image: Bytes) -> Bytes | None:
    if known is not None and known.shape != image.shape[:2]:
        raise ValueError(f"known {known.shape} does not fit the image {image.shape}")
    return None if known is None else _bytes(known)


def _check_image(image: Bytes) -> None:
    if image.ndim != 3 or image.shape[2] != 3 or image.size == 0:
        raise ValueError(f"an image is (height, width, 3) and not empty, got {image.shape}")


def _check_mask(mask: Bytes) -> None:
    if mask.ndim != 2 or mask.size == 0:
        raise ValueError(f"a mask is (height, width) and not empty, got {mask.shape}")


def _check_tables(tables: Bytes) -> None:
    if tables.shape != (3, 256):
        raise ValueError(f"tables are (3, 256), got {tables.shape}")


def _check_window(width: int, height: int) -> None:
    if not (1 <= width <= LARGEST_WINDOW_PX and 1 <= height <= LARGEST_WINDOW_PX):
        raise ValueError(
            f"a window is 1 to {LARGEST_WINDOW_PX} px wide and high, got {width} x {height}"
        )
