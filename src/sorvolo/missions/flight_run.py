"""What the methods' runs share: a flight on its way into a site, its log and its writer."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from types import TracebackType
from typing import Any, Self

from sorvolo.missions.flight_report import FlightLog
from sorvolo.missions.flight_setup import FlightSetup, new_site
from sorvolo.missions.settings import MapSettings
from sorvolo.store.archive import Archive, FlightWriter
from sorvolo.survey.flight import Notice, PosedFrame
from sorvolo.survey.mosaic import Status


class FlightRun(ABC):
    """A flight on its way into a site. A context manager: leaving without `finish` leaves the site as it was.

    `writer` is one that was begun before for this flight; whoever began it ends it.
    """

    def __init__(
        self, setup: FlightSetup, archive: Archive, settings: MapSettings, writer: FlightWriter | None = None
    ) -> None:
        self._setup, self._archive, self._settings = setup, archive, settings
        self._log = FlightLog()
        self._writer = writer
        self._began_writer = False

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._writer is not None and self._began_writer:
            self._writer.__exit__(kind, error, trace)

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

    @abstractmethod
    def add(self, posed: PosedFrame) -> tuple[Status, str, int]:
        """Place one frame; what became of it, in words if not by vision, and how many tiles were painted meanwhile."""

    @abstractmethod
    def finish(self, notices: Sequence[Notice], started_s: float) -> None:
        """Place the flight for good, paint it and make it part of the site.

        `started_s` is when the flight's mapping began, by the monotonic clock. Raises InputError, and leaves the site
        as it was, when no frame has a place.
        """

    def _make_site(self, m_per_px: float, ground_up_m: float) -> None:
        """Make the site if there is none; see `new_site`."""
        if not self._archive.has_site:
            name = self._archive.folder.resolve().name or "site"
            self._archive.create_site(new_site(self._setup, name, m_per_px, ground_up_m))

    def _begin_flight(self) -> FlightWriter:
        """The writer, begun when it is first asked for."""
        if self._writer is None:
            source = self._setup.source
            settings: dict[str, Any] = {"method": self._settings.method, **vars(self._settings)}
            self._writer = self._archive.begin_flight(source.name, source.fingerprint, settings)
            self._began_writer = True
        return self._writer
