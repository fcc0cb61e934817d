"""Tiles with a change painted in: the change and a narrow rim, in the map's light, nothing else."""

from dataclasses import replace

import numpy as np
import pytest

from sorvolo.change.map_update import is_painted, patched
from sorvolo.survey.findings import Change, ChangeKind, Patch

GRID_FROM_SITE = np.array(
    [[20.0, 0, 0], [0, -20.0, 0], [0, 0, 1]]
)  # 0.05 m a pixel, pixel (0, 0) at the origin
WINDOW = (0, 0, 128, 128)


def textured(seed=0):
    return np.random.default_rng(seed).integers(60, 120, (128, 128, 3)).astype(np.uint8)


def tile(alpha=255):
    return np.dstack([textured(), np.full((128, 128), alpha, np.uint8)])


def patch_with(brightness=1.0, hole=False):
    """A 40 x 40 px patch over tile pixels 40..79 whose middle 12 x 12 px hold a red thing."""
    before = np.dstack([textured()[40:80, 40:80], np.full((40, 40), 255, np.uint8)])
    after = before.copy()
    after[14:26, 14:26, :3] = (150, 20, 20)
    after[..., :3] = np.clip(after[..., :3] * brightness, 0, 255).astype(np.uint8)
    if hole:
        after[:20, :, 3] = 0
    changed = np.zeros((40, 40), bool)
    changed[14:26, 14:26] = True
    return Patch(39.5 / 20, -39.5 / 20, 0.05, before, after, changed, np.zeros((40, 40), np.uint8))


def test_the_change_is_painted_and_the_rest_stays_byte_for_byte():
    old = tile()
    new = patched(old, WINDOW, GRID_FROM_SITE, patch_with())
    assert np.abs(new[54:66, 54:66, :3].astype(int) - (150, 20, 20)).max() <= 3
    touched = (new != old).any(axis=2)
    ys, xs = np.nonzero(touched)
    assert ys.min() >= 40 and ys.max() < 80 and xs.min() >= 40 and xs.max() < 80
    assert np.array_equal(new[~touched], old[~touched])
    assert np.count_nonzero(touched) < 40 * 40
    assert (new[..., 3] == 255).all()
    assert np.array_equal(old, tile())  # the given tile is not written to


@pytest.mark.parametrize("brightness", [0.75, 1.25])
def test_the_flights_light_is_brought_to_the_maps(brightness):
    new = patched(tile(), WINDOW, GRID_FROM_SITE, patch_with(brightness))
    assert np.abs(new[58:62, 58:62, :3].astype(int) - (150, 20, 20)).max() <= 8
    unchanged_rim = np.abs(new[48:53, 48:72, :3].astype(int) - tile()[48:53, 48:72, :3])
    assert unchanged_rim.mean() < 3


def test_a_tile_that_it_does_not_touch_is_the_same_object():
    old = tile()
    assert patched(old, (512, 512, 640, 640), GRID_FROM_SITE, patch_with()) is old
    nothing = patch_with()
    unmarked = replace(nothing, changed=np.zeros((40, 40), bool))
    assert patched(old, WINDOW, GRID_FROM_SITE, unmarked) is old


def test_neighbouring_tiles_agree_at_their_border():
    whole = patched(tile(), WINDOW, GRID_FROM_SITE, patch_with())
    left = patched(tile()[:, :60], (0, 0, 60, 128), GRID_FROM_SITE, patch_with())
    right = patched(tile()[:, 60:], (60, 0, 128, 128), GRID_FROM_SITE, patch_with())
    assert np.abs(np.hstack([left, right]).astype(int) - whole).max() <= 1


def test_unknown_ground_is_filled_and_alpha_never_lost():
    new = patched(tile(alpha=0), WINDOW, GRID_FROM_SITE, patch_with())
    assert (new[54:66, 54:66, 3] == 255).all()
    partly = patched(tile(), WINDOW, GRID_FROM_SITE, patch_with(hole=True))
    assert (partly[..., 3] == 255).all()
    assert np.array_equal(partly[40:58], tile()[40:58])  # the flight knows nothing there


def test_what_moves_is_not_painted():
    patch = patch_with()
    square = np.array([[0, 0], [1, 0], [1, 1], [0, 1.0]])
    for kind in ChangeKind:
        change = Change("f-1", kind, 0.9, square, 0, 1, 3, 1.0, 1.0, 0.1, patch)
        assert is_painted(change) == (kind != ChangeKind.MOVING)
