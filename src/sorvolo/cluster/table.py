"""The result of each flight of a batch: a table that survives every kill, and the lock of its folder.

`batch.jsonl` holds a row for each change, the newest of a flight last; it is written anew, without the older ones, when
a batch begins. `docs/formats.md` has its fields.
"""

import json
import os
import signal
import socket
import time
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from enum import StrEnum
from pathlib import Path
from typing import Any, BinaryIO, Self

from sorvolo.cluster.orders import WORKER, Ending, Scouted
from sorvolo.errors import StoreError
from sorvolo.store.atomic import atomic_write_bytes, writing
from sorvolo.store.locks import take_lock
from sorvolo.store.site.catalogue import utc_now
from sorvolo.store.site.catalogue_place import is_site

TABLE, LOCK = "batch.jsonl", "batch.lock"
_FORMAT = 1
_ENDING_S = 10.0  # how long workers of a batch that was killed may take to end, and
_PATIENCE_S = 2.0  # to end by themselves: then they are killed


class State(StrEnum):
    """Where a flight of a batch stands."""

    WAITING = "waiting"
    RUNNING = "running"
    DONE = "done"
    DOUBTFUL = "doubtful"  # used, but its result is to be checked before use
    DUPLICATE = "duplicate"  # the same flight as another, under another name
    SKIPPED = "skipped"  # no flight, though it may be taken for one
    FAILED = "failed"  # it cannot be used as it is
    SET_ASIDE = "set aside"  # it ended its process each time


FINAL = frozenset({State.DONE, State.DOUBTFUL, State.SET_ASIDE})
"""States that stand as long as the flight's files and what is asked for of it are the same."""


@dataclass(frozen=True)
class Row:
    """One flight: its files, its site, and what became of it.

    `request` is what is asked for, `stamp` its files', `tries` how often it was begun for this request, of which
    `crashes` ended its process; seconds and processor time are those of all tries together, the memory is the largest.
    """

    source: str
    mission: str
    stamp: str
    request: str
    scouted: Scouted | None
    site: str = ""
    flight: str = ""
    state: State = State.WAITING
    words: str = ""
    tries: int = 0
    crashes: int = 0
    seconds: float = 0.0
    cpu_s: float = 0.0
    peak_memory_mb: float = 0.0
    host: str = ""
    changed_utc: str = ""

    @property
    def key(self) -> tuple[str, str]:
        """What a row is of: the mission and the flight, by its fingerprint, or by its path while that is unknown."""
        return self.mission, self.scouted.fingerprint if self.scouted else self.source

    def after(self, ending: Ending, state: State, words: str) -> Self:
        """The row after a try."""
        return replace(
            self,
            state=state,
            words=words,
            flight=ending.flight or self.flight,
            seconds=round(self.seconds + ending.seconds, 3),
            cpu_s=round(self.cpu_s + ending.cpu_s, 3),
            peak_memory_mb=max(self.peak_memory_mb, ending.peak_memory_mb),
            host=ending.host,
        )

    @classmethod
    def of(cls, plain: Mapping[str, Any]) -> Self:
        """A row as it stands in the file. Raises TypeError, KeyError or ValueError for another object."""
        seen = plain["scouted"]
        if seen is not None:
            seen = Scouted(**{**seen, "box": None if seen["box"] is None else tuple(seen["box"])})
        return cls(**{**plain, "scouted": seen, "state": State(plain["state"])})


class BatchTable:
    """The rows of a folder of sites, by `Row.key`. Only `put` changes them. A context manager; made by `open`."""

    def __init__(self, root: Path, lock: int, rows: dict[tuple[str, str], Row]) -> None:
        self.root, self.lock = root, lock
        self._rows = rows
        self._file: BinaryIO = (root / TABLE).open("ab")

    @classmethod
    def open(cls, root: Path) -> Self:
        """Open the table of a folder, which is made if it is not there, as its only batch.

        Raises StoreError for a folder that another batch works in, that is a site itself or cannot be written, and for
        a table of another format.
        """
        _make(root)
        lock = _locked(root)
        try:
            rows = _read(root / TABLE)
            lines = [
                _line({"made_by": "sorvolo batch", "format": _FORMAT}),
                *map(_row_line, rows.values()),
            ]
            atomic_write_bytes(root / TABLE, b"".join(lines))
            return cls(root, lock, rows)
        except BaseException:
            os.close(lock)
            raise

    def close(self) -> None:
        """Let go of the folder."""
        self._file.close()
        os.close(self.lock)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __iter__(self) -> Iterator[Row]:
        return iter(list(self._rows.values()))

    def get(self, key: tuple[str, str]) -> Row | None:
        """The newest row of a flight."""
        return self._rows.get(key)

    def put(self, row: Row) -> Row:
        """Keep the newest row of a flight: on the disk when this returns; the row as it is kept."""
        row = replace(row, changed_utc=utc_now())
        with writing(self.root / TABLE):
            self._file.write(_row_line(row))
            self._file.flush()
            os.fsync(self._file.fileno())
        self._rows[row.key] = row
        return row


def _make(root: Path) -> None:
    if is_site(root):
        raise StoreError(
            f"{root} is a site itself; a batch makes several: name the folder above it, or a new one"
        )
    try:
        with writing(root):
            root.mkdir(parents=True, exist_ok=True)
    except (FileExistsError, NotADirectoryError) as error:
        raise StoreError(f"{root} is a file, a folder was needed; choose another name") from error


def _locked(root: Path) -> int:
    """The right to work in the folder, as a descriptor; a batch that was killed has it until its workers are gone."""
    path = root / LOCK
    with writing(path):
        lock = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o644)
    began_s = time.monotonic()
    while not take_lock(lock):
        holder = _holder(lock)
        waited_s = time.monotonic() - began_s
        if _is_alive(holder) or waited_s > _ENDING_S:
            os.close(lock)
            who = holder or "its name is not known"
            raise StoreError(
                f"another batch is running in {root}: {who}; wait until it ends, or stop it"
            )
        if waited_s > _PATIENCE_S:
            _kill_orphans(path)
        time.sleep(0.1)
    os.ftruncate(lock, 0)
    os.pwrite(
        lock, f"process {os.getpid()} on {socket.gethostname()}, since {utc_now()}".encode(), 0
    )
    return lock


def _kill_orphans(lock: Path) -> None:
    """Kill the workers of a batch that is gone which do not end by themselves: stopped ones, and those that hang.

    None where the system does not state which files processes have open (there is no /proc).
    """
    own = lock.stat()
    for process in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):  # it has ended, or is another user's
            if WORKER.encode() not in (process / "cmdline").read_bytes().split(b"\0"):
                continue
            if any(os.path.samestat(each.stat(), own) for each in (process / "fd").iterdir()):
                os.kill(int(process.name), signal.SIGKILL)


def _holder(lock: int) -> str:
    return os.pread(lock, 1000, 0).decode("utf-8", "replace").strip()


def _is_alive(holder: str) -> bool:
    """Whether the process that a lock names exists; on another machine it is assumed to."""
    words = holder.split()
    if len(words) < 4 or not words[1].isdecimal() or words[3].rstrip(",") != socket.gethostname():
        return bool(holder)
    try:
        os.kill(int(words[1]), 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        pass
    return True


def _read(path: Path) -> dict[tuple[str, str], Row]:
    """The newest row of each flight; a last line that a kill tore is passed over."""
    rows: dict[tuple[str, str], Row] = {}
    try:
        lines = path.read_bytes().split(b"\n")
    except FileNotFoundError:
        return rows
    except OSError as error:
        raise StoreError(f"{path} cannot be read ({error.strerror})") from error
    for number, line in enumerate(lines):
        try:
            plain = json.loads(line) if line else None
            if number == 0:
                _demand_format(path, plain)
            elif plain is not None:
                row = Row.of(plain)
                rows.pop((row.mission, row.source), None)  # from when its files could not be read
                rows[row.key] = row
        except (ValueError, TypeError, KeyError) as error:
            if number >= len(lines) - 1:
                break
            raise StoreError(
                f"{path}: line {number + 1} is no row of a batch ({error}); move the file away"
            ) from error
    return rows


def _demand_format(path: Path, head: Any) -> None:
    if not isinstance(head, dict) or head.get("made_by") != "sorvolo batch":
        raise StoreError(
            f"{path} is not a table of sorvolo batch; move it away, or choose another --root"
        )
    if head.get("format") != _FORMAT:
        raise StoreError(
            f"{path} has format {head.get('format')}, this version reads {_FORMAT}; use the version that wrote it"
        )


def _row_line(row: Row) -> bytes:
    return _line(asdict(row))


def _line(content: Mapping[str, Any]) -> bytes:
    return json.dumps(content, ensure_ascii=False).encode("utf-8", "surrogateescape") + b"\n"
