"""Matching: mutual nearest neighbours that are clearly nearest, and only where the prediction allows."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from sorvolo.registration.matching import match
from sorvolo.survey.mosaic import Features


def scattered(seed: int, count: int = 60, kind: str = "orb") -> Features:
    rng = np.random.default_rng(seed)
    descriptors = rng.integers(0, 256, (count, 32)).astype(np.uint8)
    if kind == "sift":
        descriptors = rng.random((count, 128)).astype(np.float32)
    return Features(kind, rng.uniform(0, 500, (count, 2)), descriptors)


def shuffled(features: Features, order: np.ndarray, shift_px: float = 0.0) -> Features:
    return Features(
        features.kind, features.points_px[order] + shift_px, features.descriptors[order]
    )


@given(st.integers(0, 10_000), st.sampled_from(["orb", "sift"]))
def test_the_same_points_find_each_other(seed, kind):
    old = scattered(seed, kind=kind)
    order = np.random.default_rng(seed + 1).permutation(len(old))
    pairs = match(shuffled(old, order), old, None, 0.0)
    assert len(pairs) == len(old)
    assert (order[pairs[:, 0]] == pairs[:, 1]).all()


def test_unrelated_points_do_not_match():
    assert len(match(scattered(1), scattered(2), None, 0.0)) < 5


def test_twins_are_refused():
    old = scattered(3)
    doubled = Features(
        "orb",
        np.concatenate([old.points_px, old.points_px + 50]),
        np.concatenate([old.descriptors, old.descriptors]),
    )
    assert len(match(old, doubled, None, 0.0)) == 0


def test_each_point_is_used_once():
    old = scattered(4)
    order = np.concatenate([np.arange(60), np.arange(60)])
    pairs = match(shuffled(old, order), old, None, 0.0)
    assert len(set(pairs[:, 1])) == len(pairs) == 60


def test_a_prediction_settles_between_twins():
    old = scattered(5)
    twins = Features(
        "orb",
        np.concatenate([old.points_px, old.points_px + 2000]),
        np.concatenate([old.descriptors, old.descriptors]),
    )
    shift = np.array([[1, 0, 7.0], [0, 1, 7.0], [0, 0, 1]])
    pairs = match(shuffled(old, np.arange(60), 7.0), twins, shift, 30.0)
    assert len(pairs) > 55
    assert (pairs[:, 0] == pairs[:, 1]).all()


def test_pairs_beyond_the_search_are_left_out():
    old = scattered(6)
    assert len(match(shuffled(old, np.arange(60), 25.0), old, np.eye(3), 30.0)) == 0
    assert len(match(shuffled(old, np.arange(60), 15.0), old, np.eye(3), 30.0)) == 60


def test_a_prediction_that_leaves_nothing_gives_nothing():
    far = np.array([[1, 0, 9000.0], [0, 1, 0], [0, 0, 1]])
    pairs = match(scattered(7), scattered(7), far, 30.0)
    assert pairs.shape == (0, 2)


def test_different_kinds_and_too_few_points_give_nothing():
    assert match(scattered(8), scattered(8, kind="sift"), None, 0.0).shape == (0, 2)
    assert match(scattered(8, count=3), scattered(8), None, 0.0).shape == (0, 2)
    assert match(scattered(8), scattered(8, count=0), None, 0.0).shape == (0, 2)
