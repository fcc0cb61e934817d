"""One watch while it runs: each frame is searched, detections are placed and tracked, new objects reported."""

import itertools
import json
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from sorvolo.capture.sync import DATED_NS
from sorvolo.detection.scene import SceneMagnifier
from sorvolo.detection.tiling import whole_m_per_px
from sorvolo.geometry.arrays import ImageRGB
from sorvolo.missions.flight.detector_protocol import ObjectDetector
from sorvolo.missions.flight.result_cache import ResultCache
from sorvolo.missions.flight.setup import FlightSetup
from sorvolo.missions.watch.alerts import interpreted_placeholder, interpreted_words
from sorvolo.missions.watch.files import SeenFrame, WatchFiles
from sorvolo.missions.watch.notifier import Notifier
from sorvolo.missions.watch.places import Places
from sorvolo.missions.watch.report import (
    WatchLog,
    build_watch_report,
    count_by_class,
    model_facts,
    source_notices,
)
from sorvolo.missions.watch.settings import WatchOutputs, WatchSettings
from sorvolo.store.atomic import atomic_write_bytes
from sorvolo.store.exports.detection_files import write_detections
from sorvolo.store.exports.plain import json_bytes
from sorvolo.store.pages.watch import watch_page
from sorvolo.survey.flight import Frame, LostFrame, Site
from sorvolo.survey.mosaic import FrameView
from sorvolo.survey.objects import Detections, Sighting, Track
from sorvolo.survey.wording import counted_list
from sorvolo.tracking.following import Located, Taken

_LAST_ALERTS_S, _LAST_EVENTS_S = 35.0, 5.0  # how long the end waits for what is still on its way


@dataclass(frozen=True, eq=False)
class EarlyFound:
    """All that a frame shows of some `classes`, while it is still searched for others. Fields as of WatchUpdate."""

    frame_name: str
    time_ns: int
    classes: tuple[str, ...]
    detections: Detections
    latency_s: float
    size_px: tuple[int, int]
    clip_ns: int


@dataclass(frozen=True, eq=False)
class WatchUpdate:
    """What one searched frame brought.

    `detections` are all of the frame's; `sightings` those that have a place; `new` the tracks that this frame
    confirmed, `tracks` all confirmed ones that it saw. `counts` are the objects so far, by class. `latency_s` is from
    a live frame's arrival to this update, and of a recorded one how long it took. `frames_expected` is 0 for a live
    source. `size_px` is the frame's width and height, `clip_ns` its time after the source's first frame, `view` what
    ground it shows by telemetry. Places are metres of `site`; where it is local, pixels of the first frame of their
    `segment`, which counts from 1.
    `is_resumed`: a watch that was killed had searched the frame.
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
    size_px: tuple[int, int]
    clip_ns: int
    view: FrameView | None
    is_resumed: bool


def utc_ns(setup: FlightSetup, frame_ns: int) -> int:
    """A frame's UTC by telemetry's clock; by its own where telemetry's was never set."""
    time_ns = setup.utc_ns(frame_ns)
    return time_ns if time_ns >= DATED_NS else frame_ns


@dataclass(frozen=True, eq=False)
class _Tracks:
    """All tracks after a frame, the confirmed ones, those of them that it shows, and those that it confirmed."""

    known: Sequence[Track]
    confirmed: Sequence[Track]
    seen: Sequence[Track]
    new: Sequence[Track]

    @property
    def counts(self) -> dict[str, int]:
        """How many there are of each class."""
        return count_by_class(self.confirmed)


class WatchRun:
    """One watch. A context manager; `finish` writes what is known at the end, however the watch ended.

    `memo` has what a killed watch found and sent. `early` is given what is found in a frame before the frame's update.
    """

    def __init__(
        self,
        setup: FlightSetup,
        places: Places,
        detector: ObjectDetector,
        settings: WatchSettings,
        outputs: WatchOutputs,
        folder: Path,
        memo: ResultCache,
        early: Callable[[EarlyFound], None] | None = None,
    ) -> None:
        self._memo, self._early = memo, early
        self._setup, self._places, self._detector = setup, places, detector
        self._settings, self._outputs, self._folder = settings, outputs, folder
        self._classes = settings.classes or detector.info.usual_classes
        self._magnifier = SceneMagnifier(detector.info, self._classes)
        self._others: dict[
            str, dict[str, Any]
        ] = {}  # facts of models that looked besides it, by name
        self._looks_before = {
            info.name: count for info, count in detector.others
        }  # at another flight's pictures
        self.log = WatchLog()
        self._stack = ExitStack()
        self._files = self._stack.enter_context(WatchFiles(folder, outputs, places.site))
        self._notifier = Notifier(
            setup.source.name, setup.source.fingerprint, places.site, outputs, folder, memo
        )
        self._stack.callback(self._notifier.close, 0.0, 0.0)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._stack.close()

    def _found(self, frame: Frame, arrived_s: float) -> Detections:
        """Return what the detector finds in a frame; where nothing places the flight, at the scale its scene shows."""
        settings, classes, memo = self._settings, self._classes, self._memo
        is_scaled = settings.tiles == "auto" and self._places.site.is_local and frame.image.size > 0
        m_per_px, looks = self._places.m_per_px(frame), itertools.count()

        def look(part: ImageRGB) -> Detections:
            return memo.of(
                frame,
                f"look {next(looks)}",
                Detections,
                lambda: self._detector.detect(part, classes=classes, is_part=True),
            )

        def early(names: tuple[str, ...], found: Detections) -> None:
            assert self._early is not None
            self._early(
                EarlyFound(
                    frame.name,
                    utc_ns(self._setup, frame.time_ns),
                    names,
                    found,
                    time.monotonic() - arrived_s,
                    frame.image.shape[1::-1],
                    frame.time_ns - self._setup.source.start_ns,
                )
            )

        if is_scaled:
            m_per_px = self._magnifier.m_per_px(frame.image, look)
        overlapping = self._setup.source.kind != "photos"
        if m_per_px is not None and overlapping:
            m_per_px = whole_m_per_px(self._detector.info, classes, m_per_px, frame.image.shape[:2])
        found = memo.of(
            frame,
            "found",
            Detections,
            lambda: self._detector.detect(
                frame.image,
                tiles=settings.tiles,
                m_per_px=m_per_px,
                least_score=settings.least_score,
                classes=classes,
                from_above=self._places.is_from_above(frame),
                overlapping=overlapping,
                early=None if self._early is None else early,
            ),
        )
        if is_scaled:
            self._magnifier.see(found, frame.image)
        for facts in memo.of(frame, "other models", tuple[str, ...], self._looked_first):
            model = json.loads(facts)
            self._others.setdefault(model["name"], model)
        return found

    def _looked_first(self) -> tuple[str, ...]:
        """Return the facts, as JSON, of models that looked at a picture for the first time."""
        return tuple(
            json.dumps(model_facts(info))
            for info, count in self._detector.others
            if info.name not in self._others and count > self._looks_before.get(info.name, 0)
        )

    def lose(self, lost: LostFrame) -> None:
        """A frame that cannot be used."""
        self.log.read = lost.index + 1
        self.log.lost[lost.reason] += 1

    def add(self, frame: Frame, arrived_s: float) -> WatchUpdate:
        """Search one frame, whose turn came at `arrived_s` of the monotonic clock, and take in what it shows."""
        log, memo, source = self.log, self._memo, self._setup.source
        log.read = frame.index + 1
        is_resumed = memo.has_ended(frame.index)
        with log.stage("detect"):
            found = self._found(frame, arrived_s)
        # a stream's pictures are not there any more, so where its detections lie is kept as well
        located = memo.known(frame.index, "located", Located) if memo.is_of_stream else None
        time_ns = utc_ns(self._setup, frame.time_ns) if located is None else located.time_ns
        with log.stage("track"):
            taken = self._places.take(frame, time_ns, found, located)
        if not is_resumed:
            if memo.is_of_stream:
                memo.keep(frame, "located", taken.located)
            memo.end_frame(frame, keeps_picture=False)
        sighted = [each for each in taken.sightings if each is not None]
        tracks = self._tracks_after(taken)
        log.searched(time_ns, found, 0 if self._places.site.is_local else len(sighted))
        with log.stage("hand over"):
            self._files.add(
                SeenFrame(
                    frame,
                    time_ns,
                    found,
                    taken.sightings,
                    taken.track_ids,
                    frozenset(each.id for each in tracks.confirmed),
                    f"frame {frame.name}, counted so far: {counted_list(tracks.counts)}",
                    taken.segment,
                )
            )
            self._hand_over(taken, tracks)
        latency_s = time.monotonic() - arrived_s
        if not is_resumed:
            log.latency_s.append(latency_s)
        return WatchUpdate(
            frame.name,
            time_ns,
            found,
            sighted,
            tracks.new,
            tracks.seen,
            tracks.counts,
            latency_s,
            log.read,
            log.detected,
            source.frame_count,
            log.seconds,
            self._folder,
            self._places.site,
            taken.segment,
            frame.image.shape[1::-1],
            frame.time_ns - source.start_ns,
            self._places.view(frame),
            is_resumed,
        )

    def _tracks_after(self, taken: Taken) -> "_Tracks":
        known = self._places.tracks()
        confirmed = [track for track in known if track.confirmed]
        seen = [track for track in confirmed if track.id in set(taken.track_ids)]
        return _Tracks(
            known, confirmed, seen, [each for each in confirmed if each.id in taken.new_ids]
        )

    def _hand_over(self, taken: Taken, tracks: "_Tracks") -> None:
        """Crops, reports and withdrawals of one frame, and the files that show all tracks so far."""
        for track in (*tracks.seen, *tracks.new):
            self._files.crop_of(track)
        self._files.forget(taken.merged)
        self._files.keep_crops_of(tracks.known)
        self._notifier.report(
            tracks.new,
            tracks.seen,
            self._files.crop_names,
            self._files.segments,
        )
        self._notifier.withdraw(taken.merged)
        self._files.show(tracks.confirmed)

    def finish(self, *, ended: str, skipped: int) -> None:
        """The last word on every track, the files for other programs, and the report."""
        with self.log.stage("finish"):
            known = {track.id for track in self._places.tracks() if track.confirmed}
            tracks = [track for track in self._places.finish() if track.confirmed]
            for track in tracks:
                self._files.crop_of(track)
            self._files.close()
            late = [track for track in tracks if track.id not in known]
            self._notifier.report(late, [], self._files.crop_names, self._files.segments)
            self._notifier.report_final(tracks)
            self._notifier.close(_LAST_ALERTS_S, _LAST_EVENTS_S)
            self._files.clear()
            site, crop_names = self._places.site, self._files.crop_names
            write_detections(self._folder, site)
            rows = self._files.write_tracks(tracks)
        notices = (
            *self._places.notices(),
            *self._detector.notices,
            *source_notices(self._setup.source, self.log),
            *self._notifier.notices(),
        )
        self.log.wall_s["write, beside the rest"] = self._files.seconds
        report = build_watch_report(
            self._setup,
            self._settings,
            self._outputs,
            self._detector,
            self.log,
            tracks,
            notices,
            self._warnings(tracks),
            looked_for=self._classes,
            others=list(self._others.values()),
            ended=ended,
            skipped=skipped,
            set_aside=self._places.set_aside,
            on_ground=not site.is_local,
        )
        crops = {
            track_id: (self._folder / name).read_bytes() for track_id, name in crop_names.items()
        }
        atomic_write_bytes(self._folder / "report.json", json_bytes(report))
        page = watch_page(report, rows, crops, self._places.path_m())
        atomic_write_bytes(self._folder / "report.html", page.encode())
        self._memo.end(None)

    def _warnings(self, tracks: Sequence[Track]) -> list[str]:
        warnings = []
        if name := interpreted_placeholder(self._outputs.alert_command):
            warnings.append(interpreted_words(name))
        return warnings if self._places.site.is_local else warnings + self._place_warnings(tracks)

    def _place_warnings(self, tracks: Sequence[Track]) -> list[str]:
        """What makes places on the ground few or inaccurate."""
        warnings = []
        total = sum(self.log.found.values()) - self._places.set_aside
        if total and self.log.placed < 0.5 * total:
            warnings.append(
                f"{total - self.log.placed} of {total} detections have no place on the ground and are in no track; "
                "the notices state why"
            )
        if self._setup.source.camera.focal_sigma > 0.1:
            warnings.append(
                f"camera: {self._setup.source.camera.origin}; until then places are some percent off"
            )
        far = [track for track in tracks if track.sigma_m > 10]
        if far:
            warnings.append(
                f"{len(far)} of {len(tracks)} objects are placed to more than 10 m only; telemetry with the camera's "
                "angles would place them better"
            )
        return warnings
