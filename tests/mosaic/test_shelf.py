"""What lies on a shelf comes back as it was, whatever order it is asked for in."""

from collections.abc import Hashable

import numpy as np
import pytest

from sorvolo.mosaic.exposure import ColourPairs
from sorvolo.mosaic.planar import LinkedColours
from sorvolo.mosaic.shelf import ShelvedRows


class Drawer:
    def __init__(self) -> None:
        self.held: dict[Hashable, bytes] = {}
        self.asked = 0

    def put(self, key: Hashable, data: bytes) -> None:
        assert key not in self.held
        self.held[key] = bytes(data)

    def get(self, key: Hashable) -> bytes:
        self.asked += 1
        return self.held[key]


@pytest.mark.parametrize("drawer", [None, Drawer()])
def test_rows_come_back_in_any_order(drawer: Drawer | None) -> None:
    rows = ShelvedRows("numbers", (2, 3), float, drawer)
    expected = np.random.default_rng(1).normal(size=(6000, 2, 3))
    for row in expected:
        rows.append(row)
    assert len(rows) == 6000
    some = np.random.default_rng(2).permutation(6000)[:500]
    assert np.array_equal(rows.read(some), expected[some])
    assert np.array_equal(rows.read(np.arange(5990, 6000)), expected[5990:])
    assert rows.read(np.zeros(0, int)).shape == (0, 2, 3)


def test_the_newest_rows_are_read_without_the_shelf() -> None:
    drawer = Drawer()
    rows = ShelvedRows("numbers", (1,), np.int64, drawer)
    for number in range(10_000):
        rows.append(np.array([number]))
    assert (
        rows.read(np.arange(8_000, 10_000))[:, 0].tolist() == list(range(8_000, 10_000))
        and drawer.asked == 0
    )
    assert rows.read(np.arange(3))[:, 0].tolist() == [0, 1, 2] and drawer.asked == 1


def test_colours_of_a_link_are_those_last_kept() -> None:
    def pairs(count: int, value: float) -> ColourPairs:
        return ColourPairs(
            np.full((count, 3), value, np.float16),
            np.full((count, 3), value + 1, np.float16),
            np.full(count, 0.25, np.float16),
            np.full(count, 0.5, np.float16),
        )

    colours = LinkedColours(8, Drawer())
    for number in range(600):
        colours.keep((number + 1, number), pairs(5, number % 200))
    colours.keep((2, 1), pairs(3, 77.0))
    assert len(colours) == 600 and (2, 1) in colours and (1, 2) not in colours
    again, other = colours[2, 1], colours[300, 299]
    assert len(again) == 3 and np.all(again.colours_a == 77.0) and np.all(again.colours_b == 78.0)
    assert len(other) == 5 and np.all(other.colours_a == 99.0) and np.all(other.radius2_b == 0.5)
    assert set(colours.newest(2)) == {(600, 599), (599, 598)}
    with pytest.raises(KeyError):
        colours[7, 9]
