"""A catalogue in PostgreSQL, one schema for each site: all that only PostgreSQL needs."""

import hashlib
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from sqlalchemy import URL, Connection, Engine, NullPool, create_engine, func, select, text, update
from sqlalchemy.exc import DBAPIError
from sqlalchemy.pool import QueuePool

from sorvolo.errors import DiskFullError, StoreError, UnavailableError
from sorvolo.store.site import schema
from sorvolo.store.site.database import (
    CATALOGUE_LAYOUT,
    DAMAGED,
    ConnectionLostError,
    Database,
    Layout,
)

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


class PostgresDatabase(Database):
    """A schema of a database. Its one writer holds an advisory lock on the connection that it writes with.

    A lock is lost with its connection; the writer takes it again, and refuses to go on when another process wrote
    meanwhile. Readers' transactions cannot write.
    """

    def __init__(
        self, url: URL, name: str, *, write: bool, layout: Layout = CATALOGUE_LAYOUT
    ) -> None:
        """`url` may have a password; `name` is the schema's, checked: letters, digits and underscores."""
        super().__init__(layout, write=write)
        self._url, self._name = url, name
        self.place = f"{shown_url(url)} (schema {name})"
        self._readers = _open_engine(url, name, layout.beside, write=False)
        self._writers = _open_engine(url, name, layout.beside, write=True)
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


def shown_url(url: URL) -> str:
    """A URL as messages and the site folder have it: neither user nor password."""
    host = url.host or url.query.get("host") or "localhost"
    port = f":{url.port}" if url.port else ""
    return f"postgresql://{host}{port}/{url.database or ''}"


def _open_engine(url: URL, name: str, beside: str, *, write: bool) -> Engine:
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
