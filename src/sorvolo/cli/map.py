"""`sorvolo map`: flights into a site folder, and a summary of each."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer
from rich.markup import escape

from sorvolo.cli.heights import make_and_read, show_heights
from sorvolo.cli.options import (
    Again,
    Area,
    AsJson,
    Camera,
    CatalogueAddress,
    Classes,
    EnoughLookedAt,
    GiveUp,
    GroundElevation,
    Inputs,
    Model,
    Offset,
    Refly,
    Resolution,
    SiteOption,
    Telemetry,
    names,
    option,
    wanted_classes,
)
from sorvolo.cli.pdf import Pdf, write_pdfs
from sorvolo.cli.printing import (
    TO_CHECK,
    Console,
    announce_people,
    facts_table,
    print_json,
    read_json,
    show_notices_and_warnings,
    show_path,
)
from sorvolo.cli.progress import show_progress
from sorvolo.cli.sites import ended_by_signal, opened_site, run_on_site
from sorvolo.paths import JsonView
from sorvolo.survey.wording import counted, counted_list

if TYPE_CHECKING:
    from sorvolo.store.site.catalogue_place import Catalogues

_MAX_REASONS = 6  # of frames that are not on the map, the commonest first


MethodOption = Annotated[
    Literal["planar", "thesis"],
    option("planar: all frames fitted together. thesis: the baseline, frame by frame."),
]
CoordinateSystem = Annotated[
    str,
    option("Coordinate system of mosaic.tif, such as EPSG:25832.", show_default="the UTM zone"),
]
ControlPoints = Annotated[
    Path | None,
    option("Ground control points: a gcp_list.txt, as OpenDroneMap reads it."),
]
ControlAccuracy = Annotated[float, option("Accuracy of the control points, m (1 sigma).")]
CheckPoints = Annotated[
    str,
    option("Control points held back to measure the map: labels with commas; CP* for a prefix."),
]
BaseMap = Annotated[
    Path | None,
    option("Tie the map to this one: a GeoTIFF, or the folder of an earlier map."),
]
WithHeights = Annotated[
    bool | None,
    option(
        "True orthophoto over measured heights, or a flat map.",
        "--heights/--flat",
        show_default="heights where the ground is not level",
    ),
]


def map_command(
    inputs: Inputs,
    site: SiteOption,
    telemetry: Telemetry = None,
    camera: Camera = "",
    area: Area = None,
    method: MethodOption = "planar",
    gsd: Resolution = None,
    offset: Offset = None,
    ground_elevation: GroundElevation = None,
    crs: CoordinateSystem = "",
    gcp: ControlPoints = None,
    gcp_accuracy: ControlAccuracy = 0.05,
    check: CheckPoints = "",
    base: BaseMap = None,
    model: Model = "default",
    classes: Classes = None,
    enough_looked_at: EnoughLookedAt = 0.9,
    give_up: GiveUp = 30.0,
    catalogue: CatalogueAddress = "",
    heights: WithHeights = None,
    refly: Refly = None,
    pdf: Pdf = False,
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
    from sorvolo.missions.map.flights import map_flights
    from sorvolo.missions.mission import is_good
    from sorvolo.missions.site.copy import folder_of
    from sorvolo.store.site.catalogue_place import chosen_catalogues

    thesis = None
    if method != "planar":
        from sorvolo.lab.thesis.mapping import ThesisMapping

        thesis = ThesisMapping()
    settings = MapSettings(
        thesis,
        gsd,
        offset_s=offset,
        ground_elevation_m=ground_elevation,
        crs=crs or None,
        model=model,
        control_sigma_m=gcp_accuracy,
        checks=names(check),
        classes=wanted_classes(classes),
        heights=heights,
        enough_looked_at=enough_looked_at,
    )
    with opened_site(site, writes=True) as place:
        # in a store the catalogue lies with the tiles
        in_store = folder_of(site) is None
        catalogues = chosen_catalogues(place.folder, catalogue or ("sqlite" if in_store else ""))
        with ended_by_signal(inputs) as until:
            mapping = map_flights(
                inputs,
                place.folder,
                settings,
                telemetry=telemetry,
                camera=camera or None,
                area=area,
                live=LiveSettings(keeps_all=True, give_up_s=give_up),
                until=until,
                control=gcp,
                base=base,
                again=again,
                refly=refly or (),
                catalogues=catalogues,
            )
            folders = run_on_site(
                mapping,
                place,
                lambda updates: show_progress(updates, Console(stderr=True)),
                "mapped",
            )
        reports = [read_json(folder / "report.json") for folder in folders]
        _print(reports, place.folder, catalogues, with_heights=bool(heights), as_json=as_json)
        if pdf:
            write_pdfs((folder / "report.html" for folder in folders), Console(stderr=as_json))
    if not all(is_good(report["headline"]) for report in reports):
        raise typer.Exit(TO_CHECK)


def _print(
    reports: Sequence[JsonView],
    site: Path,
    catalogues: "Catalogues",
    *,
    with_heights: bool,
    as_json: bool,
) -> None:
    """Print what became of the flights, and their heights; those asked for of a map that stayed flat are made."""
    from sorvolo.store.site.files import HeightFile

    if not as_json:
        show_reports(reports, site, Console())
    heights = [
        make_and_read(site, report["flight"], catalogues=catalogues)
        if _is_flat(report)
        else read_json(site / "flights" / report["flight"] / HeightFile.REPORT)
        for report in reports
        if with_heights or not _is_flat(report)
    ]
    if as_json:
        plain = [
            {key: value for key, value in report.items() if key != "track"} for report in reports
        ]
        files = {path.name.replace(".", "_"): str(path) for path in _map_files(site).values()}
        print_json({"site": str(site), **files, "flights": plain, "heights": heights})
        return
    for report in heights:
        show_heights(site, report, Console())


def _is_flat(report: JsonView) -> bool:
    return bool(report.get("shape", {}).get("is_flat", True))


def show_reports(reports: Sequence[JsonView], site: Path, console: Console) -> None:
    """Print what became of the flights, what to look at first, and where the files are."""
    for report in reports:
        frames = report["frames"]
        by_gps, rejected = frames["gps-only"], frames["rejected"]
        rows = [
            ("frames", f"{frames['selected']:,} selected of {frames['total']:,}"),
            (
                "[green]matched[/green]",
                f"{frames['vision']:,} of {counted(frames['selected'], 'frame')}",
            ),
            ("[yellow]by GPS alone[/yellow]", counted(by_gps, "frame") if by_gps else ""),
            ("[red]left out[/red]", counted(rejected, "frame") if rejected else ""),
        ]
        reasons = list(frames["reasons"].items())[:_MAX_REASONS]
        frame_rows = rows + [
            ("", escape(f"{counted(count, 'frame')}: {reason}")) for reason, count in reasons
        ]
        console.print(escape(report["headline"]["text"]), style="bold")
        announce_people(report, site, console)
        title = f"Flight {escape(report['flight'])}"
        console.print(facts_table(title, (*frame_rows, *_quality_rows(report))))
        show_notices_and_warnings(report, console)
    for name, path in _map_files(site).items():
        show_path(name, path, console)
    for report in reports:
        show_path("report", site / "flights" / report["flight"] / "report.html", console)


def _quality_rows(report: JsonView) -> list[tuple[str, str]]:
    """How well frames fit each other and, where the map has metres, the Earth."""
    from sorvolo.missions.flight.report import LEVEL

    residual_px, gps_m = report["residual_px"]["median"], report["gps_residual_m"]["median"]
    base, has_metres = report.get("base"), report["georeferenced"]
    rows = [
        (
            "match error",
            ""
            if residual_px is None
            else f"{residual_px:.2f} px (median distance of matched points)",
        )
    ]
    size = "without scale, north and place on Earth: there was no usable GPS"
    if has_metres:
        placed_by = "GPS fixes"
        if base:
            placed_by = "places on the base map"
        elif report.get("control"):
            placed_by = "control points"
        height_m, sigma_m = report["height_above_ground_m"], report["sigma_m"]
        # without GPS the ground alone gives the height: a wrong unit or scale shows
        by_ground = gps_m is None and height_m is not None
        rows += [
            (
                "flight height",
                f"{height_m:.0f} m above the ground, by the {placed_by} alone" if by_ground else "",
            ),
            ("distance to GPS", "" if gps_m is None else f"{gps_m:.2f} m (median)"),
            (
                "position accuracy",
                ""
                if sigma_m is None
                else f"{sigma_m:.2f} m (1 sigma, including the error shared by all {placed_by})",
            ),
        ]
        resolution_cm = 100 * report["ground_sampling_distance_m"]
        size = f"{report['area_m2']:,.0f} m2, ground resolution {resolution_cm:.2f} cm a pixel"
    moved = base["moved_m"] if base else None
    found = report.get("objects") or {}
    objects = f"not searched: {found['why_not']}" if found.get("why_not") else ""
    if found.get("model") is not None:
        objects = f"{counted_list(found['classes'], none='none')} (model {found['model']})"
    offset = report["time_offset"]
    offsets = [f"{offset['applied_s']:+.2f} s (given)"] if offset["origin"] == "given" else []
    if offset["estimate_s"] is not None:
        unused = "" if offset["origin"] == "estimated" else ", not applied"
        offsets.append(
            f"{offset['estimate_s']:+.2f} s by the motion (1 sigma {offset['sigma_s']:.2f} s){unused}"
        )
    return [
        *rows,
        *_control_rows(report.get("control")),
        (
            "base map",
            escape(
                f"{base['found']:,} of {counted(base['sought'], 'frame')} found on {base['name']}, "
                f"{base['residual_m']:.2f} m off (median)"
                + ("" if moved is None else f", which moved the map by {moved:.2f} m")
            )
            if base
            else "",
        ),
        ("ground", escape(report.get("shape", {}).get("why", LEVEL.why))),
        ("map", size),
        ("ground seen", _seen(report.get("seen")) if has_metres else ""),
        ("objects found", escape(objects)),
        ("clock offset", "; ".join(offsets)),
        (
            "took",
            f"{report['seconds']['total']:.1f} s, memory at most {report['peak_memory_mb']:,.0f} MB",
        ),
    ]


def _seen(seen: JsonView | None) -> str:
    """How much ground one picture alone shows, and what none does."""
    if seen is None or not seen["seen_m2"]:
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


def _control_rows(control: JsonView | None) -> list[tuple[str, str]]:
    """How well the map fits its control points; those left out by name."""
    if control is None:
        return []
    rows = []
    for role, name in (("control", "control points"), ("check", "check points")):
        count = sum(point["role"] == role for point in control["points"])
        rms_m = control[f"{role}_rms_m"]
        rows.append(
            (name, "" if rms_m is None else f"{count}, {rms_m:.3f} m off (root mean square)")
        )
    left_out = ", ".join(escape(label) for label in control["excluded"])
    return [
        *rows,
        (
            "[red]left out[/red]",
            f"{left_out}: contradict the other control points" if left_out else "",
        ),
    ]


def _map_files(site: Path) -> dict[str, Path]:
    from sorvolo.store.exports.plain import features_path

    paths = {
        "picture": site / "preview.png",
        "GeoTIFF": site / "mosaic.tif",
        "KMZ": site / "mosaic.kmz",
        "objects": features_path(site, "objects"),
    }
    return {name: path for name, path in paths.items() if path.is_file()}
