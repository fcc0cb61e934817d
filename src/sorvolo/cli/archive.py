"""`sorvolo archive`: all sites of a folder indexed, the flights that saw a place, and a table of them all."""

import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from sorvolo.cli.archive_table import export_command
from sorvolo.cli.exit_codes import FAILED
from sorvolo.cli.options import AsJson, wanted_classes
from sorvolo.cli.progress import shown_work
from sorvolo.survey.wording import counted

if TYPE_CHECKING:
    from sorvolo.store.index.finding import FoundFlight, FoundThing

archive_app = typer.Typer(no_args_is_help=True)

Root = Annotated[Path, typer.Argument(help="The folder that holds the site folders.")]


@archive_app.callback()
def archive() -> None:
    """Find flights, objects and changes of all sites of a folder by place and time."""


archive_app.command("export")(export_command)


@archive_app.command("index")
def index_command(
    root: Root,
    catalogue: Annotated[
        str,
        typer.Option(
            help="Where a new index lies: postgresql://USER@HOST/DATABASE with PostGIS. Without it: a file."
        ),
    ] = "",
    as_json: AsJson = False,
) -> None:
    """Make the index of an archive, or update it: only what has changed is read.

    The exit code is 1 if a site could not be read; its earlier entries stay.

    Example: sorvolo archive index /srv/flights
    """
    from sorvolo.missions.archive.index import index_archive

    outcome = shown_work(
        index_archive(root, catalogue),
        lambda progress, update: progress.show(
            "reading sites", update.sites_done, update.sites, update.site
        ),
    )
    if as_json:
        typer.echo(json.dumps({"root": str(root), **asdict(outcome)}, indent=1))
    else:
        held = outcome.holds
        typer.echo(
            f"{root}: {counted(held['sites'], 'site')}, {counted(held['flights'], 'flight')}, "
            f"{counted(held['frames'], 'frame')}, {counted(held['objects'], 'object')}, "
            f"{counted(held['changes'], 'change')}; "
            f"{counted(outcome.added, 'flight')} new, {outcome.removed + len(outcome.gone):,} gone"
        )
        for path, fault in outcome.faults.items():
            typer.echo(f"{path}: {fault}", err=True)
    if outcome.faults:
        raise typer.Exit(FAILED)


@archive_app.command("find")
def find_command(
    root: Root,
    at: Annotated[str, typer.Option(help="The place: LATITUDE,LONGITUDE in degrees (WGS84).")],
    first: Annotated[str, typer.Option("--from", help="From this date or time (UTC) on.")] = "",
    last: Annotated[str, typer.Option("--to", help="Up to this date or time (UTC).")] = "",
    classes: Annotated[
        str | None,
        typer.Option(
            "--class", help="Only flights that found one of these there, such as car,appeared."
        ),
    ] = None,
    within: Annotated[
        float, typer.Option(help="How near a finding must be to count as there, m.")
    ] = 2.0,
    as_json: AsJson = False,
) -> None:
    """List the flights that saw a place, in order of time, and what they found there.

    Example: sorvolo archive find /srv/flights --at 46.5001,13.2502

    Example: sorvolo archive find /srv/flights --at 46.5001,13.2502 --from 2026-05-01 --class car --within 10
    """
    from sorvolo.missions.archive.find import find_place
    from sorvolo.store.exports.plain import plain_json

    found = find_place(
        root,
        at,
        first=first,
        last=last,
        classes=wanted_classes(classes, "--class"),
        within_m=within,
    )
    if as_json:
        typer.echo(
            json.dumps({"root": str(root), "at": at, "flights": plain_json(found)}, indent=1)
        )
    else:
        _show(found, Console())


def _show(found: Sequence["FoundFlight"], console: Console) -> None:
    from sorvolo.store.exports.plain import time_words

    if not found:
        console.print("no flight saw this place at that time")
        return
    table = Table(box=SIMPLE_HEAD, padding=0)
    for name in ("flown", "site", "flight", "by", "frames", "best frame", "found there"):
        table.add_column(name, overflow="fold")
    for each in found:
        table.add_row(
            time_words(each.first_ns)[:19],
            escape(each.site),
            escape(each.flight),
            each.kind,
            f"{each.frames:,}",
            escape(each.best_frame),
            "\n".join(_words(thing) for thing in each.things),
        )
    console.print(table)


def _words(thing: "FoundThing") -> str:
    kind = f", {thing.kind}" if thing.kind and thing.kind != thing.label else ""
    verdict = f", {thing.verdict}" if thing.verdict else ""
    return escape(f"{thing.label}{kind} ({thing.id}, {thing.distance_m:.1f} m{verdict})")
