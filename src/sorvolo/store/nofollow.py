"""Files of a folder that a stranger may have made: read without following a link, refused where one lies."""

import errno
import hashlib
import os
import stat
from collections.abc import Iterator
from pathlib import Path, PurePosixPath
from typing import BinaryIO

from sorvolo.errors import StoreError

MOST_BYTES = 512_000_000  # of one file: the largest keyframe takes a tenth
_CHUNK_BYTES = 1 << 20
_LINK_ERRORS = {errno.ELOOP, errno.ENOTDIR, errno.EMLINK}


def read_below(folder: Path, relative: str, most_bytes: int = MOST_BYTES) -> bytes:
    """The bytes of the file `relative` below the folder; no part of that path may be a link.

    The folder itself may be one. Raises FileNotFoundError when there is no such file, and StoreError for a link, for
    anything but a plain file, and for one of more than `most_bytes`.
    """
    with open_below(folder, relative) as file:
        size = os.fstat(file.fileno()).st_size
        if size > most_bytes:
            raise StoreError(
                f"{folder / relative} has {size / 1e6:.0f} MB, at most {most_bytes / 1e6:.0f} MB were expected; "
                "map again"
            )
        return file.read()


def open_below(folder: Path, relative: str) -> BinaryIO:
    """The file `relative` below the folder, opened to be read piece by piece; raises as `read_below`."""
    path = folder / relative
    parts = PurePosixPath(relative).parts
    if not parts or ".." in parts or parts[0] == "/":
        raise StoreError(
            f"{relative!r} is no path below {folder}; the site is damaged or was made to do harm"
        )
    try:
        descriptor = _descend(folder, parts)
    except FileNotFoundError as error:
        raise FileNotFoundError(error.errno, error.strerror, str(path)) from error
    except OSError as error:
        if error.errno in _LINK_ERRORS:
            raise _refused(path) from error
        raise StoreError(
            f"cannot read {path} ({error.strerror}); check the disk and its permissions"
        ) from error
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise _refused(path)
    return os.fdopen(descriptor, "rb")


def chunks_of(stream: BinaryIO) -> Iterator[bytes]:
    """The rest of a stream, in pieces."""
    while chunk := stream.read(_CHUNK_BYTES):
        yield chunk


def sha256_of(stream: BinaryIO) -> str:
    """The SHA-256 of the rest of a stream."""
    digest = hashlib.sha256()
    for chunk in chunks_of(stream):
        digest.update(chunk)
    return digest.hexdigest()


def refuse_links(folder: Path, *, skipped: frozenset[str] = frozenset()) -> None:
    """Raise StoreError when anything in the folder or below is a link, a device or a pipe.

    Folders with a name in `skipped` are not entered. A site has no links: one would lead writes and deletions outside.
    """
    waiting = [folder]
    while waiting:
        for entry in _entries(waiting.pop()):
            if entry.is_dir(follow_symlinks=False):
                if entry.name not in skipped:
                    waiting.append(Path(entry.path))
            elif not entry.is_file(follow_symlinks=False):
                raise _refused(Path(entry.path))


def _descend(folder: Path, parts: tuple[str, ...]) -> int:
    """A descriptor of the file at the end of the path, each part opened in the one before."""
    inside = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        for part in parts[:-1]:
            deeper = os.open(part, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW, dir_fd=inside)
            os.close(inside)
            inside = deeper
        # not blocking: a pipe in the file's place would wait for ever
        return os.open(parts[-1], os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK, dir_fd=inside)
    finally:
        os.close(inside)


def _entries(folder: Path) -> list["os.DirEntry[str]"]:
    try:
        with os.scandir(folder) as entries:
            return list(entries)
    except (FileNotFoundError, NotADirectoryError):  # a writer took it away meanwhile
        return []
    except OSError as error:
        raise StoreError(
            f"cannot read {folder} ({error.strerror}); check the disk and its permissions"
        ) from error


def _refused(path: Path) -> StoreError:
    return StoreError(
        f"{path} is a link or no plain file; a site has none, and one could lead outside of it: remove it, or do not "
        "use this site"
    )
