"""What the methods' runs share: a flight on its way into a site, its log and its writer."""

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from types import TracebackType
from typing import Any, Self

from sorvolo.missions.flight.log import FlightLog, Stage
from sorvolo.missions.flight.map_objects import (
    FrameDetections,
    ObjectFinder,
    search_summary,
    why_not_searched,
)
from sorvolo.missions.flight.memory import MemorySettings, memory_budget_bytes
from sorvolo.missions.flight.request import REQUEST
from sorvolo.missions.flight.settings import MapSettings
from sorvolo.missions.flight.setup import FlightSetup, new_site
from sorvolo.missions.map.journal import MapJournal, Step, Taken
from sorvolo.mosaic.seen_ground import PictureOnGround
from sorvolo.mosaic.selection import Selected
from sorvolo.store.site.archive import Archive, FlightWriter
from sorvolo.store.site.catalogue import StoredKeyframe
from sorvolo.survey.flight import LostFrame, Notice, PosedFrame
from sorvolo.survey.map_objects import ObjectSearch
from sorvolo.survey.mosaic import FrameView, PlacedFrame, Status


class FlightRun(ABC):
    """A flight on its way into a site. A context manager: leaving without `finish` leaves the site as it was.

    `writer` is one that was begun before for this flight; whoever began it ends it. `finder` looks for objects in the
    frames; None: nobody does. `journal` notes what becomes of each frame; None: a kill loses it. `request` is what is
    asked for, see `request_of`.
    """

    def __init__(
        self,
        setup: FlightSetup,
        archive: Archive,
        settings: MapSettings,
        writer: FlightWriter | None = None,
        finder: ObjectFinder | None = None,
        journal: MapJournal | None = None,
        request: str = "",
    ) -> None:
        self._request = request
        self._setup, self._archive, self._settings, self._finder = setup, archive, settings, finder
        self._log = FlightLog()
        self._writer = writer
        self._began_writer = False
        self._journal = journal
        self._taken: Taken | None = None  # the frame that `add` registered last

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._finder is not None:
            self._finder.close()
        if self._writer is not None and self._began_writer:
            self._writer.__exit__(kind, error, trace)
        if self._journal is not None:
            self._journal.file.end(error)

    @property
    def taken(self) -> Taken | None:
        """The frame that `add` registered last; None where it could not."""
        return self._taken

    @property
    def selected(self) -> int:
        """Frames taken so far, lost ones included."""
        return len(self._log.endings)

    @property
    def by_vision(self) -> int:
        """Frames placed by vision so far."""
        return self._log.count(Status.VISION)

    def lose(self, index: int, name: str, time_ns: int, reason: str) -> tuple[Status, str, int]:
        """A selected frame that cannot be used."""
        self._log.end(index, name, time_ns, Status.REJECTED, reason)
        return Status.REJECTED, reason, 0

    def look(self, posed: PosedFrame) -> None:
        """Have a selected frame searched for objects while it is being placed."""
        if self._finder is not None:
            with self._log.stage(Stage.DETECT):
                self._finder.look(posed)

    def take(self, each: Selected | LostFrame) -> tuple[Status, str, int]:
        """Take one selected frame, or one that the source lost; see `add`."""
        self._taken = None
        lost = each if isinstance(each, LostFrame) else each.posed.frame
        if each.reason:
            ended = self.lose(lost.index, lost.name, lost.time_ns, each.reason)
        else:
            assert isinstance(each, Selected)
            self.look(each.posed)
            ended = self.add(each.posed)
        if self._journal is not None:
            memory = each.memory if isinstance(each, Selected) else None
            reason = ended[1] if self._taken is None else ""
            is_searched = not each.reason and self._finder is not None
            self._journal.keep(
                Step(lost.index, lost.name, lost.time_ns, reason, memory, self._taken, is_searched)
            )
            self._keep_detections()
        return ended

    def take_over(self) -> Iterator[tuple[Step, tuple[Status, str, int]]]:
        """What a killed run had done, done again without its pictures: each step, and how it ended."""
        if self._journal is None:
            return
        for each in self._journal.earlier():
            if isinstance(each, FrameDetections):
                if self._finder is not None:
                    self._finder.take_over(each)
                continue
            ended = self.again(each)
            if ended is None:
                return
            yield each, ended

    def again(self, step: Step) -> tuple[Status, str, int] | None:
        """Take a frame as a killed run took it; None where its picture is not there any more."""
        return self.lose(step.index, step.name, step.time_ns, step.reason)

    def is_unsearched(self, index: int) -> bool:
        """Whether the detector has not looked at the frame of this index."""
        return self._finder is not None and not self._finder.has_seen(index)

    @abstractmethod
    def add(self, posed: PosedFrame) -> tuple[Status, str, int]:
        """Place one frame; what became of it, in words if not by vision, and how many tiles were painted meanwhile."""

    def pictures_on_ground(self) -> Sequence[PictureOnGround]:
        """Where the pictures that have a place lie by now."""
        return ()

    def view(self, index: int, time_ns: int) -> FrameView | None:
        """What the frame of this index and time shows, as it lies now; None where the camera's place is not known."""
        return None

    def stored_frame(self, index: int) -> StoredKeyframe | None:
        """The frame of this index as it lies now, with the picture that the site keeps of it.

        None where it has no place, or where no picture is stored yet: it may be asked for later.
        """
        return None

    @abstractmethod
    def finish(self, notices: Sequence[Notice], started_s: float) -> None:
        """Place the flight for good, paint it and make it part of the site.

        `started_s` is when the flight's mapping began, by the monotonic clock. Raises InputError, and leaves the site
        as it was, when no frame has a place.
        """

    def _end_search(self) -> None:
        """Have all frames searched: the detector's memory is then free for the final painting and for the files."""
        if self._finder is not None:
            with self._log.stage(Stage.DETECT):
                self._finder.rest()
            self._keep_detections()

    def _search(self, placed: Sequence[PlacedFrame]) -> ObjectSearch | None:
        """What stands on the ground by the frames' final places; None where nobody looked."""
        if self._finder is None:
            return None
        with self._log.stage(Stage.DETECT):
            return self._finder.conclude(
                placed, self._setup.source.name, has_metres=not self._archive.site().is_local
            )

    def _search_summary(self, search: ObjectSearch | None) -> dict[str, Any]:
        """The report's part on objects."""
        seconds = 0.0 if self._finder is None else self._finder.seconds
        return search_summary(search, seconds, why_not_searched(self._settings.model))

    def _keep_detections(self) -> None:
        if self._finder is not None and self._journal is not None:
            for seen in self._finder.news():
                self._journal.keep_detections(seen)

    @property
    def _detector_notices(self) -> tuple[Notice, ...]:
        return () if self._finder is None else self._finder.notices

    def _images_mb(self) -> int:
        """For the pictures that lie around a place, which are painted one after the other."""
        camera = self._setup.source.camera.camera
        picture_mb = 3 * camera.width_px * camera.height_px // 1_000_000
        most = MemorySettings()
        return min(most.images_mb, max(most.least_images_mb, most.pictures * picture_mb))

    def _make_site(self, m_per_px: float, ground_up_m: float) -> None:
        """Make the site if there is none; see `new_site`."""
        if not self._archive.has_site:
            name = self._archive.folder.resolve().name or "site"
            self._archive.create_site(new_site(self._setup, name, m_per_px, ground_up_m))

    def _begin_flight(self) -> FlightWriter:
        """The writer, begun when it is first asked for."""
        if self._writer is None:
            source = self._setup.source
            settings: dict[str, Any] = {**vars(self._settings), REQUEST: self._request}
            memory_mb = int(memory_budget_bytes(self._settings.memory_mb) / 1e6)
            journal = None if self._journal is None else self._journal.file
            self._writer = self._archive.begin_flight(
                source.name,
                source.fingerprint,
                settings,
                tiles_mb=min(MemorySettings().tiles_mb, memory_mb // 8),
                images_mb=min(self._images_mb(), memory_mb // 2),
                journal=journal,
            )
            self._began_writer = True
        return self._writer
