"""What no view shows surely and all views show together; learned features beside what unchanged ground differs by."""

from dataclasses import replace
from itertools import count

import cv2
import numpy as np
import pytest

from sorvolo.change.gathered import GatheredThings
from sorvolo.change.learned import learned_difference
from sorvolo.change.things import without_shadow
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
        cv2.resize(
            rng.normal(0, 1, (shape[0] // step, shape[1] // step)).astype(np.float32), shape[::-1]
        )
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


def test_features_differ_where_a_thing_of_the_grounds_brightness_stands_and_not_by_light_or_noise(
    ground,
):
    rng = np.random.default_rng(5)
    later = np.clip(0.8 * with_car(ground) + rng.normal(0, 4, ground.shape), 0, 255).astype(
        np.uint8
    )
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


def gathered(
    before: ImageRGB, after: ImageRGB, views: int, shade: int | np.ndarray = 0, shrunk: int = 1
) -> GatheredThings:
    """What some views show together, each `shrunk` times smaller and looked at as much larger."""
    things, rng = GatheredThings(float(shrunk)), np.random.default_rng(3)
    size_px = VIEW_PX[0] // shrunk, VIEW_PX[1] // shrunk
    small_from_view = np.array(
        [[1 / shrunk, 0, 0.5 / shrunk - 0.5], [0, 1 / shrunk, 0.5 / shrunk - 0.5], [0, 0, 1]]
    )
    for index in range(views):
        x, y = 32 * index, 24 * index
        part = np.s_[y : y + VIEW_PX[1], x : x + VIEW_PX[0]]
        noisy = np.clip(after[part] + rng.normal(0, 3, (*VIEW_PX[::-1], 3)), 0, 255).astype(
            np.uint8
        )
        site_from_image = np.array(
            [[M_PER_PX, 0, x * M_PER_PX], [0, -M_PER_PX, -y * M_PER_PX], [0, 0, 1.0]]
        )
        nothing = np.zeros(size_px[::-1], np.uint8)
        image, reference = (
            np.asarray(cv2.resize(each, size_px, interpolation=cv2.INTER_AREA), np.uint8)
            for each in (noisy, before[part])
        )
        things.add(
            ComparedView(
                index,
                f"{index}",
                index * 10**9,
                site_from_image @ np.linalg.inv(small_from_view),
                np.array([x * M_PER_PX, -y * M_PER_PX, 40.0]),
                image,
                reference,
                nothing == 0,
                nothing,
                np.zeros((0, 4), np.int64),
                np.zeros(0),
                0.4,
                nothing
                + np.broadcast_to(np.uint8(shade), before.shape[:2])[part][::shrunk, ::shrunk],
            )
        )
    return things


@pytest.mark.parametrize("shrunk", [1, 2])
def test_a_thing_that_no_view_flags_is_reported_with_its_place_and_once(ground, shrunk):
    things = gathered(ground, with_car(ground), 4, shrunk=shrunk)
    (change,) = things.conclude("b", count(7), [])
    assert change.id == "b-7" and change.kind is ChangeKind.APPEARED and change.views == 4
    west, east, south, north = BOX_M
    assert np.hypot(*(middle_of(change) - [(west + east) / 2, (south + north) / 2])) < 0.7
    assert 0.5 < change.area_m2 / ((east - west) * (north - south)) < 1.8
    assert change.patch.after[..., 3].any() and 0.3 < change.score <= 1


def moved(change: Change, east_m: float, north_m: float, kind: ChangeKind, name: str) -> Change:
    return replace(
        change, id=name, kind=kind, outline_m=change.outline_m + np.array([east_m, north_m])
    )


def test_a_thing_that_was_announced_goes_on_with_its_id_and_times_and_is_reported_once(ground):
    things = gathered(ground, with_car(ground), 4)
    (thing,) = things.conclude("b", count(7), [])
    a_part = replace(
        moved(thing, 0, 0, ChangeKind.REPLACED, "b-3"),
        announced_ns=5,
        first_seen_ns=2,
        last_seen_ns=9,
        outline_m=thing.outline_m.mean(axis=0)
        + 0.8 * (thing.outline_m - thing.outline_m.mean(axis=0)),
    )
    square_m = np.array([[0, 0], [0.6, 0], [0.6, -0.6], [0, -0.6]])
    corner = replace(a_part, id="b-2", outline_m=thing.outline_m.mean(axis=0) + square_m)
    for others in ([a_part, corner], [corner, a_part]):
        (one,) = things.conclude("b", count(8), others)
        assert one.id == "b-3" and one.kind is ChangeKind.APPEARED
        assert (one.announced_ns, one.first_seen_ns, one.last_seen_ns) == (5, 2, 9)
        assert np.array_equal(one.outline_m, thing.outline_m)


def test_other_changes_stay_but_where_features_hold_the_ground_for_the_same(ground):
    things = gathered(ground, with_car(ground), 4)
    (thing,) = things.conclude("b", count(7), [])
    same = moved(thing, 0, 9, ChangeKind.APPEARED, "b-1")
    unseen = moved(thing, -90, 0, ChangeKind.APPEARED, "b-2")
    moves = moved(thing, 0, 9, ChangeKind.MOVING, "b-3")
    area = moved(thing, 0, 0, ChangeKind.AREA, "b-4")
    beside = moved(thing, 3.2, 0, ChangeKind.APPEARED, "b-5")  # the thing is a quarter of it
    concluded = {
        each.id for each in things.conclude("b", count(8), [same, unseen, moves, area, beside])
    }
    assert concluded == {"b-2", "b-3", "b-4", "b-5", "b-8"}
    assert GatheredThings().conclude("b", count(1), [same]) == [same]


def test_what_one_view_alone_shows_is_confirmed_where_it_lies_apart_and_not_as_a_shadow_or_twice_seen(
    ground,
):
    west, east, south, north = BOX_M
    box_m = np.array([[west, south], [east, south], [east, north], [west, north]])
    assert gathered(ground, with_car(ground), 1).shows_once(box_m)
    assert not gathered(ground, with_car(ground), 1).shows_once(box_m - [0, 9])  # unchanged ground
    assert not gathered(ground, with_car(ground), 1, shade=Shade.LATER_DARK).shows_once(box_m)
    assert not gathered(ground, with_car(ground), 2).shows_once(box_m)
    assert not gathered(ground, ground, 0).shows_once(box_m)


def test_a_thing_within_an_area_lies_apart_and_unchanged_ground_or_none_does_not(ground):
    west, east, south, north = BOX_M
    box_m = np.array([[west, south], [east, south], [east, north], [west, north]])
    things = gathered(ground, with_car(ground), 3)
    assert things.lies_apart(box_m)
    assert not things.lies_apart(box_m - [0, 9]) and not things.lies_apart(box_m - [-90, 0])
    assert not gathered(ground, ground, 0).lies_apart(box_m)


def test_an_object_of_one_date_is_a_change_where_the_ground_differs_and_no_other_change_holds_it(
    ground,
):
    west, east, south, north = BOX_M
    place_m = np.array([(west + east) / 2, (south + north) / 2])
    things = gathered(ground, with_car(ground), 3)
    change = things.standing_at(place_m, 5.0, [])
    assert change is not None and np.hypot(*(middle_of(change) - place_m)) < 0.8
    assert 0.4 < change.area_m2 / ((east - west) * (north - south)) < 1.8
    dark = gathered(ground, with_car(ground), 3, shade=Shade.LATER).standing_at(place_m, 5.0, [])
    assert dark is not None and without_shadow(dark).area_m2 > 0.9 * dark.area_m2
    (known,) = things.conclude("b", count(1), [])
    assert things.standing_at(place_m, 5.0, [known]) is None
    assert things.standing_at(place_m, 5.0, [replace(known, kind=ChangeKind.AREA)]) is not None
    assert things.standing_at(place_m - [0, 9], 5.0, []) is None, "the same ground"
    assert things.standing_at(place_m - [90, 0], 5.0, []) is None, "never seen"
    assert gathered(ground, with_car(ground), 1).standing_at(place_m, 5.0, []) is None, (
        "seen by one view"
    )
    assert GatheredThings().standing_at(place_m, 5.0, []) is None


def middle_of(change: Change) -> np.ndarray:
    return (change.outline_m.min(axis=0) + change.outline_m.max(axis=0)) / 2


@pytest.mark.parametrize("views, shade", [(1, 0), (4, 0xFF)])
def test_what_one_view_shows_or_may_be_a_shadow_is_not_reported(ground, views, shade):
    assert gathered(ground, with_car(ground), views, shade).conclude("b", count(1), []) == []


def test_unchanged_ground_in_another_light_and_no_flight_at_all_give_nothing(ground):
    assert gathered(ground, (0.7 * ground).astype(np.uint8), 4).conclude("b", count(1), []) == []
    assert GatheredThings().conclude("b", count(1), []) == []
