"""Tiles in a folder of their own while a map is made of them, read one at a time."""

from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from sorvolo.geometry.arrays import ImageRGBA
from sorvolo.geometry.grid import TileIndex
from sorvolo.store.atomic import writing


class TileFolder(Mapping[TileIndex, ImageRGBA]):
    """A mapping whose pictures are files without compression; only `save` changes it. The folder is the caller's."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._known: set[TileIndex] = set()

    def save(self, index: TileIndex, rgba: ImageRGBA) -> None:
        """Keep a tile; raises StoreError on a full disk."""
        path = self._path(index)
        with writing(path):
            np.save(path, rgba)
        self._known.add(index)

    def __getitem__(self, index: TileIndex) -> ImageRGBA:
        if index not in self._known:
            raise KeyError(index)
        return np.asarray(np.load(self._path(index)), np.uint8)

    def __iter__(self) -> Iterator[TileIndex]:
        return iter(self._known)

    def __len__(self) -> int:
        return len(self._known)

    def _path(self, index: TileIndex) -> Path:
        return self._folder / f"{index[0]}_{index[1]}.npy"
