"""A corrected flight as other programs read it."""

import csv
from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pytest

from sorvolo.geometry.pose import gimbal_angles_from_rotation, site_from_gimbal_rotation
from sorvolo.store.exports.telemetry_files import cot_track, geo_txt, is_dated, track_csv, track_gpx
from sorvolo.survey.corrected import CorrectedFrame

FRAME = CorrectedFrame(
    "0001.jpg",
    0,
    1_700_000_000_000_000_000,
    0.0,
    45.0,
    7.0,
    330.0,
    30.0,
    0.0,
    -90.0,
    0.0,
    0.5,
    60.0,
    40.0,
    "vision",
)
ENU_FROM_NED = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])


def _about(axis: int, angle_deg: float) -> np.ndarray:
    """A right-handed turn about x, y or z."""
    one, two = (axis + 1) % 3, (axis + 2) % 3
    turn, angle = np.eye(3), np.radians(angle_deg)
    turn[one, one] = turn[two, two] = np.cos(angle)
    turn[two, one], turn[one, two] = np.sin(angle), -np.sin(angle)
    return turn


def _read_by_odm(line: str) -> np.ndarray:
    """(3, 3) site_from_camera by OpenDroneMap's compute_opk: cnb = Rz(yaw) Ry(pitch) Rx(roll) takes a body, x to the
    picture's top, y to its right, z along the view, to north, east, down."""
    yaw_deg, pitch_deg, roll_deg = (float(each) for each in line.split()[4:7])
    ned_from_body = _about(2, yaw_deg) @ _about(1, pitch_deg) @ _about(0, roll_deg)
    top, right, view = ned_from_body.T
    return ENU_FROM_NED @ np.column_stack([right, -top, view])


@pytest.mark.parametrize(
    "gimbal_deg",
    [
        (299.086, -88.071, 151.882),
        (91.0, -90.0, 0.0),
        (40.0, -60.0, 0.0),
        (200.0, -85.0, 35.0),
        (10.0, -30.0, -170.0),
    ],
)
def test_odm_reads_the_attitude_that_the_camera_had(gimbal_deg: tuple[float, float, float]) -> None:
    """Pitch plus 90 beside a gimbal's yaw and roll was off by 113 degrees where the roll is not near 0."""
    site_from_camera = site_from_gimbal_rotation(*gimbal_deg)
    yaw_deg, pitch_deg, roll_deg = gimbal_angles_from_rotation(site_from_camera)
    frame = replace(FRAME, yaw_deg=yaw_deg, pitch_deg=pitch_deg, roll_deg=roll_deg)
    line = geo_txt([frame]).splitlines()[1]
    np.testing.assert_allclose(_read_by_odm(line), site_from_camera, atol=1e-4)


def test_a_camera_straight_down_has_no_pitch_and_roll_for_odm() -> None:
    angles_deg = [
        float(each) for each in geo_txt([replace(FRAME, yaw_deg=91.0)]).splitlines()[1].split()[4:7]
    ]
    assert angles_deg == pytest.approx([91.0, 0.0, 0.0], abs=1e-3)


def test_names_with_spaces_keep_the_columns_of_geo_txt() -> None:
    line = geo_txt([replace(FRAME, name="IMG  IMG 0001.jpg")]).splitlines()[1]
    assert line.split()[0] == "IMG__IMG_0001.jpg" and len(line.split()) == 9


def test_no_time_is_invented_for_a_flight_without_a_date() -> None:
    """Its frames count from 1970."""
    undated = [replace(FRAME, time_ns=k * 10**9) for k in range(2)]
    assert not is_dated(undated) and is_dated([FRAME])
    rows, dated = (
        list(csv.DictReader(track_csv(frames, "ellipsoidal").splitlines()))
        for frames in (undated, [FRAME])
    )
    assert [row["utc"] for row in rows] == ["", ""] and rows[1]["height_reference"] == "ellipsoidal"
    assert dated[0]["utc"].startswith("2023-11-14T22:13:20")
    assert b"<time>" not in track_gpx(undated, "f") and b"<time>2023-11-14" in track_gpx(
        [FRAME], "f"
    )


def test_the_azimuth_of_a_camera_that_looks_down_does_not_swing() -> None:
    """It trembles about the vertical on a strip to the east, the top of the picture ahead."""
    down = site_from_gimbal_rotation(91.0, -90.0, 0.0)
    frames = []
    for tilt_deg, side_deg in ((2.0, 0.0), (-2.0, 1.0), (0.5, -3.0), (-1.0, -1.0)):
        rotation = down @ _about(0, tilt_deg) @ _about(1, side_deg)
        yaw_deg, pitch_deg, roll_deg = gimbal_angles_from_rotation(rotation)
        frames.append(replace(FRAME, yaw_deg=yaw_deg, pitch_deg=pitch_deg, roll_deg=roll_deg))
    assert np.ptp([each.yaw_deg for each in frames]) > 90
    frames.append(replace(FRAME, yaw_deg=200.0, pitch_deg=-45.0, roll_deg=3.0))
    lines = cot_track(frames, "f", is_ellipsoidal=True).splitlines()
    *straight, oblique = (ElementTree.fromstring(line).find("detail/sensor") for line in lines)
    for sensor in straight:
        assert sensor is not None and float(sensor.get("elevation", "0")) < -86
        assert float(sensor.get("azimuth", "0")) + float(sensor.get("roll", "0")) == pytest.approx(
            91.0, abs=0.2
        )
    assert oblique is not None and (oblique.get("azimuth"), oblique.get("roll")) == ("200.0", "3.0")
