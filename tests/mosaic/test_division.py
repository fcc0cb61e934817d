"""Flights divided into blocks of ground: each picture once, with all around it that ties it to the others."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from sorvolo.mosaic.division import divide

WIDTH_M, HEIGHT_M = 30.0, 20.0


def outlines(centres_m: np.ndarray) -> list[np.ndarray]:
    corners = np.array([[-1, 1], [1, 1], [1, -1], [-1, -1]]) * [WIDTH_M / 2, HEIGHT_M / 2]
    return [centre + corners for centre in centres_m]


@given(st.integers(1, 120), st.integers(1, 9), st.integers(0, 1000))
def test_each_picture_has_one_home_and_its_earlier_neighbours_there(
    count: int, blocks: int, seed: int
) -> None:
    centres_m = np.random.default_rng(seed).uniform(0, 150, (count, 2))
    found = divide(outlines(centres_m), blocks)
    assert len(found) == min(count, blocks)
    assert sorted(each for block in found for each in block.home) == list(range(count))
    sizes = [len(block.home) for block in found]
    assert max(sizes) - min(sizes) <= max(2, len(found) // 2)
    apart_m = np.abs(centres_m[:, None] - centres_m[None])
    overlaps = (apart_m < [WIDTH_M, HEIGHT_M]).all(axis=2)
    for block in found:
        assert not block.home & block.margin
        for each in block.home:
            assert set(np.flatnonzero(overlaps[each, :each]).tolist()) <= block.home | block.margin
        for each in block.margin:
            assert any(each < home for home in block.home)


def test_blocks_of_a_long_strip_are_pieces_of_it_with_margins_of_a_picture() -> None:
    centres_m = np.column_stack([np.arange(40) * 10.0, np.zeros(40)])
    first, second = divide(outlines(centres_m), 2)
    assert first.home == set(range(20)) and not first.margin
    assert second.home == set(range(20, 40)) and second.margin == {17, 18, 19}


def test_a_picture_of_the_horizon_goes_with_the_one_before_it() -> None:
    found = outlines(np.column_stack([np.arange(10) * 100.0, np.zeros(10)]))
    found[7] = np.full((4, 2), np.nan)
    assert 7 in divide(found, 5)[3].home
    assert divide([np.full((4, 2), np.nan)] * 3, 2)[1].margin  # of unknown places, all earlier ones
