"""The door to a site's database: what both kinds share, and the file of SQLite's (postgres.py is the other kind)."""

import hashlib
import itertools
import os
import sqlite3
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sqlalchemy import (
    URL,
    Connection,
    Engine,
    NullPool,
    create_engine,
    event,
    func,
    select,
    text,
    update,
)
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
class DatabaseLayout:
    """What a database of ours holds: its mark in a file's header, how its tables are made in a transaction.

    PostgreSQL looks for types in the schema `beside` as well. `page_bytes` is the size of a file's pages.
    """

    application_id: int
    make: Callable[[Connection], None]
    beside: str = ""
    page_bytes: int = 4096


CATALOGUE_LAYOUT = DatabaseLayout(0x536F7256, schema.make_tables)  # "SorV"


class ConnectionLostError(UnavailableError):
    """The connection to the database was lost: what was not committed is rolled back, the rest is kept."""


class SqliteDatabase:
    """A file; a reader's connections cannot write. See `Database`."""

    def __init__(
        self, path: Path, *, write: bool, layout: DatabaseLayout = CATALOGUE_LAYOUT
    ) -> None:
        self._layout, self._write, self._number = layout, write, next(_opened)
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
        """Make the empty tables, whole or not at all."""
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
        """Raise StoreError where this is no catalogue, or a damaged one; a writer takes the right to write."""
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
        """A transaction that sees one state of the catalogue."""
        with self._naming_faults(), self._engine.begin() as connection:
            yield connection

    changing = reading  # durable when it ends

    def fold_log(self) -> None:
        """Give back the space that the write-ahead log takes beside the site."""
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
        """A mark that changes with each transaction of others; what is read after it is at least as new."""
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
        """Close every connection and release the lock."""
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


OLDEST_SERVER = 15  # PostgreSQL's major version; older ones are not tested
# How long a writer waits for a server that restarts, and for the lock of a process that was just killed.
_PATIENCE_S = 20.0
_RETRY_S = 0.25
_WAITS = {  # of libpq, unless the URL has others: a server that is not there is noticed within a minute
    "connect_timeout": "10",
    "keepalives_idle": "20",
    "keepalives_interval": "10",
    "keepalives_count": "3",
    "tcp_user_timeout": "60000",
}
_LOST = ("08", "53300", "57P01", "57P02", "57P03", "57P05")  # 53300: all its connections are taken
_FULL = (
    "disk full: could not write {place} ({fault}); free some space on the server and run it again"
)
_BY_CODE = {
    "53100": _FULL,
    "53400": _FULL,
    "42501": "{place} cannot be written or read by {user} ({fault}); ask for a role that may, or work with a copy of "
    "the site",
    "25006": "{place} takes no changes ({fault}): a standby, or set to read only, as hosts do when a disk is full; "
    "name the server that is written to, or ask its administrator",
    **dict.fromkeys(("3F000", "42P01", "42703", "22P02"), DAMAGED),
}
_REFUSED = "{server} refused {user} ({fault}); "
_PASSWORD = _REFUSED + "give the password in ~/.pgpass or PGPASSWORD"
_LET_IN = (
    _REFUSED
    + "name another user in the address, or have the server's administrator let this user and "
    "computer in (pg_hba.conf)"
)
_SSL = (
    _REFUSED + "correct sslmode and sslrootcert in the address, or have the server's certificate "
    "mended"
)
_OTHER = "the address (--catalogue or SORVOLO_CATALOGUE)"
_BY_WORDS = {  # of libpq, which gives no code where no connection was made
    "could not write init file": _FULL,
    "No space left on device": _FULL,
    "password": _PASSWORD,
    "authentication failed": _PASSWORD,
    'role "': _LET_IN,
    "pg_hba": _LET_IN,
    "permission denied": _REFUSED + "ask for a role that may connect to this database",
    "certificate": _SSL,
    "does not support SSL": _SSL,
    "does not exist": f"{_REFUSED}make the database, or correct {_OTHER}",
    "invalid": f"{{server}}: {{fault}}; correct {_OTHER}",
}
_LOST_WORDS = (
    "no connection to {place} ({fault}); what was stored is safe: run the same command again when the server is there, "
    "it continues where it was"
)


class PostgresDatabase:
    """A schema of a database. Its one writer holds an advisory lock on the connection that it writes with.

    A lock is lost with its connection; the writer takes it again, and refuses to go on when another process wrote
    meanwhile. Readers' transactions cannot write.
    """

    def __init__(
        self, url: URL, name: str, *, write: bool, layout: DatabaseLayout = CATALOGUE_LAYOUT
    ) -> None:
        """`url` may have a password; `name` is the schema's, checked: letters, digits and underscores."""
        self._layout, self._write, self._number = layout, write, next(_opened)
        self._url, self._name = url, name
        self.place = f"{shown_url(url)} (schema {name})"
        self._readers = _open_engine_postgres(url, name, layout.beside, write=False)
        self._writers = _open_engine_postgres(url, name, layout.beside, write=True)
        self._writer: Connection | None = None
        self._writes = -1  # how many transactions had written when this writer last looked
        self._mutex = threading.RLock()

    def create(self) -> None:
        with self._naming_faults(), self._writers.begin() as connection:
            self._check_server(connection)
            connection.execute(text(f"CREATE SCHEMA {self._name}"))
            self._layout.make(connection)

    def check(self) -> None:
        with self.reading() as connection:
            self._check_server(connection)
            there = text("SELECT 1 FROM pg_namespace WHERE nspname = :name")
            if connection.execute(there, {"name": self._name}).first() is None:
                raise StoreError(
                    f"{shown_url(self._url)} has no schema {self._name}, which this folder points to; restore it "
                    "there, or name the right database in SORVOLO_CATALOGUE. Nothing was changed"
                )
        if self._write:
            with self._mutex, self._naming_faults():
                self._ready_writer()

    @contextmanager
    def reading(self) -> Iterator[Connection]:
        with self._naming_faults(), self._patiently(self._readers.connect) as connection:
            with connection.begin():
                yield connection

    @contextmanager
    def changing(self) -> Iterator[Connection]:
        with self._mutex, self._naming_faults():
            connection = self._ready_writer()
            with connection.begin():
                yield connection
                count = update(schema.numbers).where(schema.numbers.c.name == schema.WRITES)
                connection.execute(count.values(last=schema.numbers.c.last + 1))
            self._writes += 1

    def change_mark(self) -> tuple[int, int]:
        with self.reading() as connection:
            return self._number, _writes(connection)

    def close(self) -> None:
        with self._mutex:
            self._drop_writer()
        self._readers.dispose()

    def fold_log(self) -> None:
        """A server looks after its own log."""

    def _check_server(self, connection: Connection) -> None:
        version = int(connection.execute(text("SHOW server_version_num")).scalar_one()) // 10_000
        encoding = connection.execute(text("SHOW server_encoding")).scalar_one()
        place = shown_url(self._url)
        if version < OLDEST_SERVER:
            raise StoreError(
                f"{place} is PostgreSQL {version}, {OLDEST_SERVER} or later was needed; choose another server"
            )
        if encoding != "UTF8":
            raise StoreError(
                f"{place} has the encoding {encoding}, UTF8 was needed; choose another database"
            )

    def _patiently(self, connect: Callable[[], Connection]) -> Connection:
        """A connection; a writer, which may have worked for hours, waits for a server that restarts."""
        until_s = time.monotonic() + (_PATIENCE_S if self._write and self._writes >= 0 else 0.0)
        while True:
            try:
                return connect()
            except DBAPIError:
                if time.monotonic() >= until_s:
                    raise
            time.sleep(_RETRY_S)

    def _ready_writer(self) -> Connection:
        """The connection that holds the lock; reopened, and locked, if the server closed it between two uses."""
        if self._writer is not None:
            try:
                with self._writer.begin():
                    self._writer.execute(select(1))
                return self._writer
            except DBAPIError as error:
                self._drop_writer()
                if not _is_lost(error):
                    raise
        connection = self._patiently(self._writers.connect)
        try:
            self._lock(connection)
            with connection.begin():
                writes = _writes(connection)
            if self._writes not in (-1, writes):
                raise UnavailableError(
                    f"another process wrote to {self.place} while the connection was lost; run it again"
                )
        except BaseException:
            connection.close()
            raise
        self._writer, self._writes = connection, writes
        return connection

    def _lock(self, connection: Connection) -> None:
        key = int.from_bytes(hashlib.sha256(self._name.encode()).digest()[:8], signed=True)
        until_s = time.monotonic() + _PATIENCE_S
        while True:  # the server notices a killed process only when it reads from it again
            with connection.begin():
                if connection.execute(select(func.pg_try_advisory_lock(key))).scalar_one():
                    return
            if time.monotonic() >= until_s:
                raise UnavailableError(
                    f"another process is mapping into {self.place}; wait until it has finished"
                )
            time.sleep(_RETRY_S)

    def _drop_writer(self) -> None:
        if self._writer is not None:
            writer, self._writer = self._writer, None
            writer.invalidate()  # closed at once: a connection that goes back to a pool keeps its lock
            writer.close()

    @contextmanager
    def _naming_faults(self) -> Iterator[None]:
        try:
            yield
        except DBAPIError as error:
            if _is_lost(error):
                with self._mutex:
                    self._drop_writer()
            raise self._fault(error) from error

    def _fault(self, error: DBAPIError) -> StoreError:
        """What to do about a fault of PostgreSQL's."""
        state = _state(error)
        lines = str(error.orig).strip().splitlines() or [type(error.orig).__name__]
        fault = lines[0] if state else " ".join(lines)
        advice = (
            None if state else next((_BY_WORDS[each] for each in _BY_WORDS if each in fault), None)
        )
        if state and not _is_lost(error):
            refusal = f"cannot use {{place}}: {{fault}} ({state}); ask the server's administrator"
            advice = _BY_CODE.get(state, refusal)
        user = self._url.username or "this user"
        text = (advice or _LOST_WORDS).format(
            place=self.place, server=shown_url(self._url), user=user, fault=fault
        )
        if advice is None:
            return ConnectionLostError(text)
        return DiskFullError(text) if advice == _FULL else StoreError(text)


Database = SqliteDatabase | PostgresDatabase
"""A file of SQLite's or a schema of PostgreSQL's. Threads may share it; `place` is what messages call it.

Faults of the database become a StoreError in every method; its text never holds a password.
"""


def shown_url(url: URL) -> str:
    """A URL as messages and the site folder have it: neither user nor password."""
    host = url.host or url.query.get("host") or "localhost"
    port = f":{url.port}" if url.port else ""
    return f"postgresql://{host}{port}/{url.database or ''}"


def _open_engine_postgres(url: URL, name: str, beside: str, *, write: bool) -> Engine:
    own: dict[str, Any] = {key: value for key, value in _WAITS.items() if key not in url.query}
    # a writer keeps what the server is set to
    reads = "" if write else " -cdefault_transaction_read_only=on"
    path = f"{name},{beside}" if beside else name
    own["options"] = f"{url.query.get('options', '')} -csearch_path={path}{reads}".strip()
    own.setdefault("application_name", "sorvolo")
    pool: dict[str, Any] = (
        {"poolclass": NullPool} if write else {"poolclass": QueuePool, "pool_pre_ping": True}
    )
    if not write:
        own["cursor_factory"] = _binary_cursor
    try:
        return create_engine(
            url.difference_update_query(["options"]),
            connect_args=own,
            isolation_level="REPEATABLE READ",
            **pool,
        )
    except ModuleNotFoundError as error:
        raise StoreError(
            "a catalogue in PostgreSQL needs psycopg: pip install 'sorvolo[postgres]'"
        ) from error


def _binary_cursor(connection: Any, **options: Any) -> Any:
    """A cursor whose rows arrive as PostgreSQL holds them: outlines and tiles' bytes would be twice as long in hex."""
    from psycopg import Cursor
    from psycopg.pq import Format

    cursor: Any = Cursor(connection, **options)
    cursor.format = Format.BINARY
    return cursor


def _writes(connection: Connection) -> int:
    query = select(schema.numbers.c.last).where(schema.numbers.c.name == schema.WRITES)
    return connection.execute(query).scalar_one()


def _state(error: DBAPIError) -> str:
    """PostgreSQL's five-character error code; "" where no server answered."""
    return getattr(error.orig, "sqlstate", None) or ""


def _is_lost(error: DBAPIError) -> bool:
    return error.connection_invalidated or _state(error).startswith(_LOST)
