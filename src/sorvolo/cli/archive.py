"""`sorvolo archive` and `sorvolo site`: an index of many sites; copies of one."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape

from sorvolo.cli.options import AsJson, CatalogueAddress, OutFile, argument, option, wanted_classes
from sorvolo.cli.printing import FAILED, Console, new_table, print_json
from sorvolo.cli.progress import shown_work
from sorvolo.cli.sites import show_copy
from sorvolo.survey.wording import counted, counted_list

if TYPE_CHECKING:
    from sorvolo.store.index.finding import FoundFlight, FoundThing

archive_app = typer.Typer(no_args_is_help=True)
site_app = typer.Typer(no_args_is_help=True)

_MAX_FAULTS = 20  # lines on a terminal; by choice

Root = Annotated[Path, argument("The folder that holds the site folders.")]


@archive_app.callback()
def archive() -> None:
    """Find flights, objects and changes of all sites of a folder by place and time."""


@archive_app.command("index")
def index_command(
    root: Root,
    catalogue: CatalogueAddress = "",
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
        print_json({"root": str(root), **vars(outcome)})
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
    at: Annotated[str, option("The place: LATITUDE,LONGITUDE in degrees (WGS84).")],
    first: Annotated[str, option("From this date or time (UTC) on.", "--from")] = "",
    last: Annotated[str, option("Up to this date or time (UTC).", "--to")] = "",
    classes: Annotated[
        str | None,
        option("Only flights that found one of these there, such as car,appeared.", "--class"),
    ] = None,
    within: Annotated[float, option("How near a finding must be to count as there, m.")] = 2.0,
    as_json: AsJson = False,
) -> None:
    """List the flights that saw a place, in order of time, and what they found there.

    Example: sorvolo archive find /srv/flights --at 46.5001,13.2502

    Example: sorvolo archive find /srv/flights --at 46.5001,13.2502 --from 2026-05-01 --class car --within 10
    """
    from sorvolo.missions.archive.index import find_place

    found = find_place(
        root,
        at,
        first=first,
        last=last,
        classes=wanted_classes(classes, "--class"),
        within_m=within,
    )
    if as_json:
        print_json({"root": str(root), "at": at, "flights": found})
    else:
        _show(found, Console(), classes)


def _show(found: Sequence["FoundFlight"], console: Console, classes: str | None) -> None:
    from sorvolo.store.exports.plain import time_words

    if not found:
        of_class = f", or none found {classes} there" if classes else ""
        console.print(escape(f"no flight saw this place at that time{of_class}"))
        return
    table = new_table("flown", "site", "flight", "by", "frames", "best frame", "found there")
    for flight in found:
        table.add_row(
            time_words(flight.first_ns)[:19],
            escape(flight.site),
            escape(flight.flight),
            flight.kind,
            f"{flight.frames:,}",
            escape(flight.best_frame),
            "\n".join(_words(thing) for thing in flight.things),
        )
    console.print(table)


def _words(thing: "FoundThing") -> str:
    kind = f", {thing.kind}" if thing.kind and thing.kind != thing.label else ""
    verdict = f", {thing.verdict}" if thing.verdict else ""
    return escape(f"{thing.label}{kind} ({thing.id}, {thing.distance_m:.1f} m{verdict})")


@archive_app.command("export")
def export_command(
    root: Annotated[
        str, argument("The folder that holds the site folders, or s3://BUCKET/PREFIX.")
    ],
    out: OutFile,
    as_json: AsJson = False,
) -> None:
    """Write all sites, flights, versions, changes and objects as stac-geoparquet, for DuckDB, GeoPandas or QGIS.

    Needs the package pyarrow, which the extra `archive` installs. The exit code is 1 if a site could not be read; the
    others are written.

    Example: sorvolo archive export maps --out archive.parquet
    """
    from sorvolo.missions.archive.export import export_archive

    outcome = shown_work(
        export_archive(root, out),
        lambda progress, update: progress.show(
            "reading sites", update.done, update.sites or None, update.site
        ),
    )
    if as_json:
        print_json({"root": root, "file": str(out), **vars(outcome)})
    else:
        typer.echo(f"{out}: {counted_list(outcome.kinds, none='no sites')}")
        if outcome.local:
            typer.echo(f"left out, without a place on Earth: {', '.join(outcome.local)}")
        for name, fault in outcome.faults.items():
            typer.echo(f"{name}: {fault}", err=True)
    if outcome.faults:
        raise typer.Exit(FAILED)


@site_app.callback()
def site() -> None:
    """Copy sites to other places, verify the copies, and prune sites in a store."""


@site_app.command("copy")
def copy_command(
    source: Annotated[str, argument("Folder of the map, or s3://BUCKET/NAME.")],
    target: Annotated[
        str,
        argument("A new or empty folder or s3:// place, or that of an earlier copy."),
    ],
    verify: Annotated[
        bool, option("Copy nothing: compare the copy with the map.", "--verify")
    ] = False,
    catalogue: CatalogueAddress = "",
    as_json: AsJson = False,
) -> None:
    """Copy a map with all its versions, flights, pictures and findings; an interrupted copy continues.

    Every file is checked by its SHA-256. While a flight is being mapped, the copy is the map as of the last complete
    flight. The exit code is 1 if a file is missing, damaged or, with --verify, different.

    Example: sorvolo site copy field /media/usb/field

    Example: sorvolo site copy field /media/usb/field --verify
    """
    from sorvolo.missions.site.copy import copy_site, verify_copy

    work = verify_copy(source, target) if verify else copy_site(source, target, catalogue)
    outcome = show_copy(work, "comparing, file" if verify else "copying, file")
    if as_json:
        row = vars(outcome) | {"faults": dict(outcome.faults), "is_whole": not outcome.faults}
        print_json({"source": source, "target": target, **row})
    else:
        done = "compared" if verify else "copied"
        typer.echo(
            f"{target}: {done} {outcome.copied:,} of {outcome.files:,} files ({outcome.copied_bytes / 1e6:,.1f} MB), "
            f"version {outcome.newest} of the map"
        )
        if outcome.left_out:
            names = ", ".join(outcome.left_out[:_MAX_FAULTS])
            typer.echo(
                f"not copied, not part of the map: {names}{', ...' if len(outcome.left_out) > _MAX_FAULTS else ''}"
            )
        for path, fault in list(outcome.faults.items())[:_MAX_FAULTS]:
            typer.echo(f"{path}: {fault}", err=True)
        if len(outcome.faults) > _MAX_FAULTS:
            typer.echo(
                f"and {len(outcome.faults) - _MAX_FAULTS:,} more (--json lists all)", err=True
            )
        if not outcome.faults:
            typer.echo("every file matches" if verify else "the copy is complete")
        elif not verify:
            typer.echo(
                "the rest was copied; restore these files of the map from another copy, or map again",
                err=True,
            )
    if outcome.faults:
        raise typer.Exit(FAILED)


@site_app.command("prune")
def prune_command(
    place: Annotated[str, argument("The site in a store: s3://BUCKET/NAME.")],
    keep_days: Annotated[
        float, option("Keep what was stored less than this many days ago.", min=0.0)
    ] = 7.0,
    dry_run: Annotated[bool, option("Remove nothing: count.", "--dry-run")] = False,
    as_json: AsJson = False,
) -> None:
    """Remove what a site in a store no longer uses: earlier maps, pictures of flights that were mapped again.

    Versions of the map, and all that the site names, stay.

    Example: sorvolo site prune s3://survey-archive/field --dry-run
    """
    from sorvolo.missions.site.copy import prune_site

    pruned = prune_site(place, keep_days, only_count=dry_run)
    if as_json:
        print_json({"place": place, "dry_run": dry_run, **vars(pruned)})
    else:
        done = "would remove" if dry_run else "removed"
        typer.echo(
            f"{place}: {done} {counted(pruned.objects, 'object')} ({pruned.bytes / 1e6:,.1f} MB); "
            f"{pruned.kept_bytes / 1e6:,.1f} MB remain"
        )
