"""Make a folder of simulated flights with everything that drones leave behind, and the truth beside it."""

import os
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from sorvolo.geometry.geodesy import utm_epsg
from sorvolo.geometry.grid import SiteGrid
from sorvolo.lab.simulation.flight import SimulatedFlight, simulate_flights
from sorvolo.lab.simulation.flight_files import (
    MARK,
    read_orthophoto,
    simulation_description,
    simulation_folder,
    video_writer,
    write_camera,
    write_json,
    write_mask,
    write_photo,
    write_telemetry,
)
from sorvolo.lab.simulation.ground import orthophoto_ground
from sorvolo.lab.simulation.settings import GEOID_HEIGHT_M, SimulationSettings
from sorvolo.lab.simulation.truth import (
    change_mask,
    coco_boxes,
    event_features,
    feature_collection,
    frame_features,
    map_tiles,
    object_features,
)
from sorvolo.lab.simulation.world import orthophoto
from sorvolo.paths import AnyPath, as_path
from sorvolo.store.ahead import in_order
from sorvolo.store.atomic import make_folder, writing
from sorvolo.store.rasters.geotiff import write_cog

_CRF = 20  # x264's quality, lower is better; by choice
_THREADS = min(4, os.cpu_count() or 1)  # each holds a frame that is drawn, of tens of megabytes
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
    folder: AnyPath,
    settings: SimulationSettings,
    ground_file: AnyPath | None = None,
    ground_m_per_px: float | None = None,
) -> Iterator[SimulationProgress]:
    """Write the flights and their truth to `folder`, which appears whole or not at all.

    `ground_file` is the orthophoto of settings whose ground is "orthophoto". Raises SettingsError for a
    folder that holds anything but an earlier simulation, InputError for an unreadable orthophoto and
    StoreError for a full disk.
    """
    folder = Path(folder)
    ground_file = as_path(ground_file)
    started = time.monotonic()
    ground = (
        None
        if ground_file is None
        else orthophoto_ground(*read_orthophoto(ground_file, ground_m_per_px))
    )
    features: list[dict[str, Any]] = []
    with simulation_folder(folder, MARK, simulation_description(asdict(settings))) as partial:
        yield SimulationProgress("site", "", 0, 0, time.monotonic() - started)
        for flight in simulate_flights(settings, ground):
            for done in _write_flight(flight, partial / flight.name):
                yield SimulationProgress(
                    "frames", flight.name, done, len(flight), time.monotonic() - started
                )
            yield SimulationProgress(
                "truth", flight.name, len(flight), len(flight), time.monotonic() - started
            )
            features += frame_features(flight)
            _write_truth(flight, partial / "truth")
            write_camera(partial / flight.name / "camera.xml", flight.camera)
            if flight.number == 1:
                write_camera(partial / "camera.xml", flight.camera)
                _write_ground(flight, partial / "truth" / "ground.tif")
            write_json(
                partial / "truth" / "frames.geojson", feature_collection(features, flight.site)
            )
            write_json(
                partial / "truth" / "objects.geojson",
                feature_collection(object_features(flight.world, flight.site), flight.site),
            )
    yield SimulationProgress("done", "", len(features), len(features), time.monotonic() - started)


def _write_flight(flight: SimulatedFlight, folder: Path) -> Iterator[int]:
    """Write pictures and telemetry; yields the number of frames written so far."""
    with writing(folder):
        folder.mkdir()
    # The primary format beside the video under its name, every other format in a folder of its own
    formats = flight.settings.output.formats
    for format_name in formats:
        observation = flight.observation(format_name)
        if observation is None:
            continue
        is_primary = format_name == formats[0] and not flight.settings.output.photos
        place = folder if is_primary else folder / "other"
        make_folder(place)
        telemetry = observation.telemetry
        path = place / f"{flight.name}{_SUFFIXES[format_name]}"
        write_telemetry(path, telemetry, observation.corrupt, GEOID_HEIGHT_M)
        if format_name == "srt" and len(formats) > 1:
            write_telemetry(
                place / f"{flight.name}_old_dialect.srt", replace(telemetry, format="srt-gps")
            )
    if flight.settings.output.photos:
        with writing(folder):
            (folder / "photos").mkdir()
        rows = _photo_rows(flight)
        for frame in in_order(flight.frame, range(len(flight)), threads=_THREADS):
            write_photo(folder / "photos" / frame.name, frame, flight.camera, rows[frame.index])
            yield frame.index + 1
        return
    size_px = flight.camera.width_px, flight.camera.height_px
    with video_writer(
        folder / f"{flight.name}.mp4", size_px, flight.settings.imaging.fps, flight.started_ns, _CRF
    ) as write:
        for frame in in_order(flight.frame, range(len(flight)), threads=_THREADS):
            write(frame.image)
            yield frame.index + 1


def _photo_rows(flight: SimulatedFlight) -> list[dict[str, float]]:
    observation = flight.observations.get("photos")
    if observation is None:
        return [{} for _ in range(len(flight))]
    columns = observation.telemetry.columns
    return [
        {name: float(values[index]) for name, values in columns.items()}
        for index in range(len(flight))
    ]


def _write_truth(flight: SimulatedFlight, folder: Path) -> None:
    sampled = range(
        0, len(flight), 1 if flight.settings.output.photos else flight.settings.output.truth_step
    )
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
