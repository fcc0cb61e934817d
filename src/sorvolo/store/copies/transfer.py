"""A site copied from one end to another, or compared with its copy, file by file, each by its SHA-256."""

from collections.abc import Callable, Generator, Mapping
from dataclasses import dataclass
from pathlib import Path

from sorvolo.errors import StoreError
from sorvolo.store.ahead import in_order
from sorvolo.store.copies.bucket import BucketEnd
from sorvolo.store.copies.folder import FolderEnd, SiteFile
from sorvolo.store.nofollow import sha256_of
from sorvolo.store.site.files import DamagedError

SiteEnd = FolderEnd | BucketEnd


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
    catalogues. `room` gets the bytes that are needed and those that are free, before each round, and may raise
    StoreError. Raises StoreError as both ends do, and when the source changed during each of `most_rounds` rounds.
    """
    copied = copied_bytes = 0

    def move(file: SiteFile) -> str:
        try:
            with source.opened(file) as stream:
                return "" if target.put(file, stream) else "there"
        except FileNotFoundError:
            return "missing"
        except DamagedError:
            return "damaged"

    with target.being_filled():
        for _ in range(most_rounds):
            state = source.state(scratch)
            target.accept(state, scratch)
            lacking = target.lacks(state)
            total = sum(file.size for file in lacking)
            room(total, target.free_bytes())
            faults: dict[str, str] = {}
            done = done_bytes = 0
            for file, outcome in zip(lacking, in_order(move, lacking, threads=threads)):
                if outcome in ("missing", "damaged"):
                    faults[file.path] = outcome
                elif not outcome:
                    copied, copied_bytes = copied + 1, copied_bytes + file.size
                done, done_bytes = done + 1, done_bytes + file.size
                yield CopyUpdate(done, len(lacking), done_bytes, total)
            if source.is_still(state, scratch):
                target.conclude(state)
                size = sum(file.size for file in state.files.values())
                return CopyOutcome(
                    len(state.files),
                    size,
                    copied,
                    copied_bytes,
                    state.held.newest,
                    faults,
                    state.left_out,
                )
    raise StoreError(
        f"{source.name} changes faster than it can be copied; run the same command again later"
    )


def verify(
    source: SiteEnd, copied: SiteEnd, scratch: Path
) -> Generator[CopyUpdate, None, CopyOutcome]:
    """Compare a copy with the site, each file by its SHA-256, writing nothing to either.

    Raises StoreError where either end has no site, or the site changed meanwhile.
    """
    for name in ("source", "copy"):
        (scratch / name).mkdir()
    state, theirs = source.state(scratch / "source"), copied.state(scratch / "copy")
    if state.held.identity != theirs.held.identity:
        raise StoreError(f"{copied.name} holds another site, not {state.held.name!r}")
    faults = {}
    if state.held.digest != theirs.held.digest:
        faults["site.db"] = (
            f"differs: version {theirs.held.newest} of the map, the site has {state.held.newest}"
        )
    faults |= dict.fromkeys(theirs.files.keys() - state.files.keys(), "not in the site")
    faults |= dict.fromkeys(state.files.keys() - theirs.files.keys(), "missing")
    both = [each for each in state.files.values() if each.path in theirs.files]
    total = sum(each.size for each in both)

    def compare(file: SiteFile) -> str:
        expected = file.sha256 or _sha256_at(source, file)
        found = _sha256_at(copied, theirs.files[file.path])
        if not found:
            return "missing"
        return "" if found == expected else "damaged" if file.sha256 else "differs"

    done = done_bytes = 0
    for file, fault in zip(both, in_order(compare, both, threads=4)):
        if fault:
            faults[file.path] = fault
        done, done_bytes = done + 1, done_bytes + file.size
        yield CopyUpdate(done, len(both), done_bytes, total)
    if faults and not source.is_still(state, scratch):
        raise StoreError(f"{source.name} changed while it was compared; run the same command again")
    return CopyOutcome(
        len(state.files), total, len(both), total, state.held.newest, faults, state.left_out
    )


def _sha256_at(end: SiteEnd, file: SiteFile) -> str:
    """The SHA-256 of a file's bytes as they are now; "" where it is gone."""
    try:
        with end.opened(file) as stream:
            return sha256_of(stream)
    except FileNotFoundError:
        return ""
