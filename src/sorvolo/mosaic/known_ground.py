"""The ground that a map showed before a flight was painted into it: which pixels, and how new ones are fitted to it."""

from collections.abc import Mapping

import cv2
import numpy as np

from sorvolo.geometry.arrays import Bytes, ImageRGB, ImageRGBA, Mask, shrunk
from sorvolo.geometry.grid import Grid, TileIndex

SETTLING_PX = 64
"""How far beyond a window its known ground must be seen for `settled` not to depend on where the window ends."""

_SHRINK = 4  # times smaller: light is smooth
_RIM_PX = 3.0  # known pixels so deep within the rim show the step at it
_REACH_PX = 48  # over which new ground comes back to its own light
_LARGEST_STEP = 24  # gray levels: more is no light but another thing


class KnownGround:
    """Which pixels of `tiles` were opaque when first asked for, and which of those must stay as they are.

    Ask for a tile's pixels before changing the tile; only `release` changes the answers. Masks are kept as bits.
    """

    def __init__(self, grid: Grid, tiles: Mapping[TileIndex, ImageRGBA]) -> None:
        self._grid, self._tiles = grid, tiles
        self._opaque: dict[TileIndex, Bytes | None] = {}
        self._lasting: dict[TileIndex, Bytes] = {}  # where it is not all that is opaque

    def opaque(self, x0: int, y0: int, x1: int, y1: int) -> Mask:
        """(y1 - y0, x1 - x0) what the map showed within a window of grid pixels, ends exclusive."""
        return self._gather((x0, y0, x1, y1), lasting=False)

    def lasting(self, x0: int, y0: int, x1: int, y1: int) -> Mask:
        """(y1 - y0, x1 - x0) what of that must stay as it is."""
        return self._gather((x0, y0, x1, y1), lasting=True)

    def release(self, x0: int, y0: int, ground: Mask) -> None:
        """Let the pixels of `ground`, (height, width) from the grid pixel (x0, y0) on, be painted anew."""
        window = x0, y0, x0 + ground.shape[1], y0 + ground.shape[0]
        for index in self._tiles_of(window):
            bits = self._bits(index, lasting=True)
            if bits is None:
                continue
            mask = self._unpacked(bits)
            here, there = self._meeting(index, window)
            mask[here] &= ~ground[there]
            self._lasting[index] = np.packbits(mask)

    def _gather(self, window: tuple[int, int, int, int], *, lasting: bool) -> Mask:
        result = np.zeros((window[3] - window[1], window[2] - window[0]), bool)
        for index in self._tiles_of(window):
            bits = self._bits(index, lasting=lasting)
            if bits is not None:
                here, there = self._meeting(index, window)
                result[there] = self._unpacked(bits)[here]
        return result

    def _bits(self, index: TileIndex, *, lasting: bool) -> Bytes | None:
        if index not in self._opaque:
            tile = self._tiles.get(index)
            self._opaque[index] = None if tile is None else np.packbits(tile[..., 3] == 255)
        return self._lasting.get(index, self._opaque[index]) if lasting else self._opaque[index]

    def _unpacked(self, bits: Bytes) -> Mask:
        side = self._grid.tile_px
        return np.unpackbits(bits, count=side * side).reshape(side, side).view(bool)

    def _tiles_of(self, window: tuple[int, int, int, int]) -> list[TileIndex]:
        side = self._grid.tile_px
        columns = range(window[0] // side, (window[2] - 1) // side + 1)
        rows = range(window[1] // side, (window[3] - 1) // side + 1)
        return [(column, row) for row in rows for column in columns]

    def _meeting(
        self, index: TileIndex, window: tuple[int, int, int, int]
    ) -> tuple[tuple[slice, slice], tuple[slice, slice]]:
        """Where a tile and a window meet: in the tile and in the window, rows and columns."""
        tile = self._grid.tile_window(index)
        x0, y0 = max(tile[0], window[0]), max(tile[1], window[1])
        x1, y1 = min(tile[2], window[2]), min(tile[3], window[3])
        return (
            (slice(y0 - tile[1], y1 - tile[1]), slice(x0 - tile[0], x1 - tile[0])),
            (slice(y0 - window[1], y1 - window[1]), slice(x0 - window[0], x1 - window[0])),
        )


def settled(picture: ImageRGB, stored: ImageRGB, lasting: Mask) -> ImageRGB:
    """A picture, (H, W, 3), whose light at the rim of lasting ground is brought to that of the stored picture.

    Blending would have met new ground half-way; here the known side does not move, so the new side goes all the way
    and comes back to its own light within some 40 px. H and W are multiples of 4.
    """
    if lasting.all() or not lasting.any():
        return picture
    height, width = lasting.shape
    small = (width // _SHRINK, height // _SHRINK)
    inwards_px = cv2.distanceTransform(lasting.view(np.uint8), cv2.DIST_L2, 3)
    outwards_px = cv2.distanceTransform((~lasting).view(np.uint8), cv2.DIST_L2, 3)
    rim = np.exp(inwards_px / -_RIM_PX) * lasting
    step = (
        np.clip(cv2.subtract(stored, picture, dtype=cv2.CV_16S), -_LARGEST_STEP, _LARGEST_STEP)
        * rim[..., None]
    )
    side = 2 * (_REACH_PX // _SHRINK) + 1
    steps, shares = (
        cv2.GaussianBlur(
            shrunk(each, small),
            (side, side),
            _REACH_PX / 3 / _SHRINK,
        )
        for each in (step.astype(np.float32), rim.astype(np.float32))
    )
    at_rim = steps / np.maximum(shares, 1e-6)[..., None]
    kept = np.clip(1 - outwards_px / _REACH_PX, 0, 1) ** 2
    fitted = (
        picture
        + cv2.resize(at_rim, (width, height), interpolation=cv2.INTER_LINEAR) * kept[..., None]
    )
    result = np.clip(fitted + 0.5, 0, 255).astype(np.uint8)
    result[lasting] = picture[lasting]
    return result
