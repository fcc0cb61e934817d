"""A map's tiles at coarser and coarser steps, each made of four of the step before when it is first asked for."""

import hashlib
import threading
from collections import OrderedDict
from collections.abc import Callable, Mapping
from functools import cached_property
from typing import Generic, TypeVar

import cv2
import numpy as np

from sorvolo.geometry.arrays import ImageRGBA
from sorvolo.geometry.grid import TileIndex
from sorvolo.store.site.tiles import TileView

_MOST_LEVELS = 24


Key = TypeVar("Key")
Kept = TypeVar("Kept")


class BytesCache(Generic[Key, Kept]):
    """What was made last, up to a number of bytes; each thing is made once even if many ask at once."""

    def __init__(self, most_bytes: int, size_of: Callable[[Kept], int]) -> None:
        self._most_bytes, self._size_of = most_bytes, size_of
        self._kept: OrderedDict[Key, Kept] = OrderedDict()
        self._making: dict[Key, threading.Event] = {}
        self._bytes = 0
        self._lock = threading.Lock()

    def get(self, key: Key, make: Callable[[], Kept]) -> Kept:
        """What has this key, made now unless it is kept or being made; what `make` raises comes through."""
        while True:
            with self._lock:
                if key in self._kept:
                    self._kept.move_to_end(key)
                    return self._kept[key]
                made_elsewhere = self._making.get(key)
                if made_elsewhere is None:
                    self._making[key] = threading.Event()
                    break
            made_elsewhere.wait()
        try:
            made = make()
            with self._lock:
                self._kept[key] = made
                self._bytes += self._size_of(made)
                while self._bytes > self._most_bytes and len(self._kept) > 1:
                    self._bytes -= self._size_of(self._kept.popitem(last=False)[1])
        finally:
            with self._lock:
                self._making.pop(key).set()
        return made


class Pyramid:
    """The tiles of one state of a map at halved resolutions. Level 0 is the map's own.

    Pictures are known by the hashes of what they are made of: where the map did not change, one made for an earlier
    state is used again from `cache`. `coarse` may give tiles of levels above 0 without reading what they are made of.
    """

    def __init__(
        self, tiles: TileView, tile_px: int, cache: BytesCache[str, ImageRGBA],
        coarse: Callable[[int, TileIndex], ImageRGBA | None] = lambda _, __: None,
    ) -> None:
        self._tiles, self._cache, self._coarse, self.tile_px = tiles, cache, coarse, tile_px

    @cached_property
    def revision(self) -> str:
        """What names this state of the map: the same tiles, the same revision."""
        lines = sorted(f"{column},{row},{sha256}" for (column, row), sha256 in self._tiles.hashes.items())
        return hashlib.sha256("\n".join(lines).encode()).hexdigest()[:12]

    @cached_property
    def keys(self) -> list[Mapping[TileIndex, str]]:
        """For each level the tiles there are, and what names the content of each.

        The levels go on where one tile is left: a web tile of a whole country over a map of one tile would else be
        gathered at the map's own resolution, in gigabytes.
        """
        levels: list[Mapping[TileIndex, str]] = [dict(self._tiles.hashes)]
        while levels[-1] and len(levels) < _MOST_LEVELS:
            parts: dict[TileIndex, list[str]] = {}
            for (column, row), key in sorted(levels[-1].items()):
                parts.setdefault((column // 2, row // 2), []).append(f"{column % 2}{row % 2}{key}")
            levels.append({
                index: hashlib.sha256("".join(each).encode()).hexdigest() for index, each in parts.items()
            })
        return levels

    @cached_property
    def corner_tiles(self) -> list[TileIndex]:
        """The corners of the box around all tiles of level 0; none without tiles."""
        if not self._tiles.hashes:
            return []
        columns, rows = zip(*self._tiles.hashes)
        return [(min(columns), min(rows)), (max(columns), max(rows))]

    def changed_since(self, before: "Pyramid") -> list[TileIndex]:
        """The tiles that are others than in an earlier state, those that are gone included."""
        now, then = self._tiles.hashes, before._tiles.hashes
        return [index for index in now.keys() | then.keys() if now.get(index) != then.get(index)]

    def picture(self, level: int, index: TileIndex) -> ImageRGBA | None:
        """A tile, (tile_px, tile_px, 4), not to be written to; None where there is none.

        Raises StoreError where the version was dropped or is damaged.
        """
        key = self.keys[level].get(index)
        if key is None:
            return None
        if level == 0:
            return self._tiles[index]  # kept by the site's own cache
        return self._cache.get(key, lambda: self._halved(level, index))

    def _halved(self, level: int, index: TileIndex) -> ImageRGBA:
        given = self._coarse(level, index)
        if given is not None:
            return given
        half = self.tile_px // 2
        result = np.zeros((self.tile_px, self.tile_px, 4), np.uint8)
        for right in (0, 1):
            for down in (0, 1):
                part = self.picture(level - 1, (2 * index[0] + right, 2 * index[1] + down))
                if part is not None:
                    result[down * half:(down + 1) * half, right * half:(right + 1) * half] = _half(part)
        result.setflags(write=False)
        return result


def _half(rgba: ImageRGBA) -> ImageRGBA:
    """Half the size; colours are averaged where the map is, so that its edges do not darken."""
    alpha = rgba[..., 3]
    small_alpha = cv2.resize(alpha, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    if alpha.min() == 255:
        colours = cv2.resize(rgba[..., :3], None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    else:
        weighted = rgba[..., :3] * (alpha[..., None] / np.float32(255))
        sums = cv2.resize(weighted, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        colours = sums / np.maximum(small_alpha[..., None] / np.float32(255), 1e-3)
        colours = np.clip(np.round(colours), 0, 255).astype(np.uint8)
    return np.dstack([colours, small_alpha])
