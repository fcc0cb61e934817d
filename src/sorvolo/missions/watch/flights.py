"""Mode 2: people, cars and small objects found while the drone flies, or in what it brought home; no map is needed."""

import threading
import time
from collections.abc import Callable, Generator, Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

from sorvolo.capture.live.reconnect import LiveSettings
from sorvolo.capture.live.stream import LiveStream
from sorvolo.capture.source import LiveSource, Source, open_sources
from sorvolo.detection.detector import Detector
from sorvolo.errors import InputError, SettingsError
from sorvolo.geometry.arrays import ImageGray
from sorvolo.missions.flight.detector_protocol import ObjectDetector
from sorvolo.missions.flight.frames_ahead import read_ahead
from sorvolo.missions.flight.live_journal import SourceNotes
from sorvolo.missions.flight.settings import MapSettings
from sorvolo.missions.flight.setup import FlightSetup, prepare
from sorvolo.missions.watch.cot_sender import check_host, cot_place
from sorvolo.missions.watch.ground_height import over_heights
from sorvolo.missions.watch.journal import StoppedWatch, WatchJournal, WatchOrder
from sorvolo.missions.watch.places import Places, places_of
from sorvolo.missions.watch.run import EarlyFound, WatchRun, WatchUpdate, utc_ns
from sorvolo.missions.watch.settings import DEFAULT_FRAMES_PER_SECOND, WatchOutputs, WatchSettings
from sorvolo.mosaic.selection import every
from sorvolo.store.exports.cursor_on_target import COT_TYPES
from sorvolo.store.exports.detection_files import claimed_folder
from sorvolo.survey.flight import Frame, LostFrame
from sorvolo.tracking.picture_steps import SMALL_WIDTH_PX, STEP_S, PictureStep, PictureSteps

_AHEAD = 4  # decoded frames that wait for the detector
_STOPPED = "stopped on demand"


@dataclass(frozen=True)
class _Heard:
    """Who is given what is known of a live source before its frames' updates."""

    moved: Callable[[PictureStep], None] | None = None
    early: Callable[[EarlyFound], None] | None = None


def watch(
    source: Path | str,
    settings: WatchSettings = WatchSettings(),
    outputs: WatchOutputs = WatchOutputs(),
    *,
    telemetry: Path | str | None = None,
    camera: Path | str | None = None,
    detector: ObjectDetector | None = None,
    live: LiveSettings = LiveSettings(),
    until: threading.Event | None = None,
    moved: Callable[[PictureStep], None] | None = None,
    early: Callable[[EarlyFound], None] | None = None,
) -> Generator[WatchUpdate]:
    """Search a flight, yielding an update for each frame searched.

    `source`, `telemetry` and `camera` are those of `map_flights`; a folder of several videos is watched one after
    another, each into a folder of its own. `detector` is one that is loaded already; else `settings.model` is. Every
    wanted frame of a recorded flight is searched; of a live one, read with the settings `live`, the newest, so that
    latency stays bounded, and the others are counted. Objects are placed on the ground where telemetry allows it, else
    followed in the picture.

    `moved` is given how the picture of a live video moved, ten times a second of flight, in the thread that reads it:
    while a frame is searched, its last boxes can follow the picture (see `PictureSteps`). Times are those of updates.
    `early` is given what is found in a live frame of classes that take little time (cars, where they appear large),
    before the frame's update, which has the same.

    A watch that was killed goes on where it was when the same is asked for again, with a live stream within
    `live.same_flight_s`: what was found is not searched for again, and alerts that were sent are not sent again.

    Set `until`, close the generator, or press Ctrl-C, to end early: all that was found until then is written. Raises
    InputError, SettingsError or StoreError with what to do.
    """
    until = until or threading.Event()
    finder = _checked_detector(detector, settings, outputs)
    sources = open_sources([source], telemetry, camera, live=live, until=until)
    with ExitStack() as stack:
        for each in sources:
            if isinstance(each, LiveSource):
                stack.callback(each.close)
        for each in sources:
            if until.is_set():
                return
            order = WatchOrder(settings, outputs, finder)
            goes_on = (
                order.go_on_live(each, live.same_flight_s) if isinstance(each, LiveSource) else None
            )
            folder = (
                _folder_of(each, outputs, is_only=len(sources) == 1)
                if goes_on is None
                else goes_on.folder
            )
            heard = _Heard(moved, early) if isinstance(each, LiveSource) else _Heard()
            yield from _watch_one(
                each,
                WatchOrder(settings, replace(outputs, folder=folder), finder),
                folder,
                goes_on,
                until,
                heard,
                telemetry_named=telemetry is not None,
            )


def _folder_of(source: Source, outputs: WatchOutputs, *, is_only: bool) -> Path:
    """Where a watch's files go: each of several sources has a folder of its own, and each flight of a live one."""
    if outputs.folder is None and outputs.below is not None:
        folder = outputs.below / source.name
        return _free_folder(folder) if isinstance(source, LiveSource) else folder
    if outputs.folder is None:
        return Path(f"{source.name}-watch")
    return outputs.folder if is_only else outputs.folder / source.name


def _free_folder(folder: Path) -> Path:
    """The folder, with a number where there is one of this name."""
    names = (folder, *(folder.with_name(f"{folder.name}-{number}") for number in range(2, 10_000)))
    return next(each for each in names if not each.exists())


def _checked_detector(
    detector: ObjectDetector | None, settings: WatchSettings, outputs: WatchOutputs
) -> ObjectDetector:
    """The detector of a watch. Raises InputError or SettingsError where it, or where its finds go, cannot be used."""
    if outputs.cot:
        check_host(cot_place(outputs.cot))
        outputs.cot_tls.context()
    finder = Detector.load(settings.model) if detector is None else detector
    _demand_known_classes(finder, settings, outputs)
    return finder


def _demand_known_classes(
    detector: ObjectDetector, settings: WatchSettings, outputs: WatchOutputs
) -> None:
    if unknown := sorted(set(settings.classes) - set(detector.classes)):
        raise SettingsError(
            f"the model knows no {unknown[0]!r}; it knows {', '.join(detector.classes)}"
        )
    if unknown := sorted(set(outputs.cot_types) - {*detector.classes, *COT_TYPES}):
        raise SettingsError(
            f"--cot-type {unknown[0]}: no such class; the model knows {', '.join(detector.classes)}"
        )


def _watch_one(
    source: Source,
    order: WatchOrder,
    folder: Path,
    goes_on: StoppedWatch | None,
    until: threading.Event,
    heard: _Heard,
    *,
    telemetry_named: bool,
) -> Generator[WatchUpdate]:
    settings, outputs, detector = order.settings, order.outputs, order.detector
    setup, places = _prepared(source, order, telemetry_named=telemetry_named)
    with (
        _begun(source, order, setup, folder, goes_on) as journal,
        WatchRun(setup, places, detector, settings, outputs, folder, journal, heard.early) as run,
    ):
        for searched in journal.frames() if goes_on is not None else ():
            yield run.recall(searched)
        if heard.moved is not None and isinstance(source, LiveStream):
            _give_steps(source, setup, heard.moved)
        ended = _STOPPED
        try:
            first = 0 if goes_on is None else goes_on.next_index
            ended = yield from _search(run, source, settings, until, first)
        except KeyboardInterrupt:
            pass  # the usual way to end a live watch: what was found is written below
        except Exception as error:
            ended = f"stopped by an error: {error}"
            raise
        finally:
            if run.log.detected or ended == _STOPPED:
                run.finish(
                    ended=ended, skipped=source.skipped if isinstance(source, LiveSource) else 0
                )
        if ended != _STOPPED:
            _demand_searched(run, source)


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


def _demand_searched(run: WatchRun, source: Source) -> None:
    if not run.log.detected:
        reason = next(iter(run.log.lost), "the source holds none")
        raise InputError(
            f"no frame of {source.name} could be searched: {reason}; see `sorvolo inspect`"
        )


def _prepared(
    source: Source, order: WatchOrder, *, telemetry_named: bool
) -> tuple[FlightSetup, Places]:
    """The flight as it is set up, and where what is found in it will lie."""
    settings = order.settings
    mapping = MapSettings(
        offset_s=settings.offset_s, ground_elevation_m=settings.ground_elevation_m
    )

    def prepared(mapping: MapSettings) -> FlightSetup:
        return prepare(source, mapping, None, telemetry_named=telemetry_named)

    if settings.height_model:
        setup, ground = over_heights(prepared, mapping, Path(settings.height_model))
    else:
        setup, ground = prepared(mapping), None
    thresholds = order.detector.info.thresholds
    least = (
        thresholds
        if settings.least_score is None
        else dict.fromkeys(thresholds, settings.least_score)
    )
    return setup, places_of(setup, least, ground)


@contextmanager
def _begun(
    source: Source,
    order: WatchOrder,
    setup: FlightSetup,
    folder: Path,
    goes_on: StoppedWatch | None,
) -> Iterator[WatchJournal]:
    """The journal of a watch, whose folder is claimed: as a killed watch left it where that goes on, else empty."""
    file, is_live = order.journal(setup, folder), isinstance(source, LiveSource)
    goes = goes_on is not None if is_live else file.is_begun
    with (
        claimed_folder(folder, source.name, source.fingerprint, replaces=not is_live, goes_on=goes),
        closing(file),
    ):
        if isinstance(source, LiveSource):
            yield WatchJournal(
                file, SourceNotes(file, source, 0 if goes_on is None else goes_on.samples)
            )
        else:
            yield WatchJournal(file)


def _search(
    run: WatchRun, source: Source, settings: WatchSettings, until: threading.Event, first: int
) -> Generator[WatchUpdate, None, str]:
    """Search the wanted frames from index `first` on, yielding an update for each; why it ended, in words."""
    wanted = _wanted(source, settings)
    asked = _Asked(lambda index, time_ns: index >= first and wanted(index, time_ns))
    with closing(_arrivals(source, asked)) as arrivals:
        for arrived_s, each in arrivals:
            if isinstance(each, Frame):
                yield run.add(each, arrived_s)
            else:
                run.lose(each)
            if until.is_set():
                break
    if until.is_set():
        return _STOPPED
    if not isinstance(source, LiveSource):
        run.log.read = asked.frames  # also those after the last one that was searched
    return "the source ended"


class _Asked:
    """Which frames are wanted; `frames` counts how many a source has come to when it asks."""

    def __init__(self, wanted: Callable[[int, int], bool]) -> None:
        self._wanted = wanted
        self.frames = 0

    def __call__(self, index: int, time_ns: int) -> bool:
        self.frames = index + 1
        return self._wanted(index, time_ns)


def _arrivals(
    source: Source, wanted: Callable[[int, int], bool]
) -> Generator[tuple[float, Frame | LostFrame]]:
    """The frames, each with when it came, or when its turn came, by the monotonic clock.

    A live source has a thread of its own, in which newer frames take the place of older ones.
    """
    if isinstance(source, LiveSource):
        yield from source.arrivals(wanted)
    else:
        with closing(read_ahead(source.frames(wanted), _AHEAD)) as frames:
            for each in frames:
                yield time.monotonic(), each


def _wanted(source: Source, settings: WatchSettings) -> Callable[[int, int], bool]:
    """Which frames are searched: all photos, every N-th frame, or a number a second of flight.

    Of a live source all may be: those that nobody has time for give way to newer ones.
    """
    if settings.every is not None:
        step = settings.every
        return lambda index, _: index % step == 0
    if settings.frames_per_second is not None:
        return every(1 / settings.frames_per_second)
    takes_all = source.kind == "photos" or isinstance(source, LiveSource)
    return every(0.0 if takes_all else 1 / DEFAULT_FRAMES_PER_SECOND)
