"""The register: what missions saw of things on the ground, put together to one finding a thing."""

import hashlib
import math
from collections import defaultdict
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from functools import cached_property
from itertools import groupby

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial import cKDTree

from sorvolo.geometry.arrays import Floats, PointsM, Rows, frozen
from sorvolo.survey.findings import ChangeFacts, ChangeKind
from sorvolo.survey.map_objects import SearchedFrames, looked_at

# Of its own length something may lie from where another mission found it, and so much more: a person who turned.
_REACH_OF_LENGTH, _REACH_M = 0.4, 0.5
_MOST_REACH_M = 8.0  # further apart are two things, however badly they are placed
_MOST_WALK_M = 40.0  # of what moves, from its last place by one mission to that by another
_WALKS_M_S = (
    2.0  # by so much what moves may be off for each second between two missions' last sight of it
)
_SURELY_OFF = 3  # things seen again that show how far a mission as a whole is off
_AGREE_M = 1.0  # so far apart at most, they show the same
_SIGMA_OF_MEDIAN = 0.85  # per axis, by the median distance of a normal scatter in the plane
_LIKE_SIZE = 2.5  # lengths further apart than this ratio are two things, where their classes differ
_LIKE_CLASS = 0.1  # classes' shares that agree less are two classes
_NAMED = 0.1  # beside a detector's own class counts that of a change: by the same frames, or one small picture
_LEFT = 4.0  # as unlike is what the date's comparison saw leave: what came in its place is nearer
_FAR = 1e3  # the cost of a pair that cannot be one thing: more than all that can

UNNAMED = "thing"
"""What one is called whose class nobody named."""


class KnownBy(StrEnum):
    """How a thing came to be known."""

    DETECTED = "detected"
    CHANGED = "changed"
    MARKED = "marked"
    UNDER_TREES = "under trees"  # no look from above shows whether it is there


@dataclass(frozen=True, eq=False)
class MissionSighting:
    """One thing as one mission saw it, in all of the mission's frames.

    `date` is the flight's name and `order` its rank among the site's; several missions may read one flight. `id` is the
    mission's own. `position_m` (2,) east, north in the site frame, of what moves where it was at `last_ns`. `sigma_m`
    is per axis. `label` is "" where nobody named it. `class_scores` gives each class's share. `gone` is the later date
    whose comparison saw that it had left, "" where none did; then `order` is that date's. `off_m` is how far its mission
    is off as a whole, east, north, as the register found.
    """

    date: str
    order: float
    mission: str
    id: str
    origin: KnownBy
    label: str
    score: float
    position_m: Floats
    sigma_m: float
    length_m: float
    first_ns: int
    last_ns: int
    moving: bool = False
    velocity_m_s: tuple[float, float] = (0.0, 0.0)
    class_scores: Mapping[str, float] = field(default_factory=dict)
    gone: str = ""
    off_m: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        object.__setattr__(self, "position_m", frozen(self.position_m))


@dataclass(frozen=True)
class SearchedDate:
    """The frames of a date that a detector searched."""

    date: str
    order: float
    frames: SearchedFrames


@dataclass(frozen=True, eq=False)
class GroundFinding:
    """One thing on the ground, by all its sightings in order of date.

    `id` follows from the first sighting's content. `gone` is the first date that looked there and did not find it, ""
    where none did. `position_m` (2,) and `sigma_m` are those of the newest date that saw it; `known_m` (2,) is that
    place with its missions' common errors taken off. `class_sums` are the scores by class, summed over all sightings,
    those of changes as a tenth.
    """

    id: str
    sightings: tuple[MissionSighting, ...]
    position_m: Floats
    sigma_m: float
    known_m: Floats
    class_sums: Mapping[str, float]
    gone: str = ""

    @property
    def class_scores(self) -> dict[str, float]:
        """Each class's share over all sightings, the likeliest first."""
        return _shares(self.class_sums)

    @property
    def label(self) -> str:
        """The likeliest class; "" where nobody named it."""
        return next(iter(self.class_scores), "")

    @property
    def newest(self) -> MissionSighting:
        """The surest sighting of the newest date that saw it, a detector's own before a change's."""
        return max(
            self.of(self.dates[-1]),
            key=lambda each: (each.origin is KnownBy.DETECTED, each.score, each.mission, each.id),
        )

    def of(self, date: str) -> list[MissionSighting]:
        """Its sightings of a date."""
        return [each for each in self.sightings if each.date == date]

    @cached_property
    def dates(self) -> tuple[str, ...]:
        """The dates that saw it, in order."""
        return tuple(dict.fromkeys(each.date for each in self.sightings))

    @property
    def first_ns(self) -> int:
        """When it was first seen."""
        return min(each.first_ns for each in self._looked)

    @property
    def last_ns(self) -> int:
        """When it was last seen."""
        return max(each.last_ns for each in self._looked)

    @property
    def _looked(self) -> Sequence[MissionSighting]:
        """The sightings with times of their own: one that left by a comparison alone has its flight's."""
        return [each for each in self.sightings if not each.gone] or self.sightings


@dataclass(frozen=True, eq=False)
class Register:
    """All findings of a site, and the looks that ended some of them."""

    findings: tuple[GroundFinding, ...] = ()
    looks: tuple[SearchedDate, ...] = ()

    @cached_property
    def changed_on(self) -> dict[str, list[GroundFinding]]:
        """What was first seen or found gone on a date, by date."""
        changed: dict[str, list[GroundFinding]] = {}
        for each in self.findings:
            for date in {each.dates[0], each.gone}:
                changed.setdefault(date, []).append(each)
        return changed


def associate(
    sightings: Sequence[MissionSighting],
    looks: Sequence[SearchedDate] = (),
    known: Sequence[GroundFinding] = (),
    taken: Collection[str] = (),
) -> Register:
    """What missions saw, each thing one finding; the same whatever their order.

    Dates are taken in order of time, and a date's missions by name. Two sightings of one mission are never one finding.
    What a date looked at and did not find is gone; the next thing there is another finding. `known` are findings of
    dates before all of these that still stand; those within `reach_m` of the places seen and looked at are enough.
    `taken` are the ids of other findings.
    """
    steps: list[MissionSighting | SearchedDate] = [*sightings, *looks]
    working = _Working(in_order(known), len(sightings), taken)
    for (_, date), of_date in groupby(sorted(steps, key=_date_of), key=_date_of):
        of_both = list(of_date)
        seen = [each for each in of_both if isinstance(each, MissionSighting)]
        for _, mission in groupby(sorted(seen, key=_order), key=_mission_of):
            working.take(list(mission))
        working.end(date, [each.frames for each in of_both if isinstance(each, SearchedDate)])
    return Register(tuple(each.finding() for each in working.things), tuple(looks))


def as_of(found: GroundFinding, order: float, orders: Mapping[str, float]) -> GroundFinding | None:
    """A finding as it was before the date of this order, by the dates' orders; None where no date had seen it."""
    kept = [
        each for each in found.sightings if (orders[each.gone] if each.gone else each.order) < order
    ]
    gone = found.gone if found.gone and orders[found.gone] < order else ""
    if len(kept) == len(found.sightings):
        return found if gone == found.gone else replace(found, gone=gone)
    return finding_of(found.id, kept, gone) if kept else None


def finding_of(id_: str, sightings: Iterable[MissionSighting], gone: str) -> GroundFinding:
    """A finding by its sightings, in the order in which the register took them."""
    return _Thing(id_, sightings, gone).finding()


def in_order(findings: Iterable[GroundFinding]) -> list[GroundFinding]:
    """Findings in the order in which their missions brought them."""
    first = ((each.sightings[0], each) for each in findings)
    return [
        each for _, each in sorted(first, key=lambda pair: (_date_of(pair[0]), _order(pair[0])))
    ]


def reach_m(places_m: PointsM) -> tuple[Floats, Floats]:
    """The box, (2,) each, around places (N, 2), N >= 1, out of which no finding of an earlier date is theirs."""
    return places_m.min(axis=0) - _MOST_REACH_M, places_m.max(axis=0) + _MOST_REACH_M


def begun_and_ended(
    register: Register, before: Collection[str], after: str
) -> Iterator[tuple[ChangeKind, GroundFinding]]:
    """What came to be there, or left, between dates that both looked for it, or by the later one's comparison: appeared
    or disappeared. What moves is another's on each date."""
    searches = [each.frames for each in register.looks if each.date in before]
    standing = [each for each in register.changed_on.get(after, ()) if not each.newest.moving]
    new = [each for each in standing if each.dates[0] == after]
    places_m = np.array([each.position_m for each in new]).reshape(-1, 2)
    was_looked_for = looked_at(places_m, [each.label for each in new], searches)
    for found, is_known in zip(new, was_looked_for):
        by_change = any(
            each.origin is KnownBy.CHANGED and not each.gone for each in found.of(after)
        )
        if by_change or (is_known and _can_be_missed(found.sightings)):
            yield ChangeKind.APPEARED, found
    for found in standing:
        if found.gone == after and any(each in before for each in found.dates):
            yield ChangeKind.DISAPPEARED, found


def untold(
    register: Register, changes: Sequence[ChangeFacts], before: Collection[str], after: str
) -> Iterator[tuple[ChangeKind, GroundFinding]]:
    """What came or left by the detector's searches alone: none of `changes`, all those of the later date, holds it or,
    rejected perhaps, is at its place."""
    ids = {each.id for each in changes}
    places = [each for each in changes if each.kind not in (ChangeKind.AREA, ChangeKind.MOVING)]
    for kind, found in begun_and_ended(register, before, after):
        reach_m = _REACH_M + _known(found.newest.length_m) / 2
        if ids.isdisjoint(each.id for each in found.sightings) and not any(
            np.hypot(*(each.centre_m - found.position_m)) <= reach_m + each.length_m / 2
            for each in places
        ):
            yield kind, found


def _can_be_missed(sightings: Sequence[MissionSighting]) -> bool:
    """Whether a detector that looks from above and is silent states that it is gone: only where one may know it."""
    return any(
        each.label and each.origin in (KnownBy.DETECTED, KnownBy.CHANGED) for each in sightings
    )


def _date_of(each: MissionSighting | SearchedDate) -> tuple[float, str]:
    gone = each.gone if isinstance(each, MissionSighting) else ""
    return each.order, gone or each.date


def _mission_of(each: MissionSighting) -> tuple[bool, str]:
    return not each.gone, each.mission  # what left is no other's place


def _order(each: MissionSighting) -> tuple[bool, str, int, str]:
    return *_mission_of(each), each.first_ns, each.id


class _Thing:
    """A finding while missions are added. `left` is its sighting by the comparison that saw that it had left, None
    where it was seen since."""

    def __init__(self, id_: str, sightings: Iterable[MissionSighting] = (), gone: str = "") -> None:
        self.id, self.gone = id_, gone
        self.left: MissionSighting | None = None
        self.sightings: list[MissionSighting] = []
        self.of_date: list[MissionSighting] = []
        self.sums = defaultdict[str, float](float)
        for each in sightings:
            self.add(each)
        if self.of_date:
            self.settle()

    def add(self, sighting: MissionSighting) -> None:
        """Take a sighting; `settle` gives the thing its place."""
        weight = sighting.score * (_NAMED if sighting.origin is KnownBy.CHANGED else 1.0)
        for name, share in _odds(sighting).items():
            self.sums[name] += share * weight
        self.left = sighting if sighting.gone else None
        if sighting.gone and self.of_date:  # it left from where it was seen last
            last = self.of_date[-1]
            self.sightings.append(replace(sighting, date=last.date, order=last.order))
            return
        if self.of_date and self.of_date[0].date != sighting.date:
            self.of_date = []
        self.of_date.append(sighting)
        self.sightings.append(sighting)

    def settle(self) -> None:
        """Of a date's places, the mean by their errors counts; of what moves the last."""
        weights = [max(_known(each.sigma_m, 10.0), 0.01) ** -2 for each in self.of_date]
        self.sigma_m = max(weights) ** -0.5  # missions of one flight err in common
        if self.of_date[-1].moving:
            weights = [0.0] * (len(weights) - 1) + [1.0]
        places_m = np.array([each.position_m for each in self.of_date])
        offs_m = np.array([each.off_m for each in self.of_date])
        self.place_m, off_m = (
            np.array(weights) @ each / sum(weights) for each in (places_m, offs_m)
        )
        self.known_m = self.place_m - off_m

    def finding(self) -> GroundFinding:
        return GroundFinding(
            self.id,
            tuple(self.sightings),
            frozen(self.place_m),
            self.sigma_m,
            frozen(self.known_m),
            self.sums,
            self.gone,
        )


class _Working:
    """The findings while missions are added, one after another, with the places of those that still stand."""

    def __init__(self, known: Sequence[GroundFinding], most: int, taken: Collection[str]) -> None:
        """`most` findings may come to those that are known."""
        self.things = [_Thing(each.id, each.sightings) for each in known]
        self._ids = {*taken, *(each.id for each in known)}
        self._places_m = np.zeros((len(known) + most, 2))
        self._stands = np.zeros(len(self._places_m), bool)
        self._stands[: len(known)] = True
        for number, each in enumerate(known):
            self._places_m[number] = each.known_m
        self._seen: set[int] = set()  # on the date that is added
        self._left: set[int] = set()

    def take(self, mission: Sequence[MissionSighting]) -> None:
        """Add all sightings of one mission, each to a finding of its own."""
        pairs = self._near(mission)
        off_m = np.zeros(2)
        joined = _one_to_one(pairs, off_m, math.inf)
        if (common := _common_error(pairs, least=max(_SURELY_OFF, len(joined) / 2))) is not None:
            off_m, joined = common[0], _one_to_one(pairs, *common)
        for row, sighting in enumerate(mission):
            if (number := joined.get(row)) is None:
                number = len(self.things)
                self.things.append(_Thing(self._id(sighting)))
                self._stands[number] = True
            (self._left if sighting.gone else self._seen).add(number)
            own = float(off_m[0]), float(off_m[1])
            self.things[number].add(replace(sighting, off_m=own))
            self.things[number].settle()
            self._places_m[number] = self.things[number].known_m

    def _near(self, mission: Sequence[MissionSighting]) -> list["_Pair"]:
        """Each sighting of a mission, by row, with each thing near it that it may be, by number."""
        places_m = np.array([each.position_m for each in mission])
        near = self._standing_near(places_m)
        if not len(near):
            return []
        radii_m = [_MOST_WALK_M if each.moving else _MOST_REACH_M for each in mission]
        around = cKDTree(self._places_m[near]).query_ball_point(places_m, radii_m)
        pairs = (
            _pair(row, mission[row], number, self.things[number])
            for row, columns in enumerate(around)
            for number in near[columns].tolist()
        )
        return [each for each in pairs if each is not None]

    def end(self, date: str, searches: Sequence[SearchedFrames]) -> None:
        """Conclude a date: what it looked at and did not see is gone, and what its comparison saw leave."""
        for number in self._left - self._seen:
            self.things[number].gone = date
            self._stands[number] = False
        if outlines_m := [each.outlines_m.reshape(-1, 2) for each in searches]:
            near = self._standing_near(np.concatenate(outlines_m))
            unseen = [
                number
                for number in near.tolist()
                if number not in self._seen and _can_be_missed(self.things[number].sightings)
            ]
            things = [self.things[number] for number in unseen]
            labels = [next(iter(_shares(each.sums))) for each in things]
            is_gone = looked_at(self._places_m[unseen], labels, searches)
            self._stands[unseen] = ~is_gone
            for thing in (things[row] for row in np.flatnonzero(is_gone)):
                thing.gone = date
        self._seen.clear()
        self._left.clear()

    def _standing_near(self, places_m: PointsM) -> Rows:
        """Numbers of what stands within reach of the box around places (N, 2)."""
        if not len(places_m):
            return np.zeros(0, np.int64)
        own_m = self._places_m[: len(self.things)]
        low_m, high_m = places_m.min(axis=0) - _MOST_WALK_M, places_m.max(axis=0) + _MOST_WALK_M
        is_near = self._stands[: len(own_m)] & ((own_m >= low_m) & (own_m <= high_m)).all(axis=1)
        return np.flatnonzero(is_near)

    def _id(self, first: MissionSighting) -> str:
        attempt = 0
        while (found := id_by(first, attempt)) in self._ids:
            attempt += 1
        self._ids.add(found)
        return found


def id_by(first: MissionSighting, attempt: int = 0) -> str:
    """A finding's id by the flight, time and place (to 0.1 m) of its first sighting: the same when the mission is run
    again, another for another thing."""
    place = np.round(first.position_m, 1) + 0.0
    content = f"{first.date} {first.first_ns} {place[0]:.1f} {place[1]:.1f} {attempt}"
    return hashlib.sha256(content.encode()).hexdigest()[:12]


def _odds(sighting: MissionSighting) -> Mapping[str, float]:
    return sighting.class_scores or ({sighting.label: 1.0} if sighting.label else {})


def _shares(sums: Mapping[str, float]) -> dict[str, float]:
    total = sum(sums.values()) or 1.0
    return {name: sums[name] / total for name in sorted(sums, key=lambda each: (-sums[each], each))}


def _known(value: float, otherwise: float = 0.0) -> float:
    return otherwise if math.isnan(value) else value


@dataclass(frozen=True, eq=False)
class _Pair:
    """A sighting and a thing that it may be: how far it is off, (2,), how far it may be beside its error, and how
    unlike it is, its class 0 to 1."""

    row: int
    number: int
    off_m: Floats
    reach_m: float
    sigma_m: float
    unlike: float
    stands: bool


def _pair(row: int, sighting: MissionSighting, number: int, thing: _Thing) -> _Pair | None:
    """A sighting and a thing; None where they are two by their dates, missions, classes or sizes."""
    last = thing.of_date[-1]
    is_same_date = last.date == sighting.date
    if is_same_date and any(each.mission == sighting.mission for each in thing.of_date):
        return None
    if thing.left is not None and thing.left.mission == sighting.mission:
        return None  # what came in its place
    moves = sighting.moving or last.moving
    if moves and not is_same_date:
        return None
    odds, own = _odds(sighting), _shares(thing.sums)
    shared = sum(min(share, own.get(name, 0.0)) for name, share in odds.items())
    if shared < _LIKE_CLASS:
        shorter_m, longer_m = sorted((float(sighting.length_m), float(last.length_m)))
        may_differ = is_same_date or (sighting.gone and not (odds and own))
        if not may_differ or not longer_m <= _LIKE_SIZE * shorter_m:
            return None
    length_m = max(_known(sighting.length_m), _known(last.length_m))
    between_s = (sighting.last_ns - last.last_ns) / 1e9 if moves else 0.0
    return _Pair(
        row,
        number,
        sighting.position_m - thing.known_m - np.multiply(last.velocity_m_s, between_s),
        _REACH_OF_LENGTH * length_m + _REACH_M + _WALKS_M_S * abs(between_s),
        math.hypot(_known(sighting.sigma_m), _known(thing.sigma_m)),
        1 - shared + _LEFT * (thing.left is not None),
        not moves,
    )


def _common_error(pairs: Sequence[_Pair], least: float) -> tuple[Floats, float] | None:
    """By how much, (2,), a mission is off as a whole, and how far its things scatter around that, 1 sigma per axis: as
    most sightings agree, of a row of like things too. None where fewer than `least` do."""
    standing = [each for each in pairs if each.stands]
    if len(standing) < least:
        return None
    off_m = np.array([each.off_m for each in standing])
    rows = np.array([each.row for each in standing])
    agreeing = [np.array(each) for each in cKDTree(off_m).query_ball_point(off_m, _AGREE_M)]
    votes = [len(np.unique(rows[each])) for each in agreeing]
    best = agreeing[max(range(len(votes)), key=lambda k: (votes[k], -np.hypot(*off_m[k])))]
    if len(np.unique(rows[best])) < least:
        return None
    shift_m = np.median(off_m[best], axis=0)
    scatter_m = float(np.median(np.hypot(*(off_m[best] - shift_m).T)))
    return shift_m, _SIGMA_OF_MEDIAN * scatter_m


def _one_to_one(pairs: Sequence[_Pair], shift_m: Floats, most_sigma_m: float) -> dict[int, int]:
    """Each row's finding, of a mission that is off by (2,), and beside that by `most_sigma_m` at most: as many pairs as
    can be, and of those choices the nearest."""
    if not pairs:
        return {}
    apart_m = np.hypot(*(np.array([each.off_m for each in pairs]) - shift_m).T)
    reach_m = [each.reach_m + 2 * min(each.sigma_m, most_sigma_m) for each in pairs]
    apart = apart_m / np.minimum(reach_m, _MOST_REACH_M)
    kept = [pairs[k] for k in np.flatnonzero(apart <= 1).tolist()]
    rows, at_row = np.unique([each.row for each in kept], return_inverse=True)
    numbers, at_number = np.unique([each.number for each in kept], return_inverse=True)
    costs = np.full((len(rows), len(numbers)), _FAR)
    costs[at_row, at_number] = apart[apart <= 1] + [0.5 * each.unlike for each in kept]
    chosen = zip(*linear_sum_assignment(costs))
    return {int(rows[i]): int(numbers[j]) for i, j in chosen if costs[i, j] < _FAR}
