"""A simulated dataset in UMCD's layout: Tables 2.1, 2.3 and 2.4 as far as asked for, with the truth that it lacks."""

import json
import os
import shutil
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
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
from sorvolo.store.atomic import atomic_write_bytes, writing
from sorvolo.store.exports.plain import json_bytes, plain_json

MARK = "simulated.json"
_WITH, _WITHOUT = "umcd-telemetry-", "umcd-"
_NMEA_ENDING = {".nmea": ".log"}  # the thesis (2): a text file, such as CSV or LOG


def simulated_dataset(
    place: Path, size: SimulatedSize, settings: ReproductionSettings
) -> Iterator[tuple[str, SimulationProgress]]:
    """Make the dataset in `place`; yields each video's name and how far it is. A video that is there is kept.

    Raises SettingsError for a folder that holds anything but this very dataset, StoreError on a full disk.
    """
    _claim(place, size, settings)
    for name in chosen_presets(size, settings.videos):
        path = _path_of(name)
        if (place / path.last_file).exists():
            continue
        scratch = place / ".partial"
        for step in simulate_site(scratch, simulation_of(name, size, settings)):
            yield name, step
        with writing(place):
            _arrange(scratch, place, path)
            shutil.rmtree(scratch)


def chosen_presets(size: SimulatedSize, videos: int | None) -> list[str]:
    """The presets of the videos to simulate: `videos` of each environment with telemetry, the others by the size."""
    chosen: list[str] = []
    for environment in size.environments:
        for start, most in ((_WITH, videos), (_WITHOUT, size.bare_videos)):
            chosen += [
                name for name in preset_names() if name.startswith(f"{start}{environment.lower()}-")
            ][:most]
    return chosen


def simulation_of(
    name: str, size: SimulatedSize, settings: ReproductionSettings
) -> SimulationSettings:
    """A preset at this size: every video by one camera, as the dataset has one calibration."""
    wanted = preset(name)
    imaging = replace(wanted.imaging, width_px=size.size_px[0], height_px=size.size_px[1])
    length_m = (
        wanted.path.length_m if size.length_m is None else min(size.length_m, wanted.path.length_m)
    )
    step = max(1, round(imaging.fps / settings.views_per_second))
    return replace(
        wanted,
        seed=settings.seed,
        imaging=imaging,
        path=replace(wanted.path, length_m=length_m),
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
    if mark.is_file():
        if json.loads(mark.read_text(encoding="utf-8")) != wanted:
            raise SettingsError(
                f"{place}: holds a simulated dataset of another size or seed; choose another --out"
            )
        return
    if place.exists() and any(place.iterdir()):
        raise SettingsError(
            f"{place}: is not empty and holds no simulated dataset; choose another --out"
        )
    with writing(place):
        place.mkdir(parents=True, exist_ok=True)
    atomic_write_bytes(mark, json_bytes(wanted))


@dataclass(frozen=True)
class _Path:
    """A path that was flown over: once for a map, and where it has telemetry again for the changes."""

    environment: str
    name: str
    has_telemetry: bool

    @property
    def last_file(self) -> Path:
        """What is moved to its place in the dataset last: where it is, the whole path is."""
        if self.has_telemetry:
            return Path(WITH, CHANGES, self.environment, f"{self.name}{MASKS_ENDING}")
        return Path(WITHOUT, MOSAICKING, self.environment, f"{self.name}.mp4")


def _path_of(preset_name: str) -> _Path:
    """Urban, path1, with telemetry: of "umcd-telemetry-urban-path1"."""
    has_telemetry = preset_name.startswith(_WITH)
    environment, _, name = preset_name.removeprefix(_WITH if has_telemetry else _WITHOUT).partition(
        "-"
    )
    return _Path(environment.capitalize(), name, has_telemetry)


def _arrange(made: Path, place: Path, path: _Path) -> None:
    """Move a simulation's files to their places in the dataset."""
    environment = path.environment
    _move(made / "camera.xml", place / CALIBRATION / "camera.xml")
    if not path.has_telemetry:
        _move(made / "flight1" / "flight1.mp4", place / path.last_file)
        return
    for part, flight in ((MOSAICKING, "flight1"), (CHANGES, "flight2")):
        for file in sorted((made / flight).iterdir()):
            ending = _NMEA_ENDING.get(file.suffix, file.suffix)
            if file.is_file() and ending != ".xml":
                _move(file, place / WITH / part / environment / f"{path.name}{ending}")
    objects, boxes = (
        json.loads((made / "truth" / name).read_bytes())
        for name in ("objects.geojson", "flight2/boxes.json")
    )
    fps = preset(f"{_WITH}{environment.lower()}-{path.name}").imaging.fps
    text = umcd_metadata(fps, objects["features"], boxes, flight=2)
    atomic_write_bytes(place / WITH / CHANGES / environment / f"{path.name}.txt", text.encode())
    _move(made / "truth" / "flight2" / "changes", place / path.last_file)


def _move(file: Path, to: Path) -> None:
    to.parent.mkdir(parents=True, exist_ok=True)
    os.replace(file, to)
