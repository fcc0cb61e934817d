"""What no view shows surely and all views show together; learned features beside what unchanged ground differs by."""

import cv2
import numpy as np
import pytest

from sorvolo.change.areas.gathered_things import GatheredThings
from sorvolo.change.pair.learned_difference import learned_difference
from sorvolo.geometry.arrays import ImageRGB
from sorvolo.survey.findings import Change, ChangeKind, ComparedView, Shade

M_PER_PX = 0.1
VIEW_PX = 352, 256
AT = np.s_[150:186, 210:260]  # 5 x 3.6 m
BOX_M = (21.0, 26.0, -18.6, -15.0)  # west, east, south, north


@pytest.fixture(scope="module")
def ground() -> ImageRGB:
    """64 x 48 m of soil, driven over."""
    rng = np.random.default_rng(4)
    return soil(rng, 110.0, (480, 640))


def soil(rng: np.random.Generator, level: float, shape: tuple[int, int]) -> ImageRGB:
    fine, coarse = (
        cv2.resize(rng.normal(0, 1, (shape[0] // step, shape[1] // step)).astype(np.float32), shape[::-1])
        for step in (2, 16)
    )
    gray = level + 14 * fine + 12 * coarse
    return np.clip(np.dstack([gray + 12, gray, gray - 14]), 0, 255).astype(np.uint8)


def with_car(ground: ImageRGB) -> ImageRGB:
    """A car of the ground's own brightness."""
    shown = ground.copy()
    shown[AT] = 112
    shown[AT][4:-4, 12:20] = shown[AT][4:-4, 34:42] = (70, 74, 80)
    return shown


def test_features_differ_where_a_thing_of_the_grounds_brightness_stands_and_not_by_light_or_noise(ground):
    rng = np.random.default_rng(5)
    later = np.clip(0.8 * with_car(ground) + rng.normal(0, 4, ground.shape), 0, 255).astype(np.uint8)
    known = np.ones(ground.shape[:2], bool)
    known[:, 560:] = False
    apart = learned_difference(ground, later, known)
    assert apart.shape == known.shape and not apart[~known].any()
    assert apart[AT].mean() > 1.2
    elsewhere = known.copy()
    elsewhere[130:206, 190:280] = False
    assert np.percentile(apart[elsewhere], 99) < 0.6


def test_where_hardly_anything_is_known_nothing_is_reported(ground):
    known = np.zeros(ground.shape[:2], bool)
    known[:20, :20] = True
    assert not learned_difference(ground, with_car(ground), known).any()


def gathered(before: ImageRGB, after: ImageRGB, views: int, shade: int = 0) -> GatheredThings:
    things, rng = GatheredThings(), np.random.default_rng(3)
    for index in range(views):
        x, y = 32 * index, 24 * index
        part = np.s_[y : y + VIEW_PX[1], x : x + VIEW_PX[0]]
        noisy = np.clip(after[part] + rng.normal(0, 3, (*VIEW_PX[::-1], 3)), 0, 255).astype(np.uint8)
        site_from_image = np.array([[M_PER_PX, 0, x * M_PER_PX], [0, -M_PER_PX, -y * M_PER_PX], [0, 0, 1.0]])
        nothing = np.zeros(VIEW_PX[::-1], np.uint8)
        things.add(ComparedView(
            index, f"{index}", index * 10**9, site_from_image, np.array([x * M_PER_PX, -y * M_PER_PX, 40.0]), noisy,
            before[part].copy(), np.ones(VIEW_PX[::-1], bool), nothing, np.zeros((0, 4), np.int64), np.zeros(0), 0.4,
            nothing + np.uint8(shade),
        ))
    return things


def test_a_thing_that_no_view_flags_is_reported_with_its_place_and_once(ground):
    things = gathered(ground, with_car(ground), 4)
    (change,) = things.conclude("b", 7, [])
    assert change.id == "b-7" and change.kind is ChangeKind.APPEARED and change.views == 4
    west, east, south, north = BOX_M
    assert np.hypot(*(middle_of(change) - [(west + east) / 2, (south + north) / 2])) < 0.7
    assert 0.5 < change.area_m2 / ((east - west) * (north - south)) < 1.8
    assert change.patch.after[..., 3].any() and 0.3 < change.score <= 1
    assert things.conclude("b", 8, [change]) == []


def test_what_one_view_alone_shows_is_confirmed_where_it_lies_apart_and_not_as_a_shadow_or_twice_seen(ground):
    west, east, south, north = BOX_M
    box_m = np.array([[west, south], [east, south], [east, north], [west, north]])
    assert gathered(ground, with_car(ground), 1).shows_once(box_m)
    assert not gathered(ground, with_car(ground), 1).shows_once(box_m - [0, 9])  # unchanged ground
    assert not gathered(ground, with_car(ground), 1, shade=Shade.LATER_DARK).shows_once(box_m)
    assert not gathered(ground, with_car(ground), 2).shows_once(box_m)
    assert not gathered(ground, ground, 0).shows_once(box_m)


def middle_of(change: Change) -> np.ndarray:
    return (change.outline_m.min(axis=0) + change.outline_m.max(axis=0)) / 2


@pytest.mark.parametrize("views, shade", [(1, 0), (4, 0xFF)])
def test_what_one_view_shows_or_may_be_a_shadow_is_not_reported(ground, views, shade):
    assert gathered(ground, with_car(ground), views, shade).conclude("b", 1, []) == []


def test_unchanged_ground_in_another_light_and_no_flight_at_all_give_nothing(ground):
    assert gathered(ground, (0.7 * ground).astype(np.uint8), 4).conclude("b", 1, []) == []
    assert GatheredThings().conclude("b", 1, []) == []
