"""Moved shadows of what stays are no change where the sun of both dates is known; what came or left is one."""

import numpy as np
import pytest
from blob_world import M_PER_PX, START_NS, Thing, flight
from test_evidence import earlier_pictures

from sorvolo.change.announcing import Reason
from sorvolo.change.evidence import EvidenceMap, EvidenceSettings
from sorvolo.geometry.sun import direction_from_angles

DARK = (50, 50, 55)
WEST, SOUTH, EAST = (direction_from_angles(each, 45.0) for each in (270.0, 180.0, 90.0))


def shadow(
    east_m: float, north_m: float, along: str, *, is_later: bool, length_m: float = 1.5
) -> Thing:
    """The shadow of something 0.4 m wide at a place, as dark ground to the north or to the east of it."""
    size, half = (length_m + 0.2, 0.4), (length_m + 0.2) / 2
    when = {"on_map": not is_later, "in_flight": is_later}
    if along == "east":
        return Thing(east_m + half, north_m, size, colour=DARK, **when)
    return Thing(east_m, north_m + half, size[::-1], colour=DARK, **when)


def stays(east_m: float, north_m: float) -> Thing:
    return Thing(east_m, north_m, (0.4, 0.4), colour=(60, 90, 180), on_map=True)


MOVED = [
    shadow(0, 0.5, "east", is_later=False),
    shadow(0, 0.5, "north", is_later=True),
    stays(0, 0.5),
]
CAME = [shadow(0, 0.5, "north", is_later=True), Thing(0, 0.5, (0.4, 0.4), colour=(60, 90, 180))]
WENT = [
    shadow(0, 0.5, "east", is_later=False),
    Thing(0, 0.5, (0.4, 0.4), colour=(60, 90, 180), on_map=True, in_flight=False),
]
WALKED = [
    *WENT,
    *(
        Thing(each.east_m + 1.2, each.north_m - 1.4, each.size_m, colour=each.colour)
        for each in CAME
    ),
]
PLANKS = [  # as bright beside the ground as the shadow beside it is dark
    Thing(0.85, 0.5, (1.7, 0.4), colour=(245, 245, 245)),
    shadow(0, 0.5, "north", is_later=True),
    stays(0, 0.5),
]
LONGER = [
    shadow(0, 0.5, "east", is_later=False),
    shadow(0, 0.5, "north", is_later=True, length_m=3.5),
    stays(0, 0.5),
]
SUNS = {"earlier": WEST, "later": SOUTH}


@pytest.mark.parametrize(
    ("things", "suns", "is_reported"),
    [
        (MOVED, SUNS, False),
        (MOVED, {}, True),  # no clock has a date
        (MOVED, {"earlier": WEST}, True),
        (MOVED, {"earlier": WEST, "later": WEST}, True),  # a sun that stood still moves no shadow
        (MOVED, {"earlier": EAST, "later": SOUTH}, True),  # another sun than that of these shadows
        (CAME, SUNS, True),
        (WENT, SUNS, True),
        (WALKED, SUNS, True),
        (PLANKS, SUNS, True),
        (LONGER, SUNS, True),  # more than twice as long as the other one, the sun being as high
    ],
)
def test_the_moved_shadow_of_what_stays_is_no_change(things, suns, is_reported):
    def sun_at(time_ns):
        return suns.get("later" if time_ns >= START_NS else "earlier")

    evidence = EvidenceMap(
        M_PER_PX,
        EvidenceSettings(),
        "f",
        earlier_pictures([(0.0, 0.3), (1.0, 0.3)], things),
        sun_at,
    )
    for view in flight(things):
        evidence.add(view)
    assert bool(evidence.conclude()) is is_reported
    assert bool(evidence.outcomes()["never_announced"].get(Reason.SHADOW.value)) is not is_reported


def test_what_came_beside_a_moved_shadow_is_reported():
    came = Thing(0.9, 1.6, (0.6, 0.6))
    evidence = EvidenceMap(
        M_PER_PX,
        EvidenceSettings(),
        "f",
        earlier_pictures([(0.0, 0.3)], MOVED),
        lambda time_ns: SOUTH if time_ns >= START_NS else WEST,
    )
    for view in flight([*MOVED, came]):
        evidence.add(view)
    found = evidence.conclude()
    assert any(np.hypot(*(each.outline_m.mean(axis=0) - [0.9, 1.6])) < 0.6 for each in found)
