"""A catalogue in SQLite: the file `site.db` of the site folder. The only place that knows SQLite."""

import os
import sqlite3
import threading
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path

from sqlalchemy import Connection, Engine, create_engine, event
from sqlalchemy.exc import DBAPIError
from sqlalchemy.pool import PoolProxiedConnection, QueuePool

from sorvolo.errors import DiskFullError, StoreError
from sorvolo.store.atomic import atomic_path
from sorvolo.store.site import schema
from sorvolo.store.site.database import Layout, damaged, numbers

CATALOGUE_LAYOUT = Layout(0x536F7256, schema.make_tables)  # "SorV"


class SqliteDatabase:
    """The file; a reader's connections cannot write. Threads may share it."""

    def __init__(self, path: Path, *, write: bool, layout: Layout = CATALOGUE_LAYOUT) -> None:
        self._path, self._write, self._layout = path, write, layout
        self._made: Engine | None = None
        self._number = next(numbers)
        self._watching: PoolProxiedConnection | None = None
        self._watching_lock = threading.Lock()

    @property
    def place(self) -> str:
        """The file's path."""
        return str(self._path)

    @property
    def _engine(self) -> Engine:
        if self._made is None:
            self._made = _open_engine(self._path, write=self._write)
        return self._made

    def create(self) -> None:
        """Put an empty catalogue into its place, whole from its first moment."""
        try:
            with atomic_path(self._path) as temporary:
                _create_tables(temporary, self._layout)
        except (sqlite3.Error, DBAPIError) as error:
            raise _fault(self._path, error) from error

    def check(self) -> None:
        """Raise StoreError where the file is no catalogue; to write, also where it is damaged."""
        with self.reading() as connection:
            if (
                connection.exec_driver_sql("PRAGMA application_id").scalar_one()
                != self._layout.application_id
            ):
                raise StoreError(
                    f"{self._path} is not a Sorvolo catalogue; choose another site folder"
                )
            fault = (
                connection.exec_driver_sql("PRAGMA quick_check(1)").scalar_one()
                if self._write
                else "ok"
            )
            if fault != "ok":
                raise damaged(self.place, fault)

    @contextmanager
    def reading(self) -> Iterator[Connection]:
        """A transaction that sees one state of the catalogue."""
        try:
            with self._engine.begin() as connection:
                yield connection
        except DBAPIError as error:
            raise _fault(self._path, error) from error

    def changing(self) -> AbstractContextManager[Connection]:
        """A transaction, durable when it ends."""
        return self.reading()

    def fold_log(self) -> None:
        """Move the write-ahead log into the file and empty it: on a full disk, its space is needed again."""
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
        """As of `Database`. The file's time is no such mark: a transaction writes the log, waits for the disk, and only
        then becomes visible."""
        try:
            with self._watching_lock:
                if (
                    self._watching is None
                ):  # the number counts within one connection, which is kept for it
                    self._watching = self._engine.raw_connection()
                    self._watching.detach()
                cursor = self._watching.cursor()
                try:
                    return self._number, int(cursor.execute("PRAGMA data_version").fetchone()[0])
                finally:
                    cursor.close()
        except (sqlite3.Error, DBAPIError) as error:
            raise _fault(self._path, error) from error

    def close(self) -> None:
        """Close every connection; the last writer folds the write-ahead log into the file."""
        with self._watching_lock:
            if self._watching is not None:
                self._watching.close()
                self._watching = None
        if self._made is not None:
            self._made.dispose()


def _create_tables(path: Path, layout: Layout) -> None:
    connection = sqlite3.connect(path)
    connection.execute(f"PRAGMA page_size = {layout.page_bytes:d}")
    connection.execute("PRAGMA journal_mode = WAL")
    connection.execute(f"PRAGMA application_id = {layout.application_id}")
    connection.close()
    engine = _open_engine(path, write=True)
    with engine.begin() as made:
        layout.make(made)
    engine.dispose()


def _open_engine(path: Path, *, write: bool) -> Engine:
    uri = path.resolve().as_uri() + ("?mode=rw" if write else "?mode=ro")
    if (
        not write
        and not os.access(path.parent, os.W_OK)
        and not path.with_name(path.name + "-wal").exists()
    ):
        uri += "&immutable=1"  # SQLite cannot put its lock files beside a file on a read-only disk

    def connect() -> sqlite3.Connection:
        # isolation_level None: the module must not begin transactions by itself, SQLAlchemy does it below
        connection = sqlite3.connect(
            uri, uri=True, timeout=30, isolation_level=None, check_same_thread=False
        )
        connection.execute(
            "PRAGMA trusted_schema = OFF"
        )  # a stranger's triggers and views call no functions
        connection.execute("PRAGMA foreign_keys = ON")
        connection.execute("PRAGMA synchronous = FULL")
        return connection

    engine = create_engine("sqlite://", creator=connect, poolclass=QueuePool)

    @event.listens_for(engine, "begin")
    def begin(connection: Connection) -> None:
        connection.exec_driver_sql("BEGIN")

    return engine


def _fault(path: Path, error: Exception) -> StoreError:
    """What to do about a fault of SQLite's."""
    fault = str(error.orig if isinstance(error, DBAPIError) else error)
    if "full" in fault:
        return DiskFullError(
            f"disk full: could not write {path} ({fault}); free some space and run it again"
        )
    if any(words in fault for words in ("readonly", "locked", "unable to open", "disk I/O")):
        return StoreError(f"cannot use {path}: {fault}; check the disk and its permissions")
    return damaged(str(path), fault)
