"""The memory of a place: every flight and second that saw it, in order, with pictures and what was found there."""

import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any
from urllib.parse import quote

import numpy as np
from fastapi import APIRouter, Query
from shapely import Point

from sorvolo.errors import StoreError
from sorvolo.geometry.arrays import PointsM
from sorvolo.geometry.units import M_PER_DEG_LATITUDE
from sorvolo.missions.archive.index import update_site
from sorvolo.paths import Json, JsonView
from sorvolo.station.collections import Collection, SiteCollections
from sorvolo.station.crops import FlightVideos
from sorvolo.station.found import Feature
from sorvolo.station.problems import Problem
from sorvolo.station.reviews import Review, Reviews
from sorvolo.station.security import FOR_VIEWERS
from sorvolo.station.sites import SiteShelf
from sorvolo.store.exports.plain import utc_text
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
                with ArchiveIndex.open(self._shelf.root, write=True) as index:
                    known = index.sites()
                    for site_id in old:
                        path = self._path(site_id)
                        update_site(index, path, known.get(path), archives[site_id])
                self._marks |= {site_id: marks[site_id] for site_id in old}
            # the index to read from, kept open; another one where it was made anew
            root = self._shelf.root
            file = root / INDEX
            about = file.stat().st_ino if file.is_file() else 0
            if self._open is None or self._open[0] != about:
                self.close()
                self._open = about, ArchiveIndex.open(root, write=False)
            return self._open[1].find(place)

    def close(self) -> None:
        """Let go of the index."""
        if self._open is not None:
            self._open[1].close()
            self._open = None

    def _path(self, site_id: str) -> str:
        return self._shelf.folder(site_id).relative_to(self._shelf.root).as_posix()


_NEAR_M = 1.5  # from the tapped place to what was found there
_DAY_S = 86_400.0


def place_routes(
    shelf: SiteShelf,
    collections: SiteCollections,
    reviews: Reviews,
    videos: FlightVideos,
    index: PlaceIndex,
) -> APIRouter:
    """What is remembered of a place."""
    router = APIRouter(prefix="/api", tags=["memory"], dependencies=FOR_VIEWERS)

    @router.get("/place")
    def place_of_all(
        lon: float = Query(ge=-360, le=360),
        lat: float = Query(ge=-90, le=90),
        within_m: float = Query(_NEAR_M, gt=0, le=10_000),
    ) -> list[Json]:
        """Every flight of every site that saw the place or found something within reach of it, in order of time.

        Sites without GPS have no place on Earth, and are left out. 503 where the index of the sites cannot be used.
        """
        try:
            found = index.of_all(Place(lat, lon, within_m))
        except StoreError as error:
            raise Problem(503, str(error)) from error
        return [_flight_row(site_id, each, reviews) for site_id, each in found]

    @router.get("/sites/{site}/place")
    def place(
        site: str,
        lon: float = Query(ge=-360, le=360),
        lat: float = Query(ge=-90, le=90),
        most_per_flight: int = Query(12, ge=1, le=200),
    ) -> list[Json]:
        """Every frame that shows the place, in order of time, at most this many a flight: those that see it best.

        `crop_url` is a picture of the ground around it, north up; null where nothing was kept to cut it from.
        """
        archive = shelf.open(site)
        known = index.of_site(site, Place(lat, lon, _NEAR_M))
        if known is None:
            views = _views(collections.get(site, "frames"), lon, lat)
            kept = {
                (each.flight_id, each.index)
                for view in views
                for each in archive.keyframes(view.flight)
            }
            found = _near(site, Point(lon, lat), collections, reviews)
        else:
            seeing = [each.flight for each in known if each.frames]
            those = dict(zip(seeing, collections.frames_of(site, seeing), strict=True))
            views = [view for each in those.values() for view in _views(each.frames, lon, lat)]
            kept = {(flight, number) for flight, each in those.items() for number in each.kept}
            found = {each.flight: _things(site, each, reviews) for each in known}
        place_m = (
            archive.site().frame.ground_from_lonlat([(lon, lat)])[0]
            if archive.has_site
            else np.zeros(2)
        )
        chosen = [
            each
            for flight in views
            for each in _best(flight, Point(lon, lat), kept)[:most_per_flight]
        ]
        there = videos.of(archive, [each.flight for each in views])
        began = {each: archive.report(each).get("flown") for each in there}
        base = f"/api/sites/{quote(site, safe=':')}"
        rows = [_row(base, each, place_m, kept, began, found) for each in chosen]
        return sorted(rows, key=lambda each: (str(each["time"]), each["frame_id"]))

    return router


def _flight_row(site_id: str, found: FoundFlight, reviews: Reviews) -> Json:
    """A flight that saw the place, of any site."""
    things = _things(site_id, found, reviews)
    return {
        "site": site_id,
        "site_name": found.site_name,
        "flight": found.flight,
        "frames": found.frames,
        "first_time": utc_text(found.first_ns),
        "last_time": utc_text(found.last_ns),
        "best_frame": found.best_frame or None,
        "place_url": f"/api/sites/{quote(site_id, safe=':')}/place",
        **_found_here(things),
    }


def _things(site_id: str, found: FoundFlight, reviews: Reviews) -> list[Json]:
    """What a flight found at the place, by the index, with the verdicts on it."""
    verdicts = {
        kind: reviews.current(site_id, kind) for kind in {each.type for each in found.things}
    }
    return [
        {
            "type": each.type,
            "id": each.id,
            "class": each.label,
            "kind": each.kind or None,
            "score": each.score,
            "first_seen": utc_text(each.first_ns),
            "last_seen": utc_text(each.last_ns),
            "review": _review(verdicts[each.type].get(each.id)),
        }
        for each in found.things
    ]


def _near(
    site_id: str, place: Point, collections: SiteCollections, reviews: Reviews
) -> Mapping[str, list[Json]]:
    """What was found within reach of a place: changes and objects by flight, with the verdicts on them."""
    reach_deg = _NEAR_M / M_PER_DEG_LATITUDE / max(0.01, float(np.cos(np.radians(place.y))))
    ring = place.buffer(reach_deg)
    result: dict[str, list[Json]] = {}
    for name, kind in (("changes", "change"), ("objects", "object")):
        collection, verdicts = collections.get(site_id, name), reviews.current(site_id, kind)
        for number in sorted(collection.tree.query(ring, predicate="intersects")):
            each = collection.features[int(number)]
            values = each["properties"]
            result.setdefault(values["flight"], []).append(
                {
                    "type": kind,
                    "id": each["id"],
                    "class": values["class"],
                    "kind": values.get("kind"),
                    "score": values.get("score"),
                    "first_seen": values["datetime"],
                    "last_seen": values["end_datetime"],
                    "review": _review(verdicts.get(str(each["id"]))),
                }
            )
    return result


def _review(review: Review | None) -> Json | None:
    if review is None:
        return None
    return {
        "verdict": review.verdict,
        "note": review.note,
        "state": review.state,
        "who": review.who,
        "at": review.at,
    }


@dataclass(frozen=True, eq=False)
class _Views:
    """The frames of a flight that see a place, by number."""

    flight: str
    frames: Collection
    seen: Sequence[int]


def _views(frames: Collection, longitude: float, latitude: float) -> list[_Views]:
    """The frames that see a place, by flight."""
    seen: dict[str, list[int]] = {}
    for each in frames.within([longitude, latitude, longitude, latitude]):
        seen.setdefault(str(frames.features[each]["properties"]["flight"]), []).append(each)
    return [_Views(flight, frames, numbers) for flight, numbers in seen.items()]


def _best(views: _Views, place: Point, kept: set[tuple[str, int]]) -> list[Feature]:
    """The frames of a flight that see a place, best first: those whose picture was kept, and farthest from its edge."""
    frames = views.frames

    def rank(number: int) -> tuple[bool, float]:
        is_kept = (views.flight, frames.features[number]["properties"].get("frame")) in kept
        return not is_kept, -float(frames.shapes[number].boundary.distance(place))

    return [frames.features[each] for each in sorted(views.seen, key=rank)]


def _row(
    base: str,
    frame: Feature,
    place_m: PointsM,
    kept: set[tuple[str, int]],
    began: JsonView,
    found: Mapping[str, list[Json]],
) -> Json:
    """A frame that shows the place; `base` is the site's address, `began` when those flights did whose video is there."""
    values = frame["properties"]
    flight, name = values["flight"], values.get("frame")
    seconds = _seconds(values.get("time"), began[flight]) if flight in began else None
    here, named = found.get(flight, []), quote(flight, safe="")
    source = (
        "frame"
        if (flight, name) in kept
        else "video"
        if seconds is not None and isinstance(name, int)
        else ""
    )
    east_mm, north_mm = (round(1000 * float(each)) for each in place_m)
    crop = f"{base}/crops/{source}/{named}/{name}/{east_mm}/{north_mm}.jpg" if source else None
    return {
        "flight": flight,
        "time": values.get("time"),
        "frame_id": frame["id"],
        "crop_url": crop,
        "video_s": seconds,
        "video_url": f"{base}/flights/{named}/video" if flight in began else None,
        "height_m": values.get("height_above_ground_m"),
        "sigma_m": values.get("sigma_m"),
        **_found_here(here),
    }


def _found_here(found: Sequence[Json]) -> dict[str, list[Json]]:
    """What a flight found at the place, by kind, and the verdicts on it."""
    return {
        "changes": [each for each in found if each["type"] == "change"],
        "objects": [each for each in found if each["type"] == "object"],
        "reviews": [
            each["review"] | {"id": each["id"]} for each in found if each["review"] is not None
        ],
    }


def _seconds(time: Any, flown: Any) -> float | None:
    """How far into its video a frame is, s; None where the two times have nothing in common."""
    try:
        start = datetime.fromisoformat(str(flown))
        seconds = (datetime.fromisoformat(str(time)) - start).total_seconds()
    except (ValueError, TypeError):
        return None
    return round(seconds, 3) if 0 <= seconds < _DAY_S else None
