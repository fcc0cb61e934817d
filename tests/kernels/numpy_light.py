"""The kernels of light and of last pixels in NumPy: the specification of the compiled ones.

Their sums are of real numbers, whose order shows in the last digits: the compiled ones agree but for these.
"""

import numpy as np
from numpy.typing import NDArray


def slopes(
    before: NDArray[np.float32], after: NDArray[np.float32], prior: float
) -> NDArray[np.float64]:
    """(C,) by how much `after` (N, C) is spread wider than `before` (N, C), both about 0, re-weighted three times.

    What lies one and a half median rests off the slope weighs half. `prior` is added to both sums of squares.
    """
    found = np.zeros(before.shape[1])
    for channel in range(before.shape[1]):
        a, b = before[:, channel], after[:, channel]
        rest, scale = np.zeros_like(a), 1.0
        for number in range(4):
            if number > 0:
                rest = b - np.float32(found[channel]) * a
                scale = max(1.5 * float(np.median(np.abs(rest))), 0.01)
            off = rest / np.float32(scale)
            weights = (np.float32(1) / (np.float32(1) + off * off)).astype(np.float64)
            one, other = (
                (weights * each * each).sum() + prior for each in (a.astype(float), b.astype(float))
            )
            found[channel] = np.sqrt(other / one)
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
    """The solution (8,) by which `rows_x` and `rows_y` (N, 8) make `moves` (N, 2), fitted four times; the median rest.

    Rests are lengths, x times `wide` and y times `high`; where there is `trust` (N,) one and a half median ones off
    weigh half. `ridge` (8,) times the sum of weights draws the solution to 0.
    """
    weights, solution, median = trust.copy(), np.zeros(8), 0.0
    for _ in range(4):
        normal = (rows_x * weights[:, None]).T @ rows_x + (rows_y * weights[:, None]).T @ rows_y
        right = (rows_x * weights[:, None]).T @ moves[:, 0] + (rows_y * weights[:, None]).T @ moves[
            :, 1
        ]
        solution = np.linalg.solve(normal + weights.sum() * np.diag(ridge), right)
        rest = np.hypot(
            (moves[:, 0] - rows_x @ solution) * wide, (moves[:, 1] - rows_y @ solution) * high
        )
        median = float(np.median(rest[trust > 0]))
        weights = trust / (1 + (rest / max(1.5 * median, 0.05)) ** 2)
    return solution, median


def detail_products(
    before: NDArray[np.uint8],
    after: NDArray[np.uint8],
    table: NDArray[np.float32],
    window: int,
    cell: int,
) -> NDArray[np.float32]:
    """(3, h / cell, w / cell) means over cells of the details' products: before by after, before and after squared.

    Details are the values (h, w) in `table` (256,) less the mean of `window` pixels each way, the rim mirrored.
    """
    high, wide = before.shape[0] // cell, before.shape[1] // cell
    one, other = (
        _details(table[each], window)[: high * cell, : wide * cell] for each in (before, after)
    )
    products = np.stack([one * other, one * one, other * other])
    return (
        products.reshape(3, high, cell, wide, cell)
        .mean(axis=(2, 4), dtype=np.float64)
        .astype(np.float32)
    )


def _details(values: NDArray[np.float32], window: int) -> NDArray[np.float32]:
    near = np.pad(values.astype(np.float64), window // 2, mode="reflect")
    around = np.lib.stride_tricks.sliding_window_view(near, (window, window)).mean(axis=(-2, -1))
    return np.asarray(values - around.astype(np.float32), np.float32)


def flow_on_grid(
    flow: NDArray[np.float32], details: NDArray[np.uint8], rows: int, columns: int
) -> NDArray[np.float32]:
    """(rows, columns, 3) means over a grid's cells of a flow (h, w, 2) and of how far `details` (h, w) are from 128.

    A pixel that cells share counts in each as far as it covers it.
    """
    lengths = np.abs(details.astype(np.float64) - 128)
    values = np.dstack([flow.astype(np.float64), lengths])
    down, across = _shares(values.shape[0], rows), _shares(values.shape[1], columns)
    return np.einsum("ry,yxc,kx->rkc", down, values, across, optimize=True).astype(np.float32)


def _shares(size: int, cells: int) -> NDArray[np.float64]:
    """(cells, size) the part of each cell that each of `size` pixels in a row covers."""
    starts, at = np.arange(cells)[:, None] * (size / cells), np.arange(size)
    covered = np.minimum(starts + size / cells, at + 1) - np.maximum(starts, at)
    return np.maximum(covered, 0) / (size / cells)
