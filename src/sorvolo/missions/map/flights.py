"""Mode 1, first flight: sources to a map in a site folder, frame by frame."""

import threading
import time
import warnings
from collections.abc import Generator, Sequence
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from sorvolo.capture.areas import read_area
from sorvolo.capture.live.addresses import is_live_address
from sorvolo.capture.live.reconnect import LiveSettings
from sorvolo.capture.source import LiveSource, Source, opened_sources
from sorvolo.errors import SettingsError, SorvoloWarning
from sorvolo.missions.flight.base_map import open_base
from sorvolo.missions.flight.control import open_control
from sorvolo.missions.flight.detector_protocol import ObjectDetector
from sorvolo.missions.flight.disk import LiveRoom, check_room
from sorvolo.missions.flight.live_journal import SourceNotes
from sorvolo.missions.flight.map_objects import ObjectFinder, open_detector
from sorvolo.missions.flight.request import AlreadyDone, already_done, request_of
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
from sorvolo.missions.map.coverage import FlightCoverage
from sorvolo.missions.map.journal import Earlier, MapJournal, Step, begun_journal, go_on_live
from sorvolo.missions.map.planar_run import PlanarRun
from sorvolo.missions.map.reader import FrameReader
from sorvolo.missions.map.run import FlightRun
from sorvolo.missions.map.thesis_run import ThesisRun
from sorvolo.mosaic.control import ControlSettings
from sorvolo.mosaic.selection import SelectionSettings, select_keyframes
from sorvolo.store.exports.waypoints import check_waypoint_files
from sorvolo.store.site.archive import Archive
from sorvolo.store.site.catalogue_place import Catalogues
from sorvolo.survey.area import Area
from sorvolo.survey.flight import Frame, LostFrame
from sorvolo.survey.mosaic import MosaicUpdate, Status

if TYPE_CHECKING:  # `map` alone has no use for what plants and searches
    from sorvolo.missions.search.while_flying import SearchWhileFlying


def map_flights(
    inputs: Sequence[Path | str],
    site: Path,
    settings: MapSettings = MapSettings(),
    *,
    telemetry: Path | str | None = None,
    camera: Path | str | None = None,
    area: Path | None = None,
    detector: ObjectDetector | None = None,
    live: LiveSettings = LiveSettings(keeps_all=True),
    until: threading.Event | None = None,
    control: Path | None = None,
    base: Path | None = None,
    again: bool = False,
    refly: Sequence[Path] = (),
    catalogues: Catalogues | None = None,
    search: "SearchWhileFlying | None" = None,
) -> Generator[MosaicUpdate, None, tuple[AlreadyDone, ...]]:
    """Map one or more flights into the site folder, yielding an update for each selected frame.

    `inputs` are videos, folders of photos, photos, or live sources (see `open_sources`); `telemetry` a file of the
    only flight (else what lies in or beside it is used), or a receiver's link; `camera` a calibration file, a preset's
    name, "aov=DEG" or "focal_px=PX"; `area` a polygon outside of which frames are not used; `detector` one that finds
    objects in place of the model that the settings name; `control` a file of the only flight's control points
    (gcp_list.txt), `base` a GeoTIFF or a site folder whose map shows its ground, to which it is tied. A live
    flight is read, by the settings `live`, until it ends or `until` is set; then its map is finished like any other's.
    Nothing of a flight is part of the site until its last update was yielded.
    A run that was killed continues when the same is asked for again. A flight that the site has already, by
    the same files, settings and version of the program, is left out and returned, unless `again` is given.
    `catalogues` is where a new site's catalogue goes; None: where the environment has it.
    `refly` are files for waypoints over ground that the pictures leave out, kept up to date while the flight goes on.
    `search` measures a live flight's probability of detection meanwhile.
    Raises InputError, SettingsError or StoreError with what to do; the site then stays as it was. Close the generator
    to stop early: the flight that is being mapped is left out, those before it are in.
    """
    check_waypoint_files(refly, site)
    wanted = None if area is None else read_area(area)
    is_live = any(is_live_address(str(each)) for each in inputs)
    looks = open_detector(settings.model, is_live=is_live) if detector is None else detector
    opened = opened_sources(
        inputs, telemetry, camera, known_flights(site, catalogues), live=live, until=until
    )
    with opened as sources, Archive.open(site, write=True, catalogues=catalogues) as archive:
        ground = _known_ground(control, base, sources, settings)
        known = []
        asked = replace(settings, live_s=0.0, memory_mb=None), wanted, looks
        for source in sources:
            samples = go_on_live(source, archive, asked, live.same_flight_s, anew=again)
            setup = prepare(
                source,
                settings,
                archive.site() if archive.has_site else None,
                telemetry_named=telemetry is not None,
                ground_m=known_ground_m(archive),
                known_ground=ground,
                founds_site=founds_site(archive, source.name),
            )
            request = request_of(setup, *asked)
            mapped = already_done(archive, setup, request)
            if mapped and not again:
                known.append(mapped)
                continue
            coverage = FlightCoverage(setup, archive, wanted, refly, settings.live_s)
            yield from _map_one(
                setup,
                archive,
                settings,
                wanted,
                looks,
                request,
                coverage,
                anew=again and mapped is None,
                samples=samples,
                search=search if isinstance(source, LiveSource) else None,
            )
        return tuple(known)


def _known_ground(
    control: Path | None, base: Path | None, sources: Sequence[Source], settings: MapSettings
) -> KnownGround | None:
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
    _refuse_ties(len(sources), settings)
    if control is not None:
        return open_control(
            control, sources[0], ControlSettings(settings.control_sigma_m, checks=settings.checks)
        )
    assert base is not None
    return open_base(base, sources[0])


def _refuse_ties(flights: int, settings: MapSettings) -> None:
    """Raise SettingsError where a map cannot be tied to known ground."""
    if settings.method != "planar":
        raise SettingsError("--gcp and --base tie maps of method planar only; leave --method out")
    if flights != 1:
        raise SettingsError(
            f"--gcp and --base tie one flight, not {flights}; map the flights one by one"
        )


def _map_one(
    setup: FlightSetup,
    archive: Archive,
    settings: MapSettings,
    area: Area | None,
    detector: ObjectDetector | None,
    request: str,
    coverage: FlightCoverage,
    *,
    anew: bool,
    samples: int,
    search: "SearchWhileFlying | None",
) -> Generator[MosaicUpdate]:
    started_s, source = time.monotonic(), setup.source
    refuse_without_texture(source)
    m_per_px = archive.site().m_per_px if archive.has_site else settings.m_per_px
    check_room(setup, archive, m_per_px)
    room = LiveRoom(setup, archive.folder, m_per_px)
    setup = replace(setup, notices=(*setup.notices, *repeated(archive, source, "mapped")))
    live_folder = archive.folder if isinstance(source, LiveSource) else None
    finder = (
        None
        if detector is None
        else ObjectFinder(detector, source.camera.camera, settings.classes, live_folder=live_folder)
    )
    begun = _begun(setup, archive, settings, finder, request, coverage, anew=anew, samples=samples)
    with begun as run, nullcontext() if search is None else search:

        def update(
            frame: Step | LostFrame | Frame, ended: tuple[Status, str, int], read: int
        ) -> MosaicUpdate:
            view = None if isinstance(frame, LostFrame) else run.view(frame.index, frame.time_ns)
            if search is not None and ended[0] is not Status.REJECTED:
                search.take(run, archive, frame.index)
            return MosaicUpdate(
                source.name,
                frame.name,
                ended[0],
                ended[1],
                read,
                source.frame_count,
                run.selected,
                max(setup.plan.expected, run.selected),
                run.by_vision,
                ended[2],
                time.monotonic() - started_s,
                view,
                isinstance(frame, Step),
            )

        before = Earlier()
        for step, ended in run.take_over():
            before.take(step)
            yield update(step, ended, step.index + 1)
        before.search(run.is_unsearched)
        selection = SelectionSettings(
            overlap=settings.overlap, least_overlap=min(0.5, settings.overlap)
        )
        reader = FrameReader(setup, before, selection if settings.method == "planar" else None)
        selected = select_keyframes(
            reader.posed(run.look),
            selection,
            keep_all=source.kind == "photos"
            or (settings.method == "thesis" and setup.track is not None),
            inside=setup.inside(area),
            memory=before.memory,
            small=reader.small,
        )
        for each in selected:
            ended = run.take(each)
            room.look(run.selected)
            coverage.show(run.pictures_on_ground)
            yield update(
                each if isinstance(each, LostFrame) else each.posed.frame, ended, reader.read
            )
        if search is not None:
            search.land()
        run.finish(source.notices(), started_s)


def _begun(
    setup: FlightSetup,
    archive: Archive,
    settings: MapSettings,
    finder: ObjectFinder | None,
    request: str,
    coverage: FlightCoverage,
    *,
    anew: bool,
    samples: int,
) -> FlightRun:
    """The run of one flight, which notes how far it is, and goes on where a killed one was.

    `samples` of a live flight's telemetry are noted already.
    """
    file, source = begun_journal(setup, archive, request, anew=anew), setup.source
    if settings.method == "thesis":
        if file.is_begun:
            text = f"{source.name}: a stopped run begins again from the start: --method thesis cannot continue one"
            warnings.warn(text, SorvoloWarning, stacklevel=2)
            file = begun_journal(setup, archive, request, anew=True)
        return ThesisRun(setup, archive, settings, finder, MapJournal(file), request)
    journal = MapJournal(
        file, SourceNotes(file, source, samples) if isinstance(source, LiveSource) else None
    )
    return PlanarRun(
        setup, archive, settings, finder=finder, journal=journal, request=request, coverage=coverage
    )
