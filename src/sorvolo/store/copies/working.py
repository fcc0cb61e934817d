"""A site in an object store, worked on in a folder: fetched when asked for, sent back without losing others' work."""

import hashlib
import json
import os
import re
import threading
from collections.abc import Generator, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import BinaryIO, Self

from sorvolo.errors import StoreError
from sorvolo.store.atomic import atomic_write_bytes
from sorvolo.store.copies.bucket import SHOWN, BucketEnd, Manifest, key_of
from sorvolo.store.copies.folder import (
    FolderEnd,
    SiteFile,
    SiteState,
    tile_of,
)
from sorvolo.store.copies.object_store import Objects, open_objects
from sorvolo.store.copies.transfer import CopyUpdate, copy
from sorvolo.store.site.catalogue_place import is_site
from sorvolo.store.site.files import (
    ORIGIN,
    TILE_SIZES,
    UNSENT,
    DamagedError,
    cache_folder,
    lock_folder,
)


class WorkingCopy:
    """The folder in which a site of a store is worked on, on this machine; made by `of`.

    Catalogue, reports and maps lie in it; tiles and pictures of the flights come when they are asked for.
    """

    def __init__(self, objects: Objects, folder: Path) -> None:
        self.folder, self._objects = folder, objects

    @classmethod
    def of(cls, address: str, below: Path | None = None) -> Self:
        """The working copy of `s3://BUCKET/NAME`, in the folder of working copies, or `below` a folder in it.

        Raises SettingsError for an address that names none.
        """
        objects = open_objects(address)
        store = f"{os.environ.get('AWS_ENDPOINT_URL', '')} {objects.name}"
        name = re.sub(r"[^A-Za-z0-9._-]", "-", objects.name.rsplit("/", 1)[1])
        apart = f"{name}-{hashlib.sha256(store.encode()).hexdigest()[:12]}"
        return cls(objects, (cache_folder() / "sites" / apart) if below is None else below / name)

    @property
    def address(self) -> str:
        """Where the site lies."""
        return self._objects.name

    def is_ahead(self) -> bool:
        """Whether the folder's catalogue holds anything else than what it was made of, by anybody's work."""
        known = known_manifest(self.folder)
        held = _WorkingFolder(self.folder).find_held() if is_site(self.folder) else None
        return held is not None and (known is None or held.digest != known.held.digest)

    def begin_writing(self) -> None:
        """Note, before the site is written to, that it is to be sent."""
        self.folder.mkdir(parents=True, exist_ok=True)
        atomic_write_bytes(self.folder / UNSENT, b"")

    def fetch(self, scratch: Path) -> Generator[CopyUpdate, None, bool]:
        """Send pending changes, then bring the folder up to date; return whether the site exists.

        Raises OvertakenError where another writer has changed the site, and StoreError as copies do.
        """
        if (self.folder / UNSENT).is_file():
            yield from self.send(scratch)
        end = BucketEnd(self._objects)
        manifest, _ = end.find_manifest()
        known = known_manifest(self.folder)
        if manifest is None:
            if known is not None:
                raise StoreError(
                    f"the site at {self.address} is gone; what this machine has of it lies in {self.folder}: delete "
                    "that folder to begin a new site there"
                )
            return False
        if known is None or known.id != manifest.id or not is_site(self.folder):
            self.folder.mkdir(parents=True, exist_ok=True)
            yield from copy(end, _WorkingFolder(self.folder), scratch)
            self._note(end)
        return True

    def send(self, scratch: Path) -> Generator[CopyUpdate, None, bool]:
        """Send what the store has not; whether there was anything. Raises OvertakenError; StoreError as copies do."""
        known = known_manifest(self.folder)
        folder = _WorkingFolder(self.folder)
        # unless a flight was ever completed
        if not is_site(self.folder) or folder.find_held() is None:
            (self.folder / UNSENT).unlink(missing_ok=True)
            return False
        before = "" if known is None else known.id
        end = BucketEnd(self._objects, base=before)
        outcome = yield from copy(folder, end, scratch, threads=8)
        if outcome.faults:
            lost = ", ".join(outcome.faults)
            raise StoreError(
                f"{self.folder} lacks whole files that {self.address} has not either: {lost}"
            )
        self._note(end)
        (self.folder / UNSENT).unlink(missing_ok=True)
        return end.written is not None and end.written.id != before

    def set_aside(self) -> Path:
        """Keep the folder, which another writer's work has overtaken, under another name; where it lies now.

        Raises BusyError while another process writes it.
        """
        moment = datetime.now(UTC).strftime("%Y%m%dT%H%M%SZ")
        kept = self.folder.with_name(f"{self.folder.name}-kept-{moment}")
        lock = lock_folder(self.folder)
        try:
            (self.folder / UNSENT).unlink(missing_ok=True)
            os.rename(self.folder, kept)
        finally:
            os.close(lock)
        return kept

    def _note(self, end: BucketEnd) -> None:
        """Note what the folder was made of, or has become in the store."""
        manifest = end.written or end.shown
        assert manifest is not None
        atomic_write_bytes(self.folder / TILE_SIZES, json.dumps(end.tile_bytes).encode())
        note = {"address": self.address, "manifest": json.loads(manifest.data())}
        atomic_write_bytes(self.folder / ORIGIN, json.dumps(note).encode())


class StoreOrigin:
    """Where the tiles and pictures of a working copy come from. Threads may share it."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._end: BucketEnd | None = None
        self._noted: tuple[int, int] = 0, 0
        self._files: Mapping[str, SiteFile] = {}
        self._sizes: Mapping[str, int] | None = None
        self._lock = threading.Lock()

    def fetch(self, path: str) -> bool:
        """Put the file of this path into the folder, checked; whether the store has one. Raises StoreError."""
        end, files = self._opened()
        sha256 = tile_of(path)
        try:
            if sha256:
                self._put(end, SiteFile(path, 0, sha256), end.tile(path))
            elif path in files:
                with end.opened(files[path]) as stream:
                    self._put(end, files[path], stream)
        except FileNotFoundError:
            return False
        return bool(sha256) or path in files

    def tile_sizes(self) -> Mapping[str, int]:
        """The bytes of each tile in the store, by its SHA-256."""
        self._opened()
        with self._lock:
            if self._sizes is None:
                self._sizes = _read_sizes(self._folder / TILE_SIZES)
            return self._sizes

    def _put(self, end: BucketEnd, file: SiteFile, stream: BinaryIO) -> None:
        try:
            FolderEnd(self._folder).put(file, stream)
        except DamagedError as error:
            raise StoreError(
                f"{file.path} is damaged in the store, at {end.name}; restore it from a copy"
            ) from error

    def _opened(self) -> tuple[BucketEnd, Mapping[str, SiteFile]]:
        """The store, and the files that it has as of now: the working copy may have been brought up to date."""
        about = (self._folder / ORIGIN).stat()
        with self._lock:
            if self._end is None:
                self._end = BucketEnd(open_objects(_address_of(self._folder)))
            if self._noted != (about.st_mtime_ns, about.st_ino):
                known = known_manifest(self._folder)
                self._files, self._sizes = {} if known is None else known.files, None
                self._noted = about.st_mtime_ns, about.st_ino
            return self._end, self._files


class _WorkingFolder(FolderEnd):
    """The folder of a working copy: what is fetched when asked for need not be there; the store replaces it."""

    may_lose = True  # all that was added here was sent before

    def lacks(self, state: SiteState) -> list[SiteFile]:
        """Nothing that comes when it is asked for."""
        return [each for each in super().lacks(state) if not each.is_lasting]


def known_manifest(folder: Path) -> Manifest | None:
    """What a working copy was made of; None where unknown."""
    try:
        note = json.loads((folder / ORIGIN).read_bytes())
    except (FileNotFoundError, ValueError):
        return None
    return (
        Manifest.parsed(json.dumps(note.get("manifest")).encode(), str(folder))
        if isinstance(note, dict)
        else None
    )


def store_address(folder: Path, path: str) -> str:
    """Where a file of a working copy's site lies in the store; "" for one that it has not."""
    known = known_manifest(folder)
    if known is None or path not in known.files:
        return ""
    return f"{_address_of(folder)}/{path if path in SHOWN else key_of(known.files[path])}"


def _address_of(folder: Path) -> str:
    return str(json.loads((folder / ORIGIN).read_bytes())["address"])


def _read_sizes(path: Path) -> Mapping[str, int]:
    try:
        sizes = json.loads(path.read_bytes())
    except (FileNotFoundError, ValueError):
        return {}
    return sizes if isinstance(sizes, dict) else {}
