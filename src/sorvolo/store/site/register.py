"""The register of a site, from the records that its missions keep: objects, searched ground, changes, watches' tracks."""

from collections.abc import Collection, Sequence

import numpy as np
from sqlalchemy import Connection, select

from sorvolo.findings.register import Look, MissionSighting, Origin, Register, associate
from sorvolo.store.site import schema
from sorvolo.store.site.catalogue import list_versions
from sorvolo.store.site.change_records import (
    StoredChange,
    StoredObject,
    load_changes,
    load_objects,
    load_searches,
)
from sorvolo.survey.findings import ChangeKind, Verdict


def site_register(
    connection: Connection,
    flights: Collection[str] | None = None,
    watched: Sequence[MissionSighting] = (),
) -> Register:
    """What all complete runs found, each thing once; as far as these flights know. `watched` is of no run of the site."""
    searches = [each for each in load_searches(connection) if _is_of(each.flight_id, flights)]
    sightings = [
        sighting_of(each) for each in load_objects(connection) if _is_of(each.flight_id, flights)
    ]
    versions = list_versions(connection)
    flight_of = {each.id: each.flight_id for each in versions}
    before = {each.flight_id: flight_of.get(each.parent_id, "") for each in versions}
    flights_by_rank = connection.execute(select(schema.flights.c.id, schema.flights.c.rank))
    ranks = {row.id: float(row.rank) for row in flights_by_rank}
    for change in load_changes(connection):
        if _is_of(change.flight_id, flights) and change.verdict is not Verdict.REJECTED:
            sightings += _of_change(change, before.get(change.flight_id, ""), ranks)
    looks = [Look(each.flight_id, float(each.rank), each.frames) for each in searches]
    return associate([*sightings, *watched], Register(), looks)


def present_objects(register: Register, objects: Sequence[StoredObject]) -> list[StoredObject]:
    """What stands on the site by the newest look at each place, as the newest flight that detected it found it."""
    by_id = {each.thing.id: each for each in objects}
    result = []
    for found in register.present:
        known = [by_id[each.id] for each in found.sightings if each.id in by_id]
        if known:
            last = known[-1]
            result.append(StoredObject(last.flight_id, last.rank, last.thing, found))
    return result


def sighting_of(stored: StoredObject) -> MissionSighting:
    """An object that a flight's map or comparison found."""
    thing = stored.thing
    return MissionSighting(
        stored.flight_id,
        float(stored.rank),
        f"{stored.flight_id} objects",
        thing.id,
        Origin.DETECTED,
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


def _of_change(change: StoredChange, before: str, ranks: dict[str, float]) -> list[MissionSighting]:
    """What a change shows of things with a class: one that stands after it, one that left with it."""
    sightings = []
    for date, label, kinds, gone in (
        (change.flight_id, change.class_after, (ChangeKind.APPEARED, ChangeKind.REPLACED), ""),
        (
            before,
            change.class_before,
            (ChangeKind.DISAPPEARED, ChangeKind.REPLACED),
            change.flight_id,
        ),
    ):
        if not label or date not in ranks or change.kind not in kinds:
            continue
        seen_ns = (change.first_seen_ns, change.last_seen_ns) if not gone else (0, 0)
        sigma_m = change.sigma_in_map_m
        sightings.append(
            MissionSighting(
                date,
                ranks[date],
                f"{change.flight_id} changes",
                change.id,
                Origin.CHANGED,
                label,
                change.score,
                change.centre_m,
                change.sigma_m if np.isnan(sigma_m) else sigma_m,
                change.length_m,
                *seen_ns,
                gone=gone,
            )
        )
    return sightings


def _is_of(flight: str, flights: Collection[str] | None) -> bool:
    return flights is None or flight in flights
