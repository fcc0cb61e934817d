"""`sorvolo measure`: volumes, profiles and contours of flights that have heights."""

import csv
import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from sorvolo.cli.options import AsJson
from sorvolo.cli.places_of_sites import opened_site
from sorvolo.survey.wording import counted

if TYPE_CHECKING:
    from sorvolo.missions.heights.measure import MeasuredVolume

measure_app = typer.Typer(no_args_is_help=True)

_Site = Annotated[
    str,
    typer.Argument(
        help="Folder of the map, or s3://BUCKET/NAME; its flights need heights: sorvolo heights."
    ),
]
_Flight = Annotated[str, typer.Option(help="Which flight. Without it: that of the newest map.")]


@measure_app.callback()
def measure() -> None:
    """Measure volumes, profiles and contours on the heights of flights."""


@measure_app.command()
def volume(
    site: _Site,
    area: Annotated[
        Path, typer.Option(help="Area to measure: GeoJSON, KML, KMZ or a list of corners.")
    ],
    since: Annotated[
        str,
        typer.Option(
            help="Earlier flight to compare with. Without it: above the ground around the area."
        ),
    ] = "",
    flight: _Flight = "",
    as_json: AsJson = False,
) -> None:
    """Measure what was dug and heaped in an area between two flights, or a pile above the ground around it.

    The later flight is first laid on the earlier one by the ground outside the area.

    Example: sorvolo measure volume field --area pit.geojson --since may --flight june

    Example: sorvolo measure volume field --area pile.geojson
    """
    from sorvolo.missions.heights.measure import measure_volume
    from sorvolo.store.exports.plain import plain_json

    with opened_site(site) as place:
        found = measure_volume(place.folder, area, flight=flight, since=since)
    if as_json:
        typer.echo(json.dumps({**plain_json(found), "net_m3": found.volume.net_m3}, indent=1))
    else:
        _show(found, Console())


@measure_app.command()
def profile(
    site: _Site,
    at: Annotated[
        list[str], typer.Option(help="A place of the line, LAT,LON in degrees; give two or more.")
    ],
    step: Annotated[
        float, typer.Option(min=0.0, help="Distance between points, m; 0: a cell of the heights.")
    ] = 0.0,
    flight: _Flight = "",
) -> None:
    """Print heights along a line as CSV: way, place, surface with its sigma, and bare ground, m.

    Example: sorvolo measure profile field --at 46.8426,-91.9945 --at 46.8430,-91.9940 > profile.csv
    """
    from sorvolo.missions.heights.measure import measure_profile

    with opened_site(site) as place:
        rows = list(measure_profile(place.folder, at, flight=flight, step_m=step))
    writer = csv.writer(sys.stdout, lineterminator="\n")
    writer.writerow(["way_m", "latitude_deg", "longitude_deg", "surface_m", "sigma_m", "ground_m"])
    for row in rows:
        numbers = (row.surface_m, row.sigma_m, row.ground_m)
        writer.writerow(
            [
                f"{row.way_m:.3f}",
                f"{row.latitude_deg:.8f}",
                f"{row.longitude_deg:.8f}",
                *("" if each != each else f"{each:.3f}" for each in numbers),  # NaN: a hole
            ]
        )


@measure_app.command()
def contours(
    site: _Site,
    out: Annotated[Path, typer.Option(help="GeoJSON file to write.")],
    interval: Annotated[float, typer.Option(help="Difference in height between lines, m.")] = 1.0,
    flight: _Flight = "",
    surface: Annotated[
        bool, typer.Option("--surface", help="Of the surface, not of the bare ground.")
    ] = False,
) -> None:
    """Write contour lines of the bare ground.

    Example: sorvolo measure contours field --interval 0.5 --out contours.geojson
    """
    from sorvolo.missions.heights.measure import write_contours

    with opened_site(site) as place:
        count = write_contours(place.folder, out, interval, flight=flight, of_surface=surface)
    typer.echo(f"{out}: {counted(count, 'line')}")


def _show(found: "MeasuredVolume", console: Console) -> None:
    measured = found.volume
    since = f"since {found.earlier}" if found.earlier else "above the ground around the area"
    table = Table(
        title=f"Volume of {escape(found.flight)}, {escape(since)}",
        show_header=False,
        title_justify="left",
    )
    table.add_row("came" if found.earlier else "above", f"{measured.fill_m3:,.1f} m3")
    table.add_row("taken away" if found.earlier else "below", f"{measured.cut_m3:,.1f} m3")
    table.add_row(
        "difference", f"{measured.net_m3:,.1f} m3, accuracy {measured.sigma_m3:,.1f} m3 (1 sigma)"
    )
    table.add_row(
        "area", f"{measured.area_m2:,.1f} m2, {measured.known_share:.0%} of it with heights"
    )
    if found.tied is not None:
        east, north, up = found.tied.shift_m
        table.add_row(
            "flights tied",
            f"moved by {east:.2f}, {north:.2f}, {up:.2f} m (east, north, up); the ground outside the "
            f"area then differs by {found.tied.spread_m:.2f} m (1 sigma)",
        )
    console.print(table)
