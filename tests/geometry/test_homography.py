"""Plane-to-plane maps against the cameras and similarities that they stand for."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sorvolo.errors import GeometryError
from sorvolo.geometry.camera import Camera
from sorvolo.geometry.ground import footprint, ground_from_pixels, ground_from_rays
from sorvolo.geometry.homography import apply_homography, fit_similarity, site_from_image_homography
from sorvolo.geometry.pose import NADIR_CAMERA_NORTH_UP, Pose, site_from_gimbal_rotation

CAMERA = Camera(960, 540, 800, 805, 470, 275)
views = st.builds(
    lambda yaw, pitch, roll, x, y, z: Pose(
        site_from_gimbal_rotation(yaw, pitch, roll), np.array([x, y, z])
    ),
    st.floats(0, 360),
    st.floats(-90, -60),
    st.floats(-10, 10),
    st.floats(-500, 500),
    st.floats(-500, 500),
    st.floats(5, 120),
)
pixels = np.random.default_rng(2).random((30, 2)) * [959, 539]


@settings(max_examples=60, deadline=None)
@given(views, st.floats(-3, 3))
def test_the_homography_is_the_rays_way_to_the_ground(site_from_camera, ground_height_m):
    site_from_image = site_from_image_homography(CAMERA, site_from_camera, ground_height_m)
    by_rays = ground_from_pixels(CAMERA, site_from_camera, pixels, ground_height_m)
    np.testing.assert_allclose(apply_homography(site_from_image, pixels), by_rays, atol=1e-6)


@settings(max_examples=60, deadline=None)
@given(views)
def test_image_to_ground_and_back(site_from_camera):
    ground_m = ground_from_pixels(CAMERA, site_from_camera, pixels)
    points_m = site_from_camera.inverse().apply(
        np.column_stack([ground_m, np.zeros(len(ground_m))])
    )
    np.testing.assert_allclose(CAMERA.pixels_from_points(points_m), pixels, atol=1e-6)


def test_a_level_camera_has_a_footprint_with_the_image_top_to_the_north():
    outline_m = footprint(CAMERA, Pose(NADIR_CAMERA_NORTH_UP, np.array([10.0, 20.0, 80.0])))
    width_m, length_m = 80 * 960 / 800, 80 * 540 / 805
    np.testing.assert_allclose(outline_m[1] - outline_m[0], [width_m, 0], atol=1e-9)
    np.testing.assert_allclose(outline_m[3] - outline_m[0], [0, -length_m], atol=1e-9)


def test_rays_at_and_above_the_horizon_meet_nothing():
    level = Pose(site_from_gimbal_rotation(0, 0, 0), np.array([0, 0, 50.0]))
    ground_m = ground_from_pixels(CAMERA, level, np.array([[470, 275], [470, 0], [470, 539]]))
    assert np.isnan(ground_m[:2]).all()
    assert np.isfinite(ground_m[2]).all()
    assert np.isnan(footprint(CAMERA, level)[:2]).all()
    assert np.isnan(ground_from_rays(np.array([[0.0, 0, 1]]), level, 60.0)).all()


def test_pixels_above_the_horizon_are_nan_in_the_homography_too():
    tilted = Pose(site_from_gimbal_rotation(30, -10, 0), np.array([0, 0, 50.0]))
    site_from_image = site_from_image_homography(CAMERA, tilted)
    above_and_below = np.array([[470.0, -200], [470, 539]])
    mapped = apply_homography(site_from_image, above_and_below)
    assert np.isnan(mapped[0]).all()
    np.testing.assert_allclose(
        mapped[1], ground_from_pixels(CAMERA, tilted, above_and_below)[1], atol=1e-6
    )


@pytest.mark.parametrize("height_m", [0.0, -1.0])
def test_a_camera_on_or_below_the_ground_is_refused(height_m):
    with pytest.raises(GeometryError, match="above"):
        site_from_image_homography(CAMERA, Pose(NADIR_CAMERA_NORTH_UP, np.array([0, 0, height_m])))


@given(st.floats(0.01, 100), st.floats(-np.pi, np.pi), st.floats(-1e4, 1e4), st.floats(-1e4, 1e4))
def test_a_similarity_is_found_again(scale, turn, x, y):
    points = np.random.default_rng(3).normal(0, 10, (12, 2))
    linear = scale * np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    a_from_b = fit_similarity(points @ linear.T + [x, y], points)
    np.testing.assert_allclose(a_from_b[:2, :2], linear, atol=1e-6)
    np.testing.assert_allclose(a_from_b[:2, 2], [x, y], atol=1e-6)


def test_a_similarity_is_the_least_squares_one():
    rng = np.random.default_rng(4)
    b = rng.normal(0, 10, (30, 2))
    a = 2 * b + rng.normal(0, 1, b.shape)

    def misfit(matrix):
        return ((apply_homography(matrix, b) - a) ** 2).sum()

    best = fit_similarity(a, b)
    for row, column in ((0, 2), (1, 2)):
        for step in (-0.01, 0.01):
            other = best.copy()
            other[row, column] += step
            assert misfit(other) > misfit(best)
    for turn in (0.999, 1.001, np.exp(0.001j), np.exp(-0.001j)):
        other = best.copy()
        other[:2, :2] = np.array([[turn.real, -turn.imag], [turn.imag, turn.real]]) @ best[:2, :2]
        other[:2, 2] = a.mean(axis=0) - other[:2, :2] @ b.mean(axis=0)
        assert misfit(other) > misfit(best)


def test_a_similarity_needs_two_points_that_differ():
    with pytest.raises(GeometryError, match="at least 2"):
        fit_similarity(np.zeros((1, 2)), np.zeros((1, 2)))
    with pytest.raises(GeometryError, match="differ"):
        fit_similarity(np.eye(2), np.ones((2, 2)))
