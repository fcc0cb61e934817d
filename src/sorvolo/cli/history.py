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

from sorvolo.cli.options import AsJson, Compression, PlaceFormat, PlaceFormatOption
from sorvolo.cli.places_of_sites import SiteArgument, opened_site
from sorvolo.cli.shown import site_of
from sorvolo.errors import SettingsError

if TYPE_CHECKING:
    from sorvolo.missions.site.history import HistoryEntry


def history(
    site: SiteArgument,
    at: Annotated[
        str | None,
        typer.Option(help="Version number, or a date or time (UTC): the newest version by then."),
    ] = None,
    export: Annotated[
        Path | None, typer.Option(help="Write the map as it was: FILE.tif, .png or .kmz.")
    ] = None,
    compress: Annotated[
        Compression,
        typer.Option(help="Of a .tif: deflate (without loss) or jpeg (a fraction of the size)."),
    ] = Compression.DEFLATE,
    coordinates: PlaceFormatOption = PlaceFormat.LATLON,
    as_json: AsJson = False,
) -> None:
    """List the versions of a map, or write the map as it was at one of them.

    Example: sorvolo history field

    Example: sorvolo history field --at 2026-05-31 --export may.tif
    """
    if at is not None and export is None:
        raise SettingsError(
            "--at chooses the map to write: give --export FILE.tif, FILE.png or FILE.kmz as well"
        )
    with opened_site(site) as place:
        if export is None:
            _list(place.folder, coordinates, as_json=as_json)
        else:
            _export(place.folder, at, export, compress, as_json=as_json)


def _list(site: Path, coordinates: PlaceFormat, *, as_json: bool) -> None:
    from sorvolo.missions.site.history import site_history
    from sorvolo.store.exports.plain import plain_json

    entries = site_history(site)
    if as_json:
        typer.echo(json.dumps({"site": str(site), "versions": plain_json(entries)}, indent=1))
        return
    _show(entries, Console())
    if entries:
        _show_place(site, coordinates, Console())


def _export(
    site: Path, at: str | None, export: Path, compress: Compression, *, as_json: bool
) -> None:
    from sorvolo.missions.site.history import export_version, site_history
    from sorvolo.store.exports.plain import plain_json

    entries = site_history(site)
    version = export_version(site, at, export, compress=compress.value)
    if as_json:
        entry = next(each for each in entries if each.version == version.id)
        typer.echo(
            json.dumps(
                {"site": str(site), "file": str(export), "version": plain_json(entry)}, indent=1
            )
        )
    else:
        typer.echo(
            f"{export}: version {version.id}, flight {version.flight_id}, {version.created_utc}"
        )


def _show(entries: Sequence["HistoryEntry"], console: Console) -> None:
    if not entries:
        console.print("no map yet: sorvolo map makes one")
        return
    table = Table(box=SIMPLE_HEAD, padding=0)  # 80 letters hold it
    for name in (
        "no",
        "flown",
        "complete (UTC)",
        "flight",
        "by",
        "tiles",
        "MB",
        "changes",
        "reviewed",
    ):
        # folded between words, never within: "2 disappeared", "2026-11-22"
        table.add_column(
            name,
            no_wrap=name in ("no", "flown", "tiles", "MB"),
            overflow="fold",
            min_width={"complete (UTC)": 10, "changes": 13, "reviewed": 11, "by": 7}.get(name),
        )
    for each in entries:
        table.add_row(*_cells(each))
    console.print(table)
    console.print(
        "tiles: new or changed, of all; MB: written for this version", style="dim", highlight=False
    )


def _cells(entry: "HistoryEntry") -> tuple[str, ...]:
    """One version's row of the list."""
    removed = f" (-{entry.tiles_removed})" if entry.tiles_removed else ""
    changes = "\n".join(f"{count} {kind}" for kind, count in entry.changes.items())
    verdicts = ("confirmed", entry.confirmed), ("rejected", entry.rejected)
    again = " (repeated later)" if entry.is_replaced else ""
    return (
        str(entry.version),
        entry.flown_utc[:10] or "-",
        entry.date_utc[:16].replace("T", " "),
        escape(entry.flight) + again,
        entry.kind,
        f"{entry.tiles_changed}/{entry.tiles}{removed}",
        f"{entry.bytes_changed / 1e6:.1f}",
        changes or ("none" if entry.kind == "compare" else ""),
        "\n".join(f"{count} {word}" for word, count in verdicts if count),
    )


def _show_place(folder: Path, form: PlaceFormat, console: Console) -> None:
    """Where on the Earth the map is, if anywhere."""
    from sorvolo.geometry.coordinates import Coordinates, place_text

    site = site_of(folder)
    if not site.is_local:
        written = place_text(
            site.origin.latitude_deg, site.origin.longitude_deg, Coordinates(form.value)
        )
        console.print(f"the map's origin lies at {written}", highlight=False)
