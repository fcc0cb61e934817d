"""Learned features find the same ground under other light, where ORB's descriptors fail."""

import cv2
import numpy as np
import pytest

from sorvolo.registration.features import LEARNED, learned_features, release_network


@pytest.fixture(scope="module")
def ground() -> np.ndarray:
    """A picture with detail at every scale, (300, 420)."""
    rng = np.random.default_rng(4)
    picture = np.zeros((300, 420), np.float32)
    for octave in (3, 9, 27, 80):
        noise = rng.normal(0, 1, (300 // octave + 2, 420 // octave + 2)).astype(np.float32)
        picture += cv2.resize(noise, (420, 300), interpolation=cv2.INTER_CUBIC)
    return np.clip(120 + 25 * picture, 0, 255).astype(np.uint8)


def test_the_same_points_are_found_under_other_light_and_shifted(ground: np.ndarray) -> None:
    shift = np.array([13, 9])
    later = np.clip(255 * (ground[9:, 13:] / 255.0) ** 1.7 * 0.8 + 20, 0, 255).astype(np.uint8)
    old, new = learned_features(ground), learned_features(later)
    likeness = new.descriptors @ old.descriptors.T
    nearest = likeness.argmax(axis=1)
    mutual = likeness.argmax(axis=0)[nearest] == np.arange(len(new))
    miss = np.linalg.norm(old.points_px[nearest[mutual]] - new.points_px[mutual] - shift, axis=1)
    assert mutual.sum() > 100
    assert (miss < 2).mean() > 0.8


def test_points_lie_inside_pictures_of_any_size(ground: np.ndarray) -> None:
    found = learned_features(np.ascontiguousarray(ground[:101, :77]))
    assert found.kind == LEARNED and found.descriptors.shape == (len(found), 64) and len(found) > 20
    assert (found.points_px >= 0).all() and (found.points_px <= [76, 100]).all()
    assert np.linalg.norm(found.descriptors, axis=1) == pytest.approx(np.ones(len(found)), abs=1e-4)


def test_most_keeps_the_surest_points(ground: np.ndarray) -> None:
    every, some = learned_features(ground), learned_features(ground, most=50)
    assert len(some) == 50 and np.array_equal(some.points_px, every.points_px[:50])


def test_a_picture_without_detail_has_hardly_any() -> None:
    assert len(learned_features(np.full((64, 64), 90, np.uint8))) < 10


def test_a_released_network_finds_the_same_again(ground: np.ndarray) -> None:
    before = learned_features(ground, most=100)
    release_network()
    after = learned_features(ground, most=100)
    assert np.array_equal(after.points_px, before.points_px) and np.array_equal(
        after.descriptors, before.descriptors
    )
