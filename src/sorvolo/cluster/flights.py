"""The flights of a batch: found in folders, and each given the folder of its results."""

import hashlib
import math
import os
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from sorvolo.capture.decoding import PHOTO_SUFFIXES
from sorvolo.capture.recordings import recordings
from sorvolo.capture.source import safe_name
from sorvolo.capture.video import VIDEO_SUFFIXES
from sorvolo.errors import InputError, StoreError
from sorvolo.geometry.units import M_PER_DEG_LATITUDE
from sorvolo.store.exports.detection_files import find_watched
from sorvolo.store.site.archive import Archive
from sorvolo.store.site.catalogue_place import is_site
from sorvolo.survey.wording import counted

_PHOTOS = PHOTO_SUFFIXES - {".png"}  # of a camera: PNGs are masks, screenshots, maps
_NEAR_M = 50.0  # from a site's ground: a drone sees no less than half of that beside its track

Box = tuple[float, float, float, float]
"""South, west, north and east of ground, degrees."""


@dataclass(frozen=True)
class FlightFiles:
    """A video, or a folder of photos; `stamp` changes with its files. `why_not`: why it is no flight after all."""

    path: Path
    stamp: str
    why_not: str = ""


def find_flights(places: Sequence[Path], root: Path) -> list[FlightFiles]:
    """Every video and every folder of photos in these folders and below, by path.

    Hidden folders, links to folders, folders of sites and watches, and `root` are passed over. A place may also be
    a video. Raises InputError for a place that is not there, or when there is no flight at all.
    """
    found: dict[Path, FlightFiles] = {}
    files = 0
    for place in places:
        if not place.exists():
            raise InputError(f"no such folder: {place}; folders with flights were needed")
        if place.is_file():
            found[place.resolve()] = FlightFiles(place.resolve(), _stamp([place]))
            continue
        for folder, paths in _folders(place.resolve(), root.resolve()):
            files += len(paths)
            videos = [path for path in paths if path.suffix.lower() in VIDEO_SUFFIXES]
            photos = [path for path in paths if path.suffix.lower() in _PHOTOS]
            beside = sorted({*paths} - {*videos, *photos})  # a video's telemetry may be here
            for each in recordings(videos):
                path = each.chapters[0]
                found[path] = FlightFiles(path, _stamp([*each.chapters, *beside]))
            if photos:
                few = f"a single photo ({photos[0].name}): a flight needs 2 or more"
                found[folder] = FlightFiles(folder, _stamp(photos), few if not photos[1:] else "")
    if all(flight.why_not for flight in found.values()):
        raise InputError(
            f"no flights among {counted(files, 'file')} in {', '.join(map(str, places))}: videos, or folders with two "
            "or more photos, were needed"
        )
    return [found[path] for path in sorted(found)]


def _folders(place: Path, root: Path) -> Iterator[tuple[Path, list[Path]]]:
    for name, folders, names in os.walk(place):
        folder = Path(name)
        if is_site(folder) or folder == root or find_watched(folder) is not None:
            folders.clear()
            continue
        folders[:] = sorted(each for each in folders if not each.startswith("."))
        paths = [folder / each for each in sorted(names) if not each.startswith(".")]
        yield folder, [path for path in paths if path.is_file()]


def _stamp(files: Sequence[Path]) -> str:
    facts = [(path.name, path.stat().st_size, path.stat().st_mtime_ns) for path in files]
    return hashlib.sha256(repr(facts).encode("utf-8", "surrogateescape")).hexdigest()[:32]


@dataclass(frozen=True)
class Scouted:
    """What is known of a flight before its mission.

    `start_ns` is UTC of its first frame, 0 if unknown; `box` where its fixes are, None where it has none.
    """

    fingerprint: str
    frames: int
    start_ns: int
    box: Box | None

    def __post_init__(self) -> None:
        if self.box is not None:  # JSON has lists
            object.__setattr__(self, "box", tuple(self.box))


@dataclass(frozen=True)
class ExistingSite:
    """A site of a folder: the fingerprints of its flights, that of the first map, and where its ground is."""

    flights: frozenset[str]
    founder: str
    ground: Box | None


def existing_site(folder: Path, *, with_ground: bool = False) -> ExistingSite | None:
    """The site in a folder, its ground only if that is asked for; None where there is none."""
    if not is_site(folder):
        return None
    try:
        with Archive.open(folder, write=False) as archive:
            flights = {each.id: each.fingerprint for each in archive.flights()}
            founder = next((each.flight_id for each in archive.versions()), "")
            ground = _ground(archive) if with_ground else None
            return ExistingSite(frozenset(flights.values()), flights.get(founder, ""), ground)
    except StoreError:  # the flights that go there will state why
        return ExistingSite(frozenset(), "", None)


def _ground(archive: Archive) -> Box | None:
    """Where a site's map is; None without a place on Earth, and without a map."""
    from sorvolo.missions.flight.setup import known_ground_m  # takes long to import

    if not archive.has_site or (site := archive.site()).is_local:
        return None
    if (ground_m := known_ground_m(archive)) is None:
        return None
    latitudes, longitudes, _ = site.frame.wgs84_from_site(ground_m)
    corners = latitudes.min(), longitudes.min(), latitudes.max(), longitudes.max()
    south, west, north, east = map(float, corners)
    return south, west, north, east


def sites_of(
    flights: Sequence[tuple[Path, Scouted]],
    known: Mapping[str, str],
    grounds: Mapping[str, Box],
    taken: Collection[str] = (),
    *,
    by_place: bool,
    ending: str = "",
) -> dict[str, str]:
    """The site of each flight, by the flight's fingerprint.

    `known` are the sites of flights that have one: they keep it. `grounds` is where sites are that exist. `taken` are
    names that no new site may have. By place, a flight in order of time joins the first site whose ground lies within
    50 m of its fixes, and the site's ground then reaches as far as the flight's. Any other flight founds a site named
    after it, with `ending` after the name.
    """
    found, reach = dict(known), dict(grounds)
    used = {*known.values(), *grounds, *taken}

    def join(flight: Scouted, site: str) -> None:
        found[flight.fingerprint] = site
        if (box := flight.box) is not None:
            other = reach.get(site, box)
            low, high = map(min, box[:2], other[:2]), map(max, box[2:], other[2:])
            reach[site] = (*low, *high)  # type: ignore[assignment]

    # where flights already belong, their ground counts
    for _, flight in flights:
        if flight.fingerprint in found:
            join(flight, found[flight.fingerprint])
    new = [each for each in flights if each[1].fingerprint not in found]
    for path, flight in sorted(new, key=lambda each: (each[1].start_ns, str(each[0]))):
        near = [name for name in sorted(reach) if by_place and _are_near(flight.box, reach[name])]
        site = near[0] if near else _new_name(path, used, ending)
        used.add(site)
        join(flight, site)
    return found


def _are_near(one: Box | None, other: Box) -> bool:
    """Whether two boxes lie within 50 m of each other, along each axis."""
    if one is None:
        return False
    north = _NEAR_M / M_PER_DEG_LATITUDE
    east = north / max(0.01, math.cos(math.radians(one[0])))
    return (
        one[0] - north <= other[2]
        and other[0] - north <= one[2]
        and one[1] - east <= other[3]
        and other[1] - east <= one[3]
    )


def _new_name(path: Path, used: set[str], ending: str) -> str:
    """The flight's own name; with its folder's before it, or a number after it, where another site has it."""
    own = path.name if path.is_dir() else path.stem
    name = safe_name(own)
    if f"{name}{ending}" in used:
        name = safe_name(f"{path.parent.name}_{own}")
    names = [f"{name}{ending}", *(f"{name}-{number}{ending}" for number in range(2, len(used) + 3))]
    return next(each for each in names if each not in used)
