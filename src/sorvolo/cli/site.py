"""`sorvolo site`: a site copied to another place, the copy verified, a bucket pruned."""

import json
from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated

import typer

from sorvolo.cli.exit_codes import FAILED
from sorvolo.cli.options import AsJson
from sorvolo.cli.places_of_sites import show_copy
from sorvolo.survey.wording import counted

if TYPE_CHECKING:
    from sorvolo.store.copies.transfer import CopyOutcome

site_app = typer.Typer(no_args_is_help=True)

_MOST_FAULTS = 20  # lines on a terminal; by choice


@site_app.callback()
def site() -> None:
    """Copy sites to other places, verify the copies, and prune sites in a store."""


@site_app.command("copy")
def copy_command(
    source: Annotated[str, typer.Argument(help="Folder of the map, or s3://BUCKET/NAME.")],
    target: Annotated[
        str,
        typer.Argument(help="A new or empty folder or s3:// place, or that of an earlier copy."),
    ],
    verify: Annotated[
        bool, typer.Option("--verify", help="Copy nothing: compare the copy with the map.")
    ] = False,
    catalogue: Annotated[
        str,
        typer.Option(
            help="Where a new copy's catalogue lies: postgresql://USER@HOST/DATABASE; else in the copy."
        ),
    ] = "",
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
        row = asdict(outcome) | {"faults": dict(outcome.faults), "is_whole": not outcome.faults}
        typer.echo(json.dumps({"source": source, "target": target, **row}, indent=1))
    else:
        _print(outcome, target, verified=verify)
    if outcome.faults:
        raise typer.Exit(FAILED)


@site_app.command("prune")
def prune_command(
    place: Annotated[str, typer.Argument(help="The site in a store: s3://BUCKET/NAME.")],
    keep_days: Annotated[
        float, typer.Option(min=0.0, help="Keep what was stored less than this many days ago.")
    ] = 7.0,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Remove nothing: count.")] = False,
    as_json: AsJson = False,
) -> None:
    """Remove what a site in a store no longer uses: earlier maps, pictures of flights that were mapped again.

    Versions of the map, and all that the site names, stay.

    Example: sorvolo site prune s3://survey-archive/field --dry-run
    """
    from sorvolo.missions.site.copy import prune_site

    pruned = prune_site(place, keep_days, only_count=dry_run)
    if as_json:
        typer.echo(json.dumps({"place": place, "dry_run": dry_run, **asdict(pruned)}, indent=1))
    else:
        done = "would remove" if dry_run else "removed"
        typer.echo(
            f"{place}: {done} {counted(pruned.objects, 'object')} ({pruned.bytes / 1e6:,.1f} MB); "
            f"{pruned.kept_bytes / 1e6:,.1f} MB remain"
        )


def _print(outcome: "CopyOutcome", target: str, *, verified: bool) -> None:
    done = "compared" if verified else "copied"
    typer.echo(
        f"{target}: {done} {outcome.copied:,} of {outcome.files:,} files ({outcome.copied_bytes / 1e6:,.1f} MB), "
        f"version {outcome.newest} of the map"
    )
    if outcome.left_out:
        names = ", ".join(outcome.left_out[:_MOST_FAULTS])
        typer.echo(
            f"not copied, not part of the map: {names}{', ...' if len(outcome.left_out) > _MOST_FAULTS else ''}"
        )
    for path, fault in list(outcome.faults.items())[:_MOST_FAULTS]:
        typer.echo(f"{path}: {fault}", err=True)
    if len(outcome.faults) > _MOST_FAULTS:
        typer.echo(f"and {len(outcome.faults) - _MOST_FAULTS:,} more (--json lists all)", err=True)
    if not outcome.faults:
        typer.echo("every file matches" if verified else "the copy is complete")
    elif not verified:
        typer.echo(
            "the rest was copied; restore these files of the map from another copy, or map again",
            err=True,
        )
