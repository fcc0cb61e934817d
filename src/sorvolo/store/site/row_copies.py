"""One catalogue's rows copied into another, whatever databases hold them."""

from sqlalchemy import Connection, delete, insert, select, update

from sorvolo.store.site import schema

_AT_ONCE = 1000  # rows


def copy_rows(source: Connection, target: Connection) -> None:
    """Make the target's rows the source's, inside the callers' transactions."""
    for table in reversed(schema.metadata.sorted_tables):
        target.execute(delete(table))
    for table in schema.metadata.sorted_tables:
        for rows in source.execute(select(table)).mappings().partitions(_AT_ONCE):
            target.execute(insert(table), [dict(row) for row in rows])
    # the numbers of runs and versions that are gone are not given again
    numbers = schema.numbers
    for row in source.execute(select(numbers).where(numbers.c.name.in_(schema.NUMBERED))):
        target.execute(update(numbers).where(numbers.c.name == row.name).values(last=row.last))
