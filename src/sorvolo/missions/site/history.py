"""The map of a site as it was: its versions listed, one found by number or date, one written as a file."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, time, timedelta
from pathlib import Path

from sorvolo.errors import InputError, SettingsError, StoreError
from sorvolo.findings.importance import between, in_short, in_words
from sorvolo.findings.register import untold
from sorvolo.missions.heights.measure import coloured_heights
from sorvolo.store.exports.map_pictures import write_kmz, write_preview
from sorvolo.store.exports.plain import moment_of
from sorvolo.store.rasters.geotiff import write_cog, write_mbtiles_or_pdf
from sorvolo.store.rasters.height_model import write_laz
from sorvolo.store.site.archive import Archive
from sorvolo.store.site.catalogue import VersionEntry
from sorvolo.survey.findings import Verdict

_STEPS = {
    2: timedelta(hours=1),
    4: timedelta(minutes=1),
    6: timedelta(seconds=1),
}  # by digits of a time of day
_FOR_TABLETS = (".mbtiles", ".pdf")
_HEIGHTS = ".laz"
_ON_EARTH = (".kmz", *_FOR_TABLETS, _HEIGHTS)  # a map without a place cannot be these
_ENDINGS = (".tif", ".tiff", ".png", *_ON_EARTH)


@dataclass(frozen=True)
class HistoryEntry:
    """One version of the map. `changes` counts by kind, `{}` for a version that mapping made.

    `date_utc` is when the version was complete, `flown_utc` when its flight's first frame was taken ("": not known).
    `over` is the version it was painted over (0: none), `tiles_changed` and `bytes_changed` what it has that that one
    has not. `confirmed` and `rejected` count the verdicts on the changes its flight has now; 0 for a version whose
    flight was mapped or compared again since (`is_replaced`).
    """

    version: int
    date_utc: str
    flown_utc: str
    flight: str
    kind: str  # map | compare
    over: int
    tiles: int
    tiles_changed: int
    tiles_removed: int
    bytes_changed: int
    changes: Mapping[str, int]
    confirmed: int
    rejected: int
    is_replaced: bool


def site_history(site: Path) -> list[HistoryEntry]:
    """Every complete version of the map, oldest first. Raises StoreError when the folder is no site."""
    with Archive.open(site, write=False) as archive:
        versions = archive.versions()
        last_of = {version.flight_id: version.id for version in versions}
        comparisons = archive.comparisons()
        verdicts = [(each.flight_id, each.verdict) for each in archive.changes()]
        return [
            _entry(
                archive,
                each,
                comparisons.get(each.id),
                verdicts if last_of[each.flight_id] == each.id else None,
            )
            for each in versions
        ]


def came_and_left(site: Path) -> str:
    """What came and left between the newest two flights of the site, in a sentence: the comparison's, where the later
    one was compared, with what the detector's searches alone show. "" for one flight."""
    with Archive.open(site, write=False) as archive:
        made = {each.flight_id: each.id for each in archive.versions()}
        if len(made) < 2:
            return ""
        *_, before, after = made
        register = archive.register()
        if made[after] in archive.comparisons():
            changes = archive.changes(after)
            kept = [each for each in changes if each.verdict is not Verdict.REJECTED]
            words = in_short(kept, is_local=archive.site().is_local)
            if others := in_words(untold(register, changes, made.keys() - {after}, after)):
                words += f"; by the search alone: {others}"
        else:
            words = between(register, before, after)
        return f"from {before} to {after}: {words}"


def _entry(
    archive: Archive,
    version: VersionEntry,
    changes: Mapping[str, int] | None,
    verdicts: Sequence[tuple[str, Verdict | None]] | None,
) -> HistoryEntry:
    """A version; `changes` is None for one that mapping made, `verdicts` for one that was replaced since."""
    difference = archive.tile_difference(version)
    given = verdicts or ()
    return HistoryEntry(
        version.id,
        version.created_utc,
        version.flown_utc,
        version.flight_id,
        "map" if changes is None else "compare",
        version.parent_id,
        version.tiles,
        difference.changed,
        difference.removed,
        difference.changed_bytes,
        {kind: count for kind, count in (changes or {}).items() if count},
        given.count((version.flight_id, Verdict.CONFIRMED)),
        given.count((version.flight_id, Verdict.REJECTED)),
        verdicts is None,
    )


def find_version(archive: Archive, at: str) -> VersionEntry:
    """The version of a number; or the newest one flown by the end of an ISO date, or of the minute or second that
    an ISO date-time names; UTC. A flight whose clock has no date counts from when its map was made.

    Raises InputError when there is none, SettingsError when `at` is neither.
    """
    if at.isdecimal() and len(at) < 8:  # eight digits are an ISO date without dashes
        found = [version for version in archive.versions() if version.id == int(at)]
        if not found:
            numbers = [str(version.id) for version in archive.versions()]
            raise InputError(
                f"{archive.folder} has no version {at} of its map; it has {', '.join(numbers) or 'none'}"
            )
        return found[0]
    return archive.version_at(_moment(at))


def export_version(site: Path, at: str | None, path: Path) -> VersionEntry:
    """Write the map as it was at a version or date (see `find_version`; None: now) to a .tif, .png, .kmz, .mbtiles or .pdf
    file, or the heights of its flight in the map's colours to a .laz file.

    Returns the version. Raises SettingsError for another ending, InputError when there was no map, its flight has no
    heights or the file's folder does not exist, StoreError on a full disk.
    """
    if path.suffix.lower() not in _ENDINGS:
        raise SettingsError(
            f"{path.name}: the map is written as .tif, .png, .kmz, .mbtiles or .pdf, its heights as .laz; give a name with such an ending"
        )
    if not path.resolve().parent.is_dir():
        raise InputError(
            f"no folder {path.resolve().parent} to write {path.name} to; make it first"
        )
    if path.is_dir():
        raise InputError(f"{path} is a folder, a file was needed; choose another name")
    with Archive.open(site, write=False) as archive:
        complete = archive.versions()
        if not complete:
            raise InputError(f"{site} has no map yet; map a flight into it first")
        version = complete[-1] if at is None else find_version(archive, at)
        _write_map(archive, version, path)
    return version


def _write_map(archive: Archive, version: VersionEntry, path: Path) -> None:
    tiles, site = archive.tiles(version.id), archive.site()
    if not tiles:
        raise StoreError(
            f"version {version.id} of the map of {archive.folder} is empty; there is nothing to write"
        )
    ending = path.suffix.lower()
    if ending in _ON_EARTH and site.is_local:
        raise SettingsError(
            f"{archive.folder} has no place on Earth, so its map cannot be a {ending}; write .tif or .png"
        )
    if ending == ".png":
        write_preview(tiles, path)
    elif ending == ".kmz":
        write_kmz(tiles, archive.site_grid(), site.name, path)
    elif ending in _FOR_TABLETS:
        write_mbtiles_or_pdf(tiles, archive.site_grid(), site.name, path)
    elif ending == _HEIGHTS:
        cloud = coloured_heights(archive, version)
        write_laz(cloud, archive.site_grid().grid, site.height_reference, path)
    else:
        write_cog(tiles, archive.site_grid(), path, crs=version.export_crs or None)


def _moment(text: str) -> datetime:
    """The end of an ISO date, or of the hour, minute or second that an ISO date-time names, UTC unless it names a zone.

    A list shows times without their seconds: what it lists as complete at a minute was so at the minute's end.
    """
    moment = moment_of(text, time.max, "a version's number or a date")
    time_of_day = re.search(r"[Tt ]([\d:.,]+)", text)
    step = _STEPS.get(sum(letter.isdecimal() for letter in time_of_day[1])) if time_of_day else None
    return moment if step is None else moment + step - timedelta(microseconds=1)
