"""ArchiveIndex: one database over all sites of a folder, kept beside them; it can be rebuilt from them."""

import hashlib
import json
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Self

import numpy as np
import shapely
from numpy.typing import NDArray
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
from sorvolo.geometry.arrays import Floats
from sorvolo.geometry.homography import apply_homography
from sorvolo.store.exports.places import longitude_latitude
from sorvolo.store.exports.plain import number_or_null
from sorvolo.store.index import tables
from sorvolo.store.index.finding import FoundFlight, Place, find
from sorvolo.store.site.archive import Archive
from sorvolo.store.site.catalogue import FlightEntry, StoredKeyframe
from sorvolo.store.site.catalogue_place import (
    Catalogues,
    create_pointed,
    parsed_url,
    pointed_database,
)
from sorvolo.store.site.database import Database, SqliteDatabase
from sorvolo.store.site.schema import format_of
from sorvolo.survey.flight import Site


@dataclass(frozen=True, eq=False)
class PlacedRows:
    """Rows of one table: their places, and their other columns by name, in the same order."""

    places: Sequence[BaseGeometry] = ()
    columns: Sequence[Mapping[str, Any]] = ()


@dataclass(frozen=True, eq=False)
class FrameRows:
    """Frames that were placed: outlines (N, 4, 2) in degrees, longitude first; times (N,) ns; whether kept (N,)."""

    names: tuple[str, ...] = ()
    outlines: Floats = field(default_factory=lambda: np.zeros((0, 4, 2)))
    times_ns: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    is_kept: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, np.bool_))

    @property
    def place(self) -> BaseGeometry | None:
        """All ground that they show; None without frames."""
        return (
            shapely.union_all(shapely.make_valid(shapely.polygons(self.outlines)))
            if len(self.names)
            else None
        )


@dataclass(frozen=True, eq=False)
class FlightRows:
    """One complete flight; `state` changes when it enters the site again."""

    flight: str
    state: str
    kind: str
    frames: FrameRows = field(default_factory=FrameRows)
    objects: PlacedRows = field(default_factory=PlacedRows)
    changes: PlacedRows = field(default_factory=PlacedRows)

    @property
    def first_ns(self) -> int:
        """The time of the first frame, UTC; from 1970 on where no clock has a date, 0 without frames."""
        return int(self.frames.times_ns.min()) if self.frames.names else 0

    @property
    def last_ns(self) -> int:
        """The time of the last frame, as `first_ns`."""
        return int(self.frames.times_ns.max()) if self.frames.names else 0


@dataclass(frozen=True)
class IndexedState:
    """What a site holds, in brief: `state` changes with each flight and each review.

    `flights` are the states of its complete flights, `verdicts` those on its changes, by id; a local site has neither.
    """

    name: str
    is_local: bool
    state: str
    flights: Mapping[str, str]
    verdicts: Mapping[str, str]


def site_state(archive: Archive) -> IndexedState:
    """The state of a site; one without any map has no flights. Raises StoreError for a damaged catalogue."""
    if not archive.has_site:
        return IndexedState(archive.folder.name, False, "", {}, {})
    site = archive.site()
    flights = (
        {} if site.is_local else {each.id: _state_of(each) for each in archive.complete_flights}
    )
    verdicts = (
        {} if site.is_local else {each.change_id: each.verdict.value for each in archive.reviews()}
    )
    content = json.dumps([site.name, site.is_local, flights, verdicts], sort_keys=True)
    return IndexedState(
        site.name, site.is_local, hashlib.sha256(content.encode()).hexdigest(), flights, verdicts
    )


def flight_rows(archive: Archive, wanted: Collection[str]) -> Iterator[FlightRows]:
    """The rows of these flights; a broken frames.geojson counts as missing. Raises StoreError as `Archive` does."""
    site, compared = archive.site(), archive.comparisons()
    versions = {each.flight_id: each for each in archive.versions()}
    for each in archive.complete_flights:
        if each.id not in wanted:
            continue
        yield FlightRows(
            each.id,
            _state_of(each),
            "compare" if versions[each.id].id in compared else "map",
            _frames(archive, each.id, site),
            _objects(archive, each.id, site),
            _changes(archive, each.id, site),
        )


def _state_of(flight: FlightEntry) -> str:
    return f"{flight.started_utc} {flight.finished_utc} {flight.fingerprint}"


def _frames(archive: Archive, flight: str, site: Site) -> FrameRows:
    """What the flight's frames show, by its frames.geojson; by the key frames alone where that is missing."""
    keyframes = archive.keyframes(flight)
    kept = {each.name for each in keyframes}
    rows = [
        row
        for each in archive.features(f"flights/{flight}", "frames")
        if (row := _written(each, kept)) is not None
    ]
    rows = rows or [row for each in keyframes if (row := _shown(each, site)) is not None]
    if not rows:
        return FrameRows()
    names, outlines, times_ns, is_kept = zip(*rows, strict=True)
    return FrameRows(
        names, np.array(outlines), np.array(times_ns, np.int64), np.array(is_kept, np.bool_)
    )


_Row = tuple[
    str, Floats, int, bool
]  # a frame's name, outline (4, 2) in degrees, time in ns, whether it was kept


def _written(feature: Any, kept: Collection[str]) -> _Row | None:
    """A frame as the file has it; None for one that was not placed or is damaged."""
    try:
        outline = np.array(feature["geometry"]["coordinates"][0], np.float64)[:4, :2]
        moment = datetime.fromisoformat(feature["properties"]["time"])
        utc = moment if moment.tzinfo is not None else moment.replace(tzinfo=UTC)
        name, time_ns = (
            str(feature["properties"]["frame"]),
            round(utc.timestamp() * 1e6) * 1000,
        )
    except (TypeError, ValueError, KeyError, IndexError):
        return None
    return (name, outline, time_ns, name in kept) if _is_usable(outline) else None


def _shown(keyframe: StoredKeyframe, site: Site) -> _Row | None:
    """A key frame as the catalogue has it."""
    outline_m = apply_homography(keyframe.site_from_image, keyframe.camera.corners_px)
    outline = np.column_stack(longitude_latitude(outline_m, site))
    return (keyframe.name, outline, int(keyframe.time_ns), True) if _is_usable(outline) else None


def _objects(archive: Archive, flight: str, site: Site) -> PlacedRows:
    changed = {each.id for each in archive.changes(flight)}  # rows of their own
    found = [each.thing for each in archive.objects(flight)]
    things = [each for each in found if each.id not in changed]
    if not things:
        return PlacedRows()
    longitudes, latitudes = longitude_latitude(np.array([each.position_m for each in things]), site)
    return PlacedRows(
        list(shapely.points(longitudes, latitudes)),
        [
            {
                "object_id": each.id,
                "label": each.label,
                "score": float(each.score),
                "sigma_m": number_or_null(each.sigma_m),
                "first_ns": int(each.first_seen_ns),
                "last_ns": int(each.last_seen_ns),
            }
            for each in things
        ],
    )


def _changes(archive: Archive, flight: str, site: Site) -> PlacedRows:
    found = archive.changes(flight)
    return PlacedRows(
        [_polygon(each.outline_m, site) for each in found],
        [
            {
                "change_id": each.id,
                "kind": each.kind.value,
                "score": float(each.score),
                "label": each.class_after or each.class_before or each.kind.value,
                "first_ns": int(each.first_seen_ns),
                "last_ns": int(each.last_seen_ns),
                "verdict": "" if each.verdict is None else each.verdict.value,
            }
            for each in found
        ],
    )


def _polygon(outline_m: Floats, site: Site) -> BaseGeometry:
    """An outline (N, 2) in degrees; of one or two points, their box grown to a millimetre or so."""
    corners = np.column_stack(longitude_latitude(np.asarray(outline_m)[:, :2], site))
    return (
        shapely.Polygon(corners)
        if len(corners) > 2
        else shapely.MultiPoint(corners).envelope.buffer(1e-8)
    )


def _is_usable(outline: Floats) -> bool:
    """Four corners, none of them as far away as the horizon, to which a frame that looks ahead may reach."""
    return outline.shape == (4, 2) and bool(
        np.isfinite(outline).all() and (np.ptp(outline, axis=0) < 1).all()
    )


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
            url = parsed_url(address)
            if url is None:
                SqliteDatabase(root / INDEX, write=True, layout=tables.LAYOUT).create()
            else:
                create_pointed(
                    root, POINTER, url, f"sorvolo_archive_{root.resolve().name}", tables.LAYOUT
                )
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
        self, path: str, state: IndexedState, gone: Collection[str], new: Iterable[FlightRows]
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
        boxes = [
            (first + k, west, east, south, north)
            for k, place in enumerate(places)
            if place is not None
            for west, south, east, north in [place.bounds]
        ]
        if boxes:
            values = f"INSERT INTO {kept.name}_places VALUES (?, ?, ?, ?, ?)"
            connection.exec_driver_sql(values, boxes)
    return first


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
