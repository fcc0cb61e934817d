"""What a search would have found so far, measured while the flight goes on and its map grows."""

import threading
import time
import warnings
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Self

from sorvolo.errors import SorvoloError, SorvoloWarning
from sorvolo.missions.flight.detector_protocol import FindsObjects
from sorvolo.missions.flight.threads import lower_priority
from sorvolo.missions.map.planar_run import FlightRun
from sorvolo.missions.search.earlier import EarlierFlights
from sorvolo.missions.search.measure import GrowingMeasure
from sorvolo.missions.search.prepare import (
    PreparedSearch,
    check_area,
    heights_for,
    known_places,
    prepare_search,
    search_frame,
    site_with_metres,
)
from sorvolo.missions.search.report import Searched, SoFar, State, remove_figures, write_search
from sorvolo.missions.search.settings import SearchOutputs, SearchSettings
from sorvolo.store.atomic import write_page, writing
from sorvolo.store.pages.search import waiting_page
from sorvolo.store.site.archive import Archive
from sorvolo.store.site.catalogue import StoredKeyframe, utc_now
from sorvolo.survey.area import Area


@dataclass(frozen=True)
class MeasurePace:
    """How often the files are written anew."""

    again_s: float = 15.0
    rest: float = 4.0  # times as long as the last writing took: most of the time is the measure's
    look_s: float = 0.2  # until it is asked again whether there is a frame
    most_behind: int = (
        8  # frames that wait: of more every second is put off, so that new ground is measured soon
    )
    earlier: float = (
        1.0  # times as long as a picture is searched, those of earlier flights are looked at
    )
    land_s: float = 20.0  # for the frame that is being searched as the flight lands; a report that takes longer is lost


class SearchWhileFlying:
    """Measures a flight while it is mapped, in a thread of low priority; a context manager, whose end ends the thread.

    `take` is called for each frame that the map took, `land` when no more come. The files of `outputs` are written from
    time to time, with what the flight's frames so far state. Where the detector cannot keep up, every second frame is
    put off until it can: what it states then is too low rather than too high. A site without
    metres is measured by nobody, which a warning states; so is an error while measuring, for the map must not end by
    it. Raises what `prepare_search` raises.
    """

    def __init__(
        self,
        settings: SearchSettings,
        outputs: SearchOutputs,
        detector: FindsObjects | None = None,
        pace: MeasurePace = MeasurePace(),
    ) -> None:
        self._prepared: PreparedSearch = prepare_search(settings, outputs, detector, is_live=True)
        self._settings, self._outputs, self._pace = settings, outputs, pace
        self._unplaced: list[
            int
        ] = []  # frames that the map took, whose pictures it has not stored yet
        self._waiting: deque[StoredKeyframe] = deque()
        self._put_off: deque[StoredKeyframe] = deque()
        self._landed = threading.Event()
        # Python 3.11's join takes a thread for ended where Ctrl-C meets it: the process's end would abort it
        self._ended = threading.Event()
        self._thread: threading.Thread | None = None
        self._shown: Callable[[SoFar], None] | None = (
            None  # writes the last report again, in another state
        )
        self._last: SoFar | None = None
        self._has_warned = False
        self.written = 0
        """How often the files were written."""
        self.placed = 0
        """How many pictures have a place so far."""

    @property
    def area(self) -> Area | None:
        """The area that is to be searched; None for what is flown."""
        return self._prepared.area

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        self.land(State.LANDED if kind is None else State.STOPPED)

    def take(self, run: FlightRun, archive: Archive, index: int) -> None:
        """Have the frame of this index measured as soon as its picture is stored; called where the map is made."""
        if self._landed.is_set():
            return
        if not self.placed and not self._unplaced:
            self._write_waiting()
        self._unplaced.append(index)
        later = []
        for each in self._unplaced:
            stored = run.stored_frame(each)
            if stored is None:
                later.append(each)
            else:
                self._waiting.append(stored)
                self.placed += 1
        self._unplaced = later
        if self._thread is None and self._waiting:
            self._thread = threading.Thread(target=self._measure, args=(archive,), name="search")
            self._thread.start()

    def land(self, state: State = State.LANDED) -> None:
        """The flight is over: what waits is not measured any more, for its pictures are about to be put straight.

        The page then states that the flight has landed, or was stopped.
        """
        self._landed.set()
        if self._thread is not None:
            self._ended.wait(self._pace.land_s)
        if self._shown is None or self._last is None:
            if state is State.STOPPED and (
                self.placed or self._unplaced
            ):  # else an earlier search's page stands
                self._write_waiting(is_over=True)
        elif self._last.state is not state:
            self._last = replace(self._last, state=state)
            with self._warning():
                self._shown(self._last)

    def _write_waiting(self, *, is_over: bool = False) -> None:
        """A page that waits for the first figures, in the place of an earlier search's files; or waits no more."""
        with self._warning(), writing(self._outputs.folder):
            self._outputs.folder.mkdir(parents=True, exist_ok=True)
            if old := remove_figures(self._outputs):
                text = f"waypoints of an earlier search were taken away, as a flight begins: {', '.join(old)}"
                warnings.warn(text, SorvoloWarning, stacklevel=4)
            write_page(self._outputs.folder / "search.html", waiting_page(is_over=is_over))

    @contextmanager
    def _warning(self) -> Iterator[None]:
        """Turn a fault of the measure into a warning, the first one alone: the map goes on."""
        try:
            yield
        except Exception as error:
            if not self._has_warned and not self._landed.is_set():
                words = (
                    f"{error}"
                    if isinstance(error, SorvoloError)
                    else f"{type(error).__name__}: {error}"
                )
                text = f"the search is not measured whole while the flight goes on: {words}"
                warnings.warn(text, SorvoloWarning, stacklevel=3)
                self._has_warned = True

    def _measure(self, archive: Archive) -> None:
        lower_priority()
        try:
            with self._warning():
                self._measure_all(archive)
        finally:
            self._ended.set()

    def _measure_all(self, archive: Archive) -> None:
        site = site_with_metres(archive)
        area, flight_id = self._prepared.area, self._waiting[0].flight_id
        check_area(area, site)
        measure = GrowingMeasure(
            flight_id,
            site,
            self._prepared.detector,
            self._settings,
            area_m=None if area is None else area.polygons_m(site.frame),
            keep_off_m=known_places(archive),
            above=heights_for(archive, flight_id),
            cut_outs=self._prepared.cut_outs,
        )
        earlier = EarlierFlights(archive, flight_id, self._prepared, self._settings, self._outputs)
        unwritten, again_s = 0, time.monotonic() + self._pace.again_s
        while not self._landed.is_set():
            stored, began_s = self._next(), time.monotonic()
            if stored is not None:
                with self._warning():
                    frame = search_frame(archive, stored)
                    if frame is None:
                        self.placed -= 1
                    else:
                        measure.add(frame)
                        unwritten += 1
            counted = len(earlier.frames)
            # one picture of earlier flights, and more for a share of the time that this one took
            now_s, has_looked = time.monotonic(), False
            until_s = now_s + self._pace.earlier * (now_s - began_s)
            with self._warning():
                while earlier.look():
                    has_looked = True
                    if time.monotonic() >= until_s or self._landed.is_set():
                        break
            unwritten += len(earlier.frames) - counted
            if unwritten and measure.frames and time.monotonic() >= again_s:
                started_s = time.monotonic()
                with self._warning():
                    unwritten = 0 if self._write(measure, archive, earlier) else unwritten
                took_s = time.monotonic() - started_s
                again_s = time.monotonic() + max(self._pace.again_s, self._pace.rest * took_s)
            elif stored is None and not has_looked:
                self._landed.wait(self._pace.look_s)

    def _next(self) -> StoredKeyframe | None:
        """The frame that is measured next: in their order, those that were put off when no others wait."""
        if len(self._waiting) > self._pace.most_behind:
            behind = [self._waiting.popleft() for _ in range(len(self._waiting))]
            self._waiting.extendleft(reversed(behind[::2]))
            self._put_off.extend(behind[1::2])
        for queue in (self._waiting, self._put_off):
            if queue:
                return queue.popleft()
        return None

    def _write(self, measure: GrowingMeasure, archive: Archive, earlier: EarlierFlights) -> bool:
        """Write what is known by now; whether there is a map yet to show it on."""
        tiles, placed = archive.live_tiles(), self.placed
        if not tiles:
            return False
        cells, flight = measure.measured(
            [each.placed.outline_m for own in earlier.frames.values() for each in own]
        )
        searched = Searched(
            archive.site(),
            cells,
            (*earlier.on(cells), flight),
            {**earlier.frames, flight.name: tuple(measure.frames)},
            self._prepared.segments,
            unplaced=earlier.unplaced,
            cut_outs=self._prepared.cut_outs,
        )

        def show(so_far: SoFar) -> None:
            write_search(
                searched,
                tiles,
                archive.site_grid(),
                self._settings,
                self._outputs,
                self._prepared.detector,
                so_far,
                earlier.uncounted_m,
            )

        if self._landed.is_set():
            return False
        self._last = SoFar(
            flight.name, len(measure.frames), placed, utc_now(), State.FLYING, tuple(earlier.frames)
        )
        show(self._last)
        self._shown = show
        self.written += 1
        return True
