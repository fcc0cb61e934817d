"""The sites below the root: found by looking, named by ids, opened once and kept open to be read."""

import os
import threading
import time
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from sorvolo.errors import StoreError
from sorvolo.geometry.grid import SiteGrid, TileIndex
from sorvolo.paths import Json, JsonView
from sorvolo.station.problems import Problem, below
from sorvolo.station.settings import STATE_FOLDER, STREAMS_FOLDER
from sorvolo.store.site.archive import Archive
from sorvolo.store.site.catalogue import FlightEntry, VersionEntry
from sorvolo.store.site.catalogue_place import CATALOGUE, catalogue_file, is_site
from sorvolo.store.site.files import HeightFile, is_plain_name

_DEEPEST = 2  # folders below the root: `sorvolo demo` puts its site one deeper than its folder
_MOST_FOLDERS = 2000  # looked at below a root; by choice
_LOOK_EVERY_S = 1.0  # through the folders; by choice
_LOOK_AGAIN_S = 0.1  # for a site that was not there: it may have come since


class SiteShelf:
    """The sites of a root, by id. A site's id is its path below the root, its folders joined by a colon.

    Ids are looked up in what was found; none is ever made into a path. Threads may share it.
    """

    def __init__(self, root: Path) -> None:
        self.root = root
        self._lock = threading.Lock()
        self._found: dict[str, Path] = {}
        self._looked_s = -_LOOK_EVERY_S
        self._open: dict[str, tuple[tuple[int, int], Archive]] = {}

    def folders(self) -> dict[str, Path]:
        """The folder of each site by its id, those that are there now."""
        return self._folders(_LOOK_EVERY_S)

    def _folders(self, at_most_s: float) -> dict[str, Path]:
        """The folders as they were found this many seconds ago at most."""
        with self._lock:
            if time.monotonic() - self._looked_s >= at_most_s:
                self._found = {
                    ":".join(each.path.relative_to(self.root).parts)
                    or self.root.resolve().name
                    or "site": each.path
                    for each in folders_below(self.root, deepest=_DEEPEST, most=_MOST_FOLDERS)
                    if each.is_site
                }
                self._looked_s = time.monotonic()
            return dict(self._found)

    def folder(self, site_id: str) -> Path:
        """The folder of a site. Raises Problem (404)."""
        folder = self.folders().get(site_id) or self._folders(_LOOK_AGAIN_S).get(site_id)
        if folder is None:
            raise Problem(404, f"no site {site_id[:80]!r} here; /api/sites lists those there are")
        return folder

    def new_folder(self, site_id: str) -> Path:
        """The folder of a site, or of one to be made beside the others. Raises Problem for what cannot name one."""
        found = self.folders().get(site_id)
        if found is not None:
            return found
        is_taken = site_id in (STATE_FOLDER, STREAMS_FOLDER) or is_site(self.root)
        if not is_plain_name(site_id) or ":" in site_id or is_taken:
            raise Problem(400, f"{site_id[:80]!r} cannot name a new site; give letters and digits")
        folder = self.root / site_id
        if folder.is_symlink() or (
            folder.exists() and (not folder.is_dir() or any(folder.iterdir()))
        ):
            raise Problem(409, f"{site_id!r} is there already and is no site; choose another name")
        return folder

    def open(self, site_id: str) -> Archive:
        """The site, opened to be read; not to be closed. Raises Problem (404, 410), StoreError as `Archive.open`."""
        folder = self.folder(site_id)
        try:
            about = (catalogue_file(folder) or folder / CATALOGUE).stat()
        except OSError as error:
            self.forget(site_id)
            raise Problem(
                410, f"the site {site_id!r} was deleted meanwhile; /api/sites lists the others"
            ) from error
        key = (about.st_dev, about.st_ino)
        with self._lock:
            known = self._open.get(site_id)
            if known is not None and known[0] == key:
                return known[1]
        archive = Archive.open(folder, write=False)
        with self._lock:
            if known is not None:
                known[1].close()
            self._open[site_id] = (key, archive)
        return archive

    def forget(self, site_id: str) -> None:
        """Look anew: a site came or went."""
        with self._lock:
            self._looked_s = -_LOOK_EVERY_S
            known = self._open.pop(site_id, None)
        if known is not None:
            known[1].close()

    def close(self) -> None:
        """Close every site."""
        with self._lock:
            for _, archive in self._open.values():
                archive.close()
            self._open.clear()


def bounds_lonlat(tiles: Sequence[TileIndex], grid: SiteGrid) -> list[float] | None:
    """West, south, east, north of tiles, deg; None without tiles."""
    if not tiles:
        return None
    # (4, 2) longitudes and latitudes of the corners of the box around tiles
    columns, rows = np.array(tiles).reshape(-1, 2).T
    size = grid.grid.tile_px
    west, east = columns.min() * size - 0.5, (columns.max() + 1) * size - 0.5
    north, south = rows.min() * size - 0.5, (rows.max() + 1) * size - 0.5
    corners_px = np.array([[west, north], [east, north], [east, south], [west, south]])
    site_from_grid = np.linalg.inv(grid.grid_from_site_affine(np.zeros(2), 50.0))
    corners_m = corners_px @ site_from_grid[:2, :2].T + site_from_grid[:2, 2]
    latitude, longitude, _ = grid.frame.wgs84_from_site(corners_m)
    corners = np.column_stack([longitude, latitude])
    return [round(float(each), 8) for each in (*corners.min(axis=0), *corners.max(axis=0))]


def site_summary(site_id: str, archive: Archive) -> Json:
    """A site as the list of sites has it."""
    site, complete, bounds = None, archive.versions(), None
    if archive.has_site:
        site = archive.site()
        bounds = bounds_lonlat(list(archive.live_tiles()), archive.site_grid())
    return {
        "id": site_id,
        "name": site.name if site else archive.folder.name,
        "is_local": bool(site and site.is_local),
        "center_wgs84": bounds and [(bounds[0] + bounds[2]) / 2, (bounds[1] + bounds[3]) / 2],
        "bounds_wgs84": bounds,
        "flights": len({each.flight_id for each in complete}),
        "versions": len(complete),
        "updated_at": complete[-1].created_utc if complete else None,
        "m_per_px": site and site.m_per_px,
    }


def site_detail(site_id: str, archive: Archive) -> Json:
    """A site with its versions and flights, and whether a flight of it has heights."""
    versions, comparisons = archive.versions(), archive.comparisons()
    compared = {each.flight_id for each in versions if each.id in comparisons}
    return {
        **site_summary(site_id, archive),
        "versions": [
            {
                "n": each.id,
                "flight": each.flight_id,
                "made_at": each.created_utc,
                "flown_at": each.flown_utc or None,
            }
            for each in versions
        ],
        "flights": [
            _flight_row(each, archive, versions, compared) for each in archive.complete_flights
        ],
        "has_heights": any(
            archive.height_path(each.flight_id, HeightFile.REPORT).exists() for each in versions
        ),
    }


def _flight_row(
    flight: FlightEntry, archive: Archive, versions: Sequence[VersionEntry], compared: set[str]
) -> Json:
    frames: JsonView = archive.report(flight.id).get("frames") or {}
    flown = next(
        (each.flown_utc for each in reversed(versions) if each.flight_id == flight.id),
        "",
    )
    reasons = frames.get("reasons")
    return {
        "id": flight.id,
        "kind": "compare" if flight.id in compared else "map",
        "flown_at": flown or None,
        "frames": sum(flight.frames.values()),
        "matched": flight.frames.get("vision", 0),
        "by_gps": flight.frames.get("gps-only", 0),
        "rejected": flight.frames.get("rejected", 0),
        "reasons": dict(reasons) if isinstance(reasons, Mapping) else {},
        "notes": list(flight.notes),
    }


def readable(shelf: SiteShelf) -> list[Json]:
    """All sites; one that cannot be read is listed with its error instead of its figures."""
    rows = []
    for site_id in sorted(shelf.folders()):
        try:
            rows.append(site_summary(site_id, shelf.open(site_id)))
        except (StoreError, Problem) as error:
            rows.append({"id": site_id, "name": site_id, "error": below(shelf.root, str(error))})
    return rows


@dataclass(frozen=True)
class Folder:
    """A folder, this many levels below the root."""

    path: Path
    depth: int

    @property
    def is_site(self) -> bool:
        """Whether it is the folder of a site."""
        return is_site(self.path)

    @cached_property
    def entries(self) -> list[os.DirEntry[str]]:
        """What it holds, by name; nothing where it is unreadable, or was taken away meanwhile."""
        try:
            with os.scandir(self.path) as found:
                return sorted(found, key=lambda each: each.name)
        except OSError:
            return []

    def folders(self) -> "list[Folder]":
        """The folders in it that anybody may fill; links are not followed."""
        kept = (STATE_FOLDER, STREAMS_FOLDER) if self.depth == 0 else ()
        return [
            Folder(Path(each.path), self.depth + 1)
            for each in self.entries
            if each.is_dir(follow_symlinks=False)
            and not each.name.startswith(".")
            and each.name not in kept
        ]


def folders_below(root: Path, *, deepest: int, most: int) -> Iterator[Folder]:
    """The root and the folders below it: `most` of them, `deepest` levels down; the inside of sites is left out."""
    waiting = deque([Folder(root, 0)])
    for _ in range(most):
        if not waiting:
            return
        folder = waiting.popleft()
        yield folder
        if folder.depth < deepest and not folder.is_site:
            waiting += folder.folders()
