"""How far things reach: their faint parts belong to them, halos of light and soft shadows do not."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sensor_noise import camera

from sorvolo.change.pair.illumination import fit_light, light_around, relit, relit_parts
from sorvolo.change.pair.region_extent import Views, _moved, _strength, _widened
from sorvolo.change.pair.regions import RegionSettings
from sorvolo.change.pair.robust import RobustResult, compare_robust

SIZE = (360, 480)
THING = np.zeros(SIZE, bool)
THING[160:200, 240:300] = True


def plain(level: int = 120) -> np.ndarray:
    return np.full((*SIZE, 3), level, np.uint8)


def street() -> np.ndarray:
    """A plain street between rough ground."""
    rough = cv2.resize(np.random.default_rng(7).normal(0, 25, (180, 240)).astype(np.float32), SIZE[::-1])
    rough[90:270] = 0
    return np.clip(150 + rough[..., None] + np.zeros(3), 0, 255).astype(np.uint8)


def disc(centre: tuple[int, int], radius: int) -> np.ndarray:
    return cv2.circle(np.zeros(SIZE, np.uint8), centre, radius, 1, -1) > 0


def cloud(x_px: float, soft_px: float, depth: float) -> np.ndarray:
    """(h, w, 1) what a cloud's shadow over the right part leaves of the light."""
    right = np.repeat((np.arange(SIZE[1]) > x_px)[None].astype(np.float32), SIZE[0], axis=0)
    return 1 - depth * cv2.GaussianBlur(right, (0, 0), soft_px)[..., None]


CLOUD = cloud(235, 14, 0.45)


def overlap(mask: np.ndarray, truth: np.ndarray) -> float:
    return float((truth & (mask > 0)).sum() / (truth | (mask > 0)).sum())


def compared(before: np.ndarray, after: np.ndarray) -> RobustResult:
    return compare_robust(camera(before, 1), camera(after, 2))


@pytest.mark.parametrize("came", [True, False])
def test_a_faint_plate_around_a_bright_middle_is_part_of_the_thing(came: bool) -> None:
    truth = disc((240, 180), 26)
    with_thing = plain()
    with_thing[truth] = 148
    with_thing[disc((240, 180), 8)] = (40, 200, 60)
    pictures = (plain(), with_thing) if came else (with_thing, plain())
    result = compared(*pictures)
    assert overlap(result.mask, truth) > 0.8
    (x, y, width, high), = result.boxes
    assert (abs(np.array([x, y, x + width, y + high]) - [214, 154, 267, 207]) <= 6).all()


def test_a_halo_at_a_clouds_rim_is_no_part_of_the_thing() -> None:
    changed = street()
    changed[THING] = (60, 180, 90)
    result = compared(street() * CLOUD, changed)
    assert overlap(result.mask, THING) > 0.85


def test_a_soft_shadow_is_no_part_of_the_thing() -> None:
    shade = np.zeros(SIZE, np.float32)
    shade[170:222, 230:322] = 0.2
    changed = plain(150) * (1 - cv2.GaussianBlur(shade, (0, 0), 2)[..., None])
    changed[THING] = (60, 60, 220)
    assert overlap(compared(plain(150), changed).mask, THING) > 0.8


def test_the_light_beside_a_thing_is_that_of_the_plain_ground_there() -> None:
    changed = street()
    changed[THING] = (60, 180, 90)
    light = fit_light(camera(street() * CLOUD, 1), camera(changed, 2))
    around = light_around(light, THING * np.uint8(255))
    size = light.gains.shape[1::-1]
    cells = cv2.resize(CLOUD[..., 0], size, interpolation=cv2.INTER_AREA)
    beside = cv2.resize(cv2.dilate(THING.view(np.uint8), np.ones((97, 97), np.uint8)), size) > 0
    beside &= cv2.resize(cv2.dilate(THING.view(np.uint8), np.ones((33, 33), np.uint8)), size) == 0
    off = [np.abs(np.log2(each.gains[..., 1] * each.brightness[1] * cells))[beside].mean() for each in (light, around)]
    assert off[1] < 0.75 * off[0]
    assert light_around(around, np.zeros(SIZE, np.uint8)) is around


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 60), st.integers(0, 80), st.integers(1, 3), st.integers(0, 2**32 - 1))
def test_parts_lit_and_compared_alone_are_those_of_the_whole(top: int, left: int, reach_px: int, seed: int) -> None:
    before, after = (np.random.default_rng(seed + k).integers(0, 256, (72, 96, 3), np.uint8) for k in range(2))
    light = fit_light(before, after)
    views = Views(before, after, before, None, RegionSettings(reach_px=reach_px))
    place = np.s_[5:70, 0:90]
    window = np.s_[max(top, 5) : top + 10, left : left + 10]
    wide = _widened(window, place, reach_px + 2)
    whole = _strength(relit(before, light), views, place)
    alone = _strength(relit_parts(before, light, [wide]), views, wide)
    np.testing.assert_array_equal(alone[_moved(window, wide)], whole[_moved(window, place)])
