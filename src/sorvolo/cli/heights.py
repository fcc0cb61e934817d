"""`sorvolo heights`: a height model, the bare ground and a true orthophoto of a mapped flight."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from sorvolo.cli.exit_codes import TO_CHECK
from sorvolo.cli.options import AsJson
from sorvolo.cli.places_of_sites import SiteArgument, opened_site
from sorvolo.cli.progress import ProgressReport
from sorvolo.cli.shown import read_json, show_path

if TYPE_CHECKING:
    from sorvolo.store.site.catalogue_place import Catalogues


def heights(
    site: SiteArgument,
    flight: Annotated[
        str, typer.Option(help="Which flight. Without it: that of the newest map.")
    ] = "",
    cell: Annotated[
        float | None,
        typer.Option(
            help="Side of the height model's cells, m. Without it: 3 to 6 pixels of the map."
        ),
    ] = None,
    orthophoto: Annotated[bool, typer.Option(help="Also make a true orthophoto.")] = True,
    as_json: AsJson = False,
) -> None:
    """Make heights of a mapped flight: heights.tif, terrain.tif and orthophoto.tif in the flight's folder.

    The map itself stays as it is. Photos should overlap by 70 % along and 60 % across the strips.

    Example: sorvolo heights field

    Example: sorvolo heights field --flight DJI_0042 --cell 0.1
    """
    with opened_site(site, writes=True) as place:
        report = make_and_read(place.folder, flight, cell, has_orthophoto=orthophoto)
        if as_json:
            typer.echo(json.dumps({"site": str(place.folder), "heights": report}, indent=1))
        else:
            show_heights(place.folder, report, Console())
    if report["contradicts_itself"]:
        raise typer.Exit(TO_CHECK)


def make_and_read(
    site: Path,
    flight: str = "",
    cell_m: float | None = None,
    *,
    has_orthophoto: bool = True,
    catalogues: "Catalogues | None" = None,
) -> Mapping[str, Any]:
    """Make a flight's heights with progress on stderr; their report."""
    from sorvolo.missions.heights.run import HeightSettings, make_heights
    from sorvolo.store.site.files import HeightFile

    flight_id = ""
    with ProgressReport(Console(stderr=True)) as progress:
        progress.show("heights")
        for update in make_heights(
            site,
            HeightSettings(cell_m=cell_m, has_orthophoto=has_orthophoto),
            flight=flight or None,
            catalogues=catalogues,
        ):
            flight_id = update.flight_id
            progress.show(f"heights: {update.stage}, percent", round(100 * update.share), 100)
    return read_json(site / "flights" / flight_id / HeightFile.REPORT)


def show_heights(site: Path, report: Mapping[str, Any], console: Console) -> None:
    """Print what a flight's heights are good for, and where the files are."""
    from sorvolo.store.site.files import HeightFile

    cameras, surface = report["cameras"], report["surface"]
    table = Table(
        title=f"Heights of {escape(report['flight'])}", show_header=False, title_justify="left"
    )
    rows = [
        ("photos", f"{cameras['views']} with {cameras['points']:,} points in space"),
        ("match error", f"{cameras['residual_rms_px']:.2f} px (root mean square)"),
        (
            "cells",
            f"{100 * report['cell_m']:.1f} cm, {surface['covered_m2']:,.0f} m2 seen by two photos",
        ),
        ("holes", f"{surface['holes_share']:.1%} of the ground that two photos see"),
        (
            "height error",
            ""
            if surface["sigma_median_m"] is None
            else f"{surface['sigma_median_m']:.2f} m (1 sigma, median; without the error shared by all GPS fixes)",
        ),
        ("judged by", _judged(surface["own_points"])),
        ("bare ground", f"{surface['ground_share']:.0%} of the cells"),
        (
            "took",
            f"{report['seconds']['total']:.1f} s, memory at most {report['peak_memory_mb']:,.0f} MB",
        ),
    ]
    for name, text in rows:
        if text:
            table.add_row(name, text)
    console.print(table)
    for warning in report["warnings"]:
        console.print(f"[yellow]warning[/yellow] {escape(warning)}", highlight=False)
    folder = site / "flights" / report["flight"]
    for name, file in (
        ("heights", HeightFile.SURFACE),
        ("bare ground", HeightFile.GROUND),
        ("orthophoto", HeightFile.ORTHOPHOTO),
        ("picture", HeightFile.PICTURE),
    ):
        if (folder / file).is_file():
            show_path(name, folder / file, console)


def _judged(found: Mapping[str, Any]) -> str:
    """What the flight's own points state of the heights' error; "" without enough points."""
    if found["median_m"] is None:
        return ""
    raised = f"; raised {found['factor']:.1f} times" if found["factor"] > 1 else ""
    return (
        f"{found['points']:,} points of the flight's own: {found['median_m']:.2f} m off (median), "
        f"{found['within_2_sigma']:.0%} within 2 sigma of the match{raised}"
    )
