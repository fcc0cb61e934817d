"""The register of a site, from the records that its missions keep: objects, searched ground, changes, watches' tracks."""

from collections.abc import Collection, Iterator, Mapping, Sequence

from sqlalchemy import Connection, select

from sorvolo.findings.register import KnownBy, MissionSighting, Register, SearchedDate, associate
from sorvolo.store.site import schema
from sorvolo.store.site.catalogue import list_versions
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

_CAME = (ChangeKind.APPEARED, ChangeKind.REPLACED, ChangeKind.AREA)
_LEFT = (ChangeKind.DISAPPEARED, ChangeKind.REPLACED)


def site_register(
    connection: Connection,
    flights: Collection[str] | None = None,
    others: Sequence[MissionSighting] = (),
    their_looks: Sequence[SearchedDate] = (),
) -> Register:
    """What all complete runs found, each thing once; as far as these flights know. `others` are of no run of the site."""
    searches = [each for each in load_searches(connection) if _is_of(each.flight_id, flights)]
    sightings = [
        sighting_of(each.thing, each.flight_id, float(each.rank))
        for each in load_objects(connection)
        if _is_of(each.flight_id, flights)
    ]
    versions = list_versions(connection)
    flight_of = {each.id: each.flight_id for each in versions}
    before = {each.flight_id: flight_of.get(each.parent_id, "") for each in versions}
    dates = {name: (float(rank), span) for name, rank, *span in flown_flights(connection)}
    for change in load_changes(connection):
        if _is_of(change.flight_id, flights) and change.verdict is not Verdict.REJECTED:
            sightings += _of_change(change, before.get(change.flight_id, ""), dates)
    looks = [SearchedDate(each.flight_id, float(each.rank), each.frames) for each in searches]
    return associate([*sightings, *others], [*looks, *their_looks])


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
    of_finding = {each.id: found for found in register.present for each in found.sightings}
    newest = {
        of_finding[each.thing.id].id: each.thing.id
        for each in objects
        if each.thing.id in of_finding
    }
    shown = set(newest.values())
    return [
        StoredObject(each.flight_id, each.rank, each.thing, of_finding[each.thing.id])
        for each in objects
        if each.thing.id in shown
    ]


def sighting_of(thing: MapObject, flight_id: str, rank: float) -> MissionSighting:
    """An object that a flight's map or comparison found."""
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


def _of_change(
    change: StoredChange, before: str, dates: Mapping[str, tuple[float, list[int]]]
) -> Iterator[MissionSighting]:
    """What a change shows: what stands after it, and what left with it; its class where it has one."""
    if change.flight_id not in dates:
        return
    came = change.flight_id, change.class_after, _CAME, ""
    left = before, change.class_before, _LEFT, change.flight_id
    for date, label, kinds, gone in (came, left):
        if date in dates and change.kind in kinds:
            seen_ns = (change.first_seen_ns, change.last_seen_ns)
            first_ns, last_ns = dates[date][1] if gone else seen_ns
            yield MissionSighting(
                date,
                dates[change.flight_id][0],
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
                gone=gone,
            )


def _is_of(flight: str, flights: Collection[str] | None) -> bool:
    return flights is None or flight in flights
