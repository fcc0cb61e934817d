"""Whether a frame is thermal, and raw heat made visible."""

import cv2
import numpy as np
import pytest

from real_data import real_data
from sorvolo.detection.light import is_thermal, rgb_from_picture


@pytest.fixture
def heat() -> np.ndarray:
    return cv2.GaussianBlur(
        np.random.default_rng(3).uniform(0, 255, (120, 160)).astype(np.uint8), (0, 0), 4
    )


def test_grey_is_thermal_in_either_polarity_and_through_a_video(heat: np.ndarray) -> None:
    for grey in (heat, 255 - heat):
        assert is_thermal(grey) and is_thermal(grey[:, :, None])
        three = np.repeat(grey[:, :, None], 3, axis=2)
        assert is_thermal(three) and is_thermal(three.astype(np.uint16) * 257)
        chroma = cv2.cvtColor(three, cv2.COLOR_RGB2YCrCb)
        chroma[..., 1:] += (
            np.random.default_rng(0).integers(-1, 2, chroma[..., 1:].shape).astype(np.uint8)
        )
        assert is_thermal(cv2.cvtColor(chroma, cv2.COLOR_YCrCb2RGB))


def test_a_little_colour_is_daylight(heat: np.ndarray) -> None:
    sea = np.repeat(heat[:, :, None], 3, axis=2)
    sea[50:60, 50:60] = (200, 40, 40)
    assert is_thermal(sea), "a coloured mark as cameras draw it, under one per cent"
    sea[40:70, 40:70] = (200, 40, 40)
    assert not is_thermal(sea)


def test_sixteen_bits_of_heat_fill_eight(heat: np.ndarray) -> None:
    raw = (7000 + 4 * heat.astype(np.uint16)).astype(np.uint16)
    rgb = rgb_from_picture(raw)
    assert rgb.dtype == np.uint8 and rgb.shape == (120, 160, 3)
    assert rgb.min() == 0 and rgb.max() == 255
    assert np.corrcoef(rgb[..., 0].ravel(), heat.ravel())[0, 1] > 0.99


def test_one_temperature_stays_even() -> None:
    raw = (7000 + np.random.default_rng(0).integers(-2, 3, (64, 64))).astype(np.uint16)
    assert np.ptp(rgb_from_picture(raw)) < 20


def test_a_dead_pixel_does_not_darken_the_frame(heat: np.ndarray) -> None:
    raw = 7000 + heat.astype(np.uint16)
    dead = raw.copy()
    dead[5, 5], dead[6, 6] = 0, 65535
    difference = np.abs(rgb_from_picture(dead).astype(int) - rgb_from_picture(raw))
    assert np.median(difference) < 3


def test_real_pictures() -> None:
    for folder, expected in (
        ("hituav", True),
        ("sdd", False),
        ("tinyperson", False),
        ("cats", False),
    ):
        paths = sorted(real_data(f"detection/{folder}/images").rglob("*.*"))
        for path in paths[:: max(1, len(paths) // 8)]:
            picture = cv2.cvtColor(cv2.imread(str(path)), cv2.COLOR_BGR2RGB)
            assert is_thermal(picture) is expected, path.name
