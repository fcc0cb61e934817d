"""`sorvolo simulate` and `sorvolo demo`: flights over a synthetic site whose truth is known."""

import json
from collections.abc import Iterator
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sorvolo import __version__
from sorvolo.cli.compare import read_results, show_results
from sorvolo.cli.map import show_reports
from sorvolo.cli.options import AsJson, FlightHeight, Seed, argument, option
from sorvolo.cli.printing import Console, read_json
from sorvolo.cli.progress import ProgressReport, show_progress
from sorvolo.cli.sites import opened_site, run_on_site
from sorvolo.errors import SettingsError
from sorvolo.survey.wording import counted

if TYPE_CHECKING:
    from sorvolo.lab.simulation.settings import SimulationSettings
    from sorvolo.lab.simulation.site import SimulationProgress

PresetName = Annotated[
    str,
    option("What to simulate: demo, survey, compare ...; an unknown name lists all.", "--preset"),
]
Ground = Annotated[str, option("Ground: dirt, countryside, urban, sand, or an orthophoto's file.")]
GroundResolution = Annotated[
    float | None, option("Ground resolution of an orthophoto without a CRS, m a pixel.")
]
ReliefHeight = Annotated[
    float | None,
    option("Hills, from the lowest to the highest ground, m.", "--relief", show_default="level"),
]
FlightCount = Annotated[int | None, option("Number of flights; between them things change.")]
TelemetryFormat = Annotated[str, option("Telemetry format: csv, srt, nmea, gpx, all or none.")]
StripLength = Annotated[float | None, option("Length of a strip, m.")]
StripCount = Annotated[int | None, option("Number of strips.")]
AsPhotos = Annotated[bool, option("Write geo-tagged JPEG photos instead of a video.", "--photos")]
PictureCount = Annotated[
    int | None,
    option("Make this many single labelled pictures (COCO) of different sites instead of flights."),
]
ThermalShare = Annotated[float, option("With --pictures: share of thermal pictures, 0 to 1.")]


def simulate(
    folder: Annotated[Path, argument("Folder to make; an earlier simulation in it is replaced.")],
    preset: PresetName = "",
    seed: Seed = None,
    ground: Ground = "",
    ground_gsd: GroundResolution = None,
    relief: ReliefHeight = None,
    flights: FlightCount = None,
    telemetry: TelemetryFormat = "",
    height: FlightHeight = None,
    length: StripLength = None,
    strips: StripCount = None,
    photos: AsPhotos = False,
    pictures: PictureCount = None,
    thermal: ThermalShare = 0.0,
    as_json: AsJson = False,
) -> None:
    """Simulate flights: video or photos, telemetry, and the truth about every frame and object.

    Example: sorvolo simulate demo-site --preset demo

    Example: sorvolo simulate town --preset survey --ground urban --photos --telemetry all

    Example: sorvolo simulate labelled --pictures 500 --thermal 0.3 --seed 7
    """
    from sorvolo.lab.simulation.ground import GroundKind
    from sorvolo.lab.simulation.presets import preset as preset_named

    ground_file = None if not ground or ground in list(GroundKind) else Path(ground)
    if ground_file is not None and not ground_file.exists():
        raise SettingsError(f"--ground {ground}: no such file, and none of {', '.join(GroundKind)}")
    kind = ground if ground_file is None else "orthophoto"
    if pictures is None and thermal:
        raise SettingsError(
            "--thermal is for single pictures: give their number with --pictures as well"
        )
    if pictures is None:
        settings = _changed(
            preset_named(preset or "demo"),
            {"seed": seed, "flights": flights},
            scene={"ground": kind or None, "relief_m": relief},
            path={"height_m": height, "length_m": length, "strips": strips},
            output={"telemetry": telemetry or None, "photos": photos or None},
        )
        _simulate_flights(folder, settings, ground_file, ground_gsd, as_json=as_json)
        return
    of_flights = {
        "--preset": preset,
        "--relief": relief,
        "--flights": flights,
        "--telemetry": telemetry,
        "--length": length,
        "--strips": strips,
        "--photos": photos,
        "--ground-gsd": ground_gsd,
        f"--ground {ground_file}": ground_file,
    }
    # 0 is a value that was given
    if given := [
        name
        for name, value in of_flights.items()
        if value is not None and value is not False and value != ""
    ]:
        raise SettingsError(
            f"--pictures makes single pictures, not flights: leave out {', '.join(given)}"
        )
    from sorvolo.lab.simulation.pictures import PictureSettings, simulate_pictures

    asked = PictureSettings(pictures, 1 if seed is None else seed, ground, thermal)
    if height is not None:
        asked = replace(asked, height_m=(height, height))
    last = None
    with ProgressReport(Console(stderr=True), stays=True) as progress:
        for last in simulate_pictures(folder, asked):
            progress.show("simulating pictures", last.pictures_done, asked.pictures)
    if last is not None and as_json:
        typer.echo(json.dumps(asdict(last)))
    elif last is not None:
        words = f"{counted(last.pictures_done, 'picture')} with {counted(last.boxes, 'box')}"
        Console().print(f"{words} in {last.seconds:.0f} s: {folder}", soft_wrap=True)


def _changed(
    settings: "SimulationSettings", top: dict[str, Any], **parts: dict[str, Any]
) -> "SimulationSettings":
    """Return the settings with every option that was given; None was not."""
    for name, options in parts.items():
        given = {key: value for key, value in options.items() if value is not None}
        settings = replace(settings, **{name: replace(getattr(settings, name), **given)})
    return replace(settings, **{key: value for key, value in top.items() if value is not None})


def _simulate_flights(
    folder: Path,
    settings: "SimulationSettings",
    ground_file: Path | None,
    ground_gsd: float | None,
    *,
    as_json: bool,
) -> None:
    from sorvolo.lab.simulation.site import simulate_site

    steps = simulate_site(folder, settings, ground_file, ground_gsd)
    if as_json:
        for step in steps:
            if step.stage != "frames" or step.frames_done == step.frames_total:
                typer.echo(json.dumps(asdict(step)))
        return
    console = Console()
    last = _show_progress(steps, stays=True)
    if last is not None:
        console.print(
            f"{counted(last.frames_done, 'frame')} in {last.seconds:.0f} s: {folder}\n"
            f"the truth is in {folder / 'truth'}; the camera is in {folder / 'camera.xml'}",
            soft_wrap=True,
        )


def _show_progress(
    steps: "Iterator[SimulationProgress]", *, stays: bool = False
) -> "SimulationProgress | None":
    """Take all steps, showing progress; return the last."""
    last = None
    with ProgressReport(Console(stderr=True), stays=stays) as progress:
        progress.show("simulating the site")
        for last in steps:
            if last.stage == "frames":
                progress.show(
                    f"simulating {last.flight}, frame", last.frames_done, last.frames_total
                )
    return last


def demo(
    folder: Annotated[Path, argument("Folder to make; an earlier demo in it is replaced.")] = Path(
        "demo-site"
    ),
) -> None:
    """Try everything: simulate two flights, map the first, compare the second, and check both against the truth.

    Example: sorvolo demo
    """
    from sorvolo.lab.evaluation.changes import evaluate_changes
    from sorvolo.lab.evaluation.mosaic import evaluate_mosaic
    from sorvolo.lab.simulation.presets import preset
    from sorvolo.lab.simulation.site import simulate_site
    from sorvolo.missions.compare.flights import compare_flights
    from sorvolo.missions.map.flights import map_flights

    simulation, site = folder / "simulation", folder / "site"
    console, errors = Console(), Console(stderr=True)
    settings = preset("demo")
    if _is_simulated(simulation, settings):
        console.print(f"using the flights of an earlier demo: {simulation}", soft_wrap=True)
    else:
        console.print(f"simulating two flights: {simulation}", soft_wrap=True)
        _show_progress(simulate_site(simulation, settings))
    console.print("mapping the first flight")
    with opened_site(str(site), writes=True) as place:
        mapping = map_flights([simulation / "flight1" / "flight1.mp4"], site)
        folders = run_on_site(
            mapping, place, lambda updates: show_progress(updates, errors), "mapped"
        )
        show_reports([read_json(made / "report.json") for made in folders], site, console)
        for truth in evaluate_mosaic(site, truth=simulation).truth[:1]:
            corners = truth.corners
            if not corners.absolute.count:  # no frame was matched
                continue
            console.print(
                f"Checked against the truth: the frames lie {corners.absolute.rms_m:.2f} m off (rms). GPS noise alone "
                f"would cost {corners.floor.rms_m:.2f} m; relative to each other they lie {corners.shape.rms_m:.3f} m off."
            )
        console.print("comparing the second flight with the map")
        comparing = compare_flights([simulation / "flight2" / "flight2.mp4"], site)
        show_results(read_results(comparing, place), site, console)
    for measured in evaluate_changes(site, simulation):
        if measured.events is not None:
            events = measured.events
            console.print(
                f"Checked against the truth: {events.found} of {events.must_find} changes found, "
                f"{counted(events.false, 'false change')} reported."
            )
    for line in _next_steps(folder, site):
        console.print(line, soft_wrap=True, markup=False)


def _next_steps(folder: Path, site: Path) -> list[str]:
    """What to do with the demo's site; the last lines state where a browser shows it."""
    from sorvolo.station.settings import StationSettings

    return [
        "Next, review the changes, or map a flight of your own:",
        f"  sorvolo review {site}",
        f"  sorvolo history {site}",
        "  sorvolo map MY_VIDEO.MP4 --site my-site",
        f"Or see both flights in a browser, at {StationSettings(folder).address}:",
        f"  sorvolo serve {folder} --open",
    ]


def _is_simulated(folder: Path, settings: "SimulationSettings") -> bool:
    """Whether an earlier run of this version left the very flights that are wanted."""
    from sorvolo.lab.simulation.flight_files import MARK
    from sorvolo.store.exports.plain import plain_json

    try:
        mark = json.loads((folder / MARK).read_text(encoding="utf-8"))
        same = (
            mark["settings"] == plain_json(asdict(settings))
            and mark["versions"]["sorvolo"] == __version__
        )
    except (OSError, ValueError, KeyError, TypeError):
        return False
    return bool(same) and (folder / "flight1" / "flight1.mp4").is_file()
