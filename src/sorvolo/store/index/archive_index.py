"""ArchiveIndex: one database over all sites of a folder, kept beside them; it can be rebuilt from them."""

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import shapely
from shapely.geometry.base import BaseGeometry
from sqlalchemy import (
    ColumnElement,
    Connection,
    Table,
    column,
    delete,
    func,
    insert,
    select,
    table,
    text,
    update,
)

from sorvolo.errors import SettingsError, StoreError
from sorvolo.store.index import tables
from sorvolo.store.index.finding import FoundFlight, Place, find
from sorvolo.store.index.site_rows import FlightRows, SiteState
from sorvolo.store.site.catalogue_place import (
    Catalogues,
    create_pointed,
    parsed_url,
    pointed_database,
)
from sorvolo.store.site.database import Database, SqliteDatabase
from sorvolo.store.site.schema import format_of

INDEX = "archive-index.db"
POINTER = "archive-index.json"
_AT_ONCE = 5000  # rows


@dataclass(frozen=True)
class IndexedSite:
    """What the index knows of a site: its number, the state it had when it was read, and those of its flights."""

    id: int
    state: str
    flights: Mapping[str, str]


class ArchiveIndex:
    """The open index; a context manager. Sites are identified by their folders' paths below the archive's."""

    def __init__(self, database: Database) -> None:
        """Raises StoreError for a database that is not an index or cannot be reached."""
        self._database = database
        try:
            database.check()
            with database.reading() as connection:
                found = format_of(connection)
        except BaseException:
            database.close()
            raise
        if found != tables.FORMAT:
            database.close()
            raise StoreError(
                f"{database.place} has format {found} of the index, this Sorvolo works with {tables.FORMAT}; remove "
                "it, and `sorvolo archive index` makes it anew"
            )

    @classmethod
    def open(
        cls, root: Path, *, write: bool, address: str = "", catalogues: Catalogues | None = None
    ) -> Self:
        """The index of a folder of sites. Writing makes one where there is none: at `address`, else in the folder.

        `address` is a PostgreSQL URL; "" is a file of SQLite's, or the index that is there. One that lies elsewhere is
        looked for among `catalogues`; None: those of the environment. Raises StoreError where there is none to read,
        SettingsError for an address when the index lies elsewhere.
        """
        if not has_index(root):
            if not write:
                raise StoreError(
                    f"{root} has no index; make one with: sorvolo archive index {root}"
                )
            _create(root, address)
        is_file = (root / INDEX).is_file()
        if address and is_file != (parsed_url(address) is None):
            lies = "in its folder" if is_file else "in PostgreSQL"
            raise SettingsError(
                f"the index of {root} lies {lies} already; remove {INDEX if is_file else POINTER} there to begin "
                "another"
            )
        if is_file:
            return cls(SqliteDatabase(root / INDEX, write=write, layout=tables.LAYOUT))
        return cls(
            pointed_database(
                root, POINTER, write=write, layout=tables.LAYOUT, catalogues=catalogues
            )
        )

    def close(self) -> None:
        """Let go of the database."""
        self._database.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def sites(self) -> dict[str, IndexedSite]:
        """What is known, by path."""
        with self._database.reading() as connection:
            flights: dict[int, dict[str, str]] = {}
            kept = tables.flights.c
            for row in connection.execute(select(kept.site_id, kept.flight, kept.state)):
                flights.setdefault(row.site_id, {})[row.flight] = row.state
            known = connection.execute(
                select(tables.sites.c.id, tables.sites.c.path, tables.sites.c.state)
            )
            return {
                row.path: IndexedSite(row.id, row.state, flights.get(row.id, {})) for row in known
            }

    def put_site(
        self, path: str, state: SiteState, gone: Collection[str], new: Iterable[FlightRows]
    ) -> None:
        """Update a site in one transaction: remove the flights in `gone`, then add `new` ones.

        A flight in both is replaced. Verdicts are updated.
        """
        with self._database.changing() as connection:
            site_id = connection.execute(
                select(tables.sites.c.id).where(tables.sites.c.path == path)
            ).scalar()
            values = {"name": state.name, "is_local": state.is_local, "state": state.state}
            if site_id is None:
                site_id = _next_id(connection, tables.sites)
                connection.execute(insert(tables.sites).values(id=site_id, path=path, **values))
            else:
                connection.execute(
                    update(tables.sites).where(tables.sites.c.id == site_id).values(**values)
                )
            own = tables.flights.c.site_id == site_id
            for flight in gone:
                _drop_flights(connection, own & (tables.flights.c.flight == flight))
            for each in new:
                _add_flight(connection, site_id, each)
            _set_verdicts(connection, site_id, state.verdicts)

    def drop_sites(self, paths: Collection[str]) -> None:
        """Remove sites that no longer exist."""
        with self._database.changing() as connection:
            for path in paths:
                site = (
                    select(tables.sites.c.id).where(tables.sites.c.path == path).scalar_subquery()
                )
                _drop_flights(connection, tables.flights.c.site_id == site)
                connection.execute(delete(tables.sites).where(tables.sites.c.path == path))

    def counts(self) -> dict[str, int]:
        """How many sites, flights, frames, objects and changes it holds."""
        with self._database.reading() as connection:
            held = {
                each.name: connection.execute(select(func.count()).select_from(each)).scalar_one()
                for each in (tables.sites, *tables.PLACED)
            }
            frames = connection.execute(select(func.sum(tables.flights.c.frames))).scalar()
            return {**held, "frames": int(frames or 0)}

    def tidy(self) -> None:
        """Update the database's query statistics; call it after many flights."""
        with self._database.changing() as connection:
            connection.execute(text("ANALYZE"))

    def find(self, place: Place) -> list[FoundFlight]:
        """The flights that saw a place, in order of time, and what they found there. Raises StoreError."""
        with self._database.reading() as connection:
            return find(connection, place)

    @contextmanager
    def reading(self) -> Iterator[Connection]:
        """A transaction that sees one state of the index."""
        with self._database.reading() as connection:
            yield connection


def has_index(root: Path) -> bool:
    """Whether the folder has an index."""
    return (root / INDEX).is_file() or (root / POINTER).is_file()


def _create(root: Path, address: str) -> None:
    url = parsed_url(address)
    if url is None:
        SqliteDatabase(root / INDEX, write=True, layout=tables.LAYOUT).create()
    else:
        create_pointed(root, POINTER, url, f"sorvolo_archive_{root.resolve().name}", tables.LAYOUT)


def _add_flight(connection: Connection, site_id: int, rows: FlightRows) -> None:
    frames = rows.frames
    outlines = shapely.GeometryCollection(list(shapely.polygons(frames.outlines)))
    flight_id = _insert(
        connection,
        tables.flights,
        [frames.place],
        [
            {
                "site_id": site_id,
                "flight": rows.flight,
                "state": rows.state,
                "kind": rows.kind,
                "first_ns": rows.first_ns,
                "last_ns": rows.last_ns,
                "frames": len(frames.names),
                "outlines": shapely.to_wkb(outlines, byte_order=1),
                "frame_names": "\n".join(each.replace("\n", " ") for each in frames.names),
                "frame_times": frames.times_ns.astype("<i8").tobytes(),
                "frame_kept": frames.is_kept.tobytes(),
            }
        ],
    )
    for kept, each in ((tables.objects, rows.objects), (tables.changes, rows.changes)):
        _insert(
            connection,
            kept,
            each.places,
            [{**columns, "flight_id": flight_id} for columns in each.columns],
        )


def _insert(
    connection: Connection,
    kept: Table,
    places: Sequence[BaseGeometry | None],
    columns: Sequence[Mapping[str, Any]],
) -> int:
    """Add rows, with their boxes where the database has an R-tree of its own; the first one's number."""
    first = _next_id(connection, kept)
    blobs = [None if each is None else shapely.to_wkb(each) for each in places]
    rows = [
        {**row, "id": first + k, "place": blob}
        for k, (row, blob) in enumerate(zip(columns, blobs, strict=True))
    ]
    for start in range(0, len(rows), _AT_ONCE):
        connection.execute(insert(kept), rows[start : start + _AT_ONCE])
    if connection.dialect.name == "sqlite":
        _add_boxes(
            connection,
            kept,
            {first + k: place for k, place in enumerate(places) if place is not None},
        )
    return first


def _add_boxes(connection: Connection, kept: Table, places: Mapping[int, BaseGeometry]) -> None:
    boxes = [
        (number, west, east, south, north)
        for number, place in places.items()
        for west, south, east, north in [place.bounds]
    ]
    if boxes:
        connection.exec_driver_sql(f"INSERT INTO {kept.name}_places VALUES (?, ?, ?, ?, ?)", boxes)


def _drop_flights(connection: Connection, which: ColumnElement[bool]) -> None:
    """Delete flights with their objects and changes; R-trees have no foreign keys."""
    flights = select(tables.flights.c.id).where(which)
    if connection.dialect.name == "sqlite":
        for each in tables.PLACED:
            own = each.c.id if each is tables.flights else each.c.flight_id
            boxes = table(f"{each.name}_places", column("id"))
            connection.execute(
                delete(boxes).where(boxes.c.id.in_(select(each.c.id).where(own.in_(flights))))
            )
    connection.execute(delete(tables.flights).where(which))


def _next_id(connection: Connection, kept: Table) -> int:
    return (connection.execute(select(func.max(kept.c.id))).scalar() or 0) + 1


def _set_verdicts(connection: Connection, site_id: int, verdicts: Mapping[str, str]) -> None:
    """Set the verdicts: they change without a new flight."""
    own = select(tables.flights.c.id).where(tables.flights.c.site_id == site_id)
    kept = tables.changes
    known = connection.execute(
        select(kept.c.id, kept.c.change_id, kept.c.verdict).where(kept.c.flight_id.in_(own))
    ).all()
    for row in known:
        verdict = verdicts.get(row.change_id, "")
        if verdict != row.verdict:
            connection.execute(update(kept).where(kept.c.id == row.id).values(verdict=verdict))
