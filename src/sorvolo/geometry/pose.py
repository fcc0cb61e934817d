"""Rigid motion between two frames, and the attitudes that telemetry speaks in."""

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from sorvolo.errors import GeometryError
from sorvolo.geometry.arrays import Floats, Matrix3, PointsM, Vector3, frozen

NADIR_CAMERA_NORTH_UP: Matrix3 = np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]])
"""site_from_camera of a camera that looks straight down, the top of its image to the north."""

_ENU_FROM_NED: Matrix3 = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
# gimbal axes are forward, right, down; camera axes are right, down, forward
_GIMBAL_FROM_CAMERA: Matrix3 = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])


@dataclass(frozen=True, eq=False)
class Pose:
    """Where frame b sits in frame a. Name the variable `a_from_b`."""

    rotation: Matrix3  # orthonormal, (3, 3)
    translation_m: Vector3  # origin of b, seen from a

    def __post_init__(self) -> None:
        rotation, translation_m = frozen(self.rotation), frozen(self.translation_m)
        if rotation.shape != (3, 3) or translation_m.shape != (3,):
            raise GeometryError(
                f"a pose needs (3, 3) and (3,), got {rotation.shape} and {translation_m.shape}"
            )
        if (
            not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-6)
            or np.linalg.det(rotation) < 0
        ):
            raise GeometryError("rotation is not orthonormal and right-handed")
        if not np.isfinite(translation_m).all():
            raise GeometryError(f"translation is not finite: {translation_m}")
        object.__setattr__(self, "rotation", rotation)
        object.__setattr__(self, "translation_m", translation_m)

    def apply(self, points_m: PointsM) -> PointsM:
        """Points of frame b, shape (N, 3), given in frame a."""
        return points_m @ self.rotation.T + self.translation_m

    def inverse(self) -> "Pose":
        """b_from_a."""
        return Pose(self.rotation.T, -self.rotation.T @ self.translation_m)

    def __matmul__(self, inner: "Pose") -> "Pose":
        return Pose(self.rotation @ inner.rotation, self.apply(inner.translation_m))


def rotation_from_vector(rotation_vector_rad: Floats) -> Floats:
    """Rodrigues: rotation vectors, shape (..., 3), as matrices, shape (..., 3, 3)."""
    vector = np.asarray(rotation_vector_rad, dtype=np.float64)
    angle = np.linalg.norm(vector, axis=-1)[..., None, None]
    small = angle < 1e-12
    axis = vector[..., None, :] / np.where(small, 1.0, angle)
    x, y, z = axis[..., 0, 0], axis[..., 0, 1], axis[..., 0, 2]
    zero = np.zeros_like(x)
    cross = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(
        *vector.shape[:-1], 3, 3
    )
    turned = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * (cross @ cross)
    return np.where(small, np.eye(3), turned)


def rotation_between(first: Matrix3, last: Matrix3, share: float) -> Matrix3:
    """The rotation so far, from 0 to 1, on the shortest turn from one, (3, 3), to another."""
    turn, _ = cv2.Rodrigues(first.T @ last)
    return first @ cv2.Rodrigues(share * turn)[0]


def site_from_gimbal_rotation(yaw_deg: float, pitch_deg: float, roll_deg: float) -> Matrix3:
    """site_from_camera rotation of a camera whose gimbal reports these angles against north and the horizon.

    Yaw is clockwise from north, pitch is 0 at the horizon and -90 straight down, roll is right side down;
    with pitch -90 the top of the image points to `yaw_deg`. Order yaw, pitch, roll (z-y-x).
    """
    return _ENU_FROM_NED @ _ned_from_angles(yaw_deg, pitch_deg, roll_deg) @ _GIMBAL_FROM_CAMERA


def site_from_body_nadir_rotation(yaw_deg: float, pitch_deg: float, roll_deg: float) -> Matrix3:
    """site_from_camera rotation of a camera fixed below the body, looking along its down axis, image top forward.

    The angles are the body's: yaw clockwise from north, pitch nose up, roll right side down (z-y-x).
    """
    return (
        _ENU_FROM_NED
        @ _ned_from_angles(yaw_deg, pitch_deg, roll_deg)
        @ _NADIR_MOUNT
        @ _GIMBAL_FROM_CAMERA
    )


def body_nadir_angles_from_rotation(
    site_from_camera_rotation: Matrix3,
) -> tuple[float, float, float]:
    """Yaw, pitch, roll in degrees, the inverse of `site_from_body_nadir_rotation`; towards the horizon roll is 0."""
    ned_from_body = (
        _ENU_FROM_NED.T @ site_from_camera_rotation @ (_NADIR_MOUNT @ _GIMBAL_FROM_CAMERA).T
    )
    return _angles_from_ned(ned_from_body)


def body_angles_deg(w: Any, x: Any, y: Any, z: Any) -> dict[str, Any]:
    """Body angles (deg, z-y-x) of unit quaternions from body axes (forward, right, down) to north, east, down: numbers,
    or arrays of one shape; named as telemetry's columns are."""
    yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    pitch = np.arcsin(np.clip(2 * (w * y - z * x), -1.0, 1.0))
    roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    names = ("body_yaw_deg", "body_pitch_deg", "body_roll_deg")
    return dict(zip(names, map(np.degrees, (yaw, pitch, roll))))


def gimbal_angles_from_rotation(site_from_camera_rotation: Matrix3) -> tuple[float, float, float]:
    """Yaw, pitch, roll in degrees, the inverse of `site_from_gimbal_rotation`; at the nadir roll is given as 0."""
    return _angles_from_ned(_ENU_FROM_NED.T @ site_from_camera_rotation @ _GIMBAL_FROM_CAMERA.T)


def _angles_from_ned(rotation: Matrix3) -> tuple[float, float, float]:
    """The angles of `_ned_from_angles`, yaw from 0 to 360; where pitch is +-90 roll is given as 0."""
    pitch = np.arcsin(np.clip(-rotation[2, 0], -1.0, 1.0))
    if np.hypot(rotation[0, 0], rotation[1, 0]) < 1e-6:
        yaw = np.arctan2(-rotation[0, 1], rotation[1, 1])
        roll = 0.0
    else:
        yaw = np.arctan2(rotation[1, 0], rotation[0, 0])
        roll = np.arctan2(rotation[2, 1], rotation[2, 2])
    return float(np.degrees(yaw)) % 360.0, float(np.degrees(pitch)), float(np.degrees(roll))


def _ned_from_angles(yaw_deg: float, pitch_deg: float, roll_deg: float) -> Matrix3:
    yaw, pitch, roll = np.radians([yaw_deg, pitch_deg, roll_deg])
    rz = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
    ry = np.array(
        [[np.cos(pitch), 0, np.sin(pitch)], [0, 1, 0], [-np.sin(pitch), 0, np.cos(pitch)]]
    )
    rx = np.array([[1, 0, 0], [0, np.cos(roll), -np.sin(roll)], [0, np.sin(roll), np.cos(roll)]])
    return rz @ ry @ rx


_NADIR_MOUNT = _ned_from_angles(
    0.0, -90.0, 0.0
)  # a gimbal's axes in those of the body that it hangs below
