"""How far things reach: their faint parts belong to them, halos of light and soft shadows do not."""

import cv2
import numpy as np
import pytest
from sensor_noise import camera

from sorvolo.change.regions import Regions
from sorvolo.change.robust import RobustResult, compare_robust, with_weak_ground

SIZE = (360, 480)
THING = np.zeros(SIZE, bool)
THING[160:200, 240:300] = True


def plain(level: int = 120) -> np.ndarray:
    return np.full((*SIZE, 3), level, np.uint8)


def street() -> np.ndarray:
    """A plain street between rough ground."""
    rough = cv2.resize(
        np.random.default_rng(7).normal(0, 25, (180, 240)).astype(np.float32), SIZE[::-1]
    )
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
    ((x, y, width, high),) = result.boxes
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


def test_weak_ground_that_joins_two_regions_belongs_to_the_nearest_and_ends() -> None:
    """A doubted region along a cloud's edge, weakly joined with a sure box, gave the box all of that edge before."""
    labels, weak = np.zeros((180, 400), np.uint8), np.zeros((180, 400), np.uint8)
    weak[80:100, 20:390] = 255
    labels[84:96, 40:52] = 1
    labels[84:96, 120:200] = 2
    boxes = np.array([[40, 84, 12, 12], [120, 84, 80, 12]], np.int32)
    regions = Regions(labels, boxes, np.zeros((2, 0)), weak // 16, weak, 6.0, None, np.ones(2))

    def columns(region: int) -> tuple[int, int]:
        piece = with_weak_ground(regions, region, 20)
        assert not (piece.mask & (labels[piece.window] == 2 - region)).any()
        x, _, wide, _ = piece.box
        return x, x + wide

    # its own end less a rim of blur, half of the way to the neighbour; as far as things are looked for
    assert columns(0) == (22, 78)
    first, last = columns(1)
    assert abs(first - 86) <= 1 and last == 260
