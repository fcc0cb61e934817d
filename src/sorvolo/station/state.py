"""What the station keeps on its disk: its own database, the lock of its root, room for a full disk."""

import json
import os
import shutil
import sqlite3
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

from sorvolo.errors import DiskFullError, StoreError
from sorvolo.store.atomic import take_lock, writing

STATE_FILE = "station.db"
"""The file of the station's memory, in its own folder."""

_FORMAT = 3
_TABLES = """
CREATE TABLE IF NOT EXISTS events (
  seq INTEGER PRIMARY KEY AUTOINCREMENT, at TEXT NOT NULL, type TEXT NOT NULL, site TEXT, run TEXT, data TEXT NOT NULL);
CREATE TABLE IF NOT EXISTS runs (
  id TEXT PRIMARY KEY, made_at TEXT NOT NULL, site TEXT NOT NULL, mission TEXT NOT NULL, state TEXT NOT NULL,
  record TEXT NOT NULL, journal_offset INTEGER NOT NULL DEFAULT 0);
CREATE TABLE IF NOT EXISTS tokens (
  id TEXT PRIMARY KEY, name TEXT NOT NULL UNIQUE, role TEXT NOT NULL, hash TEXT NOT NULL, made_at TEXT NOT NULL,
  expires_at TEXT);
CREATE TABLE IF NOT EXISTS reviews (
  number INTEGER PRIMARY KEY AUTOINCREMENT, site TEXT NOT NULL, made_utc TEXT NOT NULL, kind TEXT NOT NULL,
  id TEXT NOT NULL, revision INTEGER NOT NULL, verdict TEXT NOT NULL, label TEXT NOT NULL, note TEXT NOT NULL,
  who TEXT NOT NULL, at TEXT NOT NULL, UNIQUE (site, made_utc, kind, id, revision));
"""


class StationState:
    """The open file `station/station.db` below the root; `reading` and `changing` give one transaction each.

    Threads may share it. Made by `open`.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._lock = threading.RLock()
        self._connection = sqlite3.connect(
            path, timeout=30, isolation_level=None, check_same_thread=False
        )
        self._connection.row_factory = sqlite3.Row

    @classmethod
    def open(cls, folder: Path) -> "StationState":
        """Open or make the file in the station's folder. Raises StoreError where it cannot be, or is another's."""
        with writing(folder):
            folder.mkdir(parents=True, exist_ok=True)
            folder.chmod(0o700)  # it holds hashes of tokens and the addresses of streams
        path = folder / STATE_FILE
        try:
            state = cls(path)
            with state._lock:
                run = state._connection.execute
                run("PRAGMA journal_mode = WAL")
                run("PRAGMA synchronous = FULL")
                run("PRAGMA trusted_schema = OFF")
                found = run("PRAGMA user_version").fetchone()[0]
                if found not in (0, _FORMAT):
                    raise StoreError(
                        f"{path} has format {found}, this Sorvolo works with {_FORMAT}; use the Sorvolo that made it, "
                        "or move the file away"
                    )
                state._connection.executescript(_TABLES)
                run(f"PRAGMA user_version = {_FORMAT}")
        except sqlite3.Error as error:
            raise StoreError(
                f"cannot use {path}: {error}; check the disk, or move the file away"
            ) from error
        return state

    def close(self) -> None:
        """Close the file."""
        with self._lock:
            self._connection.close()

    @contextmanager
    def changing(self) -> Iterator[sqlite3.Connection]:
        """A transaction, durable when it ends. Raises StoreError on a full disk."""
        with self._lock:
            try:
                self._connection.execute("BEGIN IMMEDIATE")
                try:
                    yield self._connection
                except BaseException:
                    self._connection.execute("ROLLBACK")
                    raise
                self._connection.execute("COMMIT")
            except sqlite3.OperationalError as error:
                if self._connection.in_transaction:
                    self._connection.execute("ROLLBACK")
                if error.sqlite_errorcode == sqlite3.SQLITE_FULL:
                    raise DiskFullError(
                        f"disk full: could not write {self.path} ({error}); free some space"
                    ) from error
                raise StoreError(f"cannot write {self.path} ({error}); free some space") from error

    def rows(self, query: str, values: Sequence[Any] = ()) -> list[sqlite3.Row]:
        """The rows of a query."""
        with self._lock:
            return self._connection.execute(query, values).fetchall()


def utc_now() -> str:
    """The time, RFC 3339 UTC to the millisecond."""
    return utc_after(0.0)


def utc_after(seconds: float) -> str:
    """The time in so many seconds, RFC 3339 UTC to the millisecond; such texts are in order as the times are."""
    return (
        (datetime.now(UTC) + timedelta(seconds=seconds))
        .isoformat(timespec="milliseconds")
        .replace("+00:00", "Z")
    )


def compact_json(value: Any) -> str:
    """The value as one line of JSON."""
    return json.dumps(value, ensure_ascii=False, allow_nan=False, separators=(",", ":"))


_RESERVE_BYTES = 8_000_000  # some hundred runs' last states, with SQLite's journal


def shortage(folder: Path, floor_gb: float, coming_gb: float = 0.0) -> str:
    """How little of the folder's disk is free where that is less than the floor; "" where there is room."""
    free_gb = shutil.disk_usage(folder).free / 1e9
    if free_gb - coming_gb >= floor_gb:
        return ""
    coming = f", {coming_gb:.1f} GB of uploads are to come" if coming_gb else ""
    return f"{free_gb:.2f} GB are free{coming}, and {floor_gb:.2f} GB must stay so"


class Reserve:
    """A file that holds some room on the disk, so that what a full disk did can still be written down."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def hold(self) -> None:
        """Take the room, where it is not held and the disk has it."""
        if self._path.exists() or shutil.disk_usage(self._path.parent).free < 2 * _RESERVE_BYTES:
            return
        with suppress(OSError), self._path.open("wb") as file:
            if hasattr(os, "posix_fallocate"):
                os.posix_fallocate(file.fileno(), 0, _RESERVE_BYTES)
            else:
                file.write(bytes(_RESERVE_BYTES))

    def give(self) -> bool:
        """Give the room back to the disk; whether there was any."""
        was_held = self._path.exists()
        self._path.unlink(missing_ok=True)
        return was_held


_FILE = "station.lock"


class RootLock:
    """The lock of a station's folder, held until `close`. A file that a killed station left locks nobody out."""

    def __init__(self, folder: Path) -> None:
        """Raises StoreError where another station holds it, or it cannot be written."""
        with writing(folder):
            folder.mkdir(parents=True, exist_ok=True)
            self._file = os.open(folder / _FILE, os.O_RDWR | os.O_CREAT, 0o600)
        if not take_lock(self._file):
            holder = os.pread(self._file, 20, 0).decode("ascii", "replace").strip()
            self.close()
            raise StoreError(
                f"{folder.parent}: another station serves this folder already (process {holder or 'unknown'}); end "
                "that one first, or serve another folder"
            )
        with writing(folder):
            os.ftruncate(self._file, 0)
            os.pwrite(self._file, f"{os.getpid()}\n".encode(), 0)

    def close(self) -> None:
        """Let another station in; again: nothing."""
        if self._file >= 0:
            os.close(self._file)
            self._file = -1


class ThreadOwner:
    """A part of the station with a thread, which works until `_ending` is set. `begin` and `close` begin and end it."""

    def __init__(self, name: str, work: Callable[[], None]) -> None:
        self._ending = threading.Event()
        self._thread = threading.Thread(target=work, name=name, daemon=True)

    def begin(self) -> None:
        """Begin to work."""
        self._thread.start()

    def close(self) -> None:
        """Stop working; what was not done yet is done when the station runs again."""
        self._ending.set()
        if self._thread.is_alive():
            self._thread.join(5.0)
