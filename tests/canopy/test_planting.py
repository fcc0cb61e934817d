"""Bodies planted below crowns: the gaps that views show are those that hide them."""

import numpy as np
import pytest

from sorvolo.canopy.planting import gaps


@pytest.mark.parametrize("free_share", [0.0, 0.2, 0.5])
def test_the_share_of_views_that_show_the_floor_is_measured(free_share: float) -> None:
    draw = np.random.default_rng(4)
    floor = draw.normal(90, 6, (30, 30))
    shows = draw.uniform(size=(60, 30, 30)) < free_share
    laid = np.where(
        shows, floor + draw.normal(0, 2, shows.shape), draw.normal(105, 14, shows.shape)
    )
    levels, chance, share = gaps(laid.astype(np.float32), 0.1)
    assert abs(chance.mean() - free_share) < 0.08
    assert np.abs(share - free_share).max() < 0.12
    if free_share >= 0.2:
        assert chance[shows].mean() > 2 * chance[~shows].mean()
        assert np.median(np.abs(levels - floor)) < 2.0


def test_what_a_picture_does_not_show_hides_nothing_and_shows_nothing() -> None:
    laid = np.full((30, 5, 5), 90, np.float32)
    laid[::3] = np.nan
    levels, chance, share = gaps(laid, 0.1)
    assert np.allclose(levels, 90)
    assert not chance[::3].any() and (chance[1::3] > 0.9).all() and (share > 0.9).all()
