"""Small pieces of a height model that stand alone and that too few photos confirm: matches by chance."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from sorvolo.geometry.arrays import Floats32, ImageGray, Mask, Rows


@dataclass(frozen=True)
class IslandSettings:
    """What counts as a match by chance (peaks of Hirschmueller 2008)."""

    step_cells: float = (
        4.0  # a height this much beside its neighbour's, in cells, is another piece of ground
    )
    most_cells: int = 340  # of an island: one and a half of the larger patch that is compared
    photos: int = 2  # one pair of photos: nothing confirms what it shows
    window_cells: int = 1000  # worked on at a time ...
    margin_cells: int = 48  # ... with so many around


def islands(
    up_m: Floats32, shown_by: ImageGray, cell_m: float, settings: IslandSettings = IslandSettings()
) -> Mask:
    """(H, W) the cells of a height model, NaN in holes, that stand alone where `shown_by` (H, W) photos are too few."""
    found = np.zeros(up_m.shape, bool)
    margin = settings.margin_cells
    for x0, y0, x1, y1 in _windows(up_m.shape, settings.window_cells):
        left, top = max(0, x0 - margin), max(0, y0 - margin)
        here = slice(top, y1 + margin), slice(left, x1 + margin)
        alone = _alone(up_m[here], settings.step_cells * cell_m, settings.most_cells)
        found[y0:y1, x0:x1] = alone[y0 - top : y1 - top, x0 - left : x1 - left]
    return found & (shown_by <= settings.photos)


def _windows(shape: tuple[int, ...], side: int) -> Iterator[tuple[int, int, int, int]]:
    for y0 in range(0, shape[0], side):
        for x0 in range(0, shape[1], side):
            yield x0, y0, min(x0 + side, shape[1]), min(y0 + side, shape[0])


def _alone(up_m: Floats32, step_m: float, most_cells: int) -> Mask:
    """(H, W) the cells of pieces of few cells."""
    piece = pieces(up_m, step_m)
    return np.asarray((np.bincount(piece.ravel())[piece] <= most_cells) & np.isfinite(up_m))


def pieces(up_m: Floats32, step_m: float) -> Rows:
    """(H, W) the number of the piece that each cell is of: within one, neighbours differ by less than a step."""
    number = np.arange(up_m.size).reshape(up_m.shape)
    joined: list[tuple[Rows, Rows]] = []
    for here, there in ((np.s_[:, 1:], np.s_[:, :-1]), (np.s_[1:], np.s_[:-1])):
        with np.errstate(invalid="ignore"):
            close = np.abs(up_m[here] - up_m[there]) < step_m
        joined.append((number[here][close], number[there][close]))
    rows, columns = (np.concatenate(each) for each in zip(*joined, strict=True))
    ties = coo_matrix((np.ones(len(rows), np.int8), (rows, columns)), shape=(up_m.size, up_m.size))
    _, piece = connected_components(ties, directed=False)
    return np.asarray(piece.reshape(up_m.shape), np.int64)
