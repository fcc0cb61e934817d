"""One watch while it runs: each frame is searched, detections are placed and tracked, new objects reported."""

import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from types import TracebackType
from typing import Self

from sorvolo.capture.sync import DATED_NS
from sorvolo.detection.scene import SceneMagnifier
from sorvolo.detection.tiling import whole_m_per_px
from sorvolo.geometry.arrays import ImageRGB
from sorvolo.missions.flight.detector_protocol import ObjectDetector
from sorvolo.missions.flight.setup import FlightSetup
from sorvolo.missions.watch.alerts import interpreted_placeholder, interpreted_words
from sorvolo.missions.watch.files import SeenFrame, WatchFiles
from sorvolo.missions.watch.journal import LookedModel, SearchedFrame, WatchJournal
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
from sorvolo.tracking.following import Taken

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

    `journal` notes what is detected and sent, and has what a killed watch noted. `early` is given what is found in a
    frame before the frame's update.
    """

    def __init__(
        self,
        setup: FlightSetup,
        places: Places,
        detector: ObjectDetector,
        settings: WatchSettings,
        outputs: WatchOutputs,
        folder: Path,
        journal: WatchJournal,
        early: Callable[[EarlyFound], None] | None = None,
    ) -> None:
        self._journal, self._early = journal, early
        self._setup, self._places, self._detector = setup, places, detector
        self._settings, self._outputs, self._folder = settings, outputs, folder
        self._classes = settings.classes or detector.info.usual_classes
        self._magnifier = SceneMagnifier(detector.info, self._classes)
        self._others = list(
            journal.models
        )  # that looked besides it, in the order of their first looks
        self._looks_before = {
            info.name: count for info, count in detector.others
        }  # at another flight's pictures
        self.log = WatchLog()
        self._stack = ExitStack()
        self._files = self._stack.enter_context(WatchFiles(folder, outputs, places.site))
        self._notifier = Notifier(
            setup.source.name, setup.source.fingerprint, places.site, outputs, folder, journal
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

    def _found(self, frame: Frame, arrived_s: float) -> tuple[SearchedFrame, bool]:
        """What is detected in a frame, and whether a watch that was killed had detected it."""
        earlier = self._journal.next_frame(frame.index)
        with self.log.stage("detect"):
            return self._searched(frame, earlier, arrived_s), earlier is not None

    def _searched(
        self, frame: Frame, earlier: SearchedFrame | None, arrived_s: float
    ) -> SearchedFrame:
        """What the detector finds in a frame; where nothing places the flight, at the scale that its scene shows.

        `earlier` is what it found in a watch that was killed, which is taken in its place.
        """
        settings, classes = self._settings, self._classes
        magnifier = (
            self._magnifier if settings.tiles == "auto" and self._places.site.is_local else None
        )
        m_per_px = self._places.m_per_px(frame)
        looks: list[Detections] = []

        def look(part: ImageRGB) -> Detections:
            known = None if earlier is None else earlier.looks[len(looks)]
            looks.append(
                self._detector.detect(part, classes=classes, is_part=True)
                if known is None
                else known
            )
            return looks[-1]

        def known(names: tuple[str, ...], found: Detections) -> None:
            if self._early is not None:
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

        if magnifier is not None:
            m_per_px = magnifier.m_per_px(frame.image, look)
        overlapping = self._setup.source.kind != "photos"
        if m_per_px is not None and overlapping:
            m_per_px = whole_m_per_px(self._detector.info, classes, m_per_px, frame.image.shape[:2])
        found = (
            self._detector.detect(
                frame.image,
                tiles=settings.tiles,
                m_per_px=m_per_px,
                least_score=settings.least_score,
                classes=classes,
                from_above=self._places.is_from_above(frame),
                overlapping=overlapping,
                early=None if self._early is None else known,
            )
            if earlier is None
            else earlier.found
        )
        if magnifier is not None:
            magnifier.see(found, frame.image)
        size_px = frame.image.shape[0], frame.image.shape[1]
        return SearchedFrame(
            frame.index, frame.name, frame.time_ns, found, tuple(looks), None, size_px
        )

    def lose(self, lost: LostFrame) -> None:
        """A frame that cannot be used."""
        self.log.read = lost.index + 1
        self.log.lost[lost.reason] += 1

    def add(self, frame: Frame, arrived_s: float) -> WatchUpdate:
        """Search one frame, whose turn came at `arrived_s` of the monotonic clock, and take in what it shows."""
        self.log.read = frame.index + 1
        time_ns = utc_ns(self._setup, frame.time_ns)
        searched, is_resumed = self._found(frame, arrived_s)
        with self.log.stage("track"):
            taken = self._places.take(frame, time_ns, searched.found)
        if not is_resumed:
            self._note_others()
            self._journal.keep_frame(
                replace(searched, located=taken.located if self._journal.is_live else None)
            )
        return self._update(frame, time_ns, searched, taken, arrived_s, is_resumed=is_resumed)

    def _note_others(self) -> None:
        """Note each model that looked at a picture for the first time."""
        known = {each.facts["name"] for each in self._others}
        for info, count in self._detector.others:
            if info.name not in known and count > self._looks_before.get(info.name, 0):
                each = LookedModel(model_facts(info))
                self._journal.keep_model(each)
                self._others.append(each)

    def recall(self, searched: SearchedFrame) -> WatchUpdate:
        """Take in a frame of a live source that a watch that was killed had searched, as far as its picture is not
        needed."""
        assert searched.located is not None  # of a live source they are noted
        self.log.read = searched.index + 1
        taken = self._places.recall(searched.located, searched.found, searched.size_px)
        frame = Frame.unseen(searched.index, searched.name, searched.time_ns)
        return self._update(
            frame, searched.located.time_ns, searched, taken, time.monotonic(), is_resumed=True
        )

    def _update(
        self,
        frame: Frame,
        time_ns: int,
        searched: SearchedFrame,
        taken: Taken,
        arrived_s: float,
        *,
        is_resumed: bool,
    ) -> WatchUpdate:
        """Hand over what a frame brought."""
        log, found, size_px = self.log, searched.found, searched.size_px
        sighted = [each for each in taken.sightings if each is not None]
        tracks = self._tracks_after(taken)
        log.searched(time_ns, found, 0 if self._places.site.is_local else len(sighted))
        with log.stage("hand over"):
            self._write(
                SeenFrame(
                    frame,
                    time_ns,
                    found,
                    taken.sightings,
                    taken.track_ids,
                    frozenset(each.id for each in tracks.confirmed),
                    f"frame {frame.name}, counted so far: {counted_list(tracks.counts)}",
                    taken.segment,
                ),
                size_px,
                [*tracks.seen, *tracks.new],
            )
            self._hand_over(taken, tracks, is_resumed=is_resumed)
        latency_s = time.monotonic() - arrived_s
        if not is_resumed:
            log.latency_s.append(latency_s)
        source = self._setup.source
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
            size_px[::-1],
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

    def _write(self, written: SeenFrame, size_px: tuple[int, int], shown: Sequence[Track]) -> None:
        """Write a frame's part of the files; of one whose picture is not there any more, what does without it."""
        if written.frame.image.size:
            self._files.add(written)
        else:
            self._files.recall(written, size_px)
            self._files.recall_crops(shown)

    def _hand_over(self, taken: Taken, tracks: "_Tracks", *, is_resumed: bool) -> None:
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
            is_resumed=is_resumed,
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
            others=[each.facts for each in self._others],
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
        self._journal.file.remove()

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
