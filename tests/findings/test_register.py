"""The register: one thing on the ground is one finding, whatever missions saw it and in which order."""

import time
from dataclasses import replace
from itertools import chain

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from sorvolo.findings.importance import between, grouped, in_short, ordered
from sorvolo.findings.register import (
    GroundFinding,
    KnownBy,
    MissionSighting,
    Register,
    SearchedDate,
    associate,
    untold,
)
from sorvolo.survey.findings import ChangeFacts, ChangeKind
from sorvolo.survey.map_objects import SearchedFrames

DAY_NS = 86_400 * 10**9
EVERYWHERE = SearchedFrames(np.array([[[-99, 99], [99, 99], [99, -99], [-99, -99]]] * 2, float))


def sighting(
    day: int,
    mission: str,
    east_m: float,
    north_m: float = 0.0,
    label: str = "car",
    **others: object,
) -> MissionSighting:
    """A car that stands, seen for ten seconds of a day's flight."""
    start_ns = (day + 1) * DAY_NS
    length_m = 4.4 if label == "car" else 0.6
    plain = MissionSighting(
        f"flight{day}",
        day,
        f"{mission}{day}",
        f"{mission}{day}-{east_m:.3f}",
        KnownBy.DETECTED,
        label,
        0.8,
        np.array([east_m, north_m]),
        0.2,
        length_m,
        start_ns,
        start_ns + 10**10,
    )
    return replace(plain, **others)


def look(day: int) -> SearchedDate:
    """Two frames of a day's flight that show everything."""
    return SearchedDate(f"flight{day}", day, EVERYWHERE)


def shown(register: Register) -> list[tuple[object, ...]]:
    """All that a register states of its findings."""
    return [
        (each.id, each.label, each.dates, each.gone, len(each.sightings))
        for each in register.findings
    ]


def test_all_missions_of_two_dates_see_each_thing_once() -> None:
    """A map, two watches and a comparison: rows are things, and the interval of each begins and ends by looks."""
    cars = [0.0, 6.0, 12.0, 30.0]
    seen = [
        sighting(0, mission, east_m + shift_m)
        for mission, shift_m in (("map", 0.0), ("watch", 0.4))
        for east_m in cars
    ]
    seen += [sighting(0, "map", 40.0, label="person"), sighting(0, "watch", 40.3, label="person")]
    seen += [sighting(1, "compare", east_m) for east_m in cars[:3]]
    seen += [sighting(1, "watch", east_m - 0.3) for east_m in cars[:3]]
    seen += [sighting(1, "compare", 50.0, label="person")]
    register = associate(seen, [look(0), look(1)])
    for day, count in ((0, 4), (1, 3)):
        labels = [each.label for each in register.findings if f"flight{day}" in each.dates]
        assert (labels.count("car"), labels.count("person")) == (count, 1)
    gone = [each for each in register.findings if each.gone]
    assert [(each.label, each.gone) for each in gone] == [("car", "flight1"), ("person", "flight1")]
    assert [each.gone for each in register.findings].count("") == 4
    assert between(register, "flight0", "flight1") == "1 person came, 1 left; 1 car left"
    unsearched = associate([], [look(0)])
    assert "no objects were searched for on flight1" in between(unsearched, "flight0", "flight1")
    assert [each.label for each in ordered(register.findings)] == ["person"] * 2 + ["car"] * 4


def test_silence_is_no_absence() -> None:
    """A date whose flight did not look there states nothing; one whose comparison saw it leave does."""
    seen = [sighting(0, "map", 0.0), sighting(1, "map", 60.0)]
    (first, _) = associate(seen).findings
    assert not first.gone
    left = sighting(0, "left", 0.1, order=1.0, gone="flight1", origin=KnownBy.CHANGED)
    (first, _) = associate([*seen, left]).findings
    assert first.gone == "flight1" and len(first.sightings) == 2
    left = replace(sighting(1, "left", 0.1, order=2.0, gone="flight2"), origin=KnownBy.CHANGED)
    (first, _) = associate([*seen, left]).findings  # from a map whose newest flight was elsewhere
    assert (first.dates, first.gone) == (("flight0",), "flight2")
    assert (first.first_ns, first.last_ns) == (seen[0].first_ns, seen[0].last_ns)


def test_looks_from_above_neither_miss_nor_bring_what_lies_under_trees() -> None:
    hidden = sighting(1, "trees", 0.0, label="person", origin=KnownBy.UNDER_TREES)
    register = associate([hidden], [look(0), look(1), look(2)])
    assert [each.gone for each in register.findings] == [""]
    assert between(register, "flight0", "flight1") == "nothing known came or left"
    assert between(register, "flight1", "flight2") == "nothing known came or left"
    seen = associate(
        [hidden, sighting(2, "map", 0.2, label="person")], [look(day) for day in (2, 3)]
    )
    assert between(seen, "flight2", "flight3") == "1 person left"


def test_a_look_in_no_frame_is_none() -> None:
    unseen = SearchedDate("flight1", 1, SearchedFrames(np.zeros((0, 4, 2)), {}))
    words = between(associate([sighting(0, "map", 0.0)], [look(0), unseen]), "flight0", "flight1")
    assert words.endswith("no objects were searched for on flight1")


def test_changes_that_nobody_named_are_things_too() -> None:
    """A heap came, which one look has a name for, and left; what stood in its place before is another."""
    unnamed = {"label": "", "origin": KnownBy.CHANGED, "length_m": 3.0}
    seen = [
        sighting(0, "left", 0.0, order=1.0, gone="flight1", **unnamed),
        sighting(1, "left", 0.1, **unnamed),
        sighting(1, "map", 0.2, label="truck", length_m=4.0),
        sighting(1, "leaves", 0.3, order=2.0, gone="flight2", **unnamed),
    ]
    register = associate(seen, [look(0), look(1), look(3)])
    assert shown(register)[0][1:] == ("", ("flight0",), "flight1", 1)
    assert shown(register)[1][1:] == ("truck", ("flight1",), "flight2", 3)
    assert between(register, "flight0", "flight1") == "1 truck came; 1 thing left"
    (lasting,) = associate(seen[1:2], [look(1), look(2)]).findings
    assert not lasting.gone  # nobody looks for it
    for label in ("", "small object"):  # no detector looks for them, so the comparison alone tells
        came = associate([replace(seen[1], label=label)], [])
        assert between(came, "flight0", "flight1") == f"1 {label or 'thing'} came"


def test_what_no_change_tells_is_told_by_the_searches() -> None:
    """A person left whose ground looks the same, another with a change; a change at the place, rejected perhaps, tells."""
    left = {"label": "person", "origin": KnownBy.CHANGED, "gone": "flight1", "order": 1.0}
    seen = [sighting(0, "map", east_m, label="person") for east_m in (0.0, 20.0)]
    seen += [sighting(0, "left", 20.1, **left), sighting(1, "map", 40.0)]
    register = associate(seen, [look(0), look(1)])
    told = replace(change(1, 25.0, 0.6, ChangeKind.DISAPPEARED), id=seen[2].id)
    car, person = untold(register, [told], ["flight0"], "flight1")
    assert (person[0], person[1].label) == (ChangeKind.DISAPPEARED, "person")
    assert (car[0], car[1].label) == (ChangeKind.APPEARED, "car")
    assert np.allclose(person[1].position_m, [0, 0])
    rejected = change(2, 0.3, 0.6, ChangeKind.DISAPPEARED)
    moves, ploughed = (change(3, 40.0, 4.0, kind) for kind in (ChangeKind.MOVING, ChangeKind.AREA))
    others = [told, rejected, moves, ploughed]
    (car,) = untold(register, others, ["flight0"], "flight1")
    assert car[0] is ChangeKind.APPEARED


def test_what_came_where_its_like_left_is_seen_once() -> None:
    """A comparison saw one car leave and another come; the detector saw the second, nearer to the first's place."""
    changed = sighting(1, "changes", 0.7, origin=KnownBy.CHANGED)
    left = replace(changed, date="flight0", gone="flight1", position_m=np.array([0.1, 0.0]))
    seen = [sighting(0, "map", 0.0), left, changed, sighting(1, "map", 0.1)]
    register = associate(seen, [look(0), look(1)])
    assert [(each.dates, each.gone) for each in register.findings] == [
        (("flight0",), "flight1"),
        (("flight1",), ""),
    ]
    (stands,) = associate([*seen[:2], seen[3]], [look(0), look(1)]).findings
    assert not stands.gone  # no other came: the comparison erred


def test_what_comes_after_it_was_gone_is_another() -> None:
    """A second car in the place of the first has an interval of its own."""
    seen = [sighting(0, "map", 0.0), sighting(2, "map", 0.2)]
    register = associate(seen, [look(0), look(1), look(2)])
    assert [(each.dates, each.gone) for each in register.findings] == [
        (("flight0",), "flight1"),
        (("flight2",), ""),
    ]


def test_two_things_half_a_metre_apart_never_merge() -> None:
    """Two people side by side stay two, though the next flight is placed half a metre off."""
    seen = [
        sighting(day, "map", east_m + 0.5 * day, label="person")
        for day in (0, 1)
        for east_m in (0.0, 0.5)
    ]
    register = associate(seen, [look(0), look(1)])
    assert [len(each.sightings) for each in register.findings] == [2, 2]
    assert not any(each.gone for each in register.findings)


def test_a_mission_that_is_off_as_a_whole_shows_who_parked_in_the_next_bay() -> None:
    """Five cars, one of which left; another came two bays off. All places err by metres, and by the same."""
    for shift_m in (0.0, 2.0):
        wide = {"sigma_m": 1.9}
        seen = [sighting(0, "map", east_m, **wide) for east_m in (0.0, 9.0, 18.0, 27.0, 36.0)]
        seen += [
            sighting(1, "map", each + shift_m, **wide) for each in (0.0, 9.0, 18.0, 27.0, 40.0)
        ]
        register = associate(seen, [look(0), look(1)])
        assert between(register, "flight0", "flight1") == "1 car came, 1 left"
        assert len(register.findings) == 6


def test_what_a_date_did_not_see_is_known_again_though_each_date_is_off() -> None:
    """Three dates, metres off to opposite sides; the second passed one of six cars by."""
    cars, wide = np.arange(6) * 9.0, {"sigma_m": 1.9}
    seen = [sighting(0, "map", east_m, **wide) for east_m in cars]
    seen += [sighting(1, "map", east_m + 3.0, **wide) for east_m in cars[1:]]
    seen += [sighting(2, "map", east_m - 3.0, **wide) for east_m in cars]
    found = associate(seen, [look(0), look(2)]).findings
    assert [len(each.sightings) for each in found] == [2, 3, 3, 3, 3, 3]
    # where the newest date puts them
    assert sorted(each.position_m[0] for each in found) == (cars - 3.0).tolist()


def test_moving_things_are_one_within_a_date_and_never_between_dates() -> None:
    """A walker where his speed takes him; the same place a day later is another's."""
    walks = {"moving": True, "velocity_m_s": (1.0, 0.0), "label": "person"}
    later_ns = DAY_NS + 2 * 10**10
    seen = [sighting(0, "map", 0.0, **walks), sighting(0, "watch", 10.0, last_ns=later_ns, **walks)]
    assert len(associate(seen).findings) == 1
    assert len(associate([*seen, sighting(1, "map", 10.0, **walks)]).findings) == 2


def test_a_detectors_class_outweighs_that_of_a_change() -> None:
    """A change's score is how sure it is that something changed there, not what it is."""
    change = sighting(0, "changes", 0.0, label="small object", origin=KnownBy.CHANGED, score=0.9)
    seen = sighting(0, "map", 0.1, label="person", score=0.5)
    assert [each.label for each in associate([change]).findings] == ["small object"]
    assert [each.label for each in associate([change, seen]).findings] == ["person"]


def test_a_renamed_class_is_one_thing_on_one_date() -> None:
    """Two models' names for what both see; on another date another class is another thing."""
    seen = [sighting(0, "map", 0.0), sighting(0, "watch", 0.2, label="van", length_m=5.0)]
    (found,) = associate(seen).findings
    assert set(found.class_scores) == {"car", "van"}
    assert len(associate([seen[0], replace(sighting(1, "map", 0.0), label="tree")]).findings) == 2


PLACES = st.lists(st.integers(0, 40), min_size=1, max_size=6, unique=True)
MISSIONS = st.lists(
    st.tuples(st.integers(0, 3), st.sampled_from("ab"), PLACES),
    min_size=1,
    max_size=5,
    unique_by=lambda each: each[:2],
)


@settings(max_examples=60, deadline=None)
@given(MISSIONS, st.randoms())
def test_laws(missions: list[tuple[int, str, list[int]]], random: object) -> None:
    """Order does not matter, and no mission sees a thing twice."""
    seen = [
        [sighting(day, name, 3.0 * place) for place in places] for day, name, places in missions
    ]
    whole = associate(list(chain(*seen)))
    mixed = list(chain(*seen))
    random.shuffle(mixed)
    assert shown(associate(mixed)) == shown(whole)
    for each in whole.findings:
        names = [one.mission for one in each.sightings]
        assert len(set(names)) == len(names)
    ids = [each.id for each in whole.findings]
    assert len(set(ids)) == len(ids)


@settings(max_examples=60, deadline=None)
@given(MISSIONS, st.integers(0, 3))
def test_a_flight_more_is_associated_with_what_stands_near_it(
    missions: list[tuple[int, str, list[int]]], last: int
) -> None:
    """One date after another, each with what still stands, comes to what all at once come to."""
    seen = [sighting(day, name, 3.0 * at) for day, name, places in missions for at in places]
    looks = [look(day) for day in range(4) if day != last]
    gone: list[GroundFinding] = []
    stands: list[GroundFinding] = []
    for day in range(4):
        own = [each for each in seen if each.order == day]
        found = associate(own, [each for each in looks if each.order == day], stands).findings
        gone += [each for each in found if each.gone]
        stands = [each for each in found if not each.gone]
    whole = associate(seen, looks)
    assert sorted(shown(Register((*gone, *stands)))) == sorted(shown(whole))


def test_two_hundred_flights_are_quick() -> None:
    """Over 50 things, a map each."""
    at_m = np.random.default_rng(1).uniform(-99, 99, (50, 2))
    seen = [sighting(day, "map", *place) for day in range(200) for place in at_m]
    started_s = time.process_time()
    register = associate(seen, [look(200)])
    assert time.process_time() - started_s < 3.0
    assert len(register.findings) == 50 and all(each.gone for each in register.findings)


def change(
    number: int,
    east_m: float,
    length_m: float,
    kind: ChangeKind = ChangeKind.APPEARED,
    *,
    north_m: float = 0.0,
    **classes: str,
) -> ChangeFacts:
    """A change whose outline is as wide as half its length."""
    outline_m = np.array([[-1, -0.5], [1, -0.5], [1, 0.5], [-1, 0.5]]) * length_m / 2
    place_m = np.array([east_m, north_m])
    sizes = (length_m**2 / 2, length_m, 0.3)
    return ChangeFacts(f"f-{number}", kind, 0.9, outline_m + place_m, 0, 1, 3, *sizes, **classes)


def test_changes_are_groups_what_matters_first_and_none_is_lost() -> None:
    """A lorry, its load and its shadow; a row of cars; a trench with what lies in it; a person alone; small things."""
    car = {"class_before": "car"}
    changes = [
        change(1, 100, 40.0, ChangeKind.AREA),
        *(change(2 + k, 90.0 + 6 * k, 2.0) for k in range(3)),
        change(5, 103, 0.6, class_after="person"),
        change(6, 0, 8.0, class_after="truck"),
        change(7, 6.5, 3.0),
        change(8, 0, 3.0, ChangeKind.DISAPPEARED, north_m=3.0),
        *(
            change(9 + k, 0, 4.4, ChangeKind.DISAPPEARED, north_m=50 + 3.5 * k, **car)
            for k in range(4)
        ),
        change(13, -60, 1.0),
        change(14, -80, 1.0, north_m=9.0),
        change(15, -60, 0.9, north_m=0.8),  # small beside small
        change(16, -90, 6.0),
        change(17, -90, 1.0, north_m=2.0),
        change(18, -70, 5.0, north_m=60),
        change(19, -90, 9.0, north_m=-60),
    ]
    groups = [[int(each.id[2:]) for each in group] for group in grouped(changes)]
    assert groups == [
        [5],
        [6, 7, 8],
        [9, 10, 11, 12],
        [1, 2, 3, 4],
        [19],
        [16, 18, 17],
        [13, 14, 15],
    ]
    shuffled = [[int(each.id[2:]) for each in group] for group in grouped(changes[::-1])]
    assert shuffled == groups
    assert in_short(changes) == (
        "1 person came; 1 truck came; 4 cars left; changed ground in 1 place, 40 m long; 3 large things changed; 9 small things changed"
    )
    walks = replace(changes[4], kind=ChangeKind.MOVING)
    assert in_short([*changes[4:6], walks, walks]).startswith("1 person came, 2 move; 1 truck came")

    assert "long" not in in_short(changes, is_local=True)
    assert grouped([]) == [] and in_short([]) == "nothing changed"
