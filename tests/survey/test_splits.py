"""Parts of a labelled set share no video, nor neighbours in time, and follow from the seed."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sorvolo.errors import SettingsError
from sorvolo.lab.datasets.splits import frame_number, hold_out, shared_groups
from sorvolo.survey.labels import LabelledPicture, LabelledSet

NOTHING = np.zeros((0, 4), np.float32)


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
@given(sizes=st.lists(st.integers(20, 60), min_size=8, max_size=30), seed=st.integers(0, 9))
def test_videos_stay_whole_and_nothing_is_lost(sizes, seed):
    whole = videos(*sizes)
    learnt, held, remarks = hold_out(whole, 0.25, seed)
    groups = [{each.group for each in part.pictures} for part in (learnt, held)]
    assert all(groups) and not groups[0] & groups[1] and not remarks
    assert sorted(each.path for part in (learnt, held) for each in part.pictures) == sorted(
        each.path for each in whole.pictures
    )
    assert learnt.unlabelled == held.unlabelled == {"car"}


def test_shares_are_met_as_closely_as_videos_allow():
    assert len(hold_out(videos(*[10] * 50), 0.2, 3)[1]) == 100
    one_large = hold_out(videos(400, *[10] * 20), 0.3, 1)[1]
    assert abs(len(one_large) - 180) <= 10


def test_the_seed_decides_and_the_order_does_not():
    def held_out(source, seed):
        return frozenset(each.group for each in hold_out(source, 0.2, seed)[1].pictures)

    whole = videos(*range(5, 25))
    assert held_out(whole, 1) == held_out(whole.only(whole.pictures[::-1]), 1)
    assert len({held_out(whole, seed) for seed in range(6)}) >= 4


@settings(max_examples=30, deadline=None)
@given(ids=st.sets(st.integers(0, 2000), min_size=60, max_size=300), seed=st.integers(0, 5))
def test_no_neighbours_of_one_video_in_two_parts(ids, seed):
    whole = labelled([(f"0_{each:05d}", "g") for each in sorted(ids)])
    learnt, held, remarks = hold_out(whole, 0.2, seed)
    of = [np.array(sorted(numbers(part))) for part in (learnt, held)]
    gap = min(10, len(ids) // 10 // 2)
    assert np.abs(of[0][:, None] - of[1][None]).min() > gap
    assert "too good" in remarks[0]
    left_out = len(ids) - len(learnt) - len(held)
    assert [each.split()[1] for each in remarks[1:]] == ([str(left_out)] if left_out else [])


def test_numbers_that_come_twice_make_a_sequence_of_each_video():
    whole = labelled(
        [(f"v{video}_{index:04d}", f"v{video}") for video in range(2) for index in range(40)]
    )
    learnt, held, _ = hold_out(whole, 0.1, 1)
    assert len(held) == 8 and len({each.group for each in held.pictures}) == 1
    assert 64 <= len(learnt) <= 68


def test_what_cannot_be_divided_is_learnt_whole():
    for whole, words in (
        (labelled([("one", "a"), ("two", "a")]), "no number in its name"),
        (labelled([("one_1", "a")]), "too few to be divided"),
    ):
        learnt, held, (remark,) = hold_out(whole, 0.2, 1)
        assert len(learnt) == len(whole) and not len(held) and words in remark
    with pytest.raises(SettingsError, match="below 1"):
        hold_out(videos(5, 5), 1.0, 1)


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
