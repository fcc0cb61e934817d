"""Older catalogues brought up to date by Alembic: one revision for each format, its number the format's."""

from pathlib import Path

from alembic.operations import Operations
from alembic.runtime.migration import MigrationContext
from alembic.script import ScriptDirectory
from sqlalchemy import Connection

_FOLDER = Path(__file__).parent


def upgrade(connection: Connection, found: int) -> None:
    """Run the migrations of all formats after `found`, inside the caller's transaction."""
    revisions = _script().walk_revisions(head="head")  # the newest first
    with Operations.context(MigrationContext.configure(connection)):
        for each in sorted(revisions, key=lambda revision: int(revision.revision)):
            if int(each.revision) > found:
                each.module.upgrade()


def stamp(connection: Connection, number: int) -> None:
    """Note the format in Alembic's own table, inside the caller's transaction."""
    MigrationContext.configure(connection).stamp(_script(), str(number))


def _script() -> ScriptDirectory:
    return ScriptDirectory(_FOLDER, version_locations=[_FOLDER / "versions"])
