"""What the methods' runs share: a flight on its way into a site, its log and its writer."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from types import TracebackType
from typing import Any, Self

from sorvolo.missions.flight.log import FlightLog, Stage
from sorvolo.missions.flight.map_objects import ObjectFinder, search_summary, why_not_searched
from sorvolo.missions.flight.memory import MemorySettings, memory_budget_bytes
from sorvolo.missions.flight.request import REQUEST
from sorvolo.missions.flight.result_cache import ResultCache
from sorvolo.missions.flight.settings import MapSettings
from sorvolo.missions.flight.setup import FlightSetup, new_site
from sorvolo.mosaic.seen_ground import PictureOnGround
from sorvolo.mosaic.selection import Selected
from sorvolo.store.site.archive import Archive, FlightWriter
from sorvolo.store.site.catalogue import StoredKeyframe
from sorvolo.survey.flight import Frame, LostFrame, Notice, PosedFrame
from sorvolo.survey.map_objects import ObjectSearch
from sorvolo.survey.mosaic import FrameView, PlacedFrame, Status


class FlightRun(ABC):
    """A flight on its way into a site. A context manager: leaving without `finish` leaves the site as it was.

    `writer` is one that was begun before for this flight; whoever began it ends it. `finder` looks for objects in the
    frames; None: nobody does. `memo` has what a killed run computed. `request` is what is asked for, see `request_of`.
    """

    def __init__(
        self,
        setup: FlightSetup,
        archive: Archive,
        settings: MapSettings,
        writer: FlightWriter | None = None,
        finder: ObjectFinder | None = None,
        memo: ResultCache | None = None,
        request: str = "",
    ) -> None:
        self._setup, self._archive, self._settings, self._finder = setup, archive, settings, finder
        self._memo, self._request = ResultCache() if memo is None else memo, request
        self._log = FlightLog()
        self._writer, self._began_writer = writer, False

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
        self._memo.end(error)

    @property
    def selected(self) -> int:
        """Frames taken so far, lost ones included."""
        return len(self._log.endings)

    @property
    def by_vision(self) -> int:
        return self._log.count(Status.VISION)

    def lose(self, frame: Frame | LostFrame, reason: str) -> tuple[Status, str, int]:
        """A selected frame that cannot be used."""
        self._log.end(frame.index, frame.name, frame.time_ns, Status.REJECTED, reason)
        return Status.REJECTED, reason, 0

    def take(self, selected: Selected | LostFrame) -> tuple[Status, str, int]:
        """Take one selected frame, or one that the source lost; see `add`."""
        if isinstance(selected, LostFrame):
            ended = self.lose(selected, selected.reason)
            self._memo.end_frame(selected, reason=selected.reason)
            return ended
        posed = selected.posed
        if selected.reason:
            ended = self.lose(posed.frame, selected.reason)
        else:
            if self._finder is not None:
                with self._log.stage(Stage.DETECT):
                    self._finder.look(posed)
            ended = self.add(posed)
        self._memo.end_frame(posed.frame, posed.prior, selected.reason)
        return ended

    @abstractmethod
    def add(self, posed: PosedFrame) -> tuple[Status, str, int]:
        """Place one frame; what became of it, in words if not by vision, and how many tiles were painted meanwhile."""

    def pictures_on_ground(self) -> Sequence[PictureOnGround]:
        """Return where the pictures that have a place lie by now."""
        return ()

    def view(self, index: int, time_ns: int) -> FrameView | None:
        """Return what the frame of this index shows, as it lies now; None where the camera's place is not known."""
        return None

    def stored_frame(self, index: int) -> StoredKeyframe | None:
        """Return the frame of this index as it lies now, with the picture that the site keeps of it.

        None where it has no place, or where no picture is stored yet: it may be asked for later.
        """
        return None

    @abstractmethod
    def finish(self, notices: Sequence[Notice], started_s: float) -> None:
        """Place the flight for good, paint it and make it part of the site.

        `started_s` is when the flight's mapping began, by the monotonic clock. Raises InputError, and leaves the site
        as it was, when no frame has a place.
        """

    def _search(self, placed: Sequence[PlacedFrame]) -> ObjectSearch | None:
        """Return what stands on the ground by the frames' final places; None where nobody looked."""
        if self._finder is None:
            return None
        with self._log.stage(Stage.DETECT):
            return self._finder.conclude(
                placed, self._setup.source.name, has_metres=not self._archive.site().is_local
            )

    def _search_summary(self, search: ObjectSearch | None) -> dict[str, Any]:
        seconds = 0.0 if self._finder is None else self._finder.seconds
        return search_summary(search, seconds, why_not_searched(self._settings.model))

    @property
    def _detector_notices(self) -> tuple[Notice, ...]:
        return () if self._finder is None else self._finder.notices

    def _make_site(self, m_per_px: float, ground_up_m: float) -> None:
        """Make the site if there is none; see `new_site`."""
        if not self._archive.has_site:
            name = self._archive.folder.resolve().name or "site"
            self._archive.create_site(new_site(self._setup, name, m_per_px, ground_up_m))

    def _begin_flight(self) -> FlightWriter:
        """Return the writer, begun when it is first asked for."""
        if self._writer is None:
            source, memory = self._setup.source, MemorySettings()
            # pictures that lie around a place are painted one after the other
            camera = source.camera.camera
            picture_mb = 3 * camera.width_px * camera.height_px // 1_000_000
            images_mb = min(
                memory.images_mb, max(memory.least_images_mb, memory.pictures * picture_mb)
            )
            memory_mb = int(memory_budget_bytes(self._settings.memory_mb) / 1e6)
            self._writer = self._archive.begin_flight(
                source.name,
                source.fingerprint,
                {
                    **vars(self._settings),
                    "method": self._settings.method_name,
                    REQUEST: self._request,
                },
                tiles_mb=min(memory.tiles_mb, memory_mb // 8),
                images_mb=min(images_mb, memory_mb // 2),
                journal=self._memo.journal,
            )
            self._began_writer = True
        return self._writer
