"""A run's journal: what it knows of each frame so far, appended as it comes, so that a killed run can continue."""

import hashlib
import io
import json
import os
import struct
import threading
import time
import types
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, fields, is_dataclass, replace
from enum import Enum
from functools import cache
from io import BufferedRandom
from pathlib import Path
from tokenize import TokenError
from types import MappingProxyType
from typing import Any, TypeVar, get_args, get_origin, get_type_hints

import numpy as np
from numpy.lib.format import read_array, write_array
from numpy.typing import NDArray

from sorvolo.errors import goes_on
from sorvolo.store.atomic import writing

_MAGIC = b"sorvolo journal 2\n"
_SIZE = struct.Struct("<Q")  # bytes of an entry, and of its JSON
_MOST_BYTES = 1 << 30  # of one entry: a picture of 20 megapixels takes a sixteenth
_SYNC_EVERY_S = 1.0  # waiting for the disk after each entry would cost 4 to 5 ms each


@dataclass(frozen=True, eq=False)
class Entry:
    """One entry: values as JSON holds them (NaN and infinities, too), and arrays by name, none of objects.

    `at` is where it begins in the file that it was read from.
    """

    kind: str
    values: Mapping[str, Any]
    arrays: Mapping[str, NDArray[Any]] = field(default_factory=lambda: MappingProxyType({}))
    at: int = 0
    compresses: bool = False  # masks become small by it, photographs do not


class RunJournal:
    """The journal of one run at `path`. `append` adds an entry, from any thread; `entries` are the complete ones.

    `key` names the run that it is of, `after` over which version of the map (0: none), `program` by which version of
    Sorvolo. A file with others, or a damaged one,
    counts as empty. Nothing is written before the first `append`, which cuts off what comes after the last entry that
    was taken. An entry is whole after a kill or is not there; after a power cut those of the last second may be gone.
    Files are data only: no entry can make this program run anything.
    """

    def __init__(self, path: Path, key: str, after: int, program: str = "") -> None:
        self._path, self._run = path, {"key": key, "after": after, "sorvolo": program}
        self._file: BufferedRandom | None = None
        self._end = 0
        self._synced_s = -_SYNC_EVERY_S  # by the monotonic clock, when the disk had all of it last
        self._lock = threading.Lock()
        self._is_over = False

    @property
    def is_begun(self) -> bool:
        """Whether an earlier process began the file for this same run."""
        if not self._path.is_file():
            return False
        with open(self._path, "rb", opener=_no_link) as file:
            return _read_run(file) == self._run

    @property
    def why_not(self) -> str:
        """Why what an earlier process left cannot be used; "" where it can, or where there is nothing."""
        if not self._path.is_file():
            return ""
        with open(self._path, "rb", opener=_no_link) as file:
            run = _read_run(file)
        for name, reason in (
            ("sorvolo", f"another version of Sorvolo ({run.get('sorvolo')})"),
            ("after", "an earlier version of the map: the site has changed"),
            ("key", "other settings or files"),
        ):
            if run.get(name) != self._run[name]:
                return f"it was of {reason}" if run else "its journal is damaged"
        return ""

    def entries(self) -> Iterator[Entry]:
        """The entries of an earlier process, in order. An entry counts as taken when the next one is asked for."""
        if not self._path.is_file():
            return
        with open(self._path, "rb", opener=_no_link) as file:
            if _read_run(file) != self._run:
                return
            self._end = file.tell()
            while (entry := _read(file)) is not None:
                end = file.tell()
                yield replace(entry, at=self._end)
                self._end = end

    def entry(self, at: int) -> Entry | None:
        """Return the entry that begins there, also while new ones are appended; None where none does."""
        with open(self._path, "rb", opener=_no_link) as file:
            file.seek(at)
            return _read(file)

    def append(self, entry: Entry) -> None:
        """Add an entry; nothing once the run is over. Raises StoreError when the disk is full."""
        with self._lock, writing(self._path):
            if self._is_over:
                return
            file = self._file or self._begun()
            file.write(_packed(entry))
            file.flush()
            if time.monotonic() - self._synced_s >= _SYNC_EVERY_S:
                os.fdatasync(file.fileno()) if hasattr(os, "fdatasync") else os.fsync(file.fileno())
                self._synced_s = time.monotonic()

    def close(self) -> None:
        """Let go of the file, which stays."""
        if self._file is not None:
            with suppress(
                OSError
            ):  # on a full disk half an entry may wait to be written, which nobody can read
                self._file.close()
            self._file = None

    def end(self, error: BaseException | None) -> None:
        """The run ended, with this error or none: remove the journal, unless the same command can go on with it."""
        if not goes_on(error):
            self.remove()
            return
        with self._lock:
            self._is_over = True
            self.close()

    def remove(self) -> None:
        """The run is over: remove the journal."""
        with self._lock:
            self._is_over = True
            self.close()
            self._path.unlink(missing_ok=True)
        folder = self._path.parent
        if folder.is_dir() and not any(folder.iterdir()):
            folder.rmdir()

    def _begun(self) -> BufferedRandom:
        self._path.parent.mkdir(parents=True, exist_ok=True)
        file = os.fdopen(_no_link(str(self._path), os.O_RDWR | os.O_CREAT), "r+b")
        file.truncate(self._end)
        file.seek(self._end)
        if self._end == 0:
            file.write(_MAGIC + _packed(Entry("run", self._run)))
        self._file = file
        return file


def content_sha256(*values: Any) -> str:
    """A hash of records, arrays and plain values: equal for equal values.

    Raises TypeError for anything else, such as an open file.
    """
    digest = hashlib.sha256()
    _feed(digest, values)
    return digest.hexdigest()


def _feed(digest: "hashlib._Hash", value: Any) -> None:
    if isinstance(value, np.ndarray):
        digest.update(f"{value.dtype.str}{value.shape}".encode())
        digest.update(np.ascontiguousarray(value).tobytes())
        return
    if value is None or isinstance(value, bool | int | float | str | Path):
        digest.update(f"{type(value).__name__}:{value!r};".encode())
        return
    parts = _parts(value)
    digest.update(f"[{len(parts)}".encode())
    for each in parts:
        _feed(digest, each)


def _parts(value: Any) -> Sequence[Any]:
    if is_dataclass(value) and not isinstance(value, type):
        return [type(value).__name__, *(getattr(value, each.name) for each in fields(value))]
    if isinstance(value, Mapping):
        return sorted(value.items())
    if isinstance(value, list | tuple):
        return value
    raise TypeError(f"a {type(value).__name__} has no content that could be compared")


def is_journal_after(path: Path, version: int) -> bool:
    """Whether the file is the journal of a run over this version of the map: any other can no longer be used."""
    with open(path, "rb", opener=_no_link) as file:
        return _read_run(file).get("after") == version


def _read_run(file: Any) -> Mapping[str, Any]:
    """Return what the journal states of its run, or {} if the file is no journal."""
    first = _read(file) if file.read(len(_MAGIC)) == _MAGIC else None
    return {} if first is None or first.kind != "run" else first.values


def _no_link(path: str, flags: int) -> int:
    return os.open(path, flags | os.O_NOFOLLOW | os.O_NONBLOCK, 0o644)


def _packed(entry: Entry) -> bytes:
    """The entry's size, then a zlib stream of its JSON and its arrays in NumPy's own format."""
    text = json.dumps([entry.kind, dict(entry.values), list(entry.arrays)]).encode()
    body = io.BytesIO()
    body.write(_SIZE.pack(len(text)) + text)
    for array in entry.arrays.values():
        write_array(body, np.asarray(array), allow_pickle=False)
    data = zlib.compress(body.getvalue(), 1 if entry.compresses else 0)
    return _SIZE.pack(len(data)) + data


def _read(file: Any) -> Entry | None:
    """The next entry; None at the end, which is where anything is not as it was written."""
    try:
        (size,) = _SIZE.unpack(file.read(_SIZE.size))
        if size > os.fstat(file.fileno()).st_size - file.tell():
            return None
        unpacker = zlib.decompressobj()
        body = io.BytesIO(unpacker.decompress(file.read(size), _MOST_BYTES))
        kind, values, names = json.loads(body.read(*_SIZE.unpack(body.read(_SIZE.size))))
        arrays = {str(name): read_array(body, allow_pickle=False) for name in names}
    except (
        zlib.error,
        struct.error,
        TokenError,
        ValueError,
        TypeError,
        OverflowError,
        MemoryError,
        RecursionError,
    ):
        return None
    whole = unpacker.eof and isinstance(kind, str) and isinstance(values, dict)
    return Entry(kind, values, arrays) if whole else None


_T = TypeVar("_T")


def packed(value: Any, arrays: dict[str, NDArray[Any]]) -> Any:
    """Return a record as JSON holds it; its arrays are added to those of the entry that will hold it.

    Raises TypeError for what is neither a record, an array, bytes, a sequence, a mapping by text nor a plain value.
    """
    if isinstance(value, bytes):
        value = np.frombuffer(value, np.uint8)
    if isinstance(value, np.ndarray):
        name = f"a{len(arrays)}"
        arrays[name] = value
        return name
    if isinstance(value, Mapping):
        return {str(name): packed(part, arrays) for name, part in value.items()}
    if is_dataclass(value) and not isinstance(value, type):
        return [packed(getattr(value, each.name), arrays) for each in fields(value)]
    if isinstance(value, list | tuple):
        return [packed(each, arrays) for each in value]
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, Enum):
        return value.value
    if value is None or isinstance(value, bool | int | float | str):
        return value
    raise TypeError(f"a journal holds no {type(value).__name__}")


def unpacked(kind: type[_T], value: Any, arrays: Mapping[str, NDArray[Any]]) -> _T:
    """A record of this class from what `packed` made of it.

    Raises KeyError, TypeError or ValueError, or what the record itself raises, for anything else.
    """
    return _unpacked(kind, value, arrays)


def _unpacked(hint: Any, value: Any, arrays: Mapping[str, NDArray[Any]]) -> Any:
    origin, parts = get_origin(hint), get_args(hint)
    if origin is types.UnionType:
        kind = next(each for each in parts if each is not types.NoneType)
        return None if value is None else _unpacked(kind, value, arrays)
    if origin is np.ndarray:
        return arrays[value]
    if hint is bytes:
        return arrays[value].tobytes()
    if origin is Mapping:
        return {name: _unpacked(parts[1], part, arrays) for name, part in value.items()}
    if origin in (tuple, Sequence) or is_dataclass(hint):
        if not isinstance(value, list):
            raise TypeError("a sequence was needed")
        names = _hints(hint) if is_dataclass(hint) else {}  # type: ignore[arg-type]
        hints = tuple(names.values()) or parts
        if origin is Sequence or hints[-1:] == (Ellipsis,):
            hints = (hints[0],) * len(value)
        inside = [_unpacked(*each, arrays) for each in zip(hints, value, strict=True)]
        return hint(**dict(zip(names, inside))) if names else tuple(inside)
    if issubclass(hint, Enum):
        return hint(value)
    if hint is float and type(value) is int:
        return float(value)
    if type(value) is not hint:
        raise TypeError(f"{hint.__name__} was needed, not {type(value).__name__}")
    return value


@cache
def _hints(kind: type) -> dict[str, Any]:
    hints = get_type_hints(kind)
    return {each.name: hints[each.name] for each in fields(kind)}
