"""A site folder as one end of a copy: read while others write it, or filled and kept whole."""

import hashlib
import json
import os
import shutil
import sqlite3
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import closing, contextmanager
from pathlib import Path
from typing import BinaryIO

from sqlalchemy import Connection, delete, insert, select, update

from sorvolo.errors import StoreError
from sorvolo.store.atomic import (
    TEMPORARY_PREFIX,
    atomic_path,
    atomic_write_bytes,
    remove_leftovers,
    scratch_folder,
    sync_file,
    writing,
)
from sorvolo.store.copies.site_state import (
    CatalogueState,
    SiteFile,
    SiteState,
    find_state,
    is_left_out,
    is_site_path,
    missing_from,
    named_files,
    refuse_damaged,
    tile_of,
)
from sorvolo.store.nofollow import chunks_of, open_below, refuse_links, sha256_of
from sorvolo.store.site import catalogue as records
from sorvolo.store.site import schema
from sorvolo.store.site.archive import Archive
from sorvolo.store.site.catalogue import Catalogue
from sorvolo.store.site.catalogue_place import (
    CATALOGUE,
    POINTER,
    Catalogues,
    catalogue_file,
    create_database,
    is_site,
)
from sorvolo.store.site.database import SqliteDatabase
from sorvolo.store.site.files import (
    COPYING,
    JOURNAL,
    LIVE_COVERAGE,
    LIVE_PREVIEW,
    LOCK,
    lock_folder,
    refuse_unfinished,
)
from sorvolo.store.site.origin import ORIGIN, TILE_SIZES, UNSENT

_ROWS_AT_ONCE = 1000
_OF_THE_FOLDER = frozenset(
    {
        CATALOGUE,
        f"{CATALOGUE}-wal",
        f"{CATALOGUE}-shm",
        POINTER,
        LOCK,
        COPYING,
        ORIGIN,
        TILE_SIZES,
        UNSENT,
    }
)


class FolderEnd:
    """A folder that a site is copied from or to."""

    def __init__(self, folder: Path, catalogues: Catalogues | None = None) -> None:
        """A new copy's catalogue goes where `catalogues` has it; None: a file in the folder."""
        self.folder, self.name, self._catalogues = folder, str(folder), catalogues

    @property
    def has_site(self) -> bool:
        """Whether a whole site, or one that is being copied here, is in the folder."""
        return is_site(self.folder) or (self.folder / COPYING).is_file()

    def state(self, scratch: Path) -> SiteState:
        """The site as of now, its catalogue in a file in `scratch`. Others may write the site meanwhile.

        Raises StoreError for no site, one without a map, or one that is a copy that is not finished.
        """
        refuse_unfinished(self.folder)
        path = scratch / CATALOGUE
        held, listed, left_out = self._snapshot(path)
        if held is None:
            raise StoreError(
                f"{self.folder} has no map yet: there is nothing to copy; map a flight into it first"
            )
        return SiteState(held, path, listed, left_out)

    def is_still(self, state: SiteState, scratch: Path) -> bool:
        """Whether the site is as it was: everything copied since then is consistent."""
        with scratch_folder(scratch) as apart:
            now = self.state(apart)
        return now.held == state.held and now.files == state.files

    @contextmanager
    def opened(self, file: SiteFile) -> Iterator[BinaryIO]:
        """The file's bytes, which stay the same while it is open. Raises FileNotFoundError when it is gone."""
        with open_below(self.folder, file.path) as stream:
            yield stream

    @contextmanager
    def being_filled(self) -> Iterator[None]:
        """Make the folder and lock it for writing. Raises StoreError where it holds anything but a site."""
        with writing(self.folder):
            try:
                self.folder.mkdir(parents=True, exist_ok=True)
            except FileExistsError as error:
                raise StoreError(
                    f"{self.folder} is a file, a folder was needed; choose another name"
                ) from error
        refuse_links(self.folder)
        if not self.has_site and (foreign := sorted(_foreign(self.folder))):
            raise StoreError(
                f"{self.folder} is not empty and holds no site (there is {foreign[0]!r}); choose a new or empty "
                "folder, or that of an earlier copy of this site"
            )
        lock = lock_folder(self.folder)
        try:
            yield
        finally:
            os.close(lock)

    def accept(self, new: SiteState, scratch: Path) -> None:
        """Prepare to become a copy of the site, inside `being_filled`.

        Raises StoreError where another site is in the folder, or one that holds what the new state lacks.
        """
        if (self.folder / COPYING).is_file():
            try:
                identity = str(json.loads((self.folder / COPYING).read_bytes())["identity"])
            except (ValueError, KeyError, TypeError):
                identity = ""
            refuse_other(self.name, identity, new.held)
        if is_site(self.folder):
            held, files, _ = self._snapshot(scratch / f"held-{CATALOGUE}")
            if held is not None:
                refuse_other(self.name, held.identity, new.held)
                self._refuse_loss(held, files, new)
        self.folder.mkdir(exist_ok=True)
        note = {"identity": new.held.identity, "newest_version": new.held.newest}
        atomic_write_bytes(self.folder / COPYING, json.dumps(note).encode())
        remove_leftovers([self.folder, *(each for each in self.folder.rglob("*") if each.is_dir())])

    def _refuse_loss(
        self, held: CatalogueState, files: Mapping[str, SiteFile], new: SiteState
    ) -> None:
        refuse_loss(self.name, missing_from(held, files, new))

    def find_held(self) -> CatalogueState | None:
        """What the folder's catalogue holds, unfinished runs apart; None for no map."""
        with tempfile.TemporaryDirectory(prefix="sorvolo-") as scratch:
            return self._snapshot(Path(scratch) / CATALOGUE)[0]

    def lacks(self, state: SiteState) -> list[SiteFile]:
        """The files that have yet to be put: not here, or of another size or time."""
        return [each for each in state.files.values() if not self._has(each)]

    def put(self, file: SiteFile, stream: BinaryIO) -> bool:
        """Write a file whole or not at all; True. Raises DamagedError for bytes of another SHA-256."""
        path = self.folder / file.path
        with writing(path):
            path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_path(path) as temporary:
            descriptor = os.open(
                temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW, 0o666
            )
            digest = hashlib.sha256()
            with os.fdopen(descriptor, "wb") as target:
                for chunk in chunks_of(stream):
                    digest.update(chunk)
                    target.write(chunk)
            refuse_damaged(file, digest.hexdigest())
            if file.stamp:
                os.utime(temporary, ns=(file.stamp, file.stamp))
        return True

    def conclude(self, state: SiteState) -> None:
        """Make the folder this state of the site: the catalogue last; then remove files that are not in the state."""
        catalogue = self.folder / CATALOGUE
        if self._catalogues is not None and not is_site(self.folder):
            create_database(self.folder, self._catalogues)
        if catalogue.is_file():
            _overwrite_catalogue(catalogue, state.catalogue)
        elif is_site(self.folder):
            _overwrite_rows(self.folder, state.catalogue, self._catalogues)
        else:
            with atomic_path(catalogue) as temporary, writing(temporary):
                shutil.copyfile(state.catalogue, temporary)
        for path in _paths(self.folder):
            if path not in state.files and (is_site_path(path) or tile_of(path)):
                (self.folder / path).unlink(missing_ok=True)
        _remove_empty(self.folder / "flights")
        (self.folder / COPYING).unlink(missing_ok=True)
        sync_file(self.folder)

    def free_bytes(self) -> int | None:
        """Free disk space, bytes."""
        there = next(
            each
            for each in (self.folder.absolute(), *self.folder.absolute().parents)
            if each.exists()
        )
        return shutil.disk_usage(there).free

    def _snapshot(
        self, path: Path
    ) -> tuple[CatalogueState | None, Mapping[str, SiteFile], tuple[str, ...]]:
        """What a copy of the catalogue in a new file holds (None: no map), unfinished runs apart; the site's files,
        and files that do not belong to it."""
        site = Archive.open(self.folder, write=False, catalogues=self._catalogues)
        try:
            _copy_catalogue(site.catalogue, path)
        finally:
            site.close()
        place = str(catalogue_file(self.folder) or self.folder)
        with closing(Catalogue.at(path, write=True, place=place)) as copied:
            with copied.changing() as connection:
                records.drop_unfinished(connection)
            return find_state(copied), *_listed(self.folder, *named_files(copied))

    def _has(self, file: SiteFile) -> bool:
        try:
            about = (self.folder / file.path).lstat()
        except (FileNotFoundError, NotADirectoryError):
            return False
        if about.st_size != file.size:
            return False
        if file.is_lasting or (file.stamp and about.st_mtime_ns == file.stamp):
            return True
        if not file.sha256:
            return False
        with open_below(self.folder, file.path) as stream:
            return sha256_of(stream) == file.sha256


def refuse_other(name: str, identity: str, held: CatalogueState) -> None:
    """Raise StoreError unless the site at the other end is the same one."""
    if identity != held.identity:
        raise StoreError(
            f"{name} holds another site, not {held.name!r}; nothing was copied. Choose another place, or the one of an "
            "earlier copy of this site"
        )


def refuse_loss(name: str, lost: str) -> None:
    """Raise StoreError where a copy would lose anything."""
    if lost:
        raise StoreError(
            f"{name} holds what the source of the copy lacks: {lost}. Nothing was copied; copy in the other direction "
            "first, or to a new place"
        )


def _copy_catalogue(catalogue: Catalogue, path: Path) -> None:
    """A consistent copy of an open catalogue in a file, even while others write it."""
    with writing(path), catalogue.reading() as connection:
        driver = connection.connection.driver_connection
        if not isinstance(driver, sqlite3.Connection):
            SqliteDatabase(path, write=True).create()
            with closing(Catalogue.at(path, write=True)) as target, target.changing() as written:
                copy_rows(connection, written)
            return
        try:
            with closing(sqlite3.connect(path)) as copied:
                driver.backup(copied)
        except sqlite3.Error as error:
            raise StoreError(
                f"cannot write {path} ({error}); free some space and run it again"
            ) from error


def _overwrite_catalogue(path: Path, new: Path) -> None:
    """Replace what a catalogue holds, in one transaction: readers see the old state or the new one."""
    try:
        with (
            closing(sqlite3.connect(new)) as source,
            closing(sqlite3.connect(path, timeout=30)) as target,
        ):
            source.backup(target)
            target.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    except sqlite3.Error as error:
        raise StoreError(
            f"cannot write {path} ({error}); free some space and run the copy again"
        ) from error


def _overwrite_rows(folder: Path, new: Path, catalogues: Catalogues | None) -> None:
    """The same for a catalogue in a PostgreSQL database."""
    with (
        closing(Catalogue.open(folder, write=True, catalogues=catalogues)) as target,
        target.changing() as written,
        closing(Catalogue.at(new, write=False)) as source,
        source.reading() as read,
    ):
        copy_rows(read, written)


def copy_rows(source: Connection, target: Connection) -> None:
    """Make the target's rows the source's, inside the callers' transactions."""
    for table in reversed(schema.metadata.sorted_tables):
        target.execute(delete(table))
    for table in schema.metadata.sorted_tables:
        for rows in source.execute(select(table)).mappings().partitions(_ROWS_AT_ONCE):
            target.execute(insert(table), [dict(row) for row in rows])
    # the numbers of runs and versions that are gone are not given again
    numbers = schema.numbers
    for row in source.execute(select(numbers).where(numbers.c.name.in_(schema.NUMBERED))):
        target.execute(update(numbers).where(numbers.c.name == row.name).values(last=row.last))


def _paths(folder: Path) -> Iterator[str]:
    """Every file below the folder, as a path with slashes; links are not followed."""
    for root, _, names in os.walk(folder):
        for name in names:
            yield Path(root, name).relative_to(folder).as_posix()


def _listed(
    folder: Path, lasting: Mapping[str, str], others: Mapping[str, str], owed: set[tuple[str, str]]
) -> tuple[dict[str, SiteFile], tuple[str, ...]]:
    """The files that make the state up, those missing of which the catalogue names (as of size 0), and what is none."""
    found: dict[str, SiteFile] = {}
    foreign = []
    for path in _paths(folder):
        if path in lasting or (is_site_path(path) and not is_left_out(path, lasting, owed)):
            try:
                about = (folder / path).lstat()
            except FileNotFoundError:  # replaced meanwhile
                continue
            sha256 = lasting.get(path, "")
            stamp = 0 if sha256 else about.st_mtime_ns
            found[path] = SiteFile(path, about.st_size, sha256 or others.get(path, ""), stamp)
        elif not (
            path in _OF_THE_FOLDER or is_site_path(path) or tile_of(path) or _is_passing(path)
        ):
            foreign.append(path)
    missing = {path: SiteFile(path, 0, lasting[path]) for path in lasting.keys() - found.keys()}
    return found | missing, tuple(sorted(foreign))


def _is_passing(path: str) -> bool:
    """Whether the file is temporary."""
    parts = path.split("/")
    passing = (LIVE_PREVIEW, LIVE_COVERAGE, JOURNAL)
    return any(each.startswith(TEMPORARY_PREFIX) for each in parts) or parts[-1] in passing


def _foreign(folder: Path) -> Iterator[str]:
    for path in folder.iterdir():
        if path.name not in (LOCK, ORIGIN, TILE_SIZES, UNSENT) and not path.name.startswith(
            TEMPORARY_PREFIX
        ):
            yield path.name


def _remove_empty(folder: Path) -> None:
    """Remove empty folders."""
    for root, _, _ in os.walk(folder, topdown=False):
        if not any(os.scandir(root)):
            os.rmdir(root)
