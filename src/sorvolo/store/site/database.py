"""The door to a site's database: what both kinds share, and the file of SQLite's (postgres.py is the other kind)."""

import itertools
import os
import sqlite3
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from pathlib import Path

from sqlalchemy import Connection, Engine, create_engine, event
from sqlalchemy.exc import DBAPIError
from sqlalchemy.pool import PoolProxiedConnection, QueuePool

from sorvolo.errors import DiskFullError, StoreError, UnavailableError
from sorvolo.store.atomic import atomic_path
from sorvolo.store.site import schema

DAMAGED = (
    "{place} is damaged or not a Sorvolo catalogue ({fault}); nothing was changed: restore it from a copy, or map into "
    "a new folder"
)
_opened = itertools.count()  # one for each database opened: no two have a change mark in common


@dataclass(frozen=True)
class Layout:
    """What a database of ours holds: its mark in a file's header, how its tables are made in a transaction.

    PostgreSQL looks for types in the schema `beside` as well. `page_bytes` is the size of a file's pages.
    """

    application_id: int
    make: Callable[[Connection], None]
    beside: str = ""
    page_bytes: int = 4096


CATALOGUE_LAYOUT = Layout(0x536F7256, schema.make_tables)  # "SorV"


class ConnectionLostError(UnavailableError):
    """The connection to the database was lost: what was not committed is rolled back, the rest is kept."""


class Database(ABC):
    """A file of SQLite's or a schema of PostgreSQL's. Threads may share it.

    Faults of the database become a StoreError in every method; its text never holds a password.
    """

    place: str  # what messages call it

    def __init__(self, layout: Layout, *, write: bool) -> None:
        self._layout, self._write, self._number = layout, write, next(_opened)

    @abstractmethod
    def create(self) -> None:
        """Make the empty tables, whole or not at all."""

    @abstractmethod
    def check(self) -> None:
        """Raise StoreError where this is no catalogue, or a damaged one; a writer takes the right to write."""

    @abstractmethod
    def reading(self) -> AbstractContextManager[Connection]:
        """A transaction that sees one state of the catalogue."""

    @abstractmethod
    def changing(self) -> AbstractContextManager[Connection]:
        """A transaction, durable when it ends."""

    @abstractmethod
    def change_mark(self) -> tuple[int, int]:
        """A mark that changes with each transaction of others; what is read after it is at least as new."""

    @abstractmethod
    def close(self) -> None:
        """Close every connection and release the lock."""

    def fold_log(self) -> None:  # noqa: B027 - only SQLite keeps one
        """Give back the space that a write-ahead log takes beside the site."""


class SqliteDatabase(Database):
    """A file; a reader's connections cannot write."""

    def __init__(self, path: Path, *, write: bool, layout: Layout = CATALOGUE_LAYOUT) -> None:
        super().__init__(layout, write=write)
        self.place, self._path = str(path), path
        self._made: Engine | None = None
        self._watching: PoolProxiedConnection | None = None
        self._watching_lock = threading.Lock()

    @property
    def _engine(self) -> Engine:
        if self._made is None:
            self._made = _open_engine(self._path, write=self._write)
        return self._made

    def create(self) -> None:
        with self._naming_faults(), atomic_path(self._path) as temporary:
            connection = sqlite3.connect(temporary)
            connection.execute(f"PRAGMA page_size = {self._layout.page_bytes:d}")
            connection.execute("PRAGMA journal_mode = WAL")
            connection.execute(f"PRAGMA application_id = {self._layout.application_id}")
            connection.close()
            engine = _open_engine(temporary, write=True)
            with engine.begin() as made:
                self._layout.make(made)
            engine.dispose()

    def check(self) -> None:
        with self.reading() as connection:
            mark = connection.exec_driver_sql("PRAGMA application_id").scalar_one()
            if mark != self._layout.application_id:
                raise StoreError(
                    f"{self._path} is not a Sorvolo catalogue; choose another site folder"
                )
            if self._write:
                fault = connection.exec_driver_sql("PRAGMA quick_check(1)").scalar_one()
                if fault != "ok":
                    raise StoreError(DAMAGED.format(place=self.place, fault=fault))

    @contextmanager
    def reading(self) -> Iterator[Connection]:
        with self._naming_faults(), self._engine.begin() as connection:
            yield connection

    changing = reading

    def fold_log(self) -> None:
        connection = self._engine.raw_connection()
        try:
            connection.cursor().execute("PRAGMA wal_checkpoint(TRUNCATE)")
        except sqlite3.OperationalError as error:
            raise DiskFullError(
                f"disk full: could not tidy {self._path} ({error}); free some space"
            ) from error
        finally:
            connection.close()

    def change_mark(self) -> tuple[int, int]:
        # The file's time is no such mark: a transaction writes the log, waits for the disk, and only then is visible.
        with self._naming_faults(), self._watching_lock:
            if self._watching is None:
                # the number counts within one connection, which is kept for it
                self._watching = self._engine.raw_connection()
                self._watching.detach()
            cursor = self._watching.cursor()
            try:
                return self._number, int(cursor.execute("PRAGMA data_version").fetchone()[0])
            finally:
                cursor.close()

    def close(self) -> None:
        with self._watching_lock:
            if self._watching is not None:
                self._watching.close()
                self._watching = None
        if self._made is not None:
            self._made.dispose()

    @contextmanager
    def _naming_faults(self) -> Iterator[None]:
        try:
            yield
        except (sqlite3.Error, DBAPIError) as error:
            fault = str(error.orig if isinstance(error, DBAPIError) else error)
            code = getattr(getattr(error, "orig", error), "sqlite_errorcode", 0) & 0xFF
            if code == sqlite3.SQLITE_FULL:
                raise DiskFullError(
                    f"disk full: could not write {self._path} ({fault}); free some space and run it again"
                ) from error
            if code in _UNUSABLE:
                raise StoreError(
                    f"cannot use {self._path}: {fault}; check the disk and its permissions"
                ) from error
            raise StoreError(DAMAGED.format(place=self.place, fault=fault)) from error


_UNUSABLE = (
    sqlite3.SQLITE_READONLY,
    sqlite3.SQLITE_BUSY,
    sqlite3.SQLITE_LOCKED,
    sqlite3.SQLITE_CANTOPEN,
    sqlite3.SQLITE_IOERR,
)
"""Codes of a disk or of permissions that refuse, not of damage."""


def _open_engine(path: Path, *, write: bool) -> Engine:
    uri = path.resolve().as_uri() + ("?mode=rw" if write else "?mode=ro")
    has_log = path.with_name(path.name + "-wal").exists()
    if not write and not os.access(path.parent, os.W_OK) and not has_log:
        uri += "&immutable=1"  # SQLite cannot put its lock files beside a file on a read-only disk

    def connect() -> sqlite3.Connection:
        # isolation_level None: the module must not begin transactions by itself, SQLAlchemy does it below
        connection = sqlite3.connect(
            uri, uri=True, timeout=30, isolation_level=None, check_same_thread=False
        )
        # a stranger's triggers and views call no functions
        connection.execute("PRAGMA trusted_schema = OFF")
        connection.execute("PRAGMA foreign_keys = ON")
        connection.execute("PRAGMA synchronous = FULL")
        return connection

    engine = create_engine("sqlite://", creator=connect, poolclass=QueuePool)

    @event.listens_for(engine, "begin")
    def begin(connection: Connection) -> None:
        connection.exec_driver_sql("BEGIN")

    return engine
