"""The canvas: which frame shows each piece of ground, and the tiles painted from them.

Every pixel is a function of the frames over it alone, not of the order in which they came. The ground is
divided into cells of 8 x 8 grid pixels; each cell remembers the frame that shows it best. A new or moved
frame changes the winners of some cells, and only the ground around those is rendered again, from the original
images.
"""

from collections import OrderedDict
from collections.abc import Callable, Iterable, Iterator, MutableMapping
from concurrent.futures import ThreadPoolExecutor, wait
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from sorvolo.geometry.arrays import Bytes, ImageRGB, ImageRGBA, Mask, PointsPx, square
from sorvolo.geometry.grid import Grid, SiteGrid, TileIndex
from sorvolo.mosaic.blending import (
    ALIGN_PX,
    LAYER_APRON_PX,
    WINDOW_APRON_PX,
    Layer,
    Winners,
    blend,
    coarse_fill,
    pixels_of,
    winners_from_shares,
)
from sorvolo.mosaic.canvas_frame import CELL_PX, CanvasFrame, cell_merits, coverage, warp
from sorvolo.mosaic.known_ground import SETTLING_PX, KnownGround, settled

_CHUNK_CELLS = 64  # a side: cells are looked up in blocks, so that an endless map needs no array
_NOBODY = -1  # in place of a frame's number
_FILLINGS = 32  # kept: each has a 64th of its picture's pixels
_MOVED_PX = 0.5  # a smaller move of all corners cannot be seen
_GAIN_STEP = 0.01  # a smaller change of gain is below one gray level in the mid-tones
_WINDOW_PX = 1024  # longest side of a piece rendered at once: bounds the memory
# A changed winner is felt as far as the bands spread (62 px) and its outline is smoothed (2 cells) around it.
_REACH_CELLS = 10


class _Chunk:
    """The winners of 64 x 64 cells: the frame that shows each cell best, and how well."""

    def __init__(self) -> None:
        self.winner = np.full((_CHUNK_CELLS, _CHUNK_CELLS), _NOBODY, np.int64)
        self.merit = np.full((_CHUNK_CELLS, _CHUNK_CELLS), -np.inf)
        self.frames: set[int] = set()


class Canvas:
    """The mosaic while it grows. Only `paint` changes it.

    `tiles` is where the picture is kept; `images(id)` gives the undistorted image of a frame and should
    remember the last few. `painted` are the frames whose picture is in `tiles` already, for a site that is
    opened again. With `keeps_known_ground` every pixel that `tiles` shows now stays byte for byte, whoever painted
    it, but for the ground of a painted frame that is moved or forgotten. Frames painted earlier contribute only
    pixels already in `tiles`.
    """

    def __init__(
        self,
        grid: Grid,
        tiles: MutableMapping[TileIndex, ImageRGBA],
        images: Callable[[int], ImageRGB],
        painted: Iterable[CanvasFrame] = (),
        *,
        keeps_known_ground: bool = False,
    ) -> None:
        self._grid, self._tiles, self._images = grid, tiles, images
        self._frames: dict[int, CanvasFrame] = {}
        self._chunks: dict[TileIndex, _Chunk] = {}
        self._known = KnownGround(grid, tiles) if keeps_known_ground else None
        self._painted_before: set[int] = set()
        self._fillings: dict[int, ImageRGB] = {}
        self._warping = ThreadPoolExecutor(1, thread_name_prefix="warping")
        # chunks where painted frames win what the map showed, no more
        self._bounded: set[TileIndex] = set()
        for frame in painted:
            self._add(frame)
            self._painted_before.add(frame.id)

    def paint(
        self, frames: Iterable[CanvasFrame], forget: Iterable[int] = ()
    ) -> frozenset[TileIndex]:
        """Put new or moved frames in place, drop those to forget, and return the tiles whose picture changed.

        Known frames that moved by no more than half a pixel at every corner, with the same gains, are left as
        they are. A tile that nothing covers any more is deleted.
        """
        changed = {frame.id: frame for frame in frames if self._differs(frame)}
        gone = {each for each in forget if each in self._frames} | (
            changed.keys() & self._frames.keys()
        )
        # the chunks under changed and gone frames, where they lie now and where they will
        # lie
        touched: set[TileIndex] = set()
        for each in [*gone, *changed]:
            touched |= self._chunks_of(changed[each] if each in changed else self._frames[each])
            if each in self._frames:
                touched |= self._chunks_of(self._frames[each])
        if self._known is not None:
            for key in touched:
                self._bound(key, self._known)
                self._release(key, gone & self._painted_before, self._known)
            self._painted_before -= gone
        before = {key: self._chunks[key].winner.copy() for key in touched if key in self._chunks}
        emptied: set[TileIndex] = set()
        for each in gone:
            emptied |= self._chunks_of(self._frames.pop(each))
        for key in emptied:
            staying = self._chunks.pop(key).frames - gone
            for each in sorted(staying):
                self._enter(self._frames[each], key)
        for frame in changed.values():
            self._add(frame)
        dirty = self._dirty_cells(touched, before, gone | changed.keys())
        return self._render_around(dirty)

    def covers(self, outline_px: PointsPx) -> float:
        """The share, 0-1, of an outline on the grid, shape (N, 2), that is painted; right to about a cell of
        8 px.
        """
        cells = (np.asarray(outline_px, dtype=np.float64) + 0.5) / CELL_PX - 0.5
        low = np.floor(cells.min(axis=0)).astype(int)
        width, height = (np.ceil(cells.max(axis=0)).astype(int) - low + 1).tolist()
        inside = np.zeros((height, width), np.uint8)
        cv2.fillPoly(inside, [np.rint(cells - low).astype(np.int32)], (1,))
        winners = self._winners(int(low[0]), int(low[1]), width, height)
        return float((winners[inside == 1] != _NOBODY).mean())

    def _differs(self, frame: CanvasFrame) -> bool:
        known = self._frames.get(frame.id)
        if known is None or known.rank != frame.rank:
            return True
        if (known.width_px, known.height_px) != (frame.width_px, frame.height_px):
            return True
        moved_px = np.abs(frame.outline_px - known.outline_px).max()
        brighter = np.abs(
            np.log(np.maximum(frame.gains, 1e-6) / np.maximum(known.gains, 1e-6))
        ).max()
        shaded = np.abs(frame.vignette - known.vignette).max()
        return bool(moved_px > _MOVED_PX or max(brighter, shaded) > _GAIN_STEP)

    @staticmethod
    def _chunks_of(frame: CanvasFrame) -> frozenset[TileIndex]:
        return Grid((0.0, 0.0), 1.0, CELL_PX * _CHUNK_CELLS).tiles_touched(frame.outline_px)

    def _add(self, frame: CanvasFrame) -> None:
        self._frames[frame.id] = frame
        for key in self._chunks_of(frame):
            self._enter(frame, key)

    def _enter(self, frame: CanvasFrame, key: TileIndex) -> None:
        chunk = self._chunks.setdefault(key, _Chunk())
        chunk.frames.add(frame.id)
        merit = cell_merits(
            frame, key[0] * _CHUNK_CELLS, key[1] * _CHUNK_CELLS, _CHUNK_CELLS, _CHUNK_CELLS
        )
        wins = (merit > chunk.merit) | ((merit == chunk.merit) & (frame.id < chunk.winner))
        wins &= np.isfinite(merit)
        if self._known is not None and key in self._bounded and frame.id in self._painted_before:
            wins &= _shown_cells(self._known, key)
        chunk.winner[wins] = frame.id
        chunk.merit[wins] = merit[wins]

    def _bound(self, key: TileIndex, known: KnownGround) -> None:
        """Take from painted frames the cells in which the map showed nothing: seen for the first time in this chunk."""
        if key in self._bounded:
            return
        self._bounded.add(key)
        if key in self._chunks:
            empty = ~_shown_cells(known, key)
            self._chunks[key].winner[empty] = _NOBODY
            self._chunks[key].merit[empty] = -np.inf

    def _release(self, key: TileIndex, ids: set[int], known: KnownGround) -> None:
        """Let ground that these frames showed be painted anew, with the cell around it into which seams may swing."""
        if not ids:
            return
        column, row = key[0] * _CHUNK_CELLS, key[1] * _CHUNK_CELLS
        theirs = np.isin(
            self._winners(column - 1, row - 1, _CHUNK_CELLS + 2, _CHUNK_CELLS + 2), list(ids)
        )
        if theirs.any():
            cells = cv2.dilate(theirs.astype(np.uint8), square(3))[1:-1, 1:-1] > 0
            ground = np.repeat(np.repeat(cells, CELL_PX, axis=0), CELL_PX, axis=1)
            known.release(column * CELL_PX, row * CELL_PX, ground)

    def _dirty_cells(
        self, touched: set[TileIndex], before: dict[TileIndex, NDArray[np.int64]], changed: set[int]
    ) -> dict[TileIndex, Mask]:
        """Per chunk, the cells whose winner is another, or the same one at another place."""
        nobody = _Chunk().winner
        dirty = {}
        for key in touched:
            old = before.get(key, nobody)
            new = self._chunks[key].winner if key in self._chunks else nobody
            cells = (old != new) | np.isin(old, list(changed)) | np.isin(new, list(changed))
            if cells.any():
                dirty[key] = cells
        return dirty

    def _render_around(self, dirty: dict[TileIndex, Mask]) -> frozenset[TileIndex]:
        touched: set[TileIndex] = set()
        for x0, y0, x1, y1 in self._windows(dirty):
            touched |= self._store(x0, y0, self._render(x0, y0, x1, y1))
        return frozenset(touched)

    def _windows(self, dirty: dict[TileIndex, Mask]) -> Iterator[tuple[int, int, int, int]]:
        """Aligned windows of grid pixels, ends exclusive, that hold everything a change of those cells is
        seen in.
        """
        if not dirty:
            return
        low = np.array(sorted(dirty)).min(axis=0) * _CHUNK_CELLS - _REACH_CELLS
        high = (np.array(sorted(dirty)).max(axis=0) + 1) * _CHUNK_CELLS + _REACH_CELLS
        cells = np.zeros((high - low)[::-1], np.uint8)
        for (column, row), mask in dirty.items():
            x, y = column * _CHUNK_CELLS - low[0], row * _CHUNK_CELLS - low[1]
            cells[y : y + _CHUNK_CELLS, x : x + _CHUNK_CELLS] = mask
        cells = cv2.dilate(cells, square(2 * _REACH_CELLS + 1))
        left, top, width, height = cv2.boundingRect(cells)
        xs = self._cuts(int(low[0]) + left, width) - low[0]
        ys = self._cuts(int(low[1]) + top, height) - low[1]
        rows, columns = list(pairwise(ys.tolist())), list(pairwise(xs.tolist()))
        for column, row in _neighbours_first(len(columns), len(rows)):
            (x0, x1), (y0, y1) = columns[column], rows[row]
            x, y, w, h = cv2.boundingRect(cells[y0:y1, x0:x1])
            if w and h:
                first = low + np.array([x0 + x, y0 + y])
                begin = first * CELL_PX // ALIGN_PX * ALIGN_PX
                end = -(-(first + np.array([w, h])) * CELL_PX // ALIGN_PX) * ALIGN_PX
                yield int(begin[0]), int(begin[1]), int(end[0]), int(end[1])

    def _cuts(self, first: int, count: int) -> NDArray[np.int64]:
        """Where `count` cells from the `first` on are cut into windows.

        What is too large for one is cut at borders of tiles: then each tile is painted, and stored, once.
        """
        tile_px, most_px = self._grid.tile_px, _WINDOW_PX
        if count * CELL_PX <= most_px:
            return np.array([first, first + count])
        whole_px = most_px // tile_px * tile_px if tile_px % ALIGN_PX == 0 else 0
        step = (whole_px or most_px) // CELL_PX
        return np.array(
            [first, *range((first // step + 1) * step, first + count, step), first + count]
        )

    def _render(self, x0: int, y0: int, x1: int, y1: int) -> ImageRGBA:
        """The picture of an aligned window of grid pixels, ends exclusive."""
        apron = WINDOW_APRON_PX
        if self._known is not None:
            wide = apron + SETTLING_PX
            if self._known.lasting(x0 - wide, y0 - wide, x1 + wide, y1 + wide).any():
                apron = wide
        x, y = x0 - apron, y0 - apron
        width, height = x1 - x0 + 2 * apron, y1 - y0 + 2 * apron
        pad = 2
        columns, rows = width // CELL_PX + 2 * pad, height // CELL_PX + 2 * pad
        winners = self._winners(x // CELL_PX - pad, y // CELL_PX - pad, columns, rows)
        ids = [int(each) for each in np.unique(winners) if each != _NOBODY]
        shown = None if self._known is None else self._known.opaque(x, y, x + width, y + height)

        def share_of(each: int) -> tuple[int, int, Bytes]:
            left, top, share = _share(winners == each, self._frames[each], x, y, pad)
            if shown is not None and each in self._painted_before:
                share = share * shown[top : top + share.shape[0], left : left + share.shape[1]]
            return left, top, share

        labels = winners_from_shares(
            ((number, *share_of(each)) for number, each in enumerate(ids)), height, width
        )
        picture = blend(labels, self._one_ahead(self._layers(ids, labels, x, y)))
        if self._known is not None and apron > WINDOW_APRON_PX:
            lasting = self._known.lasting(x, y, x + width, y + height) & (labels >= 0)
            # The picture that the tiles hold in a window, black where they hold none.
            side = self._grid.tile_px
            result = np.zeros((height, width, 3), np.uint8)
            for row in range(y // side, (y + height - 1) // side + 1):
                for column in range(x // side, (x + width - 1) // side + 1):
                    tile = self._tiles.get((column, row))
                    if tile is not None:
                        _paste(result, tile[..., :3], column * side - x, row * side - y)
            picture = settled(picture, result, lasting)
        inner = slice(apron, -apron)
        alpha = (labels[inner, inner] >= 0).view(np.uint8) * np.uint8(255)
        rgba = cv2.merge([*cv2.split(picture[inner, inner]), alpha])
        return cv2.copyTo(rgba, alpha)  # type: ignore[return-value]

    def _one_ahead(self, layers: Iterator[Layer]) -> Iterator[Layer]:
        """The layers, each read and warped while the one before it is blended."""
        coming = self._warping.submit(next, layers, None)
        try:
            while (layer := coming.result()) is not None:
                coming = self._warping.submit(next, layers, None)
                yield layer
        finally:  # nobody else reads pictures meanwhile
            wait([coming])

    def _layers(self, ids: list[int], labels: Winners, x: int, y: int) -> Iterator[Layer]:
        for number, each in enumerate(ids):
            left, top, width, height = cv2.boundingRect(pixels_of(labels, number))
            if not width:
                continue
            x0 = max(0, left - LAYER_APRON_PX) // ALIGN_PX * ALIGN_PX
            y0 = max(0, top - LAYER_APRON_PX) // ALIGN_PX * ALIGN_PX
            x1 = min(labels.shape[1], -(-(left + width + LAYER_APRON_PX) // ALIGN_PX) * ALIGN_PX)
            y1 = min(labels.shape[0], -(-(top + height + LAYER_APRON_PX) // ALIGN_PX) * ALIGN_PX)
            frame = self._frames[each]
            image = self._images(each)
            window = (x + x0, y + y0, x + x1, y + y1)
            yield Layer(number, x0, y0, warp(image, frame, window, self._beyond(frame, image)))

    def _beyond(self, frame: CanvasFrame, image: ImageRGB) -> ImageRGB | None:
        """What `warp` wants of an image with invalid pixels, remembered for those used last."""
        if frame.valid is None:
            return None
        found = self._fillings.pop(frame.id, None)
        if found is None:
            found = coarse_fill(image, frame.valid)
            while len(self._fillings) >= _FILLINGS:
                self._fillings.pop(next(iter(self._fillings)))
        self._fillings[frame.id] = found
        return found

    def _winners(self, column: int, row: int, width: int, height: int) -> NDArray[np.int64]:
        """(height, width) winners of a block of cells."""
        result = np.full((height, width), _NOBODY, np.int64)
        for chunk_row in range(row // _CHUNK_CELLS, (row + height - 1) // _CHUNK_CELLS + 1):
            for chunk_column in range(
                column // _CHUNK_CELLS, (column + width - 1) // _CHUNK_CELLS + 1
            ):
                chunk = self._chunks.get((chunk_column, chunk_row))
                if chunk is None:
                    continue
                x, y = chunk_column * _CHUNK_CELLS - column, chunk_row * _CHUNK_CELLS - row
                _paste(result, chunk.winner, x, y)
        return result

    def _store(self, x: int, y: int, rgba: ImageRGBA) -> set[TileIndex]:
        """Put a rendered window into its tiles and name those that it changed."""
        side = self._grid.tile_px
        changed: set[TileIndex] = set()
        for row in range(y // side, (y + rgba.shape[0] - 1) // side + 1):
            for column in range(x // side, (x + rgba.shape[1] - 1) // side + 1):
                if self._store_in((column, row), x, y, rgba):
                    changed.add((column, row))
        return changed

    def _store_in(self, index: TileIndex, x: int, y: int, rgba: ImageRGBA) -> bool:
        """Put what of a rendered window falls into a tile there, but for lasting ground; whether that changed it."""
        side = self._grid.tile_px
        lasting = (
            None if self._known is None else self._known.lasting(*self._grid.tile_window(index))
        )
        known = self._tiles.get(index)
        tile = np.zeros((side, side, 4), np.uint8) if known is None else known.copy()
        _paste(tile, rgba, x - index[0] * side, y - index[1] * side)
        if lasting is not None and known is not None:
            tile[lasting] = known[lasting]
        shows_ground = bool(tile[..., 3].any())
        is_unchanged = not shows_ground if known is None else np.array_equal(tile, known)
        if is_unchanged:
            return False
        if shows_ground:
            self._tiles[index] = tile
        else:
            del self._tiles[index]
        return True


def _neighbours_first(across: int, down: int) -> list[tuple[int, int]]:
    """Columns and rows so that those near each other follow each other (Z-order): they show the same few frames."""

    def along_z(place: tuple[int, int]) -> int:
        return sum(
            (place[0] >> bit & 1) << 2 * bit | (place[1] >> bit & 1) << 2 * bit + 1
            for bit in range(24)
        )

    return sorted(((column, row) for row in range(down) for column in range(across)), key=along_z)


def _share(wins: Mask, frame: CanvasFrame, x: int, y: int, pad: int) -> tuple[int, int, Bytes]:
    """Where in a window (its origin x, y on the grid) a frame may show, and how strongly, from the cells it
    wins.

    `wins` holds the window's cells and `pad` more on each side. Smoothing makes the seams curves, not stairs.
    """
    height, width = ((side - 2 * pad) * CELL_PX for side in wins.shape)
    left, top, columns, rows = cv2.boundingRect(wins.astype(np.uint8))
    c0, c1 = max(0, left - 2), min(wins.shape[1], left + columns + 2)
    r0, r1 = max(0, top - 2), min(wins.shape[0], top + rows + 2)
    cells = cv2.GaussianBlur(wins[r0:r1, c0:c1].astype(np.uint8) * 255, (3, 3), 0)
    share = np.asarray(
        cv2.resize(cells, None, fx=CELL_PX, fy=CELL_PX, interpolation=cv2.INTER_LINEAR), np.uint8
    )
    # the padding cells were needed for smoothing only
    x0, y0 = (c0 - pad) * CELL_PX, (r0 - pad) * CELL_PX
    cut_x, cut_y = max(0, -x0), max(0, -y0)
    x0, y0 = x0 + cut_x, y0 + cut_y
    share = share[cut_y : cut_y + height - y0, cut_x : cut_x + width - x0]
    window = x + x0, y + y0, x + x0 + share.shape[1], y + y0 + share.shape[0]
    return x0, y0, share & coverage(frame, window)


def _shown_cells(known: KnownGround, key: TileIndex) -> Mask:
    """(64, 64) the cells of a chunk in which the map showed any pixel."""
    side = _CHUNK_CELLS * CELL_PX
    shown = known.opaque(key[0] * side, key[1] * side, (key[0] + 1) * side, (key[1] + 1) * side)
    blocks: Mask = shown.reshape(_CHUNK_CELLS, CELL_PX, _CHUNK_CELLS, CELL_PX).any(axis=(1, 3))  # type: ignore[assignment]
    return blocks


def _paste(target: NDArray[np.generic], patch: NDArray[np.generic], x: int, y: int) -> None:
    """Copy what of the patch falls into the target when its top-left lies at (x, y)."""
    x0, y0 = max(0, x), max(0, y)
    x1, y1 = min(target.shape[1], x + patch.shape[1]), min(target.shape[0], y + patch.shape[0])
    if x0 < x1 and y0 < y1:
        target[y0:y1, x0:x1] = patch[y0 - y : y1 - y, x0 - x : x1 - x]


_ENOUGH_PX = 400  # of a picture's longer side, to follow a flight by


def coarseness(longest_px: int) -> int:
    """By how much (1, 2, 4 or 8) pictures of this longer side are made smaller for a map that still moves."""
    return next((step for step in (8, 4, 2) if longest_px // step >= _ENOUGH_PX), 1)


def coarse_grid(site_grid: SiteGrid, step: int) -> SiteGrid:
    """The grid whose pixels are `step` of the site's to a side, with tiles on the same ground."""
    grid = site_grid.grid
    beside_m = (step - 1) / 2 * grid.m_per_px  # the centre of the first pixel lies so far into it
    origin_m = grid.origin_m[0] + beside_m, grid.origin_m[1] - beside_m
    return SiteGrid(
        site_grid.frame, Grid(origin_m, grid.m_per_px * step, grid.tile_px // step, grid.crs)
    )


class CoarseTiles(MutableMapping[TileIndex, ImageRGBA]):
    """Tiles of a `coarse_grid` over those of the site; `save` shows there, enlarged, what was put in.

    Every pixel that a tile of the site showed when it was first asked for stays as it is. Up to `most_bytes` stay in
    memory as they are here, so that a tile painted again and again is enlarged once for all that `save` is called.
    """

    def __init__(
        self,
        tiles: MutableMapping[TileIndex, ImageRGBA],
        grid: Grid,
        step: int,
        most_bytes: int = 16 << 20,
    ) -> None:
        self._tiles, self._grid, self._step = tiles, grid, step
        self._known = KnownGround(grid, tiles)
        self._near: OrderedDict[TileIndex, ImageRGBA] = OrderedDict()
        self._unsaved: set[TileIndex] = set()
        self._most = max(1, most_bytes // (4 * (grid.tile_px // step) ** 2))

    def __getitem__(self, index: TileIndex) -> ImageRGBA:
        if index not in self._near:
            self._opaque(index)
            self._keep(
                index, np.ascontiguousarray(self._tiles[index][:: self._step, :: self._step])
            )
        self._near.move_to_end(index)
        return self._near[index]

    def __setitem__(self, index: TileIndex, coarse: ImageRGBA) -> None:
        self._unsaved.add(index)
        self._keep(index, coarse)

    def __delitem__(self, index: TileIndex) -> None:
        if self._near.pop(index, None) is None or index in self._tiles:
            del self._tiles[index]
        self._unsaved.discard(index)

    def __contains__(self, index: object) -> bool:
        return index in self._near or index in self._tiles

    def __iter__(self) -> Iterator[TileIndex]:
        return iter(self._near.keys() | set(self._tiles))

    def __len__(self) -> int:
        return len(self._near.keys() | set(self._tiles))

    def save(self) -> None:
        """Put into the site's tiles what changed since the last call."""
        for index in sorted(self._unsaved):
            self._save(index)

    def release(self) -> None:
        """Forget what is in memory."""
        self._near.clear()
        self._unsaved.clear()

    def _keep(self, index: TileIndex, coarse: ImageRGBA) -> None:
        self._near[index] = coarse
        self._near.move_to_end(index)
        while len(self._near) > self._most:
            oldest = next(iter(self._near))
            if oldest in self._unsaved:
                self._save(oldest)
            del self._near[oldest]

    def _save(self, index: TileIndex) -> None:
        known = self._opaque(index)
        tile = self._near[index].repeat(self._step, axis=0).repeat(self._step, axis=1)
        if known.any():
            tile[known] = self._tiles[index][known]
        self._tiles[index] = tile
        self._unsaved.discard(index)

    def _opaque(self, index: TileIndex) -> Mask:
        """What the site's tile showed before it was first changed."""
        return self._known.opaque(*self._grid.tile_window(index))
