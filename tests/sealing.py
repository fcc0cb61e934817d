"""Seals a catalogue's rows again after a test changed them, as a stranger who makes a site could."""

import hashlib
from contextlib import suppress
from pathlib import Path

from sqlalchemy import create_engine, delete, insert, select, update

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


def write_again(site: Path, name: str, content: str | bytes) -> None:
    """Write a file of a site that the catalogue then holds for its own."""
    data = content.encode() if isinstance(content, str) else content
    (site / name).write_bytes(data)
    digest = hashlib.sha256(data).hexdigest()
    engine = create_engine(f"sqlite:///{site / 'site.db'}")
    with engine.begin() as connection:
        connection.execute(delete(schema.files).where(schema.files.c.path == name))
        connection.execute(insert(schema.files).values(path=name, sha256=digest))
    engine.dispose()
