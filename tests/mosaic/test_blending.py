"""Blending: one layer comes back unchanged, borders are smooth in colour and sharp in texture."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from sorvolo.mosaic.blending import Layer, blend, coarse_fill, fill_invalid, winners_from_shares


def noise(height: int, width: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3), dtype=np.uint8)


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 1000), st.integers(1, 8), st.integers(1, 8))
def test_a_single_layer_comes_back(seed, rows, columns):
    image = noise(16 * rows, 16 * columns, seed)
    picture = blend(np.zeros(image.shape[:2], np.int16), [Layer(0, 0, 0, image)])
    assert np.abs(picture.astype(int) - image).max() <= 2


def test_equal_layers_blend_to_themselves():
    image = noise(128, 192)
    labels = np.zeros((128, 192), np.int16)
    labels[:, 90:] = 1
    labels[60:, 30:100] = 2
    picture = blend(labels, [Layer(n, 0, 0, image) for n in range(3)])
    assert np.abs(picture.astype(int) - image).max() <= 2


def test_colour_steps_become_ramps_and_texture_stays():
    labels = np.zeros((128, 256), np.int16)
    labels[:, 128:] = 1
    checker = (np.indices((128, 256)).sum(axis=0) % 2 * 20).astype(np.uint8)[..., None] * np.ones(
        3, np.uint8
    )
    picture = blend(labels, [Layer(0, 0, 0, checker + 80), Layer(1, 0, 0, checker + 140)]).astype(
        int
    )
    assert np.abs(np.diff(picture[::2, ::2, 0].mean(axis=0))).max() < 10
    assert np.abs(picture[64, 128:140:2, 0] - picture[64, 129:141:2, 0]).min() > 15


def test_a_brighter_neighbour_burns_no_texture():
    """Ground with bright grains beside the same ground 60 levels brighter: the seam's ramp would push grains to white."""
    grains = np.full((96, 160, 3), 150, np.uint8)
    grains[::5, ::5] = 240
    brighter = np.minimum(grains, 194) + np.uint8(60)
    labels = np.where(np.arange(160) < 80, 0, 1) * np.ones((96, 1), np.int64)
    found = blend(labels.astype(np.int16), [Layer(0, 0, 0, grains), Layer(1, 0, 0, brighter)])
    assert found[:, :80].max() < 255
    beside = found[:, 60:80]
    assert beside[grains[:, 60:80] == 150].max() > 160  # the ramp is there
    assert beside[grains[:, 60:80] == 240].min() > beside[grains[:, 60:80] == 150].max()


def test_a_layer_may_cover_part_of_the_window():
    labels = np.full((160, 160), -1, np.int16)
    labels[64:96, 64:96] = 0
    image = np.full((96, 96, 3), 90, np.uint8)
    picture = blend(labels, [Layer(0, 32, 32, image)])
    assert np.abs(picture[64:96, 64:96].astype(int) - 90).max() <= 1


def test_the_largest_share_wins_and_the_first_of_equals():
    a, b = np.full((2, 3), 7, np.uint8), np.array([[0, 7, 9]], np.uint8)
    labels = winners_from_shares([(0, 0, 0, a), (1, 1, 1, b)], 3, 4)
    assert labels.tolist() == [[0, 0, 0, -1], [0, 0, 0, 1], [-1, -1, -1, -1]]


def test_invalid_pixels_continue_their_surroundings():
    image = np.zeros((90, 120, 3), np.uint8)
    image[:, :60], image[:, 60:] = 50, 200
    valid = np.zeros((90, 120), dtype=bool)
    valid[20:70, 20:100] = True
    image[~valid] = 0
    filled = fill_invalid(image, valid)
    assert np.array_equal(filled[valid], image[valid])
    assert np.abs(filled[45, :20].astype(int) - 50).max() < 20
    assert np.abs(filled[45, 100:].astype(int) - 200).max() < 20
    assert fill_invalid(image, np.zeros_like(valid)).shape == image.shape


def test_a_coarse_fill_continues_a_slope_and_darkens_nothing():
    slope = np.linspace(60, 180, 160)[None].repeat(96, axis=0)
    image = np.dstack([slope] * 3).astype(np.uint8)
    valid = np.zeros((96, 160), dtype=bool)
    valid[16:80, 24:136] = True
    image[~valid] = 0
    filled = coarse_fill(image, valid).astype(int)[..., 0]
    assert filled.shape == (12, 20)
    assert filled.min() >= slope[0, 24] - 1 and filled.max() <= slope[0, 135]
    assert np.abs(filled[6, 3:17] - slope[0, 28:136:8]).max() <= 4
    assert np.abs(filled[0] - filled[6]).max() <= 5
