"""What a long flight has no room for in memory lies on a shelf; rows of which only the newest are wanted mostly."""

from collections import OrderedDict
from collections.abc import Hashable
from typing import Any, Protocol

import numpy as np
from numpy.typing import DTypeLike, NDArray

from sorvolo.geometry.arrays import Rows

_AT_ONCE = 256  # rows that go to the shelf together
_NEAR = 16  # times as many stay in memory as well: the newest, and what their neighbours of other strips have


class Shelf(Protocol):
    """Where bytes are kept that memory has no room for, by key; each is written once."""

    def put(self, key: Hashable, data: bytes) -> None:
        """Keep these bytes."""

    def get(self, key: Hashable) -> bytes:
        """The bytes kept under this key."""


class ShelvedRows:
    """Arrays of one `shape`, appended one after the other and never changed; without a shelf all stay in memory."""

    def __init__(
        self, name: str, shape: tuple[int, ...], dtype: DTypeLike, shelf: Shelf | None
    ) -> None:
        self._name, self._shape, self._dtype, self._shelf = name, shape, np.dtype(dtype), shelf
        self._count = 0
        self._newest = self._empty()
        self._full: OrderedDict[int, NDArray[Any]] = OrderedDict()

    def __len__(self) -> int:
        return self._count

    def append(self, row: NDArray[Any]) -> None:
        """One more."""
        self._newest[self._count % _AT_ONCE] = row
        self._count += 1
        if self._count % _AT_ONCE:
            return
        number = self._count // _AT_ONCE - 1
        if self._shelf is not None:
            self._shelf.put((self._name, number), self._newest.tobytes())
        self._near(number, self._newest)
        self._newest = self._empty()

    def read(self, at: Rows) -> NDArray[Any]:
        """(n, ...) those that came as the `at`-th, (n,)."""
        found = np.empty((len(at), *self._shape), self._dtype)
        piece, place = np.divmod(at, _AT_ONCE)
        for number in np.unique(piece).tolist():
            these = piece == number
            found[these] = self._piece(number)[place[these]]
        return found

    # ---- inside -----------------------------------------------------------------------------------------------

    def _empty(self) -> NDArray[Any]:
        return np.empty((_AT_ONCE, *self._shape), self._dtype)

    def _piece(self, number: int) -> NDArray[Any]:
        if number == self._count // _AT_ONCE:
            return self._newest
        found = self._full.get(number)
        if found is None:
            assert self._shelf is not None
            found = np.frombuffer(self._shelf.get((self._name, number)), self._dtype).reshape(
                _AT_ONCE, *self._shape
            )
        self._near(number, found)
        return found

    def _near(self, number: int, piece: NDArray[Any]) -> None:
        """Into memory; the one used longest ago makes room."""
        self._full[number] = piece
        self._full.move_to_end(number)
        if self._shelf is not None and len(self._full) > _NEAR:
            self._full.popitem(last=False)
