"""A simulated dataset in UMCD's layout: Tables 2.1, 2.3 and 2.4 as far as asked for, with the truth that it lacks."""

import json
import os
import shutil
from collections.abc import Iterator
from dataclasses import asdict, replace
from pathlib import Path

from sorvolo.errors import SettingsError
from sorvolo.lab.simulation.presets import preset, preset_names
from sorvolo.lab.simulation.settings import SimulationSettings
from sorvolo.lab.simulation.site import SimulationProgress, simulate_site
from sorvolo.lab.thesis.settings import ReproductionSettings, SimulatedSize
from sorvolo.lab.thesis.umcd_folder import (
    CALIBRATION,
    CHANGES,
    MASKS_ENDING,
    MOSAICKING,
    WITH,
    WITHOUT,
)
from sorvolo.lab.thesis.umcd_writing import umcd_metadata
from sorvolo.store.atomic import atomic_write_bytes, make_folder, writing
from sorvolo.store.exports.plain import json_bytes, plain_json

MARK = "simulated.json"
_WITH, _WITHOUT = "umcd-telemetry-", "umcd-"


def simulated_dataset(
    place: Path, size: SimulatedSize, settings: ReproductionSettings
) -> Iterator[tuple[str, SimulationProgress]]:
    """Make the dataset in `place`; yields each video's name and how far it is. A video that is there is kept.

    Raises SettingsError for a folder that holds anything but this very dataset, StoreError on a full disk.
    """
    _claim(place, size, settings)
    # the presets of the videos to simulate: `videos` of each environment with telemetry,
    # the others by the size
    chosen: list[str] = []
    for environment in size.environments:
        for start, most in ((_WITH, settings.videos), (_WITHOUT, size.bare_videos)):
            chosen += [
                name for name in preset_names() if name.startswith(f"{start}{environment.lower()}-")
            ][:most]
    for name in chosen:
        if (place / _places_of(name)[2]).exists():
            continue
        scratch = place / ".partial"
        for step in simulate_site(scratch, simulation_of(name, size, settings)):
            yield name, step
        with writing(place):
            _arrange(scratch, place, name)
            shutil.rmtree(scratch)


def simulation_of(
    name: str, size: SimulatedSize, settings: ReproductionSettings
) -> SimulationSettings:
    """A preset at this size: every video by one camera, as the dataset has one calibration."""
    wanted = preset(name)
    imaging = replace(wanted.imaging, width_px=size.size_px[0], height_px=size.size_px[1])
    step = max(1, round(imaging.fps / settings.views_per_second))
    return replace(
        wanted,
        seed=settings.seed,
        imaging=imaging,
        path=replace(wanted.path, length_m=min(size.length_m, wanted.path.length_m)),
        output=replace(wanted.output, truth_step=step),
    )


def _claim(place: Path, size: SimulatedSize, settings: ReproductionSettings) -> None:
    wanted = plain_json(
        {
            "made_by": "sorvolo reproduce --simulated",
            "seed": settings.seed,
            "views_per_second": settings.views_per_second,
            **asdict(size),
        }
    )
    mark = place / MARK
    if mark.is_file() and json.loads(mark.read_bytes()) == wanted:
        return
    if place.exists() and any(place.iterdir()):
        raise SettingsError(
            f"{place}: holds other files, or a simulated dataset of another size or seed; choose another --out"
        )
    make_folder(place)
    atomic_write_bytes(mark, json_bytes(wanted))


def _places_of(preset_name: str) -> tuple[str, str, Path]:
    """Environment, path, and what is moved to its place last: where it is, the whole path is.

    Urban, path1 and its masks of "umcd-telemetry-urban-path1"; the video where there is no telemetry.
    """
    has_telemetry = preset_name.startswith(_WITH)
    bare = preset_name.removeprefix(_WITH if has_telemetry else _WITHOUT)
    environment, _, name = bare.partition("-")
    environment = environment.capitalize()
    masks = Path(WITH, CHANGES, environment, f"{name}{MASKS_ENDING}")
    video = Path(WITHOUT, MOSAICKING, environment, f"{name}.mp4")
    return environment, name, masks if has_telemetry else video


def _arrange(made: Path, place: Path, preset_name: str) -> None:
    """Move a simulation's files to their places in the dataset."""
    environment, name, last = _places_of(preset_name)
    _move(made / "camera.xml", place / CALIBRATION / "camera.xml")
    if not preset_name.startswith(_WITH):
        _move(made / "flight1" / "flight1.mp4", place / last)
        return
    for part, flight in ((MOSAICKING, "flight1"), (CHANGES, "flight2")):
        for file in sorted((made / flight).iterdir()):
            # the thesis (2): a text file, such as CSV or LOG
            ending = file.suffix.replace(".nmea", ".log")
            if file.is_file() and ending != ".xml":
                _move(file, place / WITH / part / environment / f"{name}{ending}")
    objects, boxes = (
        json.loads((made / "truth" / file).read_bytes())
        for file in ("objects.geojson", "flight2/boxes.json")
    )
    text = umcd_metadata(preset(preset_name).imaging.fps, objects["features"], boxes, flight=2)
    atomic_write_bytes(place / WITH / CHANGES / environment / f"{name}.txt", text.encode())
    _move(made / "truth" / "flight2" / "changes", place / last)


def _move(file: Path, to: Path) -> None:
    to.parent.mkdir(parents=True, exist_ok=True)
    os.replace(file, to)
