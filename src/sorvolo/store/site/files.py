"""The folder of a site: the names of what lies in it (docs/formats.md), and the right to write there."""

import os
import re
import unicodedata
from collections.abc import Mapping
from enum import StrEnum
from pathlib import Path
from typing import Protocol

from sorvolo.errors import StoreError, UnavailableError
from sorvolo.store.atomic import TEMPORARY_PREFIX, make_folder, take_lock, writing
from sorvolo.store.nofollow import refuse_links
from sorvolo.store.site.catalogue_place import CATALOGUE, POINTER, Catalogues, create_database

_PUNCTUATION = set(" -_.,+()[]{}@=#&'!~%^$;`")
_MOST_BYTES = 200  # file systems allow 255; endings and prefixes are added
_DOCUMENT = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_-]{0,80}(\.[A-Za-z0-9]{1,10}){1,2}")
_SHA256 = re.compile(r"[0-9a-f]{64}")
_EPSG = re.compile(r"EPSG:[1-9][0-9]{0,8}")


def is_plain_name(name: str) -> bool:
    """Whether this can name a file or a folder: letters, digits and usual punctuation, no leading dot or dash."""
    return (
        0 < len(name.encode("utf-8", "replace")) <= _MOST_BYTES
        and name[0] not in ".- "
        and all(
            letter in _PUNCTUATION or unicodedata.category(letter)[0] in "LMN" for letter in name
        )
    )


def checked_name(name: str, what: str) -> str:
    """The name of a flight, a change or an object; raises StoreError when it cannot name a file."""
    if not isinstance(name, str) or not is_plain_name(name):
        raise _refused(name, what, "letters, digits and usual punctuation were needed")
    return name


def checked_document(name: str) -> str:
    """The name of a text file in a flight's folder; raises StoreError for any other."""
    if not isinstance(name, str) or _DOCUMENT.fullmatch(name) is None:
        raise _refused(name, "document", "a plain file name with an ending was needed")
    return name


def is_sha256(name: str) -> bool:
    """Whether the name is 64 hexadecimal digits, as a tile's is."""
    return _SHA256.fullmatch(name) is not None


def checked_sha256(sha256: str) -> str:
    """The name of a tile's file; raises StoreError for anything but 64 hexadecimal digits."""
    if not isinstance(sha256, str) or not is_sha256(sha256):
        raise _refused(sha256, "tile", "a SHA-256 was needed")
    return sha256


def checked_image_path(path: str, flight_id: str) -> str:
    """A keyframe's path in the site folder; raises StoreError when it lies elsewhere than its flight's keyframes."""
    folder = f"flights/{checked_name(flight_id, 'flight')}/keyframes/"
    if (
        not isinstance(path, str)
        or re.fullmatch(re.escape(folder) + r"[0-9]{1,18}/[0-9]{6,18}\.jpg", path) is None
    ):
        raise _refused(path, "keyframe", f"a picture below {folder} was needed")
    return path


def checked_crs(crs: str) -> str:
    """An EPSG code, or "" for none; raises StoreError for anything else."""
    # anything else may make GDAL or PROJ open a file or an address
    if crs and not (isinstance(crs, str) and _EPSG.fullmatch(crs)):
        raise _refused(
            crs, "coordinate reference system", "an EPSG code such as EPSG:32633 was needed"
        )
    return crs


def _refused(name: object, what: str, needed: str) -> StoreError:
    return StoreError(
        f"the site's catalogue names a {what} {str(name)[:80]!r}; {needed}. The site is damaged or was made to do "
        "harm: do not use it"
    )


ORIGIN = "origin.json"
"""In the folder of a working copy: the store's address, and what the site consisted of there."""

UNSENT = "unsent"
"""In the folder of a working copy while it may hold what the store has not."""

TILE_SIZES = "origin-tiles.json"
_FOLDER_VARIABLE = "SORVOLO_CACHE"


class Origin(Protocol):
    """The site in the store."""

    def fetch(self, path: str) -> bool:
        """Put the file of this path into the folder, checked; whether the store has one. Raises StoreError."""
        ...

    def tile_sizes(self) -> Mapping[str, int]:
        """The bytes of each tile in the store, by its SHA-256."""
        ...


def cache_folder() -> Path:
    """Where working copies lie: $SORVOLO_CACHE, else sorvolo in the system's folder for caches."""
    if chosen := os.environ.get(_FOLDER_VARIABLE):
        return Path(chosen).expanduser()
    if cache := os.environ.get("XDG_CACHE_HOME") or os.environ.get("LOCALAPPDATA"):
        return Path(cache) / "sorvolo"
    return Path.home() / ".cache" / "sorvolo"


def find_origin(folder: Path) -> Origin | None:
    """The origin of a working copy; None for any other folder. One that lies elsewhere than working copies has none:
    a stranger's site makes this program ask nobody."""
    if not (folder / ORIGIN).is_file() or not folder.resolve().is_relative_to(
        cache_folder().resolve()
    ):
        return None
    from sorvolo.store.copies.working import StoreOrigin

    return StoreOrigin(folder)


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


UNDER_TREES = "under_trees.json"
"""In a flight's folder: the cameras of a look below its crowns, and the floor that they show."""


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
        make_folder(folder)
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
