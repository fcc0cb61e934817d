"""`sorvolo archive export`: all sites of an archive as one table for searches without a server."""

import json
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from sorvolo.cli.exit_codes import FAILED
from sorvolo.cli.options import AsJson
from sorvolo.cli.progress import shown_work
from sorvolo.survey.wording import counted_list


def export_command(
    root: Annotated[
        str, typer.Argument(help="The folder that holds the site folders, or s3://BUCKET/PREFIX.")
    ],
    out: Annotated[Path, typer.Option(help="The file to write: NAME.parquet.")],
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
        typer.echo(json.dumps({"root": root, "file": str(out), **asdict(outcome)}, indent=1))
    else:
        typer.echo(f"{out}: {counted_list(outcome.kinds, none='no sites')}")
        if outcome.local:
            typer.echo(f"left out, without a place on Earth: {', '.join(outcome.local)}")
        for name, fault in outcome.faults.items():
            typer.echo(f"{name}: {fault}", err=True)
    if outcome.faults:
        raise typer.Exit(FAILED)
