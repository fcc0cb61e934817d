"""Heights that photos see through: a pixel of a photo shows one place, and often that is one that lies lower.

What stands beside a wall is often a match by chance of two photos, for the wall hides the ground from the others. But
of all cells of a height model that fall on a pixel, the photo shows the one at which it agrees best with another photo.
Where that lies lower than a cell, it sees through that cell (the free space of Merrell et al. 2007, "Real-time
visibility-based fusion of depth maps").
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from sorvolo.geometry.arrays import Floats32, ImageGray, Mask, Rows
from sorvolo.heights.lattice import Lattice
from sorvolo.heights.sweep import SweepSettings, choose_views, likeness_on
from sorvolo.heights.terrain import filled
from sorvolo.heights.views import View

ONE_PAIR = 2
"""So many photos are one pair: nothing confirms what it shows."""

# a height this much beside its neighbour's, in cells, is another piece of ground
_STEP_CELLS = 4.0


def islands(
    up_m: Floats32,
    shown_by: ImageGray,
    cell_m: float,
    most_cells: int = 340,
    window: int = 1000,
    margin: int = 48,
) -> Mask:
    """(H, W) the cells of a height model, NaN in holes, that stand alone where `shown_by` (H, W) photos are too few.

    They are matches by chance (peaks of Hirschmueller 2008): pieces of at most one and a half of the larger patch that
    is compared. `window` cells a side are worked on at a time, with `margin` around.
    """
    found = np.zeros(up_m.shape, bool)
    for x0, y0, x1, y1 in _windows(up_m.shape, window):
        left, top = max(0, x0 - margin), max(0, y0 - margin)
        here = slice(top, y1 + margin), slice(left, x1 + margin)
        # the cells of pieces of few cells
        piece = pieces(up_m[here], _STEP_CELLS * cell_m)
        alone = (np.bincount(piece.ravel())[piece] <= most_cells) & np.isfinite(up_m[here])
        found[y0:y1, x0:x1] = alone[y0 - top : y1 - top, x0 - left : x1 - left]
    return found & (shown_by <= ONE_PAIR)


def _windows(shape: tuple[int, ...], side: int) -> Iterator[tuple[int, int, int, int]]:
    for y0 in range(0, shape[0], side):
        for x0 in range(0, shape[1], side):
            yield x0, y0, min(x0 + side, shape[1]), min(y0 + side, shape[0])


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


_SEEN_VIEWS = 6  # compared with each other at a place
# likeness of two photos, 0 to 1, by which they agree: by chance it is below 0.15
_SEEN_AGREES = 0.3
_SEEN_MARGIN_CELLS = 1.5  # what a photo shows, less than that beside a cell's height, is the cell
_SEEN_SHARE = 0.5  # of a piece: seen through so many times, of the times that it is seen
_SEEN_STEP_CELLS = 2.0  # a height this much beside its neighbour's, in cells, is another piece
_SEEN_WINDOW_CELLS = 1000  # whose pieces are worked on at a time
_SEEN_APRON_CELLS = 5  # beyond a tile: more than half a patch


def seen_through(
    lattice: Lattice,
    up_m: Floats32,
    views: Sequence[View],
    pictures: Callable[[int], ImageGray],
    tile_cells: int,
    sweep: SweepSettings,
) -> Mask:
    """(H, W) the cells of a height model, NaN in holes, that as many photos see through as see them, and some pieces.

    Of a piece fewer are enough, for it has many cells.
    `pictures(i)` is view i's gray picture of about the cells' detail, compared by `sweep` in tiles of so many cells.
    """
    known = np.isfinite(up_m)
    if not known.any():
        return known
    ground = filled(up_m, known)
    through, shown = np.zeros(up_m.shape, np.uint8), np.zeros(up_m.shape, np.uint8)
    for number, places in _compared(lattice, ground, known, views, pictures, tile_cells, sweep):
        lower, itself = _seen_at(lattice, ground, views[number], places)
        through.ravel()[places.cell[lower]] += 1
        shown.ravel()[places.cell[itself]] += 1
    found = known & (through > 0) & (through >= shown)
    for x0, y0, x1, y1 in lattice.windows(_SEEN_WINDOW_CELLS):
        here = slice(y0, y1), slice(x0, x1)
        rest = np.where(found[here], np.float32(np.nan), up_m[here])
        # a plate beside a wall is apart from it once its own cells are gone
        for model in (
            up_m[here],
            rest,
        ):
            found[here] |= known[here] & _mostly(model, through[here], shown[here], lattice.cell_m)
    return found


@dataclass(frozen=True, eq=False)
class _Places:
    """Cells that a photo shows, (N,), by number, each once, and how well it agrees with another photo there."""

    cell: NDArray[np.int32]
    alike: NDArray[np.float16]


def _compared(
    lattice: Lattice,
    ground: Floats32,
    known: Mask,
    views: Sequence[View],
    pictures: Callable[[int], ImageGray],
    tile_cells: int,
    sweep: SweepSettings,
) -> Iterator[tuple[int, _Places]]:
    """Of each view, by number, the places at which it can be compared with another one."""
    found: dict[int, list[_Places]] = {}
    apron = _SEEN_APRON_CELLS
    for x0, y0, x1, y1 in lattice.windows(tile_cells):
        left, top = max(0, x0 - apron), max(0, y0 - apron)
        right, below = min(lattice.width, x1 + apron), min(lattice.height, y1 + apron)
        up_m = np.ascontiguousarray(ground[top:below, left:right])
        window = lattice.window(left, top, right, below)
        best: dict[int, Floats32] = {}
        chosen = choose_views(window, views, float(np.median(up_m)), _SEEN_VIEWS)
        for i, j, alike in likeness_on(window, views, pictures, up_m, chosen, sweep):
            for number in (i, j):
                best[number] = np.maximum(best[number], alike) if number in best else alike
        for number, alike in best.items():
            inner = alike[y0 - top : y1 - top, x0 - left : x1 - left]
            rows, columns = np.nonzero((inner > 0) & known[y0:y1, x0:x1])
            cell = ((rows + y0) * lattice.width + columns + x0).astype(np.int32)
            found.setdefault(number, []).append(
                _Places(cell, inner[rows, columns].astype(np.float16))
            )
    for number, parts in found.items():
        places = _Places(
            *(np.concatenate([getattr(each, name) for each in parts]) for name in ("cell", "alike"))
        )
        if len(places.cell):
            yield number, places


def _seen_at(lattice: Lattice, ground: Floats32, view: View, places: _Places) -> tuple[Mask, Mask]:
    """(N,) at which places a view's pixel shows another one, which lies lower, and at which the place itself."""
    rows, columns = np.divmod(places.cell, lattice.width)
    up_m = ground.ravel()[places.cell]
    cells = np.column_stack([columns, rows, np.ones(len(rows))])
    pixels = view.pixels_from_site(
        np.column_stack([(cells @ lattice.site_from_cells.T)[:, :2], up_m])
    )
    reach_m = max(float(view.site_from_camera.translation_m[2] - np.median(up_m)), 1e-3)
    per_cell = max(lattice.cell_m * view.camera.fx_px / reach_m, 1.0)
    width, height = (
        int(side / per_cell) + 2 for side in (view.camera.width_px, view.camera.height_px)
    )
    x, y = np.clip(np.rint(pixels / per_cell).astype(int), 0, [width - 1, height - 1]).T
    at, order = y * width + x, np.argsort(places.alike, kind="stable")
    alike, shows_m = np.zeros(width * height, np.float32), np.zeros(width * height, np.float32)
    # of several the last is the most alike
    alike[at[order]], shows_m[at[order]] = (
        places.alike[order],
        up_m[order],
    )
    agrees, above_m = alike[at] > _SEEN_AGREES, up_m - shows_m[at]
    margin_m = _SEEN_MARGIN_CELLS * lattice.cell_m
    return agrees & (above_m > margin_m), agrees & (np.abs(above_m) <= margin_m)


def _mostly(up_m: Floats32, through: ImageGray, shown: ImageGray, cell_m: float) -> Mask:
    """(H, W) the cells of pieces that are seen through often, of the times that they are seen."""
    piece = pieces(up_m, _SEEN_STEP_CELLS * cell_m)
    often, seen = (np.bincount(piece.ravel(), each.ravel()) for each in (through, shown))
    return np.asarray(((often > 0) & (often >= _SEEN_SHARE * seen))[piece])
