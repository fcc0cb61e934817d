"""Placed frames as the canvas and the records need them."""

import numpy as np
import pytest

from sorvolo.geometry.camera import Camera
from sorvolo.geometry.geodesy import Geodetic
from sorvolo.geometry.grid import SiteGrid
from sorvolo.geometry.ground import footprint
from sorvolo.geometry.homography import site_from_image_homography
from sorvolo.geometry.pose import Pose, site_from_gimbal_rotation
from sorvolo.mosaic.placing import canvas_frame, map_m_per_px
from sorvolo.survey.mosaic import PlacedFrame, Status

CAMERA = Camera.from_angle_of_view(320, 240, 60)
SITE_GRID = SiteGrid.at(Geodetic(41.89, 12.6), 0.05, "EPSG:32633")


def laid(pitch_deg: float):
    pose = Pose(site_from_gimbal_rotation(30, pitch_deg, 0), np.array([150.0, -80.0, 20.0]))
    frame = canvas_frame(
        4,
        1,
        CAMERA,
        site_from_image_homography(CAMERA, pose),
        SITE_GRID,
        np.full(3, 1.1),
        np.zeros(2),
        None,
    )
    return pose, frame


def test_a_picture_is_laid_where_its_corners_are():
    pose, frame = laid(-80)
    assert (frame.id, frame.rank, frame.width_px, frame.height_px) == (4, 1, 320, 240)
    assert np.abs(frame.outline_px - SITE_GRID.grid_from_site(footprint(CAMERA, pose))).max() < 0.01


def test_a_map_is_as_fine_as_the_survey_and_not_as_the_climb_before_it():
    assert map_m_per_px([20.1, 19.8, 20.4, 19.9], 1000.0) == 0.02
    assert map_m_per_px([0.2, 0.3, 2.0, 6.0, 11.0, 20.1, 19.8], 1000.0) == pytest.approx(
        0.02, rel=0.05
    )
    assert map_m_per_px([1.0, 2.0, 3.0, 4.0], 1000.0, climb_m=18.0) == pytest.approx(0.0205)
    assert map_m_per_px([20.1, 19.8, 20.4, 19.9], 1000.0, climb_m=0.4) == 0.02


def test_a_picture_that_sees_the_horizon_is_not_laid():
    assert laid(-15)[1] is None


def test_the_record_of_a_rejected_frame_names_the_reason_and_has_no_place():
    record = PlacedFrame.rejected(3, "IMG_3.jpg", 17, "blurred", CAMERA)
    assert (record.status, record.reason, record.name, record.time_ns) == (
        Status.REJECTED,
        "blurred",
        "IMG_3.jpg",
        17,
    )
    assert record.site_from_camera is None
    assert np.isnan(record.outline_m).all() and np.isnan(record.site_from_image).all()
    assert np.isnan(record.residual_px) and np.isnan(record.sigma_m)
