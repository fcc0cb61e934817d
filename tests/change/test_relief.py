"""Earlier pictures rendered over what stands on the ground: a tower seen from two sides."""

import cv2
import numpy as np
import pytest

from sorvolo.change.earlier_pictures import EarlierPicture, EarlierPictures, with_known_pixels
from sorvolo.change.relief import ReliefMap
from sorvolo.geometry.camera import Camera
from sorvolo.geometry.homography import site_from_image_homography
from sorvolo.geometry.pose import NADIR_CAMERA_NORTH_UP, Pose

CAMERA = Camera.from_angle_of_view(320, 240, 62.0)
CELL_M, HALF_M, TOWER_M = 0.1, 20.0, 6.0
EARLIER, LATER = (np.array([x, 0.0, 30.0]) for x in (-7.0, 7.0))


def stands(x, y):
    return (np.abs(x) < 2.5) & (np.abs(y) < 2.5)


def colour(x, y):
    """(..., 3) a pattern that differs from place to place, another one on the tower's roof."""
    waves = [60 * np.sin(x * 1.3 + y), 60 * np.cos(0.7 * x - y * 1.1), 40 * np.sin(2 * x)]
    pattern = 128 + np.dstack(waves)
    return np.where(stands(x, y)[..., None], 255 - pattern[..., ::-1], pattern)


def seen(centre) -> tuple[np.ndarray, np.ndarray]:
    """The picture from a place, and which of its pixels show the roof: each ray ends on the roof or on the ground."""
    x, y = np.meshgrid(np.arange(CAMERA.width_px), np.arange(CAMERA.height_px))
    rays = (
        CAMERA.rays_from_pixels(np.column_stack([x.ravel(), y.ravel()])) @ NADIR_CAMERA_NORTH_UP.T
    )
    rays = rays / -rays[:, 2:]
    ground, wall = np.zeros((len(rays), 2)), np.zeros(len(rays), bool)
    ground[:] = (centre + rays * centre[2])[:, :2]
    roof = (centre + rays * (centre[2] - TOWER_M))[:, :2]
    is_roof = stands(*roof.T)
    for up_m in np.linspace(0, TOWER_M, 60):
        wall |= stands(*(centre + rays * (centre[2] - up_m))[:, :2].T)
    at = np.where(is_roof[:, None], roof, ground)
    rgb = np.clip(colour(*(each.reshape(x.shape) for each in at.T)), 0, 255)
    rgb[(wall & ~is_roof).reshape(x.shape)] = 20
    return rgb.astype(np.uint8), is_roof.reshape(x.shape)


def relief() -> ReliefMap:
    across = np.arange(-HALF_M, HALF_M, CELL_M)
    x, y = np.meshgrid(across, across[::-1])
    top = HALF_M / CELL_M
    cells_from_site = np.array([[1 / CELL_M, 0, top], [0, -1 / CELL_M, top - 1], [0, 0, 1]])
    return ReliefMap(np.where(stands(x, y), TOWER_M, 0).astype(np.float32), cells_from_site)


def rendered(over: ReliefMap | None):
    picture, _ = seen(EARLIER)
    pose = Pose(NADIR_CAMERA_NORTH_UP, EARLIER)
    known = EarlierPicture(CAMERA, site_from_image_homography(CAMERA, pose), pose)
    earlier = EarlierPictures([known], lambda _: with_known_pixels(picture), over)
    later = site_from_image_homography(CAMERA, Pose(NADIR_CAMERA_NORTH_UP, LATER))
    ((bgr, sees),) = earlier.seen_from(later, LATER, CAMERA.width_px, CAMERA.height_px, 1)
    return cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB).astype(int), sees


@pytest.fixture(scope="module")
def truth():
    return seen(LATER)


def test_a_roof_is_rendered_where_the_later_camera_sees_it(truth) -> None:
    picture, is_roof = truth
    inner = cv2.erode(is_roof.view(np.uint8), np.ones((9, 9), np.uint8)) > 0
    for over, most in ((relief(), 12), (None, 255)):
        found, sees = rendered(over)
        off = np.abs(found - picture)[inner & sees].mean()
        assert off < most
        if over is None:
            assert off > 30  # on level ground it leans the other way


def test_ground_that_the_tower_hid_from_the_earlier_camera_is_not_known(truth) -> None:
    """East of the tower the earlier camera, in the west, saw roof and wall; in front of it all is as it was."""
    picture, _ = truth
    ground = site_from_image_homography(CAMERA, Pose(NADIR_CAMERA_NORTH_UP, LATER))
    from_ground = np.linalg.inv(ground)

    def pixel(x, y):
        u, v, w = from_ground @ [x, y, 1.0]
        return round(v / w), round(u / w)

    found, sees = rendered(relief())
    assert not sees[pixel(3.6, 0.0)]
    for place in ((-1.0, 6.0), (5.5, 0.0), (8.0, -4.0)):
        assert sees[pixel(*place)]
        assert np.abs(found[pixel(*place)] - picture[pixel(*place)]).max() < 15
    assert rendered(None)[1][pixel(3.6, 0.0)]


def test_where_nothing_stands_homographies_suffice() -> None:
    flat = ReliefMap(np.zeros((50, 50), np.float32), np.diag([10.0, 10, 1]))
    later = site_from_image_homography(CAMERA, Pose(NADIR_CAMERA_NORTH_UP, LATER))
    assert flat.find_in_earlier(later, LATER, np.linalg.inv(later), EARLIER, (320, 240)) is None
