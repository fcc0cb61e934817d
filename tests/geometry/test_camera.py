"""The lens: there and back, against OpenCV, and what is no camera."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sorvolo.errors import GeometryError
from sorvolo.geometry.camera import Camera

# lenses as they are: barrel or pincushion, decentred by a little
lenses = st.tuples(
    st.floats(-0.25, 0.15),
    st.floats(-0.05, 0.1),
    st.floats(-0.003, 0.003),
    st.floats(-0.003, 0.003),
    st.floats(-0.02, 0.02),
)
cameras = st.builds(
    lambda size, focal, dx, dy, lens: Camera(
        *size,
        focal * size[0],
        focal * size[0] * 1.01,
        size[0] / 2 + dx,
        size[1] / 2 + dy,
        np.array(lens),
    ),
    st.sampled_from([(640, 480), (1920, 1080), (4000, 3000)]),
    st.floats(0.9, 3),
    st.floats(-20, 20),
    st.floats(-20, 20),
    lenses,
)


def pixels_of(camera, count=60, seed=0):
    points = (
        np.random.default_rng(seed).random((count, 2)) * [camera.width_px, camera.height_px] - 0.5
    )
    return np.vstack((points, camera.corners_px))


@settings(max_examples=60, deadline=None)
@given(cameras)
def test_pixels_to_rays_and_back(camera):
    points_px = pixels_of(camera)
    rays = camera.rays_from_pixels(points_px)
    assert np.abs(camera.pixels_from_points(rays) - points_px).max() < 1e-6
    assert np.abs(camera.pixels_from_points(rays * 37.5) - points_px).max() < 1e-6


@settings(max_examples=30, deadline=None)
@given(cameras)
def test_projection_is_opencvs(camera):
    points_m = np.random.default_rng(1).normal(0, 0.3, (40, 3)) + np.array([0, 0, 2.0])
    expected, _ = cv2.projectPoints(
        points_m, np.zeros(3), np.zeros(3), camera.matrix, camera.distortion
    )
    assert np.abs(camera.pixels_from_points(points_m) - expected.reshape(-1, 2)).max() < 1e-6


def test_distortion_is_equations_2_2_and_2_3_on_normalised_coordinates():
    k1, k2, p1, p2, k3 = -0.1, 0.02, 0.001, -0.002, 0.005
    camera = Camera(100, 100, 1.0, 1.0, 0.0, 0.0, np.array([k1, k2, p1, p2, k3]))
    x, y = 0.3, -0.2
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    expected = [
        x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
        y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
    ]
    np.testing.assert_allclose(camera.pixels_from_points(np.array([[x, y, 1.0]]))[0], expected)


@given(cameras)
def test_undistorted_points_belong_to_the_perfect_lens(camera):
    points_px = pixels_of(camera, 10)
    straight = camera.undistort_points(points_px)
    perfect = camera.undistorted()
    assert not perfect.is_distorted
    np.testing.assert_allclose(
        perfect.rays_from_pixels(straight), camera.rays_from_pixels(points_px), atol=1e-9
    )


@settings(max_examples=40, deadline=None)
@given(cameras, st.integers(1, 4))
def test_a_resized_camera_sees_the_same_rays(camera, divisor):
    small = camera.resized(camera.width_px // divisor, camera.height_px // divisor)
    scale = np.array([small.width_px / camera.width_px, small.height_px / camera.height_px])
    points_px = pixels_of(camera, 20)
    np.testing.assert_allclose(
        small.rays_from_pixels((points_px + 0.5) * scale - 0.5),
        camera.rays_from_pixels(points_px),
        atol=1e-9,
    )
    # the outer corners stay the outer corners
    np.testing.assert_allclose((camera.corners_px + 0.5) * scale - 0.5, small.corners_px, atol=1e-9)


@given(st.integers(100, 8000), st.floats(5, 150))
def test_angle_of_view_there_and_back(width_px, aov_deg):
    camera = Camera.from_angle_of_view(width_px, width_px // 2 + 1, aov_deg)
    assert camera.angle_of_view_deg[0] == pytest.approx(aov_deg)
    edges = camera.rays_from_pixels(np.array([[-0.5, 0], [width_px - 0.5, 0]]))
    assert np.degrees(np.arctan(edges[1, 0]) - np.arctan(edges[0, 0])) == pytest.approx(aov_deg)


def test_points_behind_the_camera_are_not_seen():
    camera = Camera.from_angle_of_view(640, 480, 60)
    points_px = camera.pixels_from_points(np.array([[0.0, 0, -1], [0, 0, 0], [0, 0, 1]]))
    assert np.isnan(points_px[:2]).all()
    np.testing.assert_allclose(points_px[2], [319.5, 239.5])


def test_another_focal_length_keeps_the_pixels_aspect():
    camera = Camera(640, 480, 500, 510, 320, 240).with_focal_px(1000)
    assert (camera.fx_px, camera.fy_px) == (1000, 1020)


@pytest.mark.parametrize(
    "change",
    [
        {"fx_px": 0.0},
        {"fy_px": -5.0},
        {"fx_px": np.nan},
        {"cx_px": 5000.0},
        {"cy_px": -900.0},
        {"width_px": 0},
        {"distortion": np.zeros(4)},
        {"distortion": np.full(5, np.inf)},
    ],
)
def test_what_is_no_camera_is_refused(change):
    good = {
        "width_px": 640,
        "height_px": 480,
        "fx_px": 500.0,
        "fy_px": 500.0,
        "cx_px": 320.0,
        "cy_px": 240.0,
    }
    with pytest.raises(GeometryError):
        Camera(**(good | change))
