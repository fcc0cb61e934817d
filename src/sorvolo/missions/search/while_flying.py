"""What a search would have found so far, measured while the flight goes on and its map grows."""

import threading
import time
import warnings
from collections import deque
from dataclasses import dataclass
from types import TracebackType
from typing import Any, Self

from sorvolo.errors import SorvoloError, SorvoloWarning
from sorvolo.missions.flight.detector_protocol import ObjectDetector
from sorvolo.missions.flight.priority import lower_priority
from sorvolo.missions.map.run import FlightRun
from sorvolo.missions.search.files import write_search
from sorvolo.missions.search.frames import heights_for, search_frame
from sorvolo.missions.search.growing import GrowingMeasure
from sorvolo.missions.search.prepare import PreparedSearch, known_places, prepare_search, site_with_metres
from sorvolo.missions.search.report import Searched, SoFar
from sorvolo.missions.search.settings import SearchOutputs, SearchSettings
from sorvolo.store.site.archive import Archive
from sorvolo.store.site.catalogue import StoredKeyframe, utc_now


@dataclass(frozen=True)
class Pace:
    """How often the files are written anew."""

    again_s: float = 15.0
    rest: float = 4.0  # times as long as the last writing took: most of the time is the measure's
    look_s: float = 0.2  # until it is asked again whether there is a frame
    most_behind: int = 8  # frames that wait: of more every second is put off, so that new ground is measured soon


class SearchWhileFlying:
    """Measures a flight while it is mapped, in a thread of low priority; a context manager, whose end ends the thread.

    `take` is called for each frame that the map took, `land` when no more come. The files of `outputs` are written from
    time to time, with what the flight's frames so far state. Where the detector cannot keep up, every second frame is
    put off until it can: what it states then is too low rather than too high. A site without
    metres is measured by nobody, which a warning states; so is an error while measuring, for the map must not end by
    it. Raises what `prepare_search` raises.
    """

    def __init__(
        self, settings: SearchSettings, outputs: SearchOutputs, detector: ObjectDetector | None = None,
        pace: Pace = Pace(),
    ) -> None:
        self._prepared: PreparedSearch = prepare_search(settings, outputs, detector, is_live=True)
        self._settings, self._outputs, self._pace = settings, outputs, pace
        self._unplaced: list[int] = []  # frames that the map took, whose pictures it has not stored yet
        self._waiting: deque[StoredKeyframe] = deque()
        self._put_off: deque[StoredKeyframe] = deque()
        self._placed = 0
        self._landed = threading.Event()
        self._thread: threading.Thread | None = None
        self._planned = False
        self.written = 0
        """How often the files were written."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: type[BaseException] | BaseException | TracebackType | None) -> None:
        self.land()

    def take(self, run: FlightRun, archive: Archive, index: int) -> None:
        """Have the frame of this index measured as soon as its picture is stored; called where the map is made."""
        if self._landed.is_set():
            return
        self._unplaced.append(index)
        later = []
        for each in self._unplaced:
            stored = run.stored_frame(each)
            if stored is None:
                later.append(each)
            else:
                self._waiting.append(stored)
                self._placed += 1
        self._unplaced = later
        if self._thread is None and self._waiting:
            self._thread = threading.Thread(target=self._measure, args=(archive,), name="search", daemon=True)
            self._thread.start()

    def land(self) -> None:
        """The flight is over: what waits is not measured any more, for its pictures are about to be put straight."""
        self._landed.set()
        if self._thread is not None:
            self._thread.join()

    def take_back(self) -> None:
        """Remove the waypoints that were planned while the flight went on: nothing is left to fly."""
        for path in self._outputs.refly if self._planned else ():
            path.unlink(missing_ok=True)
        self._planned = False

    def _measure(self, archive: Archive) -> None:
        lower_priority()
        try:
            self._measure_all(archive)
        except SorvoloError as error:
            warnings.warn(f"the search is not measured while the flight goes on: {error}", SorvoloWarning, stacklevel=1)

    def _measure_all(self, archive: Archive) -> None:
        site = site_with_metres(archive)
        area, flight_id = self._prepared.area, self._waiting[0].flight_id
        measure = GrowingMeasure(
            flight_id, site, self._prepared.detector, self._settings,
            area_m=None if area is None else area.polygons_m(site.frame), keep_off_m=known_places(archive),
            above=heights_for(archive, flight_id),
        )
        unwritten, again_s = 0, 0.0
        while not self._landed.is_set():
            stored = self._next()
            if stored is not None:
                frame = search_frame(archive, stored)
                if frame is not None:
                    measure.add(frame)
                    unwritten += 1
            elif not unwritten or time.monotonic() < again_s:
                self._landed.wait(self._pace.look_s)
            if unwritten and time.monotonic() >= again_s:
                started_s = time.monotonic()
                if self._write(measure, archive):
                    unwritten = 0
                took_s = time.monotonic() - started_s
                again_s = time.monotonic() + max(self._pace.again_s, self._pace.rest * took_s)

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

    def _write(self, measure: GrowingMeasure, archive: Archive) -> bool:
        """Write what is known by now; whether there is a map yet to show it on."""
        tiles = archive.live_tiles()
        if not tiles:
            return False
        cells, flight = measure.measured()
        frames = {flight.name: tuple(measure.frames)}
        searched = Searched(archive.site(), cells, (flight,), frames, self._prepared.segments)
        report: dict[str, Any] = write_search(
            searched, tiles, archive.site_grid(), self._settings, self._outputs, self._prepared.detector,
            SoFar(len(measure.frames), self._placed, utc_now()),
        )
        if report["refly"] is None:
            self.take_back()
        self._planned = bool(report["refly"]) and bool(self._outputs.refly)
        self.written += 1
        return True
