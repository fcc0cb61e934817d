"""Control points that lie badly for a map are named in words; points over the whole area are not."""

import numpy as np
import pytest

from sorvolo.mosaic.control import layout_remarks

_CAMERAS_M = np.column_stack(
    [each.ravel() for each in np.meshgrid(np.linspace(-100, 100, 9), [-60.0, 0.0, 60.0])]
)
_STRIP_M = np.column_stack([np.linspace(-400, 400, 30), np.zeros(30)])
_CORNERS_M = np.array([[-90.0, -50], [90, -50], [90, 50], [-90, 50], [0, 5]])
_LINE_M = np.array([[-80.0, 0.2], [-30, -0.3], [10, 0.1], [70, 0.0]])


@pytest.mark.parametrize(
    "points_m, cameras_m, words",
    [
        (_CORNERS_M, _CAMERAS_M, ""),
        (_LINE_M, _CAMERAS_M, "lie on one line"),
        (0.1 * _CORNERS_M + [70, 40], _CAMERAS_M, "reach over"),
        (
            _CORNERS_M * [4.0, 0.2],
            _STRIP_M,
            "",
        ),  # to both sides of one long strip, as wide as its pictures
        (_LINE_M * [4.0, 1.0], _STRIP_M, "lie on one line"),
    ],
    ids=["spread", "line", "corner", "strip", "line along a strip"],
)
def test_badly_laid_points_are_named(
    points_m: np.ndarray, cameras_m: np.ndarray, words: str
) -> None:
    turn = np.array([[0.8, -0.6], [0.6, 0.8]])
    remarks = layout_remarks(points_m @ turn, cameras_m @ turn, 60.0)
    assert len(remarks) == bool(words) and all(words in each for each in remarks)
