"""The folder that a site lives in: made or refused, and locked by the one who writes."""

import fcntl
import os
from pathlib import Path

from sorvolo.errors import StoreError
from sorvolo.store.atomic import TEMPORARY_PREFIX, writing

CATALOGUE = "site.db"
_LOCK = "site.lock"


def make_site_folder(folder: Path) -> None:
    """Create the folder; refuse one that holds anything but a site (or what a killed creation left)."""
    try:
        with writing(folder):
            folder.mkdir(parents=True, exist_ok=True)
    except (FileExistsError, NotADirectoryError) as error:
        raise StoreError(f"{folder} is a file, a folder was needed; choose another name") from error
    if (folder / CATALOGUE).exists():
        return
    names = (path.name for path in folder.iterdir())
    foreign = sorted(name for name in names if name != _LOCK and not name.startswith(TEMPORARY_PREFIX))
    if foreign:
        raise StoreError(
            f"{folder} is no site: it holds {foreign[0]!r} and no {CATALOGUE}; choose a new or empty folder"
        )


def lock_site_folder(folder: Path) -> int:
    """The right to write, as a file descriptor to close; raises StoreError when another process has it."""
    with writing(folder / _LOCK):
        lock = os.open(folder / _LOCK, os.O_RDWR | os.O_CREAT, 0o644)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        os.close(lock)
        raise StoreError(f"another process is mapping into {folder}; wait until it has finished") from error
    return lock
