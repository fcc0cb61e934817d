"""The ground as square cells and squares of pictures: what a flight's views add up to, kept in chunks."""

from collections import OrderedDict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from sorvolo.change.outlines import dilated
from sorvolo.change.patches import Cut, PatchWindow, cut, patch_of, quality
from sorvolo.geometry.arrays import (
    Bytes,
    Floats,
    Floats32,
    ImageGray,
    Ints32,
    Labels,
    Mask,
    Matrix3,
    PointsM,
    shrunk,
    square,
)
from sorvolo.geometry.homography import apply_homography, resized
from sorvolo.survey.findings import ComparedView, Patch

CHUNK = 64  # cells, along a side of a stored piece
_VOTES: Bytes = np.array([bin(bits).count("1") for bits in range(256)], np.uint8)


# How large a cell is, and how far views are laid on cells.
_SIDE_PX = 3  # pixels of changes' pictures, along a cell's side
_LEAST_M = 0.05  # along a cell's side
_FAR_HEIGHTS = 5.0  # flying heights: ground further away shows nothing that a cell could hold
_MOST_CELLS = 2_000_000  # cells of one view, which bounds its memory


@dataclass(frozen=True)
class CellWindow:
    """Cells x0 <= column < x1, y0 <= row < y1. Columns count east, rows south; both may be negative."""

    x0: int
    y0: int
    x1: int
    y1: int

    @property
    def shape(self) -> tuple[int, int]:
        """Rows, columns."""
        return max(self.y1 - self.y0, 0), max(self.x1 - self.x0, 0)

    def joined(self, other: "CellWindow") -> "CellWindow":
        """The smallest window that holds both."""
        return CellWindow(
            min(self.x0, other.x0),
            min(self.y0, other.y0),
            max(self.x1, other.x1),
            max(self.y1, other.y1),
        )

    def overlap(self, other: "CellWindow") -> "CellWindow":
        """The cells that lie in both; its shape has a 0 where there are none."""
        return CellWindow(
            max(self.x0, other.x0),
            max(self.y0, other.y0),
            min(self.x1, other.x1),
            min(self.y1, other.y1),
        )

    def grown(self, cells: int) -> "CellWindow":
        """The window with this many cells more on each side."""
        return CellWindow(self.x0 - cells, self.y0 - cells, self.x1 + cells, self.y1 + cells)

    def part(self, part: tuple[slice, slice]) -> "CellWindow":
        """The window of a part, rows and columns, of this window's raster."""
        rows, columns = part
        return CellWindow(
            self.x0 + columns.start,
            self.y0 + rows.start,
            self.x0 + columns.stop,
            self.y0 + rows.stop,
        )

    def within(self, outer: "CellWindow") -> tuple[slice, slice]:
        """Where this window lies in the raster of another; what sticks out is cut off."""
        return (
            slice(max(self.y0 - outer.y0, 0), max(self.y1 - outer.y0, 0)),
            slice(max(self.x0 - outer.x0, 0), max(self.x1 - outer.x0, 0)),
        )

    def box_m(self, cell_m: float) -> tuple[Floats, Floats]:
        """South-west and north-east corner, (2,) each, in site metres."""
        return np.array([self.x0, -self.y1]) * cell_m, np.array([self.x1, -self.y0]) * cell_m

    def site_from_cell(self, cell_m: float) -> Matrix3:
        """(3, 3) affine map from a raster of this window, (0, 0) the centre of its first cell, to site metres."""
        return np.array(
            [
                [cell_m, 0.0, (self.x0 + 0.5) * cell_m],
                [0.0, -cell_m, -(self.y0 + 0.5) * cell_m],
                [0.0, 0.0, 1.0],
            ]
        )


def cell_side_m(m_per_px: float) -> float:
    """Return the side of a cell for changes' pictures with pixels of this size."""
    return max(_LEAST_M, _SIDE_PX * m_per_px)


def window_around(points_m: PointsM, cell_m: float) -> CellWindow:
    """The cells of the box around points, shape (N, 2), in site metres."""
    columns, rows = points_m[:, 0] / cell_m, -points_m[:, 1] / cell_m
    return CellWindow(
        int(np.floor(columns.min())),
        int(np.floor(rows.min())),
        int(np.ceil(columns.max())),
        int(np.ceil(rows.max())),
    )


class CellReport(NamedTuple):
    """What one view reports of some cells."""

    seen: float  # share of them
    flagged: float  # share of them
    score: float  # 0 to 1, the highest of the flagged ones


@dataclass(frozen=True, eq=False)
class LaidView:
    """One view as cells of a window: `flagged` where it shows a change, `seen` where it knows the ground.

    `score` is 255 times the sureness of the change there; `held` marks cells under things that may move. `legs` has the
    leg of the followed blob that shows the change there, 0 where none does.
    """

    window: CellWindow
    flagged: Mask
    seen: Mask
    score: ImageGray
    held: Mask
    legs: Ints32

    @cached_property
    def at_rim(self) -> Mask:
        """The flagged pieces that end at unknown ground or at the view's rim."""
        beside = dilated(np.pad(~self.seen, 1, constant_values=True), 3)[1:-1, 1:-1]
        _, labels = cv2.connectedComponents(self.flagged.view(np.uint8), connectivity=8)
        return np.isin(labels, np.unique(labels[beside & self.flagged]))

    def leg_of(self, window: CellWindow, cells: Mask) -> int:
        """The leg of the followed blob that shows most of what is flagged of some `cells` of a window; or 0."""
        legs = self.legs[window.within(self.window)][self.part_of(self.flagged, window, cells)]
        return int(np.bincount(legs).argmax()) if len(legs) else 0

    def report(self, window: CellWindow, cells: Mask) -> "CellReport":
        """What the view reports of some `cells` of a window."""
        inner = window.overlap(self.window)
        if 0 in inner.shape:
            return CellReport(0.0, 0.0, 0.0)
        here, there = inner.within(window), inner.within(self.window)
        mine, total = cells[here], max(int(np.count_nonzero(cells)), 1)
        flagged = mine & self.flagged[there]
        seen = np.count_nonzero(mine & self.seen[there]) / total
        score = float(self.score[there][flagged].max(initial=0)) / 255
        return CellReport(seen, np.count_nonzero(flagged) / total, score)

    def part_of(self, marked: Mask, window: CellWindow, cells: Mask) -> Mask:
        """Which of some `cells` of a window the view has `marked`, as far as it reaches."""
        return marked[window.within(self.window)] & cells[self.window.within(window)]


def lay(view: ComparedView, cell_m: float, ignored: Mask, held: Mask, legs: Labels) -> LaidView:
    """The view as cells of the ground.

    `ignored` and `held`, (number of boxes,), choose boxes: what lies in ignored ones is taken for unknown ground.
    `legs`, (number of boxes,), are those of the blobs followed in them, 0 for none. A cell is flagged where
    most of it is changed, and seen where the map and the frame know all of it.
    """
    height, width = view.changed.shape
    m_per_px = view.m_per_px
    shrink = int(np.clip(cell_m / m_per_px, 1, min(height, width)))
    rows, columns = height // shrink, width // shrink

    def small(image: ImageGray) -> ImageGray:
        if shrink == 1:
            return image
        cut = image[: rows * shrink, : columns * shrink]
        return shrunk(cut, (columns, rows))

    changed = small(view.changed)
    valid = small(view.valid.view(np.uint8) * np.uint8(255))
    score, in_held, followed = (np.zeros((rows, columns), np.uint8) for _ in range(3))
    numbers = np.unique(np.append(legs, 0))[:256]
    for index in np.argsort(view.scores, kind="stable"):
        x, y, w, h = view.boxes[index]
        part = np.s_[y // shrink : -(-(y + h) // shrink), x // shrink : -(-(x + w) // shrink)]
        score[part] = round(255 * float(np.clip(view.scores[index], 0, 1)))
        followed[part] = np.searchsorted(numbers, legs[index]) % len(numbers)
        if ignored[index]:
            valid = valid if valid.flags.writeable else valid.copy()
            valid[part][changed[part] > 0] = 0
        if held[index]:
            in_held[part] = 255
    window = _window_of(view, cell_m)
    cell_from_image = np.linalg.inv(window.site_from_cell(cell_m)) @ view.site_from_image
    cell_from_small = cell_from_image @ resized(shrink, shrink)
    size = window.shape[::-1]

    def laid(image: ImageGray, how: int) -> ImageGray:
        return np.asarray(cv2.warpPerspective(image, cell_from_small, size, flags=how), np.uint8)

    seen = laid(valid, cv2.INTER_LINEAR) >= 250
    _clear_behind(seen, cell_from_small)
    flagged = (laid(changed, cv2.INTER_LINEAR) >= 128) & seen
    may_move = laid(in_held, cv2.INTER_NEAREST) > 0 if held.any() else np.zeros_like(seen)
    return LaidView(
        window,
        flagged,
        seen,
        np.where(flagged, laid(score, cv2.INTER_NEAREST), 0),
        may_move,
        numbers[laid(followed, cv2.INTER_NEAREST)].astype(np.int32),
    )


def pieces(cells: Mask, gap: int) -> Iterator[tuple[Mask, tuple[slice, slice]]]:
    """The connected pieces of cells, gaps of up to `gap` cells closed: each with the raster's part that holds it."""
    side = 2 * ((gap + 1) // 2) + 1  # odd: an even one would shift the cells
    closed = cv2.morphologyEx(cells.view(np.uint8), cv2.MORPH_CLOSE, square(side))
    count, labels, stats, _ = cv2.connectedComponentsWithStats(closed, connectivity=8)
    for label in range(1, count):
        x, y, w, h = (int(each) for each in stats[label, :4])
        part = (slice(y, y + h), slice(x, x + w))
        yield labels[part] == label, part


def _window_of(view: ComparedView, cell_m: float) -> CellWindow:
    height, width = view.changed.shape
    x, y = np.meshgrid(np.linspace(-0.5, width - 0.5, 5), np.linspace(-0.5, height - 0.5, 5))
    ground_m = apply_homography(view.site_from_image, np.column_stack([x.ravel(), y.ravel()]))
    reach_m = max(_FAR_HEIGHTS * float(view.camera_m[2]), 1.0)
    reach_m = min(reach_m, 0.5 * cell_m * np.sqrt(_MOST_CELLS))
    low, high = view.camera_m[:2] - reach_m, view.camera_m[:2] + reach_m
    near = np.isfinite(ground_m).all(axis=1)
    if not near.any():
        return CellWindow(0, 0, 1, 1)
    if not near.all():
        ground_m = np.vstack(
            [ground_m[near], low, high]
        )  # part of the view lies beyond the horizon
    return window_around(np.clip(ground_m, low, high), cell_m)


def _clear_behind(seen: Mask, cell_from_image: Matrix3) -> None:
    # the warp would show ground behind the camera, too; there the third coordinate is not positive
    row = np.linalg.inv(cell_from_image)[2]
    height, width = seen.shape
    corners = np.array([[0, 0, 1], [width, 0, 1], [width, height, 1], [0, height, 1.0]])
    if (corners @ row > 0).all():
        return
    y, x = np.mgrid[:height, :width]
    seen[x * row[0] + y * row[1] + row[2] <= 0] = False


@dataclass(frozen=True, eq=False)
class CellEvidence:
    """What the cells of a window hold: `votes` of the last n views that saw each cell, how many views ever `seen` it
    and found it `changed`, and the number of the change that owns it, 0 = none."""

    votes: Bytes
    seen: NDArray[np.uint16]
    changed: NDArray[np.uint16]
    owner: Ints32


class _Chunk:
    def __init__(self, seen: int) -> None:
        self.history = np.zeros((CHUNK, CHUNK), np.uint8)
        self.seen = np.full((CHUNK, CHUNK), seen, np.uint16)
        self.changed = np.zeros((CHUNK, CHUNK), np.uint16)
        self.owner = np.zeros((CHUNK, CHUNK), np.int32)


class EvidenceGrid:
    """Histories of the cells, kept only where something changed. `record` and `own` change it.

    At most `most_chunks` pieces of 64 x 64 cells are kept; the one not used for the longest time goes first.
    """

    def __init__(self, n: int, most_chunks: int = 4096) -> None:
        self._kept_bits = np.uint8((1 << n) - 1)
        self._most_chunks = most_chunks
        self._chunks: OrderedDict[tuple[int, int], _Chunk] = OrderedDict()
        self._quiet: dict[
            tuple[int, int], int
        ] = {}  # views of chunks in which nothing ever changed

    def record(self, laid: LaidView, counts: bool) -> CellEvidence:
        """Shift one view into the cells' histories; the counts over all views take it in if it `counts`."""
        for key, inside, part in chunk_parts(laid.window):
            flagged, seen = laid.flagged[part], laid.seen[part]
            chunk = self._chunks.get(key)
            if chunk is None:
                if not flagged.any():
                    if counts and flagged.size == CHUNK * CHUNK and seen.all():
                        self._quiet[key] = self._quiet.get(key, 0) + 1
                    continue
                if len(self._chunks) >= self._most_chunks:
                    self._chunks.popitem(last=False)
                chunk = self._chunks[key] = _Chunk(min(self._quiet.pop(key, 0), 60_000))
            self._chunks.move_to_end(key)
            history = chunk.history[inside]
            shifted = ((history << np.uint8(1)) | flagged.view(np.uint8)) & self._kept_bits
            np.copyto(history, shifted, where=seen)
            if counts:
                for ever, now in ((chunk.seen, seen), (chunk.changed, flagged)):
                    np.minimum(ever[inside] + now, 60_000, out=ever[inside])
        return self.read(laid.window)

    def read(self, window: CellWindow) -> CellEvidence:
        """What the cells of a window hold now."""
        types = (np.uint8, np.uint16, np.uint16, np.int32)
        found = CellEvidence(*(np.zeros(window.shape, kind) for kind in types))
        for key, inside, part in chunk_parts(window):
            chunk = self._chunks.get(key)
            if chunk is not None:
                found.votes[part] = _VOTES[chunk.history[inside]]
                found.seen[part], found.changed[part] = chunk.seen[inside], chunk.changed[inside]
                found.owner[part] = chunk.owner[inside]
        return found

    def own(self, window: CellWindow, cells: Mask, number: int) -> None:
        """Give cells of a window to a change."""
        for key, inside, part in chunk_parts(window):
            chunk = self._chunks.get(key)
            if chunk is not None:
                chunk.owner[inside][cells[part]] = number


def chunk_parts(
    window: CellWindow,
) -> Iterator[tuple[tuple[int, int], tuple[slice, slice], tuple[slice, slice]]]:
    """Chunk, its part inside the window, and where that part lies in a raster of the window."""
    for row in range(window.y0 // CHUNK, -(-window.y1 // CHUNK)):
        y0, y1 = max(window.y0, row * CHUNK), min(window.y1, (row + 1) * CHUNK)
        rows, rows_here = (
            slice(y0 - row * CHUNK, y1 - row * CHUNK),
            slice(y0 - window.y0, y1 - window.y0),
        )
        for column in range(window.x0 // CHUNK, -(-window.x1 // CHUNK)):
            x0, x1 = max(window.x0, column * CHUNK), min(window.x1, (column + 1) * CHUNK)
            inside = (rows, slice(x0 - column * CHUNK, x1 - column * CHUNK))
            yield (column, row), inside, (rows_here, slice(x0 - window.x0, x1 - window.x0))


# How pictures of areas are kept.
_MOST_SQUARES = 400  # 200 MB; further squares have no pictures
_MARGIN = 0.1  # of an area's length is shown around it
_BETTER = 1.15  # times as good a view's pictures must be to replace older ones


class GroundPictures:
    """The best pictures of squares of ground, `m_per_px` a pixel, `side_px` along a side. Only `show` changes it.

    The picture of an area has at most `most_patch_px` along its longest side.
    """

    def __init__(self, m_per_px: float, side_px: int = 256, most_patch_px: int = 2048) -> None:
        self._m_per_px = m_per_px
        self._side_px, self._most_patch_px = side_px, most_patch_px
        self._side_m = side_px * m_per_px
        self._squares: dict[tuple[int, int], tuple[Cut, float]] = {}

    def show(self, view: ComparedView, places_m: PointsM) -> None:
        """Take the view's pictures of the squares that hold any of these places, (N, 2), where they are better."""
        side_m = self._side_m
        for key in _squares_at(places_m / side_m):
            if key not in self._squares and len(self._squares) >= _MOST_SQUARES:
                continue
            low_m = np.array(key) * side_m
            good = quality(view, low_m, low_m + side_m)
            old = self._squares.get(key)
            if old is not None and good <= _BETTER * old[1] and (old[0].after[..., 3] > 0).all():
                continue
            new = cut(view, self._window(key))
            if old is None:
                self._squares[key] = new, good
            elif good > _BETTER * old[1]:
                self._squares[key] = new.over(old[0]), good
            else:
                self._squares[key] = old[0].over(new), old[1]

    def patch(self, outline_m: PointsM) -> Patch:
        """The pictures of an outline, (N, 2), and of a little ground around it; nothing is known beyond the squares."""
        low_m, high_m = outline_m.min(axis=0), outline_m.max(axis=0)
        margin_m = _MARGIN * float((high_m - low_m).max())
        coarse = self._m_per_px
        while float((high_m - low_m).max() + 2 * margin_m) / coarse > self._most_patch_px - 2:
            coarse *= 2
        (west, south), (east, north) = (
            np.floor((low_m - margin_m) / coarse),
            np.ceil((high_m + margin_m) / coarse),
        )
        window = PatchWindow(
            west * coarse, north * coarse, coarse, int(east - west), int(north - south)
        )
        size = window.height_px, window.width_px
        whole = Cut(
            np.zeros((*size, 4), np.uint8), np.zeros((*size, 4), np.uint8), np.zeros(size, np.uint8)
        )
        for key in self._around(low_m - margin_m, high_m + margin_m):
            own = self._window(key)
            rows, columns, part = window.part(own)
            if part.width_px > 0 and part.height_px > 0:
                there = Cut(
                    whole.before[rows, columns],
                    whole.after[rows, columns],
                    whole.shade[rows, columns],
                )
                joined = there.over(self._squares[key][0].moved(part, own))
                there.before[:], there.after[:], there.shade[:] = (
                    joined.before,
                    joined.after,
                    joined.shade,
                )
        return patch_of(window, whole, outline_m)

    def _window(self, key: tuple[int, int]) -> PatchWindow:
        side_m = self._side_m
        return PatchWindow(
            key[0] * side_m, (key[1] + 1) * side_m, self._m_per_px, *(self._side_px,) * 2
        )

    def _around(self, low_m: PointsM, high_m: PointsM) -> Sequence[tuple[int, int]]:
        side_m = self._side_m
        first, last = np.floor(low_m / side_m), np.floor(high_m / side_m)
        return [
            key
            for key in sorted(self._squares)
            if first[0] <= key[0] <= last[0] and first[1] <= key[1] <= last[1]
        ]


def _squares_at(places: PointsM) -> list[tuple[int, int]]:
    """The squares, column and row, that hold any of these places, (N, 2) in sides of a square, column by column."""
    squares = np.floor(places).astype(int)
    first = squares.min(axis=0)
    columns, rows = (squares - first).T
    across = int(rows.max()) + 1
    found = np.divmod(
        np.unique(columns * across + rows), across
    )  # in a fraction of the time that pairs would take
    return [(int(column) + int(first[0]), int(row) + int(first[1])) for column, row in zip(*found)]


_ALL = 0.99  # of a cell must be seen for it to count


class GroundSums:
    """Sums by name, (rows, columns) float32 each, in cells of `cell_m`, and pictures of the ground that views show.

    `window_of`, `add` and `show` change it. `cell_m` is 0 before the first view.
    """

    def __init__(self, names: tuple[str, ...], most_cells: int) -> None:
        self.cell_m, self.window = 0.0, CellWindow(0, 0, 0, 0)
        self.sums: dict[str, Floats32] = {name: np.zeros((0, 0), np.float32) for name in names}
        self._most_cells = most_cells
        self._pictures = GroundPictures(1.0)
        self._times_ns: list[int] = []
        self._residuals_m: list[float] = []

    @property
    def is_empty(self) -> bool:
        """Whether no view was added."""
        return not self._times_ns

    @property
    def span_ns(self) -> tuple[int, int]:
        """Times of the first and of the last view."""
        return min(self._times_ns), max(self._times_ns)

    @property
    def residual_m(self) -> float:
        """How far views lay off the map in the mean, 0 where none states it."""
        return float(np.mean(self._residuals_m)) if self._residuals_m else 0.0

    def window_of(self, view: ComparedView, cell_m: float, picture_m: float) -> CellWindow | None:
        """The cells that a view shows, for which the raster has room now; None where it would be too large.

        The first view decides how wide cells, and pixels of the pictures, are: `cell_m` and `picture_m`.
        """
        if not self.cell_m:
            self.cell_m, self._pictures = cell_m, GroundPictures(picture_m)
        window = window_around(view.outline_m, self.cell_m)
        return window if self._make_room(window) else None

    def add(
        self,
        view: ComparedView,
        window: CellWindow,
        site_from_planes: Matrix3,
        planes: dict[str, Floats32],
        known: Floats32,
    ) -> dict[str, Floats32]:
        """Add a view's planes (h, w) by name where they are `known` (h, w, 1 or 0), and to `seen` how often each cell
        was; what was added, in the window's cells."""
        cell_from_planes = np.linalg.inv(window.site_from_cell(self.cell_m)) @ site_from_planes

        def laid(values: Floats32) -> Floats32:
            return np.asarray(
                cv2.warpPerspective(
                    values,
                    cell_from_planes,
                    window.shape[::-1],
                    flags=cv2.INTER_LINEAR,
                    borderMode=cv2.BORDER_CONSTANT,
                ),
                np.float32,
            )

        seen = (laid(known) > _ALL).astype(np.float32)
        added = {"seen": seen, **{name: laid(values) * seen for name, values in planes.items()}}
        part = window.within(self.window)
        for name, values in added.items():
            self.sums[name][part] += values
        self._times_ns.append(view.time_ns)
        if np.isfinite(view.residual_px):
            self._residuals_m.append(view.residual_px * view.m_per_px)
        return added

    def show(self, view: ComparedView, window: CellWindow, cells: Mask) -> None:
        """Keep the view's pictures of some of its cells, (rows, columns) of the window."""
        rows, columns = np.nonzero(cells)
        if len(rows):
            places = np.column_stack([columns, rows]).astype(float)
            self._pictures.show(view, apply_homography(window.site_from_cell(self.cell_m), places))

    def patch(self, outline_m: PointsM) -> Patch:
        """The pictures of an outline, (N, 2)."""
        return self._pictures.patch(outline_m)

    def _make_room(self, window: CellWindow) -> bool:
        """Make the raster hold a window; whether it does."""
        old = self.window
        new = window if 0 in old.shape else old.joined(window)
        if new == old:
            return True
        spare = max(new.shape) // 4
        new = CellWindow(
            *(
                min(new.x0, old.x0 - spare if new.x0 < old.x0 else new.x0),
                min(new.y0, old.y0 - spare if new.y0 < old.y0 else new.y0),
            ),
            *(
                max(new.x1, old.x1 + spare if new.x1 > old.x1 else new.x1),
                max(new.y1, old.y1 + spare if new.y1 > old.y1 else new.y1),
            ),
        )
        if new.shape[0] * new.shape[1] > self._most_cells:
            return False
        part = old.within(new)
        for name, values in self.sums.items():
            self.sums[name] = np.zeros(new.shape, np.float32)
            if values.size:
                self.sums[name][part] = values
        self.window = new
        return True
