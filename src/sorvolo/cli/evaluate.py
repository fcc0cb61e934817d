"""`sorvolo evaluate`: how good a result is, in numbers."""

import json
import math
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table

from sorvolo.missions.evaluate_mosaic import MosaicEvaluation, evaluate_mosaic
from sorvolo.mosaic.quality import Spread
from sorvolo.store.exports import plain_json

evaluate_app = typer.Typer(no_args_is_help=True)


@evaluate_app.callback()
def evaluate() -> None:
    """Measure results against truth, references, or themselves."""


@evaluate_app.command()
def mosaic(
    site: Annotated[Path, typer.Argument(help="The site folder that `sorvolo map` made.")],
    truth: Annotated[Path | None, typer.Option(help="Folder that `sorvolo simulate` made.")] = None,
    reference: Annotated[Path | None, typer.Option(help="GeoTIFF of the same ground.")] = None,
    positions: Annotated[
        Path | None, typer.Option(help="CSV of camera places: frame,longitude_deg,latitude_deg[,height_m].")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Accuracy of a map, and how much it deviates from its own frames.

    Example: sorvolo evaluate mosaic demo-map --truth demo-site

    Example: sorvolo evaluate mosaic field-map --reference orthophoto.tif --json
    """
    measured = evaluate_mosaic(site, truth=truth, reference=reference, positions=positions)
    if as_json:
        typer.echo(json.dumps(plain_json(measured), indent=1))
    else:
        _show(measured)


def _show(measured: MosaicEvaluation) -> None:
    console = Console()
    frames = Table("flight", "selected", "by vision", "by GPS alone", "rejected", "unknown to the truth")
    for each in measured.flights:
        frames.add_row(each.flight, *map(str, (
            each.selected, each.vision, each.gps_only, each.rejected, each.unmatched
        )))
    console.print(frames)
    errors = Table("against", "rms m", "p95 m", "max m", "rms px", "points")
    for truth in measured.truth:
        for name, spread in (
            ("corners", truth.corners.absolute),
            ("corners, shape only", truth.corners.shape),
            ("floor: what GPS noise alone costs", truth.corners.floor),
            ("corners placed by GPS alone", truth.gps_only),
            ("cameras, horizontal", truth.cameras),
        ):
            _add(errors, f"{truth.flight}: {name}", spread)
    if measured.positions is not None:
        _add(errors, "camera positions", measured.positions.absolute)
        _add(errors, "camera positions, shape only", measured.positions.shape)
    if errors.row_count:
        console.print(errors)
    for truth in measured.truth:
        if math.isfinite(truth.corners.over_floor):
            console.print(f"{truth.flight}: absolute error over its floor {truth.corners.over_floor:.2f}")
    deviation = measured.deviation
    if deviation.frames:
        console.print(
            f"deviation from {deviation.frames} of its own frames (thesis 4.1.1): {deviation.mean:.1%} on "
            f"average, {deviation.median:.1%} median, {deviation.worst:.1%} worst"
        )
    if measured.reference is not None:
        match = measured.reference
        console.print(
            f"correlation with the reference (eq. 4.1): {match.correlation:.3f} over {match.area_m2:.0f} m2 "
            f"at {match.m_per_px:.3f} m/px; the map lies {match.shift_east_m:+.2f} m east, "
            f"{match.shift_north_m:+.2f} m north of it (confidence {match.shift.response:.2f}); "
            f"{match.correlation_after_shift:.3f} without that"
        )


def _add(table: Table, name: str, spread: Spread) -> None:
    if spread.count:
        table.add_row(
            name, f"{spread.rms_m:.3f}", f"{spread.p95_m:.3f}", f"{spread.max_m:.3f}", f"{spread.rms_px:.2f}",
            str(spread.count),
        )
