"""Small simulated flights: what the flights of most tests have in common, and how they get into a folder."""

from pathlib import Path

from sorvolo.lab.simulation.settings import (
    ImagingSettings,
    OutputSettings,
    PathSettings,
    SceneSettings,
    SensorSettings,
    SimulationSettings,
)
from sorvolo.lab.simulation.site import simulate_site


def small_flight(
    seed: int,
    *,
    length_m: float,
    height_m: float = 20,
    speed_m_s: float = 5,
    spacing_m: float | None = None,
    size_px: tuple[int, int] = (320, 180),
    fps: float = 5,
    noise_m: float = 0.05,
    people: int = 0,
    cars: int = 0,
    small_objects: int = 0,
    output: OutputSettings = OutputSettings(),
) -> SimulationSettings:
    """One flight over bare ground with a few objects: two strips `spacing_m` apart, or one (None), of a length."""
    strips = {} if spacing_m is None else {"strip_spacing_m": spacing_m}
    return SimulationSettings(
        seed=seed,
        flights=1,
        scene=SceneSettings(
            people=people, cars=cars, small_objects=small_objects, has_scenery=False
        ),
        path=PathSettings(
            height_m=height_m,
            speed_m_s=speed_m_s,
            length_m=length_m,
            strips=1 if spacing_m is None else 2,
            **strips,
        ),
        imaging=ImagingSettings(width_px=size_px[0], height_px=size_px[1], fps=fps),
        sensor=SensorSettings(noise_m=(noise_m, noise_m, noise_m)),
        output=output,
    )


def simulate_into(folder: Path, settings: SimulationSettings) -> Path:
    """Simulate the flights into a folder, which is returned."""
    for _ in simulate_site(folder, settings):
        pass
    return folder
