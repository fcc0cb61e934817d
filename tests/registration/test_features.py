"""Features: points that stay on the ground, whatever the exposure and the size they were looked for at."""

import cv2
import numpy as np
import pytest
from pictured import HEIGHT, WIDTH, ground, photographed, placed

from sorvolo.registration.features import (
    FeatureSettings,
    corners,
    gray_from_rgb,
    normalise_contrast,
    orb_features,
    sharpness,
    sift_features,
)

SCENE = ground(1)
GRAY = gray_from_rgb(photographed(SCENE, placed(500, 420), noise=0.5))


@pytest.mark.parametrize(("gain", "offset"), [(0.6, 10), (0.8, -5), (1.3, 0)])
def test_normalised_contrast_forgets_the_exposure(gain, offset):
    changed = np.clip(np.round(GRAY * gain + offset), 0, 255).astype(np.uint8)
    difference = normalise_contrast(changed).astype(float) - normalise_contrast(GRAY)
    assert np.abs(GRAY.astype(float) - changed).mean() > 15
    assert np.abs(difference).mean() < 2.0


def test_normalised_contrast_lifts_sand_and_leaves_noise():
    sand = gray_from_rgb(photographed(ground(2, spread=2.0), placed(500, 420), noise=0.5))
    water = gray_from_rgb(
        photographed(np.full((900, 1200), 90, np.float32), placed(500, 420), noise=0.5)
    )
    assert normalise_contrast(sand).std() > 15
    assert normalise_contrast(water).std() < 15
    assert abs(normalise_contrast(sand).mean() - 128) < 3


@pytest.mark.parametrize(
    ("extract", "side_px", "limit_px"),
    # ORB's points are pixels of a coarser level, which links refine; SIFT's are taken as they are
    [(orb_features, 640, 0.5), (orb_features, 240, 1.0), (sift_features, 640, 0.03)],
)
def test_points_move_with_the_picture(extract, side_px, limit_px):
    settings = FeatureSettings(detection_side_px=side_px)
    gray = normalise_contrast(GRAY)
    found = extract(gray, settings)
    turned = extract(np.ascontiguousarray(gray[::-1, ::-1]), settings)
    assert len(found) > 100
    assert found.points_px.shape == (len(found), 2)
    # seen upside down the same points lie where the picture's own pixels went: no half pixel is lost on the way
    back = [WIDTH - 1, HEIGHT - 1] - turned.points_px
    near = np.linalg.norm(found.points_px[:, None] - back[None], axis=-1).argmin(axis=1)
    offset = found.points_px - back[near]
    close = np.linalg.norm(offset, axis=1) < 2.0
    assert close.mean() > 0.5
    assert np.abs(offset[close].mean(axis=0)).max() < limit_px


def test_kinds_and_descriptors():
    gray = normalise_contrast(GRAY)
    orb, sift = (
        orb_features(gray, FeatureSettings()),
        sift_features(gray, FeatureSettings(sift_count=300)),
    )
    assert (orb.kind, orb.descriptors.dtype, orb.descriptors.shape[1]) == ("orb", np.uint8, 32)
    assert (sift.kind, sift.descriptors.shape[1]) == ("sift", 128)
    assert len(sift) <= 301
    # RootSIFT: the squares of a descriptor add up to one
    assert np.allclose((sift.descriptors**2).sum(axis=1), 1, atol=1e-3)


@pytest.mark.parametrize("extract", [orb_features, sift_features])
def test_nothing_is_found_in_nothing(extract):
    assert len(extract(np.full((HEIGHT, WIDTH), 128, np.uint8), FeatureSettings())) == 0


def test_corners_are_inside_and_spread():
    found = corners(normalise_contrast(GRAY))
    assert (found >= 0).all() and (found <= [WIDTH - 1, HEIGHT - 1]).all()
    assert len({(int(x // 80), int(y // 60)) for x, y in found}) == 36


def test_corners_sit_on_corners():
    board = np.full((HEIGHT, WIDTH), 60, np.uint8)
    board[100:180, 140:260] = 200
    found = corners(board)
    for corner in ([139.5, 99.5], [259.5, 99.5], [259.5, 179.5], [139.5, 179.5]):
        assert np.linalg.norm(found - corner, axis=1).min() < 4.0


def test_sharpness_falls_with_blur_and_not_with_contrast():
    blurred = cv2.GaussianBlur(GRAY, (0, 0), 2.0)
    darker = np.round(GRAY * 0.8).astype(np.uint8)
    assert sharpness(blurred) < 0.5 * sharpness(GRAY)
    assert sharpness(darker) == pytest.approx(sharpness(GRAY), rel=0.15)
