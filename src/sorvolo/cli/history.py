"""`sorvolo history`: the versions of a map, and the map as it was."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from sorvolo.errors import SettingsError

if TYPE_CHECKING:
    from sorvolo.missions.site.history import HistoryEntry


def history(
    site: Annotated[Path, typer.Argument(help="The site folder.")],
    at: Annotated[
        str | None, typer.Option(help="Version number, or date or time (UTC): the newest version complete by its end.")
    ] = None,
    export: Annotated[Path | None, typer.Option(help="Write the map as it was: FILE.tif, .png or .kmz.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """List the versions of a map, or write the map as it was at one of them.

    Example: sorvolo history field

    Example: sorvolo history field --at 2026-05-31 --export may.tif
    """
    from sorvolo.missions.site.history import export_version, site_history
    from sorvolo.store.exports.plain import plain_json

    if at is not None and export is None:
        raise SettingsError("--at says which map to write; give --export FILE.tif, FILE.png or FILE.kmz as well")
    entries = site_history(site)
    if export is None:
        if as_json:
            typer.echo(json.dumps({"site": str(site), "versions": plain_json(entries)}, indent=1))
        else:
            _show(entries, Console())
        return
    version = export_version(site, at, export)
    if as_json:
        entry = next(each for each in entries if each.version == version.id)
        typer.echo(json.dumps({"site": str(site), "file": str(export), "version": plain_json(entry)}, indent=1))
    else:
        typer.echo(f"{export}: version {version.id}, flight {version.flight_id}, {version.created_utc}")


def _show(entries: Sequence["HistoryEntry"], console: Console) -> None:
    if not entries:
        console.print("no map yet")
        return
    table = Table(box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
    for name in ("no", "complete (UTC)", "flight", "by", "tiles", "MB", "changes", "reviewed"):
        table.add_column(name, no_wrap=name not in ("flight", "changes", "reviewed"), overflow="fold")
    for each in entries:
        removed = f" (-{each.tiles_removed})" if each.tiles_removed else ""
        changes = ", ".join(f"{count} {kind}" for kind, count in each.changes.items())
        reviewed = ", ".join(
            f"{count} {word}" for word, count in (("confirmed", each.confirmed), ("rejected", each.rejected)) if count
        )
        again = " (again since)" if each.is_replaced else ""
        table.add_row(
            str(each.version), each.date_utc[:16].replace("T", " "), escape(each.flight) + again, each.kind,
            f"{each.tiles_changed}/{each.tiles}{removed}", f"{each.bytes_changed / 1e6:.1f}",
            changes or ("none" if each.kind == "compare" else ""), reviewed,
        )
    console.print(table)
    console.print("tiles: new of all", style="dim")
