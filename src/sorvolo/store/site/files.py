"""SiteFolder: what a site consists of - its folder, its catalogue, its tiles; the only path layout (docs/formats.md)."""

import json
import os
from collections.abc import Callable, Mapping, Sequence
from enum import StrEnum
from pathlib import Path
from typing import Any, Self, TypeVar

from sorvolo.errors import NotFoundError, StoreError, UnavailableError
from sorvolo.geometry.arrays import ImageRGB
from sorvolo.geometry.grid import SiteGrid
from sorvolo.store.atomic import TEMPORARY_PREFIX, writing
from sorvolo.store.exports.ground_files import COVERAGE
from sorvolo.store.exports.plain import features_name
from sorvolo.store.images import image_from_jpeg
from sorvolo.store.locks import take_lock
from sorvolo.store.nofollow import read_below, refuse_links
from sorvolo.store.site import catalogue as records
from sorvolo.store.site.catalogue import Catalogue, VersionEntry
from sorvolo.store.site.catalogue_place import (
    CATALOGUE,
    POINTER,
    Catalogues,
    create_database,
    is_site,
)
from sorvolo.store.site.names import checked_document, checked_image_path, checked_name
from sorvolo.store.site.origin import ORIGIN, TILE_SIZES, UNSENT, find_origin
from sorvolo.store.site.tiles import TileBlobs, TileView
from sorvolo.survey.flight import Site

T = TypeVar("T")

STAGED = "staged"
"""The folder of a flight in which its next run collects pictures until it is committed."""

LIVE_PREVIEW, LIVE_COVERAGE = "live.png", "live-coverage.geojson"
JOURNAL = "run.journal"
"""The file of a flight's folder from which a killed run goes on."""

LOCK = "site.lock"
"""Held by the one process that writes."""

COPYING = "copying.json"
"""In the folder while a copy of a site is made there."""

_MOST_REPORT_BYTES = 256_000_000  # of a report.json: an hour's track takes a hundredth


class BusyError(UnavailableError):
    """Another process writes the site."""


class HeightFile(StrEnum):
    """The files of a flight's folder that hold its heights."""

    SURFACE = "heights.tif"
    GROUND = "terrain.tif"
    ORTHOPHOTO = "orthophoto.tif"
    PICTURE = "heights.png"
    REPORT = "heights.json"


class SiteFolder:
    """One open site: its catalogue and its tile blobs, and the path of everything that lies in its folder.

    Every name that comes out of the catalogue is checked before it becomes a path. Made by `open`.
    """

    def __init__(self, folder: Path, catalogue: Catalogue, lock: int | None) -> None:
        self.folder, self.catalogue = folder, catalogue
        self._origin = find_origin(folder)
        self.blobs = TileBlobs(folder / "tiles", self._origin)
        self._lock = lock

    @classmethod
    def open(cls, folder: Path, *, write: bool, catalogues: Catalogues | None = None) -> Self:
        """Open a site folder. Raises StoreError as `Archive.open` does; to write, the folder is made and locked."""
        if not write:
            if not is_site(folder):
                raise NotFoundError(
                    f"no site at {folder}; make one with: sorvolo map INPUT --site {folder}"
                )
            _refuse_traps(
                folder, skipped=frozenset({"tiles", "keyframes"})
            )  # those are read link by link
            return cls(folder, Catalogue.open(folder, write=False, catalogues=catalogues), None)
        refuse_unfinished(folder)
        _make_folder(folder)
        lock = lock_folder(folder)
        try:
            _refuse_traps(folder)
            if not _has_catalogue(folder):
                create_database(folder, catalogues)
            return cls(folder, Catalogue.open(folder, write=True, catalogues=catalogues), lock)
        except BaseException:
            os.close(lock)
            raise

    def close(self) -> None:
        """Let go of the catalogue and of the right to write."""
        self.catalogue.close()
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None

    @property
    def is_writable(self) -> bool:
        """Whether this process has the right to write."""
        return self._lock is not None

    @property
    def mosaic_path(self) -> Path:
        """The map as a Cloud Optimized GeoTIFF."""
        return self.folder / "mosaic.tif"

    @property
    def preview_path(self) -> Path:
        """The map as a small PNG."""
        return self.folder / "preview.png"

    @property
    def kmz_path(self) -> Path:
        """The map for Google Earth."""
        return self.folder / "mosaic.kmz"

    @property
    def live_preview_path(self) -> Path:
        """A small PNG of the growing map."""
        return self.folder / LIVE_PREVIEW

    @property
    def live_coverage_path(self) -> Path:
        """The ground that a flight which is being mapped has seen by now."""
        return self.folder / LIVE_COVERAGE

    def flight_folder(self, flight_id: str) -> Path:
        """Where a flight's files lie; raises StoreError for an id that is no plain name."""
        return self.folder / "flights" / checked_name(flight_id, "flight")

    def flight_folders(self) -> list[Path]:
        """The folders of all flights that have one, whether the catalogue knows them or not."""
        return [
            path
            for path in (self.folder / "flights").glob("*")
            if path.is_dir() and not path.is_symlink()
        ]

    def document_path(self, flight_id: str, name: str) -> Path:
        """A text file of a flight; raises StoreError for a name that could lie elsewhere."""
        return self.flight_folder(flight_id) / checked_document(name)

    def height_path(self, flight_id: str, file: HeightFile) -> Path:
        """Where a file of a flight's heights lies, whether it is there or not."""
        return self.flight_folder(flight_id) / file

    def journal_path(self, flight_id: str) -> Path:
        """Where a run notes how far it is, until it is committed."""
        return self.flight_folder(flight_id) / JOURNAL

    def staged_folder(self, flight_id: str, run_id: int) -> Path:
        """Where a run collects pictures until it is committed."""
        return self.flight_folder(flight_id) / STAGED / str(int(run_id))

    def image_name(self, flight_id: str, run_id: int, index: int) -> str:
        """The path of a keyframe's image in the site folder, as the catalogue holds it."""
        return (
            f"flights/{checked_name(flight_id, 'flight')}/keyframes/{int(run_id)}/{index:06d}.jpg"
        )

    def stored_image(self, flight_id: str, image_path: str, step: int = 1) -> ImageRGB:
        """A stored keyframe, at a `step`-th (1, 2, 4, 8) of its size.

        Raises StoreError when it is gone, damaged, or no keyframe of this flight.
        """
        name = checked_image_path(image_path, flight_id)
        if self._origin is not None and not (self.folder / name).exists():
            self._origin.fetch(name)
        try:
            return image_from_jpeg(
                read_below(self.folder, name), str(self.folder / name), step=step
            )
        except FileNotFoundError as error:
            raise StoreError(
                f"the keyframe {self.folder / name} is gone; if its flight was mapped again meanwhile, list the "
                "keyframes anew"
            ) from error

    def report(self, flight_id: str) -> Mapping[str, Any]:
        """A flight's report.json; empty when somebody took it away or broke it."""
        return self._document(flight_id, "report.json")

    def coverage(self, flight_id: str) -> Sequence[Any]:
        """The features of a flight's coverage.geojson; none when it has none, or somebody broke it."""
        return self._features(flight_id, COVERAGE)

    def frames(self, flight_id: str) -> Sequence[Any]:
        """The features of a flight's frames.geojson; none when somebody took it away or broke it."""
        return self._features(flight_id, "frames")

    def _features(self, flight_id: str, collection: str) -> Sequence[Any]:
        name = features_name(collection, is_local=self.site().is_local)
        features = self._document(flight_id, name).get("features")
        return features if isinstance(features, list) else []

    def _document(self, flight_id: str, document: str) -> Mapping[str, Any]:
        """A JSON object in a flight's folder; empty when it is missing or broken."""
        try:
            name = f"flights/{checked_name(flight_id, 'flight')}/{document}"
            content = json.loads(read_below(self.folder, name, _MOST_REPORT_BYTES))
        except (OSError, ValueError, RecursionError):
            return {}
        return content if isinstance(content, dict) else {}

    def catalogue_rows(self, query: Callable[..., T], *arguments: object) -> T:
        """What a query finds in one transaction."""
        with self.catalogue.reading() as connection:
            return query(connection, *arguments)

    def find_site(self) -> Site | None:
        """The site; None while there is none."""
        return self.catalogue_rows(records.load_site)

    def site(self) -> Site:
        """The site; raises StoreError while there is none."""
        site = self.find_site()
        if site is None:
            raise StoreError(f"{self.folder} has no site yet; map a flight into it first")
        return site

    def site_grid(self) -> SiteGrid:
        """The pixel grid of the site's tiles; raises StoreError while there is no site."""
        site = self.site()
        return SiteGrid.at(site.origin, site.m_per_px, site.crs)

    def versions(self) -> list[VersionEntry]:
        """Every state of the map, oldest first."""
        return self.catalogue_rows(records.list_versions)

    def version_tiles(self, version_id: int) -> TileView:
        """The tiles of a version, read when asked for; none for a version that does not exist."""

        def hashes() -> Mapping[Any, str]:
            return self.catalogue_rows(records.tile_hashes, version_id)

        return TileView(self.blobs, hashes(), hashes)


def lock_folder(folder: Path) -> int:
    """The right to write, as a file descriptor to close; raises StoreError when another process has it."""
    path = folder / LOCK
    if path.is_symlink():
        refuse_links(folder)
    with writing(path):
        lock = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK, 0o644)
    if not take_lock(lock):
        os.close(lock)
        raise BusyError(f"another process is mapping into {folder}; wait until it has finished")
    return lock


def refuse_unfinished(folder: Path) -> None:
    """Raise StoreError for a folder into which a site is being copied."""
    if (folder / COPYING).is_file():
        raise StoreError(
            f"the copy in {folder} is not finished; run the same `sorvolo site copy` again"
        )


def _make_folder(folder: Path) -> None:
    """Create the folder; refuse one that holds anything but a site (or what a killed creation left)."""
    try:
        with writing(folder):
            folder.mkdir(parents=True, exist_ok=True)
    except (FileExistsError, NotADirectoryError) as error:
        raise StoreError(f"{folder} is a file, a folder was needed; choose another name") from error
    if _has_catalogue(folder):
        return
    names = (path.name for path in folder.iterdir())
    own = (LOCK, ORIGIN, TILE_SIZES, UNSENT)
    foreign = sorted(
        name for name in names if name not in own and not name.startswith(TEMPORARY_PREFIX)
    )
    if foreign:
        raise StoreError(
            f"{folder} is no site: it holds {foreign[0]!r} and no {CATALOGUE}; choose a new or empty folder"
        )


def _has_catalogue(folder: Path) -> bool:
    """Whether a catalogue, or what calls itself one, is there already: it is never written over."""
    return any((folder / name).exists() for name in (CATALOGUE, POINTER))


def _refuse_traps(folder: Path, *, skipped: frozenset[str] = frozenset()) -> None:
    """Raise StoreError for links, and for a rollback journal: SQLite would follow and delete the files it names.

    Sorvolo's catalogue is in write-ahead mode and never has one.
    """
    refuse_links(folder, skipped=skipped)
    journal = folder / f"{CATALOGUE}-journal"
    if journal.exists():
        raise StoreError(f"{journal} is no file of Sorvolo's; remove it, or do not use this site")
