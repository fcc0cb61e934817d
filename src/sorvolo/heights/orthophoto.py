"""The true orthophoto: each piece of ground seen by a photo that nothing hides it from, on its own height."""

from collections.abc import Callable, Iterator, Sequence

import cv2
import numpy as np

from sorvolo.geometry.arrays import Floats32, ImageRGB, ImageRGBA, Mask, Matrix3
from sorvolo.geometry.grid import SiteGrid, TileIndex
from sorvolo.geometry.ground import hidden, laid_pixels
from sorvolo.geometry.homography import shifted
from sorvolo.heights.lattice import Lattice
from sorvolo.heights.views import View, ground_outlines_m
from sorvolo.mosaic.blending import (
    ALIGN_PX,
    LAYER_APRON_PX,
    Layer,
    Winners,
    blend,
    pixels_of,
    winners_from_shares,
)

_HIDDEN_CELLS = 3.0  # a height this much above the line of sight, in cells, hides what is behind
_HIDDEN_MERIT = 0.02  # of a photo that does not see the ground, against one that does
_BLOCK_TILES = 2  # painted together, to a side: what is painted around them is a smaller share


def paint_orthophoto(
    lattice: Lattice,
    up_m: Floats32,
    site_grid: SiteGrid,
    views: Sequence[View],
    pictures: Callable[[int], ImageRGB],
) -> Iterator[tuple[TileIndex, ImageRGBA, float]]:
    """The tiles of the true orthophoto, block by block, each with the share that is done; those unseen are left out.

    `up_m` (H, W) are heights without holes; `pictures(i)` is view i's picture without distortion, its exposure
    corrected.
    """
    painter = _Painter(
        lattice,
        up_m,
        choose_photos(lattice, up_m, views),
        site_grid,
        views,
        pictures,
    )
    count, side = _BLOCK_TILES, site_grid.grid.tile_px
    # to and fro: blocks that follow each other show the same few photos
    blocks = sorted(
        {(row // count, column // count) for column, row in painter.tiles()},
        key=lambda block: (block[0], -block[1] if block[0] % 2 else block[1]),
    )
    for number, (down, across) in enumerate(blocks, start=1):
        first = across * count, down * count
        rgba = painter.block(first, count)
        if rgba is None:
            continue
        for y, x in np.ndindex(count, count):
            tile = np.ascontiguousarray(rgba[y * side : (y + 1) * side, x * side : (x + 1) * side])
            if tile[..., 3].any():
                yield (first[0] + x, first[1] + y), tile, number / len(blocks)


def choose_photos(lattice: Lattice, up_m: Floats32, views: Sequence[View]) -> Winners:
    """(H, W) which view shows each cell of a height model without holes best; -1 where none does."""
    labels = np.full(lattice.shape, -1, np.int16)
    best = np.zeros(lattice.shape, np.float32)
    for number, view in enumerate(views):
        # the cells that a view may see, and the way from them to below the camera: x0, y0,
        # x1, y1, ends exclusive
        low_m, high_m = float(up_m.min()), float(up_m.max())
        corners = np.concatenate(
            [
                ground_outlines_m([view], each)
                for each in (low_m, high_m)
                if each < view.site_from_camera.translation_m[2]
            ]
            + [view.site_from_camera.translation_m[None, :2]]
        )
        cells = lattice.cells_from_site(corners)
        x0, y0 = np.clip(
            np.floor(cells.min(axis=0)).astype(int) - 1, 0, [lattice.width, lattice.height]
        ).tolist()
        x1, y1 = np.clip(
            np.ceil(cells.max(axis=0)).astype(int) + 2, 0, [lattice.width, lattice.height]
        ).tolist()
        if x1 <= x0 or y1 <= y0:
            continue
        here = slice(y0, y1), slice(x0, x1)
        window = lattice.window(x0, y0, x1, y1)
        heights: Floats32 = np.ascontiguousarray(up_m[here])
        seen = cv2.medianBlur(visible(window, heights, view).view(np.uint8), 5) > 0
        # (H, W) how well a view shows each cell, 0 (not at all) to 1: from above, and not at the
        # picture's border.
        u, v = laid_pixels(view.camera, view.site_from_camera, window.site_from_cells, heights)
        across = (u - (view.camera.width_px - 1) / 2) / (view.camera.width_px / 2)
        down = (v - (view.camera.height_px - 1) / 2) / (view.camera.height_px / 2)
        eye = window.cells_from_site(view.site_from_camera.translation_m[None, :2])[0]
        column, row = np.meshgrid(np.arange(window.width), np.arange(window.height))
        far_m = window.cell_m * np.hypot(column - eye[0], row - eye[1])
        depth_m = np.maximum(view.site_from_camera.translation_m[2] - heights, 0.1)
        steep = depth_m / np.hypot(depth_m, far_m)
        border = np.clip(1 - across**2, 0, 1) * np.clip(1 - down**2, 0, 1)
        inside = (np.abs(across) < 1) & (np.abs(down) < 1)
        merit = np.where(inside, 0.05 + 0.95 * steep**4 * np.sqrt(border), 0.0) * np.where(
            seen, 1.0, _HIDDEN_MERIT
        )
        wins = merit > best[here]
        labels[here][wins] = number
        best[here][wins] = merit[wins]
    return labels


def visible(lattice: Lattice, up_m: Floats32, view: View) -> Mask:
    """(H, W) which cells of a height model without holes nothing of it hides from a view."""
    eye_m = view.site_from_camera.translation_m
    at = lattice.cells_from_site(eye_m[None, :2])[0]
    column, row = np.meshgrid(
        np.arange(lattice.width, dtype=np.float32), np.arange(lattice.height, dtype=np.float32)
    )
    eye = np.append(at, eye_m[2])
    return ~hidden(up_m, column, row, up_m, eye, _HIDDEN_CELLS * lattice.cell_m)


class _Painter:
    """What all tiles share: the heights without holes, and which photo shows each cell."""

    def __init__(
        self,
        lattice: Lattice,
        ground: Floats32,
        labels: Winners,
        site_grid: SiteGrid,
        views: Sequence[View],
        pictures: Callable[[int], ImageRGB],
    ) -> None:
        self._ground, self._labels, self._views = ground, labels, views
        self._pictures, self._grid = pictures, site_grid.grid
        right, bottom = lattice.width - 1, lattice.height - 1
        corners = lattice.site_from_cells @ np.array(
            [[0, right, right, 0], [0, 0, bottom, bottom], [1, 1, 1, 1]]
        )
        middle = corners[:2].mean(axis=1)
        reach_m = float(np.abs(corners[:2].T - middle).max())
        site_from_grid = np.linalg.inv(site_grid.grid_from_site_affine(middle, reach_m))
        self._site_from_grid: Matrix3 = np.asarray(site_from_grid, np.float64)
        self._cells_from_grid: Matrix3 = np.linalg.inv(lattice.site_from_cells) @ site_from_grid
        self._outline = (np.linalg.inv(site_from_grid) @ corners)[:2].T

    def tiles(self) -> frozenset[TileIndex]:
        """The tiles over the height model."""
        return self._grid.tiles_touched(self._outline)

    def block(self, first: TileIndex, count: int) -> ImageRGBA | None:
        """(count tile_px, count tile_px, 4) the picture of `count` x `count` tiles; None where no photo sees them."""
        apron = -(-LAYER_APRON_PX // ALIGN_PX) * ALIGN_PX
        side = count * self._grid.tile_px + 2 * apron
        shift = shifted(
            first[0] * self._grid.tile_px - apron, first[1] * self._grid.tile_px - apron
        )
        # (side, side) the view of each pixel of a tile, the borders between views drawn
        # straight between cells
        cells_from_here = self._cells_from_grid @ shift
        ends = cells_from_here @ np.array([[0, side, 0, side], [0, 0, side, side], [1, 1, 1, 1]])
        limit = np.array(self._labels.shape[::-1])
        low = np.clip(np.floor(ends[:2].min(axis=1)).astype(int) - 2, 0, limit)
        high = np.clip(np.ceil(ends[:2].max(axis=1)).astype(int) + 3, 0, limit)
        coarse = self._labels[low[1] : high[1], low[0] : high[0]]
        there = (shifted(-low[0], -low[1]) @ cells_from_here)[:2]
        labels = winners_from_shares(
            (
                (
                    number,
                    0,
                    0,
                    np.asarray(
                        cv2.warpAffine(
                            pixels_of(coarse, number),
                            there,
                            (side, side),
                            flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
                        ),
                        np.uint8,
                    ),
                )
                for number in np.unique(coarse[coarse >= 0]).tolist()
            ),
            side,
            side,
        )
        inner = slice(apron, side - apron)
        if (labels[inner, inner] < 0).all():
            return None
        picture = blend(labels, self._layers(labels, shift, side))[inner, inner]
        alpha = (labels[inner, inner] >= 0).view(np.uint8) * np.uint8(255)
        rgba = np.dstack([picture, alpha])
        rgba[alpha == 0] = 0
        return rgba

    def _layers(self, labels: Winners, shift: Matrix3, side: int) -> Iterator[Layer]:
        up_m = np.asarray(
            cv2.warpAffine(
                self._ground,
                (self._cells_from_grid @ shift)[:2],
                (side, side),
                flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
                borderMode=cv2.BORDER_REPLICATE,
            ),
            np.float32,
        )
        for number in np.unique(labels[labels >= 0]).tolist():
            left, top, width, height = cv2.boundingRect(pixels_of(labels, number))
            x0, y0 = (max(0, each - LAYER_APRON_PX) // ALIGN_PX * ALIGN_PX for each in (left, top))
            x1, y1 = (
                min(side, -(-(each + LAYER_APRON_PX) // ALIGN_PX) * ALIGN_PX)
                for each in (left + width, top + height)
            )
            view = self._views[number]
            u, v = laid_pixels(
                view.camera,
                view.site_from_camera,
                self._site_from_grid @ shift @ shifted(x0, y0),
                up_m[y0:y1, x0:x1],
            )
            seen = cv2.remap(
                self._pictures(number), u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT_101
            )
            yield Layer(number, x0, y0, np.asarray(seen, np.uint8))
