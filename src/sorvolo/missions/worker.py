"""One mission in a process of its own: an order comes in, lines of JSON go out. The station and batches start it."""

import json
import os
import resource
import signal
import subprocess
import sys
import threading
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field, fields, replace
from functools import partial
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any, BinaryIO, TypeVar

from sorvolo.capture.live.addresses import is_live_address, without_secret
from sorvolo.child_process import python_command
from sorvolo.errors import SorvoloError, UnavailableError

if TYPE_CHECKING:
    from sorvolo.missions.mission import FlightOutcome
    from sorvolo.missions.search.while_flying import SearchWhileFlying
    from sorvolo.missions.watch.run import EarlyFound, WatchUpdate
    from sorvolo.survey.findings import CompareUpdate
    from sorvolo.survey.flight import Site
    from sorvolo.survey.mosaic import FrameView, MosaicUpdate
    from sorvolo.tracking.image_motion import PictureStep

FINISHED, FAILED, STOPPED = "run.finished", "run.failed", "run.stopped"
"""The types of a mission's last line. Its data has `exit_code`, `headline` and `error`."""

PERSON_FOUND = "person.found"
"""The type of the line that a person was found, by whatever mission; its data as of "object.found"."""

BOXES, MOTION = "frame.boxes", "frame.motion"
"""Lines for a live video alone: the boxes of one frame, and how the picture moved since another."""

DONE_CODE, FAILED_CODE, TO_CHECK, STOPPED_CODE = 0, 1, 3, 130
"""Exit codes of a mission's process, as of commands."""

_PROGRESS_EVERY_S = 0.25  # as often as a page shows it; by choice
_FIRST_TO_GO = 500  # for the kernel that looks for memory: the mission, not who started it
_PR_SET_PDEATHSIG = 1  # of prctl: the signal that a process gets when its parent dies

T = TypeVar("T")


@dataclass(frozen=True)
class Order:
    """What a mission's process does, with all files as whole paths.

    `source` is a file, a folder or an address; "" only for a search of the flights that the site has. `folder` takes
    the results of a watch or a search. `stream` names a live video that boxes are shown on. Nothing comes from such a
    stream for `away_s`: it is over. `options` are fields of the mission's settings.
    """

    mission: str
    site: str
    source: str
    telemetry: str = ""
    camera: str = ""
    folder: str = ""
    stream: str = ""
    away_s: float = 900.0
    options: Mapping[str, Any] = field(default_factory=dict)

    def line(self) -> bytes:
        """The order as `main` reads it."""
        return json.dumps(asdict(self)).encode() + b"\n"

    def settings(self, kind: Callable[..., T], **own: Any) -> T:
        """Settings of this kind with the options that they have."""
        names = {each.name for each in fields(kind)}  # type: ignore[arg-type]
        chosen = {
            name: tuple(value) if isinstance(value, list) else value
            for name, value in self.options.items()
            if name in names and value is not None
        }
        return kind(**chosen, **own)


@dataclass(frozen=True)
class Done:
    """How a mission ended: its headline, the flight's name in the site, and whether the result is one to use."""

    headline: str
    flight: str = ""
    is_good: bool = True


class Journal:
    """The lines of a mission: a JSON object each, whole once it can be read. Lines are added from any thread."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self._adding = threading.Lock()
        self._progress_s = -1e9
        self._newest_progress: Mapping[str, Any] | None = None  # that was not written yet

    def add(self, kind: str, data: Mapping[str, Any]) -> None:
        """Append one line and hand it to the operating system."""
        from sorvolo.store.exports.plain import plain_json

        line = json.dumps(
            {"type": kind, "data": plain_json(data)}, ensure_ascii=False, allow_nan=False
        )
        with self._adding:
            self._file.write(line.encode("utf-8", "surrogateescape") + b"\n")
            self._file.flush()

    def progress(self, data: Mapping[str, Any]) -> None:
        """How far the mission is, a few times a second at most."""
        self._newest_progress = data
        if time.monotonic() - self._progress_s >= _PROGRESS_EVERY_S:
            self._write_progress()

    def end(self, kind: str, exit_code: int, **data: Any) -> int:
        """Append the last line, after how far the mission came; the exit code."""
        self._write_progress()
        self.add(kind, {"exit_code": exit_code, "error": None, "headline": None} | data)
        return exit_code

    def _write_progress(self) -> None:
        self._progress_s = time.monotonic()
        if self._newest_progress is not None:
            self.add("run.progress", self._newest_progress)
        self._newest_progress = None


class Stop:
    """The first signal ends a live source, whose flight is then finished, and a watch, which writes what it found.

    Any other signal stops the mission wherever it is.
    """

    def __init__(self, order: Order) -> None:
        self.until = threading.Event()
        self.why = ""  # it is stopped although nobody asked for that
        self.cuts_short = False  # a recorded flight was not searched to its end
        self._is_live = is_live_address(order.source)
        self._ends_well = self._is_live or order.mission == "watch"
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._take)

    def at_once(self, why: str) -> None:
        """Stop the mission for a reason of its own; from any thread."""
        sys.stderr.write(f"{why}; stopped\n")
        self.why = why
        self.until.set()
        os.kill(os.getpid(), signal.SIGTERM)

    def _take(self, _: int, __: FrameType | None) -> None:
        is_first = not self.until.is_set()
        self.cuts_short = not (self._is_live and is_first)
        if is_first and self._ends_well:
            self.until.set()
            return
        raise KeyboardInterrupt


def work(order: Order, journal: Journal, fly: Callable[[Stop], Done]) -> int:
    """Run a mission over a source; its last line and exit code state how it ended.

    The details of an error that is none of ours go to standard error.
    """
    stop, source = Stop(order), order.source
    try:
        done = fly(stop)
    except KeyboardInterrupt:
        if stop.why:
            return journal.end(FAILED, FAILED_CODE, error=f"{stop.why}; nothing was kept")
        return journal.end(STOPPED, STOPPED_CODE, headline="stopped; nothing was kept")
    except SorvoloError as error:
        may_pass = isinstance(error, UnavailableError)
        return journal.end(
            FAILED, FAILED_CODE, error=without_secret(str(error), source), may_pass=may_pass
        )
    except Exception as error:
        sys.stderr.write(without_secret(traceback.format_exc(), source))
        words = f"{type(error).__name__}: {error}"
        if isinstance(error, OSError):
            words = str(error.strerror or error)
        return journal.end(FAILED, FAILED_CODE, error=without_secret(words, source), may_pass=True)
    headline = done.headline
    if stop.cuts_short:  # a watch keeps what it found
        headline = f"stopped before the flight's end: {headline}"
    code = DONE_CODE if done.is_good else TO_CHECK
    return journal.end(FINISHED, code, headline=headline, flight=done.flight)


# ---- the missions -----------------------------------------------------------------------------------------------


def run_map(
    order: Order,
    journal: Journal,
    until: threading.Event,
    search: "SearchWhileFlying | None" = None,
) -> Done:
    """Map a flight into its site."""
    from sorvolo.missions.flight.settings import MapSettings
    from sorvolo.missions.map.flights import map_flights

    site = Path(order.site)
    updates = map_flights(
        [order.source],
        site,
        order.settings(MapSettings),
        telemetry=order.telemetry or None,
        camera=order.camera or None,
        live=_live_settings(order, keeps_all=True),
        until=until,
        search=search,
    )
    with updates:
        for update in updates:
            _add_frame(journal, update.view, update.frame_name, update.status.value)
            journal.progress(_flight_progress(update, update.keyframes, update.by_vision))
        return _mapped(journal, site, updates.result())


def run_compare(order: Order, journal: Journal, until: threading.Event) -> Done:
    """Compare a flight with its site's map."""
    from sorvolo.missions.compare.flights import compare_flights
    from sorvolo.missions.flight.settings import CompareSettings
    from sorvolo.store.site.archive import Archive

    site = Path(order.site)
    announced: dict[str, None] = {}  # their ids, in order
    with Archive.open(site, write=False) as archive:
        place = archive.site()
    updates = compare_flights(
        [order.source],
        site,
        order.settings(CompareSettings),
        telemetry=order.telemetry or None,
        camera=order.camera or None,
        live=_live_settings(order, keeps_all=True),
        until=until,
    )
    with updates:
        for update in updates:
            _add_frame(journal, update.view, update.frame_name, update.status.value)
            announced |= dict.fromkeys(each.id for each in update.announced)
            _add_changes(journal, update, place)
            progress = _flight_progress(update, update.views, update.compared)
            journal.progress(progress | {"changes": len(announced)})
        outcomes = updates.result()
    with Archive.open(site, write=False) as archive:
        flights = {each.flight for each in outcomes if not each.done_utc}
        kept = {each.id for each in archive.changes() if each.flight_id in flights}
    for change_id in announced.keys() - kept:
        journal.add(
            "change.withdrawn", {"id": change_id, "why": "not confirmed by the whole flight"}
        )
    return _mapped(journal, site, outcomes)


def run_watch(order: Order, journal: Journal, until: threading.Event) -> Done:
    """Search a flight's frames for people and things."""
    from sorvolo.missions.watch.flights import watch
    from sorvolo.missions.watch.settings import WatchOutputs, WatchSettings

    updates = watch(
        order.source,
        order.settings(WatchSettings),
        WatchOutputs(Path(order.folder)),
        telemetry=order.telemetry or None,
        camera=order.camera or None,
        live=_live_settings(order),
        until=until,
        moved=partial(_add_motion, journal, order.stream) if order.stream else None,
        early=partial(_add_early, journal, order.stream) if order.stream else None,
    )
    last: WatchUpdate | None = None
    with updates:
        for update in updates:
            last = update
            _add_frame(journal, update.view, update.frame_name, "watched")
            _add_objects(journal, update, order.stream)
            journal.progress(
                {
                    "frames": update.frames_read,
                    "frames_expected": update.frames_expected or None,
                    "searched": update.frames_detected,
                    "to_search": update.frames_asked,
                    "landed": update.has_landed,
                    "objects": dict(update.counts),
                    "seconds": update.seconds,
                    "latency_s": update.latency_s,
                    "frames_per_second": _rate(update.frames_detected, update.seconds),
                }
            )
    if last is None:
        return Done("stopped before the first frame was searched", is_good=False)
    report = json.loads((last.folder / "report.json").read_bytes())
    nowhere = "" if report["georeferenced"] else ", without a place on the ground"
    headline = report["headline"]
    return Done(headline["text"] + nowhere, str(report["flight"]), headline["complete"])


def run_search(order: Order, journal: Journal, until: threading.Event) -> Done:
    """Measure what a search of the site's flights would have found, of a flight in the air while it is mapped."""
    from sorvolo.missions.search.flights import search_site
    from sorvolo.missions.search.settings import SearchOutputs, SearchSettings
    from sorvolo.missions.search.while_flying import SearchWhileFlying

    if order.options.get("through_trees"):
        return _look_through_trees(order, journal)
    settings, outputs = order.settings(SearchSettings), SearchOutputs(Path(order.folder))
    mapped = Done("")
    if order.source:  # a flight to map first
        mapped = run_map(order, journal, until, SearchWhileFlying(settings, outputs))
    with search_site(Path(order.site), settings, outputs) as measuring:
        for each in measuring:
            journal.progress(
                {
                    "frames": each.done,
                    "frames_expected": each.total,
                    "found": each.found,
                    "planted": each.planted,
                    "flight": each.flight,
                }
            )
        outcome = measuring.result()
    return Done(outcome.headline, mapped.flight, mapped.is_good and outcome.trusted)


def _look_through_trees(order: Order, journal: Journal) -> Done:
    """Look for people below the crowns of the site's newest flight."""
    from sorvolo.missions.search.through_trees import search_under_trees

    looking = search_under_trees(order.site, order.folder, plants=order.options.get("plants", 80))
    for update in looking:
        journal.progress(
            {
                "frames": update.number,
                "frames_expected": update.total,
                "flight": update.flight,
                "reason": update.stage,
            }
        )
    report = looking.result()
    flight, headline = report["flight"], report["headline"]
    _add_people(journal, Path(order.site), [flight], below_crowns=True)
    return Done(headline["text"], flight, headline["complete"])


def run_inspect(order: Order, journal: Journal, _: threading.Event) -> Done:
    """Read what a flight is before it is flown: one line "flight.inspected"."""
    from sorvolo.capture.source import open_sources

    found = open_sources([order.source], camera=order.camera or None)
    if len(found) != 1:
        raise SorvoloError(
            f"{order.source} holds {len(found)} flights, expected one; files came or went meanwhile"
        )
    samples, box = found[0].telemetry, None
    if samples.has_fixes:
        latitudes, longitudes = (
            [each for each in samples[name].tolist() if each == each]
            for name in ("latitude_deg", "longitude_deg")
        )
        box = (min(latitudes), min(longitudes), max(latitudes), max(longitudes))
    start_ns = found[0].start_ns or (int(samples.time_ns[0]) if len(samples) else 0)
    journal.add(
        "flight.inspected",
        {
            "fingerprint": found[0].fingerprint,
            "frames": found[0].frame_count,
            "start_ns": start_ns,
            "box": box,
        },
    )
    return Done("inspected")


def run_demo(order: Order, journal: Journal, until: threading.Event) -> Done:
    """Simulate two flights over a village, map the first into its site and compare the second."""
    flights = Path(order.folder) / "simulation"
    making = python_command("sorvolo", "simulate", str(flights), "--preset", "demo")
    if subprocess.run(making, check=False).returncode:
        raise SorvoloError("the flights could not be simulated; is the disk full?")
    one, two = (str(flights / each / f"{each}.mp4") for each in ("flight1", "flight2"))
    run_map(replace(order, source=one), journal, until)
    return run_compare(replace(order, source=two), journal, until)


MISSIONS: dict[str, Callable[[Order, Journal, threading.Event], Done]] = {
    "map": run_map,
    "compare": run_compare,
    "watch": run_watch,
    "search": run_search,
    "inspect": run_inspect,
    "demo": run_demo,
}


def _live_settings(order: Order, *, keeps_all: bool = False) -> Any:
    """How a live source is read. A drone that sends to a station comes back, and states when its flight is over."""
    from sorvolo.capture.live.reconnect import LiveSettings

    settings = LiveSettings(keeps_all=keeps_all, follows_redirects=False)
    return replace(settings, give_up_s=order.away_s) if order.stream else settings


def _mapped(journal: Journal, site: Path, outcomes: "Sequence[FlightOutcome]") -> Done:
    """How a flight's map, or its comparison, ended. Writes each person that the new versions show."""
    _add_people(journal, site, [each.flight for each in outcomes if not each.done_utc])
    texts = "; ".join(filter(None, (each.headline for each in outcomes)))
    flight = outcomes[-1].flight if outcomes else ""
    return Done(texts or "finished", flight, all(each.trusted for each in outcomes))


# ---- what happens on the way ------------------------------------------------------------------------------------


def _add_people(
    journal: Journal, site: Path, flights: Sequence[str], *, below_crowns: bool = False
) -> None:
    """Write each person that flights of the site found first, in single pictures or by a look below crowns."""
    from sorvolo.findings.register import KnownBy
    from sorvolo.store.site.archive import Archive

    with Archive.open(site, write=False) as archive:
        is_local = archive.site().is_local
        for feature in (each for flight in flights for each in archive.new_people(flight)):
            if (KnownBy.UNDER_TREES in feature["properties"]["origins"]) == below_crowns:
                journal.add(PERSON_FOUND, {"feature": feature, "is_local": is_local})


def _add_frame(journal: Journal, view: "FrameView | None", name: str, status: str) -> None:
    """Write where a frame lies: its outline, its camera, which way its top points."""
    import numpy as np

    from sorvolo.geometry.pose import gimbal_angles_from_rotation
    from sorvolo.store.exports.plain import utc_text

    if view is None:
        return
    latitudes, longitudes, _ = view.frame.wgs84_from_site(
        np.vstack([view.outline_m, view.site_from_camera.translation_m[:2]])
    )
    places = np.round(np.column_stack([longitudes, latitudes]), 8).tolist()
    heading_deg, pitch_deg, _ = gimbal_angles_from_rotation(view.site_from_camera.rotation)
    journal.add(
        "frame.placed",
        {
            "frame": name,
            "status": status,
            "footprint": [*places[:4], places[0]],
            "position": places[4],
            "height_m": round(float(view.site_from_camera.translation_m[2]), 2),
            "heading_deg": round(heading_deg, 1),
            "pitch_deg": round(pitch_deg, 1),
            "time": utc_text(view.time_ns),
        },
    )


def _add_changes(journal: Journal, update: "CompareUpdate", site: "Site") -> None:
    """Write each change that was announced just now; of a run that was killed, it has written them."""
    from sorvolo.store.exports.change_files import changes_geojson
    from sorvolo.store.site.change_records import stored_changes

    if update.is_resumed:
        return
    for change in update.announced:
        stored = stored_changes(change.id.rpartition("-")[0], [change])
        feature = changes_geojson(stored, replace(site, is_local=False))["features"][0]
        journal.add("change.announced", {"feature": feature})


def _add_objects(journal: Journal, update: "WatchUpdate", stream: str) -> None:
    """Write a frame's boxes, and each object that it confirmed; of a watch that was killed, it has written them."""
    from sorvolo.store.exports.detection_files import tracks_collection
    from sorvolo.survey.objects import PERSON

    if update.is_resumed:
        return
    journal.add(BOXES, _boxes(update, stream))
    if not update.new:
        return
    for feature in tracks_collection(list(update.new), update.site, {})["features"]:
        found = {"feature": feature, "is_local": update.site.is_local}
        journal.add("object.found", found)
        if feature["properties"]["class"] == PERSON:
            journal.add(PERSON_FOUND, found)


def _add_early(journal: Journal, stream: str, found: "EarlyFound") -> None:
    """Write the boxes of some classes, before the frame is searched for the others."""
    journal.add(BOXES, _boxes(found, stream) | {"classes": list(found.classes)})


def _boxes(seen: "WatchUpdate | EarlyFound", stream: str) -> dict[str, Any]:
    from sorvolo.store.exports.plain import utc_text

    found = seen.detections
    return {
        "stream": stream or None,
        "frame": seen.frame_name,
        "pts_us": seen.clip_ns // 1000,
        "time": utc_text(seen.time_ns),
        "frame_size_px": list(seen.size_px),
        "latency_s": round(seen.latency_s, 3),
        "boxes": [
            {
                "class": name,
                "score": round(float(score), 3),
                "xywh_px": [round(float(each), 1) for each in (x0, y0, x1 - x0, y1 - y0)],
            }
            for name, score, (x0, y0, x1, y1) in zip(found.names, found.scores, found.boxes_px)
        ],
    }


def _add_motion(journal: Journal, stream: str, step: "PictureStep") -> None:
    """Write how the picture moved since a tenth of a second before; in the thread that reads the stream."""
    from sorvolo.store.exports.plain import utc_text

    with suppress(OSError):  # a disk that is full: the mission's own next line states it
        journal.add(
            MOTION,
            {
                "stream": stream,
                "from_time": utc_text(step.from_ns),
                "time": utc_text(step.to_ns),
                "to_from": [float(f"{each:.9g}") for each in step.to_from.ravel()],
            },
        )


def _flight_progress(
    update: "MosaicUpdate | CompareUpdate", selected: int, matched: int
) -> dict[str, Any]:
    return {
        "frames": update.frames_read,
        "frames_expected": max(update.frames_expected, update.frames_read),
        "selected": selected,
        "matched": matched,
        "seconds": update.seconds,
        "frames_per_second": _rate(update.frames_read, update.seconds),
        "reason": update.reason or None,
    }


def _rate(frames: int, seconds: float) -> float | None:
    return round(frames / seconds, 2) if seconds > 0 else None


# ---- the process ------------------------------------------------------------------------------------------------


def main() -> int:
    """Do the order on standard input, with lines on standard output. The process ends with its parent."""
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    if sys.platform == "linux":  # also a process that hangs, or was stopped, ends with its parent
        import ctypes

        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    with suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text(str(_FIRST_TO_GO))
    journal = Journal(os.fdopen(os.dup(1), "wb"))
    os.dup2(2, 1)  # what libraries print is no line of a journal
    order = Order(**json.loads(sys.stdin.buffer.readline()))
    threading.Thread(target=_end_with_parent, daemon=True).start()
    mission = MISSIONS[order.mission]
    return work(order, journal, lambda stop: mission(order, journal, stop.until))


def _end_with_parent() -> None:
    """The parent holds the other end of the standard input as long as it lives."""
    sys.stdin.buffer.read()
    os._exit(FAILED_CODE)


if __name__ == "__main__":
    sys.exit(main())
