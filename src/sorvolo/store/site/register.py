"""The register of a site, from the records that its missions keep: objects, searched ground, changes, watches' tracks."""

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import fields, replace
from typing import Any

import numpy as np
from sqlalchemy import Connection, delete, select

from sorvolo.findings.register import (
    GroundFinding,
    KnownBy,
    MissionSighting,
    Register,
    SearchedDate,
    associate,
    in_order,
    reach_m,
)
from sorvolo.geometry.arrays import Floats, frozen
from sorvolo.store.exports.plain import plain_json
from sorvolo.store.site import schema
from sorvolo.store.site.catalogue import list_flights
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


def load_findings(
    connection: Connection, low_m: Floats | None = None, high_m: Floats | None = None
) -> list[GroundFinding]:
    """All findings; or what still stands in a box (2,), (2,), site metres."""
    table = schema.findings
    query = select(table)
    if low_m is not None and high_m is not None:
        query = query.where(
            table.c.gone == "",
            table.c.east_m.between(float(low_m[0]), float(high_m[0])),
            table.c.north_m.between(float(low_m[1]), float(high_m[1])),
        )
    found = []
    for row in schema.checked_rows(connection, table, query):
        position_m, sigma_m, class_sums = row.properties["kept"]
        finding = GroundFinding(
            row.id,
            tuple(_sighting_of(each) for each in row.properties["sightings"]),
            frozen(position_m),
            _number(sigma_m),
            frozen([row.east_m, row.north_m]),
            class_sums,
            row.gone,
        )
        found.append(finding)
    return found


def register_flight(connection: Connection, flight_id: str) -> None:
    """Take a new flight whose run was just completed into the register: it changes what stands near it."""
    sightings, looks = _seen(connection, {flight_id})
    places_m = [each.position_m.reshape(1, 2) for each in sightings]
    places_m += [each.frames.outlines_m.reshape(-1, 2) for each in looks]
    if not sum(map(len, places_m)):
        return
    low_m, high_m = reach_m(np.concatenate(places_m))
    near = load_findings(connection, low_m, high_m)
    known = {each.id: ("", len(each.sightings)) for each in near}
    found = associate(sightings, looks, near).findings
    changed = [each for each in found if known.get(each.id) != (each.gone, len(each.sightings))]
    table = schema.findings
    for each in changed:
        dropped = connection.execute(delete(table).where(table.c.id == each.id)).rowcount
        if dropped and each.id not in known:  # one far away has its id
            register_anew(connection)
            return
    schema.add_rows(connection, table, [_row_of(each) for each in changed])


def register_anew(connection: Connection) -> None:
    """Make the register of all complete runs: what one states has changed."""
    connection.execute(delete(schema.findings))
    found = associate(*_seen(connection)).findings
    schema.add_rows(connection, schema.findings, [_row_of(each) for each in found])


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


def present_objects(register: Register, objects: Sequence[StoredObject]) -> list[StoredObject]:
    """What stands on the site by the newest look at each place, as the newest flight that detected it found it."""
    there = (each for each in register.findings if not each.gone)
    of_finding = {seen.id: each for each in there for seen in each.sightings}
    newest: dict[str, StoredObject] = {}
    for each in objects:
        if (found := of_finding.get(each.thing.id)) is not None:
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
    change: StoredChange, ranks: Mapping[str, float], spans: Mapping[str, list[int]]
) -> Iterator[MissionSighting]:
    """What a change shows: what stands after it, or moves, and what left with it; its class where it has one.

    What left was there on the flight before, by rank, however late the change's own flight was compared.
    """
    rank = ranks[change.flight_id]
    before = max((each for each in ranks if ranks[each] < rank), key=ranks.__getitem__, default="")
    came = change.flight_id, change.class_after, _CAME, ""
    left = before, change.class_before, _LEFT, change.flight_id
    for date, label, kinds, gone in (came, left):
        if date and change.kind in kinds:
            seen_ns = [change.first_seen_ns, change.last_seen_ns]
            first_ns, last_ns = spans.get(date, seen_ns) if gone else seen_ns
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
    connection: Connection, flights: Collection[str] | None = None
) -> tuple[list[MissionSighting], list[SearchedDate]]:
    """What the runs of these flights saw, and where they looked; of all."""
    changes = load_changes(connection, _only(flights))
    in_changes = {each.id for each in changes}
    sightings = [
        sighting_of(each.thing, each.flight_id, float(each.rank))
        for each in load_objects(connection, _only(flights))
        if (flights is None or each.flight_id in flights) and each.thing.id not in in_changes
    ]
    whole = (each for each in list_flights(connection) if each.status == "complete")
    ranks = {each.id: float(each.rank) for each in whole}
    spans = {name: span for name, _, *span in flown_flights(connection)}
    for change in changes:
        is_known = flights is None or change.flight_id in flights
        if is_known and change.verdict is not Verdict.REJECTED:
            sightings += sightings_of_change(change, ranks, spans)
    looks = load_searches(connection, _only(flights))
    return sightings, [each for each in looks if flights is None or each.date in flights]


def _only(flights: Collection[str] | None) -> str | None:
    return next(iter(flights)) if flights is not None and len(flights) == 1 else None


def _row_of(found: GroundFinding) -> dict[str, Any]:
    kept = (found.position_m, found.sigma_m, found.class_sums)
    seen = [[getattr(each, field.name) for field in fields(each)] for each in found.sightings]
    east_m, north_m = found.known_m.tolist()
    return {
        "id": found.id,
        "east_m": east_m,
        "north_m": north_m,
        "gone": found.gone,
        "properties": plain_json({"kept": kept, "sightings": seen}),
    }


def _sighting_of(values: Sequence[Any]) -> MissionSighting:
    named = dict(zip((each.name for each in fields(MissionSighting)), values, strict=True))
    named |= {name: _number(named[name]) for name in ("sigma_m", "length_m")}
    named |= {"origin": KnownBy(named["origin"]), "velocity_m_s": tuple(named["velocity_m_s"])}
    return MissionSighting(**named)


def _number(value: float | None) -> float:
    return math.nan if value is None else value
