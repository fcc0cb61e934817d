"""The beginning that all missions over a site share: a flight is laid into the site, unless that was done already."""

import warnings
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Any

from sorvolo.build import added
from sorvolo.capture.source import Source
from sorvolo.errors import SorvoloWarning
from sorvolo.missions.flight.request import already_done, request_of
from sorvolo.missions.flight.result_cache import ResultCache, cache_of_run, go_on_live
from sorvolo.missions.flight.setup import FlightSetup
from sorvolo.missions.mission import FlightOutcome, flight_outcome
from sorvolo.store.site.archive import Archive
from sorvolo.survey.flight import Notice


@dataclass(frozen=True, eq=False)
class OpenedFlight:
    """A flight that is to be worked on; `request` is what is asked for, `anew` discards what a killed run left."""

    setup: FlightSetup
    request: str
    anew: bool

    def cache(self, archive: Archive) -> ResultCache:
        """Return the run's cache. Results of other runs are deleted by that: first refuse what has to be refused."""
        return cache_of_run(self.setup, archive, self.request, anew=self.anew)

    def noting(self, *notices: Notice) -> "OpenedFlight":
        """Return the flight with further notices for its report."""
        setup = replace(self.setup, notices=(*self.setup.notices, *notices))
        return replace(self, setup=setup)


def opened_flights(
    sources: Iterable[Source],
    archive: Archive,
    asked: Callable[[Source], tuple[Any, ...]],
    prepared: Callable[[Source], FlightSetup],
    *,
    most_gap_s: float,
    again: bool,
) -> Iterator[OpenedFlight | FlightOutcome]:
    """Lay one flight after the other into the site; without `again`, those that the site has as asked for are named.

    `asked` is what a flight's result depends on besides itself: the settings, the area, the detector, and more (see
    `request_of`). A live flight goes on with a killed run's, unless that ended more than `most_gap_s` ago.
    """
    for source in sources:
        wanted = asked(source)
        if not again:
            go_on_live(source, archive, wanted, most_gap_s)
        setup = prepared(source)
        request = request_of(setup, *wanted)
        done = already_done(archive, setup, request)
        if done and not again:
            yield outcome_of(archive, source.name, done)
        else:
            yield OpenedFlight(setup, request, anew=again and not done)


def outcome_of(archive: Archive, flight: str, done_utc: str = "") -> FlightOutcome:
    """What a site has of a flight. One that is new to it is given to the exports that packages add."""
    folder = archive.flight_folder(flight)
    for name, load in ({} if done_utc else added("exports")).items():
        try:
            load()(archive.folder, flight)
        except Exception as error:  # the flight is in the site, whatever others make of it
            text = f"the export {name!r} of {flight} failed: {type(error).__name__}: {error}"
            warnings.warn(text, SorvoloWarning, stacklevel=2)
    more = archive.folder.glob("mosaic.*")
    return flight_outcome(folder, archive.report(flight), more, done_utc)
