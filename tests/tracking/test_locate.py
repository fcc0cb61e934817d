"""Places of detected objects against the truth of simulated flights and of cases worked by hand."""

from dataclasses import replace

import numpy as np
import pytest

from sorvolo.geometry.camera import Camera
from sorvolo.geometry.ground import footprint
from sorvolo.geometry.pose import Pose, rotation_from_vector, site_from_gimbal_rotation
from sorvolo.lab.simulation.flight import simulate_flight
from sorvolo.lab.simulation.settings import (
    ImagingSettings,
    MotionSettings,
    PathSettings,
    SceneSettings,
    SimulationSettings,
)
from sorvolo.lab.simulation.truth import coco_boxes
from sorvolo.survey.flight import CameraModel, CameraPrior
from sorvolo.survey.objects import CLASSES, TYPICAL_SIZE_M, Detections, no_detections
from sorvolo.tracking.following import GroundFollower
from sorvolo.tracking.laying import IMPOSSIBLE_SIZE, LocateSettings, locate
from sorvolo.tracking.tracker import Tracker, TrackerSettings

CAMERA = Camera.from_angle_of_view(960, 540, 62.0)
NADIR = site_from_gimbal_rotation(0.0, -90.0, 0.0)
PRIOR = CameraPrior(np.array([10.0, 20.0, 60.0]), np.full(3, 0.5), NADIR, np.array([0.5, 0.5, 1.0]))
EXACT = replace(PRIOR, position_sigma_m=np.zeros(3), attitude_sigma_deg=np.zeros(3))


def one(middle_px, label="car", side_px=40.0):
    x, y = np.asarray(middle_px) + 0.5
    box = [x - side_px / 2, y - side_px / 2, x + side_px / 2, y + side_px / 2]
    return Detections(np.array([box]), np.array([0.9]), np.array([CLASSES.index(label)]), CLASSES)


def place(found, prior=PRIOR, **more):
    (sighting,), unlocated = locate(found, 3, "3", 10**9, CAMERA, prior, **more)
    return sighting, unlocated


def test_below_the_camera_lies_what_is_in_the_middle():
    sighting, unlocated = place(one([CAMERA.cx_px, CAMERA.cy_px]))
    assert not unlocated
    assert sighting.position_m == pytest.approx([10.0, 20.0])
    half_m = 60 - TYPICAL_SIZE_M["car"][2] / 2
    assert sighting.size_m == pytest.approx([40 * half_m / CAMERA.fx_px] * 2)
    # 0.5 m of GPS with 0.5 degrees of tilt at 59.25 m, beside the box's own
    assert sighting.shared_sigma_m == pytest.approx(
        np.hypot(0.5, np.radians(0.5) * half_m), rel=0.01
    )
    assert sighting.sigma_m > sighting.shared_sigma_m


def test_what_is_far_too_short_for_its_class_is_set_aside():
    window_px = 0.8 * CAMERA.fx_px / 59.25  # of a car that is 0.8 m long
    sighting, unlocated = place(one([400.0, 300.0], side_px=window_px))
    assert sighting is None and unlocated == {IMPOSSIBLE_SIZE: 1}
    for found, prior in (
        (one([400.0, 300.0], side_px=5.0 * window_px), PRIOR),
        (one([400.0, 300.0], "person", window_px), PRIOR),
        (one([window_px / 2 - 0.5, 300.0], side_px=window_px), PRIOR),  # the picture's edge cuts it
        (
            one([400.0, 300.0], side_px=window_px),
            replace(PRIOR, position_sigma_m=np.array([0.5, 0.5, 40.0])),
        ),
    ):
        sighting, unlocated = place(found, prior)
        assert sighting is not None and not unlocated


def test_a_length_that_cars_seldom_have_counts_against_one():
    """As long as a bench: hardly a car, less surely so where the height is not known; people are not judged by it."""
    m_px = CAMERA.fx_px / 59.25
    high = replace(PRIOR, position_sigma_m=np.array([0.5, 0.5, 20.0]))
    scores = [
        place(one([400.0, 300.0], label, length_m * m_px), prior)[0].score
        for label, length_m, prior in (("car", 4.3, PRIOR), ("car", 2.6, high), ("car", 2.6, PRIOR))
    ]
    assert 0.89 < scores[0] < 0.9 and 0.7 < scores[1] < 0.9 and scores[2] < 0.4
    assert place(one([400.0, 300.0], "person", 0.4 * m_px))[0].score == 0.9
    cut = one([1.3 * m_px - 0.5, 300.0], "car", 2.6 * m_px)
    assert place(cut)[0].score == 0.9


def test_what_is_far_too_wide_for_its_class_is_set_aside():
    m_px = CAMERA.fx_px / 59.25
    sighting, unlocated = place(one([400.0, 300.0], "person", 6 * m_px))
    assert sighting is None and unlocated == {IMPOSSIBLE_SIZE: 1}
    for name, side_m in (("person", 3.0), ("car", 9.0)):
        sighting, _ = place(one([400.0, 300.0], name, side_m * m_px))
        assert sighting is not None
    unsure = replace(PRIOR, position_sigma_m=np.array([0.5, 0.5, 20.0]))
    assert place(one([400.0, 300.0], "person", 6 * m_px), unsure)[0] is not None


def test_the_middle_of_an_object_stands_above_its_foot():
    right_px = np.array([CAMERA.cx_px + CAMERA.fx_px, CAMERA.cy_px])  # 45 degrees to the east
    sighting, _ = place(one(right_px, "person"), EXACT)
    assert sighting.position_m == pytest.approx([10 + 60 - 0.85, 20.0], abs=1e-3)


@pytest.mark.parametrize("pitch_deg", [-90.0, -50.0])
@pytest.mark.parametrize(
    "what", ["east", "north", "up", "tilt x", "tilt y", "heading", "focal", "pixel"]
)
def test_each_part_of_the_sigma_is_what_moving_that_part_does(pitch_deg, what):
    prior = replace(EXACT, rotation=site_from_gimbal_rotation(30.0, pitch_deg, 0.0))
    settings = LocateSettings(0.0, 0.0, 0.0)
    found, small = one([300.0, 400.0]), 1e-4 if what != "pixel" else 0.05  # boxes are float32
    before = place(found, prior, settings=settings)[0].position_m
    axis = (
        ["east", "north", "up", "tilt x", "tilt y", "heading"].index(what)
        if what not in ("focal", "pixel")
        else 0
    )
    focal_sigma, camera = 0.0, CAMERA
    moved, known = prior, prior
    if what in ("east", "north", "up"):
        moved = replace(prior, position_m=prior.position_m + small * np.eye(3)[axis])
        known = replace(prior, position_sigma_m=small * np.eye(3)[axis])
    elif what == "focal":
        focal_sigma, camera = small, CAMERA.with_focal_px(CAMERA.fx_px * (1 + small))
    elif what == "pixel":
        found, settings = one([300.0, 400.0 + small]), LocateSettings(0.0, small, 0.0)
    else:
        turn = rotation_from_vector(small * np.eye(3)[axis - 3])
        moved = replace(prior, rotation=prior.rotation @ turn)
        known = replace(prior, attitude_sigma_deg=np.degrees(small) * np.eye(3)[axis - 3])
    ((after,), _) = locate(found, 3, "3", 0, camera, moved, settings=settings)
    step_m = after.position_m - before
    covariance = place(one([300.0, 400.0]), known, focal_sigma=focal_sigma, settings=settings)[
        0
    ].covariance_m2
    if what == "pixel":  # both directions err; the one that was moved lies within them
        assert step_m @ np.linalg.solve(covariance, step_m) == pytest.approx(1.0, rel=1e-2)
    else:
        assert covariance == pytest.approx(
            np.outer(step_m, step_m), rel=1e-2, abs=1e-3 * (step_m @ step_m)
        )


def test_the_middle_of_a_larger_box_is_known_less() -> None:
    """In shares of its side, from a pixel on."""
    box = LocateSettings(height_sigma_share=0.0)
    sigmas_m = [
        place(one([300.0, 400.0], side_px=side_px), EXACT, settings=box)[0].sigma_m
        for side_px in (60.0, 90.0)
    ]
    assert sigmas_m[1] == pytest.approx(1.5 * sigmas_m[0], rel=1e-3)
    m_per_px = (60 - TYPICAL_SIZE_M["car"][2] / 2) / CAMERA.fx_px
    (least,) = (place(one([479.5, 269.5], "person", 8.0), EXACT, settings=box)[0].sigma_m,)
    assert least == pytest.approx(m_per_px, rel=0.02)


def test_what_the_pictures_edge_cuts_lies_farther_out_than_its_box():
    whole_px = np.array([-37.0, 250.0, 33.0, 280.0])  # a car of 4.4 m, half of it in the picture
    whole, cut = (
        locate(Detections([box], [0.9], [CLASSES.index("car")], CLASSES), 0, "0", 0, CAMERA, EXACT)[
            0
        ][0]
        for box in (whole_px, np.clip(whole_px, 0, None))
    )
    box_m = 0.5 * 37 * whole.size_m[0] / 70  # by how much the middle of what is seen is off
    off_m = cut.position_m - whole.position_m
    assert abs(off_m[0]) < 0.5 * box_m and abs(off_m[1]) < 0.01
    assert off_m[0] ** 2 < 4 * cut.covariance_m2[0, 0]
    assert cut.covariance_m2[0, 0] > 4 * cut.covariance_m2[1, 1]
    inside_px = whole_px + np.array([60.0, 0.0, 60.0, 0.0])
    inside = locate(
        Detections([inside_px], [0.9], [CLASSES.index("car")], CLASSES), 0, "0", 0, CAMERA, EXACT
    )[0][0]
    assert inside.covariance_m2 == pytest.approx(whole.covariance_m2, rel=0.3, abs=0.02)


@pytest.mark.parametrize("speed_m_s", [2.0, 4.0])
def test_a_car_that_drives_into_the_picture_is_one_and_moves(speed_m_s):
    """It comes in over the left edge, eastwards, while the drone flies north."""
    tracker, random = Tracker(), np.random.default_rng(3)
    m_per_px = 59.25 / CAMERA.fx_px
    for frame in range(30):
        prior = replace(PRIOR, position_m=PRIOR.position_m + np.array([0.0, 1.2 * frame, 0.0]))
        x, y = -20.0 + 0.2 * speed_m_s * frame / m_per_px, 40.0 + 1.2 * frame / m_per_px
        box = np.array([x - 30, y - 13, x + 30, y + 13]) + random.normal(0, 1.5, 4)
        box = np.clip(box, 0, [960, 540, 960, 540])
        if box[2] - box[0] < 3 or box[3] - box[1] < 3 or random.random() < 0.2:
            continue
        found = Detections([box], [0.8], [CLASSES.index("car")], CLASSES)
        seen, _ = locate(found, frame, str(frame), int(frame * 2e8), CAMERA, prior)
        outline_m = footprint(CAMERA, Pose(prior.rotation, prior.position_m))
        tracker.update(seen, time_ns=int(frame * 2e8), footprint_m=outline_m)
    (track,) = tracker.finish()
    assert track.moving and track.velocity_m_s == pytest.approx([speed_m_s, 0.0], abs=0.6)


def test_a_height_model_is_met_where_the_ray_meets_it():
    def slope_m(places_m):
        return 0.2 * (places_m[:, 0] - 10.0)

    right_px = np.array([CAMERA.cx_px + 0.5 * CAMERA.fx_px, CAMERA.cy_px])
    sighting, _ = place(one(right_px), EXACT, ground_height_m=slope_m)
    east_m = sighting.position_m[0] - 10.0
    assert east_m == pytest.approx(0.5 * (60 - 0.75 - 0.2 * east_m), abs=0.05)
    nothing, unlocated = place(
        one(right_px), EXACT, ground_height_m=lambda places_m: np.full(len(places_m), np.nan)
    )
    assert nothing is None and "height model" in next(iter(unlocated))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"position_sigma_m": np.array([np.inf, np.inf, 1.0])}, "no fix"),
        ({"position_sigma_m": np.array([1.0, 1.0, np.inf])}, "height is not known"),
        ({"attitude_sigma_deg": np.array([np.inf, 1.0, 1.0])}, "tilt is not known"),
        ({"rotation": site_from_gimbal_rotation(0.0, 10.0, 0.0)}, "horizon"),
        ({"rotation": site_from_gimbal_rotation(0.0, -2.0, 0.0)}, "no better than"),
        ({"position_m": np.array([0.0, 0.0, -3.0])}, "not above the ground"),
    ],
)
def test_what_has_no_place_names_the_reason(change, words):
    sighting, unlocated = place(one([CAMERA.cx_px, CAMERA.cy_px]), replace(PRIOR, **change))
    assert sighting is None
    ((reason, count),) = unlocated.items()
    assert words in reason and count == 1


def test_an_unknown_heading_is_a_circle_about_the_point_below():
    unknown = replace(PRIOR, attitude_sigma_deg=np.array([0.5, 0.5, np.inf]))
    middle, _ = place(one([CAMERA.cx_px, CAMERA.cy_px]), unknown)
    edge, _ = place(one([CAMERA.cx_px + 400.0, CAMERA.cy_px]), unknown)
    assert middle.sigma_m < 1.5
    assert edge.sigma_m == pytest.approx(np.linalg.norm(edge.position_m - [10.0, 20.0]), rel=0.05)


def test_nothing_found_is_nothing_placed():
    assert locate(no_detections(CLASSES), 0, "0", 0, CAMERA, PRIOR)[0] == []


@pytest.mark.long
def test_places_from_sixty_metres_are_as_good_as_they_state():
    """Boxes of a simulated flight, GPS of 1.5 m, gimbal of 0.5 degrees: at most 2 m rms, 90 to 99 % in 2 sigma."""
    settings = SimulationSettings(
        seed=21,
        flights=1,
        scene=SceneSettings("dirt", people=12, cars=6, small_objects=6, has_scenery=False),
        path=PathSettings(height_m=60, speed_m_s=10, length_m=120, strips=2, strip_spacing_m=40),
        motion=MotionSettings(),
        imaging=ImagingSettings(960, 540, fps=1.0),
    )
    flight = simulate_flight(settings)
    frames = range(len(flight))
    truth = coco_boxes(flight, frames)
    things = {thing.id: thing for thing in flight.day.things}
    random = np.random.default_rng(5)
    errors_m, distances2 = [], []
    for index in frames:
        pose = flight.true_poses[index]
        rows = [
            row
            for row in truth["annotations"]
            if row["image_id"] == index and row["visibility"] > 0.95
        ]
        boxes = np.array([row["bbox"] for row in rows], float).reshape(-1, 4)
        boxes[:, 2:] += boxes[:, :2]
        found = Detections(
            boxes, np.ones(len(rows)), np.array([row["category_id"] - 1 for row in rows]), CLASSES
        )
        prior = CameraPrior(
            pose.translation_m + random.normal(0, 1.5, 3),
            np.full(3, 1.5),
            pose.rotation @ rotation_from_vector(np.radians(random.normal(0, 0.5, 3))),
            np.full(3, 0.5),
        )
        sightings, unlocated = locate(found, index, str(index), 0, flight.camera, prior)
        assert not unlocated
        for sighting, row in zip(sightings, rows):
            error_m = (
                sighting.position_m
                - things[row["object_id"]].place_m(float(flight.from_middle_s[index]))[:2]
            )
            errors_m.append(error_m)
            distances2.append(error_m @ np.linalg.solve(sighting.covariance_m2, error_m))
    assert len(errors_m) > 60
    rms_m = np.sqrt(np.mean(np.square(errors_m)))  # per axis
    inside = np.mean(
        np.array(distances2) < 5.991
    )  # the ellipse that holds 95 % of a Gaussian's places
    print(f"rms {rms_m:.2f} m per axis, {100 * inside:.1f} % inside, {len(errors_m)} places")
    assert rms_m < 2.0
    assert 0.90 <= inside <= 0.99


def test_a_pixel_covers_more_ground_the_farther_the_camera_looks():
    model = CameraModel(CAMERA, "given", 0.01)
    follower = GroundFollower(model, TrackerSettings(), None, knows_heading=True, is_video=True)
    tilted = replace(PRIOR, rotation=site_from_gimbal_rotation(0.0, -30.0, 0.0))
    assert follower.m_per_px(PRIOR) == pytest.approx(60 / CAMERA.fx_px)
    assert follower.m_per_px(tilted) == pytest.approx(120 / CAMERA.fx_px)
