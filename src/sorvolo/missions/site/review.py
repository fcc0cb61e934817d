"""Changes and people's verdicts on them: listed, confirmed, rejected."""

from collections.abc import Sequence
from pathlib import Path

from sorvolo.errors import InputError
from sorvolo.store.site.archive import Archive
from sorvolo.store.site.change_records import StoredChange
from sorvolo.survey.findings import Verdict


def list_changes(site: Path, flight: str | None = None) -> list[StoredChange]:
    """The changes of all flights in the site folder, or of one, with their verdicts, by flight and number.

    Raises StoreError when the folder is no site or does not have the flight.
    """
    with Archive.open(site, write=False) as archive:
        return archive.changes(flight)


def review_changes(
    site: Path,
    ids: Sequence[str],
    verdict: Verdict | None,
    note: str = "",
    *,
    flight: str | None = None,
) -> list[StoredChange]:
    """Confirm or reject changes by id, or by number when `flight` names whose, or withdraw (None) what was given; return
    them as they are now.

    The flight's changes.geojson and changes.html follow. Rejected changes do not come back in later flights. Raises
    InputError for an unknown id, StoreError for an unknown flight (then no verdict is given) or when another process is
    writing.
    """
    if not ids:
        raise InputError("no change was named; give the ids that `sorvolo review SITE` lists")
    with Archive.open(site, write=True, makes=False) as archive:
        bare = next((each for each in ids if each.isdecimal()), "")
        if flight is None and bare:
            raise InputError(
                f"{site} has no change {bare}: a number is one flight's; give --flight as well, or the whole id as "
                f"`sorvolo review {site}` lists it"
            )
        by_number = {str(each.number): each.id for each in archive.changes(flight)}
        wanted = {by_number.get(each, each) for each in ids}
        archive.review(wanted, verdict, note)
        return [each for each in archive.changes() if each.id in wanted]
