"""The colours that linked keyframes share, of a whole flight, whose older ones lie on a shelf."""

from collections.abc import Iterator, Mapping
from itertools import islice

import numpy as np

from sorvolo.mosaic.exposure import ColourPairs
from sorvolo.mosaic.shelf import Shelf, ShelvedRows


class LinkedColours(Mapping[tuple[int, int], ColourPairs]):
    """Colour pairs by link (frame a, frame b), `points_per_link` at most; `keep` adds those of a link."""

    def __init__(self, points_per_link: int, shelf: Shelf | None = None) -> None:
        self._most = points_per_link
        self._places: dict[tuple[int, int], tuple[int, int]] = {}  # row, and pairs in it
        self._rows = ShelvedRows("colours", (points_per_link, 8), np.float16, shelf)

    def __len__(self) -> int:
        return len(self._places)

    def __iter__(self) -> Iterator[tuple[int, int]]:
        return iter(self._places)

    def __getitem__(self, link: tuple[int, int]) -> ColourPairs:
        row, count = self._places[link]
        found = self._rows.read(np.array([row]))[0, :count]
        return ColourPairs(found[:, :3], found[:, 3:6], found[:, 6], found[:, 7])

    def keep(self, link: tuple[int, int], pairs: ColourPairs) -> None:
        """Take the pairs of a link in, in place of earlier ones of it."""
        kept = pairs.thinned(self._most)
        row = np.zeros((self._most, 8), np.float16)
        row[: len(kept)] = np.column_stack(
            [kept.colours_a, kept.colours_b, kept.radius2_a, kept.radius2_b]
        )
        self._places[link] = len(self._rows), len(kept)
        self._rows.append(row)

    def newest(self, count: int) -> dict[tuple[int, int], ColourPairs]:
        """Those of the newest links."""
        return {link: self[link] for link in islice(reversed(self._places), count)}
