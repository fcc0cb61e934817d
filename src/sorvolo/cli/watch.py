"""`sorvolo watch`: each object printed when it is found; in the end how many of what, where, and how sure."""

import json
import signal
import threading
from collections.abc import Generator, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from sorvolo.cli.options import (
    AsJson,
    Camera,
    CotAuthority,
    CotCertificate,
    GiveUp,
    GroundElevation,
    PlaceFormat,
    PlaceFormatOption,
    names,
    wanted_classes,
)
from sorvolo.cli.places import place_heading
from sorvolo.cli.progress import ProgressReport, Resumed, rate_words
from sorvolo.cli.shown import read_json, show_notices_and_warnings, show_path
from sorvolo.errors import SettingsError
from sorvolo.survey.wording import counted, counted_list

if TYPE_CHECKING:
    from sorvolo.missions.watch.run import WatchUpdate
    from sorvolo.survey.flight import Site
    from sorvolo.survey.objects import Track

_MOST_ROWS = 40  # of a table on a terminal; by choice
_COLUMNS_EXPLAINED = (
    "score: 0 to 1, about the share that is right; accuracy: 1 sigma; views: frames that show it"
)


class Save(StrEnum):
    """How frames are kept, with the objects drawn in."""

    NONE = "none"
    VIDEO = "video"
    PICTURES = "pictures"


WatchSource = Annotated[
    str, typer.Argument(help="A video, a folder of photos, or a live stream's address.")
]
WatchTelemetry = Annotated[
    str,
    typer.Option(
        help="The flight's log if not beside the video; for a live source, a receiver's address."
    ),
]
Model = Annotated[
    str, typer.Option(help="Detector: a model's name (sorvolo models list), or a file.")
]
SearchedClasses = Annotated[
    str | None,
    typer.Option(
        help="Classes to search for, such as person,car.", show_default="all but those on request"
    ),
]
ResultsFolder = Annotated[
    Path | None, typer.Option(help="Folder for the results.", show_default="SOURCE-watch")
]
SaveOption = Annotated[Save, typer.Option(help="Keep the frames with the objects drawn in.")]
Labels = Annotated[
    str, typer.Option(help="Write labels to correct and train with: coco, yolo or coco,yolo.")
]
Cot = Annotated[
    str,
    typer.Option(
        help="Send objects to a TAK server or team: udp://host:port, tcp://host:port, tls://host:port."
    ),
]
CotType = Annotated[
    list[str] | None,
    typer.Option(help="Cursor on Target type of a class, such as person=a-f-G. Can be repeated."),
]
AlertCommand = Annotated[
    str,
    typer.Option(
        help="Program to run for each object; {flight} {id} {class} {score} {latitude} {longitude} {time} {crop}."
    ),
]
AlertUrl = Annotated[str, typer.Option(help="Post each new object to this web address as JSON.")]
EveryNth = Annotated[int | None, typer.Option(help="Search every N-th frame only.")]
SearchRate = Annotated[
    float | None,
    typer.Option(
        help="Frames searched per second of flight.", show_default="10; live: as many as possible"
    ),
]
Tiles = Annotated[
    str,
    typer.Option(
        help="Cut large pictures into tiles: auto (by ground resolution), pixels a side, or none."
    ),
]
LeastScore = Annotated[
    float | None,
    typer.Option(help="Lowest score to report, 0 to 1.", show_default="each class's own"),
]
WatchOffset = Annotated[
    float | None,
    typer.Option(
        help="Telemetry time minus video time, s.", show_default="as their clocks have it"
    ),
]
HeightModel = Annotated[
    str,
    typer.Option(
        help="GeoTIFF of ground heights in the telemetry's reference.", show_default="level ground"
    ),
]


def watch_command(
    source: WatchSource,
    telemetry: WatchTelemetry = "",
    camera: Camera = "",
    model: Model = "default",
    classes: SearchedClasses = None,
    out: ResultsFolder = None,
    save: SaveOption = Save.NONE,
    labels: Labels = "",
    cot: Cot = "",
    cot_type: CotType = None,
    cot_ca: CotAuthority = None,
    cot_cert: CotCertificate = None,
    alert_command: AlertCommand = "",
    alert_url: AlertUrl = "",
    every: EveryNth = None,
    fps: SearchRate = None,
    tiles: Tiles = "auto",
    least_score: LeastScore = None,
    offset: WatchOffset = None,
    ground_elevation: GroundElevation = None,
    height_model: HeightModel = "",
    give_up: GiveUp = 30.0,
    coordinates: PlaceFormatOption = PlaceFormat.LATLON,
    as_json: AsJson = False,
) -> None:
    """Find people, cars and small objects in a flight, live or recorded, and where on the ground they are.

    Ends with the source or with Ctrl-C. Either way all results are written, and the exit code is 0, whether anything
    was found or not. detections.jsonl grows while the watch runs. After a crash or a power cut, give the same command
    again: it continues where it was, and sends no alert twice.

    Example: sorvolo watch DJI_0042.MP4 --classes person

    Example: sorvolo watch rtsp://192.168.1.10/live --telemetry udp://:10110 --cot udp://239.2.3.1:6969
    """
    from sorvolo.capture.live.reconnect import LiveSettings
    from sorvolo.missions.watch.cot_sender import CotTls
    from sorvolo.missions.watch.flights import watch
    from sorvolo.missions.watch.settings import WatchOutputs, WatchSettings
    from sorvolo.store.exports.cursor_on_target import COT_TYPES

    settings = WatchSettings(
        model,
        wanted_classes(classes),
        least_score,
        _tiles(tiles),
        every,
        fps,
        offset,
        ground_elevation,
        height_model,
    )
    outputs = WatchOutputs(
        out,
        save.value,
        names(labels),
        cot,
        {**COT_TYPES, **_types(cot_type or [])},
        alert_command=alert_command,
        alert_url=alert_url,
        cot_tls=CotTls(cot_ca, cot_cert),
    )
    warn_of_interpreted(alert_command)
    stop = _Stop()
    watching = watch(
        source,
        settings,
        outputs,
        telemetry=telemetry or None,
        camera=camera or None,
        live=LiveSettings(give_up_s=give_up),
        until=stop.until,
    )
    folders = _folders_watched(watching, stop, coordinates, is_quiet=as_json)
    _show_results([_result(folder) for folder in folders], coordinates, as_json=as_json)


def _show_results(
    results: Sequence[Mapping[str, Any]], coordinates: PlaceFormat, *, as_json: bool
) -> None:
    if as_json:
        typer.echo(json.dumps({"watches": results}, indent=1))
    else:
        for result in results:
            _show_result(result, Console(), coordinates)
    if not results:
        Console(stderr=True).print("stopped before the first frame was searched")


def warn_of_interpreted(alert_command: str) -> None:
    """Print a warning where an alert's program would run a placeholder's text as code of its own."""
    from sorvolo.missions.watch.alerts import interpreted_placeholder, interpreted_words

    if name := interpreted_placeholder(alert_command):
        Console(stderr=True).print(
            f"[yellow]warning[/yellow]  {escape(interpreted_words(name))}", soft_wrap=True
        )


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
        before = {
            number: signal.signal(number, self._stop) for number in (signal.SIGINT, signal.SIGTERM)
        }
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)

    def _stop(self, *_: Any) -> None:
        if self.until.is_set() or not self.is_running:
            raise KeyboardInterrupt
        self.until.set()


def _folders_watched(
    watching: "Generator[WatchUpdate]", stop: _Stop, form: PlaceFormat, *, is_quiet: bool
) -> list[Path]:
    """Watch until the source ends or a person stops it; the folders of the results, each once, in order."""
    folders: dict[Path, None] = {}
    # closed after a stop: then what was found is written
    with stop.on_signals(), closing(watching) as updates, suppress(KeyboardInterrupt):
        for folder in _show_progress(updates, Console(stderr=True), form, is_quiet=is_quiet):
            stop.is_running = True
            folders[folder] = None
    return list(folders)


def _show_progress(
    updates: "Iterator[WatchUpdate]", console: Console, form: PlaceFormat, *, is_quiet: bool
) -> Iterator[Path]:
    """Take all updates, printing each new object; the folder of each."""
    resumed = Resumed(console)
    with ProgressReport(console) as progress:
        progress.show("opening")
        for update in updates:
            resumed.take(update.frames_detected, is_resumed=update.is_resumed)
            for track in () if is_quiet or update.is_resumed else update.new:
                console.print(_words_of(track, update.site, form), highlight=False, soft_wrap=True)
            delay = f"{1000 * update.latency_s:.0f} ms delay"
            progress.show(
                "watching, frame",
                update.frames_read,
                max(update.frames_expected, update.frames_read) if update.frames_expected else None,
                f"{rate_words(update.frames_detected, update.seconds)}{delay}, {counted_list(update.counts)}",
            )
            yield update.folder
        resumed.end()


def _words_of(track: "Track", site: "Site", form: PlaceFormat) -> str:
    from sorvolo.geometry.coordinates import Coordinates
    from sorvolo.missions.watch.report import found_words

    name, rest = found_words(track, site, Coordinates(form.value))
    return f"[bold]{escape(name)}[/bold]  {rest}"


def _result(folder: Path) -> dict[str, Any]:
    from sorvolo.store.exports.plain import features_path

    tracks = read_json(features_path(folder, "tracks"))
    return {"folder": str(folder), **read_json(folder / "report.json"), "tracks": tracks}


def _show_result(result: Mapping[str, Any], console: Console, form: PlaceFormat) -> None:
    tracks = [each["properties"] for each in result["tracks"]["features"]]
    console.print(
        f"Watch of {escape(result['flight'])}: {escape(counted_list(result['objects']['by_class']))} found",
        style="bold",
        highlight=False,
    )
    if tracks:
        _show_tracks(tracks, console, form, on_ground=result["georeferenced"])
    frames, latency = result["frames"], result["latency_s"]
    skipped = (
        f", {frames['skipped']:,} skipped to keep up with the source" if frames["skipped"] else ""
    )
    console.print(
        f"{frames['detected']:,} of {counted(frames['read'], 'frame')} searched at "
        f"{result['frames_per_second'] or 0.0:.1f} frames/s{skipped}; delay {1000 * (latency['median'] or 0):.0f} ms "
        f"(median), {1000 * (latency['max'] or 0):.0f} ms at most",
        highlight=False,
    )
    show_notices_and_warnings(result, console)
    folder = Path(result["folder"])
    show_path("report", folder / "report.html", console)
    if result["georeferenced"]:
        show_path("GeoJSON", folder / "tracks.geojson", console)
    else:
        show_path("list", folder / "tracks.json", console)
        console.print(f"  {result['tracks']['note']}", style="dim", highlight=False)


def _show_tracks(
    tracks: Sequence[Any], console: Console, form: PlaceFormat, *, on_ground: bool
) -> None:
    has_cuts = len({each.get("segment") for each in tracks}) > 1
    table = Table(box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
    in_picture = "segment: x, y px" if has_cuts else "x, y px"
    place_name = place_heading(False, form) if on_ground else in_picture
    for name in (
        "id",
        "class",
        "score",
        place_name,
        f"accuracy {'m' if on_ground else 'px'}",
        "views",
        "moves",
    ):
        table.add_column(name, no_wrap=name in ("id", place_name), overflow="fold")
    for each in tracks[:_MOST_ROWS]:
        table.add_row(
            str(each["id"]),
            escape(each["class"]),
            f"{each['score']:.2f}",
            _place(each, form, on_ground, has_cuts),
            f"{each['sigma_m']:.1f}",
            str(each["views"]),
            "yes" if each["moving"] else "",
        )
    console.print(table)
    if len(tracks) > _MOST_ROWS:
        name = "tracks.geojson" if on_ground else "tracks.json"
        console.print(f"and {len(tracks) - _MOST_ROWS:,} more in {name}")
    console.print(_COLUMNS_EXPLAINED, style="dim", highlight=False)


def _place(each: Mapping[str, Any], form: PlaceFormat, on_ground: bool, has_cuts: bool) -> str:
    from sorvolo.geometry.coordinates import Coordinates, place_text

    if on_ground:
        return place_text(each["latitude"], each["longitude"], Coordinates(form.value))
    segment = f"{each['segment']}: " if has_cuts else ""
    return f"{segment}{each['x_px']:.0f}, {each['y_px']:.0f}"


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
            raise SettingsError(
                f"--cot-type {pair}: give a class and its type, such as person=a-f-G"
            )
        types[name] = kind
    return types
