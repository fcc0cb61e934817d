"""Turned pictures: boxes come back to their place; and which cameras look down."""

import numpy as np
import pytest

from sorvolo.detection.fusing import is_from_above, turned, turned_back
from sorvolo.geometry.pose import site_from_gimbal_rotation


@pytest.mark.parametrize("quarters", [0, 1, 2, 3])
def test_boxes_of_a_turned_picture_lie_where_the_things_are(quarters: int) -> None:
    picture = np.zeros((60, 100, 3), np.uint8)
    picture[5:15, 70:90] = 255
    rows, columns = np.nonzero(turned(picture, quarters)[..., 0])
    box = np.array([[columns.min(), rows.min(), columns.max() + 1, rows.max() + 1]], np.float32)
    np.testing.assert_array_equal(turned_back(box, quarters, (60, 100)), [[70, 5, 90, 15]])


@pytest.mark.parametrize(
    ("pitch_deg", "above"), [(-90, True), (-60, True), (-45, False), (0, False)]
)
def test_which_cameras_look_down(pitch_deg: float, above: bool) -> None:
    assert is_from_above(site_from_gimbal_rotation(30.0, pitch_deg, 0.0)) == above
