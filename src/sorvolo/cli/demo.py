"""`sorvolo demo`: from nothing to a map and its changes, with two simulated flights."""

import json
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console

from sorvolo import __version__
from sorvolo.cli.compare import compare_and_read_results, show_results
from sorvolo.cli.map import map_and_read_reports, show_reports
from sorvolo.cli.progress import ProgressReport
from sorvolo.survey.wording import counted

if TYPE_CHECKING:
    from sorvolo.lab.simulation.settings import SimulationSettings

_DEFAULT_FOLDER = Path("demo-site")
_FLIGHT = Path("flight1") / "flight1.mp4"
_LATER_FLIGHT = Path("flight2") / "flight2.mp4"


def demo(
    folder: Annotated[
        Path, typer.Argument(help="Folder to make; an earlier demo in it is replaced.")
    ] = _DEFAULT_FOLDER,
) -> None:
    """Try everything: simulate two flights, map the first, compare the second, and check both against the truth.

    Example: sorvolo demo
    """
    from sorvolo.lab.evaluation.changes import evaluate_changes
    from sorvolo.lab.evaluation.mosaic import evaluate_mosaic
    from sorvolo.lab.simulation.presets import preset
    from sorvolo.missions.flight.settings import CompareSettings, MapSettings

    simulation, site = folder / "simulation", folder / "site"
    console = Console()
    settings = preset("demo")
    if _is_simulated(simulation, settings):
        console.print(
            f"using the flights of an earlier demo: {simulation}", soft_wrap=True, highlight=False
        )
    else:
        console.print(f"simulating two flights: {simulation}", soft_wrap=True, highlight=False)
        _simulate(simulation, settings)
    console.print("mapping the first flight")
    reports = map_and_read_reports(
        [simulation / _FLIGHT], site, MapSettings(), camera=str(simulation / "camera.xml")
    )
    show_reports(reports, site, console)
    for truth in evaluate_mosaic(site, truth=simulation).truth[:1]:
        corners = truth.corners
        if not corners.absolute.count:  # no frame was matched
            continue
        console.print(
            f"Checked against the truth: the frames lie {corners.absolute.rms_m:.2f} m off (rms). GPS noise alone "
            f"would cost {corners.floor.rms_m:.2f} m; relative to each other they lie {corners.shape.rms_m:.3f} m off."
        )
    later, camera = simulation / _LATER_FLIGHT, simulation / "camera.xml"
    console.print("comparing the second flight with the map")
    results = compare_and_read_results([later], site, CompareSettings(), camera=str(camera))
    show_results(results, site, console)
    for measured in evaluate_changes(site, simulation):
        if measured.events is not None:
            events = measured.events
            console.print(
                f"Checked against the truth: {events.found} of {events.must_find} changes found, "
                f"{counted(events.false, 'false change')} reported."
            )
    for line in _next_steps(folder, site):
        console.print(line, soft_wrap=True, highlight=False, markup=False)


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


def _simulate(folder: Path, settings: "SimulationSettings") -> None:
    from sorvolo.lab.simulate.site import simulate_site

    with ProgressReport(Console(stderr=True)) as progress:
        progress.show("simulating the site")
        for step in simulate_site(folder, settings):
            if step.stage == "frames":
                progress.show(
                    f"simulating {step.flight}, frame", step.frames_done, step.frames_total
                )


def _is_simulated(folder: Path, settings: "SimulationSettings") -> bool:
    """Whether an earlier run of this version left the very flights that are wanted."""
    from sorvolo.lab.simulate.simulation_folder import MARK
    from sorvolo.store.exports.plain import plain_json

    try:
        mark = json.loads((folder / MARK).read_text(encoding="utf-8"))
        same = (
            mark["settings"] == plain_json(asdict(settings))
            and mark["versions"]["sorvolo"] == __version__
        )
    except (OSError, ValueError, KeyError, TypeError):
        return False
    return bool(same) and (folder / _FLIGHT).is_file()
