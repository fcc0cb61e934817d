"""Files that are made from the catalogue and can be made again: the map's, and those of a flight's comparison."""

import os
import shutil
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING

from sorvolo.geometry.arrays import ImageRGBA
from sorvolo.store.atomic import TEMPORARY_PREFIX, atomic_write_bytes, sync_file, writing
from sorvolo.store.exports.change_files import changes_geojson, crop_names
from sorvolo.store.exports.map_pictures import pictures, write_kmz, write_preview
from sorvolo.store.exports.object_files import CROPS, OBJECTS, objects_geojson
from sorvolo.store.exports.plain import geojson_bytes
from sorvolo.store.images import rgba_from_png
from sorvolo.store.pages.changes import changes_page
from sorvolo.store.rasters.geotiff import write_cog
from sorvolo.store.site.catalogue import VersionEntry

if TYPE_CHECKING:
    from sorvolo.store.site.archive import Archive

STAGED = "staged"
"""The folder of a flight in which its next run collects pictures until it is committed."""

STAGED_FOLDERS = ("changes", "masks", CROPS)
_PICTURE_PX, _UNCHANGED_PX = 1600, 800  # of the map in changes.html; daily flights without change should cost little


def write_map_files(archive: "Archive", version: VersionEntry) -> None:
    """Write mosaic.tif, preview.png and mosaic.kmz of a version; remove them when it has no tiles."""
    tiles = archive.tiles(version.id)
    if not tiles:
        for path in (archive.preview_path, archive.mosaic_path, archive.kmz_path):
            path.unlink(missing_ok=True)
        return
    with ThreadPoolExecutor(1, thread_name_prefix="geotiff") as other:  # takes as long as all else together
        geotiff = other.submit(
            write_cog, tiles, archive.site_grid(), archive.mosaic_path, crs=version.export_crs or None
        )
        write_preview(tiles, archive.preview_path)
        if not archive.site().is_local:
            write_kmz(tiles, archive.site_grid(), archive.site().name, archive.kmz_path)
        geotiff.result()


def map_is_there(archive: "Archive") -> bool:
    """Whether no file of the map is missing."""
    paths = [archive.preview_path, archive.mosaic_path]
    return all(path.is_file() for path in paths + ([] if archive.site().is_local else [archive.kmz_path]))


def take_staged(flight_folder: Path, run_id: int) -> None:
    """Put the pictures that a committed run collected in the place of those of the run before it.

    May be stopped at any moment and called again.
    """
    staged = flight_folder / STAGED / str(run_id)
    for name in STAGED_FOLDERS:
        if not (staged / name).is_dir():
            continue
        with writing(flight_folder / name):
            former = flight_folder / f"{TEMPORARY_PREFIX}{os.getpid()}-{name}"
            if (flight_folder / name).exists():
                os.replace(flight_folder / name, former)
            if any((staged / name).iterdir()):
                os.replace(staged / name, flight_folder / name)
            else:
                (staged / name).rmdir()
            sync_file(flight_folder)
            shutil.rmtree(former, ignore_errors=True)
    shutil.rmtree(flight_folder / STAGED, ignore_errors=True)


def write_change_files(archive: "Archive", flight_id: str, version: VersionEntry | None) -> None:
    """Write changes.geojson and changes.html of a flight; remove them when `version` is None: it was not compared.

    `version` is the map that the comparison made. The page tells what report.json in the flight's folder says.
    """
    folder = archive.flight_folder(flight_id)
    if version is None:
        for name in ("changes.geojson", "changes.html"):
            (folder / name).unlink(missing_ok=True)
        return
    changes, site = archive.changes(flight_id), archive.site()
    atomic_write_bytes(folder / "changes.geojson", geojson_bytes(changes_geojson(changes, site)))
    crops = {each.id: _crops(folder / "changes", each.id) for each in changes}
    maps = [archive.tiles(version.parent_id) if version.parent_id else {}, archive.tiles(version.id)]
    before, after = None, None
    if any(maps):
        alike = archive.tiles_alike(version.id, version.parent_id)
        before, after = pictures(maps, _PICTURE_PX if changes else _UNCHANGED_PX, alike)
    made = {each.id: each for each in archive.versions()}
    page = changes_page(
        archive.report(flight_id), changes, before, after, site, crops,
        before_words=_words_of(made.get(version.parent_id)), after_words=_words_of(version),
    )
    atomic_write_bytes(folder / "changes.html", page.encode())


def write_object_files(archive: "Archive", flight_id: str, *, is_searched: bool) -> None:
    """Write objects.geojson of a flight; remove it when the flight's frames were not searched for objects."""
    path = archive.flight_folder(flight_id) / OBJECTS
    if not is_searched:
        path.unlink(missing_ok=True)
        return
    found = objects_geojson(archive.objects(flight_id), archive.site(), crops_from_site=False)
    atomic_write_bytes(path, geojson_bytes(found))


def write_site_objects(archive: "Archive") -> None:
    """Write objects.geojson of the site, the newest of each place; remove it when no flight was ever searched."""
    if archive.is_searched:
        found = objects_geojson(archive.newest_objects(), archive.site(), crops_from_site=True)
        atomic_write_bytes(archive.objects_path, geojson_bytes(found))
    else:
        archive.objects_path.unlink(missing_ok=True)


def _words_of(version: VersionEntry | None) -> str:
    if version is None:
        return "no map yet"
    return f"version {version.id}: flight {version.flight_id}, {version.created_utc[:10]}"


def _crops(folder: Path, change_id: str) -> tuple[ImageRGBA | None, ImageRGBA | None]:
    """A change's pictures before and after; None for one that is gone."""
    paths = [folder / name for name in crop_names(change_id)]
    before, after = (rgba_from_png(path.read_bytes(), str(path)) if path.is_file() else None for path in paths)
    return before, after
