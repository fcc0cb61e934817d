"""Heights that photos see through: pieces of a height model that would hide ground on which those photos agree.

What stands beside a wall is often a match by chance of two photos, for the wall hides the ground from the others. But
a piece that is not there hides nothing: photos that it would keep from the roof or the ground behind agree on these
(the free space of Merrell et al. 2007, "Real-time visibility-based fusion of depth maps").
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from sorvolo.geometry.arrays import Floats, Floats32, ImageGray, Mask, Rows
from sorvolo.heights.islands import pieces
from sorvolo.heights.lattice import Lattice
from sorvolo.heights.sweep import SweepSettings, choose_views, likeness_on
from sorvolo.heights.terrain import filled
from sorvolo.heights.views import View


@dataclass(frozen=True)
class FreeSpaceSettings:
    """When photos see through a piece of a height model."""

    views: int = 6  # compared with each other at a place
    agrees: float = 0.3  # likeness of two photos, 0 to 1, by which they agree: by chance it is below 0.15
    behind: float = 0.5  # share of the places that a cell hides on which a photo agrees: it sees through the cell
    photos: float = 0.5  # share of the photos that see through a cell, of those that it hides something from
    share: float = 0.5  # of a piece's cells that are seen through: the piece is not there
    margin_cells: float = 1.5  # above the line of sight, below which a cell hides nothing
    step_cells: float = 2.0  # a height this much beside its neighbour's, in cells, is another piece
    window_cells: int = 1000  # whose pieces are worked on at a time
    apron_cells: int = 5  # beyond a tile: more than half a patch


def seen_through(
    lattice: Lattice, up_m: Floats32, views: Sequence[View], pictures: Callable[[int], ImageGray], tile_cells: int,
    sweep: SweepSettings, settings: FreeSpaceSettings = FreeSpaceSettings(),
) -> Mask:
    """(H, W) the cells of pieces of a height model, NaN in holes, that photos see through.

    `pictures(i)` is view i's gray picture of about the cells' detail, compared by `sweep` in tiles of so many cells.
    """
    if not np.isfinite(up_m).any():
        return np.zeros(up_m.shape, bool)
    ground = filled(up_m, np.isfinite(up_m))
    hides, through = np.zeros(up_m.shape, np.uint8), np.zeros(up_m.shape, np.uint8)
    for number, places in _agreed(lattice, ground, np.isfinite(up_m), views, pictures, tile_cells, sweep, settings):
        hidden, agreed = _behind(lattice, up_m, ground, views[number], places, settings)
        hides += hidden > 0
        through += (hidden > 0) & (agreed > settings.behind * hidden)
    cells = (through > 0) & (through > settings.photos * hides)
    found = np.zeros(up_m.shape, bool)
    for x0, y0, x1, y1 in lattice.windows(settings.window_cells):
        here = slice(y0, y1), slice(x0, x1)
        piece = pieces(up_m[here], settings.step_cells * lattice.cell_m)
        share = np.bincount(piece.ravel(), cells[here].ravel()) / np.maximum(np.bincount(piece.ravel()), 1)
        found[here] = (share[piece] > settings.share) & np.isfinite(up_m[here])
    return found


@dataclass(frozen=True, eq=False)
class _Places:
    """Cells that a photo shows, (N,) rows and columns, and whether it agrees with another photo there."""

    rows: Rows
    columns: Rows
    agrees: Mask


def _agreed(
    lattice: Lattice, ground: Floats32, known: Mask, views: Sequence[View], pictures: Callable[[int], ImageGray],
    tile_cells: int, sweep: SweepSettings, settings: FreeSpaceSettings,
) -> list[tuple[int, _Places]]:
    """Of each view, by number, the places at which it can be compared."""
    found: dict[int, list[_Places]] = {}
    for x0, y0, x1, y1 in lattice.windows(tile_cells):
        left, top = max(0, x0 - settings.apron_cells), max(0, y0 - settings.apron_cells)
        right, below = min(lattice.width, x1 + settings.apron_cells), min(lattice.height, y1 + settings.apron_cells)
        up_m = np.ascontiguousarray(ground[top:below, left:right])
        window = lattice.window(left, top, right, below)
        best: dict[int, Floats32] = {}
        chosen = choose_views(window, views, float(np.median(up_m)), settings.views)
        for i, j, alike in likeness_on(window, views, pictures, up_m, chosen, sweep):
            for number in (i, j):
                best[number] = np.maximum(best[number], alike) if number in best else alike
        for number, alike in best.items():
            inner = alike[y0 - top:y1 - top, x0 - left:x1 - left]
            rows, columns = np.nonzero((inner > 0) & known[y0:y1, x0:x1])
            agrees = inner[rows, columns] > settings.agrees
            found.setdefault(number, []).append(_Places(rows + y0, columns + x0, agrees))
    return [(number, _joined(parts)) for number, parts in found.items()]


def _joined(parts: Sequence[_Places]) -> _Places:
    return _Places(*(np.concatenate([getattr(each, name) for each in parts]) for name in ("rows", "columns", "agrees")))


def _behind(
    lattice: Lattice, up_m: Floats32, ground: Floats32, view: View, places: _Places, settings: FreeSpaceSettings
) -> tuple[Rows, Rows]:
    """(H, W) how many places each cell of the model hides from a view, and on how many of these the view agrees."""
    eye = view.site_from_camera.translation_m
    at: Floats = lattice.cells_from_site(eye[None, :2])[0]
    away = np.column_stack([at[0] - places.columns, at[1] - places.rows])
    far = np.maximum(np.linalg.norm(away, axis=1), 1e-3)
    away /= far[:, None]
    here_m = ground[places.rows, places.columns]
    climb = (eye[2] - here_m) / far  # metres a cell on the way to the camera
    margin_m = settings.margin_cells * lattice.cell_m
    hidden, agreed = np.zeros(up_m.size, np.int64), np.zeros(up_m.size, np.int64)
    reach = min(float(np.ptp(ground)) / max(float(climb.min(initial=np.inf)), 1e-3), float(far.max(initial=0.0)))
    step = 1.5
    while step < reach:
        columns = np.rint(places.columns + away[:, 0] * step).astype(int)
        rows = np.rint(places.rows + away[:, 1] * step).astype(int)
        on = (columns >= 0) & (rows >= 0) & (columns < lattice.width) & (rows < lattice.height) & (step < far)
        cell = np.where(on, rows * lattice.width + columns, 0)
        with np.errstate(invalid="ignore"):
            hides = on & (up_m.ravel()[cell] > here_m + climb * step + margin_m)
        np.add.at(hidden, cell[hides], 1)
        np.add.at(agreed, cell[hides & places.agrees], 1)
        step = max(step + 1.0, step * 1.06)
    return hidden.reshape(up_m.shape), agreed.reshape(up_m.shape)
