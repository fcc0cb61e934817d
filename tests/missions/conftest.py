"""Small simulated flights, made once, that the tests of mapping share; their fixes are good to some centimetres."""

import shutil
from dataclasses import replace
from pathlib import Path

import av
import pytest
from truth_detector import TruthDetector

from small_flights import simulate_into, small_flight
from sorvolo.lab.simulation.settings import OutputSettings
from sorvolo.missions.flight.settings import MapSettings
from sorvolo.missions.map.flights import map_flights

_SMALL = small_flight(
    31, length_m=30, spacing_m=6, size_px=(320, 180), fps=6, people=1, cars=1, small_objects=2
)


@pytest.fixture(scope="session")
def filmed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A video of two strips with telemetry in every format, `camera.xml` and the truth."""
    folder = tmp_path_factory.mktemp("flights") / "filmed"
    return simulate_into(folder, replace(_SMALL, output=OutputSettings(telemetry="all")))


@pytest.fixture(scope="session")
def photographed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same flight as geo-tagged photos with the gimbal's angles, and the truth."""
    folder = tmp_path_factory.mktemp("flights") / "photographed"
    return simulate_into(folder, replace(_SMALL, output=OutputSettings(photos=True)))


@pytest.fixture(scope="session")
def photo_map(photographed: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The site of these photos, which nobody writes to."""
    folder = tmp_path_factory.mktemp("flights") / "site"
    for _ in map_flights(
        [photographed / "flight1" / "photos"],
        folder,
        MapSettings(model="none"),
        camera=photographed / "camera.xml",
    ):
        pass
    return folder


@pytest.fixture(scope="session")
def lagging(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same photos, each with the fix of 0.4 s before: 2 m behind."""
    folder = tmp_path_factory.mktemp("flights") / "lagging"
    sensor = replace(_SMALL.sensor, clock_offset_s=0.4)
    return simulate_into(folder, replace(_SMALL, sensor=sensor, output=OutputSettings(photos=True)))


@pytest.fixture(scope="session")
def oblique(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same video by a camera that looks 45 degrees down, with telemetry in every format."""
    folder = tmp_path_factory.mktemp("flights") / "oblique"
    motion = replace(_SMALL.motion, camera_pitch_deg=-45.0)
    return simulate_into(
        folder, replace(_SMALL, motion=motion, output=OutputSettings(telemetry="all"))
    )


@pytest.fixture(scope="session")
def keyed(filmed: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same video with a key frame of the stream each half second, as drones write them; telemetry beside it."""
    folder = tmp_path_factory.mktemp("keyed")
    flight = filmed / "flight1"
    shutil.copy(flight / "flight1.csv", folder)
    with (
        av.open(str(flight / "flight1.mp4")) as source,
        av.open(str(folder / "flight1.mp4"), "w") as target,
    ):
        target.metadata.update(source.metadata)
        stream = target.add_stream(
            "libx264", rate=6, options={"crf": "18", "x264-params": "keyint=3:scenecut=0"}
        )
        stream.width, stream.height = _SMALL.imaging.width_px, _SMALL.imaging.height_px
        for frame in source.decode(video=0):
            frame.pict_type = av.video.frame.PictureType.NONE  # the encoder chooses
            target.mux(stream.encode(frame))
        target.mux(stream.encode())
    return folder / "flight1.mp4"


@pytest.fixture(scope="module")
def detector(flown: Path) -> TruthDetector:
    """A detector that knows the truth of the module's own flight, `flown`."""
    return TruthDetector(flown)
