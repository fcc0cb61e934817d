"""The tables of the archive index, with places as geometries: R-trees in SQLite, PostGIS in PostgreSQL."""

from typing import Any

from sqlalchemy import (
    Boolean,
    Column,
    ColumnElement,
    Connection,
    Float,
    Index,
    Integer,
    LargeBinary,
    MetaData,
    Table,
    func,
    text,
)
from sqlalchemy.types import UserDefinedType

from sorvolo.errors import StoreError
from sorvolo.store.site.database import DatabaseLayout
from sorvolo.store.site.schema import (
    Nanoseconds,
    String,
    known,
    make_numbers,
    number,
    owner,
)
from sorvolo.store.site.schema import text as text_column

FORMAT = 1
"""An index of another format is rebuilt: everything in it comes from the sites."""

_APPLICATION_ID = 0x536F7249  # "SorI"
_WGS84 = 4326  # EPSG's number


class _PostgisGeometry(UserDefinedType[bytes]):
    """A geometry of PostGIS, as well-known binary on our side."""

    cache_ok = True

    def get_col_spec(self, **_: Any) -> str:
        return f"geometry(Geometry,{_WGS84})"

    def bind_expression(self, bindvalue: Any) -> ColumnElement[bytes]:
        return func.ST_GeomFromWKB(bindvalue, _WGS84, type_=self)

    def column_expression(self, colexpr: Any) -> ColumnElement[bytes]:
        return func.ST_AsBinary(colexpr, type_=LargeBinary)


Geometry = LargeBinary().with_variant(_PostgisGeometry(), "postgresql")
"""Degrees of WGS84, longitude first, as well-known binary; longitudes run on beyond 180 near the antimeridian."""

metadata = MetaData()
sites = Table(
    "sites",
    metadata,
    number(),
    known("path", String, unique=True),  # of its folder, below the archive's
    text_column("name"),
    known("is_local", Boolean),  # without a place on Earth: it has no flights here
    text_column("state"),  # a hash of what the site held when it was read
)
flights = Table(
    "flights",
    metadata,
    number(),
    owner("site_id", "sites.id", nullable=False),
    text_column("flight"),
    text_column("state"),  # which run of it was read
    text_column("kind"),  # map | compare
    known("first_ns", Nanoseconds),  # UTC; from 1970 on where no clock has a date
    known("last_ns", Nanoseconds),
    known("frames", Integer),  # that were placed; one row each would be slow to ask
    text_column("frame_names"),  # a line each, in the order of their outlines, as below
    known("frame_times", LargeBinary),  # ns as little-endian integers of 64 bits
    known("frame_kept", LargeBinary),  # a byte each: 1 where the site has its picture
    known("outlines", Geometry),  # a collection of what each shows, polygons of four corners
    Column("place", Geometry),  # all that they show; NULL without any
)
objects = Table(
    "objects",
    metadata,
    number(),
    owner("flight_id", "flights.id", nullable=False),
    text_column("object_id"),
    text_column("label"),
    known("score", Float),
    known("first_ns", Nanoseconds),
    known("last_ns", Nanoseconds),
    Column("sigma_m", Float),  # NULL where unknown
    known("place", Geometry),
)
changes = Table(
    "changes",
    metadata,
    number(),
    owner("flight_id", "flights.id", nullable=False),
    text_column("change_id"),
    text_column("kind"),
    text_column("label"),  # what it is; its kind where that is not known
    known("score", Float),
    known("first_ns", Nanoseconds),
    known("last_ns", Nanoseconds),
    text_column("verdict"),  # "": nobody reviewed it
    known("place", Geometry),
)
PLACED = (flights, objects, changes)
"""The tables with a place; in SQLite each has an R-tree `<name>_places` with the boxes of its rows."""

Index("flights_by_site", flights.c.site_id)
for _table in (objects, changes):
    Index(f"{_table.name}_by_flight", _table.c.flight_id)


def make_index(connection: Connection) -> None:
    """The empty tables, inside the caller's transaction. Raises StoreError for a PostgreSQL without PostGIS."""
    if connection.dialect.name != "sqlite":
        place = connection.execute(
            text(
                "SELECT nspname FROM pg_extension JOIN pg_namespace ON pg_namespace.oid = extnamespace "
                "WHERE extname = 'postgis'"
            )
        ).scalar()
        if place != "public":
            found = "no PostGIS" if place is None else f"PostGIS in the schema {place}"
            raise StoreError(
                f"the database has {found}; the archive index needs it in the schema public: install it (Debian: "
                "postgresql-postgis) and have an administrator run CREATE EXTENSION postgis SCHEMA public there"
            )
    metadata.create_all(connection)
    if (
        connection.dialect.name != "sqlite"
    ):  # as they are: unpacking them would take longer than to read them
        connection.execute(text("ALTER TABLE flights ALTER COLUMN outlines SET STORAGE EXTERNAL"))
    for table in PLACED:
        if connection.dialect.name != "sqlite":
            connection.execute(
                text(f"CREATE INDEX {table.name}_by_place ON {table.name} USING gist (place)")
            )
            continue
        connection.execute(
            text(
                f"CREATE VIRTUAL TABLE {table.name}_places USING rtree(id, west, east, south, north)"
            )
        )
    make_numbers(connection, FORMAT)


LAYOUT = DatabaseLayout(_APPLICATION_ID, make_index, beside="public", page_bytes=16_384)
