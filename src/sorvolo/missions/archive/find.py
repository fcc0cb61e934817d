"""The memory of a place over a whole archive: which flights of which sites saw it, and what they found there."""

from datetime import UTC, datetime, time, timedelta
from pathlib import Path

from sorvolo.errors import InputError
from sorvolo.geometry.coordinates import lonlat_from_text
from sorvolo.store.exports.plain import moment_of
from sorvolo.store.index.archive_index import ArchiveIndex
from sorvolo.store.index.finding import EARLIEST_NS, LATEST_NS, FoundFlight, Place

_MICROSECOND = timedelta(microseconds=1)


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
