"""Database: what a catalogue asks of the database that it lies in; the faults that both kinds share."""

import itertools
from contextlib import AbstractContextManager
from typing import Protocol

from sqlalchemy import Connection

from sorvolo.errors import StoreError

numbers = itertools.count()
"""One for each catalogue opened, so that no two have a change mark in common."""


class ConnectionLostError(StoreError):
    """The database went away in the middle of something: what was not committed is undone, the rest stands."""


class Database(Protocol):
    """Where a catalogue lies: a file of SQLite's, or a schema of a PostgreSQL database."""

    @property
    def place(self) -> str:
        """What messages call it; never with a password."""

    def create(self) -> None:
        """Make the tables of the newest format, whole or not at all. Raises StoreError."""

    def check(self) -> None:
        """Raise StoreError where this is no catalogue, or a damaged one; for a writer, take the right to write."""

    def set_format(self, connection: Connection, number: int) -> None:
        """Note the format that the tables have now, inside the caller's transaction."""

    def reading(self) -> AbstractContextManager[Connection]:
        """A transaction that sees one state of the catalogue. Raises StoreError for faults of the database."""

    def changing(self) -> AbstractContextManager[Connection]:
        """A transaction that happens whole, on the disk, or not at all. Raises StoreError as `reading`."""

    def fold_log(self) -> None:
        """Give back the space that a write-ahead log takes, where it lies beside the site."""

    def change_mark(self) -> tuple[int, int]:
        """Another one after each transaction of others that changed the catalogue; no two that were opened share one.

        What is read after it is at least as new. Raises StoreError.
        """

    def close(self) -> None:
        """Close every connection, and let go of the right to write."""


def damaged(place: str, fault: object) -> StoreError:
    """The error for a catalogue that cannot be what Sorvolo wrote."""
    return StoreError(
        f"{place} is damaged or not a Sorvolo catalogue ({fault}); nothing was changed: "
        "restore it from a copy, or map into a new folder"
    )
