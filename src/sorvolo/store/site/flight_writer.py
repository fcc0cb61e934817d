"""A flight on its way into a site: what is saved while it lasts, and the commit that makes it whole."""

import hashlib
import shutil
from collections.abc import Mapping, MutableMapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from sorvolo.errors import StoreError, UnavailableError, goes_on
from sorvolo.geometry.arrays import Boxes, ImageGray, ImageRGB, ImageRGBA, Mask
from sorvolo.geometry.grid import TileIndex
from sorvolo.store.atomic import (
    TEMPORARY_PREFIX,
    atomic_write_bytes,
    make_folder,
    sync_file,
    writing,
)
from sorvolo.store.exports.change_files import (
    BOXES_FILE,
    CROPS,
    boxes_json,
    crop_files,
    mask_name,
    object_crops,
    write_view_masks,
)
from sorvolo.store.exports.ground_files import frames_geojson
from sorvolo.store.exports.plain import features_name, geojson_bytes, json_bytes
from sorvolo.store.freed_memory import give_back
from sorvolo.store.images import ImageCache, jpeg_from_image
from sorvolo.store.nofollow import read_below
from sorvolo.store.rasters.geotiff import parse_crs
from sorvolo.store.site import catalogue as records
from sorvolo.store.site import change_records
from sorvolo.store.site.catalogue import StoredKeyframe
from sorvolo.store.site.register import register_flights
from sorvolo.store.site.tiles import GrowingTiles
from sorvolo.store.site.upkeep import (
    STAGED_FOLDERS,
    forget_journals,
    forget_unfinished,
    remove_unused,
    repair,
)
from sorvolo.survey.findings import Change
from sorvolo.survey.map_objects import ObjectSearch
from sorvolo.survey.mosaic import PlacedFrame, Status

if TYPE_CHECKING:
    from sorvolo.store.site.archive import Archive


class FlightWriter:
    """A flight on its way into the site; a context manager. Without `commit` the site stays as it was.

    Made by `Archive.begin_flight`. `tiles` is the map as it grows, over the newest complete version (over
    that one's parent when this very flight made it). Frames whose image is not saved are counted and listed, but no
    keyframes of the site: a flight over known ground need not store its pictures. Not for several threads at once.
    """

    def __init__(
        self,
        files: "Archive",
        flight_id: str,
        run_id: int,
        version_id: int,
        tiles: GrowingTiles,
        cache_bytes: int,
    ) -> None:
        self.tiles: MutableMapping[TileIndex, ImageRGBA] = tiles
        self._files, self._growing = files, tiles
        self._flight_id, self._run_id, self._version_id = flight_id, run_id, version_id
        self._sizes: dict[str, tuple[int, int]] = {}  # path of each saved image: width, height
        self._sha256: dict[int, str] = {}  # of each saved image, by frame index
        self._cache = ImageCache(lambda index: self.small_image(index, 1), cache_bytes)
        self._boxes: dict[str, list[list[int]]] = {}  # of each mask saved
        self._is_open = True

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: object,
        error: BaseException | None,
        trace: object,
    ) -> None:
        self._growing.close()
        if not self._is_open:
            return
        self._is_open = False
        has_journal = self._files.journal_path(self._flight_id).is_file()
        if isinstance(error, UnavailableError) or (has_journal and goes_on(error)):
            return
        try:
            # files that no reader can see go first: on a full disk, forgetting the run needs their space
            forget_journals(self._files)
            shutil.rmtree((self._files.folder / self._image_path(0)).parent, ignore_errors=True)
            shutil.rmtree(self._staged, ignore_errors=True)
            remove_unused(self._files)
            self._files.catalogue.fold_log()
            forget_unfinished(self._files)
        except StoreError:
            # if the disk is still full, the next opening does it, and the first error is the one to report
            if error is None:
                raise

    @property
    def run(self) -> str:
        """Which mapping run this is, as its pictures' paths name it."""
        return str(self._run_id)

    @property
    def is_open(self) -> bool:
        """Whether the flight is still on its way: neither committed nor left."""
        return self._is_open

    def save_image(self, index: int, image: ImageRGB) -> str:
        """Store an undistorted keyframe, (H, W, 3), as JPEG and return its path relative to the site folder.

        Raises StoreError on a full disk.
        """
        data = jpeg_from_image(image)
        relative = self._image_path(index)
        path = self._files.folder / relative
        make_folder(path.parent)
        atomic_write_bytes(path, data, durable=False)
        self._cache.forget(index)
        self._sizes[relative] = (image.shape[1], image.shape[0])
        self._sha256[index] = hashlib.sha256(data).hexdigest()
        return relative

    def stored(self, index: int) -> tuple[tuple[int, int], str]:
        """Size (width, height) and SHA-256 of a picture that this run has stored."""
        return self._sizes[self._image_path(index)], self._sha256[index]

    def keyframe(self, frame: PlacedFrame, image_path: str) -> StoredKeyframe:
        """The record of a frame whose picture was saved at this path."""
        width_px, height_px = self._sizes[image_path]
        camera = frame.camera.undistorted()
        sx, sy = camera.width_px / width_px, camera.height_px / height_px
        # centres of pixels lie half a pixel inside: frame = (stored + 1/2) s - 1/2
        frame_from_stored = np.array([[sx, 0, (sx - 1) / 2], [0, sy, (sy - 1) / 2], [0, 0, 1]])
        return StoredKeyframe(
            self._flight_id,
            frame.index,
            frame.name,
            frame.time_ns,
            frame.status,
            image_path,
            self._sha256[frame.index],
            camera.resized(width_px, height_px),
            frame.site_from_image @ frame_from_stored,
            frame.site_from_camera,
            np.asarray(frame.gains),
            frame.sigma_m,
            frame.residual_px,
            np.asarray(frame.vignette),
        )

    def keep_original(self, index: int) -> None:
        """Keep a stored picture as it is until the commit, so that a run that goes on after a kill finds it."""
        data = read_below(self._files.folder, self._image_path(index))
        atomic_write_bytes(self._original(index), data, durable=False)

    def take_over_image(self, index: int, size_px: tuple[int, int], sha256: str) -> str | None:
        """Take a picture (width, height) as stored that a killed run left; its path, or None where it is not there.

        It is there when its bytes are; the original, where it was kept, takes its place again.
        """
        relative = self._image_path(index)
        if self._original(index).is_file():
            with writing(self._files.folder / relative):
                self._original(index).replace(self._files.folder / relative)
        try:
            found = hashlib.sha256(read_below(self._files.folder, relative)).hexdigest()
        except FileNotFoundError:
            return None
        if found != sha256:
            return None
        self._sizes[relative] = size_px
        self._sha256[index] = sha256
        return relative

    def _original(self, index: int) -> Path:
        """What is removed with the files that killed processes leave, once the run is over."""
        path = self._files.folder / self._image_path(index)
        return path.with_name(f"{TEMPORARY_PREFIX}original-{path.name}")

    def image(self, index: int) -> ImageRGB:
        """A keyframe saved earlier, as it will be read later; read-only. StoreError if there is none."""
        return self._cache.get(index)

    def small_image(self, index: int, step: int) -> ImageRGB:
        """A keyframe saved earlier at a `step`-th (1, 2, 4, 8) of its size, rounded up."""
        if index not in self._sha256:
            raise StoreError(f"no image of frame {index} was saved; save it first")
        return self._files.stored_image(
            self._flight_id, self._image_path(index), self._sha256[index], step
        )

    def save_masks(self, frame_name: str, changed: ImageGray, valid: Mask, boxes: Boxes) -> None:
        """Store one view's mask and boxes (N, 4), to appear as masks/<frame>.png and in masks/boxes.json on commit.

        `changed` (H, W) is 0 or more, `valid` (H, W) where it is known. Raises StoreError on a full disk.
        """
        folder = self.staged("masks")
        name = mask_name(frame_name, self._boxes)
        write_view_masks(folder, name, changed, valid)
        self._boxes[name] = boxes_json(boxes)

    def take_back_tiles(self) -> None:
        """Make `tiles` what they were before the flight; readers see it with the next `flush`."""
        self._growing.take_back()

    def release_memory(self) -> None:
        """Drop tiles and pictures that can be read again: before a stage that needs others."""
        self._growing.release()
        self._files.blobs.cache.clear()
        self._cache.clear()
        give_back()

    def flush(self) -> None:
        """Let readers see the map as it is now."""
        changed = self._growing.save()
        with self._files.catalogue.changing() as connection:
            records.change_tiles(connection, self._version_id, changed)
            dropped = self._growing.take_superseded()
            dropped -= records.used_hashes(connection, dropped)
        self._files.blobs.remove(dropped)

    def commit(
        self,
        placed: Sequence[PlacedFrame],
        image_paths: Mapping[int, str],
        report: Mapping[str, Any],
        report_html: str,
        *,
        crs: str | None = None,
        notes: Sequence[str] = (),
        changes: Sequence[Change] | None = None,
        search: ObjectSearch | None = None,
        documents: Mapping[str, bytes] | None = None,
    ) -> int:
        """Make the flight and its map part of the site in one transaction; return the map's version.

        `image_paths` are what `save_image` returned, by frame index. Then the derived files are written,
        `crs` being that of mosaic.tif (the site's own by default); a kill or a full disk in between is made
        good by the next opening.

        `changes` is None for a flight that was mapped only; with changes, or with () for a comparison that found
        none, changes.geojson, changes.html and the crops are written, too, changes.html from `report`
        (docs/formats.md). `search` is what the frames were searched for and what was found, None when they were not:
        with it objects.geojson and the crops are written, too. `documents` are further files of the flight's folder by
        name, not empty. Raises SettingsError for a bad `crs`, StoreError on a full disk or an id that two
        changes have.
        """
        if crs is not None:
            parse_crs(crs, self._files.site_grid().grid)
        keyframes = [
            self.keyframe(frame, image_paths[frame.index])
            for frame in placed
            if frame.index in image_paths and frame.status is not Status.REJECTED
        ]
        site = self._files.site()
        found = change_records.stored_changes(self._flight_id, changes or ())
        texts = {
            **(documents or {}),
            features_name("frames", is_local=site.is_local): geojson_bytes(
                frames_geojson(placed, site)
            ),
            "report.json": json_bytes(report),
            "report.html": report_html.encode(),
        }
        # Times of the first and the last frame, ns; None without frames.
        times_ns = [int(frame.time_ns) for frame in placed]
        flown_ns = (min(times_ns), max(times_ns)) if times_ns else None
        frames = {
            status.value: sum(frame.status is status for frame in placed) for status in Status
        }
        self.flush()
        self._stage(changes or (), search)
        self._sync()
        with self._files.catalogue.changing() as connection:
            records.complete_run(
                connection,
                self._run_id,
                self._version_id,
                keyframes,
                texts,
                frames,
                notes,
                crs or "",
                flown_ns,
            )
            if changes is not None:
                change_records.add_comparison(connection, self._run_id, self._version_id, found)
            if search is not None:
                change_records.add_search(connection, self._run_id, search)
            register_flights(connection, {self._flight_id})
        self._is_open = False
        self.release_memory()
        forget_journals(self._files)
        repair(self._files)
        remove_unused(self._files)
        return self._version_id

    @property
    def _staged(self) -> Path:
        return self._files.staged_folder(self._flight_id, self._run_id)

    def staged(self, name: str) -> Path:
        """The folder of this name, made, whose files become the flight's with the commit. See `take_staged`."""
        folder = self._staged / name
        make_folder(folder)
        return folder

    def _stage(self, changes: Sequence[Change], search: ObjectSearch | None) -> None:
        """Put the pictures where a repair finds them; an empty folder takes away what a former run left."""
        flight_folder = self._files.flight_folder(self._flight_id)
        for name in STAGED_FOLDERS:
            if (flight_folder / name).is_dir():
                self.staged(name)
        for name, data in crop_files(changes).items():
            atomic_write_bytes(self.staged("changes") / name, data, durable=False)
        for name, data in object_crops(search.objects if search is not None else ()).items():
            atomic_write_bytes(self.staged(CROPS) / name, data, durable=False)
        if self._boxes:
            atomic_write_bytes(
                self._staged / "masks" / BOXES_FILE, json_bytes(self._boxes), durable=False
            )

    def _sync(self) -> None:
        """What the transaction names must reach the disk before it does."""
        self._files.blobs.sync()
        for relative in self._sizes:
            sync_file(self._files.folder / relative)
        if self._sizes:
            images = (self._files.folder / next(iter(self._sizes))).parent
            for folder in (
                images,
                images.parent,
                images.parent.parent,
                images.parent.parent.parent,
            ):
                sync_file(folder)
        if self._staged.is_dir():
            for path in (*self._staged.rglob("*"), self._staged, *list(self._staged.parents)[:3]):
                sync_file(path)
        sync_file(self._files.folder)

    def _image_path(self, index: int) -> str:
        return f"flights/{self._flight_id}/keyframes/{self._run_id}/{index:06d}.jpg"
