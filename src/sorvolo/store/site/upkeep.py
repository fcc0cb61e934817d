"""Derived files of a site, made from its catalogue: written where they are owed, removed where nothing names them."""

import os
import shutil
import warnings
from collections.abc import Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sorvolo.errors import SorvoloWarning
from sorvolo.geometry.arrays import ImageRGBA
from sorvolo.geometry.grid import TileIndex
from sorvolo.store.atomic import (
    atomic_write_bytes,
    make_folder,
    remove_leftovers,
    sync_file,
    temporary_beside,
    write_page,
    writing,
)
from sorvolo.store.exports.change_files import (
    CROPS,
    OBJECTS,
    change_placemarks,
    changes_geojson,
    crop_names,
    object_placemarks,
    objects_geojson,
)
from sorvolo.store.exports.ground_files import COVERAGE
from sorvolo.store.exports.map_pictures import Picture, pictures, small_map_of, write_small_maps
from sorvolo.store.exports.places import Placemark, gpx_bytes, kml_bytes
from sorvolo.store.exports.plain import features_name, features_path, geojson_bytes
from sorvolo.store.images import rgba_from_png
from sorvolo.store.pages.changes import changes_page
from sorvolo.store.rasters.geotiff import write_cog
from sorvolo.store.site import catalogue as records
from sorvolo.store.site import change_records
from sorvolo.store.site.catalogue import OwedFiles, VersionEntry
from sorvolo.store.site.change_records import StoredObject
from sorvolo.store.site.files import JOURNAL, STAGED, DamagedError, HeightFile, checked_document
from sorvolo.store.site.journal import is_journal_after

if TYPE_CHECKING:
    from sorvolo.store.site.archive import Archive

MAP_FILES = ("mosaic.tif", "preview.png", "mosaic.kmz")
STAGED_FOLDERS = ("changes", "masks", CROPS)
HEIGHTS = "heights"
"""The staged folder whose files go to the flight's own folder."""
# of the map in changes.html; daily flights without change should cost little
_PICTURE_PX, _UNCHANGED_PX = 1600, 800
LIST_ENDINGS = (".geojson", ".json", ".kml", ".gpx")  # of lists of places


def repair(files: "Archive") -> None:
    """Write the derived files that a killed process had not yet written, and those of the map that were deleted.

    Raises StoreError on a full disk; what the catalogue holds stays true.
    """
    with files.catalogue.reading() as connection:
        owed = records.owed_files(connection)
        shown = records.derived_version(connection)
    newest = next(reversed(files.versions()), None)
    with ThreadPoolExecutor(1, thread_name_prefix="map files") as other:
        waiting: list[Future[None]] = []
        if newest is not None and not _is_shown(files, newest, shown):
            waiting.append(other.submit(_write_map_files, files, newest))
        for each in owed:
            _write_flight_files(files, each)
        is_searched = files.catalogue_rows(change_records.has_searches)
        if owed or is_searched != features_path(files.folder, OBJECTS).is_file():
            # the newest of each place; none where no flight was ever searched
            newest_of_each = files.newest_objects() if is_searched else None
            with files.replacing(*(f"{OBJECTS}{ending}" for ending in LIST_ENDINGS)):
                _write_objects(files, files.folder, newest_of_each)
        for written in waiting:
            written.result()
    if newest is None:
        return
    with files.catalogue.changing() as connection:
        records.mark_written(connection, [each.run_id for each in owed], newest.id)


def _is_shown(files: "Archive", newest: VersionEntry, shown: int) -> bool:
    """Whether the map's files are there and are those of the newest version, or would be the same."""
    if newest.id != shown:
        crs_of = {each.id: each.export_crs for each in files.versions()}
        with files.catalogue.reading() as connection:
            now, then = (records.tile_hashes(connection, each) for each in (newest.id, shown))
        if now != then or crs_of.get(shown) != newest.export_crs:
            return False
    names = MAP_FILES[: 2 if files.site().is_local else None]
    return not newest.tiles or all(
        (files.folder / name).is_file() and files.is_sound(name) for name in names
    )


def forget_unfinished(files: "Archive") -> None:
    """Drop runs that never committed, then every file that nothing refers to.

    The journal of a run that was killed stays, and its pictures, as long as the map is the one that it began over.
    """
    with files.catalogue.changing() as connection:
        records.drop_unfinished(connection)
        newest = records.newest_version(connection)
    for flight in files.flight_folders():
        journal = flight / JOURNAL
        if journal.is_file() and not is_journal_after(journal, newest):
            journal.unlink()
    remove_unused(files)


def remove_unused(files: "Archive") -> None:
    """Delete tiles and pictures that nothing in the catalogue refers to, and what killed processes left."""
    with files.catalogue.reading() as connection:
        runs, used = records.run_ids(connection), records.used_hashes(connection)
    flights = files.flight_folders()
    over = [
        each for each in flights if not (each / JOURNAL).exists()
    ]  # else a run that was killed goes on
    remove_leftovers(
        [files.folder, *flights, *(images for each in over for images in each.glob("keyframes/*"))]
    )
    files.blobs.remove_leftovers()
    files.blobs.remove(files.blobs.stored() - used)
    for path in (files.live_preview_path, files.live_coverage_path):
        path.unlink(missing_ok=True)
    for flight in (
        over
    ):  # pictures of runs that are not known go, then folders of the flight that this empties
        known = {str(run_id) for run_id in runs.get(flight.name, set())}
        for images in (*(flight / "keyframes").glob("*"), *(flight / STAGED).glob("*")):
            if images.name.isdigit() and images.name not in known:
                shutil.rmtree(images, ignore_errors=True)
        for emptied in (flight / STAGED, *(() if known else (flight / "keyframes", flight))):
            if emptied.is_dir() and not any(emptied.iterdir()):
                emptied.rmdir()


def forget_journals(files: "Archive", kept: Path | None = None) -> None:
    """Delete the journals of runs that were killed, all but `kept`, which continues: the site changes."""
    for flight in files.flight_folders():
        if flight / JOURNAL != kept:
            (flight / JOURNAL).unlink(missing_ok=True)


def stopped_flights(files: "Archive") -> list[str]:
    """The flights whose runs were stopped before they were complete."""
    return [each.name for each in files.flight_folders() if (each / JOURNAL).is_file()]


def _write_flight_files(files: "Archive", owed: OwedFiles) -> None:
    folder = files.flight_folder(owed.flight_id)
    make_folder(folder)
    contents = {name: content for name, content in owed.documents.items() if content}
    for name in (*contents, *owed.leftovers):
        checked_document(name)  # refuses one that could lie elsewhere
    compared = files.comparisons()
    is_searched = files.catalogue_rows(change_records.has_searches, owed.flight_id)
    staged = folder / STAGED / str(owed.run_id)
    lists = (f"{name}{ending}" for name in ("changes", OBJECTS) for ending in LIST_ENDINGS)
    pictures = (name for name in STAGED_FOLDERS if (staged / name).is_dir())
    heights = HeightFile if (staged / HEIGHTS).is_dir() else ()
    names = (*contents, *owed.leftovers, *lists, "changes.html", *pictures, *heights)
    with files.replacing(*(f"flights/{owed.flight_id}/{name}" for name in names)):
        for name, content in contents.items():
            atomic_write_bytes(folder / name, content)
        for name in (*owed.leftovers, "report.pdf"):
            (folder / name).unlink(missing_ok=True)
        take_staged(folder, owed.run_id)
        version = next(
            (
                each
                for each in files.versions()
                if each.run_id == owed.run_id and each.id in compared
            ),
            None,
        )
        write_change_files(files, owed.flight_id, version)
        _write_objects(files, folder, files.objects(owed.flight_id) if is_searched else None)


def _write_map_files(files: "Archive", version: VersionEntry) -> None:
    """Write the map's files of a version; remove them when it has no tiles."""
    mosaic, preview, kmz = (files.folder / name for name in MAP_FILES)
    tiles, site = files.version_tiles(version.id), files.site()
    with files.replacing(*MAP_FILES):
        if not tiles:
            for path in (mosaic, preview, kmz):
                path.unlink(missing_ok=True)
            return
        small = small_map_of(tiles, files.site_grid().grid.tile_px)
        waiting: list[Future[None]] = []
        with ThreadPoolExecutor(1, thread_name_prefix="previews") as other:

            def pass_by(index: TileIndex, tile: ImageRGBA) -> None:
                small.take(index, tile)
                if small.taken == len(tiles):  # while GDAL makes its file
                    shown = (site.name, preview, None if site.is_local else kmz)
                    waiting.append(other.submit(write_small_maps, small, files.site_grid(), *shown))

            write_cog(
                tiles,
                files.site_grid(),
                mosaic,
                crs=version.export_crs or None,
                pass_by=pass_by,
            )
        for each in waiting:
            each.result()


def take_staged(flight_folder: Path, run_id: int) -> None:
    """Put the pictures that a committed run collected in the place of those of the run before it.

    May be stopped at any moment and called again.
    """
    staged = flight_folder / STAGED / str(run_id)
    for name in STAGED_FOLDERS:
        if not (staged / name).is_dir():
            continue
        with writing(flight_folder / name):
            former = temporary_beside(flight_folder / name)
            if (flight_folder / name).exists():
                os.replace(flight_folder / name, former)
            if any((staged / name).iterdir()):
                os.replace(staged / name, flight_folder / name)
            else:
                (staged / name).rmdir()
            sync_file(flight_folder)
            shutil.rmtree(former, ignore_errors=True)
    for path in (staged / HEIGHTS).glob("*"):
        with writing(flight_folder):
            (flight_folder / HeightFile.ORTHOPHOTO).unlink(missing_ok=True)  # of another run
            os.replace(path, flight_folder / path.name)
    shutil.rmtree(flight_folder / STAGED, ignore_errors=True)


def write_change_files(files: "Archive", flight_id: str, version: VersionEntry | None) -> None:
    """Write changes.geojson and changes.html of a flight; remove them when `version` is None: it was not compared.

    `version` is the map that the comparison made. The page shows what report.json in the flight's folder holds.
    """
    folder = files.flight_folder(flight_id)
    if version is None:
        _remove_list(folder, "changes")
        for ending in (".html", ".pdf"):
            (folder / f"changes{ending}").unlink(missing_ok=True)
        return
    changes = files.catalogue_rows(change_records.load_changes, flight_id)
    site = files.site()
    _write_list(
        folder,
        "changes",
        changes_geojson(changes, site),
        change_placemarks(changes, site),
        is_local=site.is_local,
    )
    crops = {}
    for change in changes:
        names = (f"flights/{flight_id}/changes/{name}" for name in crop_names(change.id))
        earlier, later = (_crop(files, name) for name in names)
        crops[change.id] = earlier, later
    before, after = _before_and_after(files, version, _PICTURE_PX if changes else _UNCHANGED_PX)
    made = {each.id: each for each in files.versions()}
    page = changes_page(
        files.report(flight_id),
        changes,
        before,
        after,
        site,
        crops,
        coverage=files.features(f"flights/{flight_id}", COVERAGE),
        before_words=_words_of(made.get(version.parent_id)),
        after_words=_words_of(version),
    )
    write_page(folder / "changes.html", page)


def _write_objects(files: "Archive", folder: Path, found: Sequence[StoredObject] | None) -> None:
    """Write objects.geojson of a flight's folder or the site's; remove it where nothing was searched for."""
    if found is None:
        _remove_list(folder, OBJECTS)
        return
    site = files.site()
    collection = objects_geojson(found, site, crops_from_site=folder == files.folder)
    placemarks = object_placemarks(found, site)
    _write_list(folder, OBJECTS, collection, placemarks, is_local=site.is_local)


def _write_list(
    folder: Path,
    name: str,
    collection: Mapping[str, Any],
    placemarks: Sequence[Placemark],
    *,
    is_local: bool,
) -> None:
    """Write a list of places as GeoJSON, KML and GPX; of a local site as plain JSON alone: it has no place on Earth."""
    _remove_list(folder, name, but=features_name(name, is_local=is_local))
    atomic_write_bytes(folder / features_name(name, is_local=is_local), geojson_bytes(collection))
    if not is_local:
        atomic_write_bytes(folder / f"{name}.kml", kml_bytes(name, placemarks))
        atomic_write_bytes(folder / f"{name}.gpx", gpx_bytes(name, placemarks))


def _remove_list(folder: Path, name: str, but: str = "") -> None:
    for ending in LIST_ENDINGS[: 2 if but else None]:
        if (file := f"{name}{ending}") != but:
            (folder / file).unlink(missing_ok=True)


def _before_and_after(
    files: "Archive", version: VersionEntry, most_px: int
) -> tuple[Picture | None, Picture | None]:
    """The map before the version and with it, on the same ground; None where neither has a tile."""
    maps = [files.version_tiles(version.parent_id), files.version_tiles(version.id)]
    if not any(maps):
        return None, None
    with files.catalogue.reading() as connection:
        alike = records.tiles_alike(connection, version.id, version.parent_id)
    before, after = pictures(maps, most_px, alike)
    return before, after


def _words_of(version: VersionEntry | None) -> tuple[str, str]:
    """A version by its flight, and when that was flown; where nothing of it is dated, when the version was made."""
    if version is None:
        return "no map yet", ""
    date = (
        f"flown {version.flown_utc[:10]}"
        if version.flown_utc
        else f"mapped {version.created_utc[:10]}"
    )
    return f"version {version.id}: flight {version.flight_id},", date


def _crop(files: "Archive", name: str) -> ImageRGBA | None:
    """One picture of a change; None for one that is gone or damaged."""
    try:
        return rgba_from_png(files.read_file(name), str(files.folder / name))
    except FileNotFoundError:
        return None
    except DamagedError as error:
        warnings.warn(f"{error}; it is left out", SorvoloWarning, stacklevel=2)
        return None
