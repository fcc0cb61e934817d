"""Two pictures of one date show whether the ground is level on which a camera of the other date could see something."""

import cv2
import numpy as np
import pytest
from blob_world import HEIGHT, M_PER_PX, WIDTH, Thing, picture, site_from_image, view_of

from sorvolo.change.levelness import (
    LaidPicture,
    Sights,
    is_level,
    seen_at_m,
    surroundings,
)

OUTLINE = Thing(0, 0).outline_m()
WINDOW = surroundings(OUTLINE.min(axis=0), OUTLINE.max(axis=0), M_PER_PX)
OTHER = np.array([0.0, 5.0, 15.0])


def laid(camera_m, things, off_px=0, gray=None):
    """A picture with noise, laid on the window; one of even gray where it is given."""
    rng = np.random.default_rng(round(1000 + 100 * camera_m[0]))
    image = picture(camera_m, things, 0.0) if gray is None else np.full((HEIGHT, WIDTH, 3), gray)
    image = np.clip(image + rng.normal(0, 2, image.shape), 0, 255).astype(np.uint8)
    off = np.array([[1, 0, off_px], [0, 1, 0], [0, 0, 1.0]])
    patch_from_image = off @ np.linalg.inv(WINDOW.site_from_patch) @ site_from_image(camera_m)
    known = cv2.warpPerspective(
        np.ones((HEIGHT, WIDTH), np.uint8), patch_from_image, WINDOW.size_px
    )
    rgb = cv2.warpPerspective(image, patch_from_image, WINDOW.size_px)
    return LaidPicture.of(rgb, known > 0, WINDOW, np.array(camera_m, float))


CAMERAS = (-2.0, 0.0, 15.0), (2.0, 0.5, 15.0)
WALL = {"colour": (90, 90, 140)}


@pytest.mark.parametrize(
    ("things", "level"),
    [
        ([], True),
        ([Thing(0, 0)], True),  # something flat is ground as well
        (
            [Thing(0, 0, (8, 8), 4.0, **WALL), Thing(0, 0, (1, 1), 4.0)],
            False,
        ),  # something flat on a roof
        (
            [Thing(0, 1.5, (6, 1), 4.0, **WALL)],
            False,
        ),  # a wall beside it, between it and the other camera
        ([Thing(0, -3.0, (6, 1), 4.0, **WALL)], True),  # a wall behind it hides nothing
    ],
)
def test_ground_is_level_where_pictures_of_one_date_agree_and_nowhere_else(things, level):
    assert is_level([laid(each, things) for each in CAMERAS], OUTLINE, OTHER) is level


def test_pictures_of_one_date_may_lie_a_little_off_each_other():
    assert is_level([laid(CAMERAS[0], []), laid(CAMERAS[1], [], off_px=2)], OUTLINE, OTHER)


@pytest.mark.parametrize(
    "pictures",
    [
        [laid(CAMERAS[0], [])],
        [laid(CAMERAS[0], []), laid((-1.9, 0, 15.0), [])],  # hardly apart
        [laid(each, [], gray=120) for each in CAMERAS],  # nothing to see heights by
    ],
    ids=["one", "beside", "even"],
)
def test_nothing_is_known_of_heights_from_one_place_or_without_texture(pictures):
    assert not is_level(pictures, OUTLINE, OTHER)


def test_where_one_camera_sees_what_another_sees_higher_up():
    # 5 m up, a third of the way to a camera at 15 m
    assert seen_at_m(np.zeros(2), OTHER, 5.0, np.array([0.0, -5.0, 15.0])) == pytest.approx(
        [0.0, 5.0]
    )
    assert seen_at_m(np.zeros(2), OTHER, 5.0, OTHER) == pytest.approx([0.0, 0.0])


def test_sights_are_those_from_nearest_above_and_apart_and_anew_where_the_ground_has_grown():
    sights = Sights()
    low, high = OUTLINE.min(axis=0), OUTLINE.max(axis=0)
    for number, east_m in enumerate((-6.0, -5.5, -3.0, -1.0, 0.0, 3.0, 6.0)):
        sights.show(
            view_of(number, 0.2 * number, (east_m, 0.0, 15.0), [Thing(0, 0)]), low, high, M_PER_PX
        )
    assert [each.camera_m[0] for each in sights.pictures] == [0.0, 3.0, -5.5]
    sights.show(
        view_of(9, 2.0, (2.0, 0.0, 15.0), [Thing(0, 0)]), low, high + np.array([6.0, 0.0]), M_PER_PX
    )
    assert [each.camera_m[0] for each in sights.pictures] == [2.0]
