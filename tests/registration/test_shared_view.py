"""How much two pictures share, against windows cut from one ground."""

import cv2
import numpy as np
import pytest

from sorvolo.registration.place_search import shared_view


@pytest.fixture(scope="module")
def ground() -> np.ndarray:
    rng = np.random.default_rng(5)
    coarse = rng.integers(0, 255, (60, 160, 3), np.uint8)
    return cv2.resize(coarse, (1600, 600), interpolation=cv2.INTER_CUBIC)


@pytest.mark.parametrize("shift_px", [0, 100, 300])
def test_a_shifted_window_shares_what_is_left(ground: np.ndarray, shift_px: int) -> None:
    share = shared_view(ground[:, :800], ground[:, shift_px : shift_px + 800])
    assert share == pytest.approx(1 - shift_px / 800, abs=0.03)


def test_other_ground_and_bare_pictures_share_nothing(ground: np.ndarray) -> None:
    assert shared_view(ground[:, :800], ground[:, 800:]) == 0
    assert shared_view(ground[:, :800], np.full((600, 800, 3), 90, np.uint8)) == 0
