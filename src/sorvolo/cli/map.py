"""`sorvolo map`: flights into a site folder, and in the end what became of them."""

import json
import signal
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from sorvolo.cli.progress import show_progress
from sorvolo.errors import StoreError

if TYPE_CHECKING:
    from sorvolo.capture.live.reconnect import LiveSettings
    from sorvolo.missions.flight.settings import MapSettings

_COLOURS = {"vision": "green", "gps-only": "yellow", "rejected": "red"}
_MOST_REASONS = 6


class Method(StrEnum):
    """How frames are registered."""

    PLANAR = "planar"
    THESIS = "thesis"


class Transform(StrEnum):
    """What method thesis fits between a frame and the map."""

    SIMILARITY = "similarity"
    HOMOGRAPHY = "homography"


def map_command(
    inputs: Annotated[list[str], typer.Argument(help="Videos, folders of photos, photos, or live sources.")],
    site: Annotated[Path, typer.Option(help="Folder of the map; one that exists is extended.")],
    telemetry: Annotated[
        str | None, typer.Option(help="The flight's log, if not beside the video; of a live one, the receiver's link.")
    ] = None,
    camera: Annotated[str, typer.Option(help="Calibration file, preset name or EXIF code, or aov=DEG.")] = "",
    area: Annotated[
        Path | None, typer.Option(help="Outline outside of which frames are not used: GeoJSON, KML, KMZ.")
    ] = None,
    method: Annotated[
        Method, typer.Option(help="planar: ours. thesis: the baseline, frame against map.")
    ] = Method.PLANAR,
    gsd: Annotated[
        float | None, typer.Option(help="Metres a pixel of a new map; else the frames' own.")
    ] = None,
    overlap: Annotated[float, typer.Option(help="Overlap of the frames selected, 0 to 1.")] = 0.7,
    offset: Annotated[
        float | None, typer.Option(help="Telemetry time minus video time, s; else found from motion.")
    ] = None,
    ground_elevation: Annotated[
        float | None, typer.Option(help="Of the ground, m, in telemetry's own height reference.")
    ] = None,
    crs: Annotated[str, typer.Option(help="CRS of mosaic.tif, such as EPSG:25832; else the UTM zone.")] = "",
    transform: Annotated[Transform, typer.Option(help="Of method thesis.")] = Transform.SIMILARITY,
    model: Annotated[
        str, typer.Option(help="Looks for people, cars, objects: a model's name, a file, or none.")
    ] = "default",
    give_up: Annotated[float, typer.Option(help="A live source silent for so long has ended, s.")] = 30.0,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Make a geo-referenced map of one or more flights, or extend the map in the site folder.

    Live sources are addresses (rtsp://, rtmp://, udp://, tcp://), webcam:0, and follow:PATH for a video or a folder of
    photos that is being written. Ctrl-C ends a live flight, and its map is finished; a second Ctrl-C leaves it out.

    Example: sorvolo map DJI_0042.MP4 --site field

    Example: sorvolo map photos/ --site field --camera phantom.xml --area field.geojson

    Example: sorvolo map rtsp://192.168.1.10/live --telemetry serial:/dev/ttyUSB0 --site field
    """
    from sorvolo.capture.live.reconnect import LiveSettings
    from sorvolo.missions.flight.settings import MapSettings

    settings = MapSettings(
        method.value, gsd, overlap, offset, ground_elevation, crs or None, transform.value, model=model,
    )
    reports = map_and_read_reports(
        inputs, site, settings, telemetry=telemetry, camera=camera or None, area=area,
        live=LiveSettings(keeps_all=True, give_up_s=give_up),
    )
    if as_json:
        plain = [{key: value for key, value in each.items() if key != "track"} for each in reports]
        files = {path.name.replace(".", "_"): str(path) for path in _map_files(site).values()}
        typer.echo(json.dumps({"site": str(site), **files, "flights": plain}, indent=1))
    else:
        show_reports(reports, site, Console())


def map_and_read_reports(
    inputs: Sequence[Path | str], site: Path, settings: "MapSettings", *, telemetry: Path | str | None = None,
    camera: str | None = None, area: Path | None = None,
    live: "LiveSettings | None" = None,
) -> list[dict[str, Any]]:
    """Map with a bar on stderr; the reports of the flights that were mapped, in order."""
    from sorvolo.capture.live.reconnect import LiveSettings
    from sorvolo.missions.map.flights import map_flights
    from sorvolo.store.site.archive import Archive

    before = newest_version(site)
    with ended_by_signal(inputs) as until:
        mapping = map_flights(
            inputs, site, settings, telemetry=telemetry, camera=camera, area=area,
            live=live or LiveSettings(keeps_all=True), until=until,
        )
        # closed even when the bar is stopped: then the site is as it was
        with closing(mapping) as updates:
            show_progress(updates, Console(stderr=True))
    with Archive.open(site, write=False) as archive:
        mapped = [each.flight_id for each in archive.versions() if each.complete and each.id > before]
        return [read_json(archive.flight_folder(flight_id) / "report.json") for flight_id in mapped]


@contextmanager
def ended_by_signal(inputs: Sequence[Path | str]) -> Iterator[threading.Event]:
    """An event that Ctrl-C or SIGTERM sets once where an input is live; the next one stops the command as ever."""
    from sorvolo.capture.live.addresses import is_live_address

    until = threading.Event()
    if not any(is_live_address(str(each)) for each in inputs):
        yield until
        return
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}

    def restore() -> None:
        for number, handler in before.items():
            signal.signal(number, handler)

    def end(*_: Any) -> None:
        until.set()
        restore()

    for number in before:
        signal.signal(number, end)
    try:
        yield until
    finally:
        restore()


def show_reports(reports: Sequence[Mapping[str, Any]], site: Path, console: Console) -> None:
    """Tell what became of the flights, what to look at first, and where the files are."""
    for report in reports:
        _show_report(report, console)
    for name, path in _map_files(site).items():
        tell_path(name, path, console)
    for report in reports:
        tell_path("report", site / "flights" / report["flight"] / "report.html", console)


def _show_report(report: Mapping[str, Any], console: Console) -> None:
    frames = report["frames"]
    table = Table(title=f"Flight {escape(report['flight'])}", show_header=False, title_justify="left")
    table.add_row("frames", f"{frames['selected']} selected of {frames['total']}")
    for status, colour in _COLOURS.items():
        if frames[status]:
            table.add_row(f"[{colour}]{status}[/{colour}]", str(frames[status]))
    for reason, count in list(frames["reasons"].items())[:_MOST_REASONS]:
        table.add_row("", escape(f"{count} x {reason}"))
    unit = "m" if report["georeferenced"] else "units"
    for name, text in (
        ("residual", _with_unit("{:.2f} px median", report["residual_px"]["median"])),
        ("off GPS", _with_unit("{:.2f} " + unit + " median", report["gps_residual_m"]["median"])),
        ("place good to", _with_unit(
            "{:.2f} " + unit + ", one sigma, what all fixes err in common included", report["sigma_m"]
        )),
        ("map", _size(report)),
        ("objects", _objects(report.get("objects") or {})),
        ("clock offset", _clock_offset(report["time_offset"])),
        ("took", f"{report['seconds']['total']:.1f} s, {report['peak_memory_mb']:.0f} MB at most"),
    ):
        if text:
            table.add_row(name, text)
    console.print(table)
    tell_notices_and_warnings(report, console)


def _size(report: Mapping[str, Any]) -> str:
    if not report["georeferenced"]:
        return "in a frame of its own, without metres and north"
    return f"{report['area_m2']:.0f} m2 at {100 * report['ground_sampling_distance_m']:.2f} cm a pixel"


def _objects(told: Mapping[str, Any]) -> str:
    if told.get("model") is None:
        return f"not looked for: {told['why_not']}" if told.get("why_not") else ""
    counts = [f"{count} {escape(name)}" for name, count in told["classes"].items() if count]
    return (", ".join(counts) or "none found") + f", by the model {escape(told['model'])}"


def _clock_offset(offset: Mapping[str, Any]) -> str:
    parts = [] if offset["origin"] == "none" else [f"{offset['applied_s']:+.2f} s, {offset['origin']}"]
    if offset["estimate_s"] is not None:
        parts.append(f"motion shows {offset['estimate_s']:+.2f} s within {offset['sigma_s']:.2f} s")
    return "; ".join(parts)


def _with_unit(pattern: str, number: float | None) -> str:
    return "" if number is None else pattern.format(number)


def tell_notices_and_warnings(report: Mapping[str, Any], console: Console) -> None:
    """Print what was found and survived, and what to look at first."""
    for notice in report["notices"]:
        console.print(f"[blue]note[/blue]     {escape(notice['text'])}")
    for warning in report["warnings"]:
        console.print(f"[yellow]warning[/yellow]  {escape(warning)}")


def tell_path(name: str, path: Path, console: Console) -> None:
    """Print where a file is."""
    # in one piece, however long: people copy it
    console.print(f"{name:>8}  {escape(str(path))}", soft_wrap=True, highlight=False)


def _map_files(site: Path) -> dict[str, Path]:
    named = {"picture": "preview.png", "GeoTIFF": "mosaic.tif", "KMZ": "mosaic.kmz", "objects": "objects.geojson"}
    return {name: site / file for name, file in named.items() if (site / file).is_file()}


def newest_version(site: Path) -> int:
    """The id of the site's newest version; 0 where there is no site yet."""
    from sorvolo.store.site.archive import Archive
    from sorvolo.store.site.files import CATALOGUE

    if not (site / CATALOGUE).is_file():
        return 0
    with Archive.open(site, write=False) as archive:
        return max((each.id for each in archive.versions() if each.complete), default=0)


def read_json(path: Path) -> dict[str, Any]:
    """A document of a flight; raises StoreError when it cannot be read."""
    try:
        return dict(json.loads(path.read_text(encoding="utf-8")))
    except (OSError, ValueError) as error:
        raise StoreError(f"{path} cannot be read ({error}); map the flight again") from error
