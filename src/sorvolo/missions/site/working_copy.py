"""A site in an object store as a folder on this machine: fetched before a command, sent after it."""

import tempfile
import warnings
from collections.abc import Generator
from pathlib import Path

from sorvolo.errors import NotFoundError, SorvoloWarning, StoreError
from sorvolo.missions.site.copy import folder_of
from sorvolo.store.copies.bucket import OvertakenError
from sorvolo.store.copies.transfer import CopyUpdate
from sorvolo.store.copies.working import WorkingCopy
from sorvolo.store.site.catalogue_place import is_site
from sorvolo.store.site.files import BusyError


def fetch_site(address: str, *, writes: bool) -> Generator[CopyUpdate, None, Path]:
    """The folder of a site at an address, brought up to date first if it lies in a store; what was not sent is sent.

    Tiles and pictures come when they are asked for. A command that `writes` ends with `send_site`. Raises StoreError
    where there is no site to read, and where the store refuses or cannot be reached.
    """
    folder = folder_of(address)
    if folder is not None:
        return folder
    working = WorkingCopy.of(address)
    with tempfile.TemporaryDirectory(prefix="sorvolo-") as scratch:
        try:
            there = yield from _fetched(working, Path(scratch))
        except BusyError:
            if writes or not is_site(working.folder):
                raise
            return working.folder  # a flight is being mapped into it: it is as new as that one
    if not there and not writes:
        raise NotFoundError(
            f"no site at {address}; put one there: sorvolo site copy FOLDER {address}"
        )
    if writes:
        working.begin_writing()
    return working.folder


def _fetched(working: WorkingCopy, scratch: Path) -> Generator[CopyUpdate, None, bool]:
    try:
        return (yield from working.fetch(scratch))
    except OvertakenError:
        warnings.warn(
            f"another writer has changed {working.address}; what this machine had added and not sent is kept in "
            f"{working.set_aside()}",
            SorvoloWarning,
            stacklevel=2,
        )
        return (yield from working.fetch(scratch))


def send_site(address: str, *, is_over: bool = True) -> Generator[CopyUpdate, None, None]:
    """Send what a command has added to a site in a store; nothing for a folder.

    `is_over` is whether nobody has the folder open any more. Raises StoreError where another writer has changed the
    site (what was added is then kept in another folder, which is named; OvertakenError unless it `is_over`), and where
    the store refuses or cannot be reached (then the next command sends it).
    """
    if folder_of(address) is not None:
        return
    working = WorkingCopy.of(address)
    with tempfile.TemporaryDirectory(prefix="sorvolo-") as scratch:
        try:
            yield from working.send(Path(scratch))
        except OvertakenError as error:
            if not is_over:
                raise
            raise StoreError(
                f"another writer has changed {address} meanwhile, and keeps what he added; what this command added is "
                f"kept in {working.set_aside()}. Run the same command again: it begins with the site as it is now"
            ) from error
        except StoreError as error:
            raise StoreError(
                f"{error}. What this command added is kept in {working.folder}, and sent by the next command with this "
                "site"
            ) from error
    if not is_over:
        working.begin_writing()
