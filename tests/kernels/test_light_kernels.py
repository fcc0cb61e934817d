"""The kernels of light and of last pixels: compiled against their NumPy twins, to the rounding of their sums."""

import numpy as np
import numpy_light
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sorvolo import kernels

SEEDS = st.integers(0, 2**32 - 1)


@settings(max_examples=60, deadline=None)
@given(st.integers(1, 400), st.integers(1, 4), st.booleans(), SEEDS)
def test_slopes_are_as_specified(count: int, channels: int, is_coarse: bool, seed: int) -> None:
    rng = np.random.default_rng(seed)
    before = rng.normal(0, 0.3, (count, channels)).astype(np.float32)
    after = (before * rng.uniform(0.5, 2) + rng.normal(0, 0.1, before.shape)).astype(np.float32)
    if is_coarse:  # many equal values
        before, after = before.round(1), after.round(1)
    found, plain = (each.slopes(before, after, 1e-3) for each in (kernels, numpy_light))
    np.testing.assert_allclose(found, plain, rtol=1e-9)


def test_the_slope_of_a_noisy_line_is_found_despite_changes() -> None:
    rng = np.random.default_rng(1)
    before = rng.normal(0, 0.5, (2000, 3)).astype(np.float32)
    after = (before * np.float32([0.8, 1.0, 1.3]) + rng.normal(0, 0.01, before.shape)).astype(
        np.float32
    )
    after[:200] += 2
    np.testing.assert_allclose(kernels.slopes(before, after, 1e-3), [0.8, 1.0, 1.3], atol=0.03)


@settings(max_examples=60, deadline=None)
@given(st.integers(20, 500), SEEDS)
def test_moves_are_fitted_as_specified(count: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    rows_x, rows_y = rng.normal(0, 1, (2, count, 8))
    truth = rng.normal(0, 0.1, 8)
    moves = np.column_stack([rows_x @ truth, rows_y @ truth]) + rng.normal(0, 0.01, (count, 2))
    trust = rng.uniform(0.05, 1, count) * (rng.random(count) < 0.9)
    trust[0] = 1.0
    ridge = np.array([0, 1e-6, 1e-6, 0, 1e-6, 1e-6, 1e-4, 1e-4])
    ours, plain = (
        each.fit_moves(rows_x, rows_y, moves, trust, ridge, 640, 360)
        for each in (kernels, numpy_light)
    )
    np.testing.assert_allclose(ours[0], plain[0], rtol=1e-7, atol=1e-9)
    assert ours[1] == pytest.approx(plain[1], rel=1e-7)


@settings(max_examples=40, deadline=None)
@given(st.integers(9, 60), st.integers(9, 60), st.sampled_from([1, 3, 9]), st.integers(1, 5), SEEDS)
def test_products_of_details_are_as_specified(
    height: int, width: int, window: int, cell: int, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    before, after = rng.integers(0, 256, (2, height, width), dtype=np.uint8)
    table = np.log2(np.arange(256, dtype=np.float32) + 8) * np.float32(48)
    found, plain = (
        each.detail_products(before, after, table, window, cell) for each in (kernels, numpy_light)
    )
    assert found.shape == (3, height // cell, width // cell)
    np.testing.assert_allclose(found, plain, rtol=1e-4, atol=1e-2)  # squared steps, of thousands


@settings(max_examples=40, deadline=None)
@given(st.integers(4, 60), st.integers(4, 60), st.integers(1, 4), st.integers(1, 4), SEEDS)
def test_a_flow_is_laid_on_a_grid_as_specified(
    height: int, width: int, rows: int, columns: int, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    flow = rng.normal(0, 2, (height, width, 2)).astype(np.float32)
    details = rng.integers(0, 256, (height, width), dtype=np.uint8)
    ours, plain = (
        each.flow_on_grid(flow, details, rows, columns) for each in (kernels, numpy_light)
    )
    np.testing.assert_allclose(ours, plain, rtol=1e-4, atol=1e-4)
    if height % rows == 0 and width % columns == 0:
        means = flow.reshape(rows, height // rows, columns, width // columns, 2).mean(axis=(1, 3))
        np.testing.assert_allclose(ours[..., :2], means, atol=1e-5)


def test_what_does_not_fit_is_refused() -> None:
    rows, moves, ridge = np.ones((9, 8)), np.ones((9, 2)), np.ones(8)
    with pytest.raises(ValueError, match="do not fit"):
        kernels.slopes(np.ones((4, 3), np.float32), np.ones((5, 3), np.float32), 1.0)
    with pytest.raises(ValueError, match="do not fit"):
        kernels.fit_moves(rows, rows[:5], moves, np.ones(9), ridge, 1, 1)
    with pytest.raises(ValueError, match="trust"):
        kernels.fit_moves(rows, rows, moves, np.zeros(9), ridge, 1, 1)
    picture, table = np.ones((20, 24), np.uint8), np.ones(256, np.float32)
    with pytest.raises(ValueError, match="do not fit"):
        kernels.detail_products(picture, picture[:9], table, 3, 4)
    with pytest.raises(ValueError, match="a grid"):
        kernels.flow_on_grid(np.ones((20, 24, 2), np.float32), picture, 21, 4)
    with pytest.raises(ValueError, match="window"):
        kernels.detail_products(picture, picture, table, 21, 4)
