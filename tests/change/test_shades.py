"""Ground that another shadow falls on is the same ground; what is new on it is reported nevertheless."""

import cv2
import numpy as np
import pytest

from sorvolo.change.robust import compare_robust

SUN_OVER_SHADE = np.array([0.52, 0.45, 0.4])  # blue green red: a shadow is a little blue


def ground(seed: int = 1) -> np.ndarray:
    """(360, 480, 3) uint8 rough grass."""
    rng = np.random.default_rng(seed)
    grain = sum(
        cv2.resize(
            rng.normal(0, 9, (360 // k, 480 // k)), (480, 360), interpolation=cv2.INTER_CUBIC
        )
        for k in (2, 4, 10)
    )
    return np.clip(np.array([60, 120, 90]) + grain[..., None] * [0.6, 1.0, 0.8], 0, 255).astype(
        np.uint8
    )


def shaded(image: np.ndarray, place: tuple[int, int]) -> np.ndarray:
    """The picture with a tree's shadow about `place` (x, y)."""
    depth = np.zeros(image.shape[:2], np.float32)
    cv2.ellipse(depth, (place, (90, 130), 30), 1.0, cv2.FILLED)
    depth = cv2.GaussianBlur(depth, (5, 5), 0)[..., None]
    return np.clip(image * (1 - depth + depth * SUN_OVER_SHADE), 0, 255).astype(np.uint8)


def test_a_shadow_that_moved_is_no_change() -> None:
    before, after = shaded(ground(), (200, 180)), shaded(ground(), (250, 190))
    assert not compare_robust(before, after).mask.any()


@pytest.mark.parametrize(
    "place", [(172, 150), (262, 165), (400, 300)], ids=["left", "came", "elsewhere"]
)
def test_a_thing_where_a_shadow_moved_is_found(place: tuple[int, int]) -> None:
    before, after = shaded(ground(), (200, 180)), shaded(ground(), (250, 190))
    x, y = place
    after[y : y + 16, x : x + 22] = (60, 50, 190)
    result = compare_robust(before, after)
    own = np.zeros(after.shape[:2], bool)
    own[y : y + 16, x : x + 22] = True
    assert np.count_nonzero(result.mask[own]) > 0.8 * own.sum()


def test_a_dark_thing_hides_the_grounds_structure_and_is_no_shadow() -> None:
    before = ground()
    after = before.copy()
    after[150:220, 200:300] = (before[150:220, 200:300].mean(axis=(0, 1)) * SUN_OVER_SHADE).astype(
        np.uint8
    )
    assert np.count_nonzero(compare_robust(before, after).mask[150:220, 200:300]) > 0.8 * 70 * 100
