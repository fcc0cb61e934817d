"""A map painted coarsely: on the same ground as the fine one, and never over ground that was known."""

import cv2
import numpy as np
import pytest

from sorvolo.geometry.camera import Camera
from sorvolo.geometry.geodesy import Geodetic
from sorvolo.geometry.grid import SiteGrid
from sorvolo.mosaic.canvas import Canvas, CoarseTiles, coarse_grid, coarseness
from sorvolo.mosaic.placing import canvas_frame

SITE_GRID = SiteGrid.at(Geodetic(46.0, 13.0), 0.05, "EPSG:32633", tile_px=256)
STEP = 4


def picture() -> np.ndarray:
    small = np.random.default_rng(3).uniform(0, 255, (15, 20, 3)).astype(np.float32)
    return np.clip(cv2.resize(small, (640, 480), interpolation=cv2.INTER_CUBIC), 0, 255).astype(
        np.uint8
    )


def painted(site_grid: SiteGrid, tiles, image: np.ndarray) -> None:
    camera = Camera.from_angle_of_view(image.shape[1], image.shape[0], 60)
    scale = 0.05 * 640 / image.shape[1]
    middle = np.array([[1, 0, -camera.cx_px], [0, 1, -camera.cy_px], [0, 0, 1.0]])
    site_from_image = np.array([[scale, 0, 3.0], [0, -scale, 5.0], [0, 0, 1]]) @ middle
    frame = canvas_frame(0, 0, camera, site_from_image, site_grid, np.ones(3), np.zeros(2), None)
    Canvas(site_grid.grid, tiles, lambda _: image, keeps_known_ground=True).paint([frame])


def joined(tiles, side: int) -> np.ndarray:
    columns, rows = ([int(each[k]) for each in tiles] for k in (0, 1))
    shape = (max(rows) - min(rows) + 1) * side, (max(columns) - min(columns) + 1) * side, 4
    whole = np.zeros(shape, np.uint8)
    for (column, row), tile in tiles.items():
        y, x = (row - min(rows)) * side, (column - min(columns)) * side
        whole[y : y + side, x : x + side] = tile
    return whole


def test_what_is_painted_coarsely_lies_where_the_fine_picture_does():
    image, fine, coarse = picture(), {}, {}
    painted(SITE_GRID, fine, image)
    small = cv2.resize(image, (160, 120), interpolation=cv2.INTER_AREA)
    view = CoarseTiles(coarse, SITE_GRID.grid, STEP)
    painted(coarse_grid(SITE_GRID, STEP), view, small)
    assert not coarse
    view.save()
    assert fine.keys() == coarse.keys()
    one, other = joined(fine, 256), joined(coarse, 256)
    both = cv2.erode((one[..., 3] & other[..., 3]), np.ones((33, 33), np.uint8)) > 0
    assert both.sum() > 200_000
    away = {
        shift: np.abs(
            one[both].astype(int) - np.roll(other, shift, axis=(0, 1))[both].astype(int)
        ).mean()
        for shift in ((0, 0), (0, 2), (2, 0), (0, -2), (-2, 0))
    }
    assert min(away, key=away.__getitem__) == (0, 0)
    assert away[0, 0] < 5


def test_known_ground_stays_and_the_rest_comes_back_as_it_was_put():
    rng = np.random.default_rng(4)
    known = rng.integers(0, 256, (256, 256, 4), np.uint8)
    known[..., 3] = 0
    known[:100, :130, 3] = 255
    tiles = {(2, 3): known.copy()}
    view = CoarseTiles(tiles, SITE_GRID.grid, STEP)
    new = rng.integers(0, 256, (64, 64, 4), np.uint8)
    new[..., 3] = 255
    view[2, 3] = new
    view[5, 5] = new
    view.save()
    assert np.array_equal(tiles[2, 3][:100, :130], known[:100, :130])
    view.release()
    assert np.array_equal(view[2, 3][25:], new[25:])
    assert np.array_equal(view[5, 5], new)
    view[5, 5] = new[::-1]
    assert np.array_equal(view[5, 5], new[::-1])
    del view[5, 5]
    assert set(view) == set(tiles) == {(2, 3)}
    view[7, 7] = new
    del view[7, 7]
    view.save()
    assert set(tiles) == {(2, 3)}


def test_few_tiles_in_memory_show_the_same_as_many():
    rng = np.random.default_rng(5)
    shown = {}
    for most_bytes in (1, 1 << 30):
        tiles: dict = {}
        view, known = CoarseTiles(tiles, SITE_GRID.grid, STEP, most_bytes), {}
        for number in range(60):
            index = (number * 7 % 5, 0)
            known[index] = rng.integers(0, 256, (64, 64, 4), np.uint8)
            view[index] = known[index]
            if number % 9 == 0:
                view.save()
        assert all(np.array_equal(view[index], each) for index, each in known.items())
        view.save()
        shown[most_bytes] = {index: each[::STEP, ::STEP] for index, each in tiles.items()}
        assert all(np.array_equal(shown[most_bytes][index], each) for index, each in known.items())


@pytest.mark.parametrize(
    ("longest_px", "step"), [(320, 1), (640, 1), (1024, 2), (1920, 4), (4000, 8), (8000, 8)]
)
def test_pictures_are_made_no_smaller_than_is_needed_to_follow(longest_px, step):
    assert coarseness(longest_px) == step
