"""Things planted into a frame: where they belong, as large, as soft and as bright as what is there."""

import cv2
import numpy as np
import pytest

from sorvolo.geometry.camera import Camera
from sorvolo.geometry.pose import Pose
from sorvolo.geometry.sun import direction_from_angles, sun_direction
from sorvolo.lab.simulation.flight import line_kernel
from sorvolo.search.drawing.planted import FrameLight, frame_light, new_plant, plant

HEIGHT_M, FOCAL_PX = 30.0, 600.0
CAMERA = Camera(640, 480, FOCAL_PX, FOCAL_PX, 319.5, 239.5)
POSE = Pose(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, HEIGHT_M]))


def _light(**others: object) -> FrameLight:
    known = {
        "gain": np.ones(3),
        "haze": np.zeros(3),
        "blur_px2": 0.1 * np.eye(2),
        "noise": 0.0,
        "shadow": 1.0,
        "is_thermal": False,
    }
    return FrameLight(**(known | others))  # type: ignore[arg-type]


def _grey(level: int = 110) -> np.ndarray:
    return np.full((480, 640, 3), level, np.uint8)


def _ground(seed: int = 1) -> np.ndarray:
    rng = np.random.default_rng(seed)
    field = cv2.GaussianBlur(rng.normal(size=(480, 640)).astype(np.float32), (0, 0), 6)
    picture = np.where(field > 0.02, 150, 70)[..., None] * np.array([0.9, 1.0, 0.5])
    return np.asarray(cv2.GaussianBlur(picture.astype(np.float32), (0, 0), 0.4))


def test_a_car_stands_where_it_is_planted_as_large_as_it_is() -> None:
    car = new_plant(1, "car", np.array([4.0, -3.0]), 7)
    box = plant(_grey(), CAMERA, POSE, [car], _light(), None, 1).boxes_px[0]
    middle = (box[:2] + box[2:]) / 2
    assert np.hypot(*(middle - [319.5 + 4 * 20, 239.5 + 3 * 20])) < 8
    longest_m = float((box[2:] - box[:2]).max()) / 20
    assert 0.7 * car.size_m[0] < longest_m < 1.3 * car.size_m[0]


def test_shadows_fall_away_from_the_sun_and_an_overcast_sky_throws_none() -> None:
    person = [new_plant(3, "car", np.array([0.0, 0.0]), 2)]
    sunny = plant(_grey(), CAMERA, POSE, person, _light(), direction_from_angles(180, 30), 1)
    box = sunny.boxes_px[0].astype(int)
    above = sunny.image[box[1] - 12 : box[1] - 4, box[0] + 5 : box[2] - 5].mean()
    below = sunny.image[box[3] + 6 : box[3] + 14, box[0] + 5 : box[2] - 5].mean()
    assert above < 80 and below == pytest.approx(
        110, abs=2
    )  # the sun stands in the south: shadows fall north, upwards
    cloudy = plant(
        _grey(), CAMERA, POSE, person, _light(shadow=0.0), direction_from_angles(180, 30), 1
    )
    assert cloudy.image[box[1] - 12 : box[1] - 4, box[0] + 5 : box[2] - 5].mean() == pytest.approx(
        110, abs=2
    )


def test_what_is_out_of_sight_has_no_box_and_leaves_the_picture() -> None:
    planted = plant(
        _grey(),
        CAMERA,
        POSE,
        [new_plant(1, "car", np.array([90.0, 0.0]), 7)],
        _light(),
        None,
        1,
    )
    assert np.isnan(planted.boxes_px).all() and (planted.image == 110).all()


@pytest.mark.parametrize("sigma_px", [1.0, 2.0, 3.0])
def test_blur_is_measured_by_the_pictures_own_edges(sigma_px: float) -> None:
    blurred = cv2.GaussianBlur(_ground(), (0, 0), sigma_px)
    assert frame_light(blurred.astype(np.uint8)).blur_px == pytest.approx(sigma_px, rel=0.3)


def test_motion_blur_is_longer_along_the_motion() -> None:
    moved = cv2.filter2D(_ground(), -1, line_kernel(np.array([9.0, 0.0])))
    blur_px2 = frame_light(moved.astype(np.uint8)).blur_px2
    assert blur_px2[0, 0] > 2.5 * blur_px2[1, 1]


def test_dark_noisy_and_thermal_frames_are_distinguished() -> None:
    rng = np.random.default_rng(2)
    noisy = np.clip(_ground() + rng.normal(0, 6, (480, 640, 3)), 0, 255).astype(np.uint8)
    assert frame_light(noisy).noise == pytest.approx(6, rel=0.3)
    dark = (0.4 * _ground()).astype(np.uint8)
    assert not frame_light(dark).is_thermal
    assert frame_light(dark).gain[0] < 0.6 * frame_light(_ground().astype(np.uint8)).gain[0]
    warm = np.full((480, 640), 90.0)
    warm[200:206, 300:306] = 230
    picture = np.dstack([warm + rng.normal(0, 2, warm.shape)] * 3).astype(np.uint8)
    light = frame_light(picture)
    assert light.is_thermal and light.gain[0] > 0
    assert frame_light(255 - picture).is_thermal


def test_a_person_is_warm_in_a_thermal_frame() -> None:
    person = [new_plant(1, "person", np.array([0.0, 0.0]), 3)]
    light = _light(gain=np.ones(3), haze=np.full(3, 90.0), is_thermal=True, shadow=0.0)
    planted = plant(_grey(90), CAMERA, POSE, person, light, direction_from_angles(180, 30), 1)
    box = planted.boxes_px[0].astype(int)
    assert planted.image[box[1] : box[3], box[0] : box[2]].max() > 120
    assert planted.image.min() >= 85  # no shadow


def test_the_sun_at_noon_of_the_equinox_and_by_an_almanac() -> None:
    noon = sun_direction(
        1_710_936_000_000_000_000, 0.0, 1.9
    )  # 2024-03-20 12:00 UTC, the equation of time is -7.5 min
    assert noon[2] > 0.9998
    # NOAA's calculator: Rome, 2024-06-21 10:00 UTC: azimuth 132.5, elevation 65.5 degrees
    east, north, up = sun_direction(1_718_964_000_000_000_000, 41.9, 12.5)
    assert np.degrees(np.arcsin(up)) == pytest.approx(65.5, abs=1.0)
    assert np.degrees(np.arctan2(east, north)) == pytest.approx(132.5, abs=3.0)
