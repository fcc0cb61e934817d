"""Headings of photos by the ground that they share."""

import cv2
import numpy as np
import pytest

from sorvolo.geometry.camera import Camera
from sorvolo.geometry.pose import site_from_gimbal_rotation
from sorvolo.survey.flight import CameraPrior, Frame
from sorvolo.tracking.headings import PhotoHeadings

CAMERA = Camera(480, 360, 400.0, 400.0, 239.5, 179.5)
HEIGHT_M, M_PER_PX = 40.0, 0.1  # the ground's picture is as fine as a photo
RNG = np.random.default_rng(5)
GROUND = cv2.resize(
    RNG.integers(0, 256, (220, 220, 3)).astype(np.uint8),
    (1760, 1760),
    interpolation=cv2.INTER_CUBIC,
)
STRIP = [(-20.0 + 8.0 * k, -16.0 + 8.0 * k) for k in range(6)]


def photo(place_m: tuple[float, float], heading_deg: float) -> np.ndarray:
    """What the camera sees straight down from there; the ground's middle is the site's zero."""
    angle = np.radians(heading_deg)
    down = -np.array([np.sin(angle), np.cos(angle)])  # east, north
    right = np.array([np.cos(angle), -np.sin(angle)])
    flip = np.array([1.0, -1.0])  # rows of the picture go south
    turn = np.column_stack([right * flip, down * flip])
    middle = np.array([880.0, 880.0]) + np.array(place_m) * flip / M_PER_PX
    matrix = np.column_stack([turn, middle - turn @ np.array([239.5, 179.5])])
    return cv2.warpAffine(GROUND, matrix, (480, 360), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)


def prior(
    place_m: tuple[float, float], heading_deg: float, sigma_deg: float = 4.0, tilt_deg: float = 1.0
) -> CameraPrior:
    return CameraPrior(
        np.array([*place_m, HEIGHT_M]),
        np.array([0.5, 0.5, 1.0]),
        site_from_gimbal_rotation(heading_deg, -90.0, 0.0),
        np.array([tilt_deg, tilt_deg, sigma_deg]),
    )


def heading_deg(seen: CameraPrior) -> float:
    top = -seen.rotation[:, 1]
    return float(np.degrees(np.arctan2(top[0], top[1])) % 360)


def frame(image: np.ndarray, number: int) -> Frame:
    return Frame(number, f"{number}.jpg", number * 2 * 10**9, image)


@pytest.mark.parametrize("off_deg", [0.0, 7.0, 12.0, -20.0])
def test_a_compass_that_is_a_little_off_is_corrected_by_what_is_sure(off_deg):
    headings = PhotoHeadings(CAMERA)
    for number, place_m in enumerate(STRIP):
        seen = headings.take(frame(photo(place_m, 45.0), number), prior(place_m, 45.0 + off_deg))
        left_deg = abs(heading_deg(seen) - 45)
        assert number == 0 or left_deg < (5.0 if abs(off_deg) > 10 else abs(off_deg) + 0.01)


@pytest.mark.parametrize("off_deg", [180.0, 90.0, -60.0])
def test_a_strip_with_wrong_headings_is_turned_right(off_deg):
    headings = PhotoHeadings(CAMERA)
    for number, place_m in enumerate(STRIP):
        wrong = off_deg if 2 <= number < 5 else 0.0
        image = photo(place_m, 45.0)
        seen = headings.take(frame(image, number), prior(place_m, 45.0 + wrong))
        assert abs((heading_deg(seen) - 45 + 180) % 360 - 180) < 3
        assert (
            seen.attitude_sigma_deg[2] == 4.0
            if not wrong
            else 4.0 < seen.attitude_sigma_deg[2] < 20
        )
    assert len(headings.error.turns_deg) == 3


def test_a_photo_that_shows_nothing_shares_the_error_of_the_one_before():
    headings = PhotoHeadings(CAMERA)
    headings.see(
        frame(photo(STRIP[1], 45.0), 1), prior(STRIP[1], 225.0)
    )  # so that the first one is held against the second
    for number, place_m in enumerate(STRIP[:4]):
        image = np.full((360, 480, 3), 90, np.uint8) if number == 2 else photo(place_m, 45.0)
        seen = headings.take(frame(image, number), prior(place_m, 225.0))
        assert abs(heading_deg(seen) - 45) < 4
    assert len(headings.error.turns_deg) == 4


def test_a_photo_without_a_heading_stays_without():
    headings = PhotoHeadings(CAMERA)
    for number, place_m in enumerate(STRIP[:3]):
        given = prior(place_m, 0.0, np.inf)
        assert headings.take(frame(photo(place_m, 130.0), number), given) is given


@pytest.mark.parametrize(("step_m", "tilt_deg"), [(1.0, 1.0), (8.0, 15.0)])
def test_what_photos_show_too_badly_changes_nothing(step_m, tilt_deg):
    headings = PhotoHeadings(CAMERA)
    for number, place_m in enumerate(((0.0, 0.0), (step_m, 0.0))):
        given = prior(place_m, 180.0, tilt_deg=tilt_deg)
        assert headings.take(frame(photo(place_m, 0.0), number), given) is given
