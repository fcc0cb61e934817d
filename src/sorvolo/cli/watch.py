"""`sorvolo watch`: each object printed when it is found; in the end how many of what, where, and how sure."""

from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.markup import escape

from sorvolo.cli.options import (
    AlertCommand,
    AlertUrl,
    AsJson,
    Authority,
    Camera,
    Classes,
    Cot,
    CotCertificate,
    EnoughLookedAt,
    GiveUp,
    GroundElevation,
    LeastScore,
    Model,
    Offset,
    PlaceFormat,
    PlaceFormatOption,
    ResultsFolder,
    SaveOption,
    SearchRate,
    Telemetry,
    argument,
    names,
    option,
    wanted_classes,
)
from sorvolo.cli.printing import (
    TO_CHECK,
    Console,
    announce_person,
    new_table,
    place_heading,
    print_json,
    read_json,
    show_notices_and_warnings,
    show_path,
)
from sorvolo.cli.progress import ProgressReport, Resumed, rate_words
from sorvolo.cli.sites import SignalStop
from sorvolo.survey.wording import counted, counted_list

if TYPE_CHECKING:
    from sorvolo.missions.watch.run import WatchUpdate

_MAX_ROWS = 40  # of a table on a terminal; by choice

Labels = Annotated[str, option("Write labels to correct and train with: coco, yolo or coco,yolo.")]
HeightModel = Annotated[
    str,
    option("GeoTIFF of ground heights in the telemetry's reference.", show_default="level ground"),
]

ThroughTrees = Annotated[
    bool,
    option(
        "Also put the frames together on the forest floor, to find people below crowns.",
        "--through-trees",
    ),
]


def watch_command(
    source: Annotated[str, argument("A video, a folder of photos, or a live stream's address.")],
    telemetry: Telemetry = None,
    camera: Camera = "",
    model: Model = "default",
    classes: Classes = None,
    out: ResultsFolder = None,
    save: SaveOption = "none",
    labels: Labels = "",
    cot: Cot = "",
    cot_ca: Authority = None,
    cot_cert: CotCertificate = None,
    alert_command: AlertCommand = "",
    alert_url: AlertUrl = "",
    fps: SearchRate = None,
    least_score: LeastScore = None,
    offset: Offset = None,
    ground_elevation: GroundElevation = None,
    height_model: HeightModel = "",
    give_up: GiveUp = 30.0,
    through_trees: ThroughTrees = False,
    enough_looked_at: EnoughLookedAt = 0.9,
    coordinates: PlaceFormatOption = "latlon",
    as_json: AsJson = False,
) -> None:
    """Find people and cars in a flight, live or recorded, and where on the ground they are; small objects by --classes.

    Ends with the source or with Ctrl-C, and writes all results either way. While a drone flies, frames of new ground are
    searched first; the others are kept and searched once it has landed, or after Ctrl-C (again: stop at once).
    The first line counts the ground that was looked at; exit code 3: less than was asked for, its pictures contradict
    the telemetry, or cameras over trees may be off. After a crash or a power cut, give the same command again.

    Example: sorvolo watch DJI_0042.MP4 --classes person

    Example: sorvolo watch rtsp://192.168.1.10/live --telemetry udp://:10110 --cot udp://239.2.3.1:6969
    """
    from sorvolo.capture.live.addresses import is_live_address
    from sorvolo.capture.live.reconnect import LiveSettings
    from sorvolo.missions.watch.cot_sender import CotTls
    from sorvolo.missions.watch.flights import watch
    from sorvolo.missions.watch.settings import WatchOutputs, WatchSettings

    settings = WatchSettings(
        model,
        wanted_classes(classes),
        least_score,
        frames_per_second=fps,
        offset_s=offset,
        ground_elevation_m=ground_elevation,
        height_model=height_model,
        through_trees=through_trees,
        enough_looked_at=enough_looked_at,
    )
    outputs = WatchOutputs(
        out,
        save,
        names(labels),
        cot,
        alert_command=alert_command,
        alert_url=alert_url,
        cot_tls=CotTls(cot_ca, cot_cert),
    )
    warn_of_interpreted(alert_command)
    # before the first frame there is nothing to keep
    words = "landed: the frames that wait are searched; press Ctrl-C again to stop at once"
    stop = SignalStop(is_running=False, words=words if is_live_address(source) else "")
    watching = watch(
        source,
        settings,
        outputs,
        telemetry=telemetry or None,
        camera=camera or None,
        live=LiveSettings(give_up_s=give_up),
        until=stop.until,
    )
    folders: dict[Path, None] = {}
    # closed after a stop: then what was found is written
    with stop.on_signals(), watching as updates, suppress(KeyboardInterrupt):
        for folder in _show_progress(updates, Console(stderr=True), coordinates, is_quiet=as_json):
            stop.is_running = True
            folders[folder] = None
    results = [_result(folder) for folder in folders]
    if as_json:
        print_json({"watches": results})
    else:
        for result in results:
            console = Console()
            tracks = [feature["properties"] for feature in result["tracks"]["features"]]
            console.print(
                f"Watch of {escape(result['flight'])}: {escape(result['headline']['text'])}",
                style="bold",
            )
            if tracks:
                _show_tracks(tracks, console, coordinates, on_ground=result["georeferenced"])
            frames, latency = result["frames"], result["latency_s"]
            skipped = (
                f", {frames['skipped']:,} left that were to be searched"
                if frames["skipped"]
                else ""
            )
            console.print(
                f"{frames['detected']:,} of {counted(frames['read'], 'frame')} searched at "
                f"{result['frames_per_second'] or 0.0:.1f} frames/s{skipped}; delay {1000 * (latency['median'] or 0):.0f} ms "
                f"(median), {1000 * (latency['max'] or 0):.0f} ms at most",
            )
            show_notices_and_warnings(result, console)
            folder = Path(result["folder"])
            show_path("report", folder / "report.html", console)
            if result["georeferenced"]:
                show_path("GeoJSON", folder / "tracks.geojson", console)
                show_path("searched", folder / "searched.geojson", console)
            else:
                show_path("list", folder / "tracks.json", console)
                console.print(f"  {result['tracks']['note']}", style="dim")
    if not results:
        Console(stderr=True).print("stopped before the first frame was searched")
    if not results or not all(each["headline"]["complete"] for each in results):
        raise typer.Exit(TO_CHECK)


def warn_of_interpreted(alert_command: str) -> None:
    """Print a warning where an alert's program would run a placeholder's text as code of its own."""
    from sorvolo.missions.watch.alerts import interpreted_placeholder, interpreted_words

    if name := interpreted_placeholder(alert_command):
        Console(stderr=True).print(
            f"[yellow]warning[/yellow]  {escape(interpreted_words(name))}", soft_wrap=True
        )


def _show_progress(
    updates: "Iterator[WatchUpdate]", console: Console, form: PlaceFormat, *, is_quiet: bool
) -> Iterator[Path]:
    """Take all updates, printing each new object; yield the folder of each."""
    from sorvolo.geometry.coordinates import Coordinates
    from sorvolo.missions.watch.run import found_words
    from sorvolo.survey.objects import PERSON

    resumed = Resumed(console)
    with ProgressReport(console) as progress:
        progress.show("opening")
        for update in updates:
            resumed.take(update.frames_detected, is_resumed=update.is_resumed)
            for track in () if is_quiet or update.is_resumed else update.new:
                name, rest = found_words(track, update.site, Coordinates(form))
                if track.label == PERSON:
                    announce_person(f"{name}  {rest}", console)
                else:
                    console.print(f"[bold]{escape(name)}[/bold]  {rest}", soft_wrap=True)
            delay = f"{1000 * update.latency_s:.0f} ms delay"
            progress.show(
                "landed, searching the rest, frame" if update.has_landed else "watching, frame",
                update.frames_read,
                max(update.frames_expected, update.frames_read) if update.frames_expected else None,
                f"{rate_words(update.frames_detected, update.seconds)}{delay}, {counted_list(update.counts)}",
            )
            yield update.folder
        resumed.end()


def _result(folder: Path) -> dict[str, Any]:
    from sorvolo.store.exports.plain import features_path

    tracks = read_json(features_path(folder, "tracks"))
    return {"folder": str(folder), **read_json(folder / "report.json"), "tracks": tracks}


def _show_tracks(
    tracks: Sequence[Any], console: Console, form: PlaceFormat, *, on_ground: bool
) -> None:
    from sorvolo.geometry.coordinates import Coordinates, place_text

    has_cuts = len({track.get("segment") for track in tracks}) > 1
    in_picture = "segment: x, y px" if has_cuts else "x, y px"
    place_name = place_heading(False, form) if on_ground else in_picture
    accuracy = f"accuracy {'m' if on_ground else 'px'}"
    table = new_table(
        *("id", "class", "score", place_name, accuracy, "views", "moves"), whole=("id", place_name)
    )
    for track in tracks[:_MAX_ROWS]:
        if on_ground:
            place = place_text(track["latitude"], track["longitude"], Coordinates(form))
        else:
            segment = f"{track['segment']}: " if has_cuts else ""
            place = f"{segment}{track['x_px']:.0f}, {track['y_px']:.0f}"
        table.add_row(
            str(track["id"]),
            escape(track["class"]),
            f"{track['score']:.2f}",
            place,
            f"{track['sigma_m']:.1f}",
            str(track["views"]),
            "yes" if track["moving"] else "",
        )
    console.print(table)
    if len(tracks) > _MAX_ROWS:
        name = "tracks.geojson" if on_ground else "tracks.json"
        console.print(f"and {len(tracks) - _MAX_ROWS:,} more in {name}")
    console.print(
        "score: 0 to 1, about the share that is right; accuracy: 1 sigma; views: frames that show it",
        style="dim",
    )
