"""Small simulated photo flights for the tests of batches: the smallest that make a map."""

from pathlib import Path

import pytest

from small_flights import simulate_into, small_flight
from sorvolo.lab.simulation.settings import OutputSettings


@pytest.fixture(scope="session")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with one flight of four photos, and its camera."""
    folder = tmp_path_factory.mktemp("batch") / "flown"
    settings = small_flight(
        31,
        length_m=14,
        fps=2,
        people=1,
        cars=1,
        small_objects=2,
        output=OutputSettings(photos=True),
    )
    return simulate_into(folder, settings)
