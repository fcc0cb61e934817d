"""One watch while it runs: each frame is searched, what was seen is placed and tracked, and those who want it told."""

import time
from collections.abc import Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from sorvolo.capture.sync import DATED_NS
from sorvolo.missions.flight.detects import Detects
from sorvolo.missions.flight.setup import FlightSetup
from sorvolo.missions.watch.alerts import Outbox, Pace, alert_command, alert_url
from sorvolo.missions.watch.cot_sender import CotSender, cot_place
from sorvolo.missions.watch.files import SeenFrame, WatchFiles
from sorvolo.missions.watch.places import Places
from sorvolo.missions.watch.report import WatchLog, build_watch_report, count_by_class, source_notices
from sorvolo.missions.watch.settings import WatchOutputs, WatchSettings
from sorvolo.store.atomic import atomic_write_bytes
from sorvolo.store.exports.cursor_on_target import cot_event, cot_removal, cot_type
from sorvolo.store.exports.detection_files import track_properties, write_detections_geojson
from sorvolo.store.exports.plain import json_bytes
from sorvolo.store.pages.watch import count_words, watch_page
from sorvolo.survey.flight import Frame, LostFrame, Notice, Site
from sorvolo.survey.objects import Detections, Sighting, Track

_LAST_ALERTS_S, _LAST_EVENTS_S = 35.0, 5.0  # how long the end waits for what is still on its way


@dataclass(frozen=True, eq=False)
class WatchUpdate:
    """What one searched frame brought.

    `detections` are all of the frame's; `sightings` those that have a place; `new` the tracks that this frame
    confirmed, `tracks` all confirmed ones that it saw. `counts` are the objects so far, by class. `latency_s` is from
    a live frame's arrival to this update, and of a recorded one how long it took. `frames_expected` is 0 for a live
    source. Places are metres of `site`; where it is local, pixels of the first frame of their `segment`, which counts
    from 1.
    """

    frame_name: str
    time_ns: int
    detections: Detections
    sightings: Sequence[Sighting]
    new: Sequence[Track]
    tracks: Sequence[Track]
    counts: Mapping[str, int]
    latency_s: float
    frames_read: int
    frames_detected: int
    frames_expected: int
    seconds: float
    folder: Path
    site: Site
    segment: int


class WatchRun:
    """One watch. A context manager; `finish` writes what is known at the end, however the watch ended."""

    def __init__(
        self, setup: FlightSetup, places: Places, detector: Detects, settings: WatchSettings, outputs: WatchOutputs,
        folder: Path,
    ) -> None:
        self._setup, self._places, self._detector = setup, places, detector
        self._settings, self._outputs, self._folder = settings, outputs, folder
        self.log = WatchLog()
        self._stack = ExitStack()
        self._files = self._stack.enter_context(WatchFiles(folder, outputs, places.site))
        self._teller = Teller(setup.source.name, setup.source.fingerprint, places.site, outputs, folder)
        self._stack.callback(self._teller.close, 0.0, 0.0)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.close()

    def lose(self, lost: LostFrame) -> None:
        """A frame that cannot be used."""
        self.log.read = lost.index + 1
        self.log.lost[lost.reason] += 1

    def add(self, frame: Frame, arrived_s: float) -> WatchUpdate:
        """Search one frame, whose turn came at `arrived_s` of the monotonic clock, and take in what it shows."""
        log, settings = self.log, self._settings
        log.read = frame.index + 1
        time_ns = self._utc_ns(frame)
        with log.stage("detect"):
            found = self._detector.detect(
                frame.image, tiles=settings.tiles, m_per_px=self._places.m_per_px(frame),
                least_score=settings.least_score, classes=settings.classes or None,
            )
        with log.stage("track"):
            taken = self._places.take(frame, time_ns, found)
        placed = 0 if self._places.site.is_local else sum(each is not None for each in taken.sightings)
        log.searched(time_ns, found, placed)
        confirmed = [track for track in self._places.tracks() if track.confirmed]
        counts = count_by_class(confirmed)
        with log.stage("hand over"):
            self._files.add(SeenFrame(
                frame, time_ns, found, taken.sightings, taken.track_ids, frozenset(each.id for each in confirmed),
                f"frame {frame.name}, counted so far: {count_words(counts)}", taken.segment,
            ))
            seen_ids = set(taken.track_ids)
            seen = [track for track in confirmed if track.id in seen_ids]
            for track in seen:
                self._files.crop_of(track)
            new = [track for track in confirmed if track.id in taken.new_ids]
            self._files.forget(taken.merged)
            self._teller.tell(new, seen, self._files.crop_names, taken.segment)
            self._teller.take_back(taken.merged)
            self._files.show(confirmed)
        latency_s = time.monotonic() - arrived_s
        log.latency_s.append(latency_s)
        source = self._setup.source
        return WatchUpdate(
            frame.name, time_ns, found, [each for each in taken.sightings if each is not None], new, seen, counts,
            latency_s, log.read, log.detected, source.frame_count, log.seconds, self._folder,
            self._places.site, taken.segment,
        )

    def finish(self, *, ended: str, skipped: int) -> None:
        """The last word on every track, the files for other programs, and the report."""
        with self.log.stage("finish"):
            tracks = [track for track in self._places.finish() if track.confirmed]
            for track in tracks:
                self._files.crop_of(track)
            self._files.close()
            self._teller.tell_finally(tracks)
            self._teller.close(_LAST_ALERTS_S, _LAST_EVENTS_S)
            self._files.clear()
            site, crop_names = self._places.site, self._files.crop_names
            write_detections_geojson(self._folder, site)
            rows = self._files.write_tracks(tracks)
        notices = (
            *self._places.notices(), *self._detector.notices, *source_notices(self._setup.source, self.log),
            *self._teller.notices(),
        )
        self.log.wall_s["write, beside the rest"] = self._files.seconds
        report = build_watch_report(
            self._setup, self._settings, self._outputs, self._detector.info, self._detector.provider, self.log, tracks,
            notices, self._warnings(tracks), ended=ended, skipped=skipped,
            set_aside=self._places.set_aside, on_ground=not site.is_local,
        )
        crops = {track_id: (self._folder / name).read_bytes() for track_id, name in crop_names.items()}
        atomic_write_bytes(self._folder / "report.json", json_bytes(report))
        page = watch_page(report, rows, crops, self._places.path_m())
        atomic_write_bytes(self._folder / "report.html", page.encode())

    def _utc_ns(self, frame: Frame) -> int:
        """A frame's UTC by telemetry's clock; by its own where telemetry's was never set."""
        time_ns = self._setup.utc_ns(frame.time_ns)
        return time_ns if time_ns >= DATED_NS else frame.time_ns

    def _warnings(self, tracks: Sequence[Track]) -> list[str]:
        warnings = []
        total = sum(self.log.found.values()) - self._places.set_aside
        if not self._places.site.is_local and total and self.log.placed < 0.5 * total:
            warnings.append(
                f"{total - self.log.placed} of {total} detections have no place on the ground and are in no track; "
                "the notices say why"
            )
        if not self._places.site.is_local and self._setup.source.camera.focal_sigma > 0.1:
            warnings.append(f"camera: {self._setup.source.camera.origin}; until then places are some percent off")
        far = [track for track in tracks if track.sigma_m > 10] if not self._places.site.is_local else []
        if far:
            warnings.append(
                f"{len(far)} of {len(tracks)} objects are placed to more than 10 m only; telemetry with the camera's "
                "angles would place them better"
            )
        return warnings


class Teller:
    """Whom a watch tells of its tracks: a TAK server, a command, a URL, each through an outbox of its own."""

    def __init__(self, flight: str, fingerprint: str, site: Site, outputs: WatchOutputs, folder: Path) -> None:
        self._flight, self._uid = flight, f"sorvolo.{flight}.{fingerprint[:8]}"
        self._site, self._outputs, self._folder = site, outputs, folder
        self._pace = Pace(outputs.cot_every_s)
        self._told_types: dict[int, str] = {}
        self._cot: Outbox[bytes] | None = None
        self._sender: CotSender | None = None
        self._alerts: list[Outbox[Mapping[str, Any]]] = []
        if outputs.cot and not site.is_local:
            self._sender = CotSender(cot_place(outputs.cot))
            self._cot = Outbox(self._sender.send, code="cot", what=f"telling {outputs.cot}")
        if outputs.alert_command:
            run = alert_command(outputs.alert_command)
            self._alerts.append(Outbox(run, code="alert_command", what="the alert command"))
        if outputs.alert_url:
            post = alert_url(outputs.alert_url)
            self._alerts.append(Outbox(post, code="alert_url", what=f"the alert to {outputs.alert_url}"))

    def tell(self, new: Sequence[Track], seen: Sequence[Track], crops: Mapping[int, str], segment: int) -> None:
        """Alert once of each new track; tell the TAK server of all that are seen, each at its pace."""
        of_segment = {"segment": segment} if self._site.is_local else {}
        for track in new:
            crop = crops.get(track.id)
            alert = {
                "flight": self._flight, **track_properties(track, self._site), **of_segment,
                "crop": None if crop is None else str((self._folder / crop).resolve()),
            }
            alert["time"] = alert["last_seen"]
            for outbox in self._alerts:
                outbox.put(alert)
        for track in seen:
            if self._cot is not None and self._pace.allows(track.id):
                self._told_types[track.id] = cot_type(track.label, self._outputs.cot_types)
                self._cot.put(self._event(track))

    def take_back(self, track_ids: Iterable[int]) -> None:
        """Tracks that turned out to be others leave the TAK server's map."""
        for track_id in track_ids:
            if self._cot is not None and track_id in self._told_types:
                uid, kind = f"{self._uid}.{track_id}", self._told_types.pop(track_id)
                self._cot.put(cot_removal(uid, type_=kind, now_ns=time.time_ns()))

    def tell_finally(self, tracks: Sequence[Track]) -> None:
        """The TAK server gets each track's last place."""
        if self._cot is not None:
            for track in tracks:
                self._cot.put(self._event(track))

    def close(self, alerts_s: float, events_s: float) -> None:
        """Wait until all is told, at most so long for the alerts and for the TAK server."""
        for outbox in self._alerts:
            outbox.close(alerts_s)
        if self._cot is not None and self._sender is not None:
            self._cot.close(events_s)
            self._sender.close()

    def notices(self) -> tuple[Notice, ...]:
        """What could not be told, and what was never going to be."""
        found: list[Notice] = []
        if self._outputs.cot and self._cot is None:
            text = f"nothing places this flight on Earth, so nothing was told to {self._outputs.cot}"
            found.append(Notice("cot_without_place", 1, text))
        for outbox in self._alerts:
            found += outbox.notices()
        return (*found, *(self._cot.notices() if self._cot is not None else ()))

    def _event(self, track: Track) -> bytes:
        return cot_event(
            track, self._site, uid=f"{self._uid}.{track.id}", now_ns=time.time_ns(),
            stale_s=self._outputs.cot_stale_s, types=self._outputs.cot_types,
        )
