"""The thesis's method: it places what it should, reports why it did not, and repeats itself exactly."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sorvolo.errors import GeometryError, SettingsError
from sorvolo.geometry.homography import apply_homography
from sorvolo.lab.thesis.stitching import (
    RoiStitcher,
    RoiStitchingSettings,
    Stitched,
    georeference,
    solve_gains,
)

WIDTH, HEIGHT = 320, 240


def ground(seed: int = 0, contrast: float = 25.0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    total = np.zeros((700, 1000, 3), np.float32)
    for octave in (6, 24, 96):
        small = rng.normal(0, 1, (700 // octave + 2, 1000 // octave + 2, 3)).astype(np.float32)
        total += cv2.resize(small, (1000, 700), interpolation=cv2.INTER_CUBIC)
    return np.clip(128 + contrast * total, 0, 255).astype(np.uint8)


GROUND = ground()


def pose(x: float, y: float, turn_deg: float = 0.0, scale: float = 1.0) -> np.ndarray:
    a = np.radians(turn_deg)
    return np.array(
        [
            [scale * np.cos(a), -scale * np.sin(a), x],
            [scale * np.sin(a), scale * np.cos(a), y],
            [0, 0, 1],
        ]
    )


def photographed(ground_from_image: np.ndarray, gain: float = 1.0) -> np.ndarray:
    image = cv2.warpPerspective(GROUND, np.linalg.inv(ground_from_image), (WIDTH, HEIGHT))
    return np.clip(image * gain, 0, 255).astype(np.uint8)


PATH = [
    pose(40, 40),
    pose(130, 60, 4),
    pose(220, 70, -3, 1.03),
    pose(330, 120, 6, 0.98),
    pose(380, 240, 10),
]


def corner_error_px(placed: Stitched, true: np.ndarray, first: np.ndarray = PATH[0]) -> float:
    corners = np.array([[0, 0], [WIDTH, 0], [WIDTH, HEIGHT], [0, HEIGHT]], dtype=float)
    expected = apply_homography(np.linalg.inv(first) @ true, corners)
    return float(np.abs(apply_homography(placed.mosaic_from_image, corners) - expected).max())


@pytest.mark.parametrize("options", [{}, {"transform": "homography"}])
def test_frames_are_placed_where_they_were_taken(options):
    stitcher = RoiStitcher(RoiStitchingSettings(**options))
    for number, true in enumerate(PATH):
        placed = stitcher.add(number, photographed(true))
        assert isinstance(placed, Stitched)
        assert corner_error_px(placed, true) < 3.0
        assert number == 0 or placed.inliers >= 12
        assert placed.residual_px < 2.0
    centre = np.array([[(WIDTH - 1) / 2, (HEIGHT - 1) / 2]])
    assert placed.barycentre_px == pytest.approx(
        apply_homography(placed.mosaic_from_image, centre)[0]
    )


def test_gains_make_overlaps_alike_but_stay_near_one():
    stitcher = RoiStitcher()
    brightness = [1.0, 0.8, 0.85, 0.9, 1.0]
    for number, true in enumerate(PATH):
        stitcher.add(number, photographed(true, brightness[number]))
    gains = stitcher.gains()
    levels = np.array([gains[number] * each for number, each in enumerate(brightness)])
    assert np.ptp(levels) < 0.6 * np.ptp(brightness)
    assert all(0.85 < gain < 1.2 for gain in gains.values())
    assert gains[1] > gains[0]


def test_gains_do_not_drift_along_a_chain():
    """Each neighbour a little darker: a gain by the last frame alone would end at 1.5; a prior bounds all of them."""
    overlaps = {(n, n + 1): (0.7, 120.0, 120.0 * 0.97) for n in range(14)}
    gains = solve_gains(list(range(15)), overlaps)
    assert max(gains.values()) < 1.1
    assert min(gains.values()) > 0.9
    assert solve_gains([3], {}) == {3: 1.0}


def test_the_same_frames_give_the_same_map_to_the_bit():
    pictures = []
    for _ in range(2):
        stitcher = RoiStitcher()
        for number, true in enumerate(PATH[:3]):
            placed = stitcher.add(number, photographed(true))
        pictures.append((stitcher.gains(), placed.mosaic_from_image))
    assert pictures[0][0] == pictures[1][0]
    assert np.array_equal(pictures[0][1], pictures[1][1])


def test_a_lost_frame_is_named_and_the_region_stays():
    stitcher = RoiStitcher()
    stitcher.add(0, photographed(PATH[0]))
    blank = stitcher.add(1, np.full((HEIGHT, WIDTH, 3), 100, np.uint8))
    assert isinstance(blank, str)
    assert "features" in blank
    elsewhere = stitcher.add(2, cv2.resize(ground(9)[:HEIGHT, :WIDTH], (WIDTH, HEIGHT)))
    assert isinstance(elsewhere, str)
    assert "match" in elsewhere
    assert list(stitcher.gains()) == [0]
    assert isinstance(stitcher.add(3, photographed(PATH[1])), Stitched)


def test_the_region_is_around_the_last_frame_only():
    """Ground that the mosaic shows, but farther than the region reaches, is not found again."""
    stitcher = RoiStitcher()
    for number, x in enumerate((0, 150, 300, 450, 600)):
        assert isinstance(stitcher.add(number, photographed(pose(x, 200))), Stitched)
    assert isinstance(stitcher.add(9, photographed(pose(0, 200))), str)


def test_ground_of_low_contrast_is_stitched():
    faint = ground(3, contrast=6)
    a, b = faint[100:340, 100:420], faint[120:360, 160:480]
    stitcher = RoiStitcher()
    stitcher.add(0, a)
    assert isinstance(stitcher.add(1, b), Stitched)
    assert len(cv2.xfeatures2d.AKAZE_create(threshold=1e-3).detect(a)) < 12  # by OpenCV's own


@pytest.mark.parametrize(
    "options",
    [{"max_features": 0}, {"transform": "affine"}],
)
def test_impossible_settings_are_refused(options):
    with pytest.raises(SettingsError):
        RoiStitchingSettings(**options)


@settings(max_examples=50, deadline=None)
@given(
    st.floats(0.01, 1.0),
    st.floats(-180, 180),
    st.floats(-1000, 1000),
    st.floats(-1000, 1000),
    st.integers(0, 999),
)
def test_georeference_finds_the_similarity_and_turns_y_up(scale, turn_deg, east, north, seed):
    barycentres = np.random.default_rng(seed).uniform(-2000, 2000, (6, 2))
    true = pose(east, north, turn_deg, scale) @ np.diag([1.0, -1.0, 1.0])
    fixes = apply_homography(true, barycentres)
    found = georeference(barycentres, fixes)
    assert np.allclose(found, true, atol=1e-6)
    assert np.linalg.det(found[:2, :2]) < 0


def test_georeference_needs_two_places():
    with pytest.raises(GeometryError):
        georeference(np.zeros((1, 2)), np.zeros((1, 2)))
    with pytest.raises(GeometryError):
        georeference(np.zeros((3, 2)), np.zeros((2, 2)))
