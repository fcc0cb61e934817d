"""Which objects stood on one date alone."""

from dataclasses import replace

import numpy as np
import pytest

from sorvolo.change.reconcile import SearchedGround, on_one_date
from sorvolo.survey.findings import ChangeKind
from sorvolo.survey.map_objects import MapObject, SearchedFrames, looked_at

FRAMES_M = np.array([[[0.0, 0.0], [40, 0], [40, 30], [0, 30]]] * 3)
SEARCHED = SearchedFrames(FRAMES_M)


def car(
    name: str, east_m: float, north_m: float, *, length_m: float = 4.5, moving: bool = False
) -> MapObject:
    return MapObject(
        name,
        "car",
        0.9,
        np.array([east_m, north_m]),
        0.3,
        length_m,
        1.8,
        3,
        3,
        0,
        9,
        moving=moving,
    )


def names(before: SearchedGround, after: SearchedGround) -> dict[str, ChangeKind]:
    return {each.id: kind for kind, each in on_one_date(before, after)}


def test_what_one_date_shows_alone_appeared_or_disappeared() -> None:
    before = SearchedGround([car("stays", 10, 10), car("left", 20, 10)], [SEARCHED])
    after = SearchedGround([car("still there", 11, 10.5), car("came", 30, 10)], [SEARCHED])
    assert names(before, after) == {"came": ChangeKind.APPEARED, "left": ChangeKind.DISAPPEARED}
    assert names(after, before) == {"came": ChangeKind.DISAPPEARED, "left": ChangeKind.APPEARED}


@pytest.mark.parametrize("frames_m", [np.zeros((0, 4, 2)), FRAMES_M[:1] + 100])
def test_where_the_other_date_was_not_searched_nothing_is_known(frames_m: np.ndarray) -> None:
    after = SearchedGround([car("came", 30, 10)], [SEARCHED])
    assert names(SearchedGround([], [SearchedFrames(frames_m)]), after) == {}


def test_what_moves_or_has_no_size_is_left_out_and_hides_nothing() -> None:
    moves, sizeless = car("moves", 30, 10, moving=True), car("sizeless", 20, 10, length_m=np.nan)
    assert (
        names(SearchedGround([], [SEARCHED]), SearchedGround([moves, sizeless], [SEARCHED])) == {}
    )
    stands = car("stands", 30, 10)
    assert names(SearchedGround([moves], [SEARCHED]), SearchedGround([stands], [SEARCHED])) == {
        "stands": ChangeKind.APPEARED
    }


def test_two_frames_must_show_a_place_and_one_is_enough_where_there_is_only_one() -> None:
    places_m = np.array([[5.0, 5], [50, 5], [35, 5]])
    beside_m = FRAMES_M[:1] + np.array([30.0, 0])
    cars = ["car"] * 3
    two, one = (
        SearchedFrames(np.concatenate([FRAMES_M[:1], beside_m])),
        SearchedFrames(FRAMES_M[:1]),
    )
    assert looked_at(places_m, cars, [two]).tolist() == [False, False, True]
    assert looked_at(places_m, cars, [one]).tolist() == [True, False, True]
    assert looked_at(places_m, cars, [one, SearchedFrames(beside_m)]).tolist() == [
        False,
        False,
        True,
    ]
    assert looked_at(places_m, cars, [SearchedFrames(np.zeros((0, 4, 2)))]).tolist() == [
        False,
        False,
        False,
    ]


def test_a_class_that_was_not_looked_for_is_not_gone() -> None:
    everywhere, nowhere = np.ones(3, bool), np.zeros(3, bool)
    coarse = SearchedFrames(FRAMES_M, {"car": everywhere, "person": nowhere})
    person = replace(car("person", 20, 10, length_m=1.7), label="person")
    before = SearchedGround([person, car("left", 10, 10)], [SEARCHED])
    assert names(before, SearchedGround([], [coarse])) == {"left": ChangeKind.DISAPPEARED}
    assert names(before, SearchedGround([], [SEARCHED])) == {
        "person": ChangeKind.DISAPPEARED,
        "left": ChangeKind.DISAPPEARED,
    }
    assert names(SearchedGround([], [coarse]), before) == {"left": ChangeKind.APPEARED}
    assert looked_at(np.array([[20.0, 10]]), ["truck"], [coarse]).tolist() == [False], (
        "of no name at all"
    )


def test_what_is_longer_may_lie_farther_from_where_it_was() -> None:
    assert car("again", 12.2, 10).stands_where(car("parked", 10, 10))
    assert not car("short", 12.2, 10, length_m=1.7).stands_where(car("parked", 10, 10))
    assert not car("moves", 10, 10, moving=True).stands_where(car("parked", 10, 10))
