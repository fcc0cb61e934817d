"""Mode 1, later flights: sources against the map in a site folder, frame by frame."""

import threading
import time
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

from sorvolo.capture.areas import read_area
from sorvolo.capture.live.reconnect import LiveSettings
from sorvolo.capture.source import LiveSource, Source, opened_sources
from sorvolo.change.alignment import Caution, FlightPlace
from sorvolo.errors import InputError, SettingsError, StoreError
from sorvolo.missions.compare.run import Again, CompareRun, Pending
from sorvolo.missions.compare.whole_flight import MANY, OVERLAP
from sorvolo.missions.flight.detector_protocol import FindsObjects, ObjectDetector
from sorvolo.missions.flight.disk import check_room
from sorvolo.missions.flight.headline import contradicts_itself
from sorvolo.missions.flight.known_camera import known_camera
from sorvolo.missions.flight.map_objects import check_classes, open_detector
from sorvolo.missions.flight.opened import OpenedFlight, opened_flights, outcome_of
from sorvolo.missions.flight.result_cache import ResultCache
from sorvolo.missions.flight.settings import CompareSettings
from sorvolo.missions.flight.setup import (
    FlightSetup,
    known_flights,
    known_ground_m,
    prepare,
    repeated,
)
from sorvolo.missions.flight.threads import read_ahead
from sorvolo.missions.heights.measure import heights_stamps, own_heights_stamp, without_heights
from sorvolo.missions.mission import FlightOutcome, mission
from sorvolo.mosaic.selection import StretchSelection, every
from sorvolo.paths import AnyPath, Inputs, as_path, as_text, listed
from sorvolo.registration.lens import single_threaded_opencv
from sorvolo.store.site.archive import Archive
from sorvolo.survey.area import Area
from sorvolo.survey.findings import Change, CompareUpdate, ViewStatus
from sorvolo.survey.flight import Frame, LostFrame, PosedFrame
from sorvolo.survey.mosaic import FrameView

_AHEAD = 2  # frames that are compared while the evidence of one is gathered: a thread for each
_DECODED = 1  # frames of a video that wait to be compared


@mission
def compare_flights(
    inputs: Inputs,
    site: AnyPath,
    settings: CompareSettings = CompareSettings(),
    *,
    telemetry: AnyPath | None = None,
    camera: AnyPath | None = None,
    area: AnyPath | None = None,
    steps: AnyPath | None = None,
    detector: FindsObjects | None = None,
    live: LiveSettings = LiveSettings(keeps_all=True),
    until: threading.Event | None = None,
    again: bool = False,
) -> Generator[CompareUpdate, None, tuple[FlightOutcome, ...]]:
    """Compare one or more later flights with the map in the site folder, yielding an update for each frame compared.

    `inputs`, `telemetry`, `camera`, `area`, `detector`, `live` and `until` are those of `map_flights`. An update
    carries the changes that its frame announced; after one that `comes_again` its frame may have another. `steps` is a
    folder for the intermediate pictures of another method than the robust one. The flights' findings and the new version
    of the map are part of the site when a flight's last update was yielded.
    A run that was killed continues when the same is asked for again.
    A flight that was compared already, as it is asked for, is not compared again, unless `again` is given.
    Raises InputError, SettingsError or StoreError with what to do; the site then stays as it was. `cancel()` stops early:
    the flight that is being compared is left out, those before it are in.
    """
    inputs = listed(inputs)
    site = Path(site)
    telemetry = as_text(telemetry)
    camera = as_text(camera)
    area = as_path(area)
    steps = as_path(steps)
    if steps is not None:
        if settings.method is None:
            raise SettingsError("the robust method shows no steps: choose another --method as well")
        if steps.resolve().is_relative_to(site.resolve()):
            raise SettingsError(
                f"{steps} lies in the site folder {site}, which is sorvolo's own; name another folder"
            )
    wanted = None if area is None else read_area(area)
    with Archive.open(site, write=False) as archive:
        _check_map(archive, site, settings)
    looks = open_detector(settings.model, detector, inputs)
    check_classes(looks, settings.classes)
    opened = opened_sources(
        inputs,
        telemetry,
        camera,
        known_flights(site),
        live=live,
        until=until,
        better_camera=lambda guess: known_camera(guess, archive),
    )
    with Archive.open(site, write=True) as archive, opened as sources, single_threaded_opencv():
        outcomes: list[FlightOutcome] = []

        def asked(source: Source) -> tuple[Any, ...]:
            base, _ = _base_version(archive, source)
            stamps = (
                heights_stamps(archive, but=source.name),
                own_heights_stamp(archive, source.name),
            )
            reviews = [(each.change_id, each.verdict.value) for each in archive.reviews()]
            return settings, wanted, looks, base, reviews, stamps, steps

        def prepared(source: Source) -> FlightSetup:
            return prepare(
                source,
                settings.mapping,
                archive.site(),
                telemetry_named=telemetry is not None,
                finds_itself=True,
                ground_m=known_ground_m(archive),
            )

        for flight in opened_flights(
            sources, archive, asked, prepared, most_gap_s=live.same_flight_s, again=again
        ):
            if isinstance(flight, FlightOutcome):
                outcomes.append(flight)
                continue
            base, is_newest = _base_version(archive, flight.setup.source)
            # what later flights painted stays
            own = settings if is_newest else replace(settings, updates_map=False)
            yield from _compare_one(flight, archive, own, wanted, steps, looks, base)
            outcomes.append(outcome_of(archive, flight.setup.source.name))
        return tuple(outcomes)


def _check_map(archive: Archive, site: Path, settings: CompareSettings) -> None:
    """Raise StoreError where there is no map, or one that contradicts itself: changes on it would be its own faults."""
    if not archive.tiles():
        raise StoreError(
            f"{site} holds no map yet; make one of an earlier flight: sorvolo map INPUT --site {site}"
        )
    if settings.trusts_map:
        return
    for each in archive.flights():
        report = archive.report(each.id)
        if contradicts_itself(report):
            raise StoreError(
                f"the map in {site} contradicts itself (flight {each.id}): {report['headline'].get('text')}; map that "
                "flight again with what it lacks, or compare all the same with --trust-map"
            )


def _compare_one(
    flight: OpenedFlight,
    archive: Archive,
    settings: CompareSettings,
    area: Area | None,
    steps: Path | None,
    detector: ObjectDetector | None,
    base: int,
) -> Generator[CompareUpdate]:
    started_s, source = time.monotonic(), flight.setup.source
    flight = flight.noting(
        *repeated(archive, flight.setup, "compared"), *without_heights(archive, source.name)
    )
    setup = flight.setup
    if settings.updates_map:
        check_room(setup, archive, archive.site().m_per_px, keeps_pictures=False)
    inside = setup.inside(area)
    step_s = 0.0 if source.kind == "photos" else 1.0 / settings.views_per_second
    memo = flight.cache(archive)
    with CompareRun(setup, archive, settings, base, steps, detector, flight.request, memo) as run:

        def ahead() -> (
            int
        ):  # a live view's changes are announced at once, unless the next view waits already
            return 0 if isinstance(source, LiveSource) and not source.is_behind else _AHEAD

        def updated(
            frame: Frame | LostFrame,
            status: ViewStatus,
            reason: str,
            residual_px: float = float("nan"),
            announced: tuple[Change, ...] = (),
            view: FrameView | None = None,
            *,
            is_resumed: bool = False,
            comes_again: bool = False,
        ) -> CompareUpdate:
            return CompareUpdate(
                source.name,
                frame.name,
                setup.utc_ns(frame.time_ns),
                status,
                reason,
                residual_px,
                announced,
                frame.index + 1,
                source.frame_count,
                run.views,
                run.compared,
                time.monotonic() - started_s,
                view,
                is_resumed,
                comes_again,
            )

        for each in _ended(source, step_s, setup, inside, run, memo, ahead):
            if isinstance(each, LostFrame):
                run.lose(each)
                yield updated(each, ViewStatus.LOST, each.reason)
            elif isinstance(each, Again):
                yield updated(
                    each.posed.frame,
                    ViewStatus.NOT_ALIGNED,
                    "it is looked for again with all of its flight",
                    is_resumed=each.is_resumed,
                    comes_again=True,
                )
            else:
                outcome, announced = run.add(each)
                yield updated(
                    each.posed.frame,
                    outcome.status,
                    outcome.reason,
                    outcome.residual_px,
                    announced,
                    run.view(each.posed),
                    is_resumed=each.is_resumed,
                )
        run.finish(source.notices(), started_s)


def _ended(
    source: Source,
    step_s: float,
    setup: FlightSetup,
    inside: Callable[[PosedFrame], bool],
    run: CompareRun,
    memo: ResultCache,
    ahead: Callable[[], int],
) -> Iterator[Pending | LostFrame | Again]:
    """The frames as their comparisons end. What was not found on the map is tried again after the others, with the
    whole flight where that can be read again: each photo, and of a video, which shows the same ground again anyway,
    frames that overlap as photos do. Until one of its frames was found beyond doubt all of a video wait: where none is,
    single frames are found in wrong places. Frames that come again are named until then."""
    is_photos = source.kind == "photos"
    can_whole = setup.track is not None and not isinstance(source, LiveSource)
    overlapping = StretchSelection(OVERLAP, keep_all=False)
    caution = Caution.NEVER
    if can_whole:
        caution = Caution.ALWAYS if is_photos else Caution.AT_FIRST

    def is_chosen(posed: PosedFrame) -> bool:
        if is_photos or not can_whole:
            return is_photos
        outline_m = run.outline_m(posed)
        return outline_m is not None and overlapping.take(outline_m)

    chosen: set[int] = set()
    again: set[int] = set()
    for kept in memo.kept_frames():
        assert kept.prior is not None
        yield run.begin(PosedFrame(kept.frame, kept.prior))
    for each in _begun(_frames(source, step_s), setup, inside, run, ahead, caution=caution):
        if isinstance(each, Pending):
            index, is_one = each.posed.frame.index, is_chosen(each.posed)
            if is_one:
                chosen.add(index)
            if each.is_unplaced and (is_one or each.comes_again):
                again.add(index)
                run.put_off(each)
                yield Again(each.posed, is_resumed=each.is_resumed)
                continue
        yield each
    if not again:
        return
    places: Mapping[int, FlightPlace] = {}
    if can_whole and (is_photos or len(again & chosen) > MANY * len(chosen)):
        frames = source.frames(lambda index, _: index in chosen)
        places = yield from run.places_with_flight(_posed(frames, setup, inside), len(chosen))
    if places and not is_photos:
        run.leave_out(len(again - chosen))  # those that overlap show their ground
        again &= chosen
    yield from _begun(
        source.frames(lambda index, _: index in again),
        setup,
        inside,
        run,
        ahead,
        places,
        is_again=True,
    )


def _posed(
    frames: Iterable[Frame | LostFrame], setup: FlightSetup, inside: Callable[[PosedFrame], bool]
) -> Iterator[PosedFrame]:
    """The frames inside of the area with what telemetry has of their cameras; lost ones were counted before."""
    for each in frames:
        if isinstance(each, Frame) and inside(
            posed := PosedFrame(each, setup.prior(each, first=False))
        ):
            yield posed


def _frames(source: Source, step_s: float) -> Generator[Frame | LostFrame]:
    """A frame each step. A recorded video is decoded in a thread of its own: photos and live sources have theirs."""
    frames = source.frames(every(step_s))
    if isinstance(source, LiveSource) or source.kind == "photos":
        yield from frames
        return
    with closing(read_ahead(frames, _DECODED)) as ahead:
        yield from ahead


def _begun(
    frames: Iterable[Frame | LostFrame],
    setup: FlightSetup,
    inside: Callable[[PosedFrame], bool],
    run: CompareRun,
    ahead: Callable[[], int],
    places: Mapping[int, FlightPlace] = MappingProxyType({}),
    caution: Caution = Caution.NEVER,
    *,
    is_again: bool = False,
) -> Iterator[Pending | LostFrame]:
    """The frames inside of the area in order, each with its comparison begun, and that of up to `ahead()` after it."""
    waiting: deque[Pending | LostFrame] = deque()
    for each in frames:
        if isinstance(each, LostFrame):
            waiting.append(each)
        elif inside(posed := PosedFrame(each, setup.prior(each, first=False))):
            waiting.append(run.begin(posed, places.get(each.index), caution, is_again=is_again))
        while len(waiting) > ahead():
            yield waiting.popleft()
    yield from waiting


def _base_version(archive: Archive, source: Source) -> tuple[int, bool]:
    """The version to compare with, and whether the flight may paint: the newest, or the one before its own."""
    complete = archive.versions()
    own = next(
        (version for version in reversed(complete) if version.flight_id == source.name), None
    )
    if own is None:
        return complete[-1].id, True
    if own.parent_id == 0:
        raise InputError(
            f"the map of the site is flight {source.name}'s own; compare a later flight, or map an earlier one first"
        )
    return own.parent_id, own.id == complete[-1].id
