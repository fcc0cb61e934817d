"""Where commands find a site: in a folder, or in an object store, from which it is fetched and to which it is sent."""

from collections.abc import Generator, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Protocol, TypeVar

import typer

from sorvolo.cli.progress import ProgressReport, shown_work
from sorvolo.errors import SorvoloError

if TYPE_CHECKING:
    from sorvolo.store.copies.transfer import CopyUpdate

SiteArgument = Annotated[str, typer.Argument(help="Folder of the map, or s3://BUCKET/NAME.")]


class _OfFlight(Protocol):
    @property
    def flight(self) -> str:
        """The flight that is being worked on."""
        ...


T = TypeVar("T")
U = TypeVar("U", bound=_OfFlight)


class Passing(Protocol):
    """Passes a mission's updates on."""

    def __call__(self, updates: Generator[U, None, T], /) -> Generator[U, None, T]:
        """The same updates and the same end."""
        ...


def not_sent(updates: Generator[U, None, T], /) -> Generator[U, None, T]:
    """The updates as they are: what a flight adds stays where it is."""
    return updates


@dataclass(frozen=True)
class OpenedSite:
    """A site's folder on this machine, and the address that it was asked for by."""

    folder: Path
    address: str

    def results(self, ending: str) -> Path:
        """Where results go: beside the site's folder; for a site in a store, into the current folder."""
        if "://" in self.address and not self.address.startswith("file:"):
            return Path(f"{self.address.rstrip('/').rpartition('/')[2]}-{ending}")
        return self.folder.with_name(f"{self.folder.resolve().name}-{ending}")

    def sent(self, updates: Generator[U, None, T], /) -> Generator[U, None, T]:
        """The updates of a mission; after each of its flights but the last what it added is sent to the store."""
        flight = ""
        with closing(updates):
            while True:
                try:
                    update = next(updates)
                except StopIteration as end:
                    return end.value
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
    """The site's folder. One in a store is brought up to date before, and what was added is sent at the end."""
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
