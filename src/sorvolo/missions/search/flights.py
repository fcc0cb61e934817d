"""`sorvolo search`: a site's flights measured, and what a search of the area would have found written down."""

from collections.abc import Generator, Mapping, Sequence
from pathlib import Path
from typing import Any

from sorvolo.errors import InputError
from sorvolo.missions.flight.detector_protocol import ObjectDetector
from sorvolo.missions.search.files import write_search
from sorvolo.missions.search.frames import flights_to_search, heights_for, search_frames
from sorvolo.missions.search.measure import MeasuredFlight, SearchFrame, SearchProgress, measure_flight
from sorvolo.missions.search.prepare import known_places, prepare_search, site_with_metres
from sorvolo.missions.search.report import Searched
from sorvolo.missions.search.settings import SearchOutputs, SearchSettings
from sorvolo.search.cells import Cells, cells_of
from sorvolo.store.site.archive import Archive


def search_site(
    site_folder: Path, settings: SearchSettings, outputs: SearchOutputs, detector: ObjectDetector | None = None
) -> Generator[SearchProgress | dict[str, Any]]:
    """Measure the flights of a site, yielding progress and, at last, the report; files appear in `outputs.folder`.

    The probability that a person, or a car, who lay anywhere in the area would have been reported is learnt from ones
    drawn into the flights' own frames. Raises InputError for a site without metres or flights, and for a model that is
    not installed; what `prepare_search` refuses is refused before any work.
    """
    prepared = prepare_search(settings, outputs, detector)
    area, looks = prepared.area, prepared.detector
    with Archive.open(site_folder, write=False) as archive:
        site = site_with_metres(archive)
        names = flights_to_search(archive, outputs.flights)
        frames = {name: search_frames(archive, name) for name in names}
        if not frames:
            raise InputError(f"{site_folder} has no mapped flight: sorvolo map INPUT --site {site_folder} makes one")
        outlines_m = [each.placed.outline_m for own in frames.values() for each in own]
        cells = cells_of(outlines_m, site, None if area is None else area.polygons_m(site.frame))
        measured = yield from _measured(frames, cells, archive, looks, settings)
        searched = Searched(
            site, cells, tuple(measured), {name: tuple(own) for name, own in frames.items()}, prepared.segments
        )
        yield write_search(searched, archive.tiles(), archive.site_grid(), settings, outputs, looks)


def _measured(
    frames: Mapping[str, Sequence[SearchFrame]], cells: Cells, archive: Archive, detector: ObjectDetector,
    settings: SearchSettings,
) -> Generator[SearchProgress, None, list[MeasuredFlight]]:
    """Each flight measured, one after the other."""
    site, known_m, measured = archive.site(), known_places(archive), []
    for name, own in frames.items():
        for each in measure_flight(
            name, own, cells, site, detector, settings, known_m, heights_for(archive, name)
        ):
            if isinstance(each, MeasuredFlight):
                measured.append(each)
            else:
                yield each
    return measured
