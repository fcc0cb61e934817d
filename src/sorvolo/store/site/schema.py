"""The tables of the catalogue, the same in SQLite and in PostgreSQL, and the number of its format."""

from collections.abc import Sequence

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
    Table,
    insert,
    select,
)
from sqlalchemy import String as AnyString

FORMAT = 1
"""A catalogue of another format is refused."""

String = AnyString().with_variant(
    AnyString(collation="C"), "postgresql"
)  # ordered by bytes, as SQLite does
Nanoseconds = BigInteger().with_variant(Integer, "sqlite")  # SQLite's integers have 64 bits

metadata = MetaData()
site = Table(
    "site",
    metadata,
    Column("id", Integer, primary_key=True),  # always 1
    Column("name", String, nullable=False),
    Column("latitude_deg", Float, nullable=False),
    Column("longitude_deg", Float, nullable=False),
    Column("height_m", Float, nullable=False),
    Column("height_reference", String, nullable=False),
    Column("crs", String, nullable=False),
    Column("m_per_px", Float, nullable=False),
    Column("is_local", Boolean, nullable=False),
    Column("created_utc", String, nullable=False),
    Column(
        "derived_version", Integer, nullable=False
    ),  # the version in mosaic.tif and its kin; 0: none
)
flights = Table(
    "flights",
    metadata,
    Column("id", String, primary_key=True),
    Column("rank", Integer, nullable=False, unique=True),
)
runs = Table(
    "runs",
    metadata,
    Column(
        "id", Integer, primary_key=True, autoincrement=False
    ),  # names the run's folder: never used twice
    Column("flight_id", ForeignKey("flights.id"), nullable=False),
    Column("fingerprint", String, nullable=False),
    Column("status", String, nullable=False),  # mapping | complete
    Column("started_utc", String, nullable=False),
    Column("finished_utc", String, nullable=False),  # "" while mapping
    Column("method", String, nullable=False),
    Column("settings", JSON, nullable=False),
    Column("frames", JSON, nullable=False),  # status -> number of frames
    Column("notes", JSON, nullable=False),
    Column("files_written", Boolean, nullable=False),
)
keyframes = Table(
    "keyframes",
    metadata,
    Column("run_id", ForeignKey("runs.id", ondelete="CASCADE"), primary_key=True),
    Column("frame_index", Integer, primary_key=True),
    Column("name", String, nullable=False),
    Column("time_ns", Nanoseconds, nullable=False),
    Column("status", String, nullable=False),
    Column("image_path", String, nullable=False),
    Column("camera", JSON, nullable=False),  # width_px, height_px, fx_px, fy_px, cx_px, cy_px
    Column("site_from_image", JSON, nullable=False),  # (3, 3)
    Column("rotation", JSON, nullable=False),  # (3, 3) site_from_camera, [] when unknown
    Column("translation_m", JSON, nullable=False),  # (3,), [] when unknown
    Column("gains", JSON, nullable=False),
    Column("vignette", JSON, nullable=False),
    Column("sigma_m", Float),  # NULL when unknown
    Column("residual_px", Float),
)
documents = Table(
    "documents",
    metadata,  # the text files of a run, verbatim until they are written, then emptied to save room
    Column("run_id", ForeignKey("runs.id", ondelete="CASCADE"), primary_key=True),
    Column("name", String, primary_key=True),
    Column("content", LargeBinary, nullable=False),  # b"": the file is on the disk
)
leftovers = Table(
    "leftovers",
    metadata,  # text files of the run before that this one has not: to be removed
    Column("run_id", ForeignKey("runs.id", ondelete="CASCADE"), primary_key=True),
    Column("name", String, primary_key=True),
)
versions = Table(
    "versions",
    metadata,
    Column("id", Integer, primary_key=True, autoincrement=False),
    Column("parent_id", Integer, nullable=False),  # the version it was painted over; 0: none
    Column("flight_id", ForeignKey("flights.id"), nullable=False),
    Column("run_id", Integer, nullable=False),
    Column("created_utc", String, nullable=False),
    Column("complete", Boolean, nullable=False),
    Column("export_crs", String, nullable=False),  # "" is the site's own
)
version_tiles = Table(
    "version_tiles",
    metadata,
    Column("version_id", ForeignKey("versions.id", ondelete="CASCADE"), primary_key=True),
    Column("tile_column", Integer, primary_key=True),
    Column("tile_row", Integer, primary_key=True),
    Column("sha256", String, nullable=False),
)
Index("version_tiles_by_content", version_tiles.c.sha256)
comparisons = Table(
    "comparisons",
    metadata,  # a version that a comparison made; kept when its run is replaced
    Column("version_id", ForeignKey("versions.id", ondelete="CASCADE"), primary_key=True),
    Column("run_id", Integer, nullable=False),
    Column("kinds", JSON, nullable=False),  # kind -> number of changes
)
changes = Table(
    "changes",
    metadata,
    Column("id", String, primary_key=True),
    Column("run_id", ForeignKey("runs.id", ondelete="CASCADE"), nullable=False),
    Column("number", Integer, nullable=False),
    Column("kind", String, nullable=False),
    Column("properties", JSON, nullable=False),
)
Index("changes_by_run", changes.c.run_id)
reviews = Table(
    "reviews",
    metadata,  # no foreign keys: a verdict outlives the run whose change was looked at
    Column("change_id", String, primary_key=True),
    Column("flight_id", String, nullable=False),
    Column("verdict", String, nullable=False),
    Column("at_utc", String, nullable=False),
    Column("note", String, nullable=False),
    Column("kind", String, nullable=False),
    Column("outline_m", JSON, nullable=False),
)
searches = Table(
    "searches",
    metadata,  # a run whose frames were searched for objects, perhaps without finding any
    Column("run_id", ForeignKey("runs.id", ondelete="CASCADE"), primary_key=True),
    Column("model", String, nullable=False),
    Column("outlines_m", JSON, nullable=False),  # (N, 4, 2) of the frames that were looked at
    Column("searched_for", JSON),  # class -> (N,) 0 or 1; null: each frame for every class
)
objects = Table(
    "objects",
    metadata,
    Column("run_id", ForeignKey("runs.id", ondelete="CASCADE"), primary_key=True),
    Column("number", Integer, primary_key=True),
    Column("id", String, nullable=False),
    Column("properties", JSON, nullable=False),
)
flown = Table(
    "flown",
    metadata,  # when the flight was flown that made a version; kept when its run is replaced
    Column("version_id", ForeignKey("versions.id", ondelete="CASCADE"), primary_key=True),
    Column("first_ns", Nanoseconds, nullable=False),  # UTC; from 1970 on where no clock has a date
    Column("last_ns", Nanoseconds, nullable=False),
)
numbers_metadata = MetaData()
numbers = Table(
    "numbers",
    numbers_metadata,
    # "runs" and "versions": the number given last; "writes": transactions that wrote, counted in PostgreSQL; "format"
    Column("name", String, primary_key=True),
    Column("last", BigInteger, nullable=False),
)
NUMBERED = ("runs", "versions")
WRITES = "writes"


def make_tables(connection: Connection) -> None:
    """Make the empty tables, inside the caller's transaction."""
    metadata.create_all(connection)
    make_numbers(connection, FORMAT, NUMBERED)


def make_numbers(connection: Connection, format_number: int, names: Sequence[str] = ()) -> None:
    """Make the table of these numbers, of the count of writes and of the format."""
    numbers.create(connection)
    first = {**dict.fromkeys((*names, WRITES), 0), "format": format_number}
    rows = [{"name": name, "last": last} for name, last in first.items()]
    connection.execute(insert(numbers), rows)
    if connection.dialect.name == "sqlite":
        connection.exec_driver_sql(f"PRAGMA user_version = {format_number:d}")


def format_of(connection: Connection) -> int:
    """Return the format of a catalogue or an index."""
    if connection.dialect.name == "sqlite":
        return int(connection.exec_driver_sql("PRAGMA user_version").scalar_one())
    query = select(numbers.c.last).where(numbers.c.name == "format")
    return int(connection.execute(query).scalar_one())
