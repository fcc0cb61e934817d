"""One watch while it runs: each frame is searched, detections are placed and tracked, new objects reported."""

import itertools
import json
import math
import statistics
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Self

from sorvolo.capture.live.stream import BEGUN_LATE
from sorvolo.capture.sync import DATED_NS
from sorvolo.detection.contract import ModelInfo
from sorvolo.detection.scene import SceneMagnifier
from sorvolo.detection.tiling import whole_m_per_px
from sorvolo.geometry.arrays import ImageRGB, PointsM
from sorvolo.geometry.coordinates import Coordinates, place_text
from sorvolo.missions.flight.detector_protocol import ObjectDetector
from sorvolo.missions.flight.looked_at import LookedAt, ground_for, looked_at, searched_document
from sorvolo.missions.flight.report import (
    camera_facts,
    peak_memory_mb,
    report_head,
    telemetry_facts,
)
from sorvolo.missions.flight.request import software
from sorvolo.missions.flight.result_cache import ResultCache
from sorvolo.missions.flight.setup import FlightSetup
from sorvolo.missions.watch.alerts import interpreted_placeholder, interpreted_words
from sorvolo.missions.watch.announced import Announced, SightingKey, sighting_key
from sorvolo.missions.watch.files import SeenFrame, WatchFiles
from sorvolo.missions.watch.notifier import Notifier
from sorvolo.missions.watch.places import CONTRADICTED, Places
from sorvolo.missions.watch.settings import WatchOutputs, WatchSettings
from sorvolo.missions.watch.through_trees import ThroughTrees
from sorvolo.search.looked_ground import near_ground
from sorvolo.store.atomic import atomic_write_bytes
from sorvolo.store.exports.detection_files import write_detections
from sorvolo.store.exports.plain import json_bytes, utc_text
from sorvolo.store.pages.watch import watch_page
from sorvolo.survey.flight import Frame, LostFrame, Notice, Site
from sorvolo.survey.mosaic import FrameView
from sorvolo.survey.objects import Detections, Sighting, Track
from sorvolo.survey.wording import counted, counted_list, most_first
from sorvolo.tracking.following import Located

# notices of sources about frames that cannot be used: left out where the reasons are reported
_OF_LOST_FRAMES = (
    "unreadable_photo",
    "corrupt_photo",
    "duplicate_photo",
    "other_size",
    "other_shape",
)


@dataclass
class WatchLog:
    """Frames, detections and times of one watch as they happen."""

    read: int = 0  # frames that the source went past
    detected: int = 0  # frames searched
    with_detections: int = 0
    lost: Counter[str] = field(default_factory=Counter)  # reasons of frames that cannot be used
    found: Counter[str] = field(default_factory=Counter)  # detections by class
    placed: Counter[str] = field(default_factory=Counter)  # detections with a place, by class
    latency_s: list[float] = field(default_factory=list)
    asked: int = 0  # frames that were to be searched
    unkept: int = 0  # of a live flight, for want of disk
    first_ns: int = -1
    last_ns: int = -1
    wall_s: dict[str, float] = field(default_factory=dict)
    started_s: float = field(default_factory=time.monotonic)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Count the wall seconds of a block."""
        started_s = time.monotonic()
        try:
            yield
        finally:
            self.wall_s[name] = self.wall_s.get(name, 0.0) + time.monotonic() - started_s

    def searched(self, time_ns: int, found: Detections, placed: Sequence[Sighting]) -> None:
        """Count one frame that was searched."""
        self.detected += 1
        self.with_detections += len(found) > 0
        self.found.update(found.names)
        self.placed.update(each.label for each in placed)
        self.first_ns = time_ns if self.first_ns < 0 else self.first_ns
        self.last_ns = time_ns

    def again(self) -> "WatchLog":
        """The log of the same flight, which is searched again from its first frame."""
        return WatchLog(
            self.read,
            lost=self.lost,
            latency_s=self.latency_s,
            asked=self.asked,
            unkept=self.unkept,
            wall_s=self.wall_s,
            started_s=self.started_s,
        )

    @property
    def seconds(self) -> float:
        """Since the watch began."""
        return time.monotonic() - self.started_s


def found_words(
    track: Track, site: Site, form: Coordinates = Coordinates.LATLON
) -> tuple[str, str]:
    """A new object's name, and where it is (none of a local site) and how sure that is."""
    name, seen = (
        f"{track.label} {track.id}",
        f"score {track.score:.2f}, {counted(track.views, 'view')}",
    )
    if site.is_local:
        return name, seen
    latitude, longitude, _ = site.frame.wgs84_from_site(track.position_m[None])
    place = place_text(float(latitude[0]), float(longitude[0]), form)
    return name, f"at {place} (accuracy {track.sigma_m:.1f} m), {seen}"


def count_by_class(tracks: Sequence[Track]) -> dict[str, int]:
    """How many confirmed tracks of each class, most first, equals by name."""
    return most_first(each.label for each in tracks if each.confirmed)


def model_facts(model: ModelInfo) -> dict[str, Any]:
    """What the report states of a model that looked at pictures."""
    return {
        "name": model.name,
        "version": model.version,
        "preset": model.preset,
        "precision": model.precision,
        "classes": list(model.classes),
        "thresholds": dict(model.thresholds),
        "calibrated": list(model.calibration),
        "licence": model.licence,
        "trained_on": model.trained_on,
        "created": model.created,
    }


_UNCOUNTED = "uncounted"
_FEW = 2  # detections of a video that a false alarm may make; by choice
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
    a live frame's arrival to this update, and of a recorded one how long it took. `frames_asked` were to be searched so
    far; `frames_expected` is 0 for a live source. `size_px` is the frame's width and height, `clip_ns` its time after the source's first frame, `view` what
    ground it shows by telemetry. Places are metres of `site`; where it is local, pixels of the first frame of their
    `segment`, which counts from 1.
    `is_resumed`: a watch that was killed had searched the frame. `has_landed`: a live flight has ended, and the frames
    that were left are searched.
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
    frames_asked: int
    frames_expected: int
    seconds: float
    folder: Path
    site: Site
    segment: int
    size_px: tuple[int, int]
    clip_ns: int
    view: FrameView | None
    is_resumed: bool
    has_landed: bool


def headline_of_watch(
    headline: dict[str, Any], notices: Sequence[Notice], trees: ThroughTrees | None = None
) -> dict[str, Any]:
    """A headline that also states what keeps it from being the whole truth, and what is under trees."""
    limits = [
        "what was flown before the watch began was not looked at"
        if each.code == BEGUN_LATE
        else each.text
        for each in notices
        if each.code in (BEGUN_LATE, CONTRADICTED, _UNCOUNTED)
    ]
    is_complete = headline["complete"] and not limits
    if trees is not None:
        seen = len(trees.tracks)
        own = f"{seen} of the people only through the trees: " if seen else ""
        limits.append(f"{own}{trees.headline['text']}")
        is_complete &= trees.headline["complete"]
    return {"text": "; ".join([headline["text"], *limits]), "complete": is_complete}


def utc_ns(setup: FlightSetup, frame_ns: int) -> int:
    """A frame's UTC by telemetry's clock; by its own where telemetry's was never set."""
    time_ns = setup.utc_ns(frame_ns)
    return time_ns if time_ns >= DATED_NS else frame_ns


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
        trees: ThroughTrees | None = None,
    ) -> None:
        self._memo, self._early, self.trees = memo, early, trees
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
        self.has_landed = False
        """Whether the frames that come are those that were left while the flight was live."""
        self._ground = (
            None if places.site.is_local else ground_for(places.site, detector.info, self._classes)
        )
        self._announced: Announced | None = None  # once the flight is searched again
        self._seen: dict[SightingKey, int] = {}  # by which track, while live
        self._stack = ExitStack()
        self._files = self._stack.enter_context(WatchFiles(folder, outputs, places.site))
        self._notifier = Notifier(
            setup.source.name, setup.source.fingerprint, places.site, outputs, folder, memo
        )
        self._stack.callback(self._notifier.close, 0.0, 0.0)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def _found(self, frame: Frame, arrived_s: float) -> Detections:
        """Return what the detector finds in a frame; where nothing places the flight, at the scale its scene shows."""
        settings, classes, memo = self._settings, self._classes, self._memo
        is_scaled = self._places.site.is_local and frame.image.size > 0
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
                tiles="auto",
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

    def search_again(self, places: Places, memo: ResultCache) -> None:
        """From here on the flight's frames come once more, from the first one, with those that were left out.

        `places` are the flight's, without anything in them yet; `memo` has what was found so far. Objects keep the ids
        under which they were announced.
        """
        self._announced = Announced(
            self._places.follower.tracks(), self._seen, by_place=not places.site.is_local
        )
        self._places, self._memo, self._early = places, memo, None
        self._files.close()
        self._files = self._stack.enter_context(
            WatchFiles(self._folder, self._outputs, places.site)
        )
        self.log = self.log.again()

    def forget_ground(self) -> None:
        """Count pictures alone: what ground the flight would have shown is not known."""
        self._ground = None

    def show(self, frame: Frame) -> PointsM | None:
        """A frame shows ground, whether or not it is searched: (4, 2) site metres; None where that is not known."""
        outline_m = self._outline_m(frame)
        if outline_m is not None and self._ground is not None:
            self._ground.show(outline_m)
        return outline_m

    def _outline_m(self, frame: Frame) -> PointsM | None:
        view = None if self._ground is None else self._places.view(frame)
        if view is None:
            return None
        return near_ground(view.outline_m, view.site_from_camera.translation_m)

    def put_together(self, frame: Frame, picture: Callable[[], ImageRGB] | None = None) -> None:
        """Take in a frame, in order of time, for what all of them show under trees."""
        if self.trees is not None:
            view = self._places.view(frame)
            self.trees.take(frame, None if view is None else view.site_from_camera, picture)

    def new_share(self, outline_m: PointsM) -> float:
        """The share, 0 to 1, of this ground that no frame was searched for."""
        return 1.0 if self._ground is None else self._ground.new_share(outline_m)

    def doubtful(self) -> dict[int, PointsM]:
        """The places (2,), by track, of what was seen clearly but not often enough to be announced."""
        if self._ground is None:
            return {}
        return {
            track.id: track.position_m
            for track in self._places.follower.tracks()
            if not track.confirmed and track.score >= self._detector.info.thresholds[track.label]
        }

    def looked_at(self) -> LookedAt:
        """How much of what the flight showed was looked at so far."""
        seen = max(self.log.asked, self.log.detected + self.log.lost.total())
        return looked_at(self._ground, self.log.detected, seen, self._settings.enough_looked_at)

    def lose(self, lost: LostFrame) -> None:
        """A frame that cannot be used."""
        self.log.read = max(self.log.read, lost.index + 1)
        self.log.lost[lost.reason] += 1
        if self._setup.source.kind == "video":  # a photo's place is lost with it
            self.show(Frame.unseen(lost.index, lost.name, lost.time_ns, (0, 0)))

    def add(self, frame: Frame, arrived_s: float) -> WatchUpdate:
        """Search one frame, whose turn came at `arrived_s` of the monotonic clock, and take in what it shows."""
        log, memo, source = self.log, self._memo, self._setup.source
        log.read = max(log.read, frame.index + 1)
        is_resumed = memo.has_ended(frame.index)
        with log.stage("detect"):
            found = self._found(frame, arrived_s)
        # a stream's pictures are not there any more, so where its detections lie is kept as well
        is_gone = memo.is_of_stream and not frame.image.size
        located = memo.known(frame.index, "located", Located) if is_gone else None
        time_ns = utc_ns(self._setup, frame.time_ns) if located is None else located.time_ns
        with log.stage("track"):
            taken = self._places.take(frame, time_ns, found, located)
        outline_m = self._outline_m(frame)
        if outline_m is not None and self._ground is not None:
            m_per_px = self._places.m_per_px(frame)
            self._ground.look(outline_m, math.inf if m_per_px is None else m_per_px, self._classes)
        if not is_resumed:
            if memo.is_of_stream:
                memo.keep(frame, "located", taken.located)
            memo.end_frame(frame, keeps_picture=False)
        sighted = [each for each in taken.sightings if each is not None]
        known: Sequence[Track] = self._places.follower.tracks()
        left = list[Track]()
        if self._announced is not None:
            taken, known = self._announced.see(taken, known)
            left = self._announced.left()
        elif memo.is_of_stream:
            ids = zip(taken.sightings, taken.track_ids)
            self._seen |= {sighting_key(each): own for each, own in ids if each is not None}
        confirmed = [track for track in known if track.confirmed]
        seen_ids = set(taken.track_ids)
        seen = [track for track in confirmed if track.id in seen_ids]
        new = [track for track in confirmed if track.id in taken.new_ids]
        if self.trees is not None:
            below = self.trees.new()
            new, seen = [*new, *below], [*seen, *below]
            left += self.trees.tracks.values()
        counts = count_by_class([*confirmed, *left])
        log.searched(time_ns, found, () if self._places.site.is_local else sighted)
        with log.stage("hand over"):
            files, notifier = self._files, self._notifier
            files.add(
                SeenFrame(
                    frame,
                    time_ns,
                    found,
                    taken.sightings,
                    taken.track_ids,
                    frozenset(each.id for each in confirmed),
                    f"frame {frame.name}, counted so far: {counted_list(counts)}",
                    taken.segment,
                )
            )
            for track in (*seen, *new):
                files.crop_of(track)
            files.forget(taken.merged)
            files.keep_crops_of(known)
            notifier.report(new, seen, files.crop_names, files.segments)
            notifier.withdraw(taken.merged)
            files.show([*confirmed, *left])
        latency_s = time.monotonic() - arrived_s
        if not (is_resumed or self.has_landed):
            log.latency_s.append(latency_s)
        return WatchUpdate(
            frame.name,
            time_ns,
            found,
            sighted,
            new,
            seen,
            counts,
            latency_s,
            log.read,
            log.detected,
            log.asked,
            source.frame_count,
            log.seconds,
            self._folder,
            self._places.site,
            taken.segment,
            frame.image.shape[1::-1],
            frame.time_ns - source.start_ns,
            self._places.view(frame),
            is_resumed and self._announced is None,
            self.has_landed,
        )

    def finish(self, *, ended: str) -> None:
        """The last word on every track, the files for other programs, and the report."""
        with self.log.stage("finish"):
            known = {track.id for track in self._places.follower.tracks() if track.confirmed}
            tracks = [track for track in self._places.follower.finish() if track.confirmed]
            late_ids = {track.id for track in tracks} - known
            if self._announced is not None:
                late_ids = {
                    each.id
                    for each in self._announced.named(
                        each for each in tracks if each.id in late_ids
                    )
                }
                tracks = self._announced.named(tracks)
                self._notifier.withdraw(each.id for each in self._announced.left())
            if self.trees is not None:
                late_ids |= {track.id for track in self.trees.new()}
                tracks += self.trees.tracks.values()
            for track in tracks:
                self._files.crop_of(track)
            self._files.close()
            late = [track for track in tracks if track.id in late_ids]
            self._notifier.report(late, [], self._files.crop_names, self._files.segments)
            self._notifier.report_final(tracks)
            self._notifier.close(_LAST_ALERTS_S, _LAST_EVENTS_S)
            self._files.clear()
            site, crop_names = self._places.site, self._files.crop_names
            write_detections(self._folder, site)
            rows = self._files.write_tracks(tracks)
        self.log.wall_s["write, beside the rest"] = self._files.seconds
        report = self._report(tracks, ended)
        crops = {
            track_id: (self._folder / name).read_bytes() for track_id, name in crop_names.items()
        }
        for name, data in searched_document(self._ground, self._places.site).items():
            atomic_write_bytes(self._folder / name, data)
        atomic_write_bytes(self._folder / "report.json", json_bytes(report))
        page = watch_page(report, rows, crops, self._places.follower.path_m())
        atomic_write_bytes(self._folder / "report.html", page.encode())
        self._memo.end(None)

    def _report(self, tracks: Sequence[Track], ended: str) -> dict[str, Any]:
        """Return report.json; its keys are specified in docs/formats.md. Numbers that are not known are None."""
        setup, log, detector, outputs = self._setup, self.log, self._detector, self._outputs
        total, seconds, is_local = sum(log.found.values()), log.seconds, self._places.site.is_local
        set_aside, placed = self._places.follower.impossible_size, log.placed.total()
        telemetry = telemetry_facts(setup)
        if is_local:  # how a map finds the ground's height is of no use then
            telemetry["height"] = telemetry["height"].split(",")[0]
        lost, looked = log.lost.total(), self.looked_at()
        counts = count_by_class(tracks)
        notices = [
            *self._places.notices(),
            *detector.notices,
            *setup.source.telemetry.notices,
            *(
                each
                for each in setup.source.notices()
                if not (lost and each.code in _OF_LOST_FRAMES)
            ),
        ]
        if lost:
            reasons = "; ".join(f"{count} x {reason}" for reason, count in log.lost.most_common(5))
            text = f"{counted(lost, 'frame')} could not be used: {reasons}"
            notices.append(Notice("lost_frames", lost, text))
        # nobody can say that there is none of a class of which detections have no place
        few = set_aside + (0 if setup.source.kind == "photos" else _FEW)
        hidden = {
            name
            for name in self._classes
            if not (is_local or counts.get(name)) and log.found[name] - log.placed[name] > few
        }
        not_placed = total - placed - set_aside
        if hidden or (not is_local and placed < 0.5 * (total - set_aside)):
            text = f"{not_placed:,} of {counted(total, 'detection')} have no place on the ground and are not counted"
            notices.append(Notice(_UNCOUNTED, not_placed, text))
        if log.unkept:
            text = f"{counted(log.unkept, 'frame')} did not wait for the landing: the disk is full"
            notices.append(Notice("disk_full", log.unkept, text))
        gone = 0 if self._announced is None else len(self._announced.left())
        if gone:
            text = f"{counted(gone, 'object')} announced while live: not confirmed by all frames, not counted"
            notices.append(Notice("not_confirmed", gone, text))
        notices += self._notifier.notices()
        classes = [each for each in self._classes if each not in hidden]
        return {
            **report_head(setup, is_local=is_local),
            "first_frame": utc_text(log.first_ns) if log.first_ns >= 0 else None,
            "last_frame": utc_text(log.last_ns) if log.last_ns >= 0 else None,
            "ended": ended,
            "headline": headline_of_watch(looked.headline(counts, classes), notices, self.trees),
            "looked_for": list(self._classes),
            "looked_at": looked.facts(),
            "objects": {"total": len(tracks), "by_class": counts},
            "frames": {
                "read": log.read,
                "detected": log.detected,
                "with_detections": log.with_detections,
                "skipped": max(0, looked.seen - log.detected - lost),
                "lost": lost,
                "reasons": dict(log.lost.most_common()),
            },
            "detections": {
                "total": total,
                "placed": placed,
                "not_placed": not_placed,
                "set_aside": set_aside,
                "by_class": dict(log.found.most_common()),
            },
            "model": {**model_facts(detector.info), "runs_on": detector.provider},
            "other_models": list(self._others.values()),
            "camera": camera_facts(setup.source.camera),
            "telemetry": telemetry,
            "latency_s": {
                "median": statistics.median(log.latency_s) if log.latency_s else None,
                "max": max(log.latency_s, default=None),
            },
            "frames_per_second": log.detected / seconds if seconds > 0 else None,
            "seconds": {
                "total": round(seconds, 3),
                **{name: round(value, 3) for name, value in log.wall_s.items()},
            },
            "peak_memory_mb": peak_memory_mb(),
            "notices": [asdict(each) for each in notices],
            "warnings": self._warnings(tracks),
            "settings": {
                **asdict(self._settings),
                "save": outputs.save,
                "labels": list(outputs.labels),
                "cot": outputs.cot,
            },
            "versions": software("numpy", "opencv-contrib-python-headless", "av", "onnxruntime"),
        }

    def _warnings(self, tracks: Sequence[Track]) -> list[str]:
        """Return what makes places on the ground inaccurate, and alerts dangerous."""
        warnings, camera = [], self._setup.source.camera
        if name := interpreted_placeholder(self._outputs.alert_command):
            warnings.append(interpreted_words(name))
        if self._places.site.is_local:
            return warnings
        if camera.focal_sigma > 0.1:
            warnings.append(f"camera: {camera.origin}; until then places are some percent off")
        far = [track for track in tracks if track.sigma_m > 10]
        if far:
            warnings.append(
                f"{len(far)} of {len(tracks)} objects are placed to more than 10 m only; telemetry with the camera's "
                "angles, or a turn that shows its clock, would place them better"
            )
        return warnings
