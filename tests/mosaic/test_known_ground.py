"""Ground that a map shows already stays as it is, and what is painted beside it meets it without a seam."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from test_canvas import GROUND, HEIGHT, WIDTH, flight, pose, whole

from sorvolo.geometry.grid import Grid
from sorvolo.mosaic.canvas import Canvas
from sorvolo.mosaic.canvas_frame import CanvasFrame
from sorvolo.mosaic.known_ground import KnownGround, settled

GRID = Grid((0.0, 0.0), 0.05)


def brighter(images: dict[int, np.ndarray], ids: list[int], gain: float) -> dict[int, np.ndarray]:
    return {
        k: np.clip(v * (gain if k in ids else 1), 0, 255).astype(np.uint8)
        for k, v in images.items()
    }


@pytest.fixture(scope="module")
def halves():
    """Two flights side by side, the later one 6 % brighter than its exposure states, and the map of the first."""
    frames, images = flight()
    early = [each for each in frames if each.id % 4 < 2]
    late = [replace(each, rank=1) for each in frames if each.id % 4 >= 2]
    images = brighter(images, [each.id for each in late], 1.06)
    tiles: dict = {}
    Canvas(GRID, tiles, images.__getitem__).paint(early)
    return early, late, images, tiles


def extended(halves, frames=None) -> dict:
    early, late, images, tiles = halves
    tiles = dict(tiles)
    canvas = Canvas(
        GRID,
        tiles,
        images.__getitem__,
        early,
        keeps_known_ground=True,
    )
    for frame in frames or late:
        canvas.paint([frame])
    return tiles


def test_known_pixels_stay_and_the_new_side_meets_them(halves):
    before, after = whole(halves[3], 512), whole(extended(halves), 512)
    known = before[..., 3] == 255
    assert np.array_equal(after[known], before[known])
    truth = np.zeros_like(after[..., :3])
    truth[512 - 80 : 512 + 820, 512 - 100 : 512 + 1000] = GROUND
    error = after[..., :3].astype(float) - truth
    seen = (after[..., 3] == 255) & truth.any(axis=2)
    outwards_px = cv2.distanceTransform((~known).astype(np.uint8), cv2.DIST_L2, 5)
    touching = cv2.dilate(((outwards_px > 0) & seen).astype(np.uint8), np.ones((5, 5))) > 0
    step = (
        error[seen & (outwards_px > 0) & (outwards_px <= 2)].mean() - error[known & touching].mean()
    )
    farther = error[seen & (outwards_px > 70)].mean() - error[known].mean()
    assert farther > 5.5  # gray levels: the late flight keeps its own light
    assert abs(step) < 2.0  # blending half-way, the known side held, would have left 3.7


def test_new_ground_is_the_same_however_it_is_cut_and_ordered(halves, monkeypatch):
    late = halves[1]
    one = whole(extended(halves), 512)
    monkeypatch.setattr("sorvolo.mosaic.canvas._WINDOW_PX", 192)
    other = whole(extended(halves, late[::-1]), 512)
    assert np.abs(one.astype(int) - other).max() <= 2


def test_the_ground_of_a_forgotten_frame_is_painted_anew(halves):
    early, _, images, tiles = halves
    tiles = dict(tiles)
    canvas = Canvas(GRID, tiles, images.__getitem__, painted=early, keeps_known_ground=True)
    canvas.paint([], forget=[early[0].id])
    alone: dict = {}
    Canvas(GRID, alone, images.__getitem__).paint(early[1:])
    before, after, expected = (whole(each, 512) for each in (halves[3], tiles, alone))
    lost = (before[..., 3] == 255) & (expected[..., 3] == 0)
    assert lost.sum() > 5_000
    assert not after[lost, 3].any()
    assert (after == before).all(axis=2).mean() > 0.9


def test_pixels_patched_into_the_map_are_not_reverted(halves):
    early, late, images, tiles = halves
    patched = {index: tile.copy() for index, tile in tiles.items()}
    first = next(iter(patched.values()))
    first[first[..., 3] == 255] = (255, 0, 255, 255)
    after = extended((early, late, images, patched))
    assert all(
        np.array_equal(after[k][v[..., 3] == 255], v[v[..., 3] == 255]) for k, v in patched.items()
    )


def test_a_painted_frame_shows_no_ground_that_the_map_did_not():
    """Its mask of existing pixels is not known any more: what lies beyond them is the next frame's."""
    valid = np.zeros((HEIGHT, WIDTH), bool)
    valid[40:-40, 40:-40] = True
    early = CanvasFrame(0, 0, WIDTH, HEIGHT, pose(0, 0), valid=valid)
    late = CanvasFrame(1, 1, WIDTH, HEIGHT, pose(120, 0))
    images = {
        0: np.full((HEIGHT, WIDTH, 3), 90, np.uint8),
        1: np.full((HEIGHT, WIDTH, 3), 90, np.uint8),
    }
    images[0][~valid] = 0
    tiles: dict = {}
    Canvas(GRID, tiles, images.__getitem__).paint([early])
    Canvas(
        GRID,
        tiles,
        images.__getitem__,
        painted=[replace(early, valid=None)],
        keeps_known_ground=True,
    ).paint([late])
    new = whole(tiles, 512)[512 : 512 + HEIGHT, 512 + 120 : 512 + 120 + WIDTH]
    assert (new[..., 3] == 255).all()
    assert (np.abs(new[..., :3].astype(int) - 90) > 30).mean() < 0.01


def test_masks_of_windows_across_tiles_and_none():
    rng = np.random.default_rng(0)
    tiles = {(x, y): np.zeros((32, 32, 4), np.uint8) for x, y in ((-1, 0), (0, 0), (0, 1))}
    for tile in tiles.values():
        tile[..., 3] = rng.integers(0, 2, (32, 32)) * 255
    known = KnownGround(Grid((0.0, 0.0), 1.0, 32), tiles)
    whole_mask = np.zeros((64, 64), bool)
    for (x, y), tile in tiles.items():
        whole_mask[32 * y : 32 * y + 32, 32 * x + 32 : 32 * x + 64] = tile[..., 3] == 255
    assert np.array_equal(known.opaque(-20, 5, 31, 60), whole_mask[5:60, 12:63])
    for tile in tiles.values():
        tile[:] = 255  # painted since: what was shown at the beginning counts
    assert np.array_equal(known.opaque(-32, 0, 32, 64), whole_mask)
    known.release(-3, -3, np.ones((10, 10), bool))
    expected = whole_mask.copy()
    expected[0:7, 29:39] = False
    assert np.array_equal(known.lasting(-32, 0, 32, 64), expected)
    assert np.array_equal(known.opaque(-32, 0, 32, 64), whole_mask)


def test_settling_changes_nothing_where_the_light_agrees():
    picture = np.random.default_rng(2).integers(0, 255, (96, 128, 3), dtype=np.uint8)
    lasting = np.zeros((96, 128), bool)
    lasting[:, :60] = True
    assert np.array_equal(settled(picture, picture, lasting), picture)
