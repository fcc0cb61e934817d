"""The folder of a site: the names of what lies in it (docs/formats.md), and the right to write there."""

import os
from enum import StrEnum
from pathlib import Path

from sorvolo.errors import StoreError, UnavailableError
from sorvolo.store.atomic import TEMPORARY_PREFIX, writing
from sorvolo.store.locks import take_lock
from sorvolo.store.nofollow import refuse_links
from sorvolo.store.site.catalogue_place import CATALOGUE, POINTER, Catalogues, create_database
from sorvolo.store.site.origin import ORIGIN, TILE_SIZES, UNSENT

STAGED = "staged"
"""The folder of a flight in which its next run collects pictures until it is committed."""

LIVE_PREVIEW, LIVE_COVERAGE = "live.png", "live-coverage.geojson"
JOURNAL = "run.journal"
"""The file of a flight's folder from which a killed run goes on."""

LOCK = "site.lock"
"""Held by the one process that writes."""

COPYING = "copying.json"
"""In the folder while a copy of a site is made there."""


class BusyError(UnavailableError):
    """Another process writes the site."""


class DamagedError(StoreError):
    """A file's bytes are not those that were written."""


class HeightFile(StrEnum):
    """The files of a flight's folder that hold its heights."""

    SURFACE = "heights.tif"
    GROUND = "terrain.tif"
    ORTHOPHOTO = "orthophoto.tif"
    PICTURE = "heights.png"
    REPORT = "heights.json"


def lock_folder(folder: Path) -> int:
    """The right to write, as a file descriptor to close; raises StoreError when another process has it."""
    path = folder / LOCK
    if path.is_symlink():
        refuse_links(folder)
    with writing(path):
        lock = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK, 0o644)
    if not take_lock(lock):
        os.close(lock)
        raise BusyError(f"another process is mapping into {folder}; wait until it has finished")
    return lock


def refuse_unfinished(folder: Path) -> None:
    """Raise StoreError for a folder into which a site is being copied."""
    if (folder / COPYING).is_file():
        raise StoreError(
            f"the copy in {folder} is not finished; run the same `sorvolo site copy` again"
        )


def begin_writing(folder: Path, catalogues: Catalogues | None) -> int:
    """Make the folder a site unless it is one; the right to write, as a file descriptor to close.

    Raises StoreError as `Archive.open` does.
    """
    refuse_unfinished(folder)
    _make_folder(folder)
    lock = lock_folder(folder)
    try:
        refuse_traps(folder)
        if not _has_catalogue(folder):
            create_database(folder, catalogues)
    except BaseException:
        os.close(lock)
        raise
    return lock


def _make_folder(folder: Path) -> None:
    """Create the folder; refuse one that holds anything but a site (or what a killed creation left)."""
    try:
        with writing(folder):
            folder.mkdir(parents=True, exist_ok=True)
    except (FileExistsError, NotADirectoryError) as error:
        raise StoreError(f"{folder} is a file, a folder was needed; choose another name") from error
    if _has_catalogue(folder):
        return
    names = (path.name for path in folder.iterdir())
    own = (LOCK, ORIGIN, TILE_SIZES, UNSENT)
    foreign = sorted(
        name for name in names if name not in own and not name.startswith(TEMPORARY_PREFIX)
    )
    if foreign:
        raise StoreError(
            f"{folder} is no site: it holds {foreign[0]!r} and no {CATALOGUE}; choose a new or empty folder"
        )


def _has_catalogue(folder: Path) -> bool:
    """Whether a catalogue, or what calls itself one, is there already: it is never written over."""
    return any((folder / name).exists() for name in (CATALOGUE, POINTER))


def refuse_traps(folder: Path, *, skipped: frozenset[str] = frozenset()) -> None:
    """Raise StoreError for links, and for a rollback journal: SQLite would follow and delete the files it names.

    Sorvolo's catalogue is in write-ahead mode and never has one.
    """
    refuse_links(folder, skipped=skipped)
    journal = folder / f"{CATALOGUE}-journal"
    if journal.exists():
        raise StoreError(f"{journal} is no file of Sorvolo's; remove it, or do not use this site")
