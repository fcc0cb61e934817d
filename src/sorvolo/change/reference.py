"""The known map as a later flight reads it: any view of it, and its features, made once."""

from collections import OrderedDict
from collections.abc import Mapping
from functools import cached_property

import cv2
import numpy as np

from sorvolo.geometry.arrays import (
    ImageGray,
    ImageRGB,
    ImageRGBA,
    Mask,
    Matrix3,
    PointsPx,
    shrunk,
    square,
)
from sorvolo.geometry.grid import Grid, TileIndex, gather_tiles
from sorvolo.geometry.homography import apply_homography, resized, shifted
from sorvolo.registration.features import (
    FeatureSettings,
    gray_from_rgb,
    normalise_contrast,
    orb_features,
)
from sorvolo.survey.mosaic import Features

_BLOCK_PX = 512  # features are found in blocks of this side
_APRON_PX = 40  # what contrast and descriptors look at beyond a block
_LEVEL_TILES, _LEVEL_STEP_PX = 20, 16  # by which the map's middle grey is known
_CACHE_BYTES = 192 * 2**20  # of tiles at hand
_STEP_PX = (
    32  # of the map: pictures are made of whole squares of this side, a multiple of any `shrink`
)
_MOST_PX = 48_000_000  # of the map in one view: more is a view towards the horizon
_FEATURES = FeatureSettings(detection_side_px=_BLOCK_PX + 2 * _APRON_PX, orb_count=1100)
_NOTHING = Features("orb", np.zeros((0, 2)), np.zeros((0, 32), np.uint8))


class ReferenceMap:
    """A version of the map, read a tile at a time; remembers the last tiles and all features.

    `tiles` is any mapping from tile to RGBA; level n of the map has pixels of 2^n grid pixels.
    """

    def __init__(self, tiles: Mapping[TileIndex, ImageRGBA], grid: Grid) -> None:
        self._tiles, self._grid = tiles, grid
        self._cache: OrderedDict[tuple[int, TileIndex], ImageRGBA | None] = OrderedDict()
        self._cache_tiles = max(8, _CACHE_BYTES // (4 * grid.tile_px**2))
        self._features: dict[tuple[int, TileIndex], Features] = {}

    def seen_from(
        self, grid_from_image: Matrix3, width_px: int, height_px: int, shrink: int = 1
    ) -> tuple[ImageRGB, Mask]:
        """The map resampled to an image's pixels, and where it is known; nothing is known of views to the horizon.

        With `shrink` n the result is an n-th as wide and high, made of the tiles that the whole image needs: whoever
        asks for both pays for no coarse ones.
        """
        size = max(1, width_px // shrink), max(1, height_px // shrink)
        nothing = np.zeros((size[1], size[0], 3), np.uint8), np.zeros((size[1], size[0]), bool)
        outline = outline_on_grid(grid_from_image, width_px, height_px)
        if outline is None:
            return nothing
        level = level_for(grid_from_image, width_px, height_px)
        level_from_image = _level_from_grid(level) @ grid_from_image
        outline = apply_homography(_level_from_grid(level), outline)
        low = (np.floor(outline.min(axis=0)).astype(int) - 2) // _STEP_PX * _STEP_PX
        high = -(-(np.ceil(outline.max(axis=0)).astype(int) + 3) // _STEP_PX) * _STEP_PX
        if np.prod((high - low).astype(float)) > _MOST_PX:
            return nothing
        x, y = (int(each) for each in low)
        window = self._assembled(level, x, y, *(int(each) for each in high - low))
        window_from_image = shifted(-x, -y) @ level_from_image
        if shrink > 1:
            small = window.shape[1] // shrink, window.shape[0] // shrink
            window = shrunk(window, small)
            image_from_small = resized(width_px / size[0], height_px / size[1])
            window_from_image = (
                resized(1 / shrink, 1 / shrink) @ window_from_image @ image_from_small
            )
        seen = cv2.warpPerspective(
            window, window_from_image, size, flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        )
        return cv2.cvtColor(seen, cv2.COLOR_RGBA2RGB), cv2.extractChannel(seen, 3) == 255  # type: ignore[return-value]

    def features_under(
        self, grid_from_image: Matrix3, width_px: int, height_px: int, margin: float
    ) -> Features:
        """ORB features of the map under an image and `margin` of its size around it, `points_px` on the grid."""
        outline = outline_on_grid(grid_from_image, width_px, height_px)
        if outline is None:
            return _NOTHING
        level = level_for(grid_from_image, width_px, height_px)
        centre = outline.mean(axis=0)
        outline = apply_homography(
            _level_from_grid(level), centre + (outline - centre) * (1 + 2 * margin)
        )
        blocks = Grid((0.0, 0.0), 1.0, _BLOCK_PX).tiles_touched(outline)
        if len(blocks) > 400:
            return _NOTHING
        return _joined([self._block(level, each) for each in sorted(blocks)])

    def all_features(self, level: int, most: int) -> Features:
        """The features of the whole map at a level, or of nothing when they are more than `most`."""
        side = self._grid.tile_px << level
        blocks: set[TileIndex] = set()
        per_block = _BLOCK_PX << level
        for column, row in {
            (c * self._grid.tile_px // side, r * self._grid.tile_px // side) for c, r in self._tiles
        }:
            first = column * side // per_block, row * side // per_block
            last = ((column + 1) * side - 1) // per_block, ((row + 1) * side - 1) // per_block
            blocks |= {
                (c, r) for c in range(first[0], last[0] + 1) for r in range(first[1], last[1] + 1)
            }
        if len(blocks) * _FEATURES.orb_count > most:
            return _NOTHING
        return _joined([self._block(level, each) for each in sorted(blocks)])

    def brightness_of(self, image: ImageRGB) -> float:
        """How many times as bright as the map a picture is, by the middle grey of either."""
        return float(np.median(image[::_LEVEL_STEP_PX, ::_LEVEL_STEP_PX])) / max(
            self._middle_grey, 1.0
        )

    # ---- inside -----------------------------------------------------------------------------------------------

    @cached_property
    def _middle_grey(self) -> float:
        """By a few of the map's tiles."""
        every = -(-len(self._tiles) // _LEVEL_TILES)
        some = [
            self._tiles[index][::_LEVEL_STEP_PX, ::_LEVEL_STEP_PX]
            for index in sorted(self._tiles)[::every]
        ]
        levels = np.concatenate([tile[tile[..., 3] > 0][:, :3].ravel() for tile in some])
        return float(np.median(levels)) if len(levels) else 0.0

    def _assembled(self, level: int, x: int, y: int, width: int, height: int) -> ImageRGBA:
        window = x, y, x + width, y + height
        return gather_tiles(window, self._grid.tile_px, lambda index: self._tile(level, index))

    def _tile(self, level: int, index: TileIndex) -> ImageRGBA | None:
        key = level, index
        if key not in self._cache:
            self._cache[key] = self._made(level, index)
            while len(self._cache) > self._cache_tiles:
                self._cache.popitem(last=False)
        self._cache.move_to_end(key)
        return self._cache[key]

    def _made(self, level: int, index: TileIndex) -> ImageRGBA | None:
        if level == 0:
            return self._tiles.get(index)
        side = self._grid.tile_px
        children = {
            (dx, dy): self._tile(level - 1, (2 * index[0] + dx, 2 * index[1] + dy))
            for dx in (0, 1)
            for dy in (0, 1)
        }
        if all(each is None for each in children.values()):
            return None
        large = np.zeros((2 * side, 2 * side, 4), np.uint8)
        for (dx, dy), child in children.items():
            if child is not None:
                large[dy * side : (dy + 1) * side, dx * side : (dx + 1) * side] = child
        small = shrunk(large, (side, side))
        small[small[..., 3] < 255] = 0  # half-known pixels are darkened by the unknown half
        return small

    def _block(self, level: int, index: TileIndex) -> Features:
        if (level, index) not in self._features:
            self._features[level, index] = self._found(level, index)
        return self._features[level, index]

    def _found(self, level: int, index: TileIndex) -> Features:
        x, y = index[0] * _BLOCK_PX - _APRON_PX, index[1] * _BLOCK_PX - _APRON_PX
        side = _BLOCK_PX + 2 * _APRON_PX
        rgba = self._assembled(level, x, y, side, side)
        known = rgba[..., 3] == 255
        if not known.any():
            return _NOTHING
        found = orb_features(normalised(cv2.cvtColor(rgba, cv2.COLOR_RGBA2RGB), known), _FEATURES)  # type: ignore[arg-type]
        near = np.rint(found.points_px).astype(int).clip(0, side - 1)
        inner = (
            (found.points_px >= _APRON_PX - 0.5) & (found.points_px < side - _APRON_PX - 0.5)
        ).all(axis=1)
        safe = cv2.erode(known.view(np.uint8), square(31))  # no corners of the map's rim
        keep = inner & (safe[near[:, 1], near[:, 0]] > 0)
        grid_px = apply_homography(
            np.linalg.inv(_level_from_grid(level)), found.points_px[keep] + [x, y]
        )
        return Features(found.kind, grid_px, found.descriptors[keep])


def normalised(rgb: ImageRGB, known: Mask) -> ImageGray:
    """Contrast-normalised gray of a picture with holes; the holes are even gray and throw no edges."""
    gray = gray_from_rgb(rgb)
    if known.all():
        return normalise_contrast(gray)
    gray = gray.copy()
    gray[~known] = np.uint8(gray[known].mean()) if known.any() else 128
    result = normalise_contrast(gray)
    result[~known] = 128
    return result


def outline_on_grid(grid_from_image: Matrix3, width_px: int, height_px: int) -> PointsPx | None:
    """(4, 2) the image's corners on the grid; None where one lies at or beyond the horizon."""
    w, h = width_px - 0.5, height_px - 0.5
    outline = apply_homography(
        grid_from_image, np.array([[-0.5, -0.5], [w, -0.5], [w, h], [-0.5, h]])
    )
    return outline if np.isfinite(outline).all() and np.abs(outline).max() < 1e9 else None


def level_for(grid_from_image: Matrix3, width_px: int, height_px: int) -> int:
    """The level of the map whose pixels are about as large on the ground as the image's, at its centre."""
    centre = np.array([(width_px - 1) / 2, (height_px - 1) / 2, 1.0])
    x, y, z = grid_from_image @ centre
    linear = grid_from_image[:2, :2] / z - np.outer([x, y], grid_from_image[2, :2]) / z**2
    return int(np.clip(np.rint(0.5 * np.log2(max(abs(np.linalg.det(linear)), 1e-12))), 0, 8))


def _level_from_grid(level: int) -> Matrix3:
    return resized(0.5**level, 0.5**level)


def _joined(parts: list[Features]) -> Features:
    parts = [each for each in parts if len(each)]
    if not parts:
        return _NOTHING
    return Features(
        parts[0].kind,
        np.concatenate([each.points_px for each in parts]),
        np.concatenate([each.descriptors for each in parts]),
    )
