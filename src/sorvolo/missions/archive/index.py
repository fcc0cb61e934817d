"""The archive index: brought up to date by what changed since, and asked which flights saw a place."""

import os
from collections.abc import Generator, Iterator
from dataclasses import dataclass, field
from datetime import UTC, datetime, time, timedelta
from pathlib import Path

from sorvolo.errors import InputError, StoreError
from sorvolo.geometry.coordinates import lonlat_from_text
from sorvolo.store.exports.plain import moment_of
from sorvolo.store.index.archive_index import ArchiveIndex, IndexedSite, flight_rows, site_state
from sorvolo.store.index.finding import EARLIEST_NS, LATEST_NS, FoundFlight, Place
from sorvolo.store.site.archive import Archive
from sorvolo.store.site.catalogue_place import Catalogues, is_site

_MICROSECOND = timedelta(microseconds=1)


@dataclass(frozen=True)
class IndexUpdate:
    """One site after it was looked at: what came and went, or why it could not be read (what is known of it stays)."""

    site: str
    sites_done: int
    sites: int
    added: int = 0
    removed: int = 0
    fault: str = ""


@dataclass
class IndexOutcome:
    """What an index holds after an update. `faults` are sites that could not be read, and why."""

    sites: int = 0
    changed: int = 0
    added: int = 0
    removed: int = 0
    gone: list[str] = field(default_factory=list)
    faults: dict[str, str] = field(default_factory=dict)
    holds: dict[str, int] = field(default_factory=dict)


def index_archive(root: Path, address: str = "") -> Generator[IndexUpdate, None, IndexOutcome]:
    """Bring the index of all sites below a folder up to date, yielding each site; a killed update goes on again.

    A new index lies at `address`, a PostgreSQL URL, else in the folder. A flight mapped again replaces itself. Raises
    InputError for no folder, StoreError or SettingsError where the index cannot be written.
    """
    catalogues = Catalogues.of_environment().choosing(address)
    if not root.is_dir():
        raise InputError(f"{root} is not a folder; give the one that holds the site folders")
    outcome = IndexOutcome()
    with ArchiveIndex.open(root, write=True, address=address, catalogues=catalogues) as index:
        known = index.sites()
        paths = sorted(sites_below(root))
        outcome.sites = len(paths)
        for done, path in enumerate(paths, start=1):
            update = _update_site(root, path, index, known.get(path), catalogues, done, len(paths))
            _count(outcome, update)
            yield update
        outcome.gone = sorted(known.keys() - set(paths))
        index.drop_sites(outcome.gone)
        if outcome.changed or outcome.gone:
            index.tidy()
        outcome.holds = index.counts()
    return outcome


def sites_below(root: Path) -> Iterator[str]:
    """The folders of sites, as paths below the root with slashes; "." where the root is one. Links are not followed."""
    for folder, folders, _ in os.walk(root):
        path = Path(folder)
        if is_site(path):
            folders.clear()
            yield path.relative_to(root).as_posix()
        folders[:] = [each for each in folders if not each.startswith(".")]


def update_site(
    index: ArchiveIndex, path: str, known: IndexedSite | None, archive: Archive
) -> tuple[int, int]:
    """Bring what the index has of one open site up to date: how many of its flights came, and how many went.

    `path` is the site's, `known` what the index knows of it. Raises StoreError for a site that cannot be read.
    """
    before = known.flights if known is not None else {}
    state = site_state(archive)
    if known is not None and known.state == state.state:
        return 0, 0
    new = {flight for flight, each in state.flights.items() if before.get(flight) != each}
    rows = list(flight_rows(archive, new))
    gone = before.keys() & new | before.keys() - state.flights.keys()
    index.put_site(path, state, gone, rows)
    return len(new), len(gone - new)


def _update_site(
    root: Path,
    path: str,
    index: ArchiveIndex,
    known: IndexedSite | None,
    catalogues: Catalogues,
    done: int,
    count: int,
) -> IndexUpdate:
    try:
        with Archive.open(root / path, write=False, catalogues=catalogues) as archive:
            added, removed = update_site(index, path, known, archive)
    except StoreError as error:
        return IndexUpdate(path, done, count, fault=f"{error}")
    return IndexUpdate(path, done, count, added, removed)


def _count(outcome: IndexOutcome, update: IndexUpdate) -> None:
    outcome.added += update.added
    outcome.removed += update.removed
    outcome.changed += bool(update.added or update.removed)
    if update.fault:
        outcome.faults[update.site] = update.fault


def find_place(
    root: Path,
    at: str,
    *,
    first: str = "",
    last: str = "",
    classes: tuple[str, ...] = (),
    within_m: float = 2.0,
) -> list[FoundFlight]:
    """The flights that saw the place `at`, "LATITUDE, LONGITUDE", in order of time, by the archive's index.

    `first` and `last` are dates or times (ISO 8601, UTC unless they name a zone), a date meaning its whole day; "" is
    no bound. With `classes` only flights that found one of them within `within_m`. Raises SettingsError for what
    cannot be asked, StoreError where there is no index.
    """
    if not root.is_dir():
        raise InputError(f"{root} is not a folder; give the one that holds the site folders")
    longitude_deg, latitude_deg = lonlat_from_text(at)
    place = Place(
        latitude_deg,
        longitude_deg,
        within_m,
        _nanoseconds(first, time.min) if first else EARLIEST_NS,
        _nanoseconds(last, time.max) if last else LATEST_NS,
        frozenset(classes),
    )
    with ArchiveIndex.open(root, write=False) as index:
        return index.find(place)


def _nanoseconds(text: str, of_day: time) -> int:
    """A moment, ns since 1970; a date stands for its first or last one."""
    since = moment_of(text, of_day) - datetime(1970, 1, 1, tzinfo=UTC)
    return min(max(since // _MICROSECOND * 1000, EARLIEST_NS), LATEST_NS)
