"""Changes and people's reviews of them, in the catalogue."""

import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from sqlalchemy import Connection, Row, delete, select

from sorvolo.errors import StoreError
from sorvolo.findings.importance import grouped
from sorvolo.findings.register import GroundFinding, SearchedDate
from sorvolo.geometry.arrays import Floats, PointsM, frozen
from sorvolo.store.exports.plain import plain_json
from sorvolo.store.site import schema
from sorvolo.store.site.catalogue import utc_now
from sorvolo.store.site.files import checked_name, is_plain_name
from sorvolo.survey.findings import Change, ChangeFacts, ChangeKind, HeightChange, Verdict
from sorvolo.survey.map_objects import MapObject, ObjectSearch, SearchedFrames


@dataclass(frozen=True)
class CropPlace:
    """Where a change's crops lie: the outer corner of their first pixel in site metres, north up; their size."""

    west_m: float
    north_m: float
    m_per_px: float
    width_px: int
    height_px: int


@dataclass(frozen=True, eq=False)
class StoredChange(ChangeFacts):
    """A change of a flight's complete run, and the verdict on it, if any.

    The fields are those of `survey.findings.Change`; `number` counts within the flight. The crops are
    `<id>-before.png` and `<id>-after.png` in the flight's folder `changes`, on the ground as `crop` places them.
    """

    flight_id: str
    number: int
    velocity_m_s: Floats
    announced_ns: int
    crop: CropPlace
    verdict: Verdict | None = None
    note: str = ""
    sigma_in_map_m: float = float("nan")
    height_change: HeightChange | None = None


@dataclass(frozen=True, eq=False)
class StoredReview:
    """A person's review of a change, with the kind and outline that the change had then."""

    change_id: str
    flight_id: str
    verdict: Verdict
    at_utc: str
    note: str
    kind: ChangeKind
    outline_m: PointsM


def stored_changes(flight_id: str, changes: Sequence[Change]) -> list[StoredChange]:
    """The changes as they are stored, by number: the one that ends the id, or all by their places in the list.

    Raises StoreError when two have the same id, or an id cannot name a file.
    """
    ids = [each.id for each in changes]
    for change_id in ids:
        if ids.count(change_id) > 1:
            raise StoreError(f"two changes have the id {change_id!r}; each needs its own")
        if not is_plain_name(change_id):
            raise StoreError(
                f"{change_id!r} cannot name a change's pictures; choose letters, digits and dashes"
            )
    endings = [re.search(r"[0-9]{1,9}$", change_id) for change_id in ids]
    numbers = [int(ending.group()) for ending in endings if ending is not None]
    if len(set(numbers)) < len(ids):
        numbers = list(range(1, len(ids) + 1))
    result = [_stored(flight_id, number, each) for number, each in zip(numbers, changes)]
    return sorted(result, key=lambda change: change.number)


def grouped_changes(changes: Iterable[StoredChange]) -> list[list[StoredChange]]:
    """The groups of each flight's changes, what matters most first; one that a person rejected is in no group."""
    by_flight: dict[str, list[StoredChange]] = {}
    rejected = []
    for each in changes:
        if each.verdict is Verdict.REJECTED:
            rejected.append([each])
        else:
            by_flight.setdefault(each.flight_id, []).append(each)
    return [group for each in by_flight.values() for group in grouped(each)] + rejected


def add_comparison(
    connection: Connection, run_id: int, version_id: int, changes: Sequence[StoredChange]
) -> None:
    """Note that this run compared its flight with the map and found these changes, perhaps none.

    Raises StoreError when another flight has a change of the same id.
    """
    known = select(schema.changes.c.id)
    for each in changes:
        if connection.execute(known.where(schema.changes.c.id == each.id)).first() is not None:
            raise StoreError(
                f"another flight of this site has a change {each.id!r} already; ids must differ"
            )
    kinds = {kind.value: sum(each.kind is kind for each in changes) for kind in ChangeKind}
    row = {"version_id": version_id, "run_id": run_id, "kinds": kinds}
    schema.add_rows(connection, schema.comparisons, [row])
    schema.add_rows(connection, schema.changes, [_row_of(each, run_id) for each in changes])


def load_changes(
    connection: Connection, flight_id: str | None = None, among: Collection[str] | None = None
) -> list[StoredChange]:
    """The changes of complete runs by flight rank and number, with their verdicts; of one flight if its id is given,
    or of these ids.

    A verdict belongs to a change of its id whose box still meets the one that was looked at: other settings may
    have given the id to another piece of ground.
    """
    query = schema.of_complete_runs(schema.changes, flight_id)
    query = query.order_by(schema.changes.c.number, schema.changes.c.id)
    reviews = {review.change_id: review for review in load_reviews(connection, flight_id)}
    return [
        _change_of(row, reviews.get(row.id))
        for part in schema.within(query, schema.changes.c.id, among)
        for row in schema.checked_rows(connection, schema.changes, part)
    ]


def load_reviews(connection: Connection, flight_id: str | None = None) -> list[StoredReview]:
    """All reviews, oldest first; of one flight if its id is given."""
    reviews = schema.reviews
    query = select(reviews).order_by(reviews.c.at_utc, reviews.c.change_id)
    if flight_id is not None:
        query = query.where(reviews.c.flight_id == flight_id)
    return [
        StoredReview(
            row.change_id,
            row.flight_id,
            Verdict(row.verdict),
            row.at_utc,
            row.note,
            ChangeKind(row.kind),
            _outline(row.outline_m),
        )
        for row in schema.checked_rows(connection, reviews, query)
    ]


def put_reviews(
    connection: Connection, changes: Sequence[StoredChange], verdict: Verdict | None, note: str
) -> None:
    """Give each of these changes the same verdict, None for none; an earlier one is replaced."""
    now = utc_now()
    for each in changes:
        connection.execute(delete(schema.reviews).where(schema.reviews.c.change_id == each.id))
        if verdict is None:
            continue
        row = {
            "change_id": each.id,
            "flight_id": each.flight_id,
            "verdict": verdict.value,
            "at_utc": now,
            "note": note,
            "kind": each.kind.value,
            "outline_m": each.outline_m.tolist(),
        }
        schema.add_rows(connection, schema.reviews, [row])


def compared_versions(connection: Connection) -> dict[int, Mapping[str, int]]:
    """The versions that comparisons made: the number of changes of each kind."""
    table = schema.comparisons
    return {
        row.version_id: row.kinds for row in schema.checked_rows(connection, table, select(table))
    }


_STORED = (
    *(each.name for each in fields(ChangeFacts)),
    "velocity_m_s",
    "announced_ns",
    "sigma_in_map_m",
    "height_change",
)  # fields of a change that are stored as they are


def _stored(flight_id: str, number: int, change: Change) -> StoredChange:
    patch = change.patch
    height_px, width_px = patch.changed.shape
    return StoredChange(
        **{name: getattr(change, name) for name in _STORED},
        flight_id=flight_id,
        number=number,
        crop=CropPlace(patch.west_m, patch.north_m, patch.m_per_px, width_px, height_px),
    )


def _row_of(change: StoredChange, run_id: int) -> dict[str, Any]:
    properties = plain_json({name: getattr(change, name) for name in (*_STORED, "crop")})
    kept = {name: properties.pop(name) for name in ("id", "kind")}
    return {**kept, "run_id": run_id, "number": change.number, "properties": properties}


def _change_of(row: Row[Any], review: StoredReview | None) -> StoredChange:
    values, crop = row.properties, CropPlace(**row.properties["crop"])
    outline_m = _outline(values["outline_m"])
    if not len(outline_m) or not crop.m_per_px > 0:
        raise ValueError("no outline, or a picture without a scale")
    sizes = ("area_m2", "length_m", "sigma_m", "sigma_in_map_m")
    risen = values["height_change"]
    is_reviewed = review is not None and bool(
        np.all(outline_m.min(axis=0) <= review.outline_m.max(axis=0))
        and np.all(review.outline_m.min(axis=0) <= outline_m.max(axis=0))
    )
    return StoredChange(
        **{
            **values,
            **{name: np.nan if values[name] is None else values[name] for name in sizes},
            "id": checked_name(row.id, "change"),
            "kind": ChangeKind(row.kind),
            "outline_m": outline_m,
            "velocity_m_s": frozen(values["velocity_m_s"]),
            "height_change": None if risen is None else HeightChange(**risen),
            "crop": crop,
        },
        flight_id=row.flight_id,
        number=row.number,
        verdict=review.verdict if review is not None and is_reviewed else None,
        note=review.note if review is not None and is_reviewed else "",
    )


def _outline(rows: Any) -> PointsM:
    return frozen(np.reshape(np.asarray(rows, np.float64), (-1, 2)))


@dataclass(frozen=True, eq=False)
class StoredObject:
    """An object of a flight's complete run; its crop is `objects/<id>.jpg` in the flight's folder.

    `finding` is what it is a sighting of, None in the list of one flight.
    """

    flight_id: str
    rank: int
    thing: MapObject
    finding: GroundFinding | None = None


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
    _add_objects(connection, run_id, search.objects, 1)


def put_under_trees(connection: Connection, flight_id: str, found: Sequence[MapObject]) -> None:
    """Note what a look below the crowns found in a flight's complete run, in place of what an earlier look found."""
    runs, objects = schema.runs, schema.objects
    query = select(runs.c.id).where(runs.c.flight_id == flight_id, runs.c.status == "complete")
    (run_id,) = connection.execute(query).scalars()
    rows = connection.execute(select(objects).where(objects.c.run_id == run_id)).all()
    earlier = [row.number for row in rows if is_under_trees(row.id)]
    connection.execute(
        delete(objects).where(objects.c.run_id == run_id, objects.c.number.in_(earlier))
    )
    if not has_searches(connection, flight_id):  # in no frame for no class: nothing is gone by it
        add_search(
            connection,
            run_id,
            ObjectSearch("", (), (), SearchedFrames(np.zeros((0, 4, 2)), {}), 0, 0, 0),
        )
    _add_objects(connection, run_id, found, 1 + max((row.number for row in rows), default=0))


def is_under_trees(object_id: str) -> bool:
    """Whether a look below crowns found an object, by its id."""
    return "-u" in object_id and object_id.rsplit("-u", 1)[1].isdecimal()


def _add_objects(
    connection: Connection, run_id: int, objects: Sequence[MapObject], first: int
) -> None:
    names = [each.name for each in fields(MapObject) if each.name not in ("id", "crop_jpeg")]
    rows = [
        {
            "run_id": run_id,
            "number": number,
            "id": each.id,
            "properties": plain_json({name: getattr(each, name) for name in names}),
        }
        for number, each in enumerate(objects, start=first)
    ]
    schema.add_rows(connection, schema.objects, rows)


def has_searches(connection: Connection, flight_id: str | None = None) -> bool:
    """Whether any complete run's frames were searched; of one flight if its id is given."""
    query = schema.of_complete_runs(schema.searches, flight_id).limit(1)
    return connection.execute(query.with_only_columns(schema.searches.c.run_id)).first() is not None


def load_searches(connection: Connection, flight_id: str | None = None) -> list[SearchedDate]:
    """The frames that complete runs searched, by flight rank; of one flight if its id is given."""
    query = schema.of_complete_runs(schema.searches, flight_id)
    return [
        SearchedDate(row.flight_id, float(row.rank), _frames_of(row.outlines_m, row.searched_for))
        for row in schema.checked_rows(connection, schema.searches, query)
    ]


def load_objects(
    connection: Connection, flight_id: str | None = None, among: Collection[str] | None = None
) -> list[StoredObject]:
    """The objects of complete runs by flight rank and number; of one flight if its id is given, or of these ids."""
    query = schema.of_complete_runs(schema.objects, flight_id).order_by(schema.objects.c.number)
    found = [
        StoredObject(row.flight_id, row.rank, _object_of(row.id, row.properties))
        for part in schema.within(query, schema.objects.c.id, among)
        for row in schema.checked_rows(connection, schema.objects, part)
    ]
    return sorted(found, key=lambda each: each.rank)


def _frames_of(outlines_m: Any, searched_for: Any) -> SearchedFrames:
    if searched_for is None:
        return SearchedFrames(outlines_m)
    return SearchedFrames(
        outlines_m, {str(name): np.array(rows, bool) for name, rows in searched_for.items()}
    )


def _object_of(object_id: str, values: dict[str, Any]) -> MapObject:
    lengths = {
        name: np.nan if values[name] is None else values[name]
        for name in ("sigma_m", "length_m", "width_m")
    }
    return MapObject(checked_name(object_id, "object"), **{**values, **lengths})
