"""What several commands print and read: files, notices, warnings, and where a site stands."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer
from rich.console import Console
from rich.markup import escape

from sorvolo.errors import StoreError

if TYPE_CHECKING:
    from sorvolo.missions.flight.request import AlreadyDone
    from sorvolo.store.site.catalogue_place import Catalogues
    from sorvolo.survey.flight import Site


def show_path(name: str, path: Path, console: Console) -> None:
    """Print where a file is."""
    # in one piece, however long: people copy it
    console.print(f"{name:>8}  {escape(str(path))}", soft_wrap=True, highlight=False)


def show_notices_and_warnings(report: Mapping[str, Any], console: Console) -> None:
    """Print what was found and survived, and what to look at first."""
    for notice in report["notices"]:
        console.print(f"[blue]note[/blue]     {escape(notice['text'])}", highlight=False)
    for warning in report["warnings"]:
        console.print(f"[yellow]warning[/yellow]  {escape(warning)}", highlight=False)


def read_json(path: Path) -> dict[str, Any]:
    """A document of a flight; raises StoreError when it cannot be read."""
    try:
        return dict(json.loads(path.read_text(encoding="utf-8")))
    except (OSError, ValueError) as error:
        raise StoreError(
            f"{path} cannot be read ({error}); run the command on this flight again"
        ) from error


def newest_version(site: Path, catalogues: "Catalogues | None" = None) -> int:
    """The id of the site's newest version; 0 where there is no site yet."""
    from sorvolo.store.site.archive import Archive
    from sorvolo.store.site.catalogue_place import is_site

    if not is_site(site):
        return 0
    with Archive.open(site, write=False, catalogues=catalogues) as archive:
        return max((each.id for each in archive.versions() if each.complete), default=0)


def site_of(folder: Path) -> "Site":
    """The site in a folder. Raises StoreError when there is none."""
    from sorvolo.store.site.archive import Archive

    with Archive.open(folder, write=False) as archive:
        return archive.site()


def unit_of(site: "Site") -> str:
    """Metres, or the units of a map that has none."""
    return "units" if site.is_local else "m"


def show_done(flights: "Sequence[AlreadyDone]", done: str) -> None:
    """Print on stderr which flights the site has already: "mapped" or "compared"."""
    for each in flights:
        moment = each.done_utc[:16].replace("T", " ")
        typer.echo(
            f"{each.flight} is {done} already ({moment} UTC); --again does it anew", err=True
        )
