"""What is measured of regions: signs that distinguish a thing from light, and outlines to a part of a pixel."""

import cv2
import numpy as np
import pytest
from sensor_noise import camera

from sorvolo.change.regions import FEATURES
from sorvolo.change.robust import compare_robust, examine


def signs(reference: np.ndarray, query: np.ndarray) -> dict[str, float]:
    """The features of the largest region that differs."""
    regions, *_ = examine(reference, query, None)
    assert len(regions.boxes)
    return dict(zip(FEATURES, regions.features[np.argmax(regions.features[:, 0])]))


def test_a_shadow_keeps_the_structure_of_its_ground_and_a_thing_hides_it(
    ground: np.ndarray,
) -> None:
    shaded, covered = ground.copy(), ground.copy()
    narrow = np.s_[140:156, 180:280]  # wide ones are taken for light
    shaded[narrow] = (shaded[narrow] * 0.5).astype(np.uint8)
    other = np.random.default_rng(8).normal(0, 1, (60, 100)).astype(np.float32)
    covered[narrow] = (60 + 40 * cv2.GaussianBlur(other, (0, 0), 2)[:16, :, None]).astype(np.uint8)
    shadow, thing = (signs(camera(ground, 1), camera(each, 2)) for each in (shaded, covered))
    assert shadow["structure kept"] > thing["structure kept"] + 0.3


def test_a_things_rim_is_sharp_and_a_clouds_is_not(ground: np.ndarray) -> None:
    flat = cv2.GaussianBlur(ground, (0, 0), 15)
    cover = np.zeros(flat.shape[:2], np.float32)
    cv2.rectangle(cover, (200, 150), (239, 189), 1.0, -1)
    sharp, soft = (
        signs(camera(flat, 1), camera(flat * (1 - 0.5 * each[..., None]), 2))
        for each in (cover, cv2.GaussianBlur(cover, (0, 0), 12))
    )
    assert sharp["rim light"] > 2 * soft["rim light"]


def test_wind_over_a_smooth_lawn_is_no_change_and_hides_no_thing() -> None:
    lawn = np.full((360, 480, 3), (105, 185, 95), np.uint8)
    noise = cv2.resize(
        np.random.default_rng(4).normal(0, 1, (72, 96)).astype(np.float32),
        (480, 360),
        interpolation=cv2.INTER_CUBIC,
    )
    waved = lawn * (1 + 0.06 * noise[..., None])
    assert not compare_robust(camera(lawn, 1), camera(waved, 2)).mask.any()
    waved[150:178, 200:244] = (60, 60, 200)
    mask = compare_robust(camera(lawn, 1), camera(waved, 2)).mask > 0
    truth = np.zeros_like(mask)
    truth[150:178, 200:244] = True
    assert (mask & truth).sum() > 0.9 * (mask | truth).sum()


@pytest.mark.parametrize("shift", [0, 1, 2, 3])
def test_outlines_run_along_things_to_a_part_of_a_pixel(ground: np.ndarray, shift: int) -> None:
    truth = np.zeros(ground.shape[:2], bool)
    truth[150 + shift : 171 + shift, 200 + shift : 237 + shift] = True
    changed = ground.copy()
    changed[truth] = (190, 60, 40)
    mask = compare_robust(camera(ground, 1), camera(changed, 2)).mask > 0
    around_px = 2 * (21 + 37)
    assert (mask != truth).sum() < 0.75 * around_px


@pytest.mark.parametrize("size", [(96, 128), (97, 129)])
def test_a_thing_at_the_picture_rim_keeps_its_place(size: tuple[int, int]) -> None:
    flat = np.full((*size, 3), 120, np.uint8)
    changed = flat.copy()
    changed[-30:, -40:] = (20, 40, 200)
    mask = compare_robust(camera(flat, 1), camera(changed, 2)).mask > 0
    truth = (changed != flat).any(axis=2)
    assert (mask & truth).sum() > 0.85 * (mask | truth).sum()
