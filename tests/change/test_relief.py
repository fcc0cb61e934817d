"""Pictures laid over a true orthophoto's heights: a tower seen from two sides."""

import cv2
import numpy as np
import pytest

from sorvolo.change import alignment
from sorvolo.change.earlier_pictures import EarlierPicture, EarlierPictures, with_known_pixels
from sorvolo.change.relief import OrthoSurface
from sorvolo.geometry.camera import Camera
from sorvolo.geometry.homography import apply_homography, site_from_image_homography
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


def relief() -> OrthoSurface:
    across = np.arange(-HALF_M, HALF_M, CELL_M)
    x, y = np.meshgrid(across, across[::-1])
    top = HALF_M / CELL_M
    cells_from_site = np.array([[1 / CELL_M, 0, top], [0, -1 / CELL_M, top - 1], [0, 0, 1]])
    return OrthoSurface(np.where(stands(x, y), TOWER_M, 0).astype(np.float32), cells_from_site)


def laid(centre, over: OrthoSurface) -> tuple[np.ndarray, np.ndarray]:
    """A picture from a place on the raster, and where it is seen there."""
    picture, _ = seen(centre)
    pose = Pose(NADIR_CAMERA_NORTH_UP, centre)
    # a picture's own place on level ground is no witness: only its camera in space counts
    known = EarlierPicture(CAMERA, site_from_image_homography(CAMERA, pose) @ OFF, pose)
    earlier = EarlierPictures([known], lambda _: with_known_pixels(picture), over)
    ((bgr, sees),) = earlier.seen_from(RASTER, centre, CAMERA.width_px, CAMERA.height_px, 1)
    return cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB).astype(int), sees


RASTER = site_from_image_homography(CAMERA, Pose(NADIR_CAMERA_NORTH_UP, np.array([0.0, 0, 30])))
OFF = np.diag([1.01, 1.01, 1.0])  # of a picture on the plane that fits uneven ground


def places() -> tuple[np.ndarray, np.ndarray]:
    x, y = np.meshgrid(np.arange(CAMERA.width_px), np.arange(CAMERA.height_px))
    ground = apply_homography(RASTER, np.column_stack([x.ravel(), y.ravel()]))
    return ground[:, 0].reshape(x.shape), ground[:, 1].reshape(x.shape)


@pytest.mark.parametrize("centre", [EARLIER, LATER])
def test_roof_and_ground_lie_at_their_places(centre) -> None:
    x, y = places()
    true = np.clip(colour(x, y), 0, 255)
    found, sees = laid(centre, relief())
    off = np.abs(found - true).max(axis=2)
    roof, ground = stands(x, y), ~stands(1.3 * x, 1.3 * y)
    assert sees[stands(1.5 * x, 1.5 * y)].all()
    assert np.percentile(off[sees & roof], 95) < 25
    assert np.percentile(off[sees & ground], 95) < 25
    flat = OrthoSurface(np.zeros((400, 400), np.float32), relief().cells_from_site)
    leaning, _ = laid(centre, flat)
    assert np.median(np.abs(leaning - true).max(axis=2)[roof]) > 25


def test_ground_that_the_tower_hides_is_not_known() -> None:
    """East of the tower the earlier camera, in the west, saw roof and wall; the later one sees the ground there."""
    x, y = places()
    behind = (np.abs(y) < 1.5) & (x > 3.1) & (x < 3.9)
    assert not laid(EARLIER, relief())[1][behind].any()
    assert laid(LATER, relief())[1][behind].all()


def test_walls_are_no_ground_that_pictures_share() -> None:
    x, y = places()
    _, sees = laid(LATER, relief())
    assert not sees[(np.abs(x - 2.5) < 0.15) & (np.abs(y) < 2)].any()


def test_a_frame_stands_where_it_was_taken_from() -> None:
    """A frame whose place on level ground is off by what the tower and its slope do: its camera in space is found."""
    slope = relief()
    up_m = slope.up_m + np.linspace(-2, 2, slope.up_m.shape[1], dtype=np.float32)
    surface = OrthoSurface(up_m, slope.cells_from_site)
    pose = Pose(NADIR_CAMERA_NORTH_UP, LATER)
    points = np.random.default_rng(1).uniform(-8, 8, (60, 2))
    cells = np.column_stack([points, np.ones(60)]) @ surface.cells_from_site.T
    up = up_m[cells[:, 1].round().astype(int), cells[:, 0].round().astype(int)]
    seen_at = CAMERA.pixels_from_points((np.column_stack([points, up]) - LATER) @ pose.rotation)
    seen_at[:8] += 30  # false pairs
    start = Pose(NADIR_CAMERA_NORTH_UP, LATER + np.array([0.7, -0.4, 0.9]))
    found = alignment._seen_so(seen_at, np.column_stack([points, up]), CAMERA, start)
    assert found is not None and np.abs(found[0].translation_m - LATER).max() < 0.05
    assert found[1] < 0.5
    # of points that no camera above them could see so
    unseen = np.random.default_rng(2).uniform(0, 300, seen_at.shape)
    below = np.column_stack([points, up + 40])
    assert alignment._seen_so(unseen, below, CAMERA, start) is None
