"""Files that appear whole or not at all: written beside their place, synced, then renamed."""

import errno
import fcntl
import os
import secrets
import shutil
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

from sorvolo.errors import FULL, DiskFullError, StoreError

TEMPORARY_PREFIX = ".tmp-"
"""Whatever a killed process left behind starts with this; `remove_leftovers` deletes it."""

_FORBIDDEN = {errno.EACCES, errno.EPERM, errno.EROFS}


@contextmanager
def atomic_path(path: Path, *, durable: bool = True) -> Iterator[Path]:
    """A temporary path in the same folder, renamed to `path` when the block ends well, else removed.

    The name keeps `path`'s ending, for writers that choose their format by it. With `durable` the file and
    its folder reach the disk before this returns; without, the file is still whole after a kill, but a power
    cut may lose it. Raises StoreError when the disk is full or the folder cannot be written; other errors
    pass through.
    """
    temporary = temporary_beside(path)
    with writing(path):
        temporary.touch(
            exist_ok=False
        )  # a refusal here has a number, which GDAL's and SQLite's words lack
        temporary.unlink()
        try:
            yield temporary
            if durable:
                sync_file(temporary)
            os.replace(temporary, path)
            if durable:
                sync_file(path.parent)
        except BaseException:
            temporary.unlink(missing_ok=True)
            raise


def atomic_write_bytes(path: Path, data: bytes, *, durable: bool = True) -> None:
    """Replace the file at `path` by `data`: a reader sees the old bytes or the new ones, never a part.

    Raises StoreError when the disk is full or the folder cannot be written.
    """
    with atomic_path(path, durable=durable) as temporary:
        # a link with this very name, however unlikely, is not followed
        descriptor = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW, 0o666)
        with os.fdopen(descriptor, "wb") as file:
            file.write(data)


def write_page(path: Path, page: str) -> None:
    """Replace a page; the PDF that was printed from the one before goes. Raises StoreError as `atomic_write_bytes`."""
    path.with_suffix(".pdf").unlink(missing_ok=True)
    atomic_write_bytes(path, page.encode())


@contextmanager
def scratch_folder(parent: Path) -> Iterator[Path]:
    """A temporary folder inside `parent`, on the same disk, gone when the block ends.

    Raises StoreError when the disk is full or the folder cannot be written.
    """
    folder = temporary_beside(parent / "scratch")
    with writing(parent):
        folder.mkdir()
        try:
            yield folder
        finally:
            shutil.rmtree(folder, ignore_errors=True)


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """Turn the operating system's refusals to write into a StoreError that states what to do."""
    try:
        yield
    except OSError as error:
        if error.errno in FULL:
            raise DiskFullError(
                f"disk full: could not write {path} ({error.strerror}); free some space and run it again"
            ) from error
        is_ours = TEMPORARY_PREFIX in str(error.filename)  # a name that nobody gave
        if is_ours or error.errno in _FORBIDDEN:
            raise StoreError(
                f"cannot write {path} ({error.strerror}); choose a folder that you may write to"
            ) from error
        raise


def make_folder(folder: Path) -> None:
    """Make the folder and those above it, where there is none. Raises StoreError as `writing` does."""
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)


def sync_file(path: Path) -> None:
    """Wait until a file's bytes, or a folder's names, are on the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def remove_leftovers(folders: Iterable[Path]) -> int:
    """Delete what killed writers left in these folders (not below them); how many things it was.

    Only for a folder that no other process is writing to.
    """
    removed = 0
    for folder in folders:
        for leftover in folder.glob(f"{TEMPORARY_PREFIX}*"):
            if leftover.is_dir() and not leftover.is_symlink():
                shutil.rmtree(leftover, ignore_errors=True)
            else:
                leftover.unlink(missing_ok=True)
            removed += 1
    return removed


def temporary_beside(path: Path) -> Path:
    """A name in the same folder that nothing has; what a killed process leaves there is a leftover."""
    # nobody can know the name before and put a link there, which other programs' writers would follow
    return path.with_name(f"{TEMPORARY_PREFIX}{secrets.token_hex(6)}-{path.name}")


def take_lock(descriptor: int) -> bool:
    """Take the lock of an open file, which it keeps until it is closed; False where another one has it."""
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True
