"""Mode 2: people, cars and small objects found while the drone flies, or in what it brought home; no map is needed."""

import json
import threading
import time
import warnings
from collections import deque
from collections.abc import Callable, Generator
from contextlib import ExitStack, closing
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from sorvolo.build import build
from sorvolo.capture.live.reconnect import LiveSettings
from sorvolo.capture.live.stream import LiveStream
from sorvolo.capture.source import LiveSource, Source, demand_inputs, open_sources
from sorvolo.errors import InputError, SorvoloWarning
from sorvolo.geometry.arrays import ImageGray, PointsM
from sorvolo.missions.flight.detector_protocol import (
    FindsObjects,
    ObjectDetector,
    as_detector,
    load_detector,
)
from sorvolo.missions.flight.map_objects import check_classes
from sorvolo.missions.flight.request import live_request, request_of
from sorvolo.missions.flight.result_cache import ResultCache, go_on
from sorvolo.missions.flight.settings import MapSettings
from sorvolo.missions.flight.setup import FlightSetup, prepare
from sorvolo.missions.flight.threads import read_ahead
from sorvolo.missions.mission import FlightOutcome, flight_outcome, mission
from sorvolo.missions.watch.cot_sender import check_host, cot_place
from sorvolo.missions.watch.places import Places, over_heights, places_of
from sorvolo.missions.watch.run import EarlyFound, WatchRun, WatchUpdate, utc_ns
from sorvolo.missions.watch.settings import DEFAULT_FRAMES_PER_SECOND, WatchOutputs, WatchSettings
from sorvolo.missions.watch.through_trees import ThroughTrees
from sorvolo.missions.watch.waiting import WaitingFrames
from sorvolo.mosaic.selection import every
from sorvolo.paths import AnyPath, Inputs, as_text, listed
from sorvolo.store.exports.detection_files import JOURNAL, claimed_folder
from sorvolo.store.site.journal import RunJournal, content_sha256
from sorvolo.survey.flight import Frame
from sorvolo.tracking.image_motion import SMALL_WIDTH_PX, STEP_S, PictureStep, PictureSteps
from sorvolo.tracking.laying import GroundHeight

_AHEAD = 4  # decoded frames that wait for the detector
_STOPPED = "stopped on demand"


@mission
def watch(
    source: Inputs,
    settings: WatchSettings = WatchSettings(),
    outputs: WatchOutputs = WatchOutputs(),
    *,
    telemetry: AnyPath | None = None,
    camera: AnyPath | None = None,
    detector: FindsObjects | None = None,
    live: LiveSettings = LiveSettings(),
    until: threading.Event | None = None,
    moved: Callable[[PictureStep], None] | None = None,
    early: Callable[[EarlyFound], None] | None = None,
) -> Generator[WatchUpdate, None, tuple[FlightOutcome, ...]]:
    """Search a flight, yielding an update for each frame searched.

    `source`, `telemetry` and `camera` are those of `map_flights`; a folder of several videos is watched one after
    another, each into a folder of its own. `detector` is one that is loaded already; else `settings.model` is. Every
    wanted frame is searched. Of a live flight, read with the settings `live`, frames that show new ground come first;
    what is left is searched once it has ended, from the pictures that were kept. Objects are placed on the ground where
    telemetry allows it, else followed in the picture.

    `moved` is given how the picture of a live video moved, ten times a second of flight, in the thread that reads it:
    while a frame is searched, its last boxes can follow the picture (see `PictureSteps`). Times are those of updates.
    `early` is given what is found in a live frame of classes that take little time (cars, where they appear large),
    before the frame's update, which has the same.

    A watch that was killed goes on where it was when the same is asked for again, with a live stream within
    `live.same_flight_s`: what was found is not searched for again, and alerts that were sent are not sent again.

    Set `until` to end a live flight, whose rest is then searched, or a recorded one at once; `cancel()`, or
    Ctrl-C, ends at once: all that was found until then is written. Raises
    InputError, SettingsError or StoreError with what to do.
    """
    telemetry = as_text(telemetry)
    camera = as_text(camera)
    until = until or threading.Event()
    inputs = listed(source)
    demand_inputs(inputs)
    finder = _checked_detector(detector, settings, outputs)
    sources = open_sources(inputs, telemetry, camera, live=live, until=until)
    with ExitStack() as stack:
        for each in sources:
            if isinstance(each, LiveSource):
                stack.callback(each.close)
        outcomes: list[FlightOutcome] = []
        for each in sources:
            if until.is_set():
                break
            is_live = isinstance(each, LiveSource)
            stopped = _stopped_watch(each, settings, outputs, finder, live.same_flight_s)
            folder = stopped or _folder_of(each, outputs, is_only=len(sources) == 1)
            outcome = yield from _watch_one(
                each,
                settings,
                replace(outputs, folder=folder),
                finder,
                until,
                moved if is_live else None,
                early if is_live else None,
                goes_on=stopped is not None,
                telemetry_named=telemetry is not None,
            )
            outcomes.append(outcome)
        return tuple(outcomes)


def _stopped_watch(
    source: Source,
    settings: WatchSettings,
    outputs: WatchOutputs,
    detector: ObjectDetector,
    most_gap_s: float,
) -> Path | None:
    """Have a live source go on with the flight of a killed watch that was asked for the same; that watch's folder."""
    if not isinstance(source, LiveSource):
        return None
    request = live_request(source, settings, None, detector, *_asked(settings, outputs))
    named, below = outputs.folder, outputs.below
    names = Path().glob(f"*-watch/{JOURNAL}") if below is None else below.glob(f"*/{JOURNAL}")
    for folder in sorted(each.parent for each in names) if named is None else [named]:
        journal = _journal(folder, request)
        if journal.is_begun and go_on(source, journal, most_gap_s):
            return folder
    return None


def _asked(settings: WatchSettings, outputs: WatchOutputs) -> tuple[Any, ...]:
    """Return what a watch is asked for besides its settings."""
    stamp: tuple[int, ...] = ()
    if settings.height_model:
        stat = Path(settings.height_model).stat()
        stamp = stat.st_size, stat.st_mtime_ns
    return replace(outputs, folder=None, below=None), stamp


def _journal(folder: Path, request: str) -> RunJournal:
    return RunJournal(folder / JOURNAL, content_sha256(request), 0, build())


def _folder_of(source: Source, outputs: WatchOutputs, *, is_only: bool) -> Path:
    """Where a watch's files go: each of several sources has a folder of its own, and each flight of a live one."""
    if outputs.folder is None and outputs.below is not None:
        folder = first = outputs.below / source.name
        number = 1
        while isinstance(source, LiveSource) and folder.exists():
            number += 1
            folder = first.with_name(f"{first.name}-{number}")
        return folder
    if outputs.folder is None:
        return Path(f"{source.name}-watch")
    return outputs.folder if is_only else outputs.folder / source.name


def _checked_detector(
    detector: FindsObjects | None, settings: WatchSettings, outputs: WatchOutputs
) -> ObjectDetector:
    """The detector of a watch. Raises InputError or SettingsError where it, or where its finds go, cannot be used."""
    if outputs.cot:
        check_host(cot_place(outputs.cot))
        outputs.cot_tls.context()
    finder = load_detector(settings.model) if detector is None else as_detector(detector)
    check_classes(finder, settings.classes)
    return finder


def _watch_one(
    source: Source,
    settings: WatchSettings,
    outputs: WatchOutputs,
    detector: ObjectDetector,
    until: threading.Event,
    moved: Callable[[PictureStep], None] | None,
    early: Callable[[EarlyFound], None] | None,
    *,
    goes_on: bool,
    telemetry_named: bool,
) -> Generator[WatchUpdate, None, FlightOutcome]:
    folder, is_live = outputs.folder, isinstance(source, LiveSource)
    assert folder is not None
    setup, ground = _prepared(source, settings, telemetry_named=telemetry_named)
    places = _places(setup, settings, detector, ground)
    request = request_of(setup, settings, None, detector, *_asked(settings, outputs))
    journal = _journal(folder, request)
    if why_not := journal.why_not:
        text = f"{folder}: a watch that was stopped cannot continue: {why_not}"
        warnings.warn(text, SorvoloWarning, stacklevel=2)
    passed = _Passed(_wanted(source, settings))
    with ExitStack() as stack:
        goes = goes_on if is_live else journal.is_begun
        stack.enter_context(
            claimed_folder(
                folder, source.name, source.fingerprint, replaces=not is_live, goes_on=goes
            )
        )
        stack.callback(journal.close)
        memo = ResultCache(journal, source)
        trees = None
        if settings.through_trees:
            trees = ThroughTrees(setup, places.site, folder, memo)
            stack.callback(trees.close)
        run = stack.enter_context(
            WatchRun(setup, places, detector, settings, outputs, folder, memo, early, trees)
        )
        if moved is not None and isinstance(source, LiveStream):
            _give_steps(source, setup, moved)
        ended = _STOPPED
        try:
            if isinstance(source, LiveSource):
                waiting = stack.enter_context(WaitingFrames(source, passed.is_wanted, folder))
                yield from _live(run, waiting, passed, memo)
                ended = _STOPPED if until.is_set() else "the source ended"
                new_places = partial(_places, setup, settings, detector, ground)
                yield from _rest(run, waiting, lambda: ResultCache(journal, source), new_places)
            else:
                yield from _recorded(run, source, passed, until)
                if not until.is_set():
                    ended = "the source ended"
                    run.log.read = passed.count  # also those after the last one that was searched
            if trees is not None and (is_live or not until.is_set()):
                trees.finish()
        except KeyboardInterrupt:
            ended = _STOPPED  # what was found is written below
        except Exception as error:
            ended = f"stopped by an error: {error}"
            raise
        finally:
            if ended == _STOPPED and not is_live:
                passed.note_unread(run, source)
            if run.log.detected or ended == _STOPPED:
                run.finish(ended=ended)
        if ended != _STOPPED and not run.log.detected:
            reason = next(iter(run.log.lost), "the source holds none")
            raise InputError(
                f"no frame of {source.name} could be searched: {reason}; see `sorvolo inspect`"
            )
    return flight_outcome(folder, json.loads((folder / "report.json").read_bytes()))


class _Passed:
    """Which of a source's frames are to be searched, asked in the thread that reads it; notes those that show ground."""

    def __init__(self, wanted: Callable[[int, int], bool]) -> None:
        self._wanted, self._shows = wanted, every(1 / DEFAULT_FRAMES_PER_SECOND)
        self._showing: deque[tuple[int, int]] = deque()
        self.count = 0
        self.earlier = 0
        """How many frames came while a killed watch ran."""
        self._asked = 0

    def is_wanted(self, index: int, time_ns: int) -> bool:
        """Whether this frame is to be searched."""
        self.count = index + 1
        is_wanted = self._wanted(index, time_ns)
        self._asked += is_wanted
        if self._shows(index, time_ns) and not is_wanted:
            self._showing.append((index, time_ns))
        return is_wanted

    def note(self, run: WatchRun) -> None:
        """Tell the watch how many frames were to be searched so far, and what ground the others show."""
        run.log.asked = self._asked + self.earlier
        while self._showing:
            index, time_ns = self._showing.popleft()
            run.show(Frame.unseen(index, str(index), time_ns, (0, 0)))

    def note_unread(self, run: WatchRun, source: Source) -> None:
        """Tell the watch what a recorded flight would have shown after the frame at which it was stopped."""
        if source.kind == "photos":
            self._asked += max(0, source.frame_count - self.count)
            run.forget_ground()
        else:
            for index in range(self.count, source.frame_count):
                time_ns = source.start_ns + round(index * 1e9 / source.frame_rate_hz)
                if self.is_wanted(index, time_ns):
                    self._showing.append((index, time_ns))
        self.note(run)


def _recorded(
    run: WatchRun, source: Source, passed: _Passed, until: threading.Event
) -> Generator[WatchUpdate]:
    """Search every wanted frame of a flight that is over."""
    with closing(read_ahead(source.frames(passed.is_wanted), _AHEAD)) as frames:
        for frame in frames:
            passed.note(run)
            if isinstance(frame, Frame):
                update = run.add(frame, time.monotonic())
                run.put_together(frame)
                yield update
            else:
                run.lose(frame)
            if until.is_set():
                return
    passed.note(run)


def _live(
    run: WatchRun, waiting: WaitingFrames, passed: _Passed, memo: ResultCache
) -> Generator[WatchUpdate]:
    """Search what a killed watch had searched of the stream, then new ground as it comes, until the flight ends."""
    for each in memo.kept_frames():
        passed.earlier += 1
        yield run.add(each.frame, time.monotonic())
    for frame in memo.waited_frames():  # their pictures are lost
        passed.earlier += 1
        run.show(frame)

    def came(frame: Frame) -> PointsM | None:
        memo.note_came(frame)
        run.put_together(frame, lambda: waiting.picture(frame.index))
        return run.show(frame)

    with closing(waiting.live(came, run.new_share, run.doubtful)) as arrivals:
        for arrived_s, arrived in arrivals:
            passed.note(run)
            if isinstance(arrived, Frame):
                yield run.add(arrived, arrived_s)
            else:
                run.lose(arrived)
    passed.note(run)
    run.log.unkept = waiting.unkept


def _rest(
    run: WatchRun,
    waiting: WaitingFrames,
    new_memo: Callable[[], ResultCache],
    new_places: Callable[[], Places],
) -> Generator[WatchUpdate]:
    """Search what was left while the flight was live; the whole flight again, where that was not in order of time.

    What was searched is not searched again. Closed early, it still takes in all that was searched.
    """
    run.has_landed = True
    if waiting.is_in_order:
        for frame in waiting.in_order(set(waiting.left()).__contains__):
            yield run.add(frame, time.monotonic())
        return
    memo = new_memo()
    run.search_again(new_places(), memo)
    own = set(waiting.kept())
    for each in memo.kept_frames():  # of an earlier process, without pictures
        if each.index not in own:
            run.add(each.frame, time.monotonic())
    done = -1
    try:
        for frame in waiting.in_order(lambda _: True):
            done = frame.index
            yield run.add(frame, time.monotonic())
    finally:
        for frame in waiting.in_order(lambda index: index > done and memo.has_ended(index)):
            run.add(frame, time.monotonic())


def _give_steps(
    source: LiveStream, setup: FlightSetup, moved: Callable[[PictureStep], None]
) -> None:
    """Have a live video compared with itself a tenth of a second before, while its frames are searched."""
    steps = PictureSteps()

    def compare(time_ns: int, gray: ImageGray) -> None:
        step = steps.add(utc_ns(setup, time_ns), gray, source.size_px[0])
        if step is not None:
            moved(step)

    source.glance(STEP_S, SMALL_WIDTH_PX, compare)


def _prepared(
    source: Source, settings: WatchSettings, *, telemetry_named: bool
) -> tuple[FlightSetup, GroundHeight | None]:
    """The flight as it is set up, and the ground's heights where a model has them."""
    mapping = MapSettings(
        offset_s=settings.offset_s, ground_elevation_m=settings.ground_elevation_m
    )

    def prepared(mapping: MapSettings) -> FlightSetup:
        return prepare(source, mapping, None, telemetry_named=telemetry_named)

    if settings.height_model:
        return over_heights(prepared, mapping, Path(settings.height_model))
    return prepared(mapping), None


def _places(
    setup: FlightSetup,
    settings: WatchSettings,
    detector: ObjectDetector,
    ground: GroundHeight | None,
) -> Places:
    """Where what is found in the flight will lie."""
    thresholds = detector.info.thresholds
    least = (
        thresholds
        if settings.least_score is None
        else dict.fromkeys(thresholds, settings.least_score)
    )
    return places_of(setup, least, ground)


def _wanted(source: Source, settings: WatchSettings) -> Callable[[int, int], bool]:
    """Which frames are searched: all photos, or a number a second of flight.

    Of a live source those that the detector is too slow for wait until it has landed.
    """
    if settings.frames_per_second is not None:
        return every(1 / settings.frames_per_second)
    return every(0.0 if source.kind == "photos" else 1 / DEFAULT_FRAMES_PER_SECOND)
