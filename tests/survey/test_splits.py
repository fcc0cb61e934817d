"""Parts of a labelled set share no video, nor neighbours in time, and follow from the seed."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sorvolo.errors import InputError, SettingsError
from sorvolo.lab.datasets.splits import frame_number, shared_groups, split_by_blocks, split_by_group
from sorvolo.survey.labels import LabelledPicture, LabelledSet

NOTHING = np.zeros((0, 4), np.float32)
SHARES = {"train": 0.7, "val": 0.1, "test": 0.2}


def labelled(names_and_groups, name="set"):
    pictures = [
        LabelledPicture(f"images/{each}.jpg", 64, 64, group, NOTHING, np.zeros(0), NOTHING)
        for each, group in names_and_groups
    ]
    return LabelledSet(name, ("person",), tuple(pictures), frozenset({"car"}))


def videos(*sizes):
    return labelled(
        [
            (f"v{video}_{index:04d}", f"v{video}")
            for video, size in enumerate(sizes)
            for index in range(size)
        ]
    )


def numbers(part):
    return {frame_number(each.path) for each in part.pictures}


@settings(max_examples=40, deadline=None)
@given(sizes=st.lists(st.integers(1, 60), min_size=3, max_size=30), seed=st.integers(0, 9))
def test_groups_stay_whole_and_nothing_is_lost(sizes, seed):
    whole = videos(*sizes)
    parts = split_by_group(whole, SHARES, seed)
    groups = [{each.group for each in part.pictures} for part in parts.values()]
    assert all(groups) and sum(map(len, groups)) == len(set.union(*groups)) == len(sizes)
    assert sorted(each.path for part in parts.values() for each in part.pictures) == sorted(
        each.path for each in whole.pictures
    )
    assert all(part.unlabelled == {"car"} for part in parts.values())


def test_shares_are_met_as_closely_as_videos_allow():
    parts = split_by_group(videos(*[10] * 50), SHARES, 3)
    assert {name: len(part) for name, part in parts.items()} == {
        "train": 350,
        "val": 50,
        "test": 100,
    }
    one_large = split_by_group(videos(400, *[10] * 20), {"train": 0.7, "test": 0.3}, 1)
    assert abs(len(one_large["train"]) - 420) <= 10


def test_the_seed_decides_and_the_order_does_not():
    def held_out(source, seed):
        return frozenset(
            each.group for each in split_by_group(source, SHARES, seed)["test"].pictures
        )

    whole = videos(*range(5, 25))
    assert held_out(whole, 1) == held_out(whole.only(whole.pictures[::-1]), 1)
    assert len({held_out(whole, seed) for seed in range(6)}) >= 4


def test_too_few_videos_and_impossible_shares_are_reported():
    with pytest.raises(InputError, match=r"2 videos cannot make 3 parts.*blocks"):
        split_by_group(videos(5, 5), SHARES)
    for shares in ({}, {"train": 0.5}, {"train": 1.2, "test": -0.2}):
        with pytest.raises(SettingsError, match="sum up to 1"):
            split_by_group(videos(5, 5), shares)


@settings(max_examples=30, deadline=None)
@given(
    ids=st.sets(st.integers(0, 2000), min_size=60, max_size=300),
    seed=st.integers(0, 5),
    gap=st.integers(0, 15),
)
def test_no_neighbours_in_two_parts(ids, seed, gap):
    whole = labelled([(f"0_{each % 7}_{each:05d}", f"g{each % 7}") for each in sorted(ids)])
    parts = split_by_blocks(whole, SHARES, block=15, gap=gap, seed=seed)
    of = {name: np.array(sorted(numbers(part))) for name, part in parts.items()}
    for one, other in (("train", "val"), ("train", "test"), ("val", "test")):
        if len(of[one]) and len(of[other]):
            assert np.abs(of[one][:, None] - of[other][None]).min() > gap
    dropped = sum(note.count for part in parts.values() for note in part.notices)
    assert sum(map(len, parts.values())) + dropped == len(ids)


def test_only_the_larger_part_gives_way_and_only_at_its_borders():
    whole = labelled([(f"f_{each:05d}", "f") for each in range(400)])
    parts = split_by_blocks(whole, {"test": 0.25, "train": 0.75}, block=100, gap=10, seed=2)
    test, train = numbers(parts["test"]), numbers(parts["train"])
    assert len(test) == 100 and max(test) - min(test) == 99
    borders = (min(test) > 0) + (max(test) < 399)
    assert len(train) == 300 - 10 * borders
    assert [(note.code, note.count) for note in parts["train"].notices] == [
        ("left_out_at_borders", 10 * borders)
    ]


def test_numbers_that_come_twice_make_a_sequence_of_each_video():
    whole = labelled(
        [(f"v{video}_{index:04d}", f"v{video}") for video in range(2) for index in range(40)]
    )
    parts = split_by_blocks(whole, {"train": 0.5, "test": 0.5}, block=40, gap=10)
    assert {len(part) for part in parts.values()} == {40}
    assert all(len({each.group for each in part.pictures}) == 1 for part in parts.values())


def test_blocks_need_numbers_and_enough_pictures():
    with pytest.raises(InputError, match="no number in its name"):
        split_by_blocks(labelled([("one", "a"), ("two", "b")]), {"train": 1.0})
    with pytest.raises(InputError, match="smaller blocks"):
        split_by_blocks(videos(50), {"train": 0.5, "test": 0.5}, block=100)
    with pytest.raises(SettingsError, match="block must be"):
        split_by_blocks(videos(50), {"train": 1.0}, block=0)


def test_a_video_in_two_sets_is_warned_of():
    first = labelled([("a_1", "a"), ("b_1", "b")], "learnt")
    second = labelled([("b_2", "b"), ("b_3", "b"), ("c_1", "c")], "measured")
    (note,) = shared_groups(first, second)
    assert note.count == 2 and "(b) lie in both learnt and measured" in note.text
    assert shared_groups(first, labelled([("c_1", "c")])) == ()


@pytest.mark.parametrize(
    "name, number",
    [
        ("1_130_40_0_03855.jpg", 3855),
        ("bb_V0014_I0003160_jpg.rf.9a81.jpg", 3160),
        ("Drone2_(90).jpg", 90),
        ("x.jpg", None),
        ("clip3/frames/12.png", 12),
        ("DJI-00760-00001.jpg", 1),
    ],
)
def test_frame_numbers(name, number):
    assert frame_number(name) == number
