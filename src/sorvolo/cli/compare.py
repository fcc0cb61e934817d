"""`sorvolo compare`: a later flight against the map, its changes told as they are found."""

import json
from collections.abc import Mapping, Sequence
from contextlib import closing
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, SpinnerColumn, TextColumn, TimeRemainingColumn
from rich.table import Table

from sorvolo.cli.map import ended_by_signal, newest_version, read_json, tell_notices_and_warnings, tell_path
from sorvolo.cli.progress import bars

if TYPE_CHECKING:
    from sorvolo.capture.live.reconnect import LiveSettings
    from sorvolo.missions.flight.settings import CompareSettings
    from sorvolo.survey.findings import Change, CompareUpdate

_COLOURS = {"appeared": "green", "disappeared": "red", "replaced": "yellow", "moving": "cyan"}
_MOST_ROWS = 40


class ChangeMethod(StrEnum):
    """How a frame is compared with the map."""

    ROBUST = "robust"
    THESIS = "thesis"


def compare(
    inputs: Annotated[
        list[str], typer.Argument(help="Videos, folders of photos, photos, or live sources of a later flight.")
    ],
    site: Annotated[Path, typer.Option(help="Folder of the map that an earlier flight made.")],
    telemetry: Annotated[
        str | None, typer.Option(help="The flight's log, if not beside the video; of a live one, the receiver's link.")
    ] = None,
    camera: Annotated[str, typer.Option(help="Calibration file, preset name or EXIF code, or aov=DEG.")] = "",
    area: Annotated[
        Path | None, typer.Option(help="Outline outside of which frames are not used: GeoJSON, KML, KMZ.")
    ] = None,
    method: Annotated[ChangeMethod, typer.Option(help="robust: ours. thesis: the baseline.")] = ChangeMethod.ROBUST,
    views_per_second: Annotated[
        float, typer.Option(help="Frames compared a second of a video; the others show the same again.")
    ] = 5.0,
    votes: Annotated[int, typer.Option(help="Views that must show a change ...")] = 3,
    voters: Annotated[int, typer.Option(help="... among the last so many that saw the ground.")] = 5,
    offset: Annotated[float | None, typer.Option(help="Telemetry time minus video time, s.")] = None,
    ground_elevation: Annotated[
        float | None, typer.Option(help="Of the ground, m, in telemetry's own height reference.")
    ] = None,
    masks: Annotated[bool, typer.Option("--masks", help="Write each frame's change mask and boxes, too.")] = False,
    steps: Annotated[
        Path | None, typer.Option(help="Folder for method thesis's eight pictures a view (its Figure 3.14), 4-8 MB.")
    ] = None,
    thesis: Annotated[
        list[str] | None,
        typer.Option(
            help="A value of Table 4.2 for method thesis, such as T_gray=light, W_a=8x8, eq3.21=printed, threads=4; "
            "again for each. See docs/thesis.md."
        ),
    ] = None,
    update: Annotated[
        bool, typer.Option("--update/--no-update", help="Bring the map up to date where the ground changed or is new.")
    ] = True,
    model: Annotated[
        str, typer.Option(help="Tells what changed, before and after: a model's name, a file, or none.")
    ] = "default",
    give_up: Annotated[float, typer.Option(help="A live source silent for so long has ended, s.")] = 30.0,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Find what appeared, disappeared or moves since the map in the site folder was made, and update the map.

    Live sources are those of `sorvolo map`. Ctrl-C ends a live flight, and what it showed is kept; a second Ctrl-C
    leaves it out.

    Example: sorvolo compare DJI_0057.MP4 --site field

    Example: sorvolo compare photos/ --site field --masks --json
    """
    from sorvolo.capture.live.reconnect import LiveSettings
    from sorvolo.change.pair.thesis_options import thesis_options
    from sorvolo.missions.flight.settings import CompareSettings

    settings = CompareSettings(
        method.value, views_per_second, votes, voters, offset, ground_elevation, updates_map=update, writes_masks=masks,
        model=model, thesis=thesis_options(thesis or []),
    )
    results = compare_and_read_results(
        inputs, site, settings, telemetry=telemetry, camera=camera or None, area=area, steps=steps,
        live=LiveSettings(keeps_all=True, give_up_s=give_up),
    )
    if as_json:
        typer.echo(json.dumps({"site": str(site), "flights": results}, indent=1))
    else:
        show_results(results, site, Console())


def compare_and_read_results(
    inputs: Sequence[Path | str], site: Path, settings: "CompareSettings", *, telemetry: Path | str | None = None,
    camera: str | None = None, area: Path | None = None, steps: Path | None = None,
    live: "LiveSettings | None" = None,
) -> list[dict[str, Any]]:
    """Compare with a bar and each change as it is announced on stderr; report and changes of each flight, in order."""
    from sorvolo.capture.live.reconnect import LiveSettings
    from sorvolo.missions.compare.flights import compare_flights
    from sorvolo.store.site.archive import Archive

    before = newest_version(site)
    with ended_by_signal(inputs) as until:
        comparing = compare_flights(
            inputs, site, settings, telemetry=telemetry, camera=camera, area=area, steps=steps,
            live=live or LiveSettings(keeps_all=True), until=until,
        )
        # closed even when the bar is stopped: then the site is as it was
        with closing(comparing) as updates:
            told_ids = _show_progress(updates, site, Console(stderr=True))
    with Archive.open(site, write=False) as archive:
        compared = [each.flight_id for each in archive.versions() if each.complete and each.id > before]
        return [_result(archive.flight_folder(flight_id), told_ids) for flight_id in compared]


def show_results(results: Sequence[Mapping[str, Any]], site: Path, console: Console) -> None:
    """Tell what changed, what could not be compared, and where the files are."""
    for result in results:
        _show_result(result, console)
        folder = site / "flights" / result["flight"]
        tell_path("page", folder / "changes.html", console)
        tell_path("GeoJSON", folder / "changes.geojson", console)
        tell_path("report", folder / "report.html", console)
    tell_path("map", site / "preview.png", console)


def _show_progress(updates: Any, site: Path, console: Console) -> list[str]:
    """Take all updates, telling each change as it is announced; the ids of these."""
    columns = (
        SpinnerColumn(), TextColumn("{task.description}"), BarColumn(bar_width=30),
        TextColumn("{task.fields[told]}"), TimeRemainingColumn(),
    )
    told_ids: list[str] = []
    unit = ""
    with bars(*columns, console=console) as progress:
        task = progress.add_task("opening", total=None, told="")
        update: CompareUpdate
        for update in updates:
            for change in update.announced:
                told_ids.append(change.id)
                unit = unit or unit_of(site)
                console.print(_words_of(change, unit), highlight=False)
            rate = f"{update.frames_read / update.seconds:.1f} frames/s, " if update.seconds > 0 else ""
            progress.update(
                task, description="comparing",
                told=f"{rate}{update.compared} of {update.views} compared, {len(told_ids)} changes",
                total=max(update.frames_expected, update.frames_read), completed=update.frames_read,
            )
    return told_ids


def unit_of(site: Path) -> str:
    """Metres, or the units of a map that has none."""
    from sorvolo.store.site.archive import Archive

    with Archive.open(site, write=False) as archive:
        return "units" if archive.site().is_local else "m"


def _words_of(change: "Change", unit: str) -> str:
    colour = _COLOURS[change.kind]
    centre_m = change.outline_m.mean(axis=0)
    named = " to ".join(escape(name) for name in (change.class_before, change.class_after) if name)
    what = f"{named}, " if named else ""
    return (
        f"[{colour}]{change.kind.value:>11}[/{colour}]  {escape(change.id)}: {what}{change.length_m:.1f} {unit} long, "
        f"{centre_m[0]:+.1f} {unit} east {centre_m[1]:+.1f} {unit} north of the site's origin, "
        f"within {change.sigma_m:.2f} {unit}"
    )


def _result(folder: Path, told_ids: Sequence[str]) -> dict[str, Any]:
    """What a flight's files say, and which changes were told while it lasted and are not among them in the end."""
    report = read_json(folder / "report.json")
    changes = read_json(folder / "changes.geojson")
    kept = {feature["properties"]["id"] for feature in changes["features"]}
    taken_back = [each for each in told_ids if each.rpartition("-")[0] == report["flight"] and each not in kept]
    return {
        "flight": report["flight"], "method": report["method"], "comparison": report["comparison"],
        "frames": report["frames"], "seconds": report["seconds"]["total"], "peak_memory_mb": report["peak_memory_mb"],
        "warnings": report["warnings"], "notices": report["notices"], "changes": changes,
        "taken_back": taken_back,
    }


def _show_result(result: Mapping[str, Any], console: Console) -> None:
    comparison = result["comparison"]
    dark = ", and most would be missed: it was too dark" if comparison.get("most_missed") else ""
    console.print(
        f"Flight {escape(result['flight'])}: {len(result['changes']['features'])} changes{dark}", style="bold"
    )
    table = Table(box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
    is_local = result["changes"].get("crs", "WGS84") is None  # no place on Earth, no metres
    unit, place, digits = ("units", "north, east", 1) if is_local else ("m", "latitude, longitude", 6)
    for name in ("id", "kind", f"long {unit}", place, f"within {unit}", "views", "score"):
        table.add_column(name, no_wrap=True)
    for feature in result["changes"]["features"][:_MOST_ROWS]:
        each = feature["properties"]
        longitude, latitude = _middle(feature["geometry"]["coordinates"][0])
        table.add_row(
            escape(each["id"]), _kind_words(each), f"{each['length_m']:.2f}",
            f"{latitude:.{digits}f}, {longitude:.{digits}f}", f"{each['sigma_m']:.2f}", str(each["views"]),
            f"{each['score']:.2f}",
        )
    if table.row_count:
        console.print(table)
    if len(result["changes"]["features"]) > _MOST_ROWS:
        console.print(f"and {len(result['changes']['features']) - _MOST_ROWS} more in changes.geojson")
    views = comparison["views"]
    console.print(
        f"{views['compared']} of {sum(views.values())} views compared over {comparison['compared_area_m2']:.0f} "
        f"{'square units' if is_local else 'm2'}, "
        f"in {result['seconds']:.1f} s, {result['peak_memory_mb']:.0f} MB at most"
    )
    extension = comparison.get("extension") or {}
    if extension.get("frames"):
        as_well = f"; {extension['shown_as_well']} more show the same ground" if extension["shown_as_well"] else ""
        console.print(
            f"the map grew by {extension['area_m2']:.0f} m2: {extension['frames']} frames extended it{as_well}"
        )
    if result["taken_back"]:
        console.print(
            f"taken back, since what the whole flight showed does not bear them out: {', '.join(result['taken_back'])}",
            highlight=False, markup=False,
        )
    for reason, count in list(comparison["reasons"].items())[:6]:
        console.print(f"  {count} x {escape(reason)}", highlight=False)
    tell_notices_and_warnings(result, console)


def _kind_words(properties: Mapping[str, Any]) -> str:
    """The kind of change, and below it what it was and is: side by side they do not fit a terminal of 80 columns."""
    named = " to ".join(escape(name) for name in (properties["class_before"], properties["class_after"]) if name)
    return f"{properties['kind']}\n{named}" if named else str(properties["kind"])


def _middle(ring: Sequence[Sequence[float]]) -> tuple[float, float]:
    points = ring[:-1]
    return sum(each[0] for each in points) / len(points), sum(each[1] for each in points) / len(points)
