"""How much a map deviates from the frames it was made of: the thesis's 4.1.1, over a flight."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from sorvolo.geometry.arrays import Floats, ImageRGB, ImageRGBA, Mask, Matrix3
from sorvolo.geometry.grid import SiteGrid, TileIndex
from sorvolo.geometry.homography import apply_homography
from sorvolo.lab.evaluation.map_quality import DEVIATION_BINS, Deviation, deviation
from sorvolo.mosaic.canvas_frame import CanvasFrame, coverage, warp

_UNSEEN = 236  # a light grey
_RECENT = 64  # tiles remembered: neighbouring frames share most


@dataclass(frozen=True, eq=False)
class DeviationSummary:
    """The thesis's deviation over frames: mean, median and worst share, and the mean histogram."""

    mean: float
    median: float
    worst: float
    histogram: Floats
    frames: int


@dataclass(frozen=True, eq=False)
class DeviationPictures:
    """A part of the map, the frame that it was made of, and how they differ, (H, W, 3) each; grey where unknown."""

    mosaic: ImageRGB
    frame: ImageRGB
    difference: ImageRGB


class MapDeviation:
    """Compares frames with the map one after another; remembers the map's last tiles."""

    def __init__(self, tiles: Mapping[TileIndex, ImageRGBA], site_grid: SiteGrid) -> None:
        self._tiles, self._site_grid = tiles, site_grid
        self._recent: dict[TileIndex, ImageRGBA] = {}

    def of(self, image: ImageRGB, site_from_image: Matrix3) -> Deviation:
        """The deviation of one undistorted frame, (H, W, 3), from the map under it."""
        return deviation(*self._both(image, site_from_image))

    def shown(self, image: ImageRGB, site_from_image: Matrix3) -> DeviationPictures:
        """The pictures of the thesis's Figure 4.1 of one undistorted frame."""
        mosaic, frame, mask = self._both(image, site_from_image)
        mosaic[~mask], frame[~mask] = _UNSEEN, _UNSEEN
        difference = np.abs(mosaic.astype(np.int16) - frame).astype(np.uint8)
        difference[~mask] = _UNSEEN
        return DeviationPictures(mosaic, frame, difference)

    def under(self, outline_m: Floats, width_px: int, height_px: int) -> ImageRGB:
        """(height, width, 3) the map as a frame sees it whose corners lie at `outline_m`, (4, 2) in the site frame.

        The corners are those of the top left pixel, the top right, the bottom right and the bottom left.
        """
        grid_from_site = self._site_grid.grid_from_site_affine(np.mean(outline_m, axis=0), 100.0)
        corners = apply_homography(grid_from_site, np.asarray(outline_m, np.float64))
        low, high = np.floor(corners.min(axis=0)), np.ceil(corners.max(axis=0)) + 1
        window = int(low[0]), int(low[1]), int(high[0]), int(high[1])
        ends = np.array(
            [[0, 0], [width_px - 1, 0], [width_px - 1, height_px - 1], [0, height_px - 1]],
            np.float32,
        )
        frame_from_window = cv2.getPerspectiveTransform((corners - low).astype(np.float32), ends)
        found = cv2.warpPerspective(
            self._crop(window, self._site_grid.grid.tile_px),
            frame_from_window,
            (width_px, height_px),
        )
        found[found[..., 3] == 0] = _UNSEEN
        return np.ascontiguousarray(found[..., :3])

    def _both(self, image: ImageRGB, site_from_image: Matrix3) -> tuple[ImageRGB, ImageRGB, Mask]:
        """The map and the frame in one window of the grid, and where both are known."""
        height, width = image.shape[:2]
        x, y, z = site_from_image @ np.array([width / 2, height / 2, 1.0])
        grid_from_site = self._site_grid.grid_from_site_affine(np.array([x / z, y / z]), 100.0)
        frame = CanvasFrame(0, 0, width, height, grid_from_site @ site_from_image)
        low, high = (
            np.floor(frame.outline_px.min(axis=0)),
            np.ceil(frame.outline_px.max(axis=0)) + 1,
        )
        window = int(low[0]), int(low[1]), int(high[0]), int(high[1])
        mosaic = self._crop(window, self._site_grid.grid.tile_px)
        mask = (coverage(frame, window) > 0) & (mosaic[..., 3] > 0)
        return np.ascontiguousarray(mosaic[..., :3]), warp(image, frame, window), mask

    def _crop(self, window: tuple[int, int, int, int], side: int) -> ImageRGBA:
        """(height, width, 4) the map in a window of grid pixels (x0, y0, x1, y1, ends exclusive)."""
        x0, y0, x1, y1 = window
        result = np.zeros((y1 - y0, x1 - x0, 4), np.uint8)
        for row in range(y0 // side, (y1 - 1) // side + 1):
            for column in range(x0 // side, (x1 - 1) // side + 1):
                if (column, row) not in self._tiles:
                    continue
                left, top = max(x0, column * side), max(y0, row * side)
                right, bottom = min(x1, (column + 1) * side), min(y1, (row + 1) * side)
                tile = self._tile((column, row))
                result[top - y0 : bottom - y0, left - x0 : right - x0] = tile[
                    top - row * side : bottom - row * side,
                    left - column * side : right - column * side,
                ]
        return result

    def _tile(self, index: TileIndex) -> ImageRGBA:
        tile = self._recent.pop(index, None)
        if tile is None:
            tile = self._tiles[index]
            if len(self._recent) >= _RECENT:
                del self._recent[next(iter(self._recent))]
        self._recent[index] = tile
        return tile


def frames_to_compare(count: int, most: int) -> list[int]:
    """At most this many of a flight's frames, by number, evenly chosen."""
    return (
        list(range(count))
        if count <= most
        else np.linspace(0, count - 1, most).astype(int).tolist()
    )


def summed_up(deviations: Sequence[Deviation]) -> DeviationSummary:
    """The deviations of frames together; those that show none of the map are left out."""
    found = [each for each in deviations if each.count]
    if not found:
        nan = float("nan")
        return DeviationSummary(nan, nan, nan, np.zeros(DEVIATION_BINS), 0)
    shares = np.array([each.share for each in found])
    return DeviationSummary(
        float(shares.mean()),
        float(np.median(shares)),
        float(shares.max()),
        np.mean([each.histogram for each in found], axis=0),
        len(found),
    )
