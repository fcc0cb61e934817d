"""What several commands print and read: exit codes, files, notices, warnings, places."""

import json
from collections.abc import Callable, Container, Iterable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import rich.console
import typer
from rich.box import SIMPLE_HEAD
from rich.markup import escape
from rich.table import Table

from sorvolo.cli.options import PlaceFormat
from sorvolo.errors import StoreError
from sorvolo.paths import Json, JsonView

if TYPE_CHECKING:
    from sorvolo.geometry.arrays import Floats
    from sorvolo.survey.flight import Site

FAILED = 1
"""Exit code: an error, or a part of the work failed."""

TO_CHECK = 3
"""Exit code: done, but check the result before use; the first line states why."""

STOPPED = 130
"""Exit code: stopped by Ctrl-C, as shells count it."""


class Console(rich.console.Console):
    """A terminal that colours no numbers and paths by itself."""

    def __init__(self, *, stderr: bool = False) -> None:
        super().__init__(stderr=stderr, highlight=False)


def new_table(
    *names: str,
    whole: Container[str] = (),
    right: Container[str] = (),
    widths: Mapping[str, int] = MappingProxyType({}),
    is_tight: bool = False,
    title: str | None = None,
) -> Table:
    """A table with columns of these names: `whole` ones are never folded, `right` ones hold numbers, and each is as wide
    as its `widths`, or as the longest word of its name. A tight one spares blanks."""
    padding = 0 if is_tight else (0, 1, 0, 0)
    table = Table(box=SIMPLE_HEAD, padding=padding, title=title, title_justify="left")
    for name in names:
        table.add_column(
            name,
            no_wrap=name in whole,
            overflow="fold",
            min_width=widths.get(name, max(map(len, name.split()), default=0)),
            justify="right" if name in right else "left",
        )
    return table


def facts_table(title: str, rows: Iterable[tuple[str, str]]) -> Table:
    """Names and what is known of each; those without a text are left out."""
    table = Table(title=title, show_header=False, title_justify="left")
    table.add_column()
    table.add_column(overflow="fold")
    for name, text in rows:
        if text:
            table.add_row(name, text)
    return table


def announce_person(words: str, console: Console) -> None:
    """Print that a person was found, with the terminal's bell."""
    console.bell()
    console.print(f"[bold red]PERSON FOUND[/bold red]  {escape(words)}", soft_wrap=True)


def announce_people(
    report: JsonView, folder: Path, console: Console, form: PlaceFormat = "latlon"
) -> None:
    """Print each person whom a map or a comparison was first to find, by its report; `folder` has the site."""
    from sorvolo.geometry.coordinates import Coordinates, place_text
    from sorvolo.store.site.archive import Archive

    if not report["objects"].get("model"):
        return
    with Archive.open(folder, write=False) as archive:
        people, is_local = archive.new_people(report["flight"]), archive.site().is_local
    for each in people:
        x, y = each["geometry"]["coordinates"]
        known, place = each["properties"], f"at {x:+.1f}, {y:+.1f}"
        if not is_local:
            accuracy = f" (accuracy {known['sigma_m']:.1f} m)" if known["sigma_m"] else ""
            place = f"at {place_text(y, x, Coordinates(form))}{accuracy}"
        announce_person(f"person {each['id']}  {place}, score {known['score']:.2f}", console)


def show_path(name: str, path: Path, console: Console) -> None:
    """Print where a file is."""
    # in one piece, however long: people copy it
    console.print(f"{name:>8}  {escape(str(path))}", soft_wrap=True)


def show_notices_and_warnings(report: JsonView, console: Console) -> None:
    """Print a report's notices, then its warnings."""
    for notice in report.get("notices", ()):
        console.print(f"[blue]note[/blue]     {escape(notice['text'])}")
    for warning in report["warnings"]:
        console.print(f"[yellow]warning[/yellow]  {escape(warning)}")


def print_json(value: Any) -> None:
    """Print a value as JSON: records as objects, NaN as null."""
    from sorvolo.store.exports.plain import plain_json

    typer.echo(json.dumps(plain_json(value), indent=1))


def read_json(path: Path) -> Json:
    """Return a document of a flight; raise StoreError if it cannot be read."""
    try:
        return dict(json.loads(path.read_text(encoding="utf-8")))
    except (OSError, ValueError) as error:
        raise StoreError(
            f"{path} cannot be read ({error}); run the command on this flight again"
        ) from error


def site_of(folder: Path) -> "Site":
    """Return the site in a folder; raise StoreError if there is none."""
    from sorvolo.store.site.archive import Archive

    with Archive.open(folder, write=False) as archive:
        return archive.site()


def place_heading(site_is_local: bool, form: PlaceFormat) -> str:
    """Return the heading of a column of places."""
    from sorvolo.geometry.coordinates import Coordinates

    return "east, north" if site_is_local else Coordinates(form).heading


def place_words(site: "Site", form: PlaceFormat) -> "Callable[[Floats], str]":
    """Return a function that writes a place of the site, (2,) or (3,) east, north (up) metres."""
    from sorvolo.geometry.coordinates import Coordinates, place_text

    def words(point_m: "Floats") -> str:
        if site.is_local:
            return f"{point_m[0]:+.1f}, {point_m[1]:+.1f}"
        latitude, longitude, _ = site.frame.wgs84_from_site(point_m[None])
        return place_text(float(latitude[0]), float(longitude[0]), Coordinates(form))

    return words
