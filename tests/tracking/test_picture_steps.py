"""How a whole picture moves, from pictures cut out of a larger one by known homographies."""

import cv2
import numpy as np
import pytest
from test_image_motion import HEIGHT, WIDTH, cut, ground

from sorvolo.tracking.image_motion import PictureSteps

FULL_WIDTH = 2 * WIDTH  # of the picture of which these are small copies


def seen(picture, ground_from_view):
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return cv2.warpPerspective(picture, ground_from_view, (WIDTH, HEIGHT), flags=flags)


def moved(to_from, points):
    homogeneous = np.column_stack([points, np.ones(len(points))]) @ to_from.T
    return homogeneous[:, :2] / homogeneous[:, 2:]


def test_a_step_takes_the_ground_where_an_aslant_camera_shows_it():
    picture = ground(side=2000)
    aslant = np.array([[1.0, 0.15, 500.0], [0.0, 1.2, 600.0], [0.0, 4e-4, 1.0]])
    forward = np.array([[1.0, 0.02, 4.0], [-0.02, 1.0, 14.0], [0.0, 0.0, 1.0]])
    steps = PictureSteps()
    assert steps.add(0, seen(picture, aslant), FULL_WIDTH) is None
    step = steps.add(10**8, seen(picture, forward @ aslant), FULL_WIDTH)
    assert (step.from_ns, step.to_ns) == (0, 10**8)
    points = np.array(
        [
            [30.0, 30],
            [WIDTH - 30, 40],
            [WIDTH / 2, 180],
            [40, HEIGHT - 40],
            [WIDTH - 40, HEIGHT - 30],
        ]
    )
    expected = moved(np.linalg.inv(forward @ aslant) @ aslant, points)
    found = moved(step.to_from, 2 * points + 0.5)
    assert np.abs(found - (2 * expected + 0.5)).max() < 1.5
    assert np.abs(expected - points).max() > 10  # far more than the error
    assert (
        np.ptp(np.linalg.norm(expected - points, axis=1)) > 4
    )  # near ground moves faster: no shift would do


def test_what_moves_on_the_ground_does_not_carry_it():
    steps = PictureSteps()
    for number in range(2):
        view = np.ascontiguousarray(cut(ground(), (700 + 6 * number, 700))[0][..., 0])
        view[100 + 12 * number : 180 + 12 * number, 200:320] = ground(2)[
            :80, :120
        ]  # a truck with a pattern
        step = steps.add(number * 10**8, view, WIDTH)
    assert moved(step.to_from, np.array([[260.0, 150.0]]))[0] == pytest.approx([254, 150], abs=0.5)


def test_pictures_of_other_ground_or_of_nothing_are_no_step():
    steps = PictureSteps()
    views = [np.ascontiguousarray(cut(ground(seed), (700, 700))[0][..., 0]) for seed in (1, 2)]
    assert steps.add(0, views[0], WIDTH) is None
    assert steps.add(10**8, views[1], WIDTH) is None  # a cut
    assert steps.add(2 * 10**8, np.full_like(views[0], 90), WIDTH) is None
    assert steps.add(3 * 10**8, views[1], WIDTH) is None
    assert steps.add(4 * 10**8, views[1], WIDTH) is not None
    assert steps.add(4 * 10**8, views[1], WIDTH) is None  # no time has passed
    assert steps.add(5 * 10**8, views[1][::2, ::2], WIDTH) is None  # another size
