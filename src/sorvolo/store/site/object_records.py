"""What stands on the map, as rows of the catalogue: each flight's search, its objects, and the newest of each place."""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from sqlalchemy import Connection, select

from sorvolo.store.exports.plain import plain_json
from sorvolo.store.site import schema
from sorvolo.store.site.names import checked_name
from sorvolo.survey.map_objects import MapObject, ObjectSearch, SearchedFrames, looked_at


@dataclass(frozen=True, eq=False)
class StoredSearch:
    """A complete run's search: its flight and rank, the model, and the frames looked at."""

    flight_id: str
    rank: int
    model: str
    frames: SearchedFrames


@dataclass(frozen=True, eq=False)
class StoredObject:
    """An object of a flight's complete run; its crop is `objects/<id>.jpg` in the flight's folder.

    `flights` are all that saw it there, in order of rank, this one last.
    """

    flight_id: str
    rank: int
    thing: MapObject
    flights: tuple[str, ...]


def add_search(connection: Connection, run_id: int, search: ObjectSearch) -> None:
    """Note that this run's frames were searched for objects, and what was found."""
    searched_for = search.frames.searched_for
    row = {
        "run_id": run_id,
        "model": search.model,
        "outlines_m": np.round(search.frames.outlines_m, 3).tolist(),
        "searched_for": None
        if searched_for is None
        else {name: np.asarray(rows, int).tolist() for name, rows in searched_for.items()},
    }
    schema.add_rows(connection, schema.searches, [row])
    names = [each.name for each in fields(MapObject) if each.name not in ("id", "crop_jpeg")]
    rows = [
        {
            "run_id": run_id,
            "number": number,
            "id": each.id,
            "properties": plain_json({name: getattr(each, name) for name in names}),
        }
        for number, each in enumerate(search.objects, start=1)
    ]
    schema.add_rows(connection, schema.objects, rows)


def load_searches(connection: Connection) -> list[StoredSearch]:
    """The searches of complete runs, by flight rank."""
    query = schema.of_complete_runs(schema.searches)
    return [
        StoredSearch(
            row.flight_id,
            row.rank,
            row.model,
            _frames_of(row.outlines_m, row.searched_for),
        )
        for row in schema.checked_rows(connection, schema.searches, query)
    ]


def load_objects(connection: Connection, flight_id: str | None = None) -> list[StoredObject]:
    """The objects of complete runs by flight rank and number; of one flight if its id is given."""
    query = schema.of_complete_runs(schema.objects, flight_id).order_by(schema.objects.c.number)
    return [
        StoredObject(row.flight_id, row.rank, _object_of(row.id, row.properties), (row.flight_id,))
        for row in schema.checked_rows(connection, schema.objects, query)
    ]


def newest_objects(
    objects: Sequence[StoredObject], searches: Sequence[StoredSearch]
) -> list[StoredObject]:
    """What stands on the site by the newest look at each piece of ground.

    What an earlier flight found where two frames of a later one looked for its class is replaced by what that one
    found. What stands there still keeps the time at which it was first seen, and names all flights that saw it.
    """
    result: list[StoredObject] = []
    for search in sorted(searches, key=lambda each: each.rank):
        own = [each for each in objects if each.flight_id == search.flight_id]
        seen_again = looked_at(
            np.array([each.thing.position_m for each in result]).reshape(-1, 2),
            [each.thing.label for each in result],
            [search.frames],
        )
        before = [each for each, again in zip(result, seen_again) if again]
        result = [each for each, again in zip(result, seen_again) if not again]
        result += [_since(each, before) for each in own]
    return result


def is_searched(connection: Connection, run_id: int) -> bool:
    """Whether the run's frames were searched for objects."""
    query = select(schema.searches.c.run_id).where(schema.searches.c.run_id == run_id)
    return connection.execute(query).first() is not None


def _frames_of(outlines_m: Any, searched_for: Any) -> SearchedFrames:
    if searched_for is None:
        return SearchedFrames(outlines_m)
    return SearchedFrames(
        outlines_m, {str(name): np.array(rows, bool) for name, rows in searched_for.items()}
    )


def _since(found: StoredObject, before: Sequence[StoredObject]) -> StoredObject:
    """The object with the time since which it has stood there, where an earlier flight found the same."""
    thing = found.thing
    for each in before:
        other = each.thing
        sigma_m = float(np.hypot(thing.sigma_m, other.sigma_m))
        if other.label == thing.label and thing.stands_where(other, sigma_m):
            kept = replace(thing, first_seen_ns=min(thing.first_seen_ns, other.first_seen_ns))
            return replace(found, thing=kept, flights=(*each.flights, found.flight_id))
    return found


def _object_of(object_id: str, values: dict[str, Any]) -> MapObject:
    lengths = {
        name: np.nan if values[name] is None else values[name]
        for name in ("sigma_m", "length_m", "width_m")
    }
    return MapObject(checked_name(object_id, "object"), **{**values, **lengths})
