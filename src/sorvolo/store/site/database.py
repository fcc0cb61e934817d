"""Database: what a catalogue needs of its database; the faults that both kinds share."""

import itertools
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Protocol

from sqlalchemy import Connection

from sorvolo.errors import StoreError, UnavailableError

numbers = itertools.count()
"""One for each catalogue opened, so that no two have a change mark in common."""


@dataclass(frozen=True)
class Layout:
    """What a database of ours holds: its mark in a file's header, how its tables are made in a transaction.

    `beside` is a schema of PostgreSQL's in which types are looked for as well; "" for none. `page_bytes` is the size
    of a file's pages: larger ones for larger rows.
    """

    application_id: int
    make: Callable[[Connection], None]
    beside: str = ""
    page_bytes: int = 4096


class ConnectionLostError(UnavailableError):
    """The connection to the database was lost: what was not committed is rolled back, the rest is kept."""


class Database(Protocol):
    """Where a catalogue lies: a file of SQLite's, or a schema of a PostgreSQL database."""

    @property
    def place(self) -> str:
        """What messages call it; never with a password."""

    def create(self) -> None:
        """Make the tables of the newest format, whole or not at all. Raises StoreError."""

    def check(self) -> None:
        """Raise StoreError where this is no catalogue, or a damaged one; for a writer, take the right to write."""

    def reading(self) -> AbstractContextManager[Connection]:
        """A transaction that sees one state of the catalogue. Raises StoreError for faults of the database."""

    def changing(self) -> AbstractContextManager[Connection]:
        """A transaction, durable when it ends. Raises StoreError as `reading`."""

    def fold_log(self) -> None:
        """Give back the space that a write-ahead log takes, where it lies beside the site."""

    def change_mark(self) -> tuple[int, int]:
        """A mark that changes with each transaction of others; no two open catalogues share one.

        What is read after it is at least as new. Raises StoreError.
        """

    def close(self) -> None:
        """Close every connection and release the lock."""


def damaged(place: str, fault: object) -> StoreError:
    """The error for a damaged catalogue."""
    return StoreError(
        f"{place} is damaged or not a Sorvolo catalogue ({fault}); nothing was changed: "
        "restore it from a copy, or map into a new folder"
    )
