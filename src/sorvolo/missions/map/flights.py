"""Mode 1, first flight: sources to a map in a site folder, frame by frame."""

import threading
import time
from collections.abc import Generator, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from sorvolo.capture.areas import read_area
from sorvolo.capture.live.reconnect import LiveSettings
from sorvolo.capture.source import Source, opened_sources
from sorvolo.errors import SettingsError
from sorvolo.missions.flight.base_map import open_base
from sorvolo.missions.flight.control import open_control
from sorvolo.missions.flight.detects import Detects
from sorvolo.missions.flight.glimpses import refuse_without_texture
from sorvolo.missions.flight.map_objects import ObjectFinder, open_detector
from sorvolo.missions.flight.settings import MapSettings
from sorvolo.missions.flight.setup import KnownGround, known_flights, known_ground_m, prepare, repeated
from sorvolo.missions.map.planar_run import PlanarRun
from sorvolo.missions.map.run import FlightRun
from sorvolo.missions.map.thesis_run import ThesisRun
from sorvolo.mosaic.control import ControlSettings
from sorvolo.mosaic.selection import Selected, SelectionSettings, every, select_keyframes
from sorvolo.store.site.archive import Archive
from sorvolo.survey.area import Area
from sorvolo.survey.flight import Frame, LostFrame, PosedFrame
from sorvolo.survey.mosaic import MosaicUpdate, Status


def map_flights(
    inputs: Sequence[Path | str], site: Path, settings: MapSettings = MapSettings(), *,  # noqa: B008 (frozen)
    telemetry: Path | str | None = None, camera: Path | str | None = None, area: Path | None = None,
    detector: Detects | None = None, live: LiveSettings = LiveSettings(keeps_all=True),  # noqa: B008 (frozen)
    until: threading.Event | None = None, control: Path | None = None,
    base: Path | None = None,
) -> Generator[MosaicUpdate]:
    """Map one or more flights into the site folder, yielding an update for each selected frame.

    `inputs` are videos, folders of photos, photos, or live sources (see `open_sources`); `telemetry` a file of the
    only flight (else what lies in or beside it is used), or a receiver's link; `camera` a calibration file, a preset's
    name, "aov=DEG" or "focal_px=PX"; `area` a polygon outside of which frames are not used; `detector` one that finds
    objects in place of the model that the settings name; `control` a file of the only flight's control points
    (gcp_list.txt), `base` a GeoTIFF or a site folder whose map shows its ground, to which it is tied. A live
    flight is read, by the settings `live`, until it ends or `until` is set; then its map is finished like any other's.
    Nothing of a flight is part of the site until its last update was yielded.
    Raises InputError, SettingsError or StoreError with what to do; the site then stays as it was. Close the generator
    to stop early: the flight that is being mapped is left out, those before it are in.
    """
    if control is not None and base is not None:
        raise SettingsError("a map is tied to control points (--gcp) or to a base map (--base), not to both")
    if settings.checks and control is None:
        raise SettingsError("check points (--check) are of a control point file: give it with --gcp")
    wanted = None if area is None else read_area(area)
    looks = open_detector(settings.model) if detector is None else detector
    opened = opened_sources(inputs, telemetry, camera, known_flights(site), live=live, until=until)
    with opened as sources, Archive.open(site, write=True) as archive:
        ground = _known_ground(control, base, sources, settings)
        for source in sources:
            yield from _map_one(source, archive, settings, wanted, looks, ground, telemetry_named=telemetry is not None)


def _known_ground(
    control: Path | None, base: Path | None, sources: Sequence[Source], settings: MapSettings
) -> KnownGround | None:
    if control is None and base is None:
        return None
    if settings.method != "planar":
        raise SettingsError("--gcp and --base tie maps of method planar only; leave --method out")
    if len(sources) != 1:
        raise SettingsError(f"--gcp and --base tie one flight, not {len(sources)}; map the flights one by one")
    if control is not None:
        return open_control(control, sources[0], ControlSettings(settings.control_sigma_m, checks=settings.checks))
    assert base is not None
    return open_base(base, sources[0])


def _map_one(
    source: Source, archive: Archive, settings: MapSettings, area: Area | None, detector: Detects | None,
    ground: KnownGround | None, *, telemetry_named: bool,
) -> Generator[MosaicUpdate]:
    started_s = time.monotonic()
    setup = prepare(
        source, settings, archive.site() if archive.has_site else None, telemetry_named=telemetry_named,
        ground_m=known_ground_m(archive), known_ground=ground,
    )
    refuse_without_texture(source)
    setup = replace(setup, notices=(*setup.notices, *repeated(archive, source.name, "mapped")))
    make = ThesisRun if settings.method == "thesis" else PlanarRun
    finder = None if detector is None else ObjectFinder(detector, source.camera.camera, settings.classes)
    with make(setup, archive, settings, finder=finder) as run:
        read = 0

        def posed() -> Iterator[PosedFrame | LostFrame]:
            nonlocal read
            for each in source.frames(every(setup.plan.step_s)):
                read = each.index + 1
                yield PosedFrame(each, setup.prior(each, first=read == 1)) if isinstance(each, Frame) else each

        selection = SelectionSettings(overlap=settings.overlap, least_overlap=min(0.5, settings.overlap))
        selected = select_keyframes(
            posed(), selection,
            keep_all=source.kind == "photos" or (settings.method == "thesis" and setup.track is not None),
            inside=setup.inside(area),
        )
        for each in selected:
            status, reason, tiles = _take(run, each)
            name = each.name if isinstance(each, LostFrame) else each.posed.frame.name
            view = None if isinstance(each, LostFrame) else run.view(each.posed)
            yield MosaicUpdate(
                name, status, reason, read, source.frame_count, run.selected,
                max(setup.plan.expected, run.selected), run.by_vision, tiles, time.monotonic() - started_s,
                view,
            )
        run.finish(source.notices(), started_s)


def _take(run: FlightRun, each: Selected | LostFrame) -> tuple[Status, str, int]:
    if isinstance(each, LostFrame):
        return run.lose(each.index, each.name, each.time_ns, each.reason)
    if each.reason:
        frame = each.posed.frame
        return run.lose(frame.index, frame.name, frame.time_ns, each.reason)
    run.look(each.posed)
    return run.add(each.posed)
