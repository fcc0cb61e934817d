"""A catalogue in PostgreSQL: one schema for each site. With postgres_refusal.py the only place that knows it."""

import hashlib
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from sqlalchemy import URL, Connection, Engine, NullPool, create_engine, func, select, text, update
from sqlalchemy.exc import DBAPIError, ProgrammingError
from sqlalchemy.pool import QueuePool

from sorvolo.errors import DiskFullError, StoreError, UnavailableError
from sorvolo.store.site import schema
from sorvolo.store.site.database import ConnectionLostError, Layout, damaged, numbers
from sorvolo.store.site.postgres_refusal import refusal_codes
from sorvolo.store.site.sqlite_database import CATALOGUE_LAYOUT

OLDEST_SERVER = 15  # PostgreSQL's major version; older ones are not tested
_PATIENCE_S = 20.0
"""How long a writer waits for a server that restarts, and for the lock of a process that was just killed."""

_LOOK_AGAIN_S = 0.25  # at a lock that another process holds; by choice
_WAITS = {  # of libpq, unless the URL has others: a server that is not there is noticed within a minute
    "connect_timeout": "10",
    "keepalives_idle": "20",
    "keepalives_interval": "10",
    "keepalives_count": "3",
    "tcp_user_timeout": "60000",
}
_LOST = ("08", "53300", "57P01", "57P02", "57P03", "57P05")  # 53300: all its connections are taken
_FULL = ("53100", "53400")
_FORBIDDEN = ("42501",)
_ONLY_READS = ("25006",)
_NOT_OURS = ("3F000", "42P01", "42703", "22P02")
_PASSWORD = "give the password in ~/.pgpass or PGPASSWORD"
_ENCRYPTION = (
    "correct sslmode and sslrootcert in the address, or have the server's certificate mended"
)
_REFUSALS = (  # by the server's code; by words where no code is known, which are English, as libpq's own always are
    ("28P01", ("password", "authentication failed"), _PASSWORD),
    (
        "28000",
        ('role "', "pg_hba"),
        "name another user in the address, or have the server's administrator let this "
        "user and computer in (pg_hba.conf)",
    ),
    ("42501", ("permission denied",), "ask for a role that may connect to this database"),
    ("", ("certificate", "does not support SSL"), _ENCRYPTION),
    (
        "3D000",
        ("does not exist",),
        "make the database, or correct the address (--catalogue or SORVOLO_CATALOGUE)",
    ),
)
_FULL_WORDS = (
    "could not write init file",
    "No space left on device",
)  # where nobody can connect for that


class PostgresDatabase:
    """A schema of a database. Its one writer holds an advisory lock on the connection that it writes with.

    A lock is lost with its connection; the writer takes it again, and refuses to go on when another process wrote
    meanwhile. Readers' transactions see one state, and cannot write. Threads may share it.
    """

    def __init__(
        self, url: URL, name: str, *, write: bool, layout: Layout = CATALOGUE_LAYOUT
    ) -> None:
        """`url` may have a password; `name` is the schema's, checked: letters, digits and underscores."""
        self._url, self._name, self._write, self._layout = url, name, write, layout
        self._readers = _open_engine(url, name, layout.beside, write=False)
        self._writers = _open_engine(url, name, layout.beside, write=True)
        self._writer: Connection | None = None
        self._writes = -1  # how many transactions had written when this writer last looked
        self._mutex = threading.RLock()
        self._number = next(numbers)

    @property
    def place(self) -> str:
        """Server, database and schema, without a password."""
        return f"{shown_url(self._url)} (schema {self._name})"

    def create(self) -> None:
        """Make the schema and its tables in one transaction. Raises StoreError, also for a server that is too old."""
        with self._naming_faults(), self._writers.begin() as connection:
            self._check_server(connection)
            connection.execute(text(f"CREATE SCHEMA {self._name}"))
            self._layout.make(connection)

    def check(self) -> None:
        """Raise StoreError where server or schema does not fit; a writer takes the lock, or raises StoreError."""
        with self.reading() as connection:
            self._check_server(connection)
            known = text("SELECT 1 FROM pg_namespace WHERE nspname = :name")
            if connection.execute(known, {"name": self._name}).first() is None:
                raise StoreError(
                    f"{shown_url(self._url)} has no schema {self._name}, which this folder points to; restore it "
                    "there, or name the right database in SORVOLO_CATALOGUE. Nothing was changed"
                )
        if self._write:
            with self._mutex, self._naming_faults():
                self._ready_writer()

    @contextmanager
    def reading(self) -> Iterator[Connection]:
        """A transaction that sees one state of the catalogue."""
        with (
            self._naming_faults(),
            self._patiently(self._readers.connect) as connection,
            connection.begin(),
        ):
            yield connection

    @contextmanager
    def changing(self) -> Iterator[Connection]:
        """A transaction, durable when it ends; for the one writer."""
        with self._mutex, self._naming_faults():
            connection = self._ready_writer()
            with connection.begin():
                yield connection
                count = update(schema.numbers).where(schema.numbers.c.name == schema.WRITES)
                connection.execute(count.values(last=schema.numbers.c.last + 1))
            self._writes += 1

    def fold_log(self) -> None:
        """Nothing: the server keeps its own log."""

    def change_mark(self) -> tuple[int, int]:
        """As of `Database`: how many transactions have written."""
        with self.reading() as connection:
            return self._number, _writes(connection)

    def close(self) -> None:
        """Close every connection, which frees the lock."""
        with self._mutex:
            self._drop_writer()
        self._readers.dispose()

    def _check_server(self, connection: Connection) -> None:
        version = int(connection.execute(text("SHOW server_version_num")).scalar_one()) // 10_000
        if version < OLDEST_SERVER:
            raise StoreError(
                f"{shown_url(self._url)} is PostgreSQL {version}, {OLDEST_SERVER} or later was needed; choose another "
                "server"
            )
        encoding = connection.execute(text("SHOW server_encoding")).scalar_one()
        if encoding != "UTF8":
            raise StoreError(
                f"{shown_url(self._url)} has the encoding {encoding}, UTF8 was needed; choose another database"
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
            time.sleep(_LOOK_AGAIN_S)

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
            time.sleep(_LOOK_AGAIN_S)

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
        """What to do about a fault of PostgreSQL's. The text never holds the password."""
        state = _state(error)
        lines = str(error.orig).strip().splitlines() or [type(error.orig).__name__]
        fault = lines[0]
        if state.startswith(_FULL):
            return self._full(fault)
        if state.startswith(_FORBIDDEN):
            return StoreError(
                f"{self.place} cannot be written or read by {self._url.username or 'this user'} ({fault}); ask for a "
                "role that may, or work with a copy of the site"
            )
        if state.startswith(_ONLY_READS):
            return StoreError(
                f"{self.place} takes no changes ({fault}): a standby, or set to read only, as hosts do when a disk "
                "is full; name the server that is written to, or ask its administrator"
            )
        if state.startswith(_NOT_OURS):
            return damaged(self.place, fault)
        if _is_lost(error):
            return self._lost(" ".join(lines))
        if (
            isinstance(error, ProgrammingError) and not state
        ):  # an option of the address that libpq does not know
            return self._misspelt(fault)
        if not state:
            return self._refused(
                " ".join(lines), refusal_codes(self._url, float(_WAITS["connect_timeout"]))
            )
        return self._unusable(fault, state)

    def _refused(self, fault: str, codes: Sequence[str]) -> StoreError:
        """What to do where no connection was made; `codes` are those of the server's errors, where they are known."""
        for code, words, advice in _REFUSALS:
            if code in codes or (not codes and any(each in fault for each in words)):
                user = self._url.username or "this user"
                return StoreError(f"{shown_url(self._url)} refused {user} ({fault}); {advice}")
        if not codes and "invalid" in fault:
            return self._misspelt(fault)
        if any(code.startswith(_FULL) for code in codes) or any(
            words in fault for words in _FULL_WORDS
        ):
            return self._full(fault)
        unknown = next((code for code in codes if not code.startswith(_LOST)), "")
        return self._unusable(fault, unknown) if unknown else self._lost(fault)

    def _misspelt(self, fault: str) -> StoreError:
        return StoreError(
            f"{shown_url(self._url)}: {fault}; correct the address (--catalogue or SORVOLO_CATALOGUE)"
        )

    def _lost(self, fault: str) -> StoreError:
        return ConnectionLostError(
            f"no connection to {self.place} ({fault}); what was stored is safe: run the same command again when the "
            "server is there, it continues where it was"
        )

    def _unusable(self, fault: str, state: str) -> StoreError:
        return StoreError(
            f"cannot use {self.place}: {fault} ({state}); ask the server's administrator"
        )

    def _full(self, fault: str) -> StoreError:
        return DiskFullError(
            f"disk full: could not write {self.place} ({fault}); free some space on the server and run it again"
        )


def shown_url(url: URL) -> str:
    """A URL as messages and the site folder have it: neither user nor password."""
    host = url.host or url.query.get("host") or "localhost"
    port = f":{url.port}" if url.port else ""
    return f"postgresql://{host}{port}/{url.database or ''}"


def _open_engine(url: URL, name: str, beside: str, *, write: bool) -> Engine:
    own: dict[str, Any] = {key: value for key, value in _WAITS.items() if key not in url.query}
    reads = (
        "" if write else " -cdefault_transaction_read_only=on"
    )  # a writer keeps what the server is set to
    path = f"{name},{beside}" if beside else name
    asked = url.query.get("options", "")
    own["options"] = f"{asked} -csearch_path={path}{reads}".strip()
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
