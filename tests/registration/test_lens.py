"""Lenses: straightened pictures and refined cameras agree with the camera's own equations."""

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sorvolo.geometry.camera import Camera
from sorvolo.registration.lens import Undistorter, refined_camera

PERFECT = Camera(480, 320, 400.0, 402.0, 243.0, 155.0)
BARREL = Camera(480, 320, 400.0, 402.0, 243.0, 155.0, np.array([-0.12, 0.03, 0.001, -0.0008, 0.0]))
GRID_PX = np.array([[x, y] for x in (60, 150, 240, 330, 420) for y in (50, 160, 270)], float)


def dotted(points_px: np.ndarray) -> np.ndarray:
    """A black picture with a soft white dot at each point."""
    y, x = np.mgrid[:320, :480]
    distance2 = (x[..., None] - points_px[:, 0]) ** 2 + (y[..., None] - points_px[:, 1]) ** 2
    dots = 240 * np.exp(-distance2 / (2 * 3.0**2)).max(axis=-1)
    return np.repeat(np.round(dots).astype(np.uint8)[..., None], 3, axis=2)


def dots(image: np.ndarray, near_px: np.ndarray) -> np.ndarray:
    """Where the dots are, each the centre of mass of the 23 px window about its expected place."""
    found = []
    for x, y in np.round(near_px).astype(int):
        window = image[y - 11 : y + 12, x - 11 : x + 12, 0].astype(float)
        rows, columns = np.mgrid[y - 11 : y + 12, x - 11 : x + 12]
        found.append(
            [(window * columns).sum() / window.sum(), (window * rows).sum() / window.sum()]
        )
    return np.array(found)


def test_a_straightened_picture_is_the_perfect_lens_s():
    lens = Undistorter(BARREL)
    rays = lens.camera.rays_from_pixels(GRID_PX)
    seen = BARREL.pixels_from_points(rays)
    assert np.abs(seen - GRID_PX).max() > 3
    assert np.abs(dots(lens.undistort(dotted(seen)), GRID_PX) - GRID_PX).max() < 0.05
    assert not lens.camera.is_distorted


@pytest.mark.parametrize("camera", [BARREL, PERFECT])
@pytest.mark.parametrize("share", [1.0, 2 / 3, 0.4])
def test_pictures_are_straightened_and_made_smaller_in_one(camera, share):
    small = camera.resized(round(480 * share), round(320 * share))
    seen = camera.pixels_from_points(camera.undistorted().rays_from_pixels(GRID_PX))
    lens = Undistorter(small, camera)
    straight = cv2.resize(lens.undistort(dotted(seen)), (480, 320), interpolation=cv2.INTER_LINEAR)
    assert np.abs(dots(straight, GRID_PX) - GRID_PX).max() < 0.1
    bright = lens.undistort(np.full((320, 480, 3), 200, np.uint8))
    assert bright.shape == (small.height_px, small.width_px, 3) and (bright == 200).all()
    mask = lens.valid(small.width_px, small.height_px)
    assert mask is None or mask.mean() > 0.9


def test_a_perfect_lens_leaves_pictures_alone():
    lens = Undistorter(PERFECT)
    image = dotted(GRID_PX)
    assert lens.undistort(image) is image
    assert lens.valid(480, 320) is None


def test_only_seen_pixels_are_valid():
    pincushion = Camera(480, 320, 400.0, 402.0, 243.0, 155.0, np.array([0.15, 0, 0, 0, 0.0]))
    lens = Undistorter(pincushion)
    mask = lens.valid(480, 320)
    white = lens.undistort(np.full((320, 480, 3), 255, np.uint8))
    assert mask is not None and mask.shape == (320, 480) and 0.5 < mask.mean() < 1
    assert (white[mask] == 255).all()
    small = lens.valid(120, 80)
    assert small is not None and small.shape == (80, 120)
    assert (
        cv2.resize(mask.astype(np.uint8), (120, 80), interpolation=cv2.INTER_AREA)[small] == 1
    ).all()


@pytest.mark.parametrize("radial", [0.0, 1e-5, -1e-4])
def test_nothing_is_left_over_where_nothing_moves(radial):
    assert Undistorter.left_over(PERFECT, radial) is None


@pytest.mark.parametrize("radial", [0.05, -0.04])
def test_what_is_left_over_is_taken_out(radial):
    lens = Undistorter.left_over(PERFECT, radial)
    centre, focal = (
        np.array([PERFECT.cx_px, PERFECT.cy_px]),
        np.array([PERFECT.fx_px, PERFECT.fy_px]),
    )
    ideal = (GRID_PX - centre) / focal
    # seen is where the bundle's equation, ideal = seen (1 + k r^2), holds
    seen = ideal.copy()
    for _ in range(60):
        seen = ideal / (1 + radial * (seen**2).sum(axis=1, keepdims=True))
    image = dotted(seen * focal + centre)
    assert np.abs(seen * focal + centre - GRID_PX).max() > 0.5
    assert np.abs(dots(lens.undistort(image), GRID_PX) - GRID_PX).max() < 0.05


@given(st.floats(0.93, 1.07), st.floats(-0.04, 0.04), st.sampled_from([PERFECT, BARREL]))
def test_the_refined_camera_sees_what_the_flight_found(focal_scale, radial, camera):
    x, y = np.meshgrid(np.linspace(0, 479, 13), np.linspace(0, 319, 9))
    pixels = np.column_stack([x.ravel(), y.ravel()])
    seen = camera.undistorted().rays_from_pixels(camera.undistort_points(pixels))[:, :2]
    found = seen * (1 + radial * (seen**2).sum(axis=1, keepdims=True)) / focal_scale
    refined = refined_camera(camera, focal_scale, radial)
    rays = np.column_stack([found, np.ones(len(found))])
    assert np.abs(refined.pixels_from_points(rays) - pixels).max() < 0.05
    assert refined.fx_px == pytest.approx(camera.fx_px * focal_scale)


def test_a_camera_that_nothing_was_found_about_stays():
    refined = refined_camera(BARREL, 1.0, 0.0)
    assert (refined.distortion == BARREL.distortion).all() and refined.fx_px == BARREL.fx_px
