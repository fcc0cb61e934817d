"""The contents of a batch's folders: which files are flights, and what is known of each before it is mapped."""

import hashlib
import os
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from sorvolo.capture.decoding import PHOTO_SUFFIXES
from sorvolo.capture.video import VIDEO_SUFFIXES
from sorvolo.cluster.orders import Scouted, ScoutOrder
from sorvolo.cluster.process import WorkerProcess
from sorvolo.errors import InputError
from sorvolo.store.exports.detection_files import find_watched
from sorvolo.store.site.catalogue_place import is_site
from sorvolo.survey.wording import counted

_PHOTOS = PHOTO_SUFFIXES - {".png"}  # of a camera: PNGs are masks, screenshots, maps
_VIDEOS = VIDEO_SUFFIXES - {".lrv"}  # which is the small copy of a video beside it
_LEAST_PHOTOS = 2  # one photo is no flight
_STALL_S = 120.0  # a file on a slow disk may take that long to open; by choice


@dataclass(frozen=True)
class FoundFlight:
    """A video, or a folder of photos; `stamp` changes with the names, sizes and times of its files.

    `why_not` is why it is no flight after all, though somebody may take it for one; "" for a flight.
    """

    path: Path
    stamp: str
    why_not: str = ""


@dataclass(frozen=True)
class Unreadable:
    """A flight that cannot be read, and why; `crashed` if every try crashed its process."""

    words: str
    crashed: bool = False


def find_flights(places: Sequence[Path], root: Path) -> list[FoundFlight]:
    """Every video and every folder of photos in these folders and below, by path; one with a single photo is no flight.

    Hidden folders, links to folders, folders of sites and watches, and `root` are passed over. A place may also be
    a video. Raises InputError for a place that is not there, or when there is no flight at all.
    """
    found: dict[Path, FoundFlight] = {}
    files = 0
    for place in places:
        if not place.exists():
            raise InputError(f"no such folder: {place}; folders with flights were needed")
        if place.is_file():
            found[place.resolve()] = FoundFlight(place.resolve(), _stamp([place]))
            continue
        for folder, names in _folders(place.resolve(), root.resolve()):
            files += len(names)
            for each in _flights_of(folder, names):
                found[each.path] = each
    if all(each.why_not for each in found.values()):
        raise InputError(
            f"no flights among {counted(files, 'file')} in {', '.join(map(str, places))}: videos, or folders with two "
            "or more photos, were needed"
        )
    return [found[path] for path in sorted(found)]


def _folders(place: Path, root: Path) -> Iterator[tuple[Path, list[str]]]:
    for folder, folders, names in os.walk(place):
        if is_site(Path(folder)) or Path(folder) == root or find_watched(Path(folder)) is not None:
            folders.clear()
            continue
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        yield Path(folder), sorted(name for name in names if not name.startswith("."))


def _flights_of(folder: Path, names: Sequence[str]) -> Iterator[FoundFlight]:
    paths = [path for name in names if (path := folder / name).is_file()]
    videos, photos = _ending_in(_VIDEOS, paths), _ending_in(_PHOTOS, paths)
    beside = sorted({*paths} - {*videos, *photos})
    for path in videos:
        yield FoundFlight(path, _stamp([path, *beside]))  # its telemetry may be among these
    if photos:
        few = f"a single photo ({photos[0].name}): a flight needs {_LEAST_PHOTOS} or more"
        yield FoundFlight(folder, _stamp(photos), few if len(photos) < _LEAST_PHOTOS else "")


def _ending_in(endings: frozenset[str], paths: Sequence[Path]) -> list[Path]:
    return [path for path in paths if path.suffix.lower() in endings]


def _stamp(files: Sequence[Path]) -> str:
    facts = [(path.name, path.stat().st_size, path.stat().st_mtime_ns) for path in files]
    return hashlib.sha256(repr(facts).encode("utf-8", "surrogateescape")).hexdigest()[:32]


def scout(
    paths: Sequence[Path],
    camera: str,
    most_tries: int,
    held: Sequence[int] = (),
    seen: Callable[[int], None] = lambda _: None,
) -> list[Scouted | Unreadable]:
    """Inspect each flight in a separate process: a file that crashes a decoder does not crash the batch.

    One that ends the process `most_tries` times is unreadable. `seen` is called with how many were looked into.
    """
    found: list[Scouted | Unreadable] = []
    crashes: Counter[int] = Counter()
    while len(found) < len(paths):
        worker = WorkerProcess(ScoutOrder(tuple(map(str, paths[len(found) :])), camera), held)
        try:
            for kind, data in worker.answers(_STALL_S):
                if kind == "scouted":
                    box = data["box"]
                    found.append(Scouted(**{**data, "box": None if box is None else tuple(box)}))
                elif kind == "unreadable":
                    found.append(Unreadable(str(data["words"])))
                seen(len(found))
        except BaseException:
            worker.kill()
            raise
        finally:
            ending = worker.end(None)
        if len(found) < len(paths):
            crashes[len(found)] += 1
            if crashes[len(found)] >= most_tries:
                found.append(Unreadable(ending.words, crashed=True))
    return found
