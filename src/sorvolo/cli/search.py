"""`sorvolo search`: what a flight's search would have found, measured, and where it could not see."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape
from rich.table import Table

from sorvolo.cli.options import (
    Area,
    AsJson,
    Camera,
    Classes,
    DjiDrone,
    GiveUp,
    Model,
    Refly,
    ResultsFolder,
    SiteOption,
    Telemetry,
    argument,
    option,
    wanted_classes,
)
from sorvolo.cli.pdf import Pdf, write_pdfs
from sorvolo.cli.printing import (
    TO_CHECK,
    Console,
    announce_people,
    announce_person,
    print_json,
    read_json,
    show_notices_and_warnings,
    show_path,
)
from sorvolo.cli.progress import ProgressReport, show_progress
from sorvolo.cli.sites import ended_by_signal, opened_site, run_on_site
from sorvolo.errors import SettingsError
from sorvolo.paths import Json, JsonView

if TYPE_CHECKING:
    from sorvolo.cli.sites import OpenedSite
    from sorvolo.missions.search.settings import SearchOutputs, SearchSettings

Flights = Annotated[
    list[str] | None,
    option("Flight to measure. Can be repeated.", show_default="all flights of the map"),
]
Segments = Annotated[
    Path | None,
    option("Segments as GeoJSON polygons with the property poa (probability of area)."),
]
Plants = Annotated[int, option("People, and cars, to plant: more take longer and are surer.")]
Plant = Annotated[
    list[Path] | None,
    option(
        "Photos or a video of a person from straight above, or cut-outs with transparency, to plant in place of "
        "drawn people. Can be repeated."
    ),
]
PlantCm = Annotated[
    float | None,
    option("Centimetres of ground that a pixel of --plant covers.", show_default="by its height"),
]
Enough = Annotated[float, option("Ground with a lower probability is a hole.")]
ThroughTrees = Annotated[
    bool,
    option(
        "Look for people below crowns: put all pictures together on the forest floor, in place of measuring.",
        "--through-trees",
    ),
]


def search_command(
    inputs: Annotated[
        list[str],
        argument(
            "The folder of a map, or s3://BUCKET/NAME; or flights (videos, photos, a live source) to map into --site."
        ),
    ],
    site: SiteOption = "",
    flight: Flights = None,
    area: Area = None,
    poa: Segments = None,
    model: Model = "default",
    classes: Classes = None,
    plants: Plants = 80,
    plant: Plant = None,
    plant_cm: PlantCm = None,
    enough: Enough = 0.5,
    through_trees: ThroughTrees = False,
    refly: Refly = None,
    dji_drone: DjiDrone = "fly",
    out: ResultsFolder = None,
    telemetry: Telemetry = None,
    camera: Camera = "",
    give_up: GiveUp = 30.0,
    pdf: Pdf = False,
    as_json: AsJson = False,
) -> None:
    """Measure what a search would have found: "had a person lain here, would we have seen them?"

    People and cars are drawn into the flight's own frames, the detector searches them, and the share that a map would
    report becomes a map of the probability of detection. Ends with exit code 3 where part of the area was not seen well
    enough; the first line states why. A live source is measured while it flies: the page, the files and the waypoints
    show what would have been found so far, and where it has yet to look.

    Example: sorvolo search field --area search-area.kml --refly holes.kml

    Example: sorvolo search field --plant our-volunteer/

    Example: sorvolo search forest --through-trees

    Example: sorvolo search DJI_0042.MP4 --site field --poa segments.geojson

    Example: sorvolo search rtsp://192.168.1.10/live --site field --area search-area.kml --refly holes.kml
    """
    from sorvolo.missions.search.flights import search_site
    from sorvolo.missions.search.settings import SearchOutputs, SearchSettings

    if not site and (camera or telemetry):
        option = "--camera" if camera else "--telemetry"
        raise SettingsError(
            f"{option} is for flights that are mapped now; give --site FOLDER, or leave it out"
        )
    if through_trees and (site or len(flight or ()) > 1):
        raise SettingsError(
            "--through-trees looks at one mapped flight; give the map's folder and one --flight"
        )
    measured = {"--area": area, "--poa": poa, "--refly": refly, "--classes": classes}
    measured |= {"--plant": plant}
    if through_trees and (unused := [name for name, value in measured.items() if value]):
        raise SettingsError(
            f"{', '.join(unused)}: --through-trees looks below all that the flight saw, and measures nothing; leave it out"
        )
    settings = SearchSettings(plants, wanted_classes(classes), model, enough)
    with opened_site(site or _map_of(inputs), writes=bool(site) or through_trees) as place:
        outputs = SearchOutputs(
            out or place.results("search"),
            area,
            poa,
            tuple(flight or ()),
            tuple(refly or ()),
            dji_drone,
            tuple(plant or ()),
            plant_cm,
        )
        if site:
            if flight:
                raise SettingsError(
                    "--flight names flights that the map has; flights that are mapped now are measured"
                )
            _map_all(inputs, place, settings, outputs, telemetry, camera, give_up)
        if through_trees:
            report: JsonView = _look_through_trees(place, outputs, plants)
        else:
            measuring = search_site(place.folder, settings, outputs)
            with ProgressReport(Console(stderr=True)) as progress, measuring:
                for update in measuring:
                    progress.show(
                        f"searching planted pictures of {update.flight},",
                        update.done,
                        update.total,
                        f"{update.found} of {update.planted} found" if update.planted else "",
                    )
                report = measuring.result().report
    if as_json:
        print_json({"folder": str(outputs.folder), **report})
    elif through_trees:
        _show_under_trees(report, outputs.folder, Console())
    else:
        _show(report, outputs.folder, outputs.refly, Console())
    if pdf:
        page = "under_trees.html" if through_trees else "search.html"
        write_pdfs([outputs.folder / page], Console(stderr=as_json))
    if not report["headline"]["complete"]:
        raise typer.Exit(TO_CHECK)


def _look_through_trees(place: "OpenedSite", outputs: "SearchOutputs", plants: int) -> Json:
    from sorvolo.missions.search.through_trees import search_under_trees

    flight = outputs.flights[0] if outputs.flights else ""
    looking = search_under_trees(place.folder, outputs.folder, flight=flight, plants=plants)
    with ProgressReport(Console(stderr=True)) as progress, looking:
        for update in looking:
            progress.show(
                f"under the trees of {update.flight}: {update.stage},", update.number, update.total
            )
        return looking.result()


def _show_under_trees(report: JsonView, folder: Path, console: Console) -> None:
    console.print(escape(report["headline"]["text"]), style="bold", soft_wrap=True)
    for row in report["people"]:
        where = f"{row['latitude_deg']:.6f}, {row['longitude_deg']:.6f}"
        pictures = ", ".join(row["pictures"])
        announce_person(f"{where}  {row['anomaly']:.0f} sigmas, see {pictures}", console)
    show_notices_and_warnings(report, console)
    for name, file in (
        ("page", "under_trees.html"),
        ("GeoTIFF", "under_trees.tif"),
        ("places", "under_trees.geojson"),
    ):
        show_path(name, folder / file, console)


def _map_all(
    inputs: Sequence[str],
    place: "OpenedSite",
    settings: "SearchSettings",
    outputs: "SearchOutputs",
    telemetry: str | None,
    camera: str,
    give_up_s: float,
) -> None:
    """Map the flights; a live one is measured meanwhile."""
    from sorvolo.capture.live.addresses import is_live_address
    from sorvolo.capture.live.reconnect import LiveSettings
    from sorvolo.capture.source import demand_inputs
    from sorvolo.missions.flight.settings import MapSettings
    from sorvolo.missions.map.flights import map_flights
    from sorvolo.missions.search.prepare import check_area_of, prepare_search
    from sorvolo.missions.search.while_flying import SearchWhileFlying

    demand_inputs(inputs)
    flying, console = None, Console(stderr=True)
    if live := sum(is_live_address(address) for address in inputs):
        if live > 1:
            raise SettingsError(
                f"one live flight is measured while it is on, not {live}; search them one by one"
            )
        flying = SearchWhileFlying(settings, outputs)
        area = flying.area
        show_path("page, once the flight is on", outputs.folder / "search.html", console)
    else:
        # mapping takes long: what cannot be used is refused before
        area = prepare_search(settings, outputs).area
    check_area_of(place.folder, area)
    with ended_by_signal(inputs) as until:
        mapping = map_flights(
            list(inputs),
            place.folder,
            MapSettings(model=settings.model),
            telemetry=telemetry,
            camera=camera or None,
            live=LiveSettings(keeps_all=True, give_up_s=give_up_s),
            until=until,
            search=flying,
        )
        mapped = run_on_site(mapping, place, lambda rows: show_progress(rows, console), "mapped")
    for folder in mapped:
        announce_people(read_json(folder / "report.json"), place.folder, console)


def _map_of(inputs: Sequence[str]) -> str:
    """Return the only input if it is a map; raise SettingsError for anything else."""
    if len(inputs) == 1 and ("://" in inputs[0] or Path(inputs[0]).is_dir()):
        return inputs[0]
    if len(inputs) > 1:
        found = f"{len(inputs)} inputs"
    else:
        found = f"{inputs[0]} is a file" if Path(inputs[0]).exists() else f"there is no {inputs[0]}"
    raise SettingsError(
        f"{found}; give the folder of a map, or flights and --site FOLDER to map them into"
    )


def _show(report: JsonView, folder: Path, refly: tuple[Path, ...], console: Console) -> None:
    text = report["headline"]["text"]
    console.print(escape(text[:1].upper() + text[1:]), style="bold", soft_wrap=True)
    table = Table("class", "POD", "90 % interval", "area", "seen", "sweep width", "coverage")
    for label, row in report["classes"].items():
        width = "" if row["sweep_width_m"] is None else f"{row['sweep_width_m']:.1f} m"
        table.add_row(
            escape(label),
            f"{row['pod']:.2f}",
            f"{row['pod_low']:.2f} to {row['pod_high']:.2f}",
            f"{row['area_m2']:,.0f} m2",
            f"{row['seen_m2']:,.0f} m2",
            width,
            f"{row['coverage']:.2f}",
        )
    console.print(table)
    if report["segments"]:
        segments = Table("segment", "POA", "POD", "POS", "left")
        for segment in report["segments"]:
            segments.add_row(
                escape(segment["name"]),
                *(f"{segment[key]:.2f}" for key in ("poa", "pod", "pos", "left")),
            )
        console.print(segments)
    show_notices_and_warnings(report, console)
    for name, file in (("page", "search.html"), ("GeoTIFF", "pod.tif"), ("areas", "pod.geojson")):
        show_path(name, folder / file, console)
    for path in refly if report["refly"] else ():
        show_path("re-fly", path, console)
