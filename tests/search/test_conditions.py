"""What ground looked like, on pictures made of lawn and rough crowns."""

import cv2
import numpy as np
import pytest

from sorvolo.geometry.camera import Camera
from sorvolo.geometry.pose import Pose, site_from_gimbal_rotation
from sorvolo.search.conditions import gather, look_at

M_PER_PX, SIDE_PX = 0.1, 400


def crowns_of(is_crown: np.ndarray) -> np.ndarray:
    """(H, W) bool at picture size: where trees show in a picture from straight above, lawn elsewhere."""
    rng = np.random.default_rng(4)
    leaves = cv2.resize(
        rng.normal(1.0, 0.45, (SIDE_PX // 4, SIDE_PX // 4)), (SIDE_PX, SIDE_PX)
    ).clip(0.1, 2.0)
    light = np.where(is_crown, leaves, 1.0)[..., None]
    image = np.uint8(np.clip(np.array([60.0, 110.0, 45.0]) * light, 0, 255))
    return crowns_of_picture(image, None)


def straight_down() -> tuple[Camera, Pose]:
    """A camera that looks straight down, the picture's top to the north."""
    camera = Camera(SIDE_PX, SIDE_PX, 400.0, 400.0, (SIDE_PX - 1) / 2, (SIDE_PX - 1) / 2)
    return camera, Pose(
        site_from_gimbal_rotation(0.0, -90.0, 0.0), np.array([0.0, 0.0, 400 * M_PER_PX])
    )


def crowns_of_picture(image: np.ndarray, sun: np.ndarray | None) -> np.ndarray:
    """(H, W) bool at picture size: where trees show."""
    crowns = look_at(image, *straight_down(), 0.5, sun).crowns
    return (
        cv2.resize(crowns.astype(np.uint8), (SIDE_PX, SIDE_PX), interpolation=cv2.INTER_NEAREST) > 0
    )


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


def tree_on_a_lawn(*, is_rough: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A picture of a sunlit crown of 6 m on a lawn with its shadow to the right; where the crown and the shadow are."""
    rng = np.random.default_rng(6)
    crown, shadow = disc(180, 200, 3.0), disc(225, 200, 3.0) & ~disc(180, 200, 3.0)
    leaves = cv2.resize(
        rng.normal(1.0, 0.5, (SIDE_PX // 2, SIDE_PX // 2)), (SIDE_PX, SIDE_PX)
    ).clip(0.1, 2.0)
    light = 1.0 + rng.normal(0, 0.05, (SIDE_PX, SIDE_PX))
    light = np.where(
        shadow, 0.45 * light, np.where(crown, 0.8 * (leaves if is_rough else light), light)
    )
    return (
        np.uint8(np.clip(np.array([80.0, 130.0, 60.0]) * light[..., None], 0, 255)),
        crown,
        shadow,
    )


@pytest.mark.parametrize(
    ("is_rough", "sun"), [(True, None), (True, (-0.7, 0.0, 0.7)), (False, (-0.7, 0.0, 0.7))]
)
def test_the_lit_crown_of_a_single_tree_hides_the_ground_and_its_shadow_does_not(
    is_rough: bool, sun: tuple[float, float, float] | None
) -> None:
    """By its leaves, or by the shadow that it throws away from the sun in the west."""
    image, crown, shadow = tree_on_a_lawn(is_rough=is_rough)
    found = crowns_of_picture(image, None if sun is None else np.array(sun))
    assert found[crown].mean() > 0.75
    assert found[shadow].mean() < 0.3
    assert found[~crown & ~shadow].mean() < 0.03


def test_nothing_is_found_on_the_side_of_a_shadow_that_is_away_from_the_sun() -> None:
    image, crown, _ = tree_on_a_lawn(is_rough=False)
    assert crowns_of_picture(image, np.array([0.7, 0.0, 0.7]))[crown].mean() < 0.1


def test_what_stands_high_hides_the_ground_as_a_crown_or_a_roof() -> None:
    """A raised green place is a crown, a raised grey one a roof; what the pictures show to be crowns stays so."""
    rough = cv2.resize(
        np.random.default_rng(4).normal(1.0, 0.45, (100, 100)), (SIDE_PX, SIDE_PX)
    ).clip(0.1, 2.0)
    image = np.uint8(np.clip(np.array([60.0, 110.0, 45.0]) * rough[..., None], 0, 255))
    image[:, :200] = (90, 90, 90)
    image[:130, 200:] = (60, 110, 45)
    camera, pose = straight_down()
    look = look_at(image, camera, pose, 0.5)
    places_m = np.array([[-10.0, 0.0], [10.0, 15.0], [10.0, -5.0], [10.0, -10.0], [500.0, 0.0]])

    def above(places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return np.array([4.0, 4.0, 0.1, np.nan, 4.0]), np.array([0.2, 0.2, 0.2, np.nan, 0.2])

    alone, known = gather([look], places_m, 0.5), gather([look], places_m, 0.5, above)
    assert alone.under_trees.tolist() == [False, False, True, True, False] and not alone.roofs.any()
    assert known.under_trees.tolist() == [False, True, True, True, False]
    assert known.roofs.tolist() == [True, False, False, False, False]
    assert np.isnan(known.columns[4]).all()


def test_texture_is_relative_to_lightness() -> None:
    """The same ground at half the light has the same texture."""
    rng = np.random.default_rng(5)
    ground = rng.uniform(100, 200, (SIDE_PX, SIDE_PX, 1)).repeat(3, axis=2)
    camera = Camera(SIDE_PX, SIDE_PX, 400.0, 400.0, (SIDE_PX - 1) / 2, (SIDE_PX - 1) / 2)
    pose = Pose(site_from_gimbal_rotation(0.0, -90.0, 0.0), np.array([0.0, 0.0, 40.0]))
    bright, dim = (look_at(np.uint8(ground * light), camera, pose, 0.5) for light in (1.0, 0.5))
    np.testing.assert_allclose(bright.texture, dim.texture, rtol=0.1)
    assert 0.01 < float(np.median(bright.texture)) < 0.3
