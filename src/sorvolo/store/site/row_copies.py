"""One catalogue's rows copied into another, whatever databases hold them."""

from collections.abc import Mapping

from sqlalchemy import Connection, delete, insert, select, text, update

from sorvolo.errors import StoreError
from sorvolo.store.site import schema

_AT_ONCE = 1000  # rows


def copy_rows(source: Connection, target: Connection) -> None:
    """Make the target's rows the source's, inside the callers' transactions; both have the newest format.

    Raises StoreError where the source has an older one: Sorvolo brings it up to date when it writes to that site.
    """
    found = schema.format_of(source)
    if found != schema.SCHEMA_VERSION:
        raise StoreError(
            f"the catalogue has format version {found}, {schema.SCHEMA_VERSION} was needed to copy it; map, compare or "
            "review something in that site first"
        )
    for table in reversed(schema.metadata.sorted_tables):
        target.execute(delete(table))
    for table in schema.metadata.sorted_tables:
        for rows in source.execute(select(table)).mappings().partitions(_AT_ONCE):
            target.execute(insert(table), [dict(row) for row in rows])
    _set_numbers(target, _numbers(source))


def _numbers(connection: Connection) -> Mapping[str, int]:
    """The numbers given last to runs and versions: those of rows that are gone are never given again."""
    if connection.dialect.name == "sqlite":
        rows = connection.execute(text("SELECT name, seq FROM sqlite_sequence"))
    else:
        rows = connection.execute(select(schema.numbers.c.name, schema.numbers.c.last))
    known = {str(name): int(last) for name, last in rows}
    return {name: known.get(name, 0) for name in schema.NUMBERED}


def _set_numbers(connection: Connection, numbers: Mapping[str, int]) -> None:
    for name, last in numbers.items():
        if connection.dialect.name == "sqlite":
            connection.execute(
                text("DELETE FROM sqlite_sequence WHERE name = :name"), {"name": name}
            )
            connection.execute(
                text("INSERT INTO sqlite_sequence (name, seq) VALUES (:name, :last)"),
                {"name": name, "last": last},
            )
        else:
            connection.execute(
                update(schema.numbers).where(schema.numbers.c.name == name).values(last=last)
            )
