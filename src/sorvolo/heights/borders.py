"""Where what stands on the ground ends: what patches carried beyond an edge is given back to the ground beside it.

Photos are compared in patches. One that lies beside a roof but reaches its edge fits best at the roof's height, so
roofs and crowns came out wider than they are by up to half a patch. Here the cells near a step decide anew, each
between its own height and that of the ground beside it, by patches so small that they blur nothing; and the border
between the two runs along edges of the picture, by a minimum cut (Boykov and Jolly 2001, "Interactive graph cuts").
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy.sparse import coo_matrix, csr_matrix
from scipy.sparse.csgraph import breadth_first_order, maximum_flow

from sorvolo.geometry.arrays import Floats, Floats32, ImageGray, Mask, Rows
from sorvolo.geometry.ground import laid_pixels
from sorvolo.heights.lattice import Lattice
from sorvolo.heights.sweep import SweepSettings, choose_views, likeness_on
from sorvolo.heights.terrain import filled
from sorvolo.heights.views import View, inside

_CAPACITY = 1000  # of the cut, which counts in whole numbers, for a likeness of 1
_WAYS = tuple(  # to the eight neighbours, down and right, and what a tie to each weighs
    (down, right, 1.0 if 0 in (down, right) else 0.7)
    for down in (-1, 0, 1)
    for right in (-1, 0, 1)
    if down or right
)


_BORDER_STEP_CELLS = 8.0  # a height so far above one nearby, in cells, stands on the ground
# nearby: more than half of a patch of 15 cells, and the blur of its contrast
_BORDER_REACH_CELLS = 9
_BORDER_WINDOW_CELLS = 3  # side of the patches that decide
_BORDER_VIEWS = 6  # compared at a place
_BORDER_PAIR_SHARE = 0.2  # of their pairs, the most alike: the others may be hidden from it
_BORDER_EVIDENCE = 2.0  # what a likeness weighs against a border of one cell
_BORDER_STAYS = 0.05  # likeness in favour of the height that was found
# gray levels between neighbours, at which a border costs 0.6 of its price
_BORDER_EDGE_LEVELS = 8.0
_BORDER_APRON_CELLS = 24  # beyond a tile, so that neighbouring tiles agree


def beyond_borders(
    lattice: Lattice,
    up_m: Floats32,
    views: Sequence[View],
    pictures: Callable[[int], ImageGray],
    tile_cells: int,
    sweep: SweepSettings,
) -> Floats32:
    """(H, W) the ground's height at the cells that patches gave to what stands beside them; NaN at all others.

    `up_m` (H, W) is a height model, NaN in holes; `pictures(i)` view i's gray picture of about the cells' detail,
    compared as `sweep` has it, in tiles of so many cells.
    """
    found = np.full(up_m.shape, np.nan, np.float32)
    small = replace(sweep, window_cells=(_BORDER_WINDOW_CELLS, _BORDER_WINDOW_CELLS))
    for x0, y0, x1, y1 in lattice.windows(tile_cells):
        apron = _BORDER_APRON_CELLS
        left, top = max(0, x0 - apron), max(0, y0 - apron)
        right, below = min(lattice.width, x1 + apron), min(lattice.height, y1 + apron)
        part = up_m[top:below, left:right]
        standing = _standing(part, lattice.cell_m)
        if standing is None:
            continue
        moved = ~_kept(lattice.window(left, top, right, below), standing, views, pictures, small)
        inner = slice(y0 - top, y1 - top), slice(x0 - left, x1 - left)
        found[y0:y1, x0:x1][moved[inner]] = standing.ground_m[inner][moved[inner]]
    return found


@dataclass(frozen=True, eq=False)
class _Standing:
    """Cells with far lower ones nearby, `near` (H, W), the heights of all, and of the ground nearest to each."""

    near: Mask
    up_m: Floats32
    ground_m: Floats32
    step_m: float


def _standing(up_m: Floats32, cell_m: float) -> _Standing | None:
    """What stands near ground in a piece of a height model; None where nothing does."""
    known = np.isfinite(up_m)
    if not known.any():
        return None
    whole = filled(up_m, known)
    side, step_m = 2 * _BORDER_REACH_CELLS + 1, _BORDER_STEP_CELLS * cell_m
    nearby = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))
    calm = cv2.medianBlur(whole, 5)
    near = known & (whole - cv2.erode(calm, nearby) > step_m)
    # the ground beside it, and not the middle of a roof
    below = ~near & (cv2.dilate(calm, nearby) - whole > step_m)
    if not near.any() or not below.any():
        return None
    _, labels = cv2.distanceTransformWithLabels(
        (~below).view(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
    )
    height_of = np.zeros(int(labels.max()) + 1, np.float32)
    height_of[labels[below]] = whole[below]
    return _Standing(near, whole, height_of[labels], step_m)


def _kept(
    lattice: Lattice,
    standing: _Standing,
    views: Sequence[View],
    pictures: Callable[[int], ImageGray],
    sweep: SweepSettings,
) -> Mask:
    """(H, W) which cells keep their height."""
    own_m = standing.up_m
    ground_m = np.where(standing.near, standing.ground_m, own_m)
    chosen = choose_views(lattice, views, float(np.median(own_m)), _BORDER_VIEWS)
    own, ground = (
        _alike(lattice, views, pictures, up_m, chosen, sweep) for up_m in (own_m, ground_m)
    )
    if own is None or ground is None:
        return np.ones(own_m.shape, bool)
    picture = _mean_picture(lattice, views, pictures, own_m, chosen)
    calm = np.asarray(cv2.GaussianBlur(picture, (0, 0), 0.7), np.float32)
    return _cut(standing, _BORDER_EVIDENCE * (own - ground) + _BORDER_STAYS, calm)


def _alike(
    lattice: Lattice,
    views: Sequence[View],
    pictures: Callable[[int], ImageGray],
    up_m: Floats32,
    chosen: Sequence[int],
    sweep: SweepSettings,
) -> Floats32 | None:
    """(H, W) how alike photos are on heights, the mean over their most alike pairs; None without any pair."""
    alike = [each for _, _, each in likeness_on(lattice, views, pictures, up_m, chosen, sweep)]
    if not alike:
        return None
    wanted = int(np.ceil(_BORDER_PAIR_SHARE * len(alike)))
    return np.asarray(
        np.partition(np.stack(alike), -wanted, axis=0)[-wanted:].mean(axis=0), np.float32
    )


def _mean_picture(
    lattice: Lattice,
    views: Sequence[View],
    pictures: Callable[[int], ImageGray],
    up_m: Floats32,
    chosen: Sequence[int],
) -> Floats32:
    """(H, W) the mean of the photos laid on heights: sharp where those are right, blurred elsewhere."""
    total, count = (np.zeros(up_m.shape, np.float32) for _ in range(2))
    for number in chosen:
        view, picture = views[number], pictures(number)
        camera = view.camera.resized(picture.shape[1], picture.shape[0])
        x, y = laid_pixels(camera, view.site_from_camera, lattice.site_from_cells, up_m)
        seen = inside(np.stack([x, y], axis=-1), camera)
        total += np.where(seen, cv2.remap(picture.astype(np.float32), x, y, cv2.INTER_LINEAR), 0)
        count += seen
    return np.asarray(total / np.maximum(count, 1), np.float32)


class _Ties:
    """A graph to be cut between its two last nodes: `keep` and `give`."""

    def __init__(self, nodes: int) -> None:
        self.keep, self.give = nodes, nodes + 1
        self._parts: list[tuple[Rows, Rows, Floats]] = []

    def add(self, begin: Rows | int, end: Rows | int, price: Floats) -> None:
        """Ties from `begin` to `end`, (N,) or one for all, and what it costs to cut each, (N,)."""
        self._parts.append(
            (np.broadcast_to(begin, price.shape), np.broadcast_to(end, price.shape), price)
        )

    def kept(self) -> Rows:
        """The nodes that stay with `keep` when the ties between it and `give` are cut as cheaply as can be."""
        begin, end, price = (np.concatenate(each) for each in zip(*self._parts, strict=True))
        capacity = np.rint(_CAPACITY * price).astype(np.int32)
        ties = csr_matrix(
            coo_matrix((capacity, (begin, end)), shape=(self.give + 1, self.give + 1))
        )
        rest = ties - maximum_flow(ties, self.keep, self.give).flow
        rest.data = np.maximum(rest.data, 0)
        rest.eliminate_zeros()
        reached, _ = breadth_first_order(rest, self.keep)
        return np.asarray(reached)


def _cut(standing: _Standing, gain: Floats32, picture: Floats32) -> Mask:
    """(H, W) the cells that keep their height: the cheapest border between those that should and those that should not.

    `gain` (H, W) is what keeping its height gains at a cell; a border costs less where the picture has an edge.
    """
    near, up_m, (height, width) = standing.near, standing.up_m, standing.near.shape
    rows, columns = np.nonzero(near)
    nodes, number = np.arange(len(rows)), np.full(near.shape, -1)
    number[near] = nodes
    ties = _Ties(len(nodes))
    ties.add(ties.keep, nodes, np.maximum(gain[near], 0))
    ties.add(nodes, ties.give, np.maximum(-gain[near], 0))
    for down, right, weight in _WAYS:
        y, x = rows + down, columns + right
        lies = (y >= 0) & (y < height) & (x >= 0) & (x < width)
        here, y, x, own_y, own_x = nodes[lies], y[lies], x[lies], rows[lies], columns[lies]
        apart = picture[y, x] - picture[own_y, own_x]
        price = weight * np.exp(-(apart**2) / (2 * _BORDER_EDGE_LEVELS**2))
        there = number[y, x]
        ties.add(here[there >= 0], there[there >= 0], price[there >= 0])
        # a neighbour with nothing lower nearby is the middle of a roof, or the ground
        stands = np.abs(up_m[y, x] - up_m[own_y, own_x]) < 0.5 * standing.step_m
        for other, which in ((ties.keep, (there < 0) & stands), (ties.give, (there < 0) & ~stands)):
            begin, end = (other, here[which]) if other == ties.keep else (here[which], other)
            ties.add(begin, end, price[which])
    kept = np.ones(near.shape, bool)
    kept[near] = np.isin(nodes, ties.kept())
    return kept
