"""`sorvolo map`: flights into a site folder, and a summary of each."""

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

from sorvolo.cli.exit_codes import TO_CHECK
from sorvolo.cli.heights import make_and_read, show_heights
from sorvolo.cli.options import (
    Again,
    Area,
    AsJson,
    Camera,
    Compression,
    GiveUp,
    GroundElevation,
    LiveTelemetry,
    Offset,
    names,
    wanted_classes,
)
from sorvolo.cli.places_of_sites import Passing, not_sent, opened_site
from sorvolo.cli.progress import show_progress
from sorvolo.cli.shown import (
    newest_version,
    read_json,
    show_done,
    show_notices_and_warnings,
    show_path,
)
from sorvolo.survey.wording import counted, counted_list

if TYPE_CHECKING:
    from sorvolo.capture.live.reconnect import LiveSettings
    from sorvolo.missions.flight.request import AlreadyDone
    from sorvolo.missions.flight.settings import MapSettings
    from sorvolo.missions.search.while_flying import SearchWhileFlying
    from sorvolo.store.site.catalogue_place import Catalogues
    from sorvolo.survey.mosaic import MosaicUpdate

_MOST_REASONS = 6  # of frames that are not on the map, the commonest first


class Method(StrEnum):
    """How frames are registered."""

    PLANAR = "planar"
    THESIS = "thesis"


class Transform(StrEnum):
    """What method thesis fits between a frame and the map."""

    SIMILARITY = "similarity"
    HOMOGRAPHY = "homography"


MappedSite = Annotated[
    str, typer.Option(help="Folder of the map, or s3://BUCKET/NAME; an existing map is extended.")
]
Resolution = Annotated[
    float | None,
    typer.Option(help="Ground resolution of a new map, m a pixel. Without it: the frames' own."),
]
CoordinateSystem = Annotated[
    str,
    typer.Option(
        help="Coordinate system of mosaic.tif, such as EPSG:25832. Without it: the UTM zone."
    ),
]
ControlPoints = Annotated[
    Path | None,
    typer.Option(help="Ground control points: a gcp_list.txt, as OpenDroneMap reads it."),
]
ControlAccuracy = Annotated[
    float, typer.Option(help="Accuracy of the control points, m (1 sigma).")
]
BaseMap = Annotated[
    Path | None,
    typer.Option(help="Tie the map to this one: a GeoTIFF, or the folder of an earlier map."),
]
CheckPoints = Annotated[
    str,
    typer.Option(
        help="Control points held back to measure the map: labels with commas; CP* for a prefix."
    ),
]
MapCompression = Annotated[
    Compression | None,
    typer.Option(
        help="Of mosaic.tif: deflate (without loss) or jpeg (a fraction of the size). Without it: as before, deflate "
        "for a new map."
    ),
]
TransformOption = Annotated[Transform, typer.Option(help="What --method thesis fits.")]
StitchingValues = Annotated[
    list[str] | None,
    typer.Option(
        help="A value of method thesis, such as features=3000. Can be repeated. See docs/thesis.md."
    ),
]
HowRegistered = Annotated[
    Method,
    typer.Option(help="planar: all frames fitted together. thesis: the baseline, frame by frame."),
]
Model = Annotated[
    str,
    typer.Option(
        help="Detector for people, cars and small objects: a model's name, a file, or none."
    ),
]
SearchedClasses = Annotated[
    str | None,
    typer.Option(
        help="What to look for, with commas.", show_default="what the model usually reports"
    ),
]
Memory = Annotated[
    float | None,
    typer.Option(
        help="Memory for pictures that are needed again, MB, 64 or more. Without it: 512, or a quarter of the "
        "machine's if that is less."
    ),
]

CatalogueAddress = Annotated[
    str,
    typer.Option(
        help="Where a new map's catalogue lies: postgresql://USER@HOST/DATABASE, or sqlite, a file in the folder. "
        "Without it: SORVOLO_CATALOGUE, else sqlite. See docs/catalogue.md."
    ),
]
Refly = Annotated[
    list[Path] | None,
    typer.Option(
        help="Waypoints over ground that no picture shows: .plan, .kmz (DJI), .geojson or .kml. Kept up to date while "
        "the flight goes on. Can be repeated."
    ),
]
WithHeights = Annotated[
    bool,
    typer.Option(
        "--heights/--flat", help="Also make heights and a true orthophoto of each flight."
    ),
]


def map_command(
    inputs: Annotated[
        list[str], typer.Argument(help="Videos, folders of photos, photos, or live sources.")
    ],
    site: MappedSite,
    telemetry: LiveTelemetry = None,
    camera: Camera = "",
    area: Area = None,
    method: HowRegistered = Method.PLANAR,
    gsd: Resolution = None,
    overlap: Annotated[float, typer.Option(help="Overlap of the selected frames, 0 to 1.")] = 0.7,
    offset: Offset = None,
    ground_elevation: GroundElevation = None,
    crs: CoordinateSystem = "",
    gcp: ControlPoints = None,
    gcp_accuracy: ControlAccuracy = 0.05,
    check: CheckPoints = "",
    base: BaseMap = None,
    compress: MapCompression = None,
    transform: TransformOption = Transform.SIMILARITY,
    thesis: StitchingValues = None,
    model: Model = "default",
    classes: SearchedClasses = None,
    memory: Memory = None,
    give_up: GiveUp = 30.0,
    catalogue: CatalogueAddress = "",
    heights: WithHeights = False,
    refly: Refly = None,
    again: Again = False,
    as_json: AsJson = False,
) -> None:
    """Make a geo-referenced map of one or more flights, or extend the map in the site folder.

    Live sources: rtsp://, rtmp://, udp://, tcp://, webcam:0, follow:PATH (a video or folder that is being written).
    Ctrl-C finishes a live flight's map, a second one discards it. After a crash, the same command continues.

    Example: sorvolo map DJI_0042.MP4 --site field

    Example: sorvolo map photos/ --site field --camera phantom.xml --area field.geojson --refly holes.plan --heights

    Example: sorvolo map photos/ --site field --gcp gcp_list.txt --check CP*

    Example: sorvolo map rtsp://192.168.1.10/live --telemetry serial:/dev/ttyUSB0 --site field
    """
    from sorvolo.capture.live.reconnect import LiveSettings
    from sorvolo.missions.flight.settings import MapSettings
    from sorvolo.mosaic.roi_stitching import stitching_settings

    settings = MapSettings(
        method.value,
        gsd,
        overlap,
        offset,
        ground_elevation,
        crs or None,
        compress.value if compress else None,
        model=model,
        thesis=stitching_settings(thesis or [], transform=transform.value),
        control_sigma_m=gcp_accuracy,
        checks=names(check),
        memory_mb=memory,
        classes=wanted_classes(classes),
    )
    with opened_site(site, writes=True) as place:
        catalogues = _catalogues(site, place.folder, catalogue)
        reports = map_and_read_reports(
            inputs,
            place.folder,
            settings,
            telemetry=telemetry,
            camera=camera or None,
            area=area,
            live=LiveSettings(keeps_all=True, give_up_s=give_up),
            control=gcp,
            base=base,
            again=again,
            sent=place.sent,
            refly=refly or (),
            catalogues=catalogues,
        )
        _print(reports, place.folder, catalogues, with_heights=heights, as_json=as_json)
    _exit_by(reports)


def _exit_by(reports: Sequence[Mapping[str, Any]]) -> None:
    """End with the code for results that are to be checked, where any is."""
    if any(each["headline"]["quality"] != "map" for each in reports):
        raise typer.Exit(TO_CHECK)


def _catalogues(site: str, folder: Path, address: str) -> "Catalogues":
    """Where a new site's catalogue goes: to this address; "" leaves it to the environment. Raises SettingsError."""
    from sorvolo.missions.site.copy import folder_of
    from sorvolo.store.site.catalogue_place import chosen_catalogues

    in_store = folder_of(site) is None  # there it lies with the tiles
    return chosen_catalogues(folder, address or ("sqlite" if in_store else ""))


def _print(
    reports: Sequence[Mapping[str, Any]],
    site: Path,
    catalogues: "Catalogues",
    *,
    with_heights: bool,
    as_json: bool,
) -> None:
    """Print what became of the flights; with heights, make and print them, too."""
    if not as_json:
        show_reports(reports, site, Console())
    heights = [
        make_and_read(site, each["flight"], catalogues=catalogues)
        for each in reports
        if with_heights
    ]
    if as_json:
        plain = [{key: value for key, value in each.items() if key != "track"} for each in reports]
        files = {path.name.replace(".", "_"): str(path) for path in _map_files(site).values()}
        typer.echo(
            json.dumps({"site": str(site), **files, "flights": plain, "heights": heights}, indent=1)
        )
        return
    for each in heights:
        show_heights(site, each, Console())


def map_and_read_reports(
    inputs: Sequence[Path | str],
    site: Path,
    settings: "MapSettings",
    *,
    telemetry: Path | str | None = None,
    camera: str | None = None,
    area: Path | None = None,
    live: "LiveSettings | None" = None,
    control: Path | None = None,
    base: Path | None = None,
    again: bool = False,
    sent: Passing = not_sent,
    refly: Sequence[Path] = (),
    catalogues: "Catalogues | None" = None,
    search: "SearchWhileFlying | None" = None,
) -> list[dict[str, Any]]:
    """Map with progress on stderr; the reports of the flights, in order, and of those that were mapped already.

    `sent` sees the mission's updates and may send what a flight added. `search`, `catalogues`: as `map_flights`.
    """
    from sorvolo.capture.live.reconnect import LiveSettings
    from sorvolo.missions.map.flights import map_flights
    from sorvolo.store.site.archive import Archive

    before = newest_version(site, catalogues)
    with ended_by_signal(inputs) as until:
        mapping = sent(
            map_flights(
                inputs,
                site,
                settings,
                telemetry=telemetry,
                camera=camera,
                area=area,
                live=live or LiveSettings(keeps_all=True),
                until=until,
                control=control,
                base=base,
                again=again,
                refly=refly,
                catalogues=catalogues,
                search=search,
            )
        )
        known: list[AlreadyDone] = []

        def noted() -> Iterator["MosaicUpdate"]:
            known.extend((yield from mapping))

        # closed even when the bar is stopped: then the site is as it was
        with closing(mapping):
            show_progress(noted(), Console(stderr=True))
    show_done(known, "mapped")
    with Archive.open(site, write=False, catalogues=catalogues) as archive:
        mapped = [
            each.flight_id for each in archive.versions() if each.complete and each.id > before
        ]
        mapped += [each.flight for each in known]
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
    """Print what became of the flights, what to look at first, and where the files are."""
    for report in reports:
        _show_report(report, console)
    for name, path in _map_files(site).items():
        show_path(name, path, console)
    for report in reports:
        show_path("report", site / "flights" / report["flight"] / "report.html", console)


def _show_report(report: Mapping[str, Any], console: Console) -> None:
    table = Table(
        title=f"Flight {escape(report['flight'])}", show_header=False, title_justify="left"
    )
    for name, text in (*_frame_rows(report["frames"]), *_quality_rows(report)):
        if text:
            table.add_row(name, text)
    console.print(escape(report["headline"]["text"]), style="bold", highlight=False)
    console.print(table)
    show_notices_and_warnings(report, console)


def _frame_rows(frames: Mapping[str, Any]) -> list[tuple[str, str]]:
    rows = [
        ("frames", f"{frames['selected']:,} selected of {frames['total']:,}"),
        (
            "[green]matched[/green]",
            f"{frames['vision']:,} of {counted(frames['selected'], 'frame')}",
        ),
        (
            "[yellow]by GPS alone[/yellow]",
            counted(frames["gps-only"], "frame") if frames["gps-only"] else "",
        ),
        ("[red]left out[/red]", counted(frames["rejected"], "frame") if frames["rejected"] else ""),
    ]
    reasons = list(frames["reasons"].items())[:_MOST_REASONS]
    return rows + [
        ("", escape(f"{counted(count, 'frame')}: {reason}")) for reason, count in reasons
    ]


def _quality_rows(report: Mapping[str, Any]) -> list[tuple[str, str]]:
    """How well frames fit each other and, where the map has metres, the Earth."""
    residual_px = report["residual_px"]["median"]
    rows = [
        ("match error", _with_unit("{:.2f} px (median distance of matched points)", residual_px))
    ]
    if report["georeferenced"]:
        rows += [
            ("flight height", _height_by_known_ground(report)),
            (
                "distance to GPS",
                _with_unit("{:.2f} m (median)", report["gps_residual_m"]["median"]),
            ),
            (
                "position accuracy",
                _with_unit(
                    f"{{:.2f}} m (1 sigma, including the error shared by all {_placed_by(report)})",
                    report["sigma_m"],
                ),
            ),
        ]
    return [
        *rows,
        *_control_rows(report.get("control")),
        ("base map", _base(report.get("base"))),
        ("map", _size(report)),
        ("ground seen", _seen(report.get("seen"), has_metres=report["georeferenced"])),
        ("objects found", _objects(report.get("objects") or {})),
        ("clock offset", _clock_offset(report["time_offset"])),
        (
            "took",
            f"{report['seconds']['total']:.1f} s, memory at most {report['peak_memory_mb']:,.0f} MB",
        ),
    ]


def _height_by_known_ground(report: Mapping[str, Any]) -> str:
    """The height that a flight without GPS has by its control points or its base map: a wrong unit or scale shows."""
    if report["gps_residual_m"]["median"] is not None or report["height_above_ground_m"] is None:
        return ""
    return f"{report['height_above_ground_m']:.0f} m above the ground, by the {_placed_by(report)} alone"


def _seen(seen: Mapping[str, Any] | None, *, has_metres: bool) -> str:
    """How much ground one picture alone shows, and what none does."""
    if seen is None or not has_metres or not seen["seen_m2"]:
        return ""
    words = f"{seen['one_view_m2'] / seen['seen_m2']:.0%} of it by one picture alone"
    if not seen["holes"]:
        return f"{words}, no holes"
    planned = (
        f"; waypoints in {', '.join(seen['refly'])}"
        if seen["refly"]
        else "; --refly plans a flight over them"
    )
    return escape(
        f"{words}, {counted(seen['holes'], 'hole')} of {seen['holes_m2']:,.0f} m2{planned}"
    )


def _placed_by(report: Mapping[str, Any]) -> str:
    if report.get("base"):
        return "places on the base map"
    return "control points" if report.get("control") else "GPS fixes"


def _base(base: Mapping[str, Any] | None) -> str:
    if base is None:
        return ""
    moved = "" if base["moved_m"] is None else f", which moved the map by {base['moved_m']:.2f} m"
    return escape(
        f"{base['found']:,} of {counted(base['sought'], 'frame')} found on {base['name']}, {base['residual_m']:.2f} m "
        f"off (median){moved}"
    )


def _control_rows(control: Mapping[str, Any] | None) -> list[tuple[str, str]]:
    """How well the map fits its control points, those left out by name."""
    if control is None:
        return []
    words = {"control": "control points", "check": "check points"}
    rows = []
    for role, name in words.items():
        count = sum(each["role"] == role for each in control["points"])
        rms_m = control[f"{role}_rms_m"]
        rows.append(
            (name, f"{count}, {rms_m:.3f} m off (root mean square)" if rms_m is not None else "")
        )
    left_out = ", ".join(escape(each) for each in control["excluded"])
    return [
        *rows,
        (
            "[red]left out[/red]",
            f"{left_out}: contradict the other control points" if left_out else "",
        ),
    ]


def _size(report: Mapping[str, Any]) -> str:
    if not report["georeferenced"]:
        return "without scale, north and place on Earth: there was no usable GPS"
    resolution_cm = 100 * report["ground_sampling_distance_m"]
    return f"{report['area_m2']:,.0f} m2, ground resolution {resolution_cm:.2f} cm a pixel"


def _objects(found: Mapping[str, Any]) -> str:
    if found.get("model") is None:
        return f"not searched: {escape(str(found['why_not']))}" if found.get("why_not") else ""
    return escape(f"{counted_list(found['classes'], none='none')} (model {found['model']})")


def _clock_offset(offset: Mapping[str, Any]) -> str:
    parts = (
        [] if offset["origin"] == "none" else [f"{offset['applied_s']:+.2f} s ({offset['origin']})"]
    )
    if offset["estimate_s"] is not None:
        parts.append(
            f"estimated from the motion: {offset['estimate_s']:+.2f} s (1 sigma {offset['sigma_s']:.2f} s)"
        )
    return "; ".join(parts)


def _with_unit(pattern: str, number: float | None) -> str:
    return "" if number is None else pattern.format(number)


def _map_files(site: Path) -> dict[str, Path]:
    from sorvolo.store.exports.plain import features_path

    named = {"picture": "preview.png", "GeoTIFF": "mosaic.tif", "KMZ": "mosaic.kmz"}
    paths = {name: site / file for name, file in named.items()} | {
        "objects": features_path(site, "objects")
    }
    return {name: path for name, path in paths.items() if path.is_file()}
