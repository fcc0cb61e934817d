"""The command `sorvolo`: its commands, and the one place where errors become exit codes."""

import logging
import os
import signal
import sys
import threading
import tomllib
import traceback
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TextIO

import typer

from sorvolo.build import build
from sorvolo.cli.archive import archive_app, site_app
from sorvolo.cli.batch import batch
from sorvolo.cli.calibrate import calibrate
from sorvolo.cli.compare import compare
from sorvolo.cli.evaluate import evaluate_app
from sorvolo.cli.heights import heights, measure_app
from sorvolo.cli.history import history, review
from sorvolo.cli.inspect import inspect
from sorvolo.cli.map import map_command
from sorvolo.cli.models import models_app
from sorvolo.cli.options import option
from sorvolo.cli.plan import plan
from sorvolo.cli.printing import FAILED, STOPPED
from sorvolo.cli.progress import IS_QUIET
from sorvolo.cli.reproduce import reproduce
from sorvolo.cli.search import search_command
from sorvolo.cli.serve import serve, token
from sorvolo.cli.simulate import demo, simulate
from sorvolo.cli.stream import stream
from sorvolo.cli.telemetry import telemetry_command
from sorvolo.cli.train import train
from sorvolo.cli.watch import watch_command
from sorvolo.errors import FULL, InputError, SettingsError, SorvoloError, SorvoloWarning
from sorvolo.store.freed_memory import share_arenas

if TYPE_CHECKING:
    from sys import UnraisableHookArgs

_COMMANDS = (
    *(inspect, plan, map_command, compare, watch_command, search_command, telemetry_command),
    *(simulate, train, calibrate, demo, history, review, heights, serve, stream, token, batch),
    reproduce,
)
_ASKED_AGAIN_S = 0.02  # an end that C code swallowed is asked for again so soon; by choice

app = typer.Typer(no_args_is_help=True, pretty_exceptions_enable=False)
for _command in _COMMANDS:
    app.command(_command.__name__.removesuffix("_command"))(_command)
app.add_typer(archive_app, name="archive")
app.add_typer(evaluate_app, name="evaluate")
app.add_typer(measure_app, name="measure")
app.add_typer(models_app, name="models")
app.add_typer(site_app, name="site")


@dataclass
class GlobalOptions:
    """The options before the command, and the last line of a command that was stopped."""

    debug: bool = False
    stop_words: str = "stopped; unfinished work was discarded, everything before it is unchanged"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command. The exit code: 0 success, 1 an error (one line on stderr), 2 wrong usage, 130 stopped."""
    # before NumPy is loaded: BLAS's threads only wait for each other over our small matrices
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    share_arenas()
    global_options = GlobalOptions()
    try:
        with _interrupts_repeated(), _warnings_in_one_line():
            app(
                args=None if arguments is None else list(arguments),
                prog_name="sorvolo",
                obj=global_options,
            )
    except SystemExit as stop:
        code = stop.code if isinstance(stop.code, int) else FAILED
        if code == STOPPED:
            _print_line(global_options.stop_words)
        return code
    except Exception as error:
        if global_options.debug:
            traceback.print_exc()
        _print_line(f"error: {_words_of(error)}")
        return FAILED
    return 0


@contextmanager
def _interrupts_repeated() -> Iterator[None]:
    """A Ctrl-C that strikes where Python can raise nothing, as in the clean-up of a library's object, strikes again."""
    before = sys.unraisablehook

    def strike_again() -> None:
        # wakes a main thread that waits, too
        signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGINT)

    def look(lost: "UnraisableHookArgs") -> None:
        if not issubclass(lost.exc_type, KeyboardInterrupt):
            before(lost)
            return
        again = threading.Timer(_ASKED_AGAIN_S, strike_again)
        again.daemon = True
        again.start()

    sys.unraisablehook = look
    try:
        yield
    finally:
        sys.unraisablehook = before


@contextmanager
def _warnings_in_one_line() -> Iterator[None]:
    """Our own warnings are for the person at the terminal, who needs no place in the program."""
    with warnings.catch_warnings():
        before = warnings.showwarning

        def show(
            message: Warning | str,
            category: type[Warning],
            filename: str,
            lineno: int,
            file: TextIO | None = None,
            line: str | None = None,
        ) -> None:
            if issubclass(category, SorvoloWarning):
                _print_line(f"warning: {message}")
            else:
                before(message, category, filename, lineno, file, line)

        warnings.showwarning = show
        yield


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"sorvolo {build()}")
        raise typer.Exit


@app.callback()
def options(
    context: typer.Context,
    version: Annotated[
        bool,
        option("Print the version and stop.", "--version", callback=_print_version, is_eager=True),
    ] = False,
    debug: Annotated[
        bool, option("Show where in the program an error occurred.", "--debug")
    ] = False,
    quiet: Annotated[
        bool, option("Show no progress; results, warnings and errors stay.", "--quiet")
    ] = False,
    verbose: Annotated[
        bool, option("Log each step to stderr, in place of bars.", "--verbose")
    ] = False,
    config: Annotated[
        Path | None,
        option("A TOML file with a table of options for each command, such as `map`."),
    ] = None,
) -> None:
    """Maps from small drones: geo-referenced, compared with earlier flights, searched for people and cars.

    New here? Run `sorvolo demo`. With a flight of your own: `sorvolo inspect`, then `map`, `compare` or `watch`.
    """
    context.ensure_object(GlobalOptions).debug = debug
    context.call_on_close(partial(IS_QUIET.reset, IS_QUIET.set(quiet or verbose)))
    if verbose:
        logger, handler = logging.getLogger("sorvolo"), logging.StreamHandler()
        handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
        logger.addHandler(handler)
        logger.setLevel(logging.INFO)
        context.call_on_close(partial(logger.setLevel, logging.NOTSET))
        context.call_on_close(partial(logger.removeHandler, handler))
    if config is not None:
        try:
            tables = tomllib.loads(config.read_text(encoding="utf-8"))
        except (OSError, ValueError, RecursionError) as error:
            raise InputError(f"{config}: no TOML file that can be read ({error})") from error
        context.default_map = _defaults(context.command, tables, f"{config}: ")


def _defaults(command: Any, table: Mapping[str, Any], where: str) -> dict[str, Any]:
    """What a table of a settings file gives for a command's options, or for those of a group's commands.

    Raises SettingsError for a name that is none of them.
    """
    if not isinstance(table, Mapping):
        raise SettingsError(f"{where.rstrip(': ')} is no table of options, but {table!r}")
    below = getattr(command, "commands", {})
    options = {} if below else {o.lstrip("-"): each for each in command.params for o in each.opts}
    if unknown := sorted(set(table) - {*options, *below}):
        known = ", ".join(sorted({*options, *below} - {"help"}))
        raise SettingsError(f"{where}there is no {unknown[0]!r}; there are {known}")
    defaults = {}
    for name, value in table.items():
        if name in below:
            defaults[name] = _defaults(below[name], value, f"{where}[{name}] ")
            continue
        option = options[name]
        if isinstance(value, bool) and not option.is_flag:
            raise SettingsError(f"{where}{name} takes a value, not {str(value).lower()}")
        defaults[option.name] = value
    return defaults


def _words_of(error: Exception) -> str:
    """What happened and what to do, in one line."""
    if isinstance(error, SorvoloError):
        return f"{error}"
    if isinstance(error, ImportError):
        return f"{error}; a package is missing or broken"
    if isinstance(error, OSError) and error.errno in FULL:
        where = f" while writing {error.filename}" if error.filename else ""
        return f"the disk is full{where}; free some space and run the same command again"
    if isinstance(error, OSError) and error.strerror:
        where = f"{error.filename}: " if error.filename else ""
        return f"{where}{error.strerror}; check that the path exists and may be read and written"
    if isinstance(error, MemoryError):
        return "out of memory; close other programs, or make a coarser map with --gsd"
    if isinstance(error, UnicodeEncodeError) and error.reason.startswith("surrogates"):
        return "the name of a file or folder is not UTF-8, as from an old disk or zip; rename it"
    return (
        f"this is a bug in sorvolo {build()}: {type(error).__name__}: {error}. Please report it with the "
        "command and what `sorvolo --debug ...` prints (see CONTRIBUTING.md)"
    )


def _print_line(text: str) -> None:
    typer.echo(" ".join(text.split()), err=True)
