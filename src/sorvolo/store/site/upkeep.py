"""Upkeep of a site: missing derived files are written, files that nothing refers to are removed."""

import shutil
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

from sorvolo.store.atomic import atomic_write_bytes, remove_leftovers, writing
from sorvolo.store.site import catalogue as records
from sorvolo.store.site import change_records, object_records
from sorvolo.store.site.catalogue import OwedFiles, VersionEntry
from sorvolo.store.site.derived import (
    map_is_there,
    site_objects_are_there,
    take_staged,
    write_change_files,
    write_map_files,
    write_object_files,
    write_site_objects,
)
from sorvolo.store.site.files import JOURNAL, STAGED, SiteFiles
from sorvolo.store.site.journal import is_journal_after


def repair(files: SiteFiles) -> None:
    """Write the derived files that a killed process had not yet written, and those of the map that were deleted.

    Raises StoreError on a full disk; what the catalogue holds stays true.
    """
    with files.catalogue.reading() as connection:
        owed = records.owed_files(connection)
        shown = records.derived_version(connection)
    newest = _newest(files)
    with ThreadPoolExecutor(1, thread_name_prefix="map files") as other:
        waiting: list[Future[None]] = []
        if newest is not None and not _is_shown(files, newest, shown):
            waiting.append(other.submit(write_map_files, files, newest))
        for each in owed:
            _write_flight_files(files, each)
        if owed or not site_objects_are_there(files):
            write_site_objects(files)
        for written in waiting:
            written.result()
    if newest is None:
        return
    with files.catalogue.changing() as connection:
        records.mark_written(connection, [each.run_id for each in owed], newest.id)


def _is_shown(files: SiteFiles, newest: VersionEntry, shown: int) -> bool:
    """Whether the map's files are those of the newest version, or would be the same."""
    return _looks_like(files, newest, shown) and (not newest.tiles or map_is_there(files))


def _newest(files: SiteFiles) -> VersionEntry | None:
    return next((each for each in reversed(files.versions()) if each.complete), None)


def forget_unfinished(files: SiteFiles) -> None:
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


def remove_unused(files: SiteFiles) -> None:
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
    for flight in over:
        _remove_unused_pictures(flight, {str(run_id) for run_id in runs.get(flight.name, set())})


def forget_journals(files: SiteFiles, kept: Path | None = None) -> None:
    """Delete the journals of runs that were killed, all but `kept`, which continues: the site changes."""
    for flight in files.flight_folders():
        if flight / JOURNAL != kept:
            (flight / JOURNAL).unlink(missing_ok=True)


def stopped_flights(files: SiteFiles) -> list[str]:
    """The flights whose runs were stopped before they were complete."""
    return [each.name for each in files.flight_folders() if (each / JOURNAL).is_file()]


def _remove_unused_pictures(flight: Path, known_runs: set[str]) -> None:
    """Delete the pictures of runs that are not known, then folders of the flight that this emptied."""
    for images in (*(flight / "keyframes").glob("*"), *(flight / STAGED).glob("*")):
        if images.name.isdigit() and images.name not in known_runs:
            shutil.rmtree(images, ignore_errors=True)
    for emptied in (flight / STAGED, *(() if known_runs else (flight / "keyframes", flight))):
        if emptied.is_dir() and not any(emptied.iterdir()):
            emptied.rmdir()


def _looks_like(files: SiteFiles, version: VersionEntry, shown: int) -> bool:
    """Whether the map's files, which show another version, would be the same for this one."""
    if version.id == shown:
        return True
    written_as = {each.id: (each.export_crs, each.compress) for each in files.versions()}.get(shown)
    with files.catalogue.reading() as connection:
        same = records.tile_hashes(connection, version.id) == records.tile_hashes(connection, shown)
    return same and written_as == (version.export_crs, version.compress)


def _write_flight_files(files: SiteFiles, owed: OwedFiles) -> None:
    folder = files.flight_folder(owed.flight_id)
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
    for name, content in owed.documents.items():
        if content:
            atomic_write_bytes(files.document_path(owed.flight_id, name), content)
    for name in owed.leftovers:
        files.document_path(owed.flight_id, name).unlink(missing_ok=True)
    take_staged(folder, owed.run_id)
    with files.catalogue.reading() as connection:
        is_compared = change_records.is_compared(connection, owed.run_id)
        is_searched = object_records.is_searched(connection, owed.run_id)
    version = next(
        (each for each in files.versions() if each.run_id == owed.run_id and is_compared), None
    )
    write_change_files(files, owed.flight_id, version)
    write_object_files(files, owed.flight_id, is_searched=is_searched)
