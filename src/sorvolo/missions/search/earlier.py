"""Flights that earlier searches measured, put together with one that goes on: their frames looked at, not searched."""

from collections import deque
from collections.abc import Sequence
from dataclasses import replace
from functools import partial

from sorvolo.errors import InputError
from sorvolo.geometry.arrays import PointsM
from sorvolo.missions.search.frames import flights_to_search, marked_heights, search_frames
from sorvolo.missions.search.measure import (
    MeasuredClass,
    MeasuredFlight,
    SearchedPlants,
    SearchFrame,
    look_of,
    measured_class,
    plants_of,
    reach_m,
    sun_at,
)
from sorvolo.missions.search.measured_before import Basis, read_plants
from sorvolo.missions.search.prepare import PreparedSearch
from sorvolo.missions.search.settings import SearchOutputs, SearchSettings
from sorvolo.search.cells import Cells, cells_of
from sorvolo.search.conditions import AboveGround, Gathering
from sorvolo.store.site.archive import Archive
from sorvolo.survey.flight import Site


class EarlierFlights:
    """The flights of a site but one, as far as earlier searches into the same folder measured them on the same basis.

    `look` takes one frame at a time, so that it can be called between others' work; a flight counts once all its frames
    were looked at.
    """

    def __init__(
        self,
        archive: Archive,
        but: str,
        prepared: PreparedSearch,
        settings: SearchSettings,
        outputs: SearchOutputs,
    ) -> None:
        site, before = archive.site(), read_plants(outputs.folder)
        self._left: deque[_Flight] = deque()
        self._measured: list[tuple[Cells, MeasuredFlight]] = []
        self.frames: dict[str, tuple[SearchFrame, ...]] = {}
        """Of the flights that count, by their names."""
        self._outlines_m: dict[str, list[PointsM]] = {}
        for name in flights_to_search(archive, ()):
            frames = [] if name == but else _frames_of(archive, name)
            if not frames:
                continue
            self._outlines_m[name] = [each.placed.outline_m for each in frames]
            above, mark = marked_heights(archive, name)
            basis = Basis.of(frames, prepared, settings, heights=mark)
            known, searched = before.get(name, (None, None))
            if known is not None and searched is not None and known.serves(basis):
                self._left.append(
                    _Flight(name, frames, site, basis.classes, searched, above, settings)
                )

    @property
    def uncounted_m(self) -> list[PointsM]:
        """The ground of each frame of the flights that do not count yet, or never will, (4, 2) site metres."""
        return [
            each
            for name, own in self._outlines_m.items()
            if name not in self.frames
            for each in own
        ]

    def look(self) -> bool:
        """Look at one more frame; whether there was one."""
        if not self._left:
            return False
        flight = self._left.popleft()  # and left out where one of its pictures cannot be read
        flight.look()
        if flight.is_whole:
            self._measured.append((flight.cells, flight.measured()))
            self.frames[flight.name] = tuple(flight.frames)
        else:
            self._left.appendleft(flight)
        return True

    def on(self, cells: Cells) -> list[MeasuredFlight]:
        """The flights that count by now, over other cells of the site: each cell has what theirs has at its middle."""
        moved = []
        for own, flight in self._measured:
            rows = own.rows_at(cells.centres_m)
            classes = [
                replace(each, seen=each.seen.at(rows), chances=each.chances.at(rows))
                for each in flight.classes
            ]
            moved.append(replace(flight, classes=tuple(classes)))
        return moved


class _Flight:
    """One flight while its frames are looked at."""

    def __init__(
        self,
        name: str,
        frames: Sequence[SearchFrame],
        site: Site,
        labels: Sequence[str],
        searched: SearchedPlants,
        above: AboveGround | None,
        settings: SearchSettings,
    ) -> None:
        self.name, self.frames, self._settings, self._searched = name, frames, settings, searched
        self.cells = cells_of([each.placed.outline_m for each in frames], site, None)
        self._sun, self._has_heights = (
            sun_at(frames[len(frames) // 2], site, settings),
            above is not None,
        )
        on = partial(Gathering, above=above)
        self._cells = {label: on(self.cells.centres_m, reach_m(label)) for label in labels}
        self._plants = {
            label: on(plants_of(label, searched.plants)[0], reach_m(label)) for label in labels
        }
        self._looked, self._is_thermal, self._blur_px = 0, False, 0.0

    @property
    def is_whole(self) -> bool:
        """Whether all frames were looked at."""
        return self._looked == len(self.frames)

    def look(self) -> None:
        """Look at the next frame."""
        light, look = look_of(self.frames[self._looked], self._sun)
        for each in (*self._cells.values(), *self._plants.values()):
            each.add(look)
        self._looked += 1
        self._is_thermal |= light.is_thermal
        self._blur_px = max(self._blur_px, light.blur_px)

    def measured(self) -> MeasuredFlight:
        """What its plants state of its own cells."""
        return MeasuredFlight(
            self.name,
            len(self.frames),
            self._searched,
            self._sun is not None,
            self._has_heights,
            self._is_thermal,
            self._blur_px,
            tuple(map(self._class, self._cells)),
            is_earlier=True,
        )

    def _class(self, label: str) -> MeasuredClass:
        seen, plants_seen = self._cells[label].conditions(), self._plants[label].conditions()
        return measured_class(
            label, seen, self._searched.plants, lambda _, __: plants_seen, self._settings
        )


def _frames_of(archive: Archive, name: str) -> list[SearchFrame]:
    """The frames of a flight that have a place; none of one that would have to be mapped again."""
    try:
        return search_frames(archive, name)
    except InputError:
        return []
