"""What ground looked like, on pictures made of lawn and rough crowns."""

import cv2
import numpy as np

from sorvolo.geometry.camera import Camera
from sorvolo.geometry.pose import Pose, site_from_gimbal_rotation
from sorvolo.search.conditions import look_at

M_PER_PX, SIDE_PX = 0.1, 400


def crowns_of(is_crown: np.ndarray) -> np.ndarray:
    """(H, W) bool at picture size: where trees show in a picture from straight above, lawn elsewhere."""
    rng = np.random.default_rng(4)
    leaves = cv2.resize(rng.normal(1.0, 0.45, (SIDE_PX // 4, SIDE_PX // 4)), (SIDE_PX, SIDE_PX)).clip(0.1, 2.0)
    light = np.where(is_crown, leaves, 1.0)[..., None]
    image = np.uint8(np.clip(np.array([60.0, 110.0, 45.0]) * light, 0, 255))
    camera = Camera(SIDE_PX, SIDE_PX, 400.0, 400.0, (SIDE_PX - 1) / 2, (SIDE_PX - 1) / 2)
    pose = Pose(site_from_gimbal_rotation(0.0, -90.0, 0.0), np.array([0.0, 0.0, 400 * M_PER_PX]))
    crowns = look_at(image, camera, pose, 0.5).crowns
    return cv2.resize(crowns.astype(np.uint8), (SIDE_PX, SIDE_PX), interpolation=cv2.INTER_NEAREST) > 0


def disc(x: int, y: int, radius_m: float) -> np.ndarray:
    rows, columns = np.mgrid[:SIDE_PX, :SIDE_PX]
    return np.asarray(np.hypot(columns - x, rows - y) * M_PER_PX < radius_m)


def test_smooth_crowns_within_a_forest_are_forest() -> None:
    """A gap of 4 m within trees counts as under trees, a clearing of 16 m does not."""
    gap, clearing = disc(100, 100, 2.0), disc(270, 270, 8.0)
    found = crowns_of(~(gap | clearing))
    assert found[gap].mean() > 0.9
    assert found[disc(270, 270, 5.0)].mean() < 0.1


def test_shrubs_on_a_lawn_stay_apart() -> None:
    found = crowns_of(disc(150, 200, 2.0) | disc(205, 200, 2.0))
    assert found[disc(150, 200, 0.5)].any()
    assert not found[disc(177, 200, 0.5)].any()


def test_texture_is_relative_to_lightness() -> None:
    """The same ground at half the light has the same texture."""
    rng = np.random.default_rng(5)
    ground = rng.uniform(100, 200, (SIDE_PX, SIDE_PX, 1)).repeat(3, axis=2)
    camera = Camera(SIDE_PX, SIDE_PX, 400.0, 400.0, (SIDE_PX - 1) / 2, (SIDE_PX - 1) / 2)
    pose = Pose(site_from_gimbal_rotation(0.0, -90.0, 0.0), np.array([0.0, 0.0, 40.0]))
    bright, dim = (look_at(np.uint8(ground * light), camera, pose, 0.5) for light in (1.0, 0.5))
    np.testing.assert_allclose(bright.texture, dim.texture, rtol=0.1)
    assert 0.01 < float(np.median(bright.texture)) < 0.3
