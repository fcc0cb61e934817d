"""The site folder: the only path layout, who may write, and how a flight enters whole or not at all."""

import fcntl
import os
import shutil
from collections.abc import Mapping, MutableMapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np

from sorvolo.errors import SettingsError, StoreError
from sorvolo.geometry.arrays import ImageRGB, ImageRGBA
from sorvolo.geometry.grid import SiteGrid, TileIndex
from sorvolo.store import catalogue as records
from sorvolo.store.atomic import (
    TEMPORARY_PREFIX,
    atomic_write_bytes,
    remove_leftovers,
    sync_file,
    writing,
)
from sorvolo.store.catalogue import Catalogue, FlightEntry, StoredKeyframe, VersionEntry
from sorvolo.store.exports import (
    frames_geojson,
    geojson_bytes,
    json_bytes,
    plain_json,
    write_kmz,
    write_preview,
)
from sorvolo.store.geotiff import parse_crs, write_cog
from sorvolo.store.images import ImageCache, image_from_jpeg, jpeg_from_image
from sorvolo.store.tiles import GrowingTiles, TileBlobs, TileView
from sorvolo.survey.flight import Site
from sorvolo.survey.mosaic import PlacedFrame, Status

_CATALOGUE = "site.db"
_LOCK = "site.lock"
_MEGABYTE = 1_000_000


class Archive:
    """One site on disk; a context manager. Made by `open`.

    The catalogue is the truth. Tiles and keyframe images are files that it names; everything else is derived
    from them and replaced whole, so that the folder can be read at any moment, whatever was killed when.
    """

    def __init__(self, folder: Path, catalogue: Catalogue, lock: int | None) -> None:
        self._folder, self._catalogue, self._lock = folder, catalogue, lock
        self._blobs = TileBlobs(folder / "tiles")
        self._writer: FlightWriter | None = None

    @classmethod
    def open(cls, folder: Path, *, write: bool) -> Self:
        """Open a site folder, to read it (while another process writes it, too) or as its only writer.

        Writing creates the folder, removes what a killed run left and repairs derived files. Raises
        StoreError when the folder is no site, is being written by another process, cannot be written, is
        damaged, or has another format version; then nothing in it was changed.
        """
        folder = Path(folder)
        path = folder / _CATALOGUE
        if not write:
            if not path.is_file():
                raise StoreError(f"no site at {folder}; make one with: sorvolo map INPUT --site {folder}")
            return cls(folder, Catalogue(path, write=False), None)
        _make_site_folder(folder)
        lock = _exclusive_lock(folder)
        try:
            if not path.exists():
                Catalogue.create(path)
            archive = cls(folder, Catalogue(path, write=True), lock)
        except BaseException:
            os.close(lock)
            raise
        try:
            archive._forget_unfinished()
            archive.repair()
        except BaseException:
            archive.close()
            raise
        return archive

    def close(self) -> None:
        """Let go of the catalogue and of the right to write."""
        self._catalogue.close()
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def folder(self) -> Path:
        """The site folder."""
        return self._folder

    @property
    def mosaic_path(self) -> Path:
        """The map as a Cloud Optimized GeoTIFF."""
        return self._folder / "mosaic.tif"

    @property
    def preview_path(self) -> Path:
        """The map as a small PNG."""
        return self._folder / "preview.png"

    @property
    def kmz_path(self) -> Path:
        """The map for Google Earth; there is none for a local site."""
        return self._folder / "mosaic.kmz"

    @property
    def live_preview_path(self) -> Path:
        """Where the mission may keep a small PNG of the growing map; removed when the flight is done."""
        return self._folder / "live.png"

    def flight_folder(self, flight_id: str) -> Path:
        """Where a flight's frames.geojson, report.json, report.html and keyframes lie."""
        return self._folder / "flights" / flight_id

    @property
    def has_site(self) -> bool:
        """Whether `create_site` was ever called on this folder."""
        with self._catalogue.reading() as connection:
            return records.load_site(connection) is not None

    def site(self) -> Site:
        """The site; raises StoreError when there is none yet."""
        with self._catalogue.reading() as connection:
            site = records.load_site(connection)
        if site is None:
            raise StoreError(f"{self._folder} has no site yet; map a flight into it first")
        return site

    def site_grid(self) -> SiteGrid:
        """The pixel grid of the site's tiles; raises StoreError when there is no site yet."""
        site = self.site()
        return SiteGrid.at(site.origin, site.m_per_px, site.crs)

    def create_site(self, site: Site) -> None:
        """Fix the site for ever; raises StoreError when the folder has one."""
        self._require_writable()
        if self.has_site:
            raise StoreError(f"{self._folder} holds the site {self.site().name!r}; choose another folder")
        with self._catalogue.changing() as connection:
            records.add_site(connection, site)

    def flights(self) -> list[FlightEntry]:
        """Every flight by rank. A complete run stays listed until the run that replaces it commits."""
        with self._catalogue.reading() as connection:
            return records.list_flights(connection)

    def versions(self) -> list[VersionEntry]:
        """Every state of the map, oldest first, the one being made included."""
        with self._catalogue.reading() as connection:
            return records.list_versions(connection)

    def keyframes(self, flight_id: str | None = None) -> list[StoredKeyframe]:
        """Keyframes of complete runs, by flight rank and index; of one flight when its id is given."""
        with self._catalogue.reading() as connection:
            return records.load_keyframes(connection, flight_id)

    def image(self, keyframe: StoredKeyframe) -> ImageRGB:
        """A keyframe's undistorted image; raises StoreError when its flight was mapped again meanwhile."""
        return _read_image(self._folder / keyframe.image_path)

    def tiles(self, version: int | None = None) -> Mapping[TileIndex, ImageRGBA]:
        """The tiles of a version, of the newest complete one by default, read when asked for; {} if none.

        Raises StoreError for a version that does not exist.
        """
        if version is not None and version not in {entry.id for entry in self.versions()}:
            raise StoreError(f"{self._folder} has no version {version} of its map; `versions` lists them")
        with self._catalogue.reading() as connection:
            newest = records.newest_version(connection)
        return self._view(newest if version is None else version)

    def live_tiles(self) -> Mapping[TileIndex, ImageRGBA]:
        """The tiles of the map that is being made, as of its last flush; else of the newest complete one."""
        with self._catalogue.reading() as connection:
            version = records.newest_version(connection, complete=False) or records.newest_version(connection)
        return self._view(version)

    def begin_flight(
        self,
        flight_id: str,
        fingerprint: str,
        settings: Mapping[str, Any],
        *,
        cache_mb: int = 256,
    ) -> "FlightWriter":
        """Start to map a flight; a flight mapped before keeps its rank, and stays readable until the commit.

        `settings["method"]`, if any, is listed with the flight. Images and tiles are kept in memory up to
        `cache_mb` each. Raises SettingsError for an id that is no folder name, StoreError when there is no
        site or another flight is being mapped.
        """
        self._require_writable()
        if self._writer is not None:
            raise StoreError(f"a flight is being mapped into {self._folder} already; finish it first")
        if not flight_id or flight_id.startswith(".") or not set(flight_id).isdisjoint('/\\:*?"<>|\0\n\r\t'):
            raise SettingsError(f"{flight_id!r} cannot name a flight's folder; choose letters and digits")
        grid = self.site_grid().grid
        with self._catalogue.changing() as connection:
            run_id, version_id = records.begin_run(
                connection, flight_id, fingerprint, str(settings.get("method", "")), plain_json(settings)
            )
            base = records.tile_hashes(connection, version_id)
        tiles = GrowingTiles(self._blobs, base, grid.tile_px, cache_mb * _MEGABYTE)
        self._writer = FlightWriter(self, flight_id, run_id, version_id, tiles, cache_mb * _MEGABYTE)
        return self._writer

    def repair(self) -> None:
        """Write the derived files that a killed process still owed, and those of the map that were deleted.

        Raises StoreError on a full disk; what the catalogue says stays true.
        """
        self._require_writable()
        with self._catalogue.reading() as connection:
            owed = records.unwritten_documents(connection)
            shown = records.derived_version(connection)
            newest = next((v for v in reversed(records.list_versions(connection)) if v.complete), None)
        for flight_id, _, documents in owed:
            with writing(self.flight_folder(flight_id)):
                self.flight_folder(flight_id).mkdir(parents=True, exist_ok=True)
            for name, content in documents.items():
                atomic_write_bytes(self.flight_folder(flight_id) / name, content)
        if newest is None:
            return
        if newest.id != shown or (newest.tiles and not self._map_is_there()):
            self._write_map(newest)
        with self._catalogue.changing() as connection:
            records.mark_written(connection, [run_id for _, run_id, _ in owed], newest.id)

    def _write_map(self, version: VersionEntry) -> None:
        tiles = self._view(version.id)
        if not tiles:
            for path in (self.preview_path, self.mosaic_path, self.kmz_path):
                path.unlink(missing_ok=True)
            return
        write_preview(tiles, self.preview_path)
        write_cog(tiles, self.site_grid(), self.mosaic_path, crs=version.export_crs or None)
        if not self.site().is_local:
            write_kmz(tiles, self.site_grid(), self.site().name, self.kmz_path)

    def _map_is_there(self) -> bool:
        paths = [self.preview_path, self.mosaic_path] + ([] if self.site().is_local else [self.kmz_path])
        return all(path.is_file() for path in paths)

    def _view(self, version_id: int) -> TileView:
        def hashes() -> Mapping[TileIndex, str]:
            with self._catalogue.reading() as connection:
                return records.tile_hashes(connection, version_id)

        return TileView(self._blobs, hashes(), hashes)

    def _require_writable(self) -> None:
        if self._lock is None:
            raise StoreError(f"{self._folder} was opened to be read; open it with write=True")

    def _forget_unfinished(self) -> None:
        """Drop runs that never committed, then every file that nothing refers to any more."""
        with self._catalogue.changing() as connection:
            records.drop_unfinished(connection)
        self._remove_unused()

    def _remove_unused(self) -> None:
        with self._catalogue.reading() as connection:
            runs, used = records.run_ids(connection), records.used_hashes(connection)
        flights = [folder for folder in self._folder.glob("flights/*") if folder.is_dir()]
        remove_leftovers([self._folder, *flights, *self._folder.glob("flights/*/keyframes/*")])
        self._blobs.remove_leftovers()
        self._blobs.remove(self._blobs.stored() - used)
        self.live_preview_path.unlink(missing_ok=True)
        for flight in flights:
            known = {str(run_id) for run_id in runs.get(flight.name, set())}
            for images in (flight / "keyframes").glob("*"):
                if images.name.isdigit() and images.name not in known:
                    shutil.rmtree(images, ignore_errors=True)
            if not known:
                for emptied in (flight / "keyframes", flight):
                    if emptied.is_dir() and not any(emptied.iterdir()):
                        emptied.rmdir()


class FlightWriter:
    """A flight on its way into the site; a context manager. Without `commit` the site stays as it was.

    Made by `Archive.begin_flight`. `tiles` is the map as it grows, over the newest complete version (over
    that one's parent when this very flight made it). Not for several threads at once.
    """

    def __init__(
        self,
        archive: Archive,
        flight_id: str,
        run_id: int,
        version_id: int,
        tiles: GrowingTiles,
        cache_bytes: int,
    ) -> None:
        self.tiles: MutableMapping[TileIndex, ImageRGBA] = tiles
        self._archive, self._growing = archive, tiles
        self._flight_id, self._run_id, self._version_id = flight_id, run_id, version_id
        self._sizes: dict[str, tuple[int, int]] = {}  # path of each saved image: width, height
        self._cache = ImageCache(
            lambda index: _read_image(archive.folder / self._image_path(index)), cache_bytes
        )
        self._is_open = True

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if not self._is_open:
            return
        self._is_open = False
        self._archive._writer = None
        try:
            # files that no reader can see go first: on a full disk, forgetting the run needs their space
            shutil.rmtree((self._archive.folder / self._image_path(0)).parent, ignore_errors=True)
            self._archive._remove_unused()
            self._archive._catalogue.fold_log()
            self._archive._forget_unfinished()
        except StoreError:
            # if the disk is still full, the next opening does it, and the first error is the one to tell
            if error is None:
                raise

    def save_image(self, index: int, image: ImageRGB) -> str:
        """Store an undistorted keyframe, (H, W, 3), as JPEG and return its path relative to the site folder.

        Raises StoreError on a full disk.
        """
        relative = self._image_path(index)
        path = self._archive.folder / relative
        with writing(path):
            path.parent.mkdir(parents=True, exist_ok=True)
        atomic_write_bytes(path, jpeg_from_image(image), durable=False)
        self._cache.forget(index)
        self._sizes[relative] = (image.shape[1], image.shape[0])
        return relative

    def image(self, index: int) -> ImageRGB:
        """A keyframe saved earlier, as it will be read later; read-only. StoreError if there is none."""
        return self._cache.get(index)

    def flush(self) -> None:
        """Let readers see the map as it is now."""
        changed = self._growing.save()
        catalogue = self._archive._catalogue
        with catalogue.changing() as connection:
            records.change_tiles(connection, self._version_id, changed)
            dropped = self._growing.take_superseded()
            dropped -= records.used_hashes(connection, dropped)
        self._archive._blobs.remove(dropped)

    def commit(
        self,
        placed: Sequence[PlacedFrame],
        image_paths: Mapping[int, str],
        report: Mapping[str, Any],
        report_html: str,
        *,
        crs: str | None = None,
        notes: Sequence[str] = (),
    ) -> int:
        """Make the flight and its map part of the site in one transaction; return the map's version.

        `image_paths` are what `save_image` returned, by frame index. Then the derived files are written,
        `crs` being that of mosaic.tif (the site's own by default); a kill or a full disk in between is made
        good by the next opening. Raises SettingsError for a bad `crs`, StoreError on a full disk or an
        unknown image path.
        """
        archive = self._archive
        if crs is not None:
            parse_crs(crs, archive.site_grid().grid)
        keyframes = [
            self._keyframe(frame, image_paths[frame.index])
            for frame in placed
            if frame.index in image_paths and frame.status is not Status.REJECTED
        ]
        documents = {
            "frames.geojson": geojson_bytes(frames_geojson(placed, archive.site())),
            "report.json": json_bytes(report),
            "report.html": report_html.encode(),
        }
        frames = {status.value: sum(frame.status is status for frame in placed) for status in Status}
        self.flush()
        self._sync()
        with archive._catalogue.changing() as connection:
            records.complete_run(
                connection, self._run_id, self._version_id, keyframes, documents, frames, notes, crs or ""
            )
        self._is_open = False
        archive._writer = None
        archive.repair()
        archive._remove_unused()
        return self._version_id

    def _sync(self) -> None:
        """What the transaction names must reach the disk before it does."""
        self._archive._blobs.sync()
        for relative in self._sizes:
            sync_file(self._archive.folder / relative)
        if self._sizes:
            images = (self._archive.folder / next(iter(self._sizes))).parent
            for folder in (images, images.parent, images.parent.parent, images.parent.parent.parent):
                sync_file(folder)
        sync_file(self._archive.folder)

    def _image_path(self, index: int) -> str:
        return f"flights/{self._flight_id}/keyframes/{self._run_id}/{index:06d}.jpg"

    def _keyframe(self, frame: PlacedFrame, image_path: str) -> StoredKeyframe:
        if image_path not in self._sizes:
            raise StoreError(f"the image {image_path} of frame {frame.name} was never saved; save it first")
        width_px, height_px = self._sizes[image_path]
        camera = frame.camera.undistorted()
        sx, sy = camera.width_px / width_px, camera.height_px / height_px
        # centres of pixels lie half a pixel inside: frame = (stored + 1/2) s - 1/2
        frame_from_stored = np.array([[sx, 0, (sx - 1) / 2], [0, sy, (sy - 1) / 2], [0, 0, 1]])
        return StoredKeyframe(
            self._flight_id, frame.index, frame.name, frame.time_ns, frame.status, image_path,
            camera.resized(width_px, height_px), frame.site_from_image @ frame_from_stored,
            frame.site_from_camera, np.asarray(frame.gains), frame.sigma_m, frame.residual_px,
            np.asarray(frame.vignette),
        )


def _make_site_folder(folder: Path) -> None:
    """Create the folder; refuse one that holds anything but a site (or what a killed creation left)."""
    try:
        with writing(folder):
            folder.mkdir(parents=True, exist_ok=True)
    except (FileExistsError, NotADirectoryError) as error:
        raise StoreError(f"{folder} is a file, a folder was needed; choose another name") from error
    if (folder / _CATALOGUE).exists():
        return
    names = (path.name for path in folder.iterdir())
    foreign = sorted(name for name in names if name != _LOCK and not name.startswith(TEMPORARY_PREFIX))
    if foreign:
        raise StoreError(
            f"{folder} is no site: it holds {foreign[0]!r} and no {_CATALOGUE}; choose a new or empty folder"
        )


def _exclusive_lock(folder: Path) -> int:
    with writing(folder / _LOCK):
        lock = os.open(folder / _LOCK, os.O_RDWR | os.O_CREAT, 0o644)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        os.close(lock)
        raise StoreError(f"another process is mapping into {folder}; wait until it has finished") from error
    return lock


def _read_image(path: Path) -> ImageRGB:
    try:
        return image_from_jpeg(path.read_bytes(), str(path))
    except FileNotFoundError as error:
        raise StoreError(
            f"the keyframe {path} is gone; if its flight was mapped again meanwhile, list the keyframes anew"
        ) from error
