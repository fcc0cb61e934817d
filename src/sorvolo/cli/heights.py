"""`sorvolo heights` and `sorvolo measure`: height models of mapped flights, and volumes between them."""

import csv
import math
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape

from sorvolo.cli.options import Area, AsJson, Flight, OutFile, SiteArgument, option
from sorvolo.cli.printing import (
    TO_CHECK,
    Console,
    facts_table,
    print_json,
    read_json,
    show_notices_and_warnings,
    show_path,
)
from sorvolo.cli.progress import ProgressReport
from sorvolo.cli.sites import opened_site
from sorvolo.paths import JsonView
from sorvolo.survey.wording import counted

if TYPE_CHECKING:
    from sorvolo.missions.heights.measure import MeasuredVolume
    from sorvolo.store.site.catalogue_place import Catalogues

measure_app = typer.Typer(no_args_is_help=True)


def heights(
    site: SiteArgument,
    flight: Flight = "",
    cell: Annotated[
        float | None,
        option("Side of the height model's cells, m.", show_default="3 to 6 pixels of the map"),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Make heights of a mapped flight: heights.tif, terrain.tif and orthophoto.tif in the flight's folder.

    The map itself stays as it is. Photos should overlap by 70 % along and 60 % across the strips.

    Example: sorvolo heights field

    Example: sorvolo heights field --flight DJI_0042 --cell 0.1
    """
    with opened_site(site, writes=True) as place:
        report = make_and_read(place.folder, flight, cell)
        if as_json:
            print_json({"site": str(place.folder), "heights": report})
        else:
            show_heights(place.folder, report, Console())
    if report["contradicts_itself"]:
        raise typer.Exit(TO_CHECK)


@measure_app.callback()
def measure() -> None:
    """Measure volumes, profiles and contours on the heights of flights."""


@measure_app.command()
def volume(
    site: SiteArgument,
    area: Area,
    since: Annotated[
        str,
        option("Earlier flight to compare with.", show_default="the ground around the area"),
    ] = "",
    flight: Flight = "",
    as_json: AsJson = False,
) -> None:
    """Measure what was dug and heaped in an area between two flights, or a pile above the ground around it.

    The later flight is first aligned with the earlier one by the ground outside the area.

    Example: sorvolo measure volume field --area pit.geojson --since may --flight june

    Example: sorvolo measure volume field --area pile.geojson
    """
    from sorvolo.missions.heights.measure import measure_volume

    assert area is not None  # typer demands it
    with opened_site(site) as place:
        found = measure_volume(place.folder, area, flight=flight, since=since)
    if as_json:
        print_json({**vars(found), "net_m3": found.volume.net_m3})
    else:
        _show_volume(found, Console())


@measure_app.command()
def profile(
    site: SiteArgument,
    at: Annotated[list[str], option("A place of the line, LAT,LON in degrees; give two or more.")],
    flight: Flight = "",
) -> None:
    """Print heights along a line as CSV: way, place, surface with its sigma, and bare ground, m.

    Example: sorvolo measure profile field --at 46.8426,-91.9945 --at 46.8430,-91.9940 > profile.csv
    """
    from sorvolo.missions.heights.measure import measure_profile

    with opened_site(site) as place:
        rows = measure_profile(place.folder, at, flight=flight)
    writer = csv.writer(sys.stdout, lineterminator="\n")
    writer.writerow(["way_m", "latitude_deg", "longitude_deg", "surface_m", "sigma_m", "ground_m"])
    for row in rows:
        numbers = (row.surface_m, row.sigma_m, row.ground_m)
        writer.writerow(
            [
                f"{row.way_m:.3f}",
                f"{row.latitude_deg:.8f}",
                f"{row.longitude_deg:.8f}",
                *("" if math.isnan(number) else f"{number:.3f}" for number in numbers),  # a hole
            ]
        )


@measure_app.command()
def contours(
    site: SiteArgument,
    out: OutFile,
    interval: Annotated[float, option("Difference in height between lines, m.")] = 1.0,
    flight: Flight = "",
) -> None:
    """Write contour lines of the bare ground.

    Example: sorvolo measure contours field --interval 0.5 --out contours.geojson
    """
    from sorvolo.missions.heights.measure import write_contours

    with opened_site(site) as place:
        count = write_contours(place.folder, out, interval, flight=flight)
    typer.echo(f"{out}: {counted(count, 'line')}")


def make_and_read(
    site: Path,
    flight: str = "",
    cell_m: float | None = None,
    *,
    catalogues: "Catalogues | None" = None,
) -> JsonView:
    """Make a flight's heights with progress on stderr; return their report."""
    from sorvolo.missions.heights.run import make_heights
    from sorvolo.store.site.files import HeightFile

    making = make_heights(site, cell_m, flight=flight or None, catalogues=catalogues)
    with ProgressReport(Console(stderr=True)) as progress:
        progress.show("heights")
        for update in making:
            progress.show(f"heights: {update.stage}, percent", round(100 * update.share), 100)
    return read_json(making.result().paths[HeightFile.REPORT])


def show_heights(site: Path, report: JsonView, console: Console) -> None:
    """Print what a flight's heights are good for, and where the files are."""
    from sorvolo.store.site.files import HeightFile

    cameras, surface = report["cameras"], report["surface"]
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
    console.print(facts_table(f"Heights of {escape(report['flight'])}", rows))
    show_notices_and_warnings(report, console)
    folder = site / "flights" / report["flight"]
    for name, file in (
        ("heights", HeightFile.SURFACE),
        ("bare ground", HeightFile.GROUND),
        ("orthophoto", HeightFile.ORTHOPHOTO),
        ("picture", HeightFile.PICTURE),
    ):
        if (folder / file).is_file():
            show_path(name, folder / file, console)


def _judged(found: JsonView) -> str:
    """What the flight's own points state of the heights' error; "" without enough points."""
    if found["median_m"] is None:
        return ""
    raised = f"; raised {found['factor']:.1f} times" if found["factor"] > 1 else ""
    return (
        f"{found['points']:,} points of the flight's own: {found['median_m']:.2f} m off (median), "
        f"{found['within_2_sigma']:.0%} within 2 sigma of the match{raised}"
    )


def _show_volume(found: "MeasuredVolume", console: Console) -> None:
    measured = found.volume
    since = f"since {found.earlier}" if found.earlier else "above the ground around the area"
    tied = ""
    if found.tied is not None:
        east, north, up = found.tied.shift_m
        tied = (
            f"moved by {east:.2f}, {north:.2f}, {up:.2f} m (east, north, up); the ground outside the "
            f"area then differs by {found.tied.spread_m:.2f} m (1 sigma)"
        )
    rows = [
        ("came" if found.earlier else "above", f"{measured.fill_m3:,.1f} m3"),
        ("taken away" if found.earlier else "below", f"{measured.cut_m3:,.1f} m3"),
        (
            "difference",
            f"{measured.net_m3:,.1f} m3, accuracy {measured.sigma_m3:,.1f} m3 (1 sigma)",
        ),
        ("area", f"{measured.area_m2:,.1f} m2, {measured.known_share:.0%} of it with heights"),
        ("flights tied", tied),
    ]
    console.print(facts_table(f"Volume of {escape(found.flight)}, {escape(since)}", rows))
