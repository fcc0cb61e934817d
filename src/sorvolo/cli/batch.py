"""`sorvolo batch`: a mission over folders of flights, on this machine or on a cluster."""

import json
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import AbstractContextManager, closing
from dataclasses import asdict, dataclass, replace
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from sorvolo.cli.options import (
    AlertCommand,
    AlertUrl,
    AsJson,
    Camera,
    Classes,
    Cot,
    CotAuthority,
    CotCertificate,
    GiveUp,
    LeastScore,
    Model,
    Resolution,
    Save,
    SaveOption,
    SearchRate,
    wanted_classes,
)
from sorvolo.cli.printing import FAILED, TO_CHECK, show_path
from sorvolo.cli.progress import ProgressReport
from sorvolo.cli.sites import ended_by_signal
from sorvolo.cli.watch import warn_of_interpreted
from sorvolo.errors import SettingsError
from sorvolo.survey.wording import counted

if TYPE_CHECKING:
    from sorvolo.cluster.batch import BatchReport, BatchSettings, BatchUpdate
    from sorvolo.cluster.executor import Executor
    from sorvolo.cluster.sites import SiteBy
    from sorvolo.cluster.table import BatchTable, Row

_MOST_ROWS = 40  # of a table on a terminal; longer ones show what failed first; by choice
_STORE_HANGS_S = 300.0  # two requests of `ObjectSettings.request_s`
_COLOURS = {
    "done": "green",
    "known": "green",
    "doubtful": "yellow",
    "duplicate": "blue",
    "skipped": "blue",
}


class MissionName(StrEnum):
    """What is done with each flight: the names of `cluster.orders.Mission`."""

    MAP = "map"
    COMPARE = "compare"
    SEARCH = "search"
    WATCH = "watch"


class SiteByName(StrEnum):
    """What makes flights belong to one site: the names of `cluster.sites.SiteBy`."""

    FLIGHT = "flight"
    PLACE = "place"


Places = Annotated[
    list[str],
    typer.Argument(
        help="Folders with flights, however deep; or live sources, as ADDRESS or SITE=ADDRESS."
    ),
]
Root = Annotated[
    Path, typer.Option(help="Folder for the results: one folder for each site, or for each watch.")
]
MissionOption = Annotated[MissionName, typer.Option(help="What to do with each flight.")]
SiteByOption = Annotated[
    SiteByName | None,
    typer.Option(
        help="flight: each flight has a site of its own. place: flights near each other share one.",
        show_default="flight; place for compare",
    ),
]
ExecutorName = Annotated[
    str,
    typer.Option(
        help="local: this machine. ray://HOST:PORT: a Ray cluster. ray: this machine's Ray, or a new one."
    ),
]
Workers = Annotated[
    int | None, typer.Option(help="Flights at once, at most.", show_default="one for each core")
]
Receivers = Annotated[
    list[str] | None,
    typer.Option(
        "--telemetry",
        help="A live source's receiver, as SITE=ADDRESS: udp://:10110, serial:/dev/ttyUSB0.",
    ),
]
Tries = Annotated[
    int, typer.Option(help="Set a flight aside when it ended its process so many times.")
]
Stall = Annotated[
    float,
    typer.Option(help="End a process that neither answers nor computes for this many seconds."),
]
CopyTo = Annotated[
    str,
    typer.Option(
        help="Copy each flight's site to this place as well: a folder, or s3://BUCKET/PREFIX."
    ),
]
Retry = Annotated[bool, typer.Option("--retry", help="Also try flights again that were set aside.")]


def batch(
    context: typer.Context,
    places: Places,
    root: Root,
    mission: MissionOption = MissionName.MAP,
    site_by: SiteByOption = None,
    executor: ExecutorName = "local",
    workers: Workers = None,
    camera: Camera = "",
    gsd: Resolution = None,
    model: Model = "default",
    give_up: GiveUp = 30.0,
    telemetry: Receivers = None,
    tries: Tries = 3,
    stall: Stall = 300.0,
    retry: Retry = False,
    copy_to: CopyTo = "",
    classes: Classes = None,
    least_score: LeastScore = None,
    fps: SearchRate = None,
    save: SaveOption = Save.NONE,
    cot: Cot = "",
    cot_ca: CotAuthority = None,
    cot_cert: CotCertificate = None,
    alert_command: AlertCommand = "",
    alert_url: AlertUrl = "",
    as_json: AsJson = False,
) -> None:
    """Map, compare, search or watch many flights. After a stop or a kill, the same command continues.

    A flight whose process dies is tried again; one that cannot be used, or that crashes every time, is listed.
    Live sources run side by side until they end; Ctrl-C ends them and finishes their results. The options from
    --classes to --alert-url are for --mission watch. ROOT/batch.jsonl holds what became of each.
    Ends with exit code 1 where a flight failed or was set aside, with 3 where a result is to be checked before use.

    Example: sorvolo batch flights/ --root maps

    Example: sorvolo batch north=rtsp://192.168.1.10/live south=udp://:5000 --root found --mission watch

    Example: sorvolo batch /mnt/shared/valley --root /mnt/shared/maps --executor ray://head:10001
    """
    from sorvolo.cluster.batch import BatchSettings
    from sorvolo.cluster.orders import FlightWish, Mission, WatchWish

    context.obj.stop_words = f"stopped; run the same command to continue: {root} holds what is done"
    place, wanted = _place(copy_to, root), wanted_classes(classes)
    watch = WatchWish(
        wanted,
        least_score,
        fps,
        save.value,
        cot,
        _whole(cot_ca),
        _whole(cot_cert),
        alert_command,
        alert_url,
    )
    wish = FlightWish(
        Mission(mission.value), _absolute(camera), _absolute(model), gsd, give_up, watch, place
    )
    settings = BatchSettings(wish, _site_by(site_by, mission), tries, stall, retry)
    report = _run(places, telemetry or (), root, settings, _Running(executor, workers))
    if as_json:
        typer.echo(json.dumps(_plain(report, root), indent=1))
    else:
        _show(report, [Path(each) for each in places], root, Console())
    raise typer.Exit(_exit_code(report))


def _exit_code(report: "BatchReport") -> int:
    counts = report.counts()
    if counts.get("failed") or counts.get("set aside"):
        return FAILED
    return TO_CHECK if counts.get("doubtful") else 0


def _site_by(wished: SiteByName | None, mission: MissionName) -> "SiteBy":
    """What makes flights belong to one site: by place where flights are compared, unless something else is asked."""
    from sorvolo.cluster.sites import SiteBy

    by = wished or (SiteByName.PLACE if mission is MissionName.COMPARE else SiteByName.FLIGHT)
    return SiteBy(by.value)


@dataclass(frozen=True)
class _Running:
    """Where flights run and how many at once, as the options have it."""

    executor: str
    workers: int | None


def _run(
    places: Sequence[str],
    receivers: Sequence[str],
    root: Path,
    settings: "BatchSettings",
    wish: _Running,
) -> "BatchReport":
    """The batch of folders, or of live sources, with its progress."""
    from sorvolo.cluster.batch import run_batch
    from sorvolo.cluster.streams import is_stream, run_streams, streams_of

    warn_of_interpreted(settings.wish.watch.alert_command)
    if settings.wish.copy_to:  # a store that hangs is given up by the copy, not by the batch
        settings = replace(settings, stall_s=settings.stall_s + _STORE_HANGS_S)
    live = [each for each in places if is_stream(each)]
    _check_live(live, places, wish.workers)
    if live:  # one that waits for its drone does nothing, and gives up by itself
        settings = replace(settings, stall_s=settings.stall_s + settings.wish.give_up_s)
        wish = replace(wish, workers=wish.workers or len(live))
    executors = _executor_of(wish, settings)
    if receivers and not live:
        raise SettingsError(
            "--telemetry is for live sources; a recorded flight's log is found beside it"
        )
    streams = streams_of(live, receivers)
    with ended_by_signal([each.address for each in streams]) as until:
        running = (
            run_streams(streams, root, settings, executors, until)
            if streams
            else run_batch([Path(each) for each in places], root, settings, executors)
        )
        # closed even when the bar is stopped: then the workers are ended
        with closing(running):
            return _show_progress(running, Console(stderr=True))


def _check_live(live: Sequence[str], places: Sequence[str], workers: int | None) -> None:
    """Raise SettingsError for live sources beside folders, and for fewer workers than live sources."""
    if live and len(live) < len(places):
        raise SettingsError(
            "give folders of flights or live sources, not both: they are two batches with two roots"
        )
    if live and workers is not None and workers < len(live):
        raise SettingsError(f"--workers {workers}: {len(live)} live sources need a worker each")


def _absolute(name: str) -> str:
    """The whole path of a file that is there; any other name as it is."""
    return str(Path(name).resolve()) if name and Path(name).is_file() else name


def _place(text: str, root: Path) -> str:
    """The place that sites are copied to, a folder by its whole path. Raises SettingsError for a root in a store."""
    if str(root).startswith("s3:"):
        raise SettingsError(
            f"--root {root}: a batch works in a folder; give one, and --copy-to s3://BUCKET/PREFIX"
        )
    if not text or "://" in text:
        return text.rstrip("/")
    if Path(text).resolve() == root.resolve():
        raise SettingsError(f"--copy-to {text} is --root itself; give another folder")
    return str(Path(text).resolve())


def _whole(path: Path | None) -> str:
    """The whole path of a file, "" for none."""
    return "" if path is None else str(path.resolve())


def _executor_of(
    wish: _Running, settings: "BatchSettings"
) -> "Callable[[BatchTable], AbstractContextManager[Executor]]":
    from sorvolo.cluster.local_executor import LocalExecutor, default_workers

    name, workers = wish.executor, wish.workers
    if workers is not None and workers < 1:
        raise SettingsError(f"--workers {workers}: at least 1 is needed")
    if name == "local":
        count = workers or default_workers()
        return lambda table: LocalExecutor(count, settings.stall_s, table.lock, settings.costs)
    if name == "ray" or name.startswith("ray://"):
        from sorvolo.cluster.ray_executor import ray_executor

        return lambda table: ray_executor(name, workers, settings.stall_s, table.root)
    raise SettingsError(f"--executor {name}: give local, ray, or ray://HOST:PORT")


def _show_progress(
    running: "Generator[BatchUpdate, None, BatchReport]", console: Console
) -> "BatchReport":
    report: list[BatchReport] = []

    def noted() -> "Iterator[BatchUpdate]":
        report.append((yield from running))

    with ProgressReport(console) as progress:
        for update in noted():
            if update.row is not None and update.found:
                console.print(
                    f"    [bold]found[/bold]  {escape(update.row.site)}: {escape(update.found)}",
                    highlight=False,
                    soft_wrap=True,
                )
            elif update.row is not None:
                _show_row(update.row, update.is_known, console)
            words = f"at {', '.join(update.running[:4])}" if update.running else ""
            progress.show(update.task, update.done, update.total, words)
    return report[0]


def _show_row(row: "Row", is_known: bool, console: Console) -> None:
    state = _state(row, is_known)
    words = (
        f"try {row.tries} failed: {row.words}"
        if row.state == "waiting" and row.tries
        else row.words
    )
    colour = _COLOURS.get(state, "red")
    console.print(
        f"[{colour}]{state:>9}[/{colour}]  {escape(row.source)}: {escape(words)}",
        highlight=False,
        soft_wrap=True,
    )


def _state(row: "Row", is_known: bool) -> str:
    if row.state == "waiting":
        return "again" if row.tries else "waiting"
    return "known" if is_known and row.state == "done" else row.state.value


def _plain(report: "BatchReport", root: Path) -> dict[str, Any]:
    rows = [{**asdict(row), "is_known": row.key in report.known} for row in report.rows]
    return {
        "root": str(root),
        "counts": report.counts(),
        "seconds": report.seconds,
        "cpu_s": round(sum(row.cpu_s for row in report.rows if row.key not in report.known), 3),
        "tries": report.tries,
        "crashes": report.crashes,
        "flights": rows,
    }


def _label(source: str, places: Sequence[Path]) -> str:
    """A flight's path below the folder that was given."""
    path = Path(source)
    below = [
        path.relative_to(place.resolve()).as_posix()
        for place in places
        if path.is_relative_to(place.resolve())
    ]
    return min((each for each in below if each != "."), key=len, default=path.name)


def _show(report: "BatchReport", places: Sequence[Path], root: Path, console: Console) -> None:
    from sorvolo.cluster.table import TABLE

    ended = ", ".join(f"{count:,} {name}" for name, count in report.counts().items())
    console.print(f"{counted(len(report.rows), 'flight')}: {ended}", style="bold", highlight=False)
    rows = report.rows
    if len(rows) > _MOST_ROWS:
        rows = tuple(row for row in rows if row.state != "done")
    table = Table(box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
    for name in ("flight", "folder", "state", "tries", "s", "CPU s", "MB", ""):
        table.add_column(
            name,
            justify="right" if name in ("tries", "s", "CPU s", "MB") else "left",
            overflow="fold",
        )
    for row in rows[:_MOST_ROWS]:
        state = _state(row, row.key in report.known)
        table.add_row(
            escape(_label(row.source, places)),
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
        console.print(f"and {len(rows) - _MOST_ROWS:,} more", highlight=False)
    console.print(
        f"tries: {report.tries}, of which {report.crashes} crashed; {report.seconds:.1f} s",
        highlight=False,
    )
    show_path("table", root / TABLE, console)
