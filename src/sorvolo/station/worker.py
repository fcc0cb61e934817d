"""A mission's own process: does one order and writes what happens into a journal, line by line; needs no server."""

import fcntl
import json
import os
import resource
import signal
import sys
import threading
import time
import traceback
from collections.abc import Mapping
from contextlib import closing, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any

import numpy as np

from sorvolo.capture.live.addresses import is_live_address, without_secret
from sorvolo.capture.live.reconnect import LiveSettings
from sorvolo.errors import SorvoloError
from sorvolo.geometry.pose import gimbal_angles_from_rotation
from sorvolo.station.camera import camera_opened
from sorvolo.station.collections import on_earth
from sorvolo.station.incomplete import cut_off, unsent
from sorvolo.station.orders import (
    BOXES,
    JOURNAL_FILE,
    LOCK_VARIABLE,
    MOTION,
    ORDER_FILE,
    TO_CHECK,
    Order,
)
from sorvolo.station.orphan_watch import ended_when_orphaned, why_orphaned
from sorvolo.store.exports.change_files import changes_geojson
from sorvolo.store.exports.detection_files import tracks_collection
from sorvolo.store.exports.plain import plain_json, utc_text
from sorvolo.store.freed_memory import share_arenas
from sorvolo.store.site.archive import Archive
from sorvolo.store.site.catalogue_place import is_site
from sorvolo.store.site.change_records import stored_changes
from sorvolo.survey.findings import CompareUpdate
from sorvolo.survey.flight import Site
from sorvolo.survey.mosaic import FrameView, MosaicUpdate
from sorvolo.survey.wording import counted_list

if TYPE_CHECKING:
    from sorvolo.missions.search.while_flying import SearchWhileFlying
    from sorvolo.missions.watch.run import EarlyFound, WatchUpdate
    from sorvolo.tracking.image_motion import PictureStep

FINISHED, FAILED, STOPPED = "run.finished", "run.failed", "run.stopped"
"""The types of a journal's last line."""

_PROGRESS_EVERY_S = 0.25  # as often as a page shows it; by choice
_LIVE_S = 0.5  # how often the growing map is shown: a browser waits for it
_NICE = 5  # the server answers first
_WRONG, _STOPPED_CODE = 1, 130


class Journal:
    """The lines of a run: a JSON object each, whole once it can be read. Lines are added from any thread."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("ab")
        self._adding = threading.Lock()
        self._progress_s = -1e9
        self._newest_progress: Mapping[str, Any] | None = None  # that was not written yet

    def add(self, kind: str, data: Mapping[str, Any]) -> None:
        """Append one line and hand it to the operating system."""
        line = json.dumps(
            {"type": kind, "data": plain_json(data)}, ensure_ascii=False, allow_nan=False
        )
        with self._adding:
            self._file.write(line.encode() + b"\n")
            self._file.flush()

    def progress(self, data: Mapping[str, Any]) -> None:
        """How far the run is, a few times a second at most."""
        self._newest_progress = data
        if time.monotonic() - self._progress_s >= _PROGRESS_EVERY_S:
            self._write_progress()

    def end(self, kind: str, data: Mapping[str, Any]) -> None:
        """Append the last line, after how far the run came."""
        self._write_progress()
        self.add(kind, data)

    def _write_progress(self) -> None:
        self._progress_s = time.monotonic()
        if self._newest_progress is not None:
            self.add("run.progress", self._newest_progress)
        self._newest_progress = None


class _Stop:
    """The first signal ends a live source, whose flight is then finished; any other stops the mission."""

    def __init__(self, is_live: bool) -> None:
        self.until = threading.Event()
        self.why = ""  # it is stopped although nobody asked for that
        self.cuts_short = False  # a recorded flight was not searched to its end
        self._is_live = is_live
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._take)

    def at_once(self, why: str) -> None:
        """Stop the mission for a reason of its own; from any thread."""
        sys.stderr.write(f"{why}; stopped\n")  # the run's log
        self.why = why
        self.until.set()
        os.kill(os.getpid(), signal.SIGTERM)

    def _take(self, _: int, __: FrameType | None) -> None:
        if self._is_live and not self.until.is_set():
            self.until.set()
            return
        self.cuts_short = True
        raise KeyboardInterrupt


def main(folder: Path) -> int:
    """Do the order in a run's folder; the exit code: 0, 1 for an error that its journal states, 3 where the flight
    is incomplete, 130 stopped."""
    order, journal = Order.read(folder), Journal(folder / JOURNAL_FILE)
    stop = _Stop(is_live_address(order.source))
    try:
        with ended_when_orphaned(folder, order.run, stop.at_once):
            headline, why = _flown(order, folder, journal, stop.until)
    except KeyboardInterrupt:
        if stop.why:
            journal.end(
                FAILED,
                {"exit_code": _WRONG, "error": f"{stop.why}; nothing was kept", "headline": None},
            )
            return _WRONG
        journal.end(
            STOPPED,
            {"exit_code": _STOPPED_CODE, "error": None, "headline": "stopped; nothing was kept"},
        )
        return _STOPPED_CODE
    except Exception as error:
        orphaned = "" if (folder / ORDER_FILE).exists() else why_orphaned(folder, order.run)
        words = _words_of(error, orphaned, order.source)
        journal.end(
            FAILED,
            {"exit_code": _WRONG, "error": without_secret(words, order.source), "headline": None},
        )
        return _WRONG
    if stop.cuts_short:  # a watch keeps what it found
        headline = f"stopped before the flight's end: {headline}"
    if why:
        journal.end(
            FINISHED,
            {"exit_code": TO_CHECK, "error": None, "headline": f"incomplete: {why}. {headline}"},
        )
        return TO_CHECK
    journal.end(FINISHED, {"exit_code": 0, "error": None, "headline": headline})
    return 0


def _words_of(error: Exception, orphaned: str, source: str) -> str:
    """Why a mission failed; the details of a fault go into the run's log. Where its folder is gone, that is why."""
    if orphaned:
        sys.stderr.write(f"{orphaned}; stopped\n")
        return f"{orphaned}; nothing was kept"
    if isinstance(error, SorvoloError):
        return str(error)
    sys.stderr.write(without_secret(traceback.format_exc(), source))
    return (
        f"{error.strerror or error}"
        if isinstance(error, OSError)
        else f"{type(error).__name__}: {error}"
    )


def _flown(order: Order, folder: Path, journal: Journal, until: threading.Event) -> tuple[str, str]:
    """The headline of a mission that was done, and why its flight is incomplete ("": it is not).

    Raises what the mission raises; its words name what the flight lacks.
    """
    with camera_opened(order, folder, until) as camera:
        try:
            headline = _MISSIONS[order.mission](camera.order, journal, until)
        except SorvoloError as error:
            if not (why := cut_off(camera.order, was_stopped=until.is_set())):
                raise
            raise type(error)(f"{error}; the flight is incomplete: {why}") from error
        why = cut_off(camera.order, was_stopped=until.is_set())
    return headline, "; ".join(filter(None, (why, unsent(camera.left()))))


def _map(
    order: Order,
    journal: Journal,
    until: threading.Event,
    search: "SearchWhileFlying | None" = None,
) -> str:
    from sorvolo.missions.flight.settings import MapSettings
    from sorvolo.missions.map.flights import map_flights

    wish, site = order.choices, Path(order.site)
    settings = MapSettings(
        overlap=wish.overlap,
        m_per_px=wish.m_per_px,
        model=wish.model or "default",
        classes=tuple(wish.classes),
        live_s=_LIVE_S,
        ground_elevation_m=wish.ground_elevation_m,
    )
    before = _newest(site)
    updates = map_flights(
        [order.source],
        site,
        settings,
        telemetry=order.telemetry or None,
        camera=order.camera or None,
        live=_live(order, keeps_all=True),
        until=until,
        search=search,
    )
    with closing(updates):
        for update in updates:
            _placed(journal, update.view, update.frame_name, update.status.value)
            journal.progress(_map_progress(update))
    return _headline(site, before)


def _compare(order: Order, journal: Journal, until: threading.Event) -> str:
    from sorvolo.missions.compare.flights import compare_flights
    from sorvolo.missions.flight.settings import CompareSettings

    wish, site = order.choices, Path(order.site)
    settings = CompareSettings(
        views_per_second=wish.views_per_second,
        votes=wish.votes,
        voters=wish.voters,
        updates_map=wish.updates_map,
        model=wish.model or "default",
        ground_elevation_m=wish.ground_elevation_m,
        classes=tuple(wish.classes),
    )
    before = _newest(site)
    announced: dict[str, None] = {}  # their ids, in order
    with Archive.open(site, write=False) as archive:
        place = archive.site()
    updates = compare_flights(
        [order.source],
        site,
        settings,
        telemetry=order.telemetry or None,
        camera=order.camera or None,
        live=_live(order, keeps_all=True),
        until=until,
    )
    with closing(updates):
        for update in updates:
            _placed(journal, update.view, update.frame_name, update.status.value)
            announced |= dict.fromkeys(each.id for each in update.announced)
            _announce(journal, update, place)
            journal.progress(_compare_progress(update, len(announced)))
    with Archive.open(site, write=False) as archive:
        flights = {each.flight_id for each in archive.versions() if each.id > before}
        kept = {each.id for each in archive.changes() if each.flight_id in flights}
    for change_id in announced.keys() - kept:
        journal.add(
            "change.withdrawn", {"id": change_id, "why": "not confirmed by the whole flight"}
        )
    return _headline(site, before)


def _watch(order: Order, journal: Journal, until: threading.Event) -> str:
    from sorvolo.missions.watch.flights import watch
    from sorvolo.missions.watch.settings import WatchOutputs, WatchSettings

    wish = order.choices
    settings = WatchSettings(
        model=wish.model or "default",
        classes=tuple(wish.classes),
        least_score=wish.least_score,
        frames_per_second=wish.frames_per_second,
        ground_elevation_m=wish.ground_elevation_m,
    )
    counts: Mapping[str, int] = {}
    updates = watch(
        order.source,
        settings,
        WatchOutputs(Path(order.folder)),
        telemetry=order.telemetry or None,
        camera=order.camera or None,
        live=_live(order),
        until=until,
        moved=partial(_moved, journal, order.stream) if order.stream else None,
        early=partial(_seen_early, journal, order.stream) if order.stream else None,
    )
    with closing(updates):
        for update in updates:
            _placed(journal, update.view, update.frame_name, "watched")
            _seen(journal, update, order.stream)
            counts = update.counts
            journal.progress(
                {
                    "frames": update.frames_read,
                    "frames_expected": update.frames_expected or None,
                    "searched": update.frames_detected,
                    "objects": dict(counts),
                    "seconds": update.seconds,
                    "latency_s": update.latency_s,
                    "frames_per_second": _rate(update.frames_detected, update.seconds),
                }
            )
    return f"{counted_list(counts)} found"


def _search(order: Order, journal: Journal, until: threading.Event) -> str:
    from sorvolo.missions.search.flights import search_site
    from sorvolo.missions.search.settings import SearchOutputs, SearchSettings
    from sorvolo.missions.search.while_flying import SearchWhileFlying

    wish = order.choices
    settings = SearchSettings(
        plants=wish.plants, classes=tuple(wish.classes), model=wish.model or "default"
    )
    outputs = SearchOutputs(Path(order.folder))
    if order.source:  # a flight to map first; one in the air is measured meanwhile
        _map(order, journal, until, SearchWhileFlying(settings, outputs))
    report: Mapping[str, Any] = {}
    with closing(search_site(Path(order.site), settings, outputs)) as measuring:
        for each in measuring:
            if isinstance(each, dict):
                report = each
                continue
            journal.progress(
                {
                    "frames": each.done,
                    "frames_expected": each.total,
                    "found": each.found,
                    "planted": each.planted,
                    "flight": each.flight,
                }
            )
    return str((report.get("headline") or {}).get("text", "measured"))


_MISSIONS = {"map": _map, "compare": _compare, "watch": _watch, "search": _search}


def _live(order: Order, *, keeps_all: bool = False) -> LiveSettings:
    """How a live source is read: a drone that sends to this station comes back, and states when its flight is over."""
    settings = LiveSettings(keeps_all=keeps_all)
    return replace(settings, give_up_s=order.away_s) if order.stream else settings


def _placed(journal: Journal, view: FrameView | None, name: str, status: str) -> None:
    """Write where a frame lies: its outline, its camera, which way its top points."""
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


def _announce(journal: Journal, update: CompareUpdate, site: Site) -> None:
    """Write each change that was announced just now; of a run that was killed, it has written them."""
    if update.is_resumed:
        return
    for change in update.announced:
        stored = stored_changes(change.id.rpartition("-")[0], [change])
        feature = changes_geojson(stored, on_earth(site))["features"][0]
        journal.add("change.announced", {"feature": feature})


def _seen(journal: Journal, update: "WatchUpdate", stream: str) -> None:
    """Write a frame's boxes, and each object that it confirmed; of a watch that was killed, it has written them."""
    if update.is_resumed:
        return
    journal.add(BOXES, _boxes(update, stream))
    if not update.new:
        return
    for feature in tracks_collection(list(update.new), update.site, {})["features"]:
        journal.add("object.found", {"feature": feature, "is_local": update.site.is_local})


def _seen_early(journal: Journal, stream: str, found: "EarlyFound") -> None:
    """Write the boxes of some classes, before the frame is searched for the others."""
    journal.add(BOXES, _boxes(found, stream) | {"classes": list(found.classes)})


def _boxes(seen: "WatchUpdate | EarlyFound", stream: str) -> dict[str, Any]:
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


def _moved(journal: Journal, stream: str, step: "PictureStep") -> None:
    """Write how the picture moved since a tenth of a second before; in the thread that reads the stream."""
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


def _map_progress(update: MosaicUpdate) -> dict[str, Any]:
    return {
        "frames": update.frames_read,
        "frames_expected": max(update.frames_expected, update.frames_read),
        "selected": update.keyframes,
        "matched": update.by_vision,
        "seconds": update.seconds,
        "frames_per_second": _rate(update.frames_read, update.seconds),
        "reason": update.reason or None,
    }


def _compare_progress(update: CompareUpdate, announced: int) -> dict[str, Any]:
    return {
        "frames": update.frames_read,
        "frames_expected": max(update.frames_expected, update.frames_read),
        "selected": update.views,
        "matched": update.compared,
        "changes": announced,
        "seconds": update.seconds,
        "frames_per_second": _rate(update.frames_read, update.seconds),
        "reason": update.reason or None,
    }


def _rate(frames: int, seconds: float) -> float | None:
    return round(frames / seconds, 2) if seconds > 0 else None


def _newest(site: Path) -> int:
    if not is_site(site):
        return 0
    with Archive.open(site, write=False) as archive:
        return max((each.id for each in archive.versions() if each.complete), default=0)


def _headline(site: Path, before: int) -> str:
    """The headlines of the flights that came since."""
    with Archive.open(site, write=False) as archive:
        flights = [
            each.flight_id for each in archive.versions() if each.complete and each.id > before
        ]
        texts = [_headline_of(archive.report(each)) for each in flights]
    return "; ".join(filter(None, texts)) or "finished"


def _headline_of(report: Mapping[str, Any]) -> str:
    """The headline of a flight's report, of its comparison where there is one; "" without any."""
    headline: Mapping[str, Any] = (report.get("comparison") or report).get("headline") or {}
    return str(headline.get("text") or "")


def _begin(folder: Path) -> int:
    """Take what a child must not have: the run's lock is open in this process alone, so that its end is seen."""
    lock = os.environ.pop(LOCK_VARIABLE, "")
    if lock.isdecimal():
        fcntl.fcntl(int(lock), fcntl.F_SETFD, fcntl.FD_CLOEXEC)
    os.nice(_NICE)
    share_arenas()
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    return main(folder)


if __name__ == "__main__":
    sys.exit(_begin(Path(sys.argv[1])))
