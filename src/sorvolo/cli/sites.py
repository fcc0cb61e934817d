"""Where commands find a site (a folder, or an object store), and how they run a mission on it."""

import signal
import threading
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, TypeVar

import typer

from sorvolo.cli.progress import ProgressReport, shown_work
from sorvolo.errors import SorvoloError

if TYPE_CHECKING:
    from sorvolo.missions.mission import FlightOutcome, Mission
    from sorvolo.store.copies.transfer import CopyUpdate


class _OfFlight(Protocol):
    @property
    def flight(self) -> str: ...


T = TypeVar("T")
U = TypeVar("U", bound=_OfFlight)


@dataclass(frozen=True)
class OpenedSite:
    """A site's folder on this machine, and the address it was opened by."""

    folder: Path
    address: str

    def results(self, ending: str) -> Path:
        """Return where results go: beside the site; for a site in a store, in the current folder."""
        if "://" in self.address and not self.address.startswith("file:"):
            return Path(f"{self.address.rstrip('/').rpartition('/')[2]}-{ending}")
        return self.folder.with_name(f"{self.folder.resolve().name}-{ending}")

    def sent(self, updates: Iterator[U], /) -> Iterator[U]:
        """Pass a mission's updates on; send each flight but the last to the store when the next begins."""
        flight = ""
        for update in updates:
            if flight not in ("", update.flight):
                self._send()
            flight = update.flight
            yield update

    def _send(self) -> None:
        from sorvolo.missions.site.working_copy import send_site
        from sorvolo.store.copies.bucket import OvertakenError

        try:
            show_copy(send_site(self.address, is_over=False), "sending the flight, file")
        except OvertakenError:
            raise
        except SorvoloError as error:  # the flights that follow need not wait for the network
            typer.echo(f"warning: {error}", err=True)


@contextmanager
def opened_site(site: str, *, writes: bool = False) -> Iterator[OpenedSite]:
    """Open a site's folder. One in a store is fetched first, and what was added is sent at the end."""
    from sorvolo.missions.site.working_copy import fetch_site, send_site

    folder = show_copy(fetch_site(site, writes=writes), "fetching, file")
    try:
        yield OpenedSite(folder, site)
    except Exception:
        if writes:  # flights before the one that failed are in the site
            try:
                show_copy(send_site(site), "sending, file")
            except SorvoloError as error:
                typer.echo(f"warning: {error}", err=True)
        raise
    if writes:
        show_copy(send_site(site), "sending, file")


def show_copy(work: "Generator[CopyUpdate, None, T]", task: str) -> T:
    """Do the work with progress on stderr."""

    def show(progress: ProgressReport, update: "CopyUpdate") -> None:
        words = f"{update.done_bytes / 1e6:,.0f} of {update.bytes / 1e6:,.0f} MB"
        progress.show(task, update.done, update.files, words)

    return shown_work(work, show)


def run_on_site(
    mission: "Mission[U, tuple[FlightOutcome, ...]]",
    place: OpenedSite,
    show: Callable[[Iterator[U]], Any],
    done: str,
) -> list[Path]:
    """Run a mission, showing its updates with `show`; return the folders of its flights.

    Flights that the site had already come last, and are named on stderr as `done` ("mapped").
    """
    with mission:  # also where the bar is stopped: then the site is as it was
        show(place.sent(mission))
        outcomes = mission.result()
    for outcome in outcomes:
        if outcome.done_utc:
            moment = outcome.done_utc[:16].replace("T", " ")
            typer.echo(
                f"{outcome.flight} is {done} already ({moment} UTC); --again repeats it", err=True
            )
    return [each.folder for each in sorted(outcomes, key=lambda each: bool(each.done_utc))]


class SignalStop:
    """Ctrl-C and SIGTERM as an event, `until`, that a mission looks at after each frame.

    An exception could strike inside a queue's own lock and block its end for ever. The second signal, and one before
    `is_running`, raises KeyboardInterrupt: then there is nothing to wait for.
    """

    def __init__(self, *, is_running: bool, words: str = "") -> None:
        self.until, self.is_running, self._words = threading.Event(), is_running, words

    @contextmanager
    def on_signals(self) -> Iterator["SignalStop"]:
        """Take the signals for the length of a block; in another thread than the main one there are none."""
        if threading.current_thread() is not threading.main_thread():
            yield self
            return
        numbers = (signal.SIGINT, signal.SIGTERM)
        before = {number: signal.signal(number, self._stop) for number in numbers}
        try:
            yield self
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)

    def _stop(self, *_: Any) -> None:
        if self.until.is_set() or not self.is_running:
            raise KeyboardInterrupt
        self.until.set()
        if self._words:
            typer.echo(self._words, err=True)


@contextmanager
def ended_by_signal(inputs: Sequence[Path | str]) -> Iterator[threading.Event]:
    """Yield an event that the first Ctrl-C or SIGTERM sets if an input is live; a second signal stops at once."""
    from sorvolo.capture.live.addresses import is_live_address

    stop = SignalStop(is_running=True)
    if any(is_live_address(str(each)) for each in inputs):
        with stop.on_signals():
            yield stop.until
    else:
        yield stop.until
