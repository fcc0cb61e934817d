"""Mode 1, first flight: sources to a map in a site folder, frame by frame."""

import itertools
import threading
import time
from collections.abc import Generator, Iterator, Sequence
from contextlib import ExitStack, closing, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from sorvolo.capture.areas import read_area
from sorvolo.capture.live.reconnect import LiveSettings
from sorvolo.capture.source import LiveSource, Source, opened_sources
from sorvolo.capture.video import VideoSource
from sorvolo.capture.video_spans import SparseReading
from sorvolo.errors import InputError, SettingsError
from sorvolo.missions.flight.base_map import open_base
from sorvolo.missions.flight.control import open_control
from sorvolo.missions.flight.detector_protocol import FindsObjects, ObjectDetector
from sorvolo.missions.flight.disk import LiveRoom, check_room
from sorvolo.missions.flight.headline import OBLIQUE_DEG
from sorvolo.missions.flight.map_objects import ObjectFinder, open_detector
from sorvolo.missions.flight.opened import OpenedFlight, opened_flights, outcome_of
from sorvolo.missions.flight.result_cache import ResultCache
from sorvolo.missions.flight.sample_frames import refuse_without_texture
from sorvolo.missions.flight.settings import MapSettings
from sorvolo.missions.flight.setup import (
    FlightSetup,
    KnownGround,
    founds_site,
    known_flights,
    known_ground_m,
    prepare,
    repeated,
)
from sorvolo.missions.flight.threads import read_ahead
from sorvolo.missions.map.coverage import FlightCoverage
from sorvolo.missions.map.planar_run import FlightRun, PlanarRun
from sorvolo.missions.mission import FlightOutcome, mission
from sorvolo.mosaic.control import ControlSettings
from sorvolo.mosaic.selection import (
    Selected,
    SelectionSettings,
    SmallCopies,
    every,
    select_keyframes,
    shows_all_between,
)
from sorvolo.paths import AnyPath, Inputs, as_path, as_text, listed
from sorvolo.store.exports.waypoints import check_waypoint_files
from sorvolo.store.site.archive import Archive
from sorvolo.store.site.catalogue_place import Catalogues
from sorvolo.survey.area import Area
from sorvolo.survey.flight import LostFrame, PosedFrame
from sorvolo.survey.mosaic import MosaicUpdate, Status

if TYPE_CHECKING:  # `map` alone has no use for what plants and searches
    from sorvolo.missions.search.while_flying import SearchWhileFlying

_AHEAD = 2  # decoded frames that wait to be placed
_FEW = 8  # selected frames after which a recorded flight is given up that cannot become a map; by choice


@mission
def map_flights(
    inputs: Inputs,
    site: AnyPath,
    settings: MapSettings = MapSettings(),
    *,
    telemetry: AnyPath | None = None,
    camera: AnyPath | None = None,
    area: AnyPath | None = None,
    detector: FindsObjects | None = None,
    live: LiveSettings = LiveSettings(keeps_all=True),
    until: threading.Event | None = None,
    control: AnyPath | None = None,
    base: AnyPath | None = None,
    again: bool = False,
    refly: Inputs = (),
    catalogues: Catalogues | None = None,
    search: "SearchWhileFlying | None" = None,
) -> Generator[MosaicUpdate, None, tuple[FlightOutcome, ...]]:
    """Map one or more flights into the site folder, yielding an update for each selected frame.

    `inputs` are videos, folders of photos, photos, or live sources (see `open_sources`); `telemetry` a file of the
    only flight (else what lies in or beside it is used), or a receiver's link; `camera` a calibration file, a preset's
    name, "aov=DEG" or "focal_px=PX"; `area` a polygon outside of which frames are not used; `detector` one that finds
    objects in place of the model that the settings name; `control` a file of the only flight's control points
    (gcp_list.txt), `base` a GeoTIFF or a site folder whose map shows its ground, to which it is tied. A live
    flight is read, by the settings `live`, until it ends or `until` is set; then its map is finished like any other's.
    Nothing of a flight is part of the site until its last update was yielded.
    A run that was killed continues when the same is asked for again. A flight that the site has already, by
    the same files, settings and version of the program, is not mapped again, unless `again` is given.
    `catalogues` is where a new site's catalogue goes; None: where the environment has it.
    `refly` are files for waypoints over ground that the pictures leave out, kept up to date while the flight goes on.
    `search` measures a live flight's probability of detection meanwhile.
    Raises InputError, SettingsError or StoreError with what to do; the site then stays as it was. `cancel()` stops
    early: the flight that is being mapped is left out, those before it are in.
    """
    inputs = listed(inputs)
    site = Path(site)
    telemetry = as_text(telemetry)
    camera = as_text(camera)
    area = as_path(area)
    control = as_path(control)
    base = as_path(base)
    waypoint_files = [Path(each) for each in listed(refly)]
    check_waypoint_files(waypoint_files, site)
    wanted = None if area is None else read_area(area)
    looks = open_detector(settings.model, detector, inputs)
    asked = replace(settings, live_s=0.0, memory_mb=None), wanted, looks
    opened = opened_sources(
        inputs, telemetry, camera, known_flights(site, catalogues), live=live, until=until
    )
    outcomes: list[FlightOutcome] = []
    with opened as sources, Archive.open(site, write=True, catalogues=catalogues) as archive:
        ground = _known_ground(control, base, sources, settings)

        def prepared(source: Source) -> FlightSetup:
            return prepare(
                source,
                settings,
                archive.site() if archive.has_site else None,
                telemetry_named=telemetry is not None,
                ground_m=known_ground_m(archive),
                known_ground=ground,
                founds_site=founds_site(archive, source.name),
            )

        for flight in opened_flights(
            sources,
            archive,
            lambda _: asked,
            prepared,
            most_gap_s=live.same_flight_s,
            again=again,
        ):
            if isinstance(flight, FlightOutcome):
                outcomes.append(flight)
                continue
            coverage = FlightCoverage(
                flight.setup, archive, wanted, waypoint_files, settings.live_s
            )
            measuring = search if isinstance(flight.setup.source, LiveSource) else None
            yield from _map_one(flight, archive, settings, wanted, looks, coverage, measuring)
            outcomes.append(outcome_of(archive, flight.setup.source.name))
    return tuple(outcomes)


def _known_ground(
    control: Path | None, base: Path | None, sources: Sequence[Source], settings: MapSettings
) -> KnownGround | None:
    """Open what a map is tied to; None without any. Raises SettingsError where that cannot be."""
    if control is not None and base is not None:
        raise SettingsError(
            "a map is tied to control points (--gcp) or to a base map (--base), not to both"
        )
    if settings.checks and control is None:
        raise SettingsError(
            "check points (--check) are of a control point file: give it with --gcp"
        )
    if control is None and base is None:
        return None
    if settings.method is not None:
        raise SettingsError("--gcp and --base tie maps of method planar only; leave --method out")
    if len(sources) != 1:
        raise SettingsError(
            f"--gcp and --base tie one flight, not {len(sources)}; map the flights one by one"
        )
    if control is not None:
        return open_control(
            control, sources[0], ControlSettings(settings.control_sigma_m, checks=settings.checks)
        )
    assert base is not None
    return open_base(base, sources[0])


def _map_one(
    flight: OpenedFlight,
    archive: Archive,
    settings: MapSettings,
    area: Area | None,
    detector: ObjectDetector | None,
    coverage: FlightCoverage,
    search: "SearchWhileFlying | None",
) -> Generator[MosaicUpdate]:
    started_s, source = time.monotonic(), flight.setup.source
    refuse_without_texture(source)
    m_per_px = archive.site().m_per_px if archive.has_site else settings.m_per_px
    check_room(flight.setup, archive, m_per_px)
    room = LiveRoom(flight.setup, archive.folder, m_per_px)
    flight = flight.noting(*repeated(archive, flight.setup, "mapped"))
    setup, method = flight.setup, settings.method
    memo = flight.cache(archive) if method is None else ResultCache()
    finder = None
    if detector is not None:
        live_folder = archive.folder if isinstance(source, LiveSource) else None
        finder = ObjectFinder(
            detector, source.camera.camera, settings.classes, live_folder=live_folder, memo=memo
        )
    begun: FlightRun = (
        PlanarRun(setup, archive, settings, None, finder, memo, flight.request, coverage)
        if method is None
        else method.begin(setup, archive, settings, finder, flight.request)
    )
    with begun as run, nullcontext() if search is None else search:
        for selected in itertools.chain(_kept(memo), _selected(setup, settings, area)):
            frame = selected if isinstance(selected, LostFrame) else selected.posed.frame
            status, reason, painted = run.take(selected)
            if run.selected == _FEW and run.by_vision <= _FEW // 4 and method is None:
                _refuse_view_aside(setup, run.by_vision)
            room.look(run.selected)
            coverage.show(run.pictures_on_ground)
            if search is not None and status is not Status.REJECTED:
                search.take(run, archive, frame.index)
            is_lost = isinstance(frame, LostFrame)
            yield MosaicUpdate(
                source.name,
                frame.name,
                status,
                reason,
                frame.index + 1,
                source.frame_count,
                run.selected,
                run.by_vision,
                painted,
                time.monotonic() - started_s,
                None if is_lost else run.view(frame.index, frame.time_ns),
                memo.has_ended(frame.index),
            )
        if search is not None:
            search.land()
        run.finish(source.notices(), started_s)


def _refuse_view_aside(setup: FlightSetup, matched: int) -> None:
    """Raise InputError for a recorded flight that looks to the side all along and whose pictures do not fit."""
    tilt_deg = 0.0 if isinstance(setup.source, LiveSource) else setup.usual_tilt_deg
    if tilt_deg > OBLIQUE_DEG:
        raise InputError(
            f"{setup.source.name}: the camera looks {tilt_deg:.0f} deg away from straight down (an orbit?), and of the "
            f"first {_FEW} pictures {matched} fit: this makes no map; fly strips with the camera straight down, or give "
            "the photos that look down"
        )


def _kept(memo: ResultCache) -> Iterator[Selected | LostFrame]:
    """Yield the frames that a killed run had selected of a stream."""
    for kept in memo.kept_frames():
        if kept.prior is None:
            yield LostFrame(kept.index, kept.name, kept.time_ns, kept.reason)
        else:
            yield Selected(PosedFrame(kept.frame, kept.prior), kept.reason)


def _selected(
    setup: FlightSetup, settings: MapSettings, area: Area | None
) -> Iterator[Selected | LostFrame]:
    """Yield a flight's keyframes. Of a recorded video no more is decoded than they need."""
    source, small = setup.source, SmallCopies()
    selection = SelectionSettings(
        overlap=settings.overlap, least_overlap=min(0.5, settings.overlap)
    )
    is_planar = settings.method is None
    wanted = every(setup.plan.step_s)
    if isinstance(source, VideoSource) and is_planar:
        sparse = SparseReading(
            setup.plan.step_s,
            lambda *_: True,
            lambda before, after: shows_all_between(small.of(before), small.of(after), selection),
        )
        frames = source.frames(wanted, sparse)
    else:
        frames = source.frames(wanted)
    with ExitStack() as stack:
        # photos and live sources have threads of their own
        if not isinstance(source, LiveSource) and source.kind != "photos":
            frames = stack.enter_context(closing(read_ahead(frames, _AHEAD)))
        yield from select_keyframes(
            (
                frame
                if isinstance(frame, LostFrame)
                else PosedFrame(frame, setup.prior(frame, first=frame.index == 0))
                for frame in frames
            ),
            selection,
            keep_all=source.kind == "photos" or (not is_planar and setup.track is not None),
            inside=setup.inside(area),
            small=small,
        )
