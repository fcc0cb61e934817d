"""Which objects stood on one date alone."""

from dataclasses import replace

import numpy as np
import pytest

from sorvolo.findings.register import SearchedDate, associate, begun_and_ended
from sorvolo.store.site.register import sighting_of
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


Searched = tuple[list[MapObject], SearchedFrames]
"""The objects of a date, and the frames that were searched for them."""


def names(*dates: Searched) -> dict[str, ChangeKind]:
    """What came and left between two dates, by the name of its newest sighting."""
    seen = [
        sighting_of(each, str(k), k) for k, (objects, _) in enumerate(dates) for each in objects
    ]
    looks = [SearchedDate(str(k), k, frames) for k, (_, frames) in enumerate(dates)]
    return {
        each.newest.id: kind for kind, each in begun_and_ended(associate(seen, looks), {"0"}, "1")
    }


def test_what_one_date_shows_alone_appeared_or_disappeared() -> None:
    before = ([car("stays", 10, 10), car("left", 20, 10)], SEARCHED)
    after = ([car("still there", 11, 10.5), car("came", 30, 10)], SEARCHED)
    assert names(before, after) == {"came": ChangeKind.APPEARED, "left": ChangeKind.DISAPPEARED}
    assert names(after, before) == {"came": ChangeKind.DISAPPEARED, "left": ChangeKind.APPEARED}


@pytest.mark.parametrize("frames_m", [np.zeros((0, 4, 2)), FRAMES_M[:1] + 100])
def test_where_the_other_date_was_not_searched_nothing_is_known(frames_m: np.ndarray) -> None:
    after = ([car("came", 30, 10)], SEARCHED)
    assert names(([], SearchedFrames(frames_m)), after) == {}


def test_what_moves_hides_nothing() -> None:
    moves, stands = car("moves", 30, 10, moving=True), car("stands", 30, 10)
    assert names(([moves], SEARCHED), ([stands], SEARCHED))["stands"] is ChangeKind.APPEARED


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
    before = ([person, car("left", 10, 10)], SEARCHED)
    assert names(before, ([], coarse)) == {"left": ChangeKind.DISAPPEARED}
    assert names(before, ([], SEARCHED)) == {
        "person": ChangeKind.DISAPPEARED,
        "left": ChangeKind.DISAPPEARED,
    }
    assert names(([], coarse), before) == {"left": ChangeKind.APPEARED}
    assert looked_at(np.array([[20.0, 10]]), ["truck"], [coarse]).tolist() == [False], (
        "of no name at all"
    )


def test_what_is_longer_may_lie_farther_from_where_it_was() -> None:
    """By its own length and the error of its place; a truck in the place of a car is another thing."""
    parked = ([car("parked", 10, 10)], SEARCHED)
    assert names(parked, ([car("again", 12.2, 10)], SEARCHED)) == {}
    assert len(names(parked, ([car("far", 13.6, 10)], SEARCHED))) == 2
    truck = replace(car("truck", 10, 10), label="truck")
    assert len(names(parked, ([truck], SEARCHED))) == 2
