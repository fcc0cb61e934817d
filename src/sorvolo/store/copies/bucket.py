"""An object store as one end of a copy: objects named by their content, and a manifest that is replaced atomically."""

import hashlib
import io
import json
import secrets
import tempfile
import threading
import warnings
from collections.abc import Mapping
from contextlib import AbstractContextManager, closing, nullcontext
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, BinaryIO, Self

from sorvolo.errors import NotFoundError, SorvoloWarning, StoreError
from sorvolo.store.atomic import writing
from sorvolo.store.copies.folder import (
    CatalogueState,
    SiteFile,
    SiteState,
    checked_path,
    find_state,
    missing_from,
    named_files,
    refuse_damaged,
    refuse_loss,
    refuse_other,
    tile_of,
)
from sorvolo.store.copies.object_store import ConflictError, Objects
from sorvolo.store.nofollow import chunks_of
from sorvolo.store.site.catalogue import Catalogue
from sorvolo.store.site.catalogue_place import CATALOGUE
from sorvolo.store.site.files import checked_sha256

MANIFEST = "sorvolo-site.json"
_FORMAT = 1
_MOST_MANIFEST_BYTES = 256_000_000  # a million pictures
_MOST_TILE_BYTES = 16_000_000  # 512 x 512 pixels take a megabyte
SHOWN = ("mosaic.tif", "preview.png")
"""The newest map, which has plain names as well, for GIS and browsers."""

_KEYS_AT_ONCE = 1000  # in a request to remove them
_MOST_SUFFIX = 10  # characters of an ending, its point included


@dataclass(frozen=True, eq=False)
class Manifest:
    """What a bucket's site consists of: the content of `sorvolo-site.json`. Tiles are those that the catalogue names.

    `id` is another one each time the site is. `tidying` is since when objects that it does not name are being removed
    ("": they are not), `tidied` another text after each time that they were.
    """

    id: str
    generation: int
    written_utc: str
    held: CatalogueState
    catalogue: tuple[int, str]  # bytes, SHA-256
    files: Mapping[str, SiteFile]
    tidying: str = ""
    tidied: str = ""

    def data(self) -> bytes:
        """As JSON."""
        held = self.held
        return json.dumps(
            {
                "format": "sorvolo site",
                "format_version": _FORMAT,
                "id": self.id,
                "generation": self.generation,
                "written_utc": self.written_utc,
                "site": {"identity": held.identity, "name": held.name},
                "digest": held.digest,
                "versions": sorted(map(list, held.versions)),
                "reviews": dict(held.reviews),
                "catalogue": list(self.catalogue),
                "tidying": self.tidying,
                "tidied": self.tidied,
                "files": {
                    path: [each.size, each.sha256] for path, each in sorted(self.files.items())
                },
            }
        ).encode()

    @classmethod
    def parsed(cls, data: bytes, where: str) -> Self:
        """Raises StoreError for what Sorvolo did not write, or a later version wrote."""
        try:
            row = json.loads(data)
            if row["format"] != "sorvolo site":
                raise ValueError("another format")
            if row["format_version"] != _FORMAT:
                raise StoreError(
                    f"{where} is written in format {row['format_version']!r}, this Sorvolo reads {_FORMAT}; use "
                    "the one that wrote it"
                )
            files = {
                checked_path(path): SiteFile(path, _size(size), checked_sha256(sha256))
                for path, (size, sha256) in row["files"].items()
            }
            held = CatalogueState(
                str(row["site"]["identity"]),
                str(row["site"]["name"]),
                str(row["digest"]),
                frozenset(
                    (int(version), int(run), str(utc)) for version, run, utc in row["versions"]
                ),
                {str(change): str(utc) for change, utc in row["reviews"].items()},
            )
            size, sha256 = row["catalogue"]
            catalogue = _size(size), checked_sha256(sha256)
            return cls(
                str(row["id"]),
                int(row["generation"]),
                str(row["written_utc"]),
                held,
                catalogue,
                files,
                str(row["tidying"]),
                str(row["tidied"]),
            )
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
            raise StoreError(
                f"{where}/{MANIFEST} is damaged, or no Sorvolo wrote it; restore it from a copy of the site"
            ) from error


class OvertakenError(StoreError):
    """Another writer has changed the site in the store meanwhile."""


class BucketEnd:
    """A place in an object store that a site is copied from or to.

    `base` is the id of the manifest that a working copy was made of ("": none was there): no other one is replaced.
    None: one is replaced whose content the new state has.
    """

    def __init__(self, objects: Objects, base: str | None = None) -> None:
        self._objects, self.name, self._base = objects, objects.name, base
        self._begin(None, "", {})
        self.written: Manifest | None = None  # by `conclude`
        self.shown: Manifest | None = None  # what `state` last gave
        self.tile_bytes: Mapping[
            str, int
        ] = {}  # of the site's tiles, by SHA-256, after `state` or `conclude`

    @property
    def has_site(self) -> bool:
        """Whether a site is there."""
        return self.find_manifest()[0] is not None

    def find_manifest(self) -> tuple[Manifest | None, str]:
        """The manifest and its ETag; None and "" where there is no site."""
        try:
            data, etag = self._objects.read(MANIFEST, _MOST_MANIFEST_BYTES)
        except FileNotFoundError:
            return None, ""
        return Manifest.parsed(data, self.name), etag

    def manifest(self) -> Manifest:
        """The manifest. Raises StoreError where there is no site."""
        found, _ = self.find_manifest()
        if found is None:
            raise NotFoundError(
                f"no site at {self.name}; put one there: sorvolo site copy FOLDER {self.name}"
            )
        return found

    def state(self, scratch: Path) -> SiteState:
        """The site as of now, its catalogue in a file in `scratch`."""
        return self.state_of(self.manifest(), scratch)

    def state_of(self, manifest: Manifest, scratch: Path) -> SiteState:
        """The site as a manifest describes it. Raises StoreError for a catalogue that is not the one it names."""
        path = scratch / CATALOGUE
        size, sha256 = manifest.catalogue
        self.fetch(SiteFile(catalogue_key(sha256), size, sha256), catalogue_key(sha256), path)
        place = f"the catalogue at {self.name}"
        with closing(Catalogue.at(path, write=True, place=place)) as catalogue:
            held = find_state(catalogue)
            lasting, _, _ = named_files(catalogue)
        if held is None or held.identity != manifest.held.identity:
            raise StoreError(
                f"{self.name}: the catalogue is not the one of this site; restore it from a copy"
            )
        sizes = self._objects.sizes("tiles")
        files = dict(manifest.files)
        tiles = {path: sha256 for path, sha256 in lasting.items() if tile_of(path)}
        files |= {
            path: SiteFile(path, sizes.get(path, 0), sha256) for path, sha256 in tiles.items()
        }
        files |= {path: SiteFile(path, 0) for path in lasting.keys() - files.keys()}
        self.shown = manifest
        self.tile_bytes = {sha256: sizes.get(path, 0) for path, sha256 in tiles.items()}
        return SiteState(held, path, files)

    def is_still(self, state: SiteState, scratch: Path) -> bool:
        """Whether the site is unchanged."""
        return self.shown is not None and self.manifest().id == self.shown.id

    def opened(self, file: SiteFile) -> AbstractContextManager[BinaryIO]:
        """A file's bytes; reading raises FileNotFoundError when it is gone."""
        if not file.sha256 or (file.size == 0 and tile_of(file.path)):
            raise FileNotFoundError(2, "no such object", f"{self.name}/{file.path}")
        return closing(self._objects.opened(key_of(file), file.size))

    def tile(self, path: str) -> BinaryIO:
        """A tile's bytes. Raises FileNotFoundError for none."""
        return io.BytesIO(self._objects.read(path, _MOST_TILE_BYTES)[0])

    def fetch(self, file: SiteFile, key: str, path: Path) -> None:
        """Write an object to a path. Raises StoreError when it is gone, or its hash does not match its name."""
        digest = hashlib.sha256()
        try:
            with (
                closing(self._objects.opened(key, file.size)) as stream,
                open(path, "wb") as target,
            ):
                for chunk in chunks_of(stream):
                    digest.update(chunk)
                    target.write(chunk)
        except FileNotFoundError as error:
            raise StoreError(
                f"{self.name}/{key} is gone; restore it from a copy of the site"
            ) from error
        if digest.hexdigest() != file.sha256:
            raise StoreError(f"{self.name}/{key} is damaged; restore it from a copy of the site")

    def being_filled(self) -> AbstractContextManager[None]:
        """No lock is held: `conclude` detects another writer."""
        return nullcontext()

    def accept(self, new: SiteState, scratch: Path) -> None:
        """Read what the store holds. Raises StoreError where the new state would lose any of it."""
        manifest, etag = self.find_manifest()
        if manifest is None:
            if self._base:
                raise StoreError(
                    f"the site at {self.name} is gone; copy it there again: sorvolo site copy"
                )
            own = ("tiles", "files", "catalogues", MANIFEST, *SHOWN)
            foreign = sorted(key for key in self._objects.first() if key.split("/")[0] not in own)
            if foreign:
                raise StoreError(
                    f"{self.name} is not empty and holds no site (there is {foreign[0][:80]!r}); choose another place"
                )
        else:
            if self._base not in (None, manifest.id):
                raise self._conflict()
            if manifest.tidying:
                raise StoreError(
                    f"the site at {self.name} has been pruned since {manifest.tidying}; run the same command again "
                    f"later, or finish a prune that was stopped: sorvolo site prune {self.name}"
                )
            refuse_other(self.name, manifest.held.identity, new.held)
            if self._base is None:
                refuse_loss(self.name, missing_from(manifest.held, manifest.files, new))
        self._begin(manifest, etag, self._objects.sizes(""))

    def _begin(self, former: Manifest | None, etag: str, stored: Mapping[str, int]) -> None:
        """Begin a round of copying over what the store holds."""
        self._former, self._etag, self._stored = former, etag, stored
        self._put: dict[str, SiteFile] = {}
        self._claimed: set[str] = set()
        self._lock = threading.Lock()

    def lacks(self, state: SiteState) -> list[SiteFile]:
        """The files whose bytes are not there, judged by names and sizes; the others are noted."""
        lacking = []
        for file in state.files.values():
            stored = self._stored.get(key_of(file)) if file.sha256 else None
            # 0: not fetched into a working copy
            if stored is not None and file.size in (stored, 0):
                self._put[file.path] = replace(file, size=stored)
            else:
                lacking.append(file)
        return lacking

    def put(self, file: SiteFile, stream: BinaryIO) -> bool:
        """Store a file under its content's name; False where it is stored.

        Raises DamagedError for bytes of another SHA-256 than the file's.
        """
        digest, size = hashlib.sha256(), 0
        # nothing can be read from a store while a store is written to
        is_here = isinstance(getattr(stream, "raw", None), io.FileIO)
        with tempfile.TemporaryFile() as beside:
            for chunk in chunks_of(stream):
                digest.update(chunk)
                size += len(chunk)
                if not is_here:
                    with writing(Path(tempfile.gettempdir())):
                        beside.write(chunk)
            refuse_damaged(file, digest.hexdigest())
            named = SiteFile(file.path, size, digest.hexdigest())
            key = key_of(named)
            is_new = self._stored.get(key) != size
            with self._lock:  # files with the same bytes share one object
                is_first = key not in self._claimed
                self._claimed.add(key)
            if is_new and is_first:
                self._objects.write(key, stream if is_here else beside)
            self._put[file.path] = named
        return is_new

    def conclude(self, state: SiteState) -> None:
        """Make everything that was put the site. Raises StoreError where another writer was faster."""
        former, stored = self._former, self._stored
        here = {
            path: replace(each, stamp=0) for path, each in self._put.items() if path in state.files
        }
        self.tile_bytes = {
            tile_of(path): stored.get(path, each.size)
            for path, each in here.items()
            if tile_of(path)
        }
        files = {path: each for path, each in here.items() if not tile_of(path)}
        if former and former.held == state.held and dict(former.files) == files:
            self.written = former  # nothing is new
            return
        sha256, size = (
            hashlib.sha256(state.catalogue.read_bytes()).hexdigest(),
            state.catalogue.stat().st_size,
        )
        if stored.get(catalogue_key(sha256)) != size:
            with state.catalogue.open("rb") as stream:
                self._objects.write(catalogue_key(sha256), stream)
        generation = 1 if former is None else former.generation + 1
        now_utc = datetime.now(UTC).isoformat(timespec="seconds")
        manifest = Manifest(
            secrets.token_hex(16), generation, now_utc, state.held, (size, sha256), files
        )
        self._swap(manifest)
        self.written = manifest
        self._show(manifest)

    def free_bytes(self) -> int | None:
        """Unknown."""
        return None

    def _swap(self, manifest: Manifest) -> None:
        """Replace the manifest by this one if it has not changed since it was read."""
        try:
            self._objects.swap(MANIFEST, manifest.data(), self._etag)
        except (ConflictError, StoreError) as error:
            # the answer may have been lost, not what was written
            found, _ = self.find_manifest()
            if found is not None and found.id == manifest.id:
                return
            if isinstance(error, ConflictError):
                raise self._conflict() from None
            raise

    def _show(self, manifest: Manifest) -> None:
        """Store the newest map under plain names as well; of two writers, the later one wins."""
        former = self._former
        shown = {} if former is None else {name: former.files.get(name) for name in SHOWN}
        done = ""
        try:
            while done != manifest.id:
                for name in SHOWN:
                    file = manifest.files.get(name)
                    if file == shown.get(name) and not done:
                        continue
                    if file is None:
                        self._objects.remove([name])
                    else:
                        self._objects.copy(key_of(file), name)
                done, manifest = manifest.id, self.manifest()
        except StoreError as error:
            warnings.warn(
                f"the site is at {self.name}, but not its map under the plain names {', '.join(SHOWN)}: {error}",
                SorvoloWarning,
                stacklevel=2,
            )

    def _conflict(self) -> OvertakenError:
        return OvertakenError(
            f"another writer has changed the site at {self.name} meanwhile; nothing there was changed, and nothing "
            "here is lost. Run the same command again"
        )


@dataclass(frozen=True)
class Pruned:
    """What was removed, or would be: objects and their bytes; and how many bytes stay."""

    objects: int
    bytes: int
    kept_bytes: int


def prune(objects: Objects, older_than_s: float, *, only_count: bool = False) -> Pruned:
    """Remove the objects that the site does not name and that were stored more than `older_than_s` ago.

    A concurrent writer could rely on such an object. So the manifest states that a prune runs, and writers that began
    before find that the manifest has changed. A prune that was killed is repeated. Raises StoreError where there is no
    site, or where another writer comes in between.
    """
    end = BucketEnd(objects)
    manifest, etag = end.find_manifest()
    if manifest is None:
        raise NotFoundError(f"no site at {objects.name}; there is nothing to tidy")
    with tempfile.TemporaryDirectory(prefix="sorvolo-") as scratch:
        files = end.state_of(manifest, Path(scratch)).files.values()
    used = {key_of(file) for file in files if file.sha256}
    used |= {catalogue_key(manifest.catalogue[1]), MANIFEST, *SHOWN}
    if not only_count:
        manifest = replace(manifest, tidying=datetime.now(UTC).isoformat(timespec="seconds"))
        _swap_manifest(objects, manifest, etag)
    stored = {
        key: about
        for key, about in objects.listing("").items()
        if key.startswith(("tiles/", "files/", "catalogues/"))
    }
    unused = {
        key: size
        for key, (size, age_s) in stored.items()
        if key not in used and age_s > older_than_s
    }
    if not only_count:
        keys = sorted(unused)
        for start in range(0, len(keys), _KEYS_AT_ONCE):
            objects.remove(keys[start : start + _KEYS_AT_ONCE])
        _, etag = end.find_manifest()
        _swap_manifest(objects, replace(manifest, tidying="", tidied=secrets.token_hex(8)), etag)
    total = sum(size for size, _ in stored.values())
    return Pruned(len(unused), sum(unused.values()), total - sum(unused.values()))


def _swap_manifest(objects: Objects, manifest: Manifest, etag: str) -> None:
    try:
        objects.swap(MANIFEST, manifest.data(), etag)
    except ConflictError:
        raise StoreError(
            f"another writer has changed the site at {objects.name}; run the same command again"
        ) from None


def sites_at(objects: Objects) -> list[str]:
    """The sites at a place and in the folders right below it, by name; "." where the place itself is one."""
    if BucketEnd(objects).has_site:
        return ["."]
    return sorted(each for each in objects.folders() if objects.has(f"{each}/{MANIFEST}"))


def key_of(file: SiteFile) -> str:
    """The key of a file's bytes: a tile's path, else its SHA-256 with the file's ending, which programs need."""
    if tile_of(file.path):
        return file.path
    suffix = Path(file.path).suffix.lower()
    ending = (
        suffix if suffix[1:].isalnum() and suffix.isascii() and len(suffix) <= _MOST_SUFFIX else ""
    )
    return f"files/{file.sha256[:2]}/{file.sha256}{ending}"


def catalogue_key(sha256: str) -> str:
    """The key of a catalogue."""
    return f"catalogues/{sha256}.db"


def _size(value: Any) -> int:
    if type(value) is not int or value < 0:
        raise ValueError(f"a size of {value!r}")
    return value
