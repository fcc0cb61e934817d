"""Arrays that are written over with every pair of pictures: asking the system for memory costs more than the sums."""

import threading

import numpy as np
from numpy.typing import NDArray

MOST_KEPT_PX = 1 << 20  # of a picture: what is larger is given back


class Scratch:
    """Arrays by name, for one size of pictures at a time. Only `take` and `stack` change it.

    An array lasts until its name is asked for again. So whoever makes a `Scratch` owns what is in it: a result that
    outlives the comparison must hold arrays of its own, or come from a `Scratch` that nobody uses again.
    """

    def __init__(self) -> None:
        self._size: tuple[int, int] = (0, 0)
        self._kept: dict[tuple[str, tuple[int, ...]], NDArray[np.uint8]] = {}

    def take(
        self, name: str, size: tuple[int, int], bands: tuple[int, ...] = (), margin_px: int = 0
    ) -> NDArray[np.uint8]:
        """The uint8 array `name` for pictures of `size` (h, w), grown by a margin; with `bands` (h, w, ...)."""
        return self._taken(name, size, (size[0] + 2 * margin_px, size[1] + 2 * margin_px, *bands))

    def stack(self, name: str, size: tuple[int, int], planes: int) -> NDArray[np.uint8]:
        """The uint8 array `name` of shape (planes, h, w), holding anything."""
        return self._taken(name, size, (planes, *size))

    def _taken(self, name: str, size: tuple[int, int], shape: tuple[int, ...]) -> NDArray[np.uint8]:
        if size[0] * size[1] > MOST_KEPT_PX:
            return np.empty(shape, np.uint8)
        if size != self._size:
            self._kept.clear()
            self._size = size
        key = name, shape
        if key not in self._kept:
            self._kept[key] = np.empty(shape, np.uint8)
        return self._kept[key]


class _OfThread(threading.local):
    def __init__(self) -> None:
        self.scratch = Scratch()


_OF_THREAD = _OfThread()


def scratch_of_thread() -> Scratch:
    """The one `Scratch` of this thread, for a function that returns nothing out of it."""
    return _OF_THREAD.scratch
