"""Copies of a batch's sites at another place, brought up to date after each flight."""

from collections.abc import Callable
from pathlib import Path

from sorvolo.errors import SorvoloError, StoreError, UnavailableError


def copy_result(site: Path, place: str, alive: Callable[..., None] = lambda: None) -> None:
    """Bring the copy of a site below a place, a folder or one in an object store, up to date; `alive` is called on the
    way.

    Raises UnavailableError where the store does not answer, else StoreError with what to do.
    """
    from sorvolo.missions.site.copy import copy_site  # with what it imports

    copying = copy_site(str(site), f"{place}/{site.name}")
    try:
        while True:
            next(copying)
            alive()
    except StopIteration as end:
        faults = end.value.faults
    except SorvoloError as error:
        kind = UnavailableError if isinstance(error, UnavailableError) else StoreError
        raise kind(f"the flight is in {site}, but was not copied: {error}") from error
    if faults:
        lost = ", ".join(sorted(faults)[:3])
        raise StoreError(
            f"the flight is in {site}, but files of the site are damaged or gone: {lost}"
        )
