"""Follows the maps of all sites, whoever paints them: an event for each change that readers can see."""

import sys
import time
from dataclasses import dataclass

from sorvolo.errors import SorvoloError
from sorvolo.station.events import EventLog, NewEvent
from sorvolo.station.problems import Problem
from sorvolo.station.reviews import Reviews
from sorvolo.station.sites import SiteShelf, bounds_lonlat
from sorvolo.station.state import ThreadOwner
from sorvolo.station.tiles import TilePyramid, WebTiles
from sorvolo.store.site.archive import Archive

_LOOK_EVERY_S = 0.1  # it delays what a page shows; by choice
_SETTLE_EVERY_S = 2.0  # between two turns at verdicts that wait; by choice


@dataclass(frozen=True, eq=False)
class _Seen:
    """A site as it was seen last."""

    mark: tuple[int, int]
    state: TilePyramid | None
    about: tuple[int, str]  # versions and name


class MapWatch(ThreadOwner):
    """What the maps looked like last. Only `look` changes it; a thread calls it."""

    def __init__(
        self, shelf: SiteShelf, tiles: WebTiles, reviews: Reviews, events: EventLog
    ) -> None:
        self._shelf, self._tiles, self._reviews, self._events = shelf, tiles, reviews, events
        # also those that could not be opened: their end is announced as well
        self._listed: set[str] = set()
        self._seen: dict[str, _Seen] = {}
        self._covered: dict[
            str, int
        ] = {}  # when the coverage of the flight in the air was written, by site
        self._settled_s = 0.0
        super().__init__("maps", self._watch)

    def start(self) -> None:
        """Follow the maps from now on; the sites of this moment are known when this returns."""
        # one deleted before the first look has to be announced as well
        self._listed |= self._shelf.folders().keys()
        self.begin()

    def look(self) -> None:
        """Compare every map with how it was, and announce what changed."""
        folders = self._shelf.folders()
        for site_id in self._listed - folders.keys():
            self._events.append(NewEvent("site.gone", {}, site_id))
            self._listed.discard(site_id)
            self._seen.pop(site_id, None)
        self._listed |= folders.keys()
        for site_id in folders:
            try:
                self._look_at(site_id)
            except (Problem, SorvoloError):  # gone meanwhile, or damaged: opening it reports why
                self._seen.pop(site_id, None)
        if time.monotonic() - self._settled_s > _SETTLE_EVERY_S:
            self._settled_s = time.monotonic()
            self._reviews.settle_waiting()

    def _look_at(self, site_id: str) -> None:
        archive = self._shelf.open(site_id)
        # announce that the coverage of the flight in the air is another one; when it ends,
        # the site has changed
        try:
            written_ns = archive.live_coverage_path.stat().st_mtime_ns
        except OSError:
            written_ns = 0
        if written_ns and written_ns != self._covered.get(site_id):
            self._events.append(NewEvent("coverage.changed", {}, site_id))
        self._covered[site_id] = written_ns
        mark, before = archive.change_mark(), self._seen.get(site_id)
        if before is not None and before.mark == mark:
            return
        state = self._tiles.live(site_id) if archive.has_site else None
        versions = len(archive.versions())
        about = versions, archive.site().name if archive.has_site else ""
        self._seen[site_id] = _Seen(mark, state, about)
        if before is None:
            self._reviews.settle(site_id)  # those that waited when the station was ended
            if self._is_news(site_id, state):
                self._announce(site_id, archive, state, None)
            return
        # a map, and another one than before
        if state is not None and (before.state is None or before.state.revision != state.revision):
            self._announce(site_id, archive, state, before.state)
        if about != before.about:
            self._events.append(NewEvent("site.changed", {"versions": versions}, site_id))
            self._reviews.settle(site_id)

    def _is_news(self, site_id: str, state: TilePyramid | None) -> bool:
        """Whether a map that is seen for the first time grew since it was announced last."""
        if state is None:
            return False
        announced = self._events.newest("map.tiles", site_id)
        return announced is None or announced["data"]["revision"] != state.revision

    def _announce(
        self, site_id: str, archive: Archive, state: TilePyramid | None, before: TilePyramid | None
    ) -> None:
        """The tiles that changed; all of them where nobody knows what was before."""
        if state is None or not state.keys[0]:
            return
        changed = list(state.keys[0]) if before is None else state.changed_since(before)
        bounds = bounds_lonlat(changed, archive.site_grid())
        data = {"revision": state.revision, "bounds": bounds, "tiles": len(changed)}
        self._events.append(NewEvent("map.tiles", data, site_id))

    def _watch(self) -> None:
        while not self._ending.wait(_LOOK_EVERY_S):
            try:
                self.look()
            except Exception as error:  # a full disk: logged, tried again
                sys.stderr.write(f"station: maps cannot be followed: {error}\n")
                self._ending.wait(2.0)
