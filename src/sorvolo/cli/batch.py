"""`sorvolo batch`: a mission over folders of flights, on this machine or on a Ray cluster."""

from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer
from rich.markup import escape

from sorvolo.cli.options import AsJson, Camera, Model, Resolution, argument, option
from sorvolo.cli.printing import FAILED, TO_CHECK, Console, new_table, print_json, show_path
from sorvolo.cli.progress import ProgressReport, shown_work
from sorvolo.errors import SettingsError
from sorvolo.survey.wording import counted

if TYPE_CHECKING:
    from sorvolo.cluster.batch import BatchReport, BatchRow, BatchUpdate

_MOST_ROWS = 40  # of a table on a terminal; longer ones show what failed first; by choice
_COLOURS = {
    "done": "green",
    "known": "green",
    "doubtful": "yellow",
    "duplicate": "blue",
    "skipped": "blue",
}


def batch(
    context: typer.Context,
    places: Annotated[list[Path], argument("Folders with flights, however deep, or videos.")],
    root: Annotated[
        Path,
        option("Folder for the results: one folder for each site, or for each watch."),
    ],
    mission: Annotated[
        Literal["map", "compare", "search", "watch"],
        option("What to do with each flight."),
    ] = "map",
    site_by: Annotated[
        Literal["flight", "place"] | None,
        option(
            "flight: each flight has a site of its own. place: flights near each other share one.",
            show_default="flight; place for compare",
        ),
    ] = None,
    executor: Annotated[
        str,
        option(
            "local: this machine. ray://HOST:PORT: a Ray cluster. ray: this machine's Ray, or a new one."
        ),
    ] = "local",
    workers: Annotated[
        int | None,
        option("Flights at once, at most.", show_default="one for each core"),
    ] = None,
    camera: Camera = "",
    gsd: Resolution = None,
    model: Model = "default",
    retry: Annotated[
        bool, option("Also try flights again that were set aside.", "--retry")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Map, compare, search or watch many flights. After a stop or a kill, the same command continues.

    Each flight runs in a process of its own. One whose process dies is tried once more, then it is set aside.
    ROOT/batch.jsonl holds what became of each.
    Ends with exit code 1 where a flight failed or was set aside, with 3 where a result is to be checked before use.

    Example: sorvolo batch flights/ --root maps

    Example: sorvolo batch /mnt/shared/valley --root /mnt/shared/maps --executor ray://head:10001
    """
    from sorvolo.cluster.batch import BatchSettings, run_batch
    from sorvolo.cluster.executors import LocalExecutor, default_slots, ray_executor

    context.obj.stop_words = f"stopped; run the same command to continue: {root} holds what is done"
    if workers is not None and workers < 1:
        raise SettingsError(f"--workers {workers}: at least 1 is needed")
    if executor not in ("local", "ray") and not executor.startswith("ray://"):
        raise SettingsError(f"--executor {executor}: give local, ray, or ray://HOST:PORT")
    by_place = mission == "compare" if site_by is None else site_by == "place"
    settings = BatchSettings(
        mission,
        _absolute(camera),
        _absolute(model),
        gsd,
        by_place,
        retry,
    )
    running = run_batch(
        places,
        root,
        settings,
        lambda table: (
            LocalExecutor(workers or default_slots(), table.lock)
            if executor == "local"
            else ray_executor(executor, workers, table.root)
        ),
    )
    with closing(running):  # also when the bar is stopped: then the missions are ended
        report = shown_work(running, _show_update)
    counts = report.counts()
    if as_json:
        rows = [{**vars(row), "is_known": row.key in report.known} for row in report.rows]
        print_json(
            {
                "root": str(root),
                "counts": report.counts(),
                "seconds": report.seconds,
                "cpu_s": round(
                    sum(row.cpu_s for row in report.rows if row.key not in report.known), 3
                ),
                "tries": report.tries,
                "crashes": report.crashes,
                "flights": rows,
            }
        )
    else:
        _show(report, places, root, Console())
    if counts.get("failed") or counts.get("set aside"):
        raise typer.Exit(FAILED)
    raise typer.Exit(TO_CHECK if counts.get("doubtful") else 0)


def _absolute(name: str) -> str:
    """The whole path of a file that is there; any other name as it is."""
    return str(Path(name).resolve()) if name and Path(name).is_file() else name


def _show_update(progress: ProgressReport, update: "BatchUpdate") -> None:
    row = update.row
    if row is not None and row.state != "running":
        state = _state_name(row, update.is_known)
        words = f"try {row.tries} failed: {row.words}" if row.state == "waiting" else row.words
        progress.console.print(
            f"[{_COLOURS.get(state, 'red')}]{state:>9}[/]  {escape(row.source)}: {escape(words)}",
            soft_wrap=True,
        )
    words = f"at {', '.join(update.running[:4])}" if update.running else ""
    progress.show(update.task, update.done, update.total, words)


def _state_name(row: "BatchRow", is_known: bool) -> str:
    if row.state == "waiting":
        return "again" if row.tries else "waiting"
    return "known" if is_known and row.state == "done" else row.state


def _show(report: "BatchReport", places: list[Path], root: Path, console: Console) -> None:
    from sorvolo.cluster.batch import TABLE

    ended = ", ".join(f"{count:,} {name}" for name, count in report.counts().items())
    console.print(f"{counted(len(report.rows), 'flight')}: {ended}", style="bold")
    rows = report.rows
    if len(rows) > _MOST_ROWS:
        rows = tuple(row for row in rows if row.state != "done")
    numbers = "tries", "s", "CPU s", "MB"
    table = new_table("flight", "folder", "state", *numbers, "", right=numbers)
    for row in rows[:_MOST_ROWS]:
        state = _state_name(row, row.key in report.known)
        # a flight's path below the folder that was given
        below = [
            path.relative_to(place.resolve()).as_posix()
            for place in places
            if (path := Path(row.source)).is_relative_to(place.resolve())
        ]
        table.add_row(
            escape(min((each for each in below if each != "."), key=len, default=path.name)),
            escape(row.site),
            f"[{_COLOURS.get(state, 'red')}]{state}",
            str(row.tries),
            f"{row.seconds:.1f}",
            f"{row.cpu_s:.1f}",
            f"{row.peak_memory_mb:.0f}",
            escape(row.words),
        )
    if rows:
        console.print(table)
    if len(rows) > _MOST_ROWS:
        console.print(f"and {len(rows) - _MOST_ROWS:,} more")
    console.print(
        f"tries: {report.tries}, of which {report.crashes} crashed; {report.seconds:.1f} s",
    )
    show_path("table", root / TABLE, console)
