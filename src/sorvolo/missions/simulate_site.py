"""Make a folder of simulated flights with everything that drones leave behind, and the truth beside it."""

import os
import platform
import shutil
import time
from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np

from sorvolo import __version__
from sorvolo.errors import SettingsError
from sorvolo.geometry.geodesy import utm_epsg
from sorvolo.geometry.grid import SiteGrid
from sorvolo.simulation.events import event_features
from sorvolo.simulation.flight import SimulatedFlight, simulate_flights
from sorvolo.simulation.ground import orthophoto_ground
from sorvolo.simulation.settings import GEOID_HEIGHT_M, SimulationSettings
from sorvolo.simulation.truth import (
    change_mask,
    coco_boxes,
    feature_collection,
    frame_features,
    map_tiles,
    object_features,
)
from sorvolo.simulation.world import orthophoto
from sorvolo.store.atomic import writing
from sorvolo.store.flight_files import (
    read_orthophoto,
    video_writer,
    write_camera,
    write_json,
    write_mask,
    write_photo,
    write_telemetry,
)
from sorvolo.store.geotiff import write_cog
from sorvolo.survey.flight import Frame

MARK = "simulation.json"
"""The file that says that a folder is a simulation, and may be replaced by another."""

_SUFFIXES = {"csv": ".csv", "srt": ".srt", "nmea": ".nmea", "gpx": ".gpx"}


@dataclass(frozen=True)
class SimulationProgress:
    """How far the simulation is: `stage` is "site", "frames", "truth" or "done"."""

    stage: str
    flight: str
    frames_done: int
    frames_total: int
    seconds: float


def simulate_site(
    folder: Path,
    settings: SimulationSettings,
    ground_file: Path | None = None,
    ground_m_per_px: float | None = None,
) -> Iterator[SimulationProgress]:
    """Write the flights and their truth to `folder`, which appears whole or not at all.

    `ground_file` is the orthophoto of settings whose ground is "orthophoto". Raises SettingsError for a
    folder that holds anything but an earlier simulation, InputError for an unreadable orthophoto and
    StoreError for a full disk.
    """
    started = time.monotonic()
    folder = folder.resolve()
    _demand_free(folder)
    ground = (
        None if ground_file is None else orthophoto_ground(*read_orthophoto(ground_file, ground_m_per_px))
    )
    partial = folder.with_name(f".{folder.name}.partial")
    with writing(folder):
        _remove_ours(partial)
        partial.mkdir(parents=True)
    write_json(partial / MARK, _description(settings))
    features: list[dict[str, Any]] = []
    yield SimulationProgress("site", "", 0, 0, time.monotonic() - started)
    for flight in simulate_flights(settings, ground):
        for done in _write_flight(flight, partial / flight.name):
            yield SimulationProgress("frames", flight.name, done, len(flight), time.monotonic() - started)
        yield SimulationProgress("truth", flight.name, len(flight), len(flight), time.monotonic() - started)
        features += frame_features(flight)
        _write_truth(flight, partial / "truth")
        if flight.settings.imaging != settings.imaging:
            write_camera(partial / flight.name / "camera.xml", flight.camera)
        if flight.number == 1:
            write_camera(partial / "camera.xml", flight.camera)
            _write_ground(flight, partial / "truth" / "ground.tif")
        write_json(partial / "truth" / "frames.geojson", feature_collection(features, flight.site))
        write_json(
            partial / "truth" / "objects.geojson",
            feature_collection(object_features(flight.world, flight.site), flight.site),
        )
    _put_in_place(partial, folder)
    yield SimulationProgress("done", "", len(features), len(features), time.monotonic() - started)


def _write_flight(flight: SimulatedFlight, folder: Path) -> Iterator[int]:
    """Write pictures and telemetry; yields the number of frames written so far."""
    with writing(folder):
        folder.mkdir()
    _write_telemetry(flight, folder)
    if flight.settings.output.photos:
        with writing(folder):
            (folder / "photos").mkdir()
        rows = _photo_rows(flight)
        for frame in _rendered(flight):
            write_photo(folder / "photos" / frame.name, frame, flight.camera, rows[frame.index])
            yield frame.index + 1
        return
    size_px = flight.camera.width_px, flight.camera.height_px
    imaging, crf = flight.settings.imaging, flight.settings.output.crf
    with video_writer(folder / f"{flight.name}.mp4", size_px, imaging.fps, flight.started_ns, crf) as write:
        for frame in _rendered(flight):
            write(frame.image)
            yield frame.index + 1


def _rendered(flight: SimulatedFlight) -> Iterator[Frame]:
    """The flight's frames in order, a few of them rendered ahead on other cores."""
    workers = min(4, os.cpu_count() or 1)
    waiting: deque[Future[Frame]] = deque()
    with ThreadPoolExecutor(workers) as executor:
        for index in range(len(flight)):
            waiting.append(executor.submit(flight.frame, index))
            if len(waiting) > 2 * workers:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()


def _write_telemetry(flight: SimulatedFlight, folder: Path) -> None:
    """The primary format beside the video under its name, every other format in a folder of its own."""
    formats = flight.settings.output.formats
    for format_name in formats:
        observation = flight.observation(format_name)
        if observation is None:
            continue
        is_primary = format_name == formats[0] and not flight.settings.output.photos
        place = folder if is_primary else folder / "other"
        with writing(place):
            place.mkdir(exist_ok=True)
        telemetry = observation.telemetry
        path = place / f"{flight.name}{_SUFFIXES[format_name]}"
        write_telemetry(path, telemetry, observation.corrupt, GEOID_HEIGHT_M)
        if format_name == "srt" and len(formats) > 1:
            write_telemetry(place / f"{flight.name}_old_dialect.srt", replace(telemetry, format="srt-gps"))


def _photo_rows(flight: SimulatedFlight) -> list[dict[str, float]]:
    observation = flight.observations.get("photos")
    if observation is None:
        return [{} for _ in range(len(flight))]
    columns = observation.telemetry.columns
    return [{name: float(values[index]) for name, values in columns.items()} for index in range(len(flight))]


def _write_truth(flight: SimulatedFlight, folder: Path) -> None:
    sampled = range(0, len(flight), 1 if flight.settings.output.photos else flight.settings.output.truth_step)
    with writing(folder):
        (folder / flight.name).mkdir(parents=True)
    write_json(folder / flight.name / "boxes.json", coco_boxes(flight, sampled))
    if flight.number > 1:
        events = feature_collection(event_features(flight), flight.site)
        write_json(folder / flight.name / "events.geojson", events)
        changes = folder / flight.name / "changes"
        with writing(folder):
            changes.mkdir()
        for index in sampled:
            name = Path(flight.frame_name(index)).stem
            write_mask(changes / f"{name}.png", change_mask(flight, index))


def _write_ground(flight: SimulatedFlight, path: Path) -> None:
    """The first flight's orthophoto in the site's UTM zone, as fine as its pictures."""
    origin = flight.settings.scene.origin
    crs = f"EPSG:{utm_epsg(origin.latitude_deg, origin.longitude_deg)}"
    site_grid = SiteGrid.at(origin, round(flight.settings.m_per_px, 4), crs)
    ground = orthophoto(flight.day).resampled(flight.settings.m_per_px)
    write_cog(map_tiles(ground, site_grid), site_grid, path)


def _description(settings: SimulationSettings) -> dict[str, Any]:
    return {
        "made_by": "sorvolo simulate",
        "versions": {
            "sorvolo": __version__, "python": platform.python_version(), "numpy": np.__version__,
            "opencv": cv2.__version__, "av": av.__version__,
        },
        "settings": asdict(settings),
    }


def _is_ours(folder: Path) -> bool:
    try:
        return '"made_by":"sorvolo simulate"' in (folder / MARK).read_text()
    except (OSError, UnicodeDecodeError):
        return False


def _demand_free(folder: Path) -> None:
    if folder.exists() and not folder.is_dir():
        raise SettingsError(f"{folder} is a file; choose a folder for the simulation")
    if folder.is_dir() and any(folder.iterdir()) and not _is_ours(folder):
        raise SettingsError(
            f"{folder} is not empty and holds no earlier simulation; choose another folder, or empty it"
        )


def _remove_ours(folder: Path) -> None:
    """Delete what a killed simulation left; it wrote its mark first."""
    if folder.is_dir() and (_is_ours(folder) or not any(folder.iterdir())):
        shutil.rmtree(folder)


def _put_in_place(partial: Path, folder: Path) -> None:
    """Rename the finished folder to its place; an earlier simulation steps aside first and goes last."""
    old = folder.with_name(f".{folder.name}.old")
    with writing(folder):
        _remove_ours(old)
        if folder.exists():
            os.replace(folder, old)
        os.replace(partial, folder)
        shutil.rmtree(old, ignore_errors=True)
