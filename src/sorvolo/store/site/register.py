"""The register of a site, from the records that its missions keep: objects, searched ground, changes, watches' tracks."""

import math
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import fields, replace
from itertools import zip_longest
from typing import Any

import numpy as np
from sqlalchemy import Connection, delete, func, or_, select

from sorvolo.findings.register import (
    GroundFinding,
    KnownBy,
    MissionSighting,
    Register,
    SearchedDate,
    as_of,
    associate,
    finding_of,
    in_order,
    reach_m,
)
from sorvolo.geometry.arrays import Floats, PointsM
from sorvolo.store.exports.plain import plain_json
from sorvolo.store.site import schema
from sorvolo.store.site.change_records import (
    StoredChange,
    StoredObject,
    is_under_trees,
    load_changes,
    load_objects,
    load_searches,
)
from sorvolo.survey.findings import ChangeKind, Verdict
from sorvolo.survey.map_objects import MapObject

_CAME = (ChangeKind.APPEARED, ChangeKind.REPLACED, ChangeKind.AREA, ChangeKind.MOVING)
_LEFT = (ChangeKind.DISAPPEARED, ChangeKind.REPLACED)
_NAMES = tuple(each.name for each in fields(MissionSighting))


# each complete flight's rank, the flight before it, and the times of that one's first and last frame
_Flown = Mapping[str, tuple[float, str, Sequence[int] | None]]


def site_register(
    connection: Connection,
    flights: Collection[str] | None = None,
    others: Sequence[MissionSighting] = (),
    their_looks: Sequence[SearchedDate] = (),
) -> Register:
    """What all complete runs found, each thing once; as far as these flights know. `others` are of no run of the site,
    later than all where their order is infinite."""
    orders = {each.order for each in others} | {each.order for each in their_looks}
    if flights is None and orders <= {math.inf}:
        kept = load_findings(connection)  # as commits put it together
        found = associate(others, their_looks, [each for each in kept if not each.gone]).findings
        whole = in_order([each for each in kept if each.gone] + list(found))
        return Register(tuple(whole), (*load_searches(connection), *their_looks))
    sightings, looks = _seen(connection, flights)
    return associate([*sightings, *others], [*looks, *their_looks])


def load_findings(connection: Connection, *which: Any) -> list[GroundFinding]:
    """All findings; or those of which these conditions on their table are true."""
    table = schema.findings
    return [
        finding_of(row.id, map(_sighting_of, row.sightings), row.gone)
        for row in schema.checked_rows(connection, table, select(table).where(*which))
    ]


def register_flights(connection: Connection, flights: Collection[str]) -> None:
    """Take what these flights' complete runs state now into the register.

    Their dates are taken again, and of later dates those that can see or miss what thereby differs, until nothing does:
    the same as all dates taken anew.
    """
    flown, table, reached = _flown(connection), schema.findings, schema.reached
    orders = {name: rank for name, (rank, *_) in flown.items()}
    again = {name for name in flown if not {name, flown[name][1]}.isdisjoint(flights)}
    first = min(orders[each] for each in again)
    later = [each for each in flown if orders[each] >= first]
    rows = schema.checked_rows(connection, reached, select(reached))
    boxes_m = {row.flight_id: np.array(row.box_m) for row in rows}
    since = select(schema.flights.c.id).where(schema.flights.c.rank >= first)
    ids = set(connection.execute(select(table.c.id)).scalars())
    spread_m = connection.execute(select(func.max(table.c.spread_m))).scalar() or 0.0
    old: dict[str, GroundFinding] = {}
    new: dict[str, GroundFinding | None] = {}  # what differs, as of the date taken last
    places_m: dict[str, PointsM] = {}  # of what differs and stands in either
    for name in later:
        if name not in again and not (name in boxes_m and _meets(boxes_m[name], places_m.values())):
            continue
        sightings, looks = _seen(connection, {name}, flown)
        if name in again:
            parts_m = [np.zeros((0, 2)), *(each.position_m for each in sightings)]
            parts_m += [each.frames.outlines_m for each in looks]
            parts_m += [boxes_m[name]] if name in boxes_m else []
            own_m = np.concatenate([np.reshape(each, (-1, 2)) for each in parts_m])
            if not len(own_m):
                continue
            boxes_m[name] = np.array([own_m.min(axis=0), own_m.max(axis=0)])
            connection.execute(delete(reached).where(reached.c.flight_id == name))
            row = {"flight_id": name, "box_m": boxes_m[name].tolist()}
            schema.add_rows(connection, reached, [row])
        (west_m, south_m), (east_m, north_m) = (each.tolist() for each in reach_m(boxes_m[name]))
        there = load_findings(
            connection,
            or_(table.c.gone == "", table.c.gone.in_(since)),
            table.c.east_m.between(west_m - spread_m, east_m + spread_m),
            table.c.north_m.between(south_m - spread_m, north_m + spread_m),
            table.c.id.not_in(list(old)[:500]),  # more are read again: see `schema.within`
        )
        old |= {each.id: each for each in there}
        before = {id_: as_of(each, orders[name], orders) for id_, each in old.items()} | new
        there = [each for each in before.values() if each is not None]
        taken = ids - old.keys() | {each.id for each in there}
        found = associate(sightings, looks, [each for each in there if not each.gone], taken)
        after = {each.id: each for each in (*there, *found.findings)}
        for id_ in before.keys() | after.keys():
            was = as_of(old[id_], orders[name] + 0.5, orders) if id_ in old else None
            new.pop(id_, None)
            places_m.pop(id_, None)
            if not _is_same(was, now := after.get(id_)):
                new[id_] = now
                if any(each is not None and not each.gone for each in (was, now)):
                    both = (each for each in (old.get(id_), now) if each is not None)
                    places_m[id_] = np.concatenate([_known_places_m(each) for each in both])
    for id_ in new:
        connection.execute(delete(table).where(table.c.id == id_))
    schema.add_rows(connection, table, [_row_of(each) for each in new.values() if each is not None])


def flown_flights(connection: Connection) -> list[tuple[str, int, int, int]]:
    """Each flight's name, rank, and the times of its first and last frame, by rank."""
    flown, flights, versions = schema.flown, schema.flights, schema.versions
    query = (
        select(flown, flights.c.id, flights.c.rank)
        .join(versions, versions.c.id == flown.c.version_id)
        .join(flights, flights.c.id == versions.c.flight_id)
        .order_by(flights.c.rank)
    )
    rows = schema.checked_rows(connection, flown, query)
    return [(row.id, row.rank, row.first_ns, row.last_ns) for row in rows]


def present_objects(
    connection: Connection, flights: Collection[str] | None = None
) -> list[StoredObject]:
    """What stands on the site by the newest look at each place, as the newest flight that detected it found it; as far
    as these flights know."""
    if flights is None:
        there = load_findings(connection, schema.findings.c.gone == "")
    else:
        there = [each for each in site_register(connection, flights).findings if not each.gone]
    of_finding: dict[str, GroundFinding] = {}
    for found in there:
        detected = (
            seen.order
            for seen in found.sightings
            if seen.origin in (KnownBy.DETECTED, KnownBy.UNDER_TREES)
        )
        newest_order = max(detected, default=-math.inf)  # later ones may be of changes' own objects
        of_finding |= {seen.id: found for seen in found.sightings if seen.order >= newest_order}
    objects = load_objects(connection, among=of_finding)
    newest: dict[str, StoredObject] = {}
    for each in objects:
        found = of_finding[each.thing.id]
        newest.pop(found.id, None)  # in the order of the objects
        newest[found.id] = replace(each, finding=found)
    return list(newest.values())


def sighting_of(thing: MapObject, flight_id: str, rank: float) -> MissionSighting:
    """An object that a detector found in a flight's frames."""
    origin = KnownBy.UNDER_TREES if is_under_trees(thing.id) else KnownBy.DETECTED
    return MissionSighting(
        flight_id,
        rank,
        f"{flight_id} {'objects' if origin is KnownBy.DETECTED else origin}",
        thing.id,
        origin,
        thing.label,
        thing.score,
        thing.position_m,
        thing.sigma_m,
        thing.length_m,
        thing.first_seen_ns,
        thing.last_seen_ns,
        thing.moving,
        (float(thing.velocity_m_s[0]), float(thing.velocity_m_s[1])),
        thing.class_scores,
    )


def sightings_of_change(
    change: StoredChange, rank: float, before: str, span: Sequence[int] | None
) -> Iterator[MissionSighting]:
    """What a change shows: what stands after it, or moves, and what left with it; its class where it has one.

    What left was there on the flight `before` that of the change, by rank, however late this was compared; `span` are
    the times of that one's first and last frame.
    """
    came = change.flight_id, change.class_after, _CAME, ""
    left = before, change.class_before, _LEFT, change.flight_id
    for date, label, kinds, gone in (came, left):
        if date and change.kind in kinds:
            seen_ns = [change.first_seen_ns, change.last_seen_ns]
            first_ns, last_ns = (gone and span) or seen_ns
            yield MissionSighting(
                date,
                rank,
                f"{change.flight_id} changes",
                change.id,
                KnownBy.CHANGED,
                label,
                change.score,
                change.centre_m,
                change.sigma_m,
                change.length_m,
                first_ns,
                last_ns,
                change.kind is ChangeKind.MOVING,
                (float(change.velocity_m_s[0]), float(change.velocity_m_s[1])),
                gone=gone,
            )


def _seen(
    connection: Connection, flights: Collection[str] | None = None, flown: _Flown | None = None
) -> tuple[list[MissionSighting], list[SearchedDate]]:
    """What the runs of these flights saw, and where they looked; of all."""
    one = next(iter(flights)) if flights is not None and len(flights) == 1 else None
    changes = load_changes(connection, one)
    in_changes = {each.id for each in changes}
    sightings = [
        sighting_of(each.thing, each.flight_id, float(each.rank))
        for each in load_objects(connection, one)
        if (flights is None or each.flight_id in flights) and each.thing.id not in in_changes
    ]
    known = flown or _flown(connection)
    for change in changes:
        flight = change.flight_id
        if (flights is None or flight in flights) and change.verdict is not Verdict.REJECTED:
            sightings += sightings_of_change(change, *known[flight])
    looks = load_searches(connection, one)
    return sightings, [each for each in looks if flights is None or each.date in flights]


def _flown(connection: Connection) -> _Flown:
    flights, runs = schema.flights, schema.runs
    query = select(flights.c.id, flights.c.rank).join(runs, runs.c.flight_id == flights.c.id)
    rows = connection.execute(query.where(runs.c.status == "complete").order_by(flights.c.rank))
    spans = {name: span for name, _, *span in flown_flights(connection)}
    flown, before = {}, ""
    for name, rank in rows:
        flown[name] = float(rank), before, spans.get(before)
        before = name
    return flown


def _known_places_m(found: GroundFinding) -> PointsM:
    """(N, 2) everywhere that missions placed it."""
    seen_m = [each.position_m for each in found.sightings]
    offs_m = [each.off_m for each in found.sightings]
    return np.array([found.known_m, *seen_m, *np.subtract(seen_m, offs_m)])


def _meets(box_m: Floats, places_m: Iterable[PointsM]) -> bool:
    low_m, high_m = reach_m(box_m)
    return any(((each >= low_m) & (each <= high_m)).all(axis=1).any() for each in places_m)


def _is_same(one: GroundFinding | None, other: GroundFinding | None) -> bool:
    if one is None or other is None:
        return one is other
    return one.gone == other.gone and all(
        mine is its or _values(mine) == _values(its)
        for mine, its in zip_longest(one.sightings, other.sightings)
    )


def _row_of(found: GroundFinding) -> dict[str, Any]:
    east_m, north_m = found.known_m.tolist()
    return {
        "id": found.id,
        "east_m": east_m,
        "north_m": north_m,
        "spread_m": float(np.abs(_known_places_m(found) - found.known_m).max()),
        "gone": found.gone,
        "sightings": [_values(each) for each in found.sightings],
    }


def _values(sighting: MissionSighting | None) -> Any:
    return plain_json([getattr(sighting, name) for name in _NAMES]) if sighting else None


def _sighting_of(values: Sequence[Any]) -> MissionSighting:
    named = dict(zip(_NAMES, values, strict=True))
    named |= {name: math.nan for name in ("sigma_m", "length_m") if named[name] is None}
    pairs = {name: tuple(named[name]) for name in ("velocity_m_s", "off_m")}
    return MissionSighting(**{**named, **pairs, "origin": KnownBy(named["origin"])})
