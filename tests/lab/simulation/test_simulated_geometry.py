"""The pictures show the ground exactly where the true poses and the camera have it."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from sorvolo.geometry.ground import footprint, ground_from_pixels
from sorvolo.lab.simulation.flight import SimulatedFlight, simulate_flight
from sorvolo.lab.simulation.ground import PaintedGround, orthophoto_ground
from sorvolo.lab.simulation.ground_painting import GroundRaster
from sorvolo.lab.simulation.rendering import render_labels
from sorvolo.lab.simulation.settings import (
    ImagingSettings,
    MotionSettings,
    OutputSettings,
    PathSettings,
    SceneSettings,
    SimulationSettings,
)
from sorvolo.lab.simulation.world import _with_shadows
from sorvolo.search.drawing.bodies import build_body
from sorvolo.search.drawing.objects import Light, Thing, ThingLabel

GRID_M = 2.0
RASTER_M = 0.02


def dotted_ground(size_m: float) -> PaintedGround:
    """Round white dots of a known place on grey, every two metres."""
    side = round(size_m / RASTER_M)
    fine = np.full((side, side, 3), 60, np.uint8)
    places = np.arange(-np.floor(size_m / 2 / GRID_M) + 1, np.floor(size_m / 2 / GRID_M)) * GRID_M
    for east in places:
        for north in places:
            centre = (np.array([east + size_m / 2, size_m / 2 - north]) / RASTER_M - 0.5) * 256
            x, y = np.round(centre).astype(int).tolist()
            cv2.circle(
                fine, (x, y), int(0.22 / RASTER_M * 256), (240, 240, 240), -1, cv2.LINE_AA, 8
            )
    return orthophoto_ground(fine, RASTER_M)


def clean_settings(**imaging: object) -> SimulationSettings:
    return SimulationSettings(
        flights=1,
        scene=SceneSettings("orthophoto", people=0, cars=0, small_objects=0),
        path=PathSettings(height_m=20, speed_m_s=4, length_m=10, strips=1, heading_deg=30),
        motion=MotionSettings(tilt_rms_deg=2.0),
        imaging=replace(
            ImagingSettings(
                640, 480, fps=2, exposure_s=0, exposure_drift=0, white_balance_drift=0, noise=0
            ),
            **imaging,
        ),
        output=OutputSettings(telemetry="none"),
    )


def centroid_errors_px(flight: SimulatedFlight, index: int) -> np.ndarray:
    """Distances between dots in the picture and where the true pose projects them."""
    gray = cv2.cvtColor(flight.frame(index).image, cv2.COLOR_RGB2GRAY).astype(np.float64)
    pose, camera = flight.true_poses[index], flight.camera
    corners = footprint(camera, pose)
    low, high = np.ceil(corners.min(axis=0) / GRID_M), np.floor(corners.max(axis=0) / GRID_M)
    east, north = np.meshgrid(
        np.arange(low[0], high[0] + 1) * GRID_M, np.arange(low[1], high[1] + 1) * GRID_M
    )
    dots = np.column_stack([east.ravel(), north.ravel(), np.zeros(east.size)])
    expected = camera.pixels_from_points(pose.inverse().apply(dots))
    errors = []
    for x, y in expected:
        if not (14 < x < camera.width_px - 15 and 14 < y < camera.height_px - 15):
            continue
        x0, y0 = round(x) - 12, round(y) - 12
        part = gray[y0 : y0 + 25, x0 : x0 + 25]
        part = (
            np.clip(part / part.max() - 0.35, 0, None)
            / np.clip(part / part.max() - 0.35, 0, None).sum()
        )
        rows, columns = np.mgrid[y0 : y0 + 25, x0 : x0 + 25]
        errors.append(np.hypot((part * columns).sum() - x, (part * rows).sum() - y))
    return np.array(errors)


@pytest.mark.parametrize("distortion", [(0, 0, 0, 0, 0), (-0.15, 0.05, 0.001, -0.0008, 0.01)])
def test_dots_lie_where_the_true_pose_projects_them(distortion):
    flight = simulate_flight(clean_settings(distortion=distortion), dotted_ground(70))
    errors = np.concatenate([centroid_errors_px(flight, index) for index in (0, 2, 4)])
    assert len(errors) > 60
    assert errors.max() < 0.1
    assert errors.mean() < 0.05


def test_a_shifted_truth_would_be_noticed():
    """The dot test can fail: half a pixel of shift is far beyond its tolerance."""
    flight = simulate_flight(clean_settings(), dotted_ground(70))
    shifted = GroundRaster(
        flight.day.ground.rgb,
        flight.day.ground.vegetation,
        flight.day.ground.west_m + 0.02,
        flight.day.ground.north_m,
        flight.day.ground.m_per_px,
    )
    moved = replace(flight, day=replace(flight.day, ground=shifted))
    assert centroid_errors_px(moved, 1).mean() > 0.3


def test_the_outline_is_the_ground_under_the_outer_corners():
    flight = simulate_flight(clean_settings(), dotted_ground(70))
    pose, camera = flight.true_poses[1], flight.camera
    outline = footprint(camera, pose)
    back = camera.pixels_from_points(pose.inverse().apply(np.column_stack([outline, np.zeros(4)])))
    assert np.abs(back - camera.corners_px).max() < 1e-6


def test_a_roof_stands_at_its_height():
    """A box's lid is seen where its corners project, not where its footprint does."""
    flight = simulate_flight(clean_settings(), dotted_ground(70))
    pose, camera = flight.true_poses[2], flight.camera
    middle = ground_from_pixels(camera, pose, np.array([[160.0, 130.0]]))[0]
    thing = Thing(
        1,
        ThingLabel.HOUSE,
        "flat roof",
        float(middle[0]),
        float(middle[1]),
        20.0,
        (4.0, 3.0, 5.0),
        3,
    )
    light = Light(np.array([0.0, 0.3, 0.954]))
    body = build_body(thing, light, 0.03)
    labels, totals = render_labels([thing], {1: body}, flight.view(2), pose, 0.0)
    corners = np.array([[x, y, z] for x in (-2, 2) for y in (-1.5, 1.5) for z in (0.0, 5.0)])
    seen = camera.pixels_from_points(
        pose.inverse().apply(corners @ thing.turn.T + thing.place_m(0.0))
    )
    rows, columns = np.nonzero(labels)
    hull = cv2.convexHull(seen.astype(np.float32))
    assert abs(len(rows) - cv2.contourArea(hull)) < 0.06 * len(
        rows
    )  # its air conditioners stand out a little
    # the near sides are exact: nothing stands out there
    assert columns.max() == pytest.approx(seen[:, 0].max(), abs=1.0)
    assert rows.max() == pytest.approx(seen[:, 1].max(), abs=1.0)
    assert totals == {1: len(rows)}


def test_what_stands_nearer_hides_what_is_behind():
    flight = simulate_flight(clean_settings(), dotted_ground(70))
    pose = flight.true_poses[2]
    below = pose.translation_m[:2]
    wall = Thing(
        1,
        ThingLabel.HOUSE,
        "flat roof",
        float(below[0] + 3),
        float(below[1]),
        0.0,
        (2.0, 6.0, 6.0),
        3,
    )
    hidden = Thing(
        2, ThingLabel.SMALL, "box", float(below[0] + 4.6), float(below[1]), 0.0, (0.4, 0.3, 0.3), 4
    )
    light = Light(np.array([0.0, 0.3, 0.954]))
    bodies = {thing.id: build_body(thing, light, 0.03) for thing in (wall, hidden)}
    labels, totals = render_labels([wall, hidden], bodies, flight.view(2), pose, 0.0)
    assert totals[2] > 50
    assert np.count_nonzero(labels == 2) < 0.2 * totals[2]
    alone, _ = render_labels([hidden], bodies, flight.view(2), pose, 0.0)
    assert np.count_nonzero(alone == 2) == totals[2]


def test_shadows_fall_away_from_the_sun():
    gray = GroundRaster(
        np.full((700, 700, 3), 200, np.uint8),
        np.zeros((700, 700), np.uint8),
        -17.5,
        17.5,
        (0.05, 0.05),
    )
    sun = np.array([np.sin(0.9), 0.0, np.cos(0.9)])  # in the east
    pole = Thing(1, ThingLabel.SMALL, "big box", 0.0, 0.0, 0.0, (0.6, 0.6, 2.0), 5)
    light = Light(sun)
    dark = _with_shadows(gray, [pole], {1: build_body(pole, light, 0.05)}, light).rgb[..., 1] < 150
    rows, columns = np.nonzero(dark)
    east = gray.west_m + (columns + 0.5) * 0.05
    assert east.min() == pytest.approx(-0.3 - 2.0 * np.tan(0.9), abs=0.12)
    assert east.max() == pytest.approx(0.3, abs=0.12)
    assert np.abs(gray.north_m - (rows + 0.5) * 0.05).max() == pytest.approx(0.3, abs=0.12)
