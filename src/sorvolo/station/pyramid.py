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

_MOST_LEVELS = 24  # halvings; a map of a million tiles a side needs 20


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


class TilePyramid:
    """The tiles of one state of a map at halved resolutions. Level 0 is the map's own.

    Pictures are known by the hashes of what they are made of: where the map did not change, one made for an earlier
    state is used again from `cache`. `coarse`, where given, may have tiles of levels above 0 without reading what they
    are made of.
    """

    def __init__(
        self,
        tiles: TileView,
        tile_px: int,
        cache: BytesCache[str, ImageRGBA],
        coarse: Callable[[int, TileIndex], ImageRGBA | None] | None = None,
    ) -> None:
        self._tiles, self._cache, self._coarse, self.tile_px = tiles, cache, coarse, tile_px

    @cached_property
    def revision(self) -> str:
        """What names this state of the map: the same tiles, the same revision."""
        lines = sorted(
            f"{column},{row},{sha256}" for (column, row), sha256 in self._tiles.hashes.items()
        )
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
            levels.append(
                {
                    index: hashlib.sha256("".join(each).encode()).hexdigest()
                    for index, each in parts.items()
                }
            )
        return levels

    @cached_property
    def corner_tiles(self) -> list[TileIndex]:
        """The corners of the box around all tiles of level 0; none without tiles."""
        if not self._tiles.hashes:
            return []
        columns, rows = zip(*self._tiles.hashes)
        return [(min(columns), min(rows)), (max(columns), max(rows))]

    def changed_since(self, before: "TilePyramid") -> list[TileIndex]:
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

    def pieces(self, level: int) -> tuple[int, Mapping[TileIndex, str]]:
        """How large the pieces of a level are that `piece` gives, px, and what names each.

        Above level 0 a piece is a quarter of a tile: what one tile of the level below becomes. Where a map grows under
        a view, only the tiles under that view have to be read.
        """
        return (
            (self.tile_px, self.keys[0])
            if level == 0
            else (self.tile_px // 2, self.keys[level - 1])
        )

    def piece(self, level: int, index: TileIndex) -> ImageRGBA | None:
        """A piece of a level; None where there is none. Raises as `picture` does."""
        if level == 0:
            return self.picture(0, index)
        if self._coarse is None:
            return self._half_of(level - 1, index)
        whole, half = self.picture(level, (index[0] // 2, index[1] // 2)), self.tile_px // 2
        if whole is None:
            return None
        left, top = half * (index[0] % 2), half * (index[1] % 2)
        return whole[top : top + half, left : left + half]

    def _half_of(self, level: int, index: TileIndex) -> ImageRGBA | None:
        """A tile made smaller, (tile_px / 2, tile_px / 2, 4); None where there is none."""
        key = self.keys[level].get(index)
        if key is None:
            return None

        def made() -> ImageRGBA:
            part = self.picture(level, index)
            assert part is not None  # its key is there
            return halved(part)

        return self._cache.get(f"half {key}", made)

    def _halved(self, level: int, index: TileIndex) -> ImageRGBA:
        given = None if self._coarse is None else self._coarse(level, index)
        if given is not None:
            return given
        half = self.tile_px // 2
        result = np.zeros((self.tile_px, self.tile_px, 4), np.uint8)
        for right in (0, 1):
            for down in (0, 1):
                part = self._half_of(level - 1, (2 * index[0] + right, 2 * index[1] + down))
                if part is not None:
                    result[down * half : (down + 1) * half, right * half : (right + 1) * half] = (
                        part
                    )
        result.setflags(write=False)
        return result


def halved(rgba: ImageRGBA) -> ImageRGBA:
    """A picture of even sides at half its size, not to be written to.

    Colours are averaged by their alpha, so that the map's edges do not darken. That takes time and is only needed where
    the alphas of four pixels differ.
    """
    small = np.asarray(
        cv2.resize(rgba, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA), np.uint8
    )
    fours = [rgba[down::2, right::2] for down in (0, 1) for right in (0, 1)]
    alphas = [each[..., 3] for each in fours]
    lowest, highest = np.minimum.reduce(alphas), np.maximum.reduce(alphas)
    at = np.nonzero(lowest != highest)
    if len(at[0]):
        mixed = np.stack([each[at] for each in fours]).astype(np.float32)
        share = mixed[..., 3:]
        colours = (mixed[..., :3] * share).sum(axis=0) / share.sum(
            axis=0
        )  # one alpha at least is above 0
        small[at] = np.round(np.column_stack([colours, share.mean(axis=0)])).astype(np.uint8)
    small.setflags(write=False)
    return small
