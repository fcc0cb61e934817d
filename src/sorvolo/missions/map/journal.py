"""What a mapping has done with each frame so far, in its journal: a killed run continues after the last one."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields
from typing import Any

import sorvolo
from sorvolo.capture.source import LiveSource, Source
from sorvolo.errors import SorvoloError
from sorvolo.geometry.arrays import ImageRGB
from sorvolo.geometry.camera import Camera
from sorvolo.geometry.pose import Pose
from sorvolo.missions.flight.live_journal import BEGUN, SAMPLES, SourceNotes, go_on
from sorvolo.missions.flight.map_objects import FrameDetections
from sorvolo.missions.flight.request import live_request
from sorvolo.missions.flight.setup import FlightSetup
from sorvolo.mosaic.planar import Registered
from sorvolo.mosaic.selection import SelectionMemory
from sorvolo.store.images import array_from_bytes
from sorvolo.store.site.archive import Archive
from sorvolo.store.site.journal import Entry, RunJournal, content_sha256
from sorvolo.survey.flight import CameraPrior
from sorvolo.survey.mosaic import Features, Keyframe, Link
from sorvolo.survey.objects import Detections

_PRIOR = ("position_m", "position_sigma_m", "rotation", "attitude_sigma_deg", "velocity_m_s")
_LINK = ("new_px", "old_px", "new_from_old")


@dataclass(frozen=True)
class StoredPicture:
    """A keyframe's picture in the site: its size (width, height) and its SHA-256."""

    size_px: tuple[int, int]
    sha256: str


@dataclass(frozen=True, eq=False)
class Taken:
    """A frame that was registered, and its picture: in the site, or as it waits for its place (bytes: JPEG)."""

    registered: Registered
    picture: StoredPicture | ImageRGB | bytes


@dataclass(frozen=True, eq=False)
class Step:
    """One frame as the mapping took it: `taken`, or why it cannot be used.

    `memory` is that of the selection after it; None for a frame that the source lost. `is_searched`: a detector was to
    look at it.
    """

    index: int
    name: str
    time_ns: int
    reason: str
    memory: SelectionMemory | None
    taken: Taken | None
    is_searched: bool


class Earlier:
    """The frames that a killed run took: where to go on in the input, and what of it to read again."""

    def __init__(self) -> None:
        self.last = -1
        """The index of the last frame taken."""
        self.memory = SelectionMemory()
        self.needed: set[int] = set()
        """Frames to read again: the source counts those that it lost, and a detector looks at the last ones."""
        self._searched: list[int] = []

    def take(self, step: Step) -> None:
        """Take the next of its frames."""
        self.last = max(self.last, step.index)
        if step.memory is None:
            self.needed.add(step.index)
        else:
            self.memory = step.memory
        if step.is_searched:
            self._searched.append(step.index)

    def search(self, is_unsearched: Callable[[int], bool]) -> None:
        """Have those frames searched again whose detections are not known."""
        self.needed |= {index for index in self._searched if is_unsearched(index)}


class MapJournal:
    """A mapping's steps and detections, in a journal of the site; `notes` are those of a live source."""

    def __init__(self, journal: RunJournal, notes: SourceNotes | None = None) -> None:
        self.file = journal
        self._notes = notes

    def keep_source(self) -> None:
        """Note what a live source has brought besides frames; nothing of a recorded one."""
        if self._notes is not None:
            self._notes.keep()

    def keep(self, step: Step) -> None:
        """Note a frame. Raises StoreError when the disk is full."""
        self.keep_source()
        values: dict[str, Any] = {
            "index": step.index,
            "name": step.name,
            "time_ns": step.time_ns,
            "reason": step.reason,
            "searched": step.is_searched,
        }
        arrays: dict[str, Any] = {}
        if step.memory is not None:
            values["selection"] = {"usual": step.memory.usual, "count": step.memory.count}
            if step.memory.last is not None:
                arrays["last"] = step.memory.last
        if step.taken is not None:
            put_taken(step.taken, values, arrays)
        self.file.append(Entry("step", values, arrays))

    def keep_detections(self, seen: FrameDetections) -> None:
        """Note what was detected in a frame."""
        self.file.append(
            Entry(
                "seen",
                {
                    "index": seen.index,
                    "classes": seen.found.classes,
                    "seconds": seen.seconds,
                    "crops": [len(each) for each in seen.crops],
                    "least": dict(seen.least),
                },
                {
                    "boxes_px": seen.found.boxes_px,
                    "scores": seen.found.scores,
                    "labels": seen.found.labels,
                    "jpegs": array_from_bytes(b"".join(seen.crops)),
                },
            )
        )

    def earlier(self) -> Iterator[Step | FrameDetections]:
        """What a killed run did, in order; it ends where an entry is not as one was written."""
        for entry in self.file.entries():
            if entry.kind in (BEGUN, SAMPLES):
                continue
            try:
                read = _step(entry) if entry.kind == "step" else detections_in(entry)
            except (KeyError, TypeError, ValueError, SorvoloError):
                return  # a damaged entry: what comes after it is done again
            yield read


def begun_journal(setup: FlightSetup, archive: Archive, request: str, *, anew: bool) -> RunJournal:
    """The journal of a run, with what a killed run of the same work left; `anew` discards that."""
    return archive.journal(
        setup.source.name, run_key(setup, archive, request), sorvolo.__version__, anew=anew
    )


def run_key(setup: FlightSetup, archive: Archive, request: str) -> str:
    """What is asked for, and of which site: the same only for the same work."""
    if isinstance(setup.source, LiveSource):
        return live_key(archive, request)
    site = archive.site() if archive.has_site else None
    versions = [
        (each.id, each.run_id, each.flight_id) for each in archive.versions() if each.complete
    ]
    return content_sha256(request, setup.plan, setup.frame.origin, site, versions)


def live_key(archive: Archive, request: str) -> str:
    """The same of a live flight, before anything is known of it."""
    return content_sha256(
        request, [(each.id, each.run_id) for each in archive.versions() if each.complete]
    )


def go_on_live(
    source: Source, archive: Archive, asked: tuple[Any, ...], most_gap_s: float, *, anew: bool
) -> int:
    """Have a live source go on with the flight of a run that was killed, if one was `asked` for the same (what follows
    the source in `live_request`); how many samples of its telemetry that run had noted."""
    if anew or not isinstance(source, LiveSource):
        return 0
    request = live_request(source, *asked)
    journal = archive.stopped_run(live_key(archive, request), sorvolo.__version__)
    so_far = None if journal is None else go_on(source, journal, most_gap_s)
    return 0 if so_far is None else len(so_far.times_ns)


def put_taken(taken: Taken, values: dict[str, Any], arrays: dict[str, Any]) -> None:
    """Add a frame that was registered to the values and arrays of an entry."""
    new = taken.registered
    keyframe, features = new.keyframe, new.keyframe.features
    values["keyframe"] = {
        "id": keyframe.id,
        "camera": _camera_values(keyframe.camera),
        "features": features.kind,
        "met": new.met,
        "source": keyframe.prior.source,
        "reason": new.reason,
        "placed": new.guess is not None,
        "links": [{"old_id": each.old_id, "sigma_px": each.sigma_px} for each in new.links],
    }
    arrays |= {
        "gray": keyframe.gray,
        "points_px": features.points_px,
        "descriptors": features.descriptors,
        "thumbnail": new.thumbnail,
        "distortion": keyframe.camera.distortion,
        **{name: getattr(keyframe.prior, name) for name in _PRIOR},
        **{
            f"{name}_{number}": getattr(each, name)
            for number, each in enumerate(new.links)
            for name in _LINK
        },
    }
    if new.guess is not None:
        arrays |= {"guess_rotation": new.guess.rotation, "guess_m": new.guess.translation_m}
    if isinstance(taken.picture, StoredPicture):
        values["stored"] = {"size_px": taken.picture.size_px, "sha256": taken.picture.sha256}
    elif isinstance(taken.picture, bytes):
        arrays["jpeg"] = array_from_bytes(taken.picture)
    else:
        arrays["picture"] = taken.picture


def _camera_values(camera: Camera) -> dict[str, Any]:
    return {
        each.name: getattr(camera, each.name)
        for each in fields(camera)
        if each.name != "distortion"
    }


def _step(entry: Entry) -> Step:
    values, arrays = entry.values, entry.arrays
    memory = None
    if "selection" in values:
        kept = values["selection"]
        memory = SelectionMemory(
            arrays.get("last"), tuple(float(each) for each in kept["usual"]), int(kept["count"])
        )
    return Step(
        int(values["index"]),
        str(values["name"]),
        int(values["time_ns"]),
        str(values["reason"]),
        memory,
        taken_in(entry),
        bool(values["searched"]),
    )


def taken_in(entry: Entry) -> Taken | None:
    """The registered frame that an entry holds; None where it holds none. Raises what a damaged one leads to."""
    if "keyframe" not in entry.values:
        return None
    arrays, kept = entry.arrays, entry.values["keyframe"]
    keyframe_id = int(kept["id"])
    camera = Camera(**kept["camera"], distortion=arrays["distortion"])
    prior = CameraPrior(**{name: arrays[name] for name in _PRIOR}, source=str(kept["source"]))
    features = Features(str(kept["features"]), arrays["points_px"], arrays["descriptors"])
    _check_picture(arrays["gray"], (camera.height_px, camera.width_px))
    links = tuple(
        Link(
            keyframe_id,
            int(each["old_id"]),
            **{name: arrays[f"{name}_{number}"] for name in _LINK},
            sigma_px=float(each["sigma_px"]),
        )
        for number, each in enumerate(kept["links"])
    )
    guess = Pose(arrays["guess_rotation"], arrays["guess_m"]) if kept["placed"] else None
    registered = Registered(
        Keyframe(keyframe_id, camera, arrays["gray"], features, prior),
        arrays["thumbnail"],
        links,
        guess,
        str(kept["reason"]),
        tuple(int(each) for each in kept["met"]),
    )
    return Taken(registered, _picture(entry))


def _picture(entry: Entry) -> StoredPicture | ImageRGB | bytes:
    stored = entry.values.get("stored")
    if stored is not None:
        width_px, height_px = stored["size_px"]
        return StoredPicture((int(width_px), int(height_px)), str(stored["sha256"]))
    if "jpeg" in entry.arrays:
        return bytes(entry.arrays["jpeg"])
    return entry.arrays["picture"]


def detections_in(entry: Entry) -> FrameDetections:
    """A frame's detections that an entry holds. Raises what a damaged one leads to."""
    arrays, values = entry.arrays, entry.values
    found = Detections(
        arrays["boxes_px"],
        arrays["scores"],
        arrays["labels"],
        tuple(str(each) for each in values["classes"]),
    )
    jpegs, crops, at = bytes(arrays["jpegs"]), [], 0
    for length in values["crops"]:
        crops.append(jpegs[at : at + int(length)])
        at += int(length)
    least = {str(name): float(score) for name, score in values["least"].items()}
    return FrameDetections(
        int(values["index"]), found, tuple(crops), float(values["seconds"]), least
    )


def _check_picture(gray: Any, size: tuple[int, int]) -> None:
    if gray.shape != size:
        raise ValueError(f"a picture of {gray.shape} where {size} were needed")
