"""Changes and people's verdicts on them: listed, confirmed, rejected."""

from collections.abc import Sequence
from pathlib import Path

from sorvolo.errors import InputError
from sorvolo.store.site.archive import Archive
from sorvolo.store.site.change_records import StoredChange
from sorvolo.survey.findings import Verdict


def list_changes(site: Path, flight: str | None = None) -> list[StoredChange]:
    """The changes of all flights in the site folder, or of one, with their verdicts, by flight and number.

    Raises StoreError when the folder is no site, InputError for a flight it does not have.
    """
    with Archive.open(site, write=False) as archive:
        _require_flight(archive, flight)
        return archive.changes(flight)


def review_changes(
    site: Path, ids: Sequence[str], verdict: Verdict, note: str = "", *, flight: str | None = None
) -> list[StoredChange]:
    """Confirm or reject changes by id, or by number when `flight` names whose; return them as they are now.

    The flight's changes.geojson and changes.html follow. Rejected changes do not come back in later flights. Raises
    InputError for an unknown id or flight (then no verdict is given), StoreError when another process is writing.
    """
    if not ids:
        raise InputError("no change was named; give the ids that `sorvolo review SITE` lists")
    with Archive.open(site, write=True, makes=False) as archive:
        _require_flight(archive, flight)
        if flight is None:
            if bare := next((each for each in ids if each.isdecimal()), ""):
                raise InputError(
                    f"{site} has no change {bare}: a number is one flight's; give --flight as well, or the whole id as "
                    f"`sorvolo review {site}` lists it"
                )
        by_number = (
            {str(each.number): each.id for each in archive.changes(flight)}
            if flight is not None
            else {}
        )
        wanted = {by_number.get(each, each) for each in ids}
        archive.review(wanted, verdict, note)
        return [each for each in archive.changes() if each.id in wanted]


def withdraw_reviews(site: Path, ids: Sequence[str]) -> None:
    """Withdraw verdicts on changes, as if none had been given; the flights' change files follow.

    Raises InputError for an unknown id, StoreError when the folder is no site or another process is writing.
    """
    with Archive.open(site, write=True, makes=False) as archive:
        archive.review(ids, None)


def _require_flight(archive: Archive, flight: str | None) -> None:
    known = [entry.id for entry in archive.flights()]
    if flight is not None and flight not in known:
        raise InputError(
            f"{archive.folder} has no flight {flight}; it has {', '.join(known) or 'none'}"
        )
