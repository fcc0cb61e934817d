"""Hills of a simulated site: rays meet the ground where it is, and pictures, things and outlines stand on it."""

from dataclasses import replace

import numpy as np
import pytest
from true_heights import ground_heights, surface_heights

from sorvolo.errors import SettingsError
from sorvolo.lab.simulation.flight import SimulatedFlight, simulate_flight
from sorvolo.lab.simulation.ground_painting import GroundArea
from sorvolo.lab.simulation.settings import (
    ImagingSettings,
    MotionSettings,
    OutputSettings,
    PathSettings,
    SceneSettings,
    SimulationSettings,
)
from sorvolo.lab.simulation.truth import frame_features
from sorvolo.lab.simulation.world import LEVEL, Relief
from sorvolo.search.drawing.view import map_view

_AREA = GroundArea(-60.0, -40.0, 60.0, 40.0)
_HILLS = Relief.hills(8.0, 25.0, _AREA, np.random.default_rng(3))


@pytest.fixture(scope="module")
def flight() -> SimulatedFlight:
    return simulate_flight(
        SimulationSettings(
            seed=5,
            flights=1,
            scene=SceneSettings(people=0, cars=2, small_objects=0, relief_m=8.0),
            path=PathSettings(height_m=25, length_m=20, strips=1),
            motion=MotionSettings(camera_pitch_deg=-80.0),
            imaging=ImagingSettings(width_px=320, height_px=240, noise=0.0),
            output=OutputSettings(photos=True),
        )
    )


def test_hills_are_as_high_as_asked_and_level_ground_has_none() -> None:
    places = np.dstack(np.meshgrid(np.linspace(-60, 60, 200), np.linspace(-40, 40, 200)))
    up = _HILLS.up_m(places)
    assert np.ptp(up) == pytest.approx(8.0, rel=0.02) and abs(up.min() + up.max()) < 0.2
    assert up.max() <= _HILLS.most_m
    assert Relief.hills(0.0, 25.0, _AREA, np.random.default_rng(3)) is LEVEL
    with pytest.raises(SettingsError, match="hills of 30 m are too high for a flight at 25 m"):
        SimulationSettings(scene=SceneSettings(relief_m=30.0), path=PathSettings(height_m=25))


def test_rays_meet_the_first_ground_in_their_way() -> None:
    rng = np.random.default_rng(1)
    eye = np.array([3.0, -2.0, 25.0])
    rays = np.column_stack([rng.uniform(-2.5, 2.5, (200, 2)), np.full(200, -1.0)])
    met = _HILLS.met(eye, rays)
    assert np.abs(met[:, 2] - _HILLS.up_m(met[:, :2])).max() < 1e-3
    ways = np.linspace(0, 1, 200)[1:-1]  # nothing of the ground stands before
    before = eye + (met - eye)[:, None] * ways[:, None]
    assert (before[..., 2] - _HILLS.up_m(before[..., :2])).min() > -1e-3
    assert np.isnan(_HILLS.met(eye, np.array([[1.0, 0.0, 0.1]]))).all()


def test_each_pixel_shows_the_ground_that_projects_there(flight: SimulatedFlight) -> None:
    relief, pose = flight.world.relief, flight.true_poses[2]
    seen = relief.seen(flight.view(2))
    rows, columns = np.meshgrid([0, 33, 121, 239], [0, 87, 190, 319], indexing="ij")
    places = seen[rows.ravel(), columns.ravel()].astype(float)
    points = np.column_stack([places, relief.up_m(places)])
    pixels = flight.camera.pixels_from_points(pose.inverse().apply(points))
    assert np.abs(pixels - np.column_stack([columns.ravel(), rows.ravel()])).max() < 0.05


@pytest.mark.long
def test_pictures_differ_from_those_of_level_ground_and_things_stand_on_the_hills(
    flight: SimulatedFlight,
) -> None:
    level = simulate_flight(
        replace(flight.settings, scene=replace(flight.settings.scene, relief_m=0.0))
    )
    assert np.abs(flight.frame(2).image.astype(int) - level.frame(2).image).mean() > 5
    feet = np.array([thing.place_m(0.0) for thing in flight.day.things])
    assert feet[:, 2] == pytest.approx(flight.world.relief.up_m(feet[:, :2]))
    assert np.ptp(feet[:, 2]) > 2


def test_outlines_and_heights_of_the_truth_are_those_of_the_hills(flight: SimulatedFlight) -> None:
    relief, pose = flight.world.relief, flight.true_poses[0]
    corners = flight.site.ground_from_lonlat(
        frame_features(flight)[0]["geometry"]["coordinates"][0][:4]
    )
    points = np.column_stack([corners, relief.up_m(corners)])
    pixels = flight.camera.pixels_from_points(pose.inverse().apply(points))
    assert np.abs(pixels - flight.camera.corners_px).max() < 0.05
    view = map_view(-10.0, 8.0, (0.1, 0.1), (200, 160))
    bare = ground_heights(view, relief)
    assert bare[0, 0] == pytest.approx(relief.up_m(np.array([-9.95, 7.95])), abs=1e-3)
    tops = surface_heights(flight.day.things, flight.day.bodies, view, relief)
    assert (tops >= bare - 1e-3).all()
