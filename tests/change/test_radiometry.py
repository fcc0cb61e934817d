"""One picture in the light of another: what the fit follows, and what it must not follow."""

import cv2
import numpy as np
import numpy_robust
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sorvolo import kernels
from sorvolo.change.light import fit_light, relit


def textured(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    coarse = cv2.resize(rng.uniform(40, 180, (9, 12, 3)), (480, 360), interpolation=cv2.INTER_CUBIC)
    fine = cv2.GaussianBlur(rng.normal(0, 60, (360, 480, 1)), (0, 0), 1.5)[..., None]
    return np.clip(coarse + fine + rng.normal(0, 1, coarse.shape), 8, 215).astype(np.uint8)


@pytest.mark.parametrize("gamma", [0.75, 1.0, 1.3])
@pytest.mark.parametrize("gains", [(0.7, 0.7, 0.7), (1.1, 1.0, 0.85)])
def test_gamma_and_white_balance_are_undone(
    gamma: float, gains: tuple[float, float, float]
) -> None:
    before = textured(1)
    after = np.clip(255 * (before / 255.0) ** gamma * gains + 0.5, 0, 255).astype(np.uint8)
    difference = np.abs(relit(before, fit_light(before, after)).astype(int) - after)
    assert np.median(difference) <= 2 and np.quantile(difference, 0.95) <= 10


def test_what_each_picture_shows_alone_flattens_nothing() -> None:
    """Leaves, misalignment and noise: as much of the ground as of them, and dark and bright things stay so."""
    ground = np.random.default_rng(5).normal(0, 12, (45, 60, 3))

    def taken(seed: int) -> np.ndarray:
        alone = np.random.default_rng(seed).normal(0, 12, ground.shape)
        picture = 110 + cv2.resize(ground + alone, (480, 360), interpolation=cv2.INTER_CUBIC)
        return np.clip(np.rint(picture), 0, 255).astype(np.uint8)

    light = fit_light(taken(6), taken(7))
    np.testing.assert_allclose(light.exponents, 1.0, atol=0.08)


def test_a_cloud_is_followed() -> None:
    before = textured(2)
    shade = np.ones(before.shape[:2], np.float32)
    shade[:, 240:] = 0.5
    after = (before * cv2.GaussianBlur(shade, (0, 0), 15)[..., None]).astype(np.uint8)
    light = fit_light(before, after)
    difference = np.abs(relit(before, light).astype(int) - after)
    assert np.quantile(difference, 0.9) <= 6
    assert light.unevenness > 0.3


@pytest.mark.parametrize("side", [40, 160])
def test_a_thing_is_not_followed_however_large(side: int) -> None:
    before = textured(3)
    after = before.copy()
    after[100 : 100 + side, 150 : 150 + side] = (30, 28, 26)
    lit = relit(before, fit_light(before, after)).astype(int)
    inside = np.s_[100 : 100 + side, 150 : 150 + side]
    assert (
        np.abs(lit[inside] - before[inside]).mean()
        < 0.2 * np.abs(before[inside].astype(int) - 28).mean()
    )


def test_unknown_ground_does_not_count() -> None:
    before = textured(4)
    after = (before * 0.8).astype(np.uint8)
    known = np.zeros(before.shape[:2], bool)
    known[:, :200] = True
    before[~known] = 255
    light = fit_light(before, after, known)
    np.testing.assert_allclose(light.brightness, 0.82, atol=0.04)
    assert fit_light(before, after, np.zeros_like(known)).unevenness == 0


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 2**31), st.integers(1, 40), st.integers(1, 40), st.integers(1, 9))
def test_relighting_agrees(seed: int, height: int, width: int, lines: int) -> None:
    rng = np.random.default_rng(seed)
    image = rng.integers(0, 256, (height, width, 3), dtype=np.uint8)
    curves = rng.integers(0, 16384, (3, 256)).astype(np.int32)
    gains = rng.integers(0, 65536, (lines, width, 3)).astype(np.float32)
    plain = np.empty_like(image)
    numpy_robust.relight(image, curves, gains, 0, 0, width, height, plain)
    np.testing.assert_array_equal(kernels.relight(image, curves, gains), plain)
