"""The tables of the catalogue, the same in SQLite and in PostgreSQL, and the number of its format."""

import json
import zlib
from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import Any

from sqlalchemy import (
    JSON,
    BigInteger,
    Boolean,
    Column,
    Connection,
    Float,
    ForeignKey,
    Index,
    Integer,
    LargeBinary,
    MetaData,
    Row,
    RowMapping,
    Select,
    Table,
    insert,
    select,
)
from sqlalchemy import String as AnyString

FORMAT = 7
"""A catalogue of another format is refused."""

# ordered by bytes, as SQLite does
String = AnyString().with_variant(AnyString(collation="C"), "postgresql")
# SQLite's integers have 64 bits
Nanoseconds = BigInteger().with_variant(Integer, "sqlite")


def known(name: str, kind: Any, *constraints: Any, **options: Any) -> Column[Any]:
    """A column that is never NULL."""
    return Column(name, kind, *constraints, nullable=False, **options)


def text(name: str) -> Column[Any]:
    """A column of text that is never NULL."""
    return known(name, String)


def number(name: str = "id") -> Column[Any]:
    """The primary key, a number that the caller gives."""
    return Column(name, Integer, primary_key=True, autoincrement=False)


def sealed() -> Column[Any]:
    """A checksum of the row, by which a damaged one is known."""
    return known("seal", BigInteger)


def owner(name: str, target: str, **options: Any) -> Column[Any]:
    """A reference to the row that this one goes with."""
    return Column(name, ForeignKey(target, ondelete="CASCADE"), **options)


metadata = MetaData()
site = Table(
    "site",
    metadata,
    number(),  # always 1
    text("name"),
    known("latitude_deg", Float),
    known("longitude_deg", Float),
    known("height_m", Float),
    text("height_reference"),
    text("crs"),
    known("m_per_px", Float),
    known("is_local", Boolean),
    text("created_utc"),
    known("derived_version", Integer),  # the version in mosaic.tif and its kin; 0: none
    sealed(),
)
flights = Table(
    "flights",
    metadata,
    Column("id", String, primary_key=True),
    known("rank", Integer, unique=True),
)
runs = Table(
    "runs",
    metadata,
    number(),  # names the run's folder: never used twice
    known("flight_id", String, ForeignKey("flights.id")),
    text("fingerprint"),
    text("status"),  # mapping | complete
    text("started_utc"),
    text("finished_utc"),  # "" while mapping
    text("method"),
    known("settings", JSON),
    known("frames", JSON),  # status -> number of frames
    known("notes", JSON),
    known("files_written", Boolean),
)
keyframes = Table(
    "keyframes",
    metadata,
    owner("run_id", "runs.id", primary_key=True),
    Column("frame_index", Integer, primary_key=True),
    text("name"),
    known("time_ns", Nanoseconds),
    text("status"),
    text("image_path"),
    text("sha256"),  # of the image's bytes
    known("camera", JSON),  # width_px, height_px, fx_px, fy_px, cx_px, cy_px
    known("site_from_image", JSON),  # (3, 3)
    known("rotation", JSON),  # (3, 3) site_from_camera, [] when unknown
    known("translation_m", JSON),  # (3,), [] when unknown
    known("gains", JSON),
    known("vignette", JSON),
    Column("sigma_m", Float),  # NULL when unknown
    Column("residual_px", Float),
    sealed(),
)
documents = Table(
    "documents",
    metadata,  # the text files of a run, verbatim until they are written, then emptied to save room
    owner("run_id", "runs.id", primary_key=True),
    Column("name", String, primary_key=True),
    known("content", LargeBinary),  # b"": the file is on the disk
)
files = Table(
    "files",
    metadata,  # the other files of the site, less those that are being written
    Column("path", String, primary_key=True),
    text("sha256"),
)
leftovers = Table(
    "leftovers",
    metadata,  # text files of the run before that this one has not: to be removed
    owner("run_id", "runs.id", primary_key=True),
    Column("name", String, primary_key=True),
)
versions = Table(
    "versions",
    metadata,
    number(),
    known("parent_id", Integer),  # the version it was painted over; 0: none
    known("flight_id", String, ForeignKey("flights.id")),
    known("run_id", Integer),
    text("created_utc"),
    known("complete", Boolean),
    text("export_crs"),  # "" is the site's own
)
version_tiles = Table(
    "version_tiles",
    metadata,
    owner("version_id", "versions.id", primary_key=True),
    Column("tile_column", Integer, primary_key=True),
    Column("tile_row", Integer, primary_key=True),
    text("sha256"),
    sealed(),
)
Index("version_tiles_by_content", version_tiles.c.sha256)
comparisons = Table(
    "comparisons",
    metadata,  # a version that a comparison made; kept when its run is replaced
    owner("version_id", "versions.id", primary_key=True),
    known("run_id", Integer),
    known("kinds", JSON),  # kind -> number of changes
    sealed(),
)
changes = Table(
    "changes",
    metadata,
    Column("id", String, primary_key=True),
    owner("run_id", "runs.id", nullable=False),
    known("number", Integer),
    text("kind"),
    known("properties", JSON),
    sealed(),
)
Index("changes_by_run", changes.c.run_id)
reviews = Table(
    "reviews",
    metadata,  # no foreign keys: a verdict outlives the run whose change was looked at
    Column("change_id", String, primary_key=True),
    text("flight_id"),
    text("verdict"),
    text("at_utc"),
    text("note"),
    text("kind"),
    known("outline_m", JSON),
    sealed(),
)
searches = Table(
    "searches",
    metadata,  # a run whose frames were searched for objects, perhaps without finding any
    owner("run_id", "runs.id", primary_key=True),
    text("model"),
    known("outlines_m", JSON),  # (N, 4, 2) of the frames that were looked at
    Column("searched_for", JSON),  # class -> (N,) 0 or 1; null: each frame for every class
    sealed(),
)
objects = Table(
    "objects",
    metadata,
    owner("run_id", "runs.id", primary_key=True),
    Column("number", Integer, primary_key=True),
    text("id"),
    known("properties", JSON),
    sealed(),
)
Index("objects_by_id", objects.c.id)
findings = Table(
    "findings",
    metadata,  # the register: a row a thing, by all that the runs' records state of it
    Column("id", String, primary_key=True),
    known("east_m", Float),  # of its place with its missions' common errors taken off
    known("north_m", Float),
    known("spread_m", Float),  # so far at most from there, along an axis, any mission placed it
    text("gone"),  # the flight that did not find it; "": it stands
    known("sightings", JSON),
    sealed(),
)
Index("findings_by_place", findings.c.gone, findings.c.east_m, findings.c.north_m)
Index("findings_by_spread", findings.c.spread_m)
reached = Table(
    "reached",
    metadata,  # the box out of which a flight's runs have no part in any finding
    Column("flight_id", String, primary_key=True),
    known("box_m", JSON),  # (2, 2): west and south, east and north
    sealed(),
)
flown = Table(
    "flown",
    metadata,  # when the flight was flown that made a version; kept when its run is replaced
    owner("version_id", "versions.id", primary_key=True),
    known("first_ns", Nanoseconds),  # UTC; from 1970 on where no clock has a date
    known("last_ns", Nanoseconds),
    sealed(),
)
numbers_metadata = MetaData()
numbers = Table(
    "numbers",
    numbers_metadata,
    # "runs" and "versions": the number given last; "writes": transactions that wrote, counted in PostgreSQL; "format"
    Column("name", String, primary_key=True),
    known("last", BigInteger),
)
NUMBERED = ("runs", "versions")
WRITES = "writes"
# of a row with a seal: a version's tiles are copied for the next one, and the map's files follow its newest version
_UNSEALED = ("seal", "version_id", "derived_version")


def add_rows(connection: Connection, table: Table, rows: Sequence[Mapping[str, Any]]) -> None:
    """Insert rows, each with its seal."""
    if rows:
        connection.execute(insert(table), [{**row, "seal": seal_of(table, row)} for row in rows])


def checked_rows(connection: Connection, table: Table, query: Select[Any]) -> Iterator[Row[Any]]:
    """Yield the rows of a query that selects all columns of `table`. Raises ValueError for one that is damaged."""
    for row in connection.execute(query):
        if "seal" in table.c and row.seal != seal_of(table, row._mapping):
            raise ValueError(f"a row of {table.name!r} is not as it was written")
        yield row


def seal_of(table: Table, row: Mapping[str, Any] | RowMapping) -> int:
    """Return the checksum of a row's values."""
    values = [
        float(row[column.name])
        if isinstance(column.type, Float) and row[column.name] is not None
        else row[column.name]
        for column in table.columns
        if column.name not in _UNSEALED
    ]
    return zlib.crc32(json.dumps(values, sort_keys=True).encode())


def make_tables(connection: Connection) -> None:
    """Make the empty tables, inside the caller's transaction."""
    metadata.create_all(connection)
    make_numbers(connection, FORMAT, NUMBERED)


def make_numbers(connection: Connection, format_number: int, names: Sequence[str] = ()) -> None:
    """Make the table of these numbers, of the count of writes and of the format."""
    numbers.create(connection)
    first = {**dict.fromkeys((*names, WRITES), 0), "format": format_number}
    connection.execute(
        insert(numbers), [{"name": name, "last": last} for name, last in first.items()]
    )
    if connection.dialect.name == "sqlite":
        connection.exec_driver_sql(f"PRAGMA user_version = {format_number:d}")


def format_of(connection: Connection) -> int:
    """Return the format of a catalogue or an index."""
    if connection.dialect.name == "sqlite":
        return int(connection.exec_driver_sql("PRAGMA user_version").scalar_one())
    query = select(numbers.c.last).where(numbers.c.name == "format")
    return int(connection.execute(query).scalar_one())


def within(
    query: Select[Any], column: Column[Any], among: Collection[Any] | None
) -> Iterator[Select[Any]]:
    """Yield the query's parts whose rows have one of these values; the whole for None. SQLite before 3.32 takes no more
    than 999 values."""
    if among is None:
        yield query
    wanted = sorted(among or ())
    for start in range(0, len(wanted), 500):
        yield query.where(column.in_(wanted[start : start + 500]))


def of_complete_runs(table: Table, flight_id: str | None = None) -> Any:
    """Select the rows that complete runs have, with `flight_id` and `rank`, by rank; of one flight if its id is given."""
    query = (
        select(table, runs.c.flight_id, flights.c.rank)
        .join(runs, runs.c.id == table.c.run_id)
        .join(flights, flights.c.id == runs.c.flight_id)
        .where(runs.c.status == "complete")
        .order_by(flights.c.rank)
    )
    return query if flight_id is None else query.where(flights.c.id == flight_id)
