"""The map's tiles on disk: blobs named by their content, and mappings over them to read and to write."""

import hashlib
from collections import OrderedDict
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, MutableMapping
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

import numpy as np

from sorvolo.errors import GeometryError, StoreError
from sorvolo.geometry.arrays import ImageRGBA, frozen
from sorvolo.geometry.grid import TileIndex
from sorvolo.store.atomic import atomic_write_bytes, remove_leftovers, sync_file, writing
from sorvolo.store.images import BytesCache, png_from_rgba, rgba_from_png
from sorvolo.store.nofollow import read_below
from sorvolo.store.site.files import Origin, checked_sha256, is_sha256

_CACHE_BYTES = (
    96 << 20
)  # the tiles of a map of some hectares, which half a dozen exports read one after the other
_WRITERS = 2  # threads that encode tiles
_WRITTEN_AT_ONCE = 4  # tiles that wait for them beyond the memory's bound, or are with them


class TileBlobs:
    """The folder `tiles/<aa>/<sha256>.png`; a blob is never overwritten, so versions of a map share it.

    The tiles read last are kept in memory. A tile that is not there is fetched from `origin`, in the folder of a
    working copy. Threads may share it.
    """

    def __init__(self, folder: Path, origin: Origin | None = None) -> None:
        self._folder, self._origin = folder, origin
        self._unsynced: set[str] = set()
        self.cache = BytesCache[str, ImageRGBA](_CACHE_BYTES, lambda tile: tile.nbytes)

    def save(self, rgba: ImageRGBA) -> str:
        """Write a tile unless its very bytes are there already, and return the SHA-256 of its PNG."""
        return self.keep(png_from_rgba(rgba))

    def keep(self, data: bytes) -> str:
        """The same for a tile that is encoded already."""
        sha256 = hashlib.sha256(data).hexdigest()
        path = self._path(sha256)
        if not path.exists():
            path.parent.mkdir(parents=True, exist_ok=True)
            # not synced one by one: `sync` does it for the blobs that last until the commit
            atomic_write_bytes(path, data, durable=False)
            self._unsynced.add(sha256)
        return sha256

    def load(self, sha256: str) -> ImageRGBA:
        """Read a tile, not to be written to.

        Raises FileNotFoundError when the blob is gone (a writer dropped its version) and StoreError when its
        bytes are not the ones that were written.
        """

        def read() -> ImageRGBA:
            tile = rgba_from_png(self.encoded(sha256), str(self._path(sha256)))
            tile.setflags(write=False)
            return tile

        return self.cache.get(sha256, read)

    def encoded(self, sha256: str) -> bytes:
        """A tile's PNG; raises as `load` does."""
        path = self._path(sha256)
        data = self._bytes(f"{self._folder.name}/{path.parent.name}/{path.name}")
        if hashlib.sha256(data).hexdigest() != sha256:
            raise StoreError(
                f"the tile {path} is damaged; restore it from a copy of the site, or map again"
            )
        return data

    def _bytes(self, name: str) -> bytes:
        try:
            return read_below(self._folder.parent, name)
        except FileNotFoundError:
            if self._origin is None or not self._origin.fetch(name):
                raise
            return read_below(self._folder.parent, name)

    def sync(self) -> None:
        """Wait until every blob written so far is on the disk."""
        written = self._unsynced.copy()  # threads may be adding to it
        for folder in {self._path(sha256).parent for sha256 in written}:
            for path in folder.iterdir():
                if path.stem in written:
                    sync_file(path)
            sync_file(folder)
        if written:
            sync_file(self._folder)
        self._unsynced -= written

    def remove(self, hashes: Collection[str]) -> None:
        """Delete blobs that no version refers to."""
        for sha256 in hashes:
            self._path(sha256).unlink(missing_ok=True)
            self.cache.forget(sha256)
        self._unsynced.difference_update(hashes)

    def stored(self) -> set[str]:
        """The SHA-256 of every blob in the folder."""
        return {path.stem for path in self._folder.glob("??/*.png") if is_sha256(path.stem)}

    def size_bytes(self, hashes: Iterable[str]) -> int:
        """How much room blobs take, each counted once."""
        paths = {sha256: self._path(sha256) for sha256 in set(hashes)}
        here = {sha256: path.stat().st_size for sha256, path in paths.items() if path.is_file()}
        there = {} if self._origin is None or len(here) == len(paths) else self._origin.tile_sizes()
        return sum(here.get(sha256, there.get(sha256, 0)) for sha256 in paths)

    def remove_leftovers(self) -> int:
        """Delete the half-written blobs of killed writers and count them."""
        return remove_leftovers(self._folder.glob("??"))

    def _path(self, sha256: str) -> Path:
        return self._folder / checked_sha256(sha256)[:2] / f"{sha256}.png"


class TileView(Mapping[TileIndex, ImageRGBA]):
    """The tiles of one version, read from disk one at a time when asked for.

    `refresh` gives the version's hashes as they are now: a version that is still growing replaces its blobs.
    """

    def __init__(
        self,
        blobs: TileBlobs,
        hashes: Mapping[TileIndex, str],
        refresh: Callable[[], Mapping[TileIndex, str]],
    ) -> None:
        self._blobs, self._hashes, self._refresh = blobs, dict(hashes), refresh

    @property
    def hashes(self) -> Mapping[TileIndex, str]:
        """The SHA-256 of each tile as of when the view was made: what names its content."""
        return self._hashes

    def __getitem__(self, index: TileIndex) -> ImageRGBA:
        """The tile; raises KeyError where there is none and StoreError when its version has been dropped."""
        sha256 = self._hashes[index]
        for _ in range(5):  # a writer would have to flush between each look and each read
            try:
                return self._blobs.load(sha256)
            except FileNotFoundError as error:
                former, sha256 = sha256, self._refresh().get(index, "")
                if sha256 == former:
                    raise _missing(error) from error
            if not sha256:
                break
        raise StoreError(
            f"tile {index} was replaced while the map was being read; read the map again"
        )

    def __iter__(self) -> Iterator[TileIndex]:
        return iter(self._hashes)

    def __len__(self) -> int:
        return len(self._hashes)

    def __contains__(self, index: object) -> bool:
        return index in self._hashes


class GrowingTiles(MutableMapping[TileIndex, ImageRGBA]):
    """The tiles of the version that is being made: copy-on-write over an earlier version, bounded in memory.

    Tiles come out read-only; a changed one has to be set. Setting a fully transparent tile removes it. Blobs
    are written when memory runs out and in `save`, so a tile repainted ten times a second is encoded once; threads
    encode them, and what fails there is tried again, and raised, by whoever asks next.
    """

    def __init__(
        self, blobs: TileBlobs, base: Mapping[TileIndex, str], tile_px: int, limit_bytes: int
    ) -> None:
        self._blobs, self._tile_px, self._limit_bytes = blobs, tile_px, limit_bytes
        self._base = dict(base)
        self._hashes = dict(base)  # what is on disk
        self._loaded: OrderedDict[TileIndex, ImageRGBA] = OrderedDict()
        self._unsaved: set[TileIndex] = set()  # loaded and newer than the disk
        self._changed: set[TileIndex] = set()  # since the last `save`
        self._superseded: set[str] = set()
        self._bytes = 0
        self._writers = ThreadPoolExecutor(_WRITERS, thread_name_prefix="tiles")
        self._writing: dict[
            TileIndex, tuple[ImageRGBA, Future[str]]
        ] = {}  # with the writers, the oldest first

    def __getitem__(self, index: TileIndex) -> ImageRGBA:
        if index in self._loaded:
            self._loaded.move_to_end(index)
            return self._loaded[index]
        if index in self._writing:
            tile, _ = self._writing[index]
            self._keep(index, tile)
            return tile
        sha256 = self._hashes[index]
        try:
            tile = self._blobs.load(sha256)
        except FileNotFoundError as error:
            raise _missing(error) from error
        self._keep(index, tile)
        return tile

    def __setitem__(self, index: TileIndex, rgba: ImageRGBA) -> None:
        """Replace a tile by a copy of `rgba`; raises GeometryError unless it has the grid's tile size."""
        if rgba.shape != (self._tile_px, self._tile_px, 4) or rgba.dtype != np.uint8:
            raise GeometryError(
                f"a tile here is {self._tile_px}x{self._tile_px} RGBA uint8, got {rgba.shape} {rgba.dtype}"
            )
        if not rgba[..., 3].any():
            if index in self:
                del self[index]
            return
        self._settle(index)
        self._unsaved.add(index)
        self._changed.add(index)
        self._keep(index, frozen(rgba, np.uint8))

    def __delitem__(self, index: TileIndex) -> None:
        if index not in self:
            raise KeyError(index)
        self._settle(index)
        dropped = self._loaded.pop(index, None)
        self._bytes -= 0 if dropped is None else dropped.nbytes
        self._unsaved.discard(index)
        self._replace_hash(index, None)
        self._changed.add(index)

    def __iter__(self) -> Iterator[TileIndex]:
        return iter(self._hashes.keys() | self._unsaved | self._writing.keys())

    def __len__(self) -> int:
        return len(self._hashes.keys() | self._unsaved | self._writing.keys())

    def __contains__(self, index: object) -> bool:
        return index in self._hashes or index in self._unsaved or index in self._writing

    def save(self) -> dict[TileIndex, str | None]:
        """Write every unsaved tile; return the hashes of tiles changed since the last call, None: removed."""
        for index in sorted(self._unsaved):
            self._write(index)
        self._settle_all()
        changed = {index: self._hashes.get(index) for index in self._changed}
        self._changed.clear()
        return changed

    def close(self) -> None:
        """End the threads that write; what they have not begun is not written any more."""
        self._writers.shutdown(cancel_futures=True)

    def release(self) -> None:
        """Drop from memory what is on the disk."""
        for index in self._loaded.keys() - self._unsaved:
            self._bytes -= self._loaded.pop(index).nbytes

    def take_back(self) -> None:
        """Undo every change: the tiles are the earlier version's again."""
        self._settle_all()
        for index in self._unsaved | {
            each for each in self if self._hashes.get(each) != self._base.get(each)
        }:
            del self[index]
        for index in self._base.keys() - self._hashes.keys():
            self._replace_hash(index, self._base[index])
            self._changed.add(index)

    def take_superseded(self) -> set[str]:
        """Hashes that this version no longer uses; the caller knows whether another version does."""
        self._settle_all()
        superseded = self._superseded - set(self._hashes.values())
        self._superseded = set()
        return superseded

    def _keep(self, index: TileIndex, tile: ImageRGBA) -> None:
        former = self._loaded.pop(index, None)
        self._bytes += tile.nbytes - (0 if former is None else former.nbytes)
        self._loaded[index] = tile
        while self._bytes > self._limit_bytes and len(self._loaded) > 1:
            oldest = next(iter(self._loaded))
            if oldest in self._unsaved:
                self._write(oldest)
            self._bytes -= self._loaded.pop(oldest).nbytes

    def _write(self, index: TileIndex) -> None:
        """Give a tile to the writers."""
        tile = self._loaded[index]
        self._writing[index] = tile, self._writers.submit(self._blobs.save, tile)
        self._unsaved.discard(index)
        while len(self._writing) > _WRITTEN_AT_ONCE:
            self._settle(next(iter(self._writing)))

    def _settle(self, index: TileIndex) -> None:
        """Wait until a tile that the writers have is written."""
        if index not in self._writing:
            return
        tile, written = self._writing.pop(index)
        try:
            failed = written.exception()
            # where the disk was full, there may be room by now
            self._replace_hash(
                index, self._blobs.save(tile) if isinstance(failed, OSError) else written.result()
            )
        except BaseException:  # a full disk, Ctrl-C: it is still to be written
            if index not in self._loaded:
                self._loaded[index] = tile
                self._bytes += tile.nbytes
            self._unsaved.add(index)
            raise

    def _settle_all(self) -> None:
        for index in list(self._writing):
            self._settle(index)

    def _replace_hash(self, index: TileIndex, sha256: str | None) -> None:
        former = self._hashes.pop(index, None)
        if former is not None and former != sha256:
            self._superseded.add(former)
        if sha256 is not None:
            self._hashes[index] = sha256


def _missing(error: FileNotFoundError) -> StoreError:
    return StoreError(
        f"{error.filename} is missing; restore it from a copy of the site, or map again"
    )


class TileFolder(Mapping[TileIndex, ImageRGBA]):
    """A mapping whose pictures are files without compression; only `save` changes it. The folder is the caller's."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._known: set[TileIndex] = set()

    def save(self, index: TileIndex, rgba: ImageRGBA) -> None:
        """Keep a tile; raises StoreError on a full disk."""
        path = self._path(index)
        with writing(path):
            np.save(path, rgba)
        self._known.add(index)

    def __getitem__(self, index: TileIndex) -> ImageRGBA:
        if index not in self._known:
            raise KeyError(index)
        return np.asarray(np.load(self._path(index)), np.uint8)

    def __iter__(self) -> Iterator[TileIndex]:
        return iter(self._known)

    def __len__(self) -> int:
        return len(self._known)

    def _path(self, index: TileIndex) -> Path:
        return self._folder / f"{index[0]}_{index[1]}.npy"
