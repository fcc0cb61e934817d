"""`sorvolo watch`: objects told as they are found, and in the end how many of what, where, and how sure."""

import json
import signal
import threading
from collections.abc import Iterator, Mapping
from contextlib import closing, contextmanager, suppress
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, SpinnerColumn, TextColumn, TimeRemainingColumn
from rich.table import Table

from sorvolo.cli.map import read_json, tell_path
from sorvolo.cli.progress import bars
from sorvolo.errors import SettingsError

if TYPE_CHECKING:
    from sorvolo.missions.watch.run import WatchUpdate
    from sorvolo.survey.flight import Site
    from sorvolo.survey.objects import Track

_MOST_ROWS = 40


class Save(StrEnum):
    """What is kept of the frames, with what was found drawn in."""

    NONE = "none"
    VIDEO = "video"
    PICTURES = "pictures"


def watch_command(
    source: Annotated[str, typer.Argument(help="A video, a folder of photos, or a live stream's address.")],
    telemetry: Annotated[
        str, typer.Option(help="The flight's log, if not beside the video; of a live source, a receiver's address.")
    ] = "",
    camera: Annotated[str, typer.Option(help="Calibration file, preset name or EXIF code, or aov=DEG.")] = "",
    model: Annotated[str, typer.Option(help="An installed model's name (sorvolo models), or a file.")] = "default",
    classes: Annotated[str, typer.Option(help="What to look for, such as person,car; else all it knows.")] = "",
    out: Annotated[Path | None, typer.Option(help="Folder for what is found; else SOURCE-watch.")] = None,
    save: Annotated[Save, typer.Option(help="Keep frames with what was found drawn in.")] = Save.NONE,
    labels: Annotated[str, typer.Option(help="Write labels to correct and train with: coco,yolo.")] = "",
    cot: Annotated[str, typer.Option(help="Tell a TAK server or team: udp://host:port, tcp://host:port.")] = "",
    cot_type: Annotated[
        list[str] | None, typer.Option(help="Cursor on Target's type of a class, such as person=a-f-G.")
    ] = None,
    alert_command: Annotated[
        str, typer.Option(help="Run for each new object; {id} {class} {score} {latitude} {longitude} {time} {crop}.")
    ] = "",
    alert_url: Annotated[str, typer.Option(help="Post each new object there as JSON.")] = "",
    every: Annotated[int | None, typer.Option(help="Search every N-th frame only.")] = None,
    fps: Annotated[
        float | None, typer.Option(help="Frames searched a second of flight; else 10, live as many as it can.")
    ] = None,
    tiles: Annotated[
        str, typer.Option(help="Cut large pictures: auto by the ground's size in pixels, px a side, or none.")
    ] = "auto",
    least_score: Annotated[float | None, typer.Option(help="0 to 1; else each class's own.")] = None,
    offset: Annotated[float | None, typer.Option(help="Telemetry time minus video time, s.")] = None,
    ground_elevation: Annotated[
        float | None, typer.Option(help="Of the ground, m, in telemetry's own height reference.")
    ] = None,
    height_model: Annotated[
        str, typer.Option(help="GeoTIFF of the ground's heights, m, in the same reference; else it is level.")
    ] = "",
    give_up: Annotated[float, typer.Option(help="A live source silent for so long has ended, s.")] = 30.0,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object at the end.")] = False,
) -> None:
    """Find people, cars and small objects in a flight, live or recorded, and say where on the ground they are.

    Ends with the source or with Ctrl-C; either way, all that was found is written, and the exit code is 0 whether or
    not anything was. Lines of detections.jsonl come as they are made.

    Example: sorvolo watch DJI_0042.MP4 --classes person

    Example: sorvolo watch rtsp://192.168.1.10/live --telemetry udp://:10110 --cot udp://239.2.3.1:6969
    """
    from sorvolo.capture.live.reconnect import LiveSettings
    from sorvolo.missions.watch.alerts import interpreted_placeholder, interpreted_words
    from sorvolo.missions.watch.flights import watch
    from sorvolo.missions.watch.settings import WatchOutputs, WatchSettings
    from sorvolo.store.exports.cursor_on_target import COT_TYPES

    settings = WatchSettings(
        model, _names(classes), least_score, _tiles(tiles), every, fps, offset, ground_elevation, height_model
    )
    outputs = WatchOutputs(
        out, save.value, _names(labels), cot, {**COT_TYPES, **_types(cot_type or [])}, alert_command=alert_command,
        alert_url=alert_url,
    )
    if name := interpreted_placeholder(alert_command):
        Console(stderr=True).print(f"[yellow]warning[/yellow]  {escape(interpreted_words(name))}", soft_wrap=True)
    folders: dict[Path, None] = {}
    stop = _Stop()
    watching = watch(
        source, settings, outputs, telemetry=telemetry or None, camera=camera or None,
        live=LiveSettings(give_up_s=give_up), until=stop.until,
    )
    # closed after a stop: then what was found is written
    with stop.on_signals(), closing(watching) as updates, suppress(KeyboardInterrupt):
        for folder in _show_progress(updates, Console(stderr=True), is_quiet=as_json):
            stop.is_running = True
            folders[folder] = None
    results = [_result(folder) for folder in folders]
    if as_json:
        typer.echo(json.dumps({"watches": results}, indent=1))
    else:
        for result in results:
            _show_result(result, Console())
    if not results:
        Console(stderr=True).print("stopped before the first frame was searched")


class _Stop:
    """Ctrl-C and SIGTERM as an event that the watch looks at after each frame.

    An exception would strike anywhere, also inside a queue's own lock, and the end would wait for it for ever. Before
    the first frame there is nothing to keep, and after the first signal nothing to wait for: then it is an exception.
    """

    def __init__(self) -> None:
        self.until = threading.Event()
        self.is_running = False

    @contextmanager
    def on_signals(self) -> Iterator[None]:
        """Take the signals for the length of a block."""
        before = {number: signal.signal(number, self._stop) for number in (signal.SIGINT, signal.SIGTERM)}
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)

    def _stop(self, *_: Any) -> None:
        if self.until.is_set() or not self.is_running:
            raise KeyboardInterrupt
        self.until.set()


def _show_progress(updates: Iterator["WatchUpdate"], console: Console, *, is_quiet: bool) -> Iterator[Path]:
    """Take all updates, telling each new object; the folder of each."""
    from sorvolo.survey.wording import counted_list

    columns = (
        SpinnerColumn(), TextColumn("{task.description}"), BarColumn(bar_width=24),
        TextColumn("{task.fields[told]}"), TimeRemainingColumn(),
    )
    with bars(*columns, console=console) as progress:
        task = progress.add_task("opening", total=None, told="")
        for update in updates:
            for track in update.new if not is_quiet else ():
                console.print(_words_of(track, update.site), highlight=False)
            rate = f"{update.frames_detected / update.seconds:.1f} frames/s, " if update.seconds > 0 else ""
            progress.update(
                task, description="watching",
                told=f"{rate}{1000 * update.latency_s:.0f} ms behind, {counted_list(update.counts)}",
                total=max(update.frames_expected, update.frames_read) if update.frames_expected else None,
                completed=update.frames_read,
            )
            yield update.folder


def _words_of(track: "Track", site: "Site") -> str:
    from sorvolo.store.exports.places import longitude_latitude

    name = f"[bold]{escape(track.label)} {track.id}[/bold]"
    if site.is_local:
        return f"{name}  score {track.score:.2f}, {track.views} views"
    longitude, latitude = longitude_latitude(track.position_m[None], site)
    return (
        f"{name}  at {latitude[0]:.6f}, {longitude[0]:.6f} within {track.sigma_m:.1f} m, score {track.score:.2f}, "
        f"{track.views} views"
    )


def _result(folder: Path) -> dict[str, Any]:
    tracks = read_json(folder / "tracks.geojson")
    return {"folder": str(folder), **read_json(folder / "report.json"), "tracks": tracks}


def _show_result(result: Mapping[str, Any], console: Console) -> None:
    from sorvolo.survey.wording import counted_list

    tracks = [each["properties"] for each in result["tracks"]["features"]]
    console.print(
        f"Watch of {escape(result['flight'])}: {escape(counted_list(result['objects']['by_class']))}", style="bold"
    )
    table = Table(box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
    on_ground = result["georeferenced"]
    has_cuts = len({each.get("segment") for each in tracks}) > 1
    unit = "m" if on_ground else "px"
    place_name = "latitude, longitude" if on_ground else "segment: x, y px" if has_cuts else "x, y px"
    for name in ("id", "class", "score", place_name, f"within {unit}", "views", "moves"):
        table.add_column(name, no_wrap=True)
    for each in tracks[:_MOST_ROWS]:
        place = (
            f"{each['latitude']:.6f}, {each['longitude']:.6f}" if on_ground
            else f"{each['segment']}: {each['x_px']:.0f}, {each['y_px']:.0f}" if has_cuts
            else f"{each['x_px']:.0f}, {each['y_px']:.0f}"
        )
        table.add_row(
            str(each["id"]), escape(each["class"]), f"{each['score']:.2f}", place, f"{each['sigma_m']:.1f}",
            str(each["views"]), "yes" if each["moving"] else "",
        )
    if table.row_count:
        console.print(table)
    if len(tracks) > _MOST_ROWS:
        console.print(f"and {len(tracks) - _MOST_ROWS} more in tracks.geojson")
    frames, latency = result["frames"], result["latency_s"]
    rate = result["frames_per_second"] or 0.0
    console.print(
        f"{frames['detected']} of {frames['read']} frames searched at {rate:.1f} frames/s, "
        f"{frames['skipped']} skipped to keep up; {1000 * (latency['median'] or 0):.0f} ms from frame to result "
        f"(at most {1000 * (latency['max'] or 0):.0f})", highlight=False,
    )
    for notice in result["notices"]:
        console.print(f"[blue]note[/blue]     {escape(notice['text'])}")
    for warning in result["warnings"]:
        console.print(f"[yellow]warning[/yellow]  {escape(warning)}")
    folder = Path(result["folder"])
    tell_path("report", folder / "report.html", console)
    tell_path("GeoJSON", folder / "tracks.geojson", console)


def _names(text: str) -> tuple[str, ...]:
    return tuple(name.strip() for name in text.split(",") if name.strip())


def _tiles(text: str) -> Any:
    if text == "auto":
        return "auto"
    if text == "none":
        return None
    try:
        return int(text)
    except ValueError:
        raise SettingsError(f"--tiles {text}: give auto, none, or a number of pixels") from None


def _types(pairs: list[str]) -> dict[str, str]:
    types = {}
    for pair in pairs:
        name, equals, kind = pair.partition("=")
        if not (name and equals and kind):
            raise SettingsError(f"--cot-type {pair}: give a class and its type, such as person=a-f-G")
        types[name] = kind
    return types
