"""What the compiled module offers; tests/kernels/numpy_*.py state what it computes."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Bytes = NDArray[np.uint8]

def equalising_tables(image: Bytes, known: Bytes | None, threads: int) -> Bytes: ...
def averaged(
    image: Bytes, tables: Bytes, width: int, height: int, threads: int
) -> tuple[Bytes, Bytes]: ...
def texture_changes(
    reference: Bytes, query: Bytes, asked: Bytes, width: int, height: int, most: int, threads: int
) -> Bytes: ...
def without_isolations(
    mask: Bytes, width: int, height: int, most_black: int, threads: int
) -> Bytes: ...
def region_boxes(mask: Bytes) -> NDArray[np.int64]: ...
def held_parts(mask: Bytes, seeds: Bytes) -> Bytes: ...
def gray_histograms(
    image: Bytes, tables: Bytes, boxes: NDArray[np.int64], known: Bytes | None
) -> NDArray[np.int64]: ...
def relight(
    image: Bytes,
    curves: NDArray[np.int32],
    gains: NDArray[np.float32],
    left: int,
    top: int,
    wide: int,
    high: int,
    out: Bytes,
) -> None: ...
def differences(
    reference: Bytes, query: Bytes, known: Bytes | None, reach: int, weight: int, out: Bytes
) -> None: ...
def tint(
    reference: Bytes, query: Bytes, logs: Bytes, boxes: NDArray[np.int32], margin: int, out: Bytes
) -> None: ...
def rim_balance(
    labels: Bytes, boxes: NDArray[np.int32], came: Bytes, went: Bytes
) -> NDArray[np.int64]: ...
def core_regions(
    values: NDArray[np.uint8],
    thresholds: NDArray[np.uint8],
    strong: float,
    core: float,
    least_area: int,
    most: int,
) -> tuple[Bytes, NDArray[np.int32]]: ...
def measure_regions(
    labels: Bytes, boxes: NDArray[np.int32], channels: Sequence[NDArray[np.uint8]], margin: int
) -> NDArray[np.int64]: ...
def match_regions(
    query: NDArray[np.uint8], reference: NDArray[np.uint8], boxes: NDArray[np.int32], reach: int
) -> NDArray[np.float64]: ...
def tree_margins(
    rows: NDArray[np.float64],
    asked: NDArray[np.int32],
    thresholds: NDArray[np.float64],
    leaves: NDArray[np.float64],
) -> NDArray[np.float64]: ...
def slopes(
    before: NDArray[np.float32], after: NDArray[np.float32], prior: float
) -> NDArray[np.float64]: ...
def fit_moves(
    rows_x: NDArray[np.float64],
    rows_y: NDArray[np.float64],
    moves: NDArray[np.float64],
    trust: NDArray[np.float64],
    ridge: NDArray[np.float64],
    wide: float,
    high: float,
) -> tuple[NDArray[np.float64], float]: ...
def detail_products(
    before: Bytes, after: Bytes, table: NDArray[np.float32], window: int, cell: int
) -> NDArray[np.float32]: ...
def flow_on_grid(
    flow: NDArray[np.float32], details: Bytes, rows: int, columns: int
) -> NDArray[np.float32]: ...
def agreements(
    pictures: Sequence[NDArray[np.float32]],
    channel: NDArray[np.int64],
    planes: NDArray[np.float64],
    frames: NDArray[np.float64],
    insets: NDArray[np.float32],
    hidden: Sequence[NDArray[np.float32] | None],
    heights: NDArray[np.float64],
    sides: Sequence[int],
    rows: int,
    columns: int,
    share: float,
    threads: int,
) -> NDArray[np.float32]: ...
def path_costs(
    cost: NDArray[np.float32], one_level: float, more_levels: float
) -> NDArray[np.float32]: ...
