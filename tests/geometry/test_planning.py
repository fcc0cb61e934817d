"""Planning against the thesis's worked numbers, and plans against the ground they must see."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sorvolo.errors import SettingsError
from sorvolo.geometry.camera import Camera
from sorvolo.geometry.planning import (
    BOTTOM_CRITICAL_M,
    FRONT_CRITICAL_M,
    StripSettings,
    Task,
    footprint_size_m,
    longest_bearing_deg,
    maximum_height_m,
    minimum_frame_rate,
    plan_strips,
    px_per_m,
    required_px_per_m,
    scene_length_m,
)
from sorvolo.geometry.polygons import points_inside

CAMERA = Camera.from_angle_of_view(1200, 800, 60.0)
SQUARE_M = np.array([[0.0, 0], [100, 0], [100, 100], [0, 100]])
U_M = np.array(
    [[0.0, 0], [300, 0], [300, 250], [200, 250], [200, 60], [90, 60], [90, 230], [0, 230]]
)
HOLE_M = np.array([[230.0, 100], [270, 100], [270, 200], [230, 200]])


def cut(number, decimals=2):
    """Cut, not rounded: so the thesis prints its heights."""
    return math.floor(number * 10**decimals) / 10**decimals


@pytest.mark.parametrize(
    ("task", "front"), [("detection", 2), ("recognition", 8), ("identification", 16)]
)
def test_table_3_1_front_facing(task, front):
    assert required_px_per_m(Task(task), FRONT_CRITICAL_M) == pytest.approx(front)


def test_the_bottom_critical_dimension_is_the_printed_one():
    assert abs(BOTTOM_CRITICAL_M - 0.605) < 1e-4


@pytest.mark.parametrize(
    ("task", "printed", "computed"),
    [("detection", 3.02, 2.48), ("recognition", 12.11, 9.92), ("identification", 24.23, 19.83)],
)
def test_table_3_1_bottom_facing_is_computed_not_copied(task, printed, computed):
    """Erratum 3: the printed column belongs to 0.495 m, not to the stated 0.605 m."""
    assert required_px_per_m(Task(task), BOTTOM_CRITICAL_M) == pytest.approx(computed, abs=0.005)
    assert cut(required_px_per_m(Task(task), 0.4952)) == printed


@pytest.mark.parametrize(
    ("srj_px_per_m", "printed_m"),
    [(2, 121.95), (8, 30.48), (16, 15.24), (3.02, 80.76), (12.11, 20.14), (24.23, 10.06)],
)
def test_equations_3_10_to_3_15_follow_from_a_pixel_of_6_97_um(srj_px_per_m, printed_m):
    """Erratum 1: the printed 5.97 um gives heights 17 % greater."""
    assert cut(maximum_height_m(1.7 / 6.97e-3, srj_px_per_m)) == printed_m
    wrong_m = maximum_height_m(1.7 / 5.97e-3, srj_px_per_m)
    assert wrong_m / printed_m == pytest.approx(6.97 / 5.97, rel=1e-3)


def test_equation_3_16_is_a_tangent():
    """Erratum 2: with tanh the seen length would not be the footprint of eq. 3.7."""
    width_m, length_m = footprint_size_m(CAMERA, 50.0)
    aov_w_deg, aov_h_deg = CAMERA.angle_of_view_deg
    assert scene_length_m(50.0, aov_w_deg) == pytest.approx(width_m)
    assert scene_length_m(50.0, aov_h_deg) == pytest.approx(length_m)
    assert abs(2 * 50 * math.tanh(math.radians(aov_w_deg) / 2) / width_m - 1) > 0.15


def test_figure_3_11_running_example():
    """60 deg from 10 m at 10 m/s: 11.547 m are seen, and half overlap needs a frame every 5.77 m."""
    scene_m = scene_length_m(10.0, 60.0)
    assert scene_m == pytest.approx(20 / math.sqrt(3))
    assert minimum_frame_rate(10.0, scene_m, 0.5) == pytest.approx(1.7320508)
    assert minimum_frame_rate(10.0, scene_m, 0.0) == pytest.approx(10 / scene_m)


@given(st.floats(1, 500), st.floats(5, 150), st.floats(0.5, 30), st.floats(0, 0.94))
def test_frame_rate_follows_height_view_speed_and_overlap(height, aov, speed, overlap):
    rate = minimum_frame_rate(speed, scene_length_m(height, aov), overlap)
    assert minimum_frame_rate(speed, scene_length_m(2 * height, aov), overlap) < rate
    assert (
        minimum_frame_rate(speed, scene_length_m(height, aov + 5), overlap) < rate
    )  # not as (c) in 3.1.1
    assert minimum_frame_rate(2 * speed, scene_length_m(height, aov), overlap) > rate
    assert minimum_frame_rate(speed, scene_length_m(height, aov), overlap + 0.05) > rate


@given(st.floats(1, 500), st.floats(100, 10000), st.sampled_from(list(Task)), st.floats(0.05, 10))
def test_at_the_maximum_height_the_task_is_just_met(height, focal_px, task, critical_m):
    needed = required_px_per_m(task, critical_m)
    assert px_per_m(maximum_height_m(focal_px, needed), focal_px) == pytest.approx(needed)
    assert px_per_m(height, focal_px) == pytest.approx(focal_px / height)


@pytest.mark.parametrize(
    "call",
    [
        lambda: required_px_per_m(Task.DETECTION, 0.0),
        lambda: required_px_per_m(Task.DETECTION, math.nan),
        lambda: px_per_m(0.0, 1000.0),
        lambda: scene_length_m(10.0, 180.0),
        lambda: minimum_frame_rate(5.0, 10.0, 1.0),
        lambda: minimum_frame_rate(0.0, 10.0, 0.5),
        lambda: StripSettings(0.0),
        lambda: StripSettings(50.0, speed_m_s=-1.0),
        lambda: StripSettings(50.0, forward_overlap=0.99),
        lambda: StripSettings(50.0, side_overlap=-0.1),
        lambda: plan_strips([[SQUARE_M * 1e4]], CAMERA, StripSettings(5.0, side_overlap=0.9)),
    ],
)
def test_impossible_settings_are_refused(call):
    with pytest.raises(SettingsError):
        call()


def photos_m(plan):
    """(N, 2) where photos are taken: evenly along each pass, one at either end."""
    places = []
    for start, end in plan.passes_m:
        count = round(float(np.linalg.norm(end - start)) / plan.photo_spacing_m) + 1
        places.append(start + np.linspace(0, 1, count)[:, None] * (end - start))
    return np.concatenate(places)


def seen_by_photos(plan, points_m):
    """Whether each point lies in the footprint of at least one photo."""
    width_m, length_m = footprint_size_m(CAMERA, plan.height_m)
    bearing = math.radians(plan.strip_bearing_deg)
    along = np.array([math.sin(bearing), math.cos(bearing)])
    across = np.array([along[1], -along[0]])
    seen = np.zeros(len(points_m), bool)
    for photo_m in photos_m(plan):
        delta = points_m - photo_m
        is_near = np.abs(delta @ along) <= length_m / 2 + 1e-6
        seen |= is_near & (np.abs(delta @ across) <= width_m / 2 + 1e-6)
    return seen


def points_of(rings, count=700):
    rng = np.random.default_rng(5)
    low, high = rings[0].min(axis=0), rings[0].max(axis=0)
    points_m = low + rng.random((count * 4, 2)) * (high - low)
    return np.concatenate([points_m[points_inside(rings, points_m)][:count], rings[0]])


def rotated(ring, angle_deg):
    turn = math.radians(angle_deg)
    return ring @ np.array([[math.cos(turn), math.sin(turn)], [-math.sin(turn), math.cos(turn)]])


@settings(max_examples=40, deadline=None)
@given(
    st.integers(3, 9),
    st.integers(0, 10**6),
    st.floats(10, 80),
    st.sampled_from([0.0, 0.3, 0.65, 0.9]),
    st.sampled_from([None, 0.0, 37.0, 90.0, 200.0]),
)
def test_every_point_of_a_star_shaped_area_is_seen(corners, seed, height_m, overlap, bearing_deg):
    rng = np.random.default_rng(seed)
    angles = np.sort(rng.random(corners) * 2 * math.pi)
    ring = (20 + 150 * rng.random(corners))[:, None] * np.column_stack(
        [np.cos(angles), np.sin(angles)]
    )
    plan = plan_strips(
        [[ring]], CAMERA, StripSettings(height_m, 5.0, overlap, overlap, bearing_deg)
    )
    assert seen_by_photos(plan, points_of([ring], 200)).all()


@pytest.mark.parametrize("angle_deg", [0.0, 30.0, 90.0, 135.0])
def test_a_concave_area_with_a_hole_is_seen_and_its_gap_is_not_photographed(angle_deg):
    rings = [rotated(U_M, angle_deg), rotated(HOLE_M, angle_deg)]
    settings_ = StripSettings(20.0, strip_bearing_deg=90.0 - angle_deg)
    plan = plan_strips([rings], CAMERA, settings_)
    assert seen_by_photos(plan, points_of(rings)).all()
    notch_m = rotated(np.array([[145.0, 180.0]]), angle_deg)
    assert not seen_by_photos(plan, notch_m).any()
    # two passes where a strip crosses both arms
    filled = plan_strips([[rotated(SQUARE_M * 2.5, angle_deg)]], CAMERA, settings_)
    assert len(plan.passes_m) > len(filled.passes_m)


def test_neighbouring_photos_and_strips_overlap_as_wanted():
    plan = plan_strips([[SQUARE_M * 3]], CAMERA, StripSettings(40.0, 6.0, 0.8, 0.6, 0.0))
    width_m, length_m = footprint_size_m(CAMERA, 40.0)
    assert plan.photo_spacing_m == pytest.approx(0.2 * length_m)
    assert np.linalg.norm(photos_m(plan)[1] - photos_m(plan)[0]) == pytest.approx(
        plan.photo_spacing_m
    )
    levels = np.unique(np.round(plan.passes_m[:, 0, 0], 6))
    assert np.diff(levels) == pytest.approx(0.4 * width_m)
    assert 1 / plan.photo_interval_s == pytest.approx(minimum_frame_rate(6.0, length_m, 0.8))


def test_passes_run_to_and_fro_and_add_up():
    plan = plan_strips([[SQUARE_M * [4, 1]]], CAMERA, StripSettings(30.0))
    assert plan.strip_bearing_deg == pytest.approx(90.0)
    directions = np.sign(plan.passes_m[:, 1, 0] - plan.passes_m[:, 0, 0])
    assert (directions[1:] == -directions[:-1]).all()
    legs_m = np.linalg.norm(np.diff(plan.waypoints_m, axis=0), axis=1)
    assert plan.distance_m == pytest.approx(legs_m.sum())
    assert plan.duration_s > plan.distance_m / plan.speed_m_s
    assert plan.photo_count == len(photos_m(plan))


def test_an_area_smaller_than_a_photo_is_one_short_pass():
    plan = plan_strips([[SQUARE_M / 50]], CAMERA, StripSettings(60.0))
    assert len(plan.passes_m) == 1
    assert plan.photo_count == 2


def test_two_polygons_are_covered_together_without_photos_between():
    far_m = SQUARE_M / 2 + [400.0, 0.0]
    plan = plan_strips(
        [[SQUARE_M / 2], [far_m]], CAMERA, StripSettings(20.0, strip_bearing_deg=90.0)
    )
    for ring in (SQUARE_M / 2, far_m):
        assert seen_by_photos(plan, points_of([ring])).all()
    assert not seen_by_photos(plan, np.array([[220.0, 25.0]])).any()


@given(st.floats(0, 179.9), st.floats(1.05, 10))
def test_the_longest_bearing_of_a_rectangle_is_its_longer_side(bearing_deg, ratio):
    ring = rotated(SQUARE_M * [1, ratio], -bearing_deg)  # the long side, north, turned clockwise
    difference = abs(longest_bearing_deg(ring) - bearing_deg)
    assert min(difference, 180 - difference) < 1e-6
