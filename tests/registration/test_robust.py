"""The robust fit: the right model among wild pairs, and none where there is none to believe."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sorvolo.geometry.homography import apply_homography
from sorvolo.registration.matching import fit_homography, is_believable

A_FROM_B = np.array([[0.98, -0.17, 40], [0.17, 0.98, -25], [2e-5, -3e-5, 1]])
CORNERS = np.array([[0, 0], [640, 0], [640, 480], [0, 480]], float)


def paired(wild_share: float, noise_px: float, seed: int = 1, count: int = 200):
    rng = np.random.default_rng(seed)
    b = rng.uniform([0, 0], [640, 480], (count, 2))
    a = apply_homography(A_FROM_B, b) + rng.normal(0, noise_px, (count, 2))
    wild = rng.random(count) < wild_share
    a[wild] = rng.uniform(0, 600, (int(wild.sum()), 2))
    return a, b, wild


@pytest.mark.parametrize("wild_share", [0.0, 0.3, 0.6])
def test_the_model_is_found_among_wild_pairs(wild_share):
    a, b, wild = paired(wild_share, 0.3)
    model, inliers = fit_homography(a, b, 3.0)
    assert (
        np.abs(apply_homography(model, CORNERS) - apply_homography(A_FROM_B, CORNERS)).max() < 1.0
    )
    assert inliers.shape == (200,) and inliers.dtype == bool
    assert inliers[~wild].mean() > 0.95
    assert inliers[wild].sum() <= 3
    assert model[2, 2] == pytest.approx(1.0)


def test_a_fit_repeats_itself():
    a, b, _ = paired(0.5, 0.5)
    first, second = fit_homography(a, b, 3.0), fit_homography(a, b, 3.0)
    assert (first[0] == second[0]).all() and (first[1] == second[1]).all()


def test_too_few_pairs_have_no_model():
    assert fit_homography(CORNERS[:3], CORNERS[:3], 3.0) is None


def test_points_on_one_line_have_no_model():
    line = np.column_stack([np.linspace(0, 600, 50), np.linspace(0, 300, 50)])
    found = fit_homography(line + 5, line, 3.0)
    assert found is None


def test_a_mirrored_picture_has_no_model():
    b = np.random.default_rng(2).uniform(0, 500, (100, 2))
    assert fit_homography(b * [-1, 1] + [500, 0], b, 3.0) is None


@given(st.floats(0.3, 3.0), st.floats(-180, 180))
def test_turns_and_moderate_scales_are_believable(scale, turn_deg):
    a = np.radians(turn_deg)
    matrix = np.array(
        [
            [scale * np.cos(a), -scale * np.sin(a), 5],
            [scale * np.sin(a), scale * np.cos(a), 9],
            [0, 0, 1.0],
        ]
    )
    assert is_believable(matrix, CORNERS)
    assert not is_believable(matrix @ np.diag([1.0, -1.0, 1.0]), CORNERS)


@pytest.mark.parametrize(
    "matrix",
    [
        np.diag([5.0, 5.0, 1.0]),
        np.diag([0.2, 0.2, 1.0]),
        np.diag([2.5, 1.0, 1.0]),
        np.array([[1, 0, 0], [0, 1, 0], [-4e-3, 0, 1.0]]),
    ],
    ids=["five times larger", "five times smaller", "stretched one way", "folded"],
)
def test_what_no_drone_does_is_not_believable(matrix):
    assert not is_believable(matrix, CORNERS)


def test_fewer_than_four_points_support_nothing():
    assert not is_believable(np.eye(3), CORNERS[:3])
