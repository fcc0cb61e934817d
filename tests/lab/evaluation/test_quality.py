"""The measures: exact on cases whose answer is known, and refusing what cannot be compared."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sorvolo.geometry.homography import apply_homography
from sorvolo.lab.evaluation.map_quality import (
    corner_errors,
    correlation,
    deviation,
    position_errors,
    residual_shift,
)


def similarity(scale: float, turn_deg: float, x: float, y: float) -> np.ndarray:
    a = np.radians(turn_deg)
    return np.array(
        [
            [scale * np.cos(a), -scale * np.sin(a), x],
            [scale * np.sin(a), scale * np.cos(a), y],
            [0, 0, 1],
        ]
    )


def outlines(count: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return rng.uniform(-200, 200, (count, 1, 2)) + np.array(
        [[-24, 13], [24, 13], [24, -13], [-24, -13]]
    )


def moved(matrix: np.ndarray, points: np.ndarray) -> np.ndarray:
    return apply_homography(matrix, points.reshape(-1, 2)).reshape(points.shape)


@settings(max_examples=50, deadline=None)
@given(st.floats(0.9, 1.1), st.floats(-5, 5), st.floats(-20, 20), st.floats(-20, 20))
def test_a_similarity_costs_no_shape(scale, turn, x, y):
    true = outlines(9)
    errors = corner_errors(moved(similarity(scale, turn, x, y), true), true, 0.05)
    assert errors.shape.max_m < 1e-6
    assert errors.absolute.rms_m >= errors.shape.rms_m
    assert errors.absolute.rms_px == pytest.approx(errors.absolute.rms_m / 0.05)
    assert errors.absolute.count == 36


def test_a_shift_is_all_datum():
    true = outlines(5)
    errors = corner_errors(true + np.array([3.0, 4.0]), true, 0.1)
    assert errors.absolute.rms_m == pytest.approx(5.0)
    assert errors.absolute.p95_m == pytest.approx(5.0)
    assert errors.absolute.max_px == pytest.approx(50.0)
    assert errors.shape.rms_m < 1e-9


def test_the_floor_is_what_the_fixes_cost():
    true, cameras = outlines(8), outlines(8).mean(axis=1)
    fixes = cameras + np.array([0.0, 1.0])
    errors = corner_errors(true + np.array([0.5, 0.0]), true, 0.05, cameras, fixes)
    assert errors.floor.rms_m == pytest.approx(1.0)
    assert errors.over_floor == pytest.approx(0.5)
    assert np.isnan(corner_errors(true, true, 0.05).over_floor)


def test_the_floor_of_white_noise_falls_with_the_number_of_fixes():
    rng = np.random.default_rng(0)
    floors = []
    for count in (10, 1000):
        true = outlines(count, 1)
        cameras = true.mean(axis=1)
        fixes = cameras + rng.normal(0, 1, (count, 2))
        floors.append(corner_errors(true, true, 0.05, cameras, fixes).floor.rms_m)
    assert floors[1] < 0.2 * floors[0]


def test_nothing_to_compare_is_not_a_number_and_no_error():
    empty = corner_errors(np.zeros((0, 4, 2)), np.zeros((0, 4, 2)), 0.05)
    assert empty.absolute.count == 0
    assert np.isnan(empty.absolute.rms_m)
    assert np.isnan(correlation(np.zeros((4, 4)), np.zeros((4, 4)), np.zeros((4, 4), dtype=bool)))
    assert np.isnan(correlation(np.zeros((4, 4)), np.eye(4), np.ones((4, 4), dtype=bool)))
    black = np.zeros((4, 4, 3), np.uint8)
    assert np.isnan(deviation(black, black, np.zeros((4, 4), dtype=bool)).share)


def test_positions_are_compared_with_and_without_the_datum():
    reference = np.random.default_rng(1).uniform(-100, 100, (12, 3))
    estimated = reference + np.array([2.0, 0.0, 0.0])
    absolute, shape = position_errors(estimated, reference, 0.05)
    assert absolute.rms_m == pytest.approx(2.0)
    assert shape.rms_m < 1e-9
    assert position_errors(estimated[:2], reference[:2], 0.05)[1].count == 0


def test_deviation_is_the_mean_gray_difference():
    mosaic = np.full((20, 30, 3), 100, np.uint8)
    frame = mosaic.copy()
    frame[:, :15] += 51
    mask = np.ones((20, 30), dtype=bool)
    found = deviation(mosaic, frame, mask)
    assert found.share == pytest.approx(0.1)
    assert found.histogram[0] == pytest.approx(0.5)
    assert found.histogram[51 // 8] == pytest.approx(0.5)
    assert found.histogram.sum() == pytest.approx(1.0)
    mask[:, :15] = False
    assert deviation(mosaic, frame, mask).share == 0.0
    assert deviation(mosaic, frame, mask).count == 300


@settings(max_examples=30, deadline=None)
@given(st.floats(0.2, 3.0), st.floats(-50, 50), st.integers(0, 100))
def test_correlation_ignores_brightness_and_contrast(gain, offset, seed):
    a = np.random.default_rng(seed).uniform(0, 255, (12, 9))
    mask = np.ones(a.shape, dtype=bool)
    assert correlation(a, gain * a + offset, mask) == pytest.approx(1.0)
    assert correlation(a, -gain * a + offset, mask) == pytest.approx(-1.0)
    b = np.random.default_rng(seed + 1).uniform(0, 255, a.shape)
    assert correlation(a, b, mask) == pytest.approx(np.corrcoef(a.ravel(), b.ravel())[0, 1])


@pytest.mark.parametrize(("x", "y"), [(0.0, 0.0), (5.0, -3.0), (-12.4, 7.6)])
def test_the_residual_shift_is_found_with_its_sign(x, y):
    rng = np.random.default_rng(2)
    a = cv2.resize(rng.uniform(0, 255, (60, 80)), (320, 240), interpolation=cv2.INTER_CUBIC)
    b = cv2.warpAffine(
        a, np.array([[1, 0, x], [0, 1, y]]), (320, 240), borderMode=cv2.BORDER_REFLECT
    )
    mask = np.ones(a.shape, dtype=bool)
    mask[:20, :50] = False
    found = residual_shift(a, 0.6 * b + 30, mask)
    assert (found.x_px, found.y_px) == pytest.approx((x, y), abs=0.3)
    assert found.response > 0.3
