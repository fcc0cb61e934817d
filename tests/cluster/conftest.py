"""Small simulated photo flights for the tests of batches: the smallest that make a map."""

from pathlib import Path

import pytest

from sorvolo.missions.simulate.site import simulate_site
from sorvolo.simulation.settings import (
    ImagingSettings,
    OutputSettings,
    PathSettings,
    SceneSettings,
    SensorSettings,
    SimulationSettings,
)


@pytest.fixture(scope="session")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with one flight of four photos, and its camera."""
    folder = tmp_path_factory.mktemp("batch") / "flown"
    settings = SimulationSettings(
        seed=31, flights=1, scene=SceneSettings(people=1, cars=1, small_objects=2, has_scenery=False),
        path=PathSettings(height_m=20, speed_m_s=5, length_m=14, strips=1, strip_spacing_m=6),
        imaging=ImagingSettings(width_px=320, height_px=180, fps=2), sensor=SensorSettings(noise_m=(0.05, 0.05, 0.05)),
        output=OutputSettings(photos=True),
    )
    for _ in simulate_site(folder, settings):
        pass
    return folder
