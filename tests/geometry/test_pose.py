"""Rigid motions: the laws of a group, and the attitudes that telemetry speaks in."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sorvolo.errors import GeometryError
from sorvolo.geometry.pose import (
    NADIR_CAMERA_NORTH_UP,
    Pose,
    body_nadir_angles_from_rotation,
    gimbal_angles_from_rotation,
    rotation_from_vector,
    site_from_body_nadir_rotation,
    site_from_gimbal_rotation,
)

vectors = st.tuples(*[st.floats(-3, 3)] * 3).map(np.array)
poses = st.builds(
    lambda turn, shift: Pose(rotation_from_vector(turn), shift * 1e3), vectors, vectors
)
POINTS_M = np.random.default_rng(0).normal(0, 100, (20, 3))
FORWARD, RIGHT, DOWN = (
    np.array([0.0, 0, 1]),
    np.array([1.0, 0, 0]),
    np.array([0.0, 1, 0]),
)  # camera axes
EAST, NORTH, UP = np.eye(3)


@given(poses)
def test_inverse(a_from_b):
    np.testing.assert_allclose(
        a_from_b.inverse().apply(a_from_b.apply(POINTS_M)), POINTS_M, atol=1e-6
    )
    identity = a_from_b @ a_from_b.inverse()
    np.testing.assert_allclose(identity.rotation, np.eye(3), atol=1e-9)
    np.testing.assert_allclose(identity.translation_m, 0, atol=1e-6)


@given(poses, poses, poses)
def test_composition_is_application_in_turn_and_associates(a_from_b, b_from_c, c_from_d):
    np.testing.assert_allclose(
        (a_from_b @ b_from_c).apply(POINTS_M), a_from_b.apply(b_from_c.apply(POINTS_M)), atol=1e-6
    )
    left, right = (a_from_b @ b_from_c) @ c_from_d, a_from_b @ (b_from_c @ c_from_d)
    np.testing.assert_allclose(left.apply(POINTS_M), right.apply(POINTS_M), atol=1e-6)


@given(poses)
def test_distances_do_not_change(pose):
    before = np.linalg.norm(POINTS_M[0] - POINTS_M[1])
    after = np.linalg.norm(np.subtract(*pose.apply(POINTS_M[:2])))
    assert after == pytest.approx(before, abs=1e-6)


@given(vectors)
def test_rotation_vectors_turn_about_themselves_by_their_length(vector):
    rotation = rotation_from_vector(vector)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-9)
    np.testing.assert_allclose(rotation @ vector, vector, atol=1e-9)
    assert np.trace(rotation) == pytest.approx(1 + 2 * np.cos(np.linalg.norm(vector)), abs=1e-9)
    np.testing.assert_allclose(rotation_from_vector(-vector), rotation.T, atol=1e-9)


def test_rotation_vectors_come_in_stacks():
    stack = np.random.default_rng(1).normal(size=(4, 2, 3))
    assert rotation_from_vector(stack).shape == (4, 2, 3, 3)
    np.testing.assert_allclose(rotation_from_vector(stack)[3, 1], rotation_from_vector(stack[3, 1]))
    np.testing.assert_array_equal(rotation_from_vector(np.zeros(3)), np.eye(3))


def test_gimbal_straight_down_has_the_image_top_towards_yaw():
    np.testing.assert_allclose(
        site_from_gimbal_rotation(0, -90, 0), NADIR_CAMERA_NORTH_UP, atol=1e-12
    )
    east_up = site_from_gimbal_rotation(90, -90, 0)
    np.testing.assert_allclose(east_up @ -DOWN, EAST, atol=1e-12)
    np.testing.assert_allclose(east_up @ FORWARD, -UP, atol=1e-12)


def test_gimbal_at_the_horizon_looks_towards_yaw():
    level = site_from_gimbal_rotation(90, 0, 0)
    np.testing.assert_allclose(level @ FORWARD, EAST, atol=1e-12)
    np.testing.assert_allclose(level @ RIGHT, -NORTH, atol=1e-12)
    np.testing.assert_allclose(level @ DOWN, -UP, atol=1e-12)
    assert (site_from_gimbal_rotation(0, 20, 0) @ FORWARD)[2] > 0
    assert (site_from_gimbal_rotation(0, 0, 10) @ RIGHT)[2] < 0


def test_body_nose_up_and_right_side_down_tilt_the_camera_as_they_should():
    np.testing.assert_allclose(
        site_from_body_nadir_rotation(0, 0, 0), NADIR_CAMERA_NORTH_UP, atol=1e-12
    )
    np.testing.assert_allclose(site_from_body_nadir_rotation(90, 0, 0) @ -DOWN, EAST, atol=1e-12)
    # nose up: the belly camera looks ahead; right side down: it looks to the left
    assert (site_from_body_nadir_rotation(0, 10, 0) @ FORWARD)[1] > 0.1
    assert (site_from_body_nadir_rotation(0, 0, 10) @ FORWARD)[0] < -0.1


@given(st.floats(0, 359.99), st.floats(-89.9, 89.9), st.floats(-179, 179))
def test_gimbal_angles_there_and_back(yaw_deg, pitch_deg, roll_deg):
    found = gimbal_angles_from_rotation(site_from_gimbal_rotation(yaw_deg, pitch_deg, roll_deg))
    turn = np.radians(np.subtract(found, (yaw_deg, pitch_deg, roll_deg)))
    np.testing.assert_allclose(np.exp(1j * turn), 1, atol=1e-6)


@given(st.floats(0, 359.99), st.floats(-89.9, 89.9), st.floats(-179, 179))
def test_body_angles_there_and_back(yaw_deg, pitch_deg, roll_deg):
    found = body_nadir_angles_from_rotation(
        site_from_body_nadir_rotation(yaw_deg, pitch_deg, roll_deg)
    )
    turn = np.radians(np.subtract(found, (yaw_deg, pitch_deg, roll_deg)))
    np.testing.assert_allclose(np.exp(1j * turn), 1, atol=1e-6)


@given(st.floats(0, 359.99), st.sampled_from([-90.0, 90.0]), st.floats(-60, 60))
def test_at_the_nadir_the_angles_still_name_the_same_rotation(yaw_deg, pitch_deg, roll_deg):
    rotation = site_from_gimbal_rotation(yaw_deg, pitch_deg, roll_deg)
    found = gimbal_angles_from_rotation(rotation)
    assert found[2] == 0.0
    np.testing.assert_allclose(site_from_gimbal_rotation(*found), rotation, atol=1e-6)


@pytest.mark.parametrize(
    "rotation", [np.eye(3) * 1.01, np.diag([1.0, 1, -1]), np.zeros((3, 3)), np.eye(2)]
)
def test_what_is_no_rotation_is_refused(rotation):
    with pytest.raises(GeometryError):
        Pose(rotation, np.zeros(3))


@pytest.mark.parametrize("translation", [np.array([0, 0, np.nan]), np.zeros(2), np.full(3, np.inf)])
def test_what_is_no_translation_is_refused(translation):
    with pytest.raises(GeometryError):
        Pose(np.eye(3), translation)


def test_a_pose_cannot_be_changed_from_outside():
    shift = np.zeros(3)
    pose = Pose(np.eye(3), shift)
    shift[0] = 5
    assert pose.translation_m[0] == 0
    with pytest.raises(ValueError, match="read-only"):
        pose.rotation[0, 0] = 2
