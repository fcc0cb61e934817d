"""`sorvolo search`: a site's flights measured, and what a search of the area would have found written down."""

from collections.abc import Generator, Mapping, Sequence
from dataclasses import dataclass, fields
from math import nan
from pathlib import Path
from typing import Any

from sorvolo.errors import InputError
from sorvolo.missions.flight.detector_protocol import FindsObjects
from sorvolo.missions.mission import is_good, mission
from sorvolo.missions.search.earlier import Basis, read_plants, write_plants
from sorvolo.missions.search.measure import (
    MeasuredFlight,
    SearchFrame,
    SearchProgress,
    measure_flight,
)
from sorvolo.missions.search.prepare import (
    PreparedSearch,
    check_area,
    flights_to_search,
    known_places,
    marked_heights,
    prepare_search,
    search_frames,
    site_with_metres,
)
from sorvolo.missions.search.report import Searched, write_search
from sorvolo.missions.search.settings import SearchOutputs, SearchSettings
from sorvolo.missions.search.through_trees import seen_floor
from sorvolo.paths import AnyPath
from sorvolo.search.cells import Cells, cells_of
from sorvolo.search.recall import SearchFigures
from sorvolo.store.atomic import make_folder
from sorvolo.store.site.archive import Archive


@dataclass(frozen=True)
class SearchOutcome:
    """What a search measured, by class: its `figures`, and `holes_m2`, the ground without enough of a chance by reason.

    `trusted` is False where the `headline` names holes, or flights that do not count. `report` is search.json.
    """

    folder: Path
    headline: str
    trusted: bool
    figures: Mapping[str, SearchFigures]
    holes_m2: Mapping[str, Mapping[str, float]]
    warnings: tuple[str, ...]
    report: Mapping[str, Any]


@mission
def search_site(
    site_folder: AnyPath,
    settings: SearchSettings,
    outputs: SearchOutputs,
    detector: FindsObjects | None = None,
) -> Generator[SearchProgress, None, SearchOutcome]:
    """Measure the flights of a site, yielding progress; files appear in `outputs.folder`.

    The probability that a person, or a car, who lay anywhere in the area would have been reported is learnt from ones
    drawn into the flights' own frames. Raises InputError for a site without metres or flights, and for a model that is
    not installed; what `prepare_search` refuses is refused before any work.
    """
    site_folder = Path(site_folder)
    prepared = prepare_search(settings, outputs, detector)
    area = prepared.area
    with Archive.open(site_folder, write=False) as archive:
        site = site_with_metres(archive)
        check_area(area, site)
        names = flights_to_search(archive, outputs.flights)
        frames = {name: own for name in names if (own := search_frames(archive, name))}
        if not frames:
            raise InputError(
                f"{site_folder} has no mapped flight with a place on the ground: sorvolo map INPUT --site {site_folder} "
                "makes one"
            )
        outlines_m = [each.placed.outline_m for own in frames.values() for each in own]
        cells = cells_of(outlines_m, site, None if area is None else area.polygons_m(site.frame))
        measured = yield from _measured(frames, cells, archive, prepared, settings, outputs.folder)
        first, looks = measured[0].classes[0].label, archive.searches()
        looked = {each.date for each in looks if len(each.frames.for_class(first))}
        searched = Searched(
            site,
            cells,
            tuple(measured),
            {name: tuple(own) for name, own in frames.items()},
            prepared.segments,
            [name for name in frames if name not in looked],
            [name for name in names if name not in frames],
            prepared.cut_outs,
        )
        report = write_search(
            searched, archive.tiles(), archive.site_grid(), settings, outputs, prepared.detector
        )
    headline, rows = report["headline"], report["classes"].items()
    names = [each.name for each in fields(SearchFigures)]
    return SearchOutcome(
        outputs.folder,
        headline["text"],
        is_good(headline),
        {
            label: SearchFigures(*(nan if row[each] is None else row[each] for each in names))
            for label, row in rows
        },
        {label: row["holes_m2"] for label, row in rows},
        tuple(report["warnings"]),
        report,
    )


def _measured(
    frames: Mapping[str, Sequence[SearchFrame]],
    cells: Cells,
    archive: Archive,
    prepared: PreparedSearch,
    settings: SearchSettings,
    folder: Path,
) -> Generator[SearchProgress, None, list[MeasuredFlight]]:
    """Each flight measured, one after the other; what an earlier search of the same measured is taken from it."""
    site, known_m, measured = archive.site(), known_places(archive), []
    mapped, before = flights_to_search(archive, ()), read_plants(folder)
    known = {name: each for name, each in before.items() if name in mapped}
    for name, own in frames.items():
        above, mark = marked_heights(archive, name)
        basis = Basis.of(own, prepared, settings, heights=mark)
        earlier = known[name][1] if name in known and known[name][0] == basis else None
        flight = yield from measure_flight(
            name,
            own,
            cells,
            site,
            prepared.detector,
            settings,
            known_m,
            above,
            earlier,
            prepared.cut_outs,
        )
        measured.append(flight)
        if earlier is None:
            known[name] = basis, flight.searched
            make_folder(folder)
            write_plants(folder, site, known)
        if (floor := seen_floor(folder, archive, name)) is not None:
            measured[-1] = flight.with_floor(floor, cells)
    return measured
