"""Exposure: known gains and vignettes are found, outliers and poor data do no harm."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sorvolo.mosaic.exposure import (
    ColourPairs,
    corrected,
    solve_exposure,
    tie_colours,
)


def seen_pairs(gains, vignette, links, rng, noise=0.02, outliers=0.0):
    """Colours that frames with these gains and vignettes record of the same random ground."""
    pairs = {}
    for a, b in links:
        ground = rng.uniform(40, 160, (60, 3))
        radius2 = rng.uniform(0, 1, (2, 60))
        sides = []
        for frame, r2 in ((a, radius2[0]), (b, radius2[1])):
            a2, a4 = vignette
            shade = np.exp(a2 * r2 + a4 * r2**2)[:, None]
            sides.append(ground / gains[frame] * shade * np.exp(rng.normal(0, noise, (60, 3))))
        wrong = rng.random(60) < outliers
        sides[0][wrong] *= rng.uniform(0.4, 2.0, (int(wrong.sum()), 1))
        pairs[a, b] = ColourPairs(*sides, *radius2)
    return pairs


def relative_to_mean(gains):
    logs = np.log(np.array([gains[i] for i in sorted(gains)]))
    return logs - logs.mean(axis=0)


@settings(max_examples=8, deadline=None)
@given(st.integers(0, 10_000))
def test_gains_and_vignette_are_found_among_outliers(seed):
    rng = np.random.default_rng(seed)
    true = {i: np.exp(rng.normal(0, 0.1, 3)) for i in range(12)}
    links = [(i, j) for i in true for j in (i + 1, i + 2) if j in true]
    found = solve_exposure(seen_pairs(true, (-0.4, 0.1), links, rng, outliers=0.15))
    assert np.abs(relative_to_mean(found.gains) - relative_to_mean(true)).max() < 0.03
    r2 = np.linspace(0, 1, 11)
    a2, a4 = found.vignette
    assert np.abs(a2 * r2 + a4 * r2**2 - (-0.4 * r2 + 0.1 * r2**2)).max() < 0.05


def test_a_vignette_that_cannot_be_seen_stays_zero():
    rng = np.random.default_rng(5)
    ground = rng.uniform(50, 150, (40, 3))
    pairs = {(0, 1): ColourPairs(ground, ground * 0.9, np.full(40, 0.3), np.full(40, 0.3))}
    found = solve_exposure(pairs)
    assert np.abs(found.vignette).max() < 1e-6
    assert np.allclose(found.gains[1] / found.gains[0], 1 / 0.9, rtol=0.01)
    assert np.allclose(found.gains[0] * found.gains[1], 1, atol=0.02), (
        "the whole keeps its brightness"
    )


def test_a_long_chain_does_not_drift():
    rng = np.random.default_rng(6)
    true = {i: np.exp(np.array([0.02, 0.0, -0.02]) * i) for i in range(80)}
    found = solve_exposure(seen_pairs(true, (0, 0), [(i, i + 1) for i in range(79)], rng))
    assert max(np.abs(np.log(gain)).max() for gain in found.gains.values()) <= np.log(2) + 1e-9


def test_no_links_and_empty_links_show_nothing():
    assert solve_exposure({}).gains == {}
    empty = ColourPairs(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0), np.zeros(0))
    found = solve_exposure({(3, 7): empty})
    assert np.array_equal(found.gains[3], np.ones(3))
    assert np.array_equal(found.gains[7], np.ones(3))


def test_tie_colours_sample_the_points_and_drop_clipped_ones():
    a, b = np.zeros((240, 320, 3), np.uint8), np.zeros((240, 320, 3), np.uint8)
    a[:, :160], a[:, 160:] = (60, 80, 100), 255
    b[:] = (90, 90, 90)
    points = np.array([[40.0, 120.0], [100.0, 30.0], [280.0, 120.0]])
    pairs = tie_colours(a, points, b, points + np.array([10, 0]))
    assert len(pairs) == 2
    assert np.allclose(pairs.colours_a, [60, 80, 100])
    assert np.allclose(pairs.colours_b, 90)
    assert pairs.radius2_a[0] == pytest.approx((119.5**2 + 0.5**2) * 4 / (320**2 + 240**2))
    assert len(tie_colours(a, np.zeros((0, 2)), b, np.zeros((0, 2)))) == 0


def test_corrected_undoes_what_the_lens_did():
    height, width = 97, 141
    yy, xx = np.mgrid[:height, :width]
    radius2 = ((xx - 70) ** 2 + (yy - 48) ** 2) * 4 / (width**2 + height**2)
    shade = np.exp(-0.5 * radius2 + 0.1 * radius2**2)
    seen = np.repeat((150 * shade).round().astype(np.uint8)[..., None], 3, axis=2)
    flat = corrected(seen, np.array([1.0, 1.0, 0.5]), np.array([-0.5, 0.1]))
    assert np.abs(flat.astype(int) - [150, 150, 75]).max() <= 2
    assert corrected(seen, np.ones(3), np.zeros(2)) is seen


@pytest.mark.parametrize("gain", [0.5, 1.02, 1.25, 2.0])
def test_a_gain_burns_nothing_that_is_not_white_already(gain: float):
    levels = np.repeat(np.arange(256, dtype=np.uint8)[None, :, None], 3, axis=2)
    bright = corrected(levels, np.full(3, gain), np.zeros(2))[0, :, 0]
    assert (bright[:255] < 255).all()
    assert (np.diff(bright.astype(int)) >= 0).all()
    assert bright[90] == pytest.approx(90 * gain, abs=0.51)


def test_links_of_few_and_of_many_points_count_by_their_points():
    """Frame 1 meets 0 in 2 points and 2 in 60: the padding of the short link weighs nothing."""
    rng = np.random.default_rng(8)
    ground, radius2 = rng.uniform(50, 150, (60, 3)), rng.uniform(0, 1, 60)
    few = ColourPairs(ground[:2], ground[:2] * 0.8, radius2[:2], radius2[:2])
    many = ColourPairs(ground, ground * 0.8, radius2, radius2)
    found = solve_exposure({(0, 1): few, (1, 2): many})
    alone = solve_exposure({(1, 2): many})
    assert found.gains[2] / found.gains[1] == pytest.approx(np.full(3, 1 / 0.8), rel=0.01)
    assert alone.gains[2] / alone.gains[1] == pytest.approx(np.full(3, 1 / 0.8), rel=0.01)
    assert (found.gains[0] < found.gains[1]).all()
