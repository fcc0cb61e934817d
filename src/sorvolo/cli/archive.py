"""`sorvolo archive`: all sites of a folder or a bucket together."""

import typer

from sorvolo.cli.archive_table import export_command

archive_app = typer.Typer(no_args_is_help=True)


@archive_app.callback()
def archive() -> None:
    """Find flights, objects and changes of all sites of a folder by place and time."""


archive_app.command("export")(export_command)
