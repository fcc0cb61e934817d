"""The site folder: the only path layout, who may write, and how a flight enters whole or not at all."""

import json
import os
import shutil
from collections.abc import Collection, Iterable, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Self

from sorvolo.errors import InputError, SettingsError, StoreError
from sorvolo.geometry.arrays import ImageRGB, ImageRGBA
from sorvolo.geometry.grid import SiteGrid, TileIndex
from sorvolo.store.atomic import atomic_write_bytes, remove_leftovers, writing
from sorvolo.store.exports.object_files import OBJECTS
from sorvolo.store.exports.plain import plain_json
from sorvolo.store.images import read_keyframe
from sorvolo.store.site import catalogue as records
from sorvolo.store.site import change_records, object_records
from sorvolo.store.site.catalogue import Catalogue, FlightEntry, OwedFiles, StoredKeyframe, TileDifference, VersionEntry
from sorvolo.store.site.change_records import StoredChange, StoredReview
from sorvolo.store.site.derived import (
    STAGED,
    map_is_there,
    take_staged,
    write_change_files,
    write_map_files,
    write_object_files,
    write_site_objects,
)
from sorvolo.store.site.flight_writer import FlightWriter
from sorvolo.store.site.folder import CATALOGUE, lock_site_folder, make_site_folder
from sorvolo.store.site.object_records import StoredObject, StoredSearch
from sorvolo.store.site.tiles import GrowingTiles, TileBlobs, TileView
from sorvolo.survey.findings import Verdict
from sorvolo.survey.flight import Site

__all__ = ["Archive", "FlightWriter"]

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
        path = folder / CATALOGUE
        if not write:
            if not path.is_file():
                raise StoreError(f"no site at {folder}; make one with: sorvolo map INPUT --site {folder}")
            return cls(folder, Catalogue(path, write=False), None)
        make_site_folder(folder)
        lock = lock_site_folder(folder)
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
    def objects_path(self) -> Path:
        """What stands on the site, as GeoJSON; there is none until a flight was searched for objects."""
        return self._folder / OBJECTS

    @property
    def live_preview_path(self) -> Path:
        """Where the mission may keep a small PNG of the growing map; removed when the flight is done."""
        return self._folder / "live.png"

    def flight_folder(self, flight_id: str) -> Path:
        """Where a flight's frames.geojson, report.json, report.html, keyframes and changes lie."""
        return self._folder / "flights" / flight_id

    def report(self, flight_id: str) -> Mapping[str, Any]:
        """A flight's report.json (docs/formats.md); empty when somebody took it away or broke it."""
        try:
            report = json.loads((self.flight_folder(flight_id) / "report.json").read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return {}
        return report if isinstance(report, dict) else {}

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

    def version_at(self, moment: datetime) -> VersionEntry:
        """The newest version that was complete at a moment, taken as UTC when it names no time zone.

        Raises InputError when there was no map yet.
        """
        utc = moment.replace(tzinfo=UTC) if moment.tzinfo is None else moment.astimezone(UTC)
        complete = [entry for entry in self.versions() if entry.complete]
        known = [entry for entry in complete if datetime.fromisoformat(entry.created_utc) <= utc]
        if not known:
            first = f"; its first version is of {complete[0].created_utc}" if complete else ", and has none now"
            raise InputError(f"{self._folder} had no map at {utc.isoformat(timespec='seconds')}{first}")
        return known[-1]

    def tile_difference(self, version: VersionEntry) -> TileDifference:
        """What a version's map has that the one it was painted over has not."""
        with self._catalogue.reading() as connection:
            changed, removed = records.tile_changes(connection, version)
        return TileDifference(len(changed), removed, self._blobs.size_bytes(changed))

    def tiles_alike(self, version: int, other: int) -> set[TileIndex]:
        """The places at which two versions have the same tile."""
        with self._catalogue.reading() as connection:
            one, two = records.tile_hashes(connection, version), records.tile_hashes(connection, other)
        return {index for index, sha256 in one.items() if two.get(index) == sha256}

    def comparisons(self) -> dict[int, Mapping[str, int]]:
        """The versions that comparisons made: how many changes of each kind each found."""
        with self._catalogue.reading() as connection:
            return change_records.compared_versions(connection)

    def changes(self, flight_id: str | None = None) -> list[StoredChange]:
        """The changes that complete runs found, by flight rank and number, with their verdicts; of one flight."""
        with self._catalogue.reading() as connection:
            return change_records.load_changes(connection, flight_id)

    def reviews(self) -> list[StoredReview]:
        """Everything that was said of changes, in the order of saying, also of those that were replaced since."""
        with self._catalogue.reading() as connection:
            return change_records.load_reviews(connection)

    @property
    def is_searched(self) -> bool:
        """Whether any flight's frames were searched for objects."""
        return bool(self.searches())

    def objects(self, flight_id: str | None = None) -> list[StoredObject]:
        """The objects that complete runs found, by flight rank and number; of one flight."""
        with self._catalogue.reading() as connection:
            return object_records.load_objects(connection, flight_id)

    def searches(self) -> list[StoredSearch]:
        """Which ground each complete run searched for objects, by flight rank."""
        with self._catalogue.reading() as connection:
            return object_records.load_searches(connection)

    def newest_objects(self, flights: Collection[str] | None = None) -> list[StoredObject]:
        """What stands on the site by the newest look at each piece of ground; as far as these flights know."""
        with self._catalogue.reading() as connection:
            found, searches = object_records.load_objects(connection), object_records.load_searches(connection)
        return object_records.newest_objects(
            [each for each in found if flights is None or each.flight_id in flights],
            [each for each in searches if flights is None or each.flight_id in flights],
        )

    def review(self, change_ids: str | Iterable[str], verdict: Verdict, note: str = "") -> None:
        """Say of one change, or of several, that it is real or not; the flights' change files follow.

        A later word replaces an earlier one. Raises InputError, and says nothing, when an id is unknown.
        """
        self._require_writable()
        wanted = {change_ids} if isinstance(change_ids, str) else set(change_ids)
        with self._catalogue.changing() as connection:
            found = [each for each in change_records.load_changes(connection) if each.id in wanted]
            unknown = sorted(wanted - {each.id for each in found})
            if unknown:
                raise InputError(
                    f"{self._folder} has no change {', '.join(unknown)}; `sorvolo review {self._folder}` lists them"
                )
            change_records.put_reviews(connection, found, verdict, note)
            records.owe_documents(connection, {each.flight_id for each in found})
        self.repair()

    def keyframes(self, flight_id: str | None = None) -> list[StoredKeyframe]:
        """Keyframes of complete runs, by flight rank and index; of one flight when its id is given."""
        with self._catalogue.reading() as connection:
            return records.load_keyframes(connection, flight_id)

    def image(self, keyframe: StoredKeyframe) -> ImageRGB:
        """A keyframe's undistorted image; raises StoreError when its flight was mapped again meanwhile."""
        return read_keyframe(self._folder / keyframe.image_path)

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
            owed = records.owed_files(connection)
            shown = records.derived_version(connection)
            newest = next((v for v in reversed(records.list_versions(connection)) if v.complete), None)
        for files in owed:
            self._write_flight_files(files)
        if owed or self.is_searched != self.objects_path.is_file():
            write_site_objects(self)
        if newest is None:
            return
        if not self._looks_like(newest, shown) or (newest.tiles and not map_is_there(self)):
            write_map_files(self, newest)
        with self._catalogue.changing() as connection:
            records.mark_written(connection, [files.run_id for files in owed], newest.id)

    def _looks_like(self, version: VersionEntry, shown: int) -> bool:
        """Whether the map's files, which show another version, would be the same for this one."""
        if version.id == shown:
            return True
        crs = {each.id: each.export_crs for each in self.versions()}.get(shown)
        with self._catalogue.reading() as connection:
            same = records.tile_hashes(connection, version.id) == records.tile_hashes(connection, shown)
        return same and crs == version.export_crs

    def _write_flight_files(self, files: OwedFiles) -> None:
        folder = self.flight_folder(files.flight_id)
        with writing(folder):
            folder.mkdir(parents=True, exist_ok=True)
        for name, content in files.documents.items():
            if content:
                atomic_write_bytes(folder / name, content)
        for name in files.leftovers:
            (folder / name).unlink(missing_ok=True)
        take_staged(folder, files.run_id)
        with self._catalogue.reading() as connection:
            is_compared = change_records.is_compared(connection, files.run_id)
            is_searched = object_records.is_searched(connection, files.run_id)
        version = next((each for each in self.versions() if each.run_id == files.run_id and is_compared), None)
        write_change_files(self, files.flight_id, version)
        write_object_files(self, files.flight_id, is_searched=is_searched)

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
            for images in (*(flight / "keyframes").glob("*"), *(flight / STAGED).glob("*")):
                if images.name.isdigit() and images.name not in known:
                    shutil.rmtree(images, ignore_errors=True)
            for emptied in (flight / STAGED, *(() if known else (flight / "keyframes", flight))):
                if emptied.is_dir() and not any(emptied.iterdir()):
                    emptied.rmdir()


