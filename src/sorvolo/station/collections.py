"""What a site holds as features in WGS84, with their boxes in an R-tree: frames, objects, changes, coverage."""

import json
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from shapely import STRtree, box
from shapely.errors import ShapelyError
from shapely.geometry import shape
from shapely.geometry.base import BaseGeometry

from sorvolo.findings.register import UNNAMED
from sorvolo.station.found import Feature, Track, found_features, on_earth
from sorvolo.station.problems import Problem
from sorvolo.station.sites import SiteShelf
from sorvolo.station.state import StationState
from sorvolo.store.exports.change_files import changes_geojson
from sorvolo.store.exports.detection_files import CROPS, TRACKS
from sorvolo.store.exports.ground_files import COVERAGE
from sorvolo.store.exports.places import place_deg
from sorvolo.store.exports.plain import feature, features_name
from sorvolo.store.nofollow import read_below
from sorvolo.store.site.archive import Archive
from sorvolo.store.site.files import LIVE_COVERAGE, is_plain_name
from sorvolo.survey.flight import Site

TITLES: Mapping[str, str] = {
    "frames": "Frames: what of the ground each shows, and how it was placed",
    "objects": "People, cars and small objects, each once, by the newest look at each place",
    "changes": "Changes between flights",
    "findings": "Everything found, each thing once, from all missions and dates; what was seen gone, too",
    "coverage": "Ground that flights saw, and its holes; ground compared, and the rest with its reason",
    "pod": "Probability of detection of the latest measured search",
    "track": "The drone's way, one line a flight",
}
FINDINGS = "findings"
SEARCH_FOLDER = "search"
"""The folder of a site in which the station keeps its latest measured search."""

_POD_FILE = f"{SEARCH_FOLDER}/pod.geojson"
_LIVE_COVERAGE = LIVE_COVERAGE.removesuffix(".geojson")
_MOST_BYTES = 256_000_000  # of a GeoJSON file of a site; 10,000 frames have some ten; by choice
_MOST_FLIGHTS = 400  # whose frames are kept by flight: of some ten kilobytes to a megabyte each

_RESULTS = "results"
_MOST_TRACKS_BYTES = 64_000_000  # of a watch's tracks; by choice
_MOST_RUNS = 100  # of a site, the newest


@dataclass(frozen=True, eq=False)
class Collection:
    """Features with a geometry, in order, and an R-tree over their boxes."""

    features: Sequence[Feature]
    shapes: Sequence[BaseGeometry]
    tree: STRtree

    @classmethod
    def of(cls, features: Sequence[Feature]) -> "Collection":
        """Of features; those whose geometry is missing or broken are left out."""
        kept, shapes = [], []
        for each in features:
            try:
                found = shape(each["geometry"]) if each.get("geometry") else None
            except (ShapelyError, ValueError, TypeError, KeyError, AttributeError, IndexError):
                continue
            if found is not None and not found.is_empty:
                kept.append(each)
                shapes.append(found)
        return cls(kept, shapes, STRtree(shapes))

    def within(self, bbox: Sequence[float]) -> list[int]:
        """Which features meet a box of west, south, east, north."""
        return sorted(int(each) for each in self.tree.query(box(*bbox), predicate="intersects"))


@dataclass(frozen=True, eq=False)
class _Kept:
    """A collection with the state of the site's catalogue, and of what collections hold, that it was made of."""

    mark: object
    content: object
    collection: Collection


@dataclass(frozen=True, eq=False)
class FlightFrames:
    """One flight's frames, and of which the picture was kept, by number."""

    frames: Collection
    kept: frozenset[int]


class Findings:
    """The findings of all sites' watches, while they run and afterwards. Threads may share it.

    A finding's id is its run's and its number there, with a colon. `folder` holds a folder for each run.
    """

    def __init__(self, state: StationState, folder: Path) -> None:
        self._state, self._folder = state, folder
        self._lock = threading.Lock()
        self._kept: dict[str, tuple[int, list[Track]]] = {}  # by run, with the time of its file

    def of_site(self, site_id: str) -> list[Track]:
        """What the watches of a site found that has a place on Earth, those of the newest watch first."""
        return [each for run in self.watches(site_id) for each in self._of_run(run)]

    def watches(self, site_id: str) -> list[str]:
        """The newest watches of a site, also of one that has no map yet."""
        rows = self._state.rows(
            "SELECT id FROM runs WHERE site = ? AND mission = 'watch' ORDER BY made_at DESC LIMIT ?",
            (site_id, _MOST_RUNS),
        )
        return [row["id"] for row in rows]

    def crop(self, site_id: str, finding_id: str) -> bytes:
        """The picture of a finding, JPEG. Raises Problem (404)."""
        found = next((each for each in self.of_site(site_id) if each["id"] == finding_id), None)
        name = str((found or {}).get("crop") or "").removeprefix(f"{CROPS}/")
        if found is None or not is_plain_name(name):
            raise Problem(
                404, "no such picture: of a finding that a watch of this site kept one of"
            )
        try:
            return read_below(self._folder / found["run"] / _RESULTS, f"{CROPS}/{name}")
        except FileNotFoundError as error:
            raise Problem(404, "this picture was not kept") from error

    def _of_run(self, run_id: str) -> list[Track]:
        folder = self._folder / run_id / _RESULTS
        try:
            mark = (folder / f"{TRACKS}.geojson").stat().st_mtime_ns
            with self._lock:
                known = self._kept.get(run_id)
            if known is None or known[0] != mark:
                content = json.loads(read_below(folder, f"{TRACKS}.geojson", _MOST_TRACKS_BYTES))
                known = (
                    mark,
                    [
                        _track_of(each, run_id)
                        for each in content["features"]
                        if each.get("geometry")
                    ],
                )
        except (OSError, ValueError, KeyError, TypeError, AttributeError):
            return []
        with self._lock:
            self._kept[run_id] = known
        return known[1]


def _track_of(feature: Feature, run_id: str) -> Track:
    """A track by its properties, with its place: without the path that it took."""
    values = {**feature["properties"], "run": run_id, "lonlat": feature["geometry"]["coordinates"]}
    for name in ("path", "best_box_px"):
        values.pop(name, None)
    return values | {
        "id": f"{run_id}:{values['id']}",
        "class_scores": values.get("class_scores") or {},
    }


class SiteCollections:
    """The collections of all sites, made when asked for and kept until their content changes. Threads may share it.

    A flight that is being mapped changes the site's catalogue twice a second, and none of its collections.
    """

    def __init__(
        self, shelf: SiteShelf, findings: Findings, marks: Callable[[str], list[Track]]
    ) -> None:
        """`marks` has what people marked as found on a site."""
        self._shelf, self._findings, self._marks = shelf, findings, marks
        self._kept: dict[tuple[str, str], _Kept] = {}
        self._flights: dict[
            tuple[str, str, str], tuple[int, FlightFrames]
        ] = {}  # frames with their file's time
        self._lock = threading.Lock()

    def frames_of(self, site_id: str, flights: Sequence[str]) -> list[FlightFrames]:
        """What `get` has of the frames of each of these flights, without reading those of others."""
        archive = self._shelf.open(site_id)
        site, created_utc = archive.site(), archive.created_utc
        return [self._frames_of(site_id, created_utc, archive, site, each) for each in flights]

    def _frames_of(
        self, site_id: str, created_utc: str, archive: Archive, site: Site, flight: str
    ) -> FlightFrames:
        mark = _modified(
            archive, f"flights/{flight}/{features_name('frames', is_local=site.is_local)}"
        )
        key = (site_id, created_utc, flight)
        with self._lock:
            known = self._flights.pop(key, None)
        if known is None or known[0] != mark:
            kept = frozenset(each.index for each in archive.keyframes(flight))
            known = mark, FlightFrames(Collection.of(_frames_of(archive, site, flight)), kept)
        with self._lock:
            self._flights[key] = known
            while len(self._flights) > _MOST_FLIGHTS:
                del self._flights[next(iter(self._flights))]
        return known[1]

    def get(self, site_id: str, name: str) -> Collection:
        """A collection of a site. Raises Problem (404)."""
        if name in (FINDINGS, "objects"):
            return self._found(site_id, name)
        if name not in _MAKERS:
            raise Problem(404, f"no collection {name[:40]!r}; there are {', '.join(TITLES)}")
        archive = self._shelf.open(site_id)
        mark = (
            archive.change_mark(),
            _modified(archive, _POD_FILE),
            _modified(archive, LIVE_COVERAGE),
        )
        with self._lock:
            known = self._kept.get((site_id, name))
        if known is not None and known.mark == mark:
            return known.collection
        return self._made(
            (site_id, name),
            _content(archive),
            lambda: _MAKERS[name](archive) if archive.has_site else [],
            mark,
        )

    def _made(
        self,
        key: tuple[str, str],
        content: object,
        make: Callable[[], Sequence[Feature]],
        mark: object = None,
    ) -> Collection:
        """The collection that is kept for this content, else made of it and kept."""
        with self._lock:
            known = self._kept.get(key)
        made = known.collection if known and known.content == content else Collection.of(make())
        with self._lock:
            self._kept[key] = _Kept(mark, content, made)
        return made

    def _found(self, site_id: str, name: str) -> Collection:
        """The site's register with what its watches saw: all findings, or those that are there by the newest look."""
        tracks = self._findings.of_site(site_id)
        try:
            archive: Archive | None = self._shelf.open(site_id)
        except Problem:
            if not self._findings.watches(site_id):
                raise
            archive = None
        marks = self._marks(site_id) if archive else []

        def make() -> Sequence[Feature]:
            if name == FINDINGS:
                known = archive if archive and archive.has_site else None
                return found_features(known, tracks, marks)
            found = self._found(site_id, FINDINGS).features
            names = ((each, each["properties"]) for each in found)
            return [each for each, own in names if not own["gone"] and own["class"] != UNNAMED]

        return self._made((site_id, name), (archive and _content(archive), tracks, marks), make)


def _frames(archive: Archive) -> list[Feature]:
    site = archive.site()
    return [each for flight in _flights(archive) for each in _frames_of(archive, site, flight)]


def _frames_of(archive: Archive, site: Site, flight: str) -> list[Feature]:
    """The frames of one flight."""
    features = []
    for each in archive.features(f"flights/{flight}", "frames"):
        values = dict(each.get("properties") or {})
        values |= {"flight": flight, "datetime": values.get("time")}
        geometry = _lonlat(each.get("geometry"), site)
        if site.is_local:
            values |= _camera_on_earth(values, site)
        features.append(feature(geometry, values, id=f"{flight}:{values.get('frame')}"))
    return features


def _track(archive: Archive) -> list[Feature]:
    lines: dict[str, list[tuple[str, list[float]]]] = {}
    for each in _frames(archive):
        values = each["properties"]
        place = [
            values.get(f"camera_{name}") for name in ("longitude_deg", "latitude_deg", "height_m")
        ]
        if None not in place[:2]:
            known = [each for each in place if each is not None]
            lines.setdefault(values["flight"], []).append((values["time"], known))
    features = []
    for flight, places in lines.items():
        places.sort(key=lambda each: each[0])
        if len(places) < 2:
            continue
        values = {
            "flight": flight,
            "datetime": places[0][0],
            "end_datetime": places[-1][0],
            "times": [time for time, _ in places],
        }
        geometry = {"type": "LineString", "coordinates": [place for _, place in places]}
        features.append(feature(geometry, values, id=flight))
    return features


def _changes(archive: Archive) -> list[Feature]:
    stored = archive.changes()
    versions = {each.flight_id: each for each in archive.versions()}
    features = []
    for change, each in zip(
        stored, changes_geojson(stored, on_earth(archive.site()))["features"], strict=True
    ):
        version, properties = versions.get(change.flight_id), each["properties"]
        values = {
            **properties,
            "flight": change.flight_id,
            "class": change.class_after or change.class_before or change.kind.value,
            "version": version and version.id,
            "from_version": version and version.parent_id,
            "datetime": properties["first_seen"],
            "end_datetime": properties["last_seen"],
            "review_kind": "change",
        }
        features.append(feature(each["geometry"], values, id=change.id))
    return features


def _coverage(archive: Archive) -> list[Feature]:
    site = archive.site()
    parts: list[tuple[str | None, list[Any]]] = [
        (flight, archive.features(f"flights/{flight}", COVERAGE)) for flight in _flights(archive)
    ]
    in_the_air = archive.features("", _LIVE_COVERAGE, is_local=False)
    return [
        feature(
            _lonlat(each.get("geometry"), site),
            {**(each.get("properties") or {}), "flight": flight},
            id=f"{flight or 'live'}:{number}",
        )
        for flight, found in [*parts, (None, in_the_air)]
        for number, each in enumerate(found)
    ]


def _pod(archive: Archive) -> list[Feature]:
    return [
        feature(each.get("geometry"), each.get("properties"), id=str(number))
        for number, each in enumerate(archive.features(SEARCH_FOLDER, "pod", is_local=False))
    ]


_MAKERS: Mapping[str, Callable[[Archive], list[Feature]]] = {
    "frames": _frames,
    "changes": _changes,
    "coverage": _coverage,
    "pod": _pod,
    "track": _track,
}


def _flights(archive: Archive) -> list[str]:
    return [each.id for each in archive.complete_flights]


def _lonlat(geometry: Any, site: Site) -> Any:
    """A geometry of a file in degrees: those of a local site are in its own units."""
    if not site.is_local or not geometry:
        return geometry

    def turned(coordinates: Any) -> Any:
        if coordinates and isinstance(coordinates[0], int | float):
            return [*place_deg(np.array(coordinates[:2], np.float64), site)]
        return [turned(each) for each in coordinates]

    return {**geometry, "coordinates": turned(geometry["coordinates"])}


def _camera_on_earth(values: Mapping[str, Any], site: Site) -> dict[str, Any]:
    east, north = values.get("camera_east"), values.get("camera_north")
    if east is None or north is None:
        return {}
    longitude, latitude = place_deg(np.array([east, north], np.float64), site)
    return {"camera_longitude_deg": longitude, "camera_latitude_deg": latitude}


def _content(archive: Archive) -> object:
    """What changes whenever a collection of the site may: its flights with their files, versions, verdicts, search."""
    if not archive.has_site:
        return None
    names = [features_name(name, is_local=archive.site().is_local) for name in ("frames", COVERAGE)]
    return (
        archive.created_utc,
        [(each.id, each.finished_utc) for each in archive.complete_flights],
        [
            _modified(archive, f"flights/{flight}/{name}")
            for flight in _flights(archive)
            for name in names
        ],
        [each.id for each in archive.versions()],
        [(each.change_id, each.verdict, each.at_utc, each.note) for each in archive.reviews()],
        _modified(archive, _POD_FILE),
        _modified(archive, LIVE_COVERAGE),
    )


def _modified(archive: Archive, file: str) -> int:
    """When a file of the site was written last, ns; 0 where there is none."""
    try:
        return (archive.folder / file).stat().st_mtime_ns
    except OSError:
        return 0
