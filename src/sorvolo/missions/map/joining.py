"""The blocks of a divided flight joined into one map: one graph of all links, solved as if one machine had done it."""

import time
from collections.abc import Generator, Sequence, Set
from dataclasses import replace
from pathlib import Path

from sorvolo.capture.source import Source, opened_sources
from sorvolo.capture.video import VideoSource
from sorvolo.errors import SettingsError, StoreError
from sorvolo.missions.flight.disk import check_room
from sorvolo.missions.flight.map_objects import FrameDetections, ObjectFinder, open_detector
from sorvolo.missions.flight.request import AlreadyDone, already_done, request_of
from sorvolo.missions.flight.settings import MapSettings
from sorvolo.missions.flight.setup import FlightSetup, known_flights, repeated
from sorvolo.missions.map.blocks import Division, most_blocks, prepare_divided
from sorvolo.missions.map.chosen_frames import ChosenFrames
from sorvolo.missions.map.coverage import FlightCoverage
from sorvolo.missions.map.journal import MapJournal, Step, begun_journal
from sorvolo.missions.map.planar_run import PlanarRun
from sorvolo.missions.map.tile_shares import PaintsElsewhere
from sorvolo.store.site.archive import Archive
from sorvolo.survey.flight import Notice
from sorvolo.survey.mosaic import MosaicUpdate, Status


def plan_blocks(
    source: Path,
    site: Path,
    settings: MapSettings,
    camera: Path | str | None,
    count: int,
    folder: Path,
) -> Division | AlreadyDone:
    """How to divide a flight into `count` blocks, fewer where it is small; or what the site has of it already.

    `folder` is where the blocks' files go. Raises InputError or SettingsError for a flight that cannot be divided, and
    for a site that shows other flights.
    """
    looks = open_detector(settings.model)
    with opened_sources([source], None, camera, known_flights(site)) as sources:
        setup = prepare_divided(sources[0], settings)
        with Archive.open(site, write=True) as archive:
            _demand_new(archive, setup)
            request = request_of(setup, replace(settings, live_s=0.0, memory_mb=None), None, looks)
            if (mapped := already_done(archive, setup, request)) is not None:
                return mapped
            check_room(setup, archive, settings.m_per_px)
        return Division(
            folder, request, min(count, most_blocks(setup)), isinstance(sources[0], VideoSource)
        )


def join_blocks(
    source: Path,
    site: Path,
    settings: MapSettings,
    camera: Path | str | None,
    division: Division,
    elsewhere: PaintsElsewhere,
) -> Generator[MosaicUpdate, None, str]:
    """Make one map of a flight's blocks, an update for each picture; the flight's name in the site.

    All links go into one graph, which is solved as a whole; `elsewhere` paints the tiles. Raises InputError when no
    picture has a place, StoreError where blocks are missing; the site then stays as it was.
    """
    started_s = time.monotonic()
    looks = open_detector(settings.model)
    opened = opened_sources([source], None, camera, known_flights(site))
    with opened as sources, Archive.open(site, write=True) as archive:
        setup = prepare_divided(sources[0], settings)
        setup = replace(setup, notices=(*setup.notices, *repeated(archive, setup.source, "mapped")))
        _demand_new(archive, setup)
        chosen = division.chosen()
        count = setup.source.frame_count if chosen is None else len(chosen.frames)
        finder = (
            None
            if looks is None
            else ObjectFinder(looks, setup.source.camera.camera, settings.classes)
        )
        journal = MapJournal(begun_journal(setup, archive, division.key, anew=True))
        coverage = FlightCoverage(setup, archive, None, (), settings.live_s)
        with PlanarRun(
            setup,
            archive,
            settings,
            finder=finder,
            journal=journal,
            request=division.key,
            coverage=coverage,
            elsewhere=elsewhere,
        ) as run:
            lost = set()
            for each in division.earlier():
                if isinstance(each, FrameDetections):
                    if finder is not None:
                        finder.take_over(each)
                    continue
                if each.memory is None:
                    lost.add(each.index)
                yield _update(run, each, _joined(run, each, division), setup, count, started_s)
            if run.selected != count:
                raise StoreError(
                    f"the blocks of {setup.source.name} hold {run.selected} of its {count} pictures; give the same "
                    "command again"
                )
            run.finish(_found_in(setup.source, lost, chosen), started_s)
        return setup.source.name


def _found_in(source: Source, lost: Set[int], chosen: ChosenFrames | None) -> Sequence[Notice]:
    """What was found in the flight's files; `lost` are the photos that could not be read."""
    if isinstance(source, VideoSource) and chosen is not None:
        source.reading = chosen.reading
        return chosen.notices
    for _ in source.frames(lambda index, _: index in lost):
        pass  # the source counts them
    return source.notices()


def _demand_new(archive: Archive, setup: FlightSetup) -> None:
    others = {each.flight_id for each in archive.versions() if each.complete} - {setup.source.name}
    if others:
        raise SettingsError(
            f"the site {archive.folder.name} shows {', '.join(sorted(others))} already: a flight in blocks makes a map "
            "of its own; leave --blocks out to join it to that map"
        )


def _joined(run: PlanarRun, step: Step, division: Division) -> tuple[Status, str]:
    if step.taken is None:
        return run.lose(step.index, step.name, step.time_ns, step.reason)[:2]
    return run.join(step, division.picture(step.index))


def _update(
    run: PlanarRun,
    step: Step,
    ended: tuple[Status, str],
    setup: FlightSetup,
    count: int,
    started_s: float,
) -> MosaicUpdate:
    return MosaicUpdate(
        setup.source.name,
        step.name,
        *ended,
        step.index + 1,
        setup.source.frame_count,
        run.selected,
        count,
        run.by_vision,
        0,
        time.monotonic() - started_s,
        run.view(step.index, step.time_ns),
    )
