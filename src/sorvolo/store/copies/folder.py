"""A site folder as one end of a copy: read while others write it, or filled and kept whole."""

import hashlib
import json
import os
import re
import shutil
import sqlite3
import tempfile
from collections.abc import Collection, Iterator, Mapping
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from sqlalchemy import Connection, delete, insert, select, update

from sorvolo.errors import StoreError
from sorvolo.store.atomic import (
    TEMPORARY_PREFIX,
    atomic_path,
    atomic_write_bytes,
    make_folder,
    remove_leftovers,
    scratch_folder,
    sync_file,
    writing,
)
from sorvolo.store.exports.change_files import OBJECTS
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
    ORIGIN,
    STAGED,
    TILE_SIZES,
    UNSENT,
    DamagedError,
    HeightFile,
    is_plain_name,
    is_sha256,
    lock_folder,
    refuse_unfinished,
)
from sorvolo.store.site.upkeep import LIST_ENDINGS, MAP_FILES

_MOST_PARTS = 6  # of a file's path: flights/<flight>/staged/<run>/changes/<file>
_HOW_FAR_WRITTEN = {
    "site": {"derived_version"},
    "runs": {"files_written"},
    "documents": {"content"},
}
_LASTING = frozenset(HeightFile)  # files of a flight that nothing in the catalogue could make again
_TILE = re.compile(r"tiles/[0-9a-f]{2}/([0-9a-f]{64})\.png")
_KEYFRAME = re.compile(r"flights/[^/]+/keyframes/[0-9]{1,18}/[0-9]{6,18}\.jpg")


@dataclass(frozen=True)
class SiteFile:
    """A file of a site: its path in the site folder, its size, and its SHA-256 ("" while nobody has read it).

    `stamp` is when it was last written, ns, for files in a folder; 0 elsewhere.
    """

    path: str
    size: int
    sha256: str = ""
    stamp: int = 0

    @property
    def is_lasting(self) -> bool:
        """Whether the file never changes: a tile or a keyframe. Another content has another path."""
        return _TILE.fullmatch(self.path) is not None or _KEYFRAME.fullmatch(self.path) is not None


@dataclass(frozen=True)
class CatalogueState:
    """What a catalogue holds that a copy must not lose.

    `identity` names the site wherever its copies lie; `digest` all that the catalogue holds, whoever wrote it where.
    `versions` are the complete versions of the map (id, run, when made), `reviews` when each change was judged.
    """

    identity: str
    name: str
    digest: str
    versions: frozenset[tuple[int, int, str]]
    reviews: Mapping[str, str]

    @property
    def newest(self) -> int:
        """The newest version's number."""
        return max((each[0] for each in self.versions), default=0)


@dataclass(frozen=True, eq=False)
class SiteState:
    """A site as it is at one moment: a catalogue without unfinished runs in a file of its own, and its files by path.

    `left_out` are files in the site's folder that do not belong to the site.
    """

    held: CatalogueState
    catalogue: Path
    files: Mapping[str, SiteFile]
    left_out: tuple[str, ...] = ()


def find_state(catalogue: Catalogue) -> CatalogueState | None:
    """What a catalogue holds; None where no flight was ever mapped."""
    with catalogue.reading() as connection:
        row = connection.execute(select(schema.site)).mappings().one_or_none()
        if row is None or records.newest_version(connection) == 0:
            return None
        versions = connection.execute(
            select(schema.versions).where(schema.versions.c.complete.is_(True))
        )
        reviews = connection.execute(select(schema.reviews.c.change_id, schema.reviews.c.at_utc))
        fixed = [
            row[name]
            for name in ("created_utc", "latitude_deg", "longitude_deg", "crs", "m_per_px")
        ]
        return CatalogueState(
            hashlib.sha256(json.dumps(fixed).encode()).hexdigest()[:32],
            row["name"],
            _digest(connection),
            frozenset((each.id, each.run_id, each.created_utc) for each in versions),
            {each.change_id: each.at_utc for each in reviews},
        )


def named_files(
    catalogue: Catalogue,
) -> tuple[dict[str, str], dict[str, str], set[tuple[str, str]]]:
    """The tiles and keyframes, and the other files, by path, with their SHA-256; flights with runs whose staged files
    are still to be placed."""
    with catalogue.reading() as connection:
        lasting = {tile_path(each): each for each in records.used_hashes(connection)}
        lasting |= {
            each.image_path: each.sha256 for each in records.load_keyframes(connection, None)
        }
        owed = {(each.flight_id, str(each.run_id)) for each in records.owed_files(connection)}
        others = records.file_hashes(connection)
    return lasting, others, owed


def missing_from(held: CatalogueState, files: Mapping[str, SiteFile], other: SiteState) -> str:
    """What a site holds and another state of it has not, in words; "" where the other could replace it without loss."""
    if versions := sorted(each[0] for each in held.versions - other.held.versions):
        return f"version {', '.join(map(str, versions))} of the map"
    later = sorted(
        each for each, at_utc in held.reviews.items() if at_utc > other.held.reviews.get(each, "")
    )
    if later:
        return f"the review of change {', '.join(later[:5])}"
    lasting = sorted(
        path for path in files if path.rpartition("/")[2] in _LASTING and path not in other.files
    )
    return ", ".join(lasting[:5])


def is_site_path(path: str) -> bool:
    """Whether a site has a file of this path: one of the map's, or one below `flights/<flight>/`; tiles apart."""
    parts = path.split("/")
    if len(parts) == 1:
        return path in (*MAP_FILES, *(f"{OBJECTS}{ending}" for ending in LIST_ENDINGS))
    if not 3 <= len(parts) <= _MOST_PARTS or parts[0] != "flights" or parts[2] == JOURNAL:
        return False
    return all(is_plain_name(part) for part in parts[1:]) and not parts[-1].startswith(
        TEMPORARY_PREFIX
    )


def checked_path(path: object) -> str:
    """A path from an untrusted list, checked; raises StoreError for one outside the site."""
    if isinstance(path, str) and (is_site_path(path) or tile_of(path)):
        return path
    raise StoreError(
        f"the copy names a file {str(path)[:80]!r}, and no site has one; it is damaged or was made to do harm: do not "
        "use it"
    )


def tile_path(sha256: str) -> str:
    """Where a tile lies in the site folder."""
    return f"tiles/{sha256[:2]}/{sha256}.png"


def tile_of(path: str) -> str:
    """The SHA-256 that a tile's path states; "" for any other file's."""
    found = _TILE.fullmatch(path)
    return found[1] if found and path == tile_path(found[1]) and is_sha256(found[1]) else ""


def refuse_damaged(file: SiteFile, sha256: str) -> None:
    """Raise DamagedError where a file's bytes are known and have another SHA-256."""
    if file.sha256 and file.sha256 != sha256:
        raise DamagedError(file.path)


def is_left_out(path: str, lasting: Collection[str], owed: set[tuple[str, str]]) -> bool:
    """Whether a copy leaves a file below `flights` out on purpose: what only an unfinished run needs."""
    parts = path.split("/")
    if parts[0] != "flights" or len(parts) < 3:
        return False
    if parts[2] == STAGED:
        return len(parts) < 4 or (parts[1], parts[3]) not in owed
    if parts[2] == "keyframes":
        return path not in lasting
    return parts[2] == JOURNAL or parts[-1].startswith(TEMPORARY_PREFIX)


def _digest(connection: Connection) -> str:
    """A hash of everything in the catalogue except the progress of derived files, and what these are."""
    digest = hashlib.sha256()
    for table in schema.metadata.sorted_tables:
        if table in (schema.leftovers, schema.files):
            continue
        digest.update(table.name.encode())
        skipped = _HOW_FAR_WRITTEN.get(table.name, set())
        query = select(table).order_by(*table.primary_key.columns)
        for row in schema.checked_rows(connection, table, query):
            values = [value for name, value in row._mapping.items() if name not in skipped]
            digest.update(json.dumps(values, sort_keys=True, default=repr).encode())
    return digest.hexdigest()


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

    may_lose = False
    """Whether the site here may be replaced by a state that lacks what it holds."""

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
                if not self.may_lose:
                    refuse_loss(self.name, missing_from(held, files, new))
        self.folder.mkdir(exist_ok=True)
        note = {"identity": new.held.identity, "newest_version": new.held.newest}
        atomic_write_bytes(self.folder / COPYING, json.dumps(note).encode())
        remove_leftovers([self.folder, *(each for each in self.folder.rglob("*") if each.is_dir())])

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
        make_folder(path.parent)
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
            try:
                with (
                    closing(sqlite3.connect(state.catalogue)) as new,
                    closing(sqlite3.connect(catalogue, timeout=30)) as old,
                ):
                    new.backup(old)
                    old.execute("PRAGMA wal_checkpoint(TRUNCATE)")
            except sqlite3.Error as error:
                raise StoreError(
                    f"cannot write {catalogue} ({error}); free some space and run the copy again"
                ) from error
        elif is_site(self.folder):
            # The same for a catalogue in a PostgreSQL database.
            with (
                closing(
                    Catalogue.open(self.folder, write=True, catalogues=self._catalogues)
                ) as target,
                target.changing() as written,
                closing(Catalogue.at(state.catalogue, write=False)) as source,
                source.reading() as read,
            ):
                copy_rows(read, written)
        else:
            with atomic_path(catalogue) as temporary, writing(temporary):
                shutil.copyfile(state.catalogue, temporary)
        for path in _paths(self.folder):
            if path not in state.files and (is_site_path(path) or tile_of(path)):
                (self.folder / path).unlink(missing_ok=True)
        # Remove empty folders.
        for root, _, _ in os.walk(self.folder / "flights", topdown=False):
            if not any(os.scandir(root)):
                os.rmdir(root)
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
