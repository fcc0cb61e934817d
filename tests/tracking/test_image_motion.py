"""Sightings in the first picture's pixels, from pictures cut out of a larger one along a known way."""

import cv2
import numpy as np
import pytest

from sorvolo.survey.flight import Frame
from sorvolo.survey.objects import CLASSES, Detections
from sorvolo.tracking.following import PictureFollower
from sorvolo.tracking.image_motion import ImageMotion
from sorvolo.tracking.tracker import IN_PICTURES, Tracker, TrackerSettings

WIDTH, HEIGHT = 640, 360


def ground(seed=1, side=1600):
    random = np.random.default_rng(seed)
    picture = sum(
        cv2.resize(random.random((side // step, side // step)), (side, side)) * step**0.5
        for step in (4, 10, 40)
    )
    return np.uint8(255 * (picture - picture.min()) / np.ptp(picture))


def cut(picture, middle, turn_deg=0.0, scale=1.0):
    """A view of the ground, and (2, 3) ground from its pixels."""
    c, s = scale * np.cos(np.radians(turn_deg)), scale * np.sin(np.radians(turn_deg))
    turn = np.array([[c, -s], [s, c]])
    ground_from_view = np.column_stack([turn, np.asarray(middle) - turn @ [WIDTH / 2, HEIGHT / 2]])
    view = cv2.warpAffine(
        picture, ground_from_view, (WIDTH, HEIGHT), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    )
    return np.dstack([view] * 3), ground_from_view


def at(points_px, side=16.0):
    boxes = np.array(
        [
            [x + 0.5 - side / 2, y + 0.5 - side / 2, x + 0.5 + side / 2, y + 0.5 + side / 2]
            for x, y in points_px
        ]
    ).reshape(-1, 4)
    return Detections(boxes, np.full(len(boxes), 0.9), np.zeros(len(boxes), np.int64), CLASSES)


def view_from_ground(ground_from_view, point):
    return np.linalg.solve(
        ground_from_view[:, :2], np.asarray(point, float) - ground_from_view[:, 2]
    )


def fly(motion, picture, poses, target, start=0):
    """Where a point of the ground comes out of each view."""
    places = []
    for number, pose in enumerate(poses, start=start):
        image, ground_from_view = cut(picture, *pose)
        found = at([view_from_ground(ground_from_view, target)])
        (sighting,), outline = motion.locate(
            found, Frame(number, str(number), number * 10**8, image), number * 10**8
        )
        places.append((sighting, outline))
    return places


def test_a_point_of_the_ground_stays_where_it_was():
    steps = np.arange(60)
    poses = [((500 + 8 * k, 500 + 3 * k), 0.4 * k, 1 + 0.003 * k) for k in steps]
    motion = ImageMotion()
    places = fly(motion, ground(), poses, (650.0, 550.0))
    _, first = cut(ground(), *poses[0])
    errors = np.array(
        [sighting.position_m - view_from_ground(first, (650.0, 550.0)) for sighting, _ in places]
    )
    assert np.abs(errors).max() < 3.0
    assert motion.segments == 1 and motion.guessed == 0
    sighting, outline = places[-1]
    assert sighting.shared_sigma_m > places[5][0].shared_sigma_m  # the way drifts
    assert np.linalg.norm(errors[-1]) < 3 * sighting.sigma_m
    assert sighting.size_m == pytest.approx([16 * 1.177] * 2, rel=0.02)
    assert outline.shape == (4, 2)


def test_a_cut_begins_anew_and_is_counted():
    motion = ImageMotion()
    before = fly(motion, ground(1), [((500 + 5 * k, 500),) for k in range(5)], (520.0, 500.0))
    after = fly(
        motion, ground(2), [((900 + 5 * k, 800),) for k in range(5)], (920.0, 800.0), start=5
    )
    assert motion.segments == 2
    assert after[0][1] == pytest.approx(before[0][1])  # the outline of a first picture, both
    assert after[0][0].shared_sigma_m == 0.0
    assert np.ptp([sighting.position_m for sighting, _ in after], axis=0).max() < 2.0


def test_one_blank_picture_does_not_lose_the_way():
    picture, motion = ground(), ImageMotion()
    poses = [((500 + 6 * k, 500),) for k in range(12)]
    blank = Frame(12, "12", 12 * 10**8, np.full((HEIGHT, WIDTH, 3), 90, np.uint8))
    before = fly(motion, picture, poses, (560.0, 520.0))
    motion.locate(at([]), blank, blank.time_ns)
    after = fly(motion, picture, [((578, 500),), ((584, 500),)], (560.0, 520.0), start=13)
    assert motion.guessed == 1 and motion.segments == 1
    assert after[-1][0].position_m == pytest.approx(before[0][0].position_m, abs=2.0)


def test_a_large_step_is_found():
    motion = ImageMotion()
    places = fly(motion, ground(), [((500 + 130 * k, 500),) for k in range(4)], (560.0, 520.0))
    assert motion.segments == 1 and motion.guessed == 0
    assert np.ptp([sighting.position_m for sighting, _ in places], axis=0).max() < 2.0


def test_an_object_that_the_camera_passes_is_one_track_that_stands():
    motion, tracker = ImageMotion(), Tracker(IN_PICTURES)
    way = np.concatenate([np.arange(0, 50), np.arange(50, 0, -1)])  # there and back
    for sighting, outline in fly(
        motion, ground(), [((500 + 12 * k, 500),) for k in way], (600.0, 520.0)
    ):
        middle = (sighting.box_px[:2] + sighting.box_px[2:]) / 2
        seen = [sighting] if (middle > 0).all() and (middle < (WIDTH, HEIGHT)).all() else []
        tracker.update(seen, time_ns=sighting.time_ns, footprint_m=outline)
    (track,) = tracker.finish()
    assert not track.moving and track.passes == 2


@pytest.mark.parametrize("step_px", [(6.0, 1.0), (-2.0, 2.0), (13.0, -4.0)])
def test_a_car_that_drives_is_one_moving_track_beside_one_that_stands(step_px):
    """Without telemetry, from a camera that flies on and turns; one in five views of each is missed."""
    random = np.random.default_rng(5)
    follower, picture, stands = (
        PictureFollower(TrackerSettings(sure_score=0.3)),
        ground(),
        np.array([700.0, 430.0]),
    )
    for number in range(40):
        image, ground_from_view = cut(picture, (560 + 6 * number, 500), turn_deg=0.4 * number)
        drives = np.array([620.0, 520.0]) + number * np.array(step_px)
        shown = [view_from_ground(ground_from_view, place) for place in (stands, drives)]
        shown = [
            place
            for place in shown
            if random.random() < 0.8
            and (place > 10).all()
            and (place < (WIDTH - 10, HEIGHT - 10)).all()
        ]
        found = at(shown, side=24.0)
        cars = Detections(found.boxes_px, found.scores, np.ones(len(found), np.int64), CLASSES)
        time_ns = number * 10**8
        follower.take(Frame(number, str(number), time_ns, image), time_ns, cars)
    tracks = [each for each in follower.finish() if each.confirmed]
    assert sorted(each.moving for each in tracks) == [False, True]
    (moving,) = (each for each in tracks if each.moving)
    np.testing.assert_allclose(moving.velocity_m_s, 10 * np.array(step_px), atol=8.0)
