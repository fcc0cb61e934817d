"""Seals a catalogue's rows again after a test changed them, as a stranger who makes a site could."""

from contextlib import suppress
from pathlib import Path

from sqlalchemy import create_engine, select, update

from sorvolo.store.site import schema


def seal_again(database: Path) -> None:
    """Give all rows the seal of what they hold now; not those that cannot be read."""
    engine = create_engine(f"sqlite:///{database}")
    for table in schema.metadata.sorted_tables:
        if "seal" not in table.c:
            continue
        with suppress(ValueError, TypeError), engine.begin() as connection:
            for row in connection.execute(select(table)).all():
                same = [column == row._mapping[column.name] for column in table.primary_key]
                seal = schema.seal_of(table, row._mapping)
                connection.execute(update(table).where(*same).values(seal=seal))
    engine.dispose()
