"""A site copied from one end to another, or compared with its copy, file by file, each by its SHA-256."""

import hashlib
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO, Protocol

from sorvolo.errors import StoreError
from sorvolo.store.copies.site_state import DamagedError, SiteFile, SiteState, chunks_of


class SiteEnd(Protocol):
    """One end of a copy: a folder or an object store."""

    @property
    def name(self) -> str:
        """The place, for messages."""
        ...

    @property
    def has_site(self) -> bool:
        """Whether a site is there, or a copy that is not finished."""
        ...

    def state(self, scratch: Path) -> SiteState:
        """The site as of now, its catalogue in a file in `scratch`."""
        ...

    def is_still(self, state: SiteState, scratch: Path) -> bool:
        """Whether the site is unchanged."""
        ...

    def opened(self, file: SiteFile) -> AbstractContextManager[BinaryIO]:
        """A file's bytes; raises FileNotFoundError when it is gone."""
        ...

    def being_filled(self) -> AbstractContextManager[None]:
        """Around all that writes."""
        ...

    def accept(self, new: SiteState, scratch: Path) -> None:
        """Prepare to become this state; raises StoreError where that would lose anything."""
        ...

    def lacks(self, state: SiteState) -> list[SiteFile]:
        """The files that have yet to be put."""
        ...

    def put(self, file: SiteFile, stream: BinaryIO) -> bool:
        """Write a file, unless its bytes are there: False. Raises DamagedError for those of another SHA-256."""
        ...

    def conclude(self, state: SiteState) -> None:
        """Make everything that was put the site, atomically."""
        ...

    def free_bytes(self) -> int | None:
        """Room for files; None where unknown."""
        ...


@dataclass(frozen=True)
class CopyUpdate:
    """Progress: files and bytes done, of those to be copied or compared."""

    done: int
    files: int
    done_bytes: int
    bytes: int


@dataclass(frozen=True)
class CopyOutcome:
    """What became of a copy, or of a comparison: `faults` has each file that is missing, damaged or different, and how.

    `copied` and `copied_bytes` count what was written (or compared), `files` and `bytes` what the site has; `newest` is
    the newest version of its map. `left_out` are files in the source's folder that do not belong to the site.
    """

    files: int
    bytes: int
    copied: int
    copied_bytes: int
    newest: int
    faults: Mapping[str, str]
    left_out: tuple[str, ...] = ()


_THERE = "there"  # of a file: found only by its bytes, where an interrupted copy left them


@dataclass
class _Counts:
    """What was copied so far, over all rounds."""

    copied: int = 0
    copied_bytes: int = 0
    faults: dict[str, str] = field(default_factory=dict)
    gone: set[str] = field(default_factory=set)


def copy(
    source: SiteEnd,
    target: SiteEnd,
    scratch: Path,
    *,
    threads: int = 4,
    most_rounds: int = 20,
    room: Callable[[int, int | None], None] = lambda needed, free: None,
) -> Generator[CopyUpdate, None, CopyOutcome]:
    """Make `target` a copy of `source` as of one moment, even if the source changes meanwhile.

    What is there already is not copied again, so that an interrupted copy continues. `scratch` is a folder for
    catalogues. `room` gets the bytes that are needed and those that are free, before each round, and may raise. Files
    that the source has lost or that are damaged there are left out and named in the outcome. Raises StoreError as the
    ends do, and when the source changed during each of `most_rounds` rounds.
    """
    counts = _Counts()
    with target.being_filled():
        for _ in range(most_rounds):
            state = source.state(scratch)
            target.accept(state, scratch)
            lacking = [each for each in target.lacks(state) if each.path not in counts.faults]
            room(sum(each.size for each in lacking), target.free_bytes())
            gone = yield from _move(source, target, lacking, counts, threads)
            for path in (
                gone & counts.gone
            ):  # gone in two rounds: another process is not just replacing it
                counts.faults[path] = "missing"
            counts.gone = gone
            if not gone - counts.faults.keys() and source.is_still(state, scratch):
                target.conclude(state)
                return CopyOutcome(
                    len(state.files),
                    sum(each.size for each in state.files.values()),
                    counts.copied,
                    counts.copied_bytes,
                    state.held.newest,
                    counts.faults,
                    state.left_out,
                )
    raise StoreError(
        f"{source.name} changes faster than it can be copied; run the same command again later"
    )


def _move(
    source: SiteEnd, target: SiteEnd, files: list[SiteFile], counts: _Counts, threads: int
) -> Generator[CopyUpdate, None, set[str]]:
    """Copy these files; the paths of those that are gone."""
    gone = set()
    total = sum(each.size for each in files)
    done = done_bytes = 0

    def move(file: SiteFile) -> str:
        try:
            with source.opened(file) as stream:
                return "" if target.put(file, stream) else _THERE
        except FileNotFoundError:
            return "gone"
        except DamagedError:
            return "damaged"

    for file, fault in in_parallel(move, files, threads):
        if fault == "gone":
            gone.add(file.path)
        elif fault not in ("", _THERE):
            counts.faults[file.path] = fault
        elif not fault:
            counts.copied += 1
            counts.copied_bytes += file.size
        done, done_bytes = done + 1, done_bytes + file.size
        yield CopyUpdate(done, len(files), done_bytes, total)
    return gone


def verify(
    source: SiteEnd, copied: SiteEnd, scratch: Path, *, threads: int = 4
) -> Generator[CopyUpdate, None, CopyOutcome]:
    """Compare a copy with the site, each file by its SHA-256, writing nothing to either.

    Raises StoreError where either end has no site, or the site changed meanwhile.
    """
    state = source.state(_made(scratch / "source"))
    theirs = copied.state(_made(scratch / "copy"))
    if state.held.identity != theirs.held.identity:
        raise StoreError(f"{copied.name} holds another site, not {state.held.name!r}")
    faults = _differences(state, theirs)
    both = [each for each in state.files.values() if each.path in theirs.files]
    total = sum(each.size for each in both)

    def compare(file: SiteFile) -> str:
        expected = file.sha256 or sha256_at(source, file)
        found = sha256_at(copied, theirs.files[file.path])
        if not found:
            return "missing"
        return "" if found == expected else "damaged" if file.sha256 else "differs"

    done = done_bytes = 0
    for file, fault in in_parallel(compare, both, threads):
        if fault:
            faults[file.path] = fault
        done, done_bytes = done + 1, done_bytes + file.size
        yield CopyUpdate(done, len(both), done_bytes, total)
    if faults and not source.is_still(state, scratch):
        raise StoreError(f"{source.name} changed while it was compared; run the same command again")
    return CopyOutcome(
        len(state.files), total, len(both), total, state.held.newest, faults, state.left_out
    )


def _differences(state: SiteState, theirs: SiteState) -> dict[str, str]:
    """How a copy differs by its catalogue and the names of its files."""
    faults = {}
    if state.held.digest != theirs.held.digest:
        faults["site.db"] = (
            f"differs: version {theirs.held.newest} of the map, the site has {state.held.newest}"
        )
    faults |= {path: "not in the site" for path in theirs.files.keys() - state.files.keys()}
    return faults | {path: "missing" for path in state.files.keys() - theirs.files.keys()}


def sha256_at(end: SiteEnd, file: SiteFile) -> str:
    """The SHA-256 of a file's bytes as they are now; "" where it is gone."""
    digest = hashlib.sha256()
    try:
        with end.opened(file) as stream:
            for chunk in chunks_of(stream):
                digest.update(chunk)
    except FileNotFoundError:
        return ""
    return digest.hexdigest()


def in_parallel(
    work: Callable[[SiteFile], str], files: Iterable[SiteFile], threads: int
) -> Iterator[tuple[SiteFile, str]]:
    """What `work` returns of each file, in order; few are begun ahead. An error ends it, and nothing more is begun."""
    waiting: deque[tuple[SiteFile, Future[str]]] = deque()
    pool = ThreadPoolExecutor(threads, thread_name_prefix="copy")
    try:
        for file in files:
            waiting.append((file, pool.submit(work, file)))
            if len(waiting) > 4 * threads:
                first, result = waiting.popleft()
                yield first, result.result()
        while waiting:
            first, result = waiting.popleft()
            yield first, result.result()
    finally:
        pool.shutdown(cancel_futures=True)


def _made(folder: Path) -> Path:
    folder.mkdir()
    return folder
