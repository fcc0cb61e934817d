"""Which flights saw a place, by the archive index of the root, which is brought up to date where a site changed."""

import threading
from collections.abc import Sequence

from sorvolo.errors import StoreError
from sorvolo.missions.archive.index import update_site
from sorvolo.station.problems import Problem
from sorvolo.station.sites import SiteShelf
from sorvolo.store.index.archive_index import INDEX, ArchiveIndex, has_index
from sorvolo.store.index.finding import FoundFlight, Place
from sorvolo.store.site.archive import Archive


class PlaceIndex:
    """Asks the index in the root's folder; makes it where there is none. Threads may share it.

    A site is looked at when its catalogue has changed since, and only its new flights are read. Where the index cannot
    be used (it is of another version, in a database out of reach, on a disk that is full), nothing is found by it.
    """

    def __init__(self, shelf: SiteShelf) -> None:
        self._shelf = shelf
        self._lock = threading.Lock()
        self._marks: dict[str, tuple[int, int]] = {}  # of sites that the index has as they are
        self._open: tuple[int, ArchiveIndex] | None = None  # with the number of its file

    def of_site(self, site_id: str, place: Place) -> list[FoundFlight] | None:
        """The flights of a site that saw a place or found something there, in order of time.

        None where the index does not know: of a site without a place on Earth, or when it cannot be used.
        """
        archive = self._shelf.open(site_id)
        if not archive.has_site or archive.site().is_local:
            return None
        path = self._path(site_id)
        try:
            found = self._asked({site_id: archive}, place)
        except StoreError:
            return None
        return [each for each in found if each.site == path]

    def of_all(self, place: Place) -> list[tuple[str, FoundFlight]]:
        """The same of all sites, with the id of each flight's site. Raises StoreError where no index can be used."""
        archives = {}
        for site_id in self._shelf.folders():
            try:
                archives[site_id] = self._shelf.open(site_id)
            except (Problem, StoreError):  # gone meanwhile, or damaged: opening it reports why
                continue
        ids = {self._path(site_id): site_id for site_id in archives}
        return [(ids[each.site], each) for each in self._asked(archives, place) if each.site in ids]

    def _asked(self, archives: dict[str, Archive], place: Place) -> Sequence[FoundFlight]:
        with self._lock:
            if not has_index(self._shelf.root):
                self._marks.clear()
            marks = {site_id: archive.change_mark() for site_id, archive in archives.items()}
            old = [site_id for site_id, mark in marks.items() if self._marks.get(site_id) != mark]
            if old:
                self._update({site_id: archives[site_id] for site_id in old})
                self._marks |= {site_id: marks[site_id] for site_id in old}
            return self._opened().find(place)

    def _opened(self) -> ArchiveIndex:
        """The index to read from, kept open; another one where it was made anew."""
        root = self._shelf.root
        file = root / INDEX
        about = file.stat().st_ino if file.is_file() else 0
        if self._open is None or self._open[0] != about:
            self.close()
            self._open = about, ArchiveIndex.open(root, write=False)
        return self._open[1]

    def close(self) -> None:
        """Let go of the index."""
        if self._open is not None:
            self._open[1].close()
            self._open = None

    def _update(self, archives: dict[str, Archive]) -> None:
        with ArchiveIndex.open(self._shelf.root, write=True) as index:
            known = index.sites()
            for site_id, archive in archives.items():
                path = self._path(site_id)
                update_site(index, path, known.get(path), archive)

    def _path(self, site_id: str) -> str:
        return self._shelf.folder(site_id).relative_to(self._shelf.root).as_posix()
