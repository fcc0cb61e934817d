"""`sorvolo demo`: from nothing to a map and its changes, with two simulated flights."""

import json
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.progress import BarColumn, SpinnerColumn, TextColumn, TimeRemainingColumn

from sorvolo import __version__
from sorvolo.cli.compare import compare_and_read_results, show_results
from sorvolo.cli.map import map_and_read_reports, show_reports
from sorvolo.cli.progress import bars

if TYPE_CHECKING:
    from sorvolo.simulation.settings import SimulationSettings

_DEFAULT_FOLDER = Path("demo-site")
_FLIGHT = Path("flight1") / "flight1.mp4"
_LATER_FLIGHT = Path("flight2") / "flight2.mp4"


def demo(
    folder: Annotated[
        Path, typer.Argument(help="Folder to make; the demo's own files in it are replaced.")
    ] = _DEFAULT_FOLDER,
) -> None:
    """Simulate two flights over a field, map the first, compare the second, and measure both against the truth.

    Example: sorvolo demo
    """
    from sorvolo.missions.evaluate.changes import evaluate_changes
    from sorvolo.missions.evaluate.mosaic import evaluate_mosaic
    from sorvolo.missions.flight.settings import CompareSettings, MapSettings
    from sorvolo.simulation.presets import preset

    simulation, site = folder / "simulation", folder / "site"
    console = Console()
    settings = preset("demo")
    if _is_simulated(simulation, settings):
        console.print(f"flights of an earlier run: {simulation}", soft_wrap=True, highlight=False)
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
        if not corners.absolute.count:  # without frames by vision there is nothing to say
            continue
        console.print(
            f"Against the truth, the corners of the frames lie {corners.absolute.rms_m:.2f} m off (rms), "
            f"where GPS noise alone costs {corners.floor.rms_m:.2f} m; within the map, which GPS moves as a "
            f"whole, they are {corners.shape.rms_m:.3f} m off."
        )
    later, camera = simulation / _LATER_FLIGHT, simulation / "camera.xml"
    console.print("comparing the second flight with the map")
    results = compare_and_read_results([later], site, CompareSettings(), camera=str(camera))
    show_results(results, site, console)
    for measured in evaluate_changes(site, simulation):
        if measured.events is not None:
            events = measured.events
            console.print(
                f"Against the truth, {events.found} of {events.must_find} changes that had to be found were found; "
                f"{events.false} false ones were told."
            )
    console.print("Next, judge the changes, or map a flight of your own:")
    for command in (
        f"sorvolo review {site}",
        f"sorvolo history {site}",
        "sorvolo map MY_VIDEO.MP4 --site my-site",
    ):
        console.print(f"  {command}", soft_wrap=True, highlight=False, markup=False)


def _simulate(folder: Path, settings: "SimulationSettings") -> None:
    from sorvolo.missions.simulate.site import simulate_site

    columns = (
        SpinnerColumn(), TextColumn("{task.description}"), BarColumn(bar_width=30), TimeRemainingColumn()
    )
    with bars(*columns, console=Console(stderr=True)) as progress:
        task = progress.add_task("the site", total=None)
        for step in simulate_site(folder, settings):
            if step.stage == "frames":
                progress.update(
                    task, description=step.flight, completed=step.frames_done, total=step.frames_total
                )


def _is_simulated(folder: Path, settings: "SimulationSettings") -> bool:
    """Whether an earlier run of this version left the very flights that are wanted."""
    from sorvolo.missions.simulate.folder import MARK
    from sorvolo.store.exports.plain import plain_json

    try:
        told = json.loads((folder / MARK).read_text(encoding="utf-8"))
        same = told["settings"] == plain_json(asdict(settings)) and told["versions"]["sorvolo"] == __version__
    except (OSError, ValueError, KeyError, TypeError):
        return False
    return bool(same) and (folder / _FLIGHT).is_file()
