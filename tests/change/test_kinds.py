"""Came, left or replaced: reported from pictures of both dates on textured ground, in any light."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sorvolo.change.kinds import kind_of, stands_out
from sorvolo.survey.findings import ChangeKind, Patch

SIZE = 60


def ground(seed):
    rng = np.random.default_rng(seed)
    rough = sum(
        cv2.resize(rng.normal(0, 1, (SIZE // step + 2, SIZE // step + 2, 3)), (SIZE, SIZE))
        for step in (2, 6, 20)
    )
    return 110 + 8 * rough


def thing_mask(seed):
    rng = np.random.default_rng([seed, 1])
    mask = np.zeros((SIZE, SIZE), np.uint8)
    box = (
        (30 + rng.uniform(-3, 3), 30 + rng.uniform(-3, 3)),
        tuple(rng.uniform(12, 24, 2)),
        rng.uniform(0, 90),
    )
    cv2.fillPoly(mask, [cv2.boxPoints(box).round().astype(np.int32)], 1)
    return mask > 0


def picture(seed, colour=None, light=1.0):
    image = ground(seed)
    if colour is not None:
        image[thing_mask(seed)] = colour
    noise = np.random.default_rng([seed, 2]).normal(0, 2, image.shape)
    rgb = np.clip(cv2.GaussianBlur(image, (0, 0), 0.7) * light + noise, 0, 255).astype(np.uint8)
    return np.dstack([rgb, np.full((SIZE, SIZE), 255, np.uint8)])


def patch(seed, before, after, light=1.0):
    no_shade = np.zeros((SIZE, SIZE), np.uint8)
    return Patch(
        0, 0, 0.05, picture(seed, before), picture(seed, after, light), thing_mask(seed), no_shade
    )


@settings(max_examples=25, deadline=None)
@given(
    st.integers(0, 1000),
    st.sampled_from([(190, 60, 50), (60, 60, 160), (150, 150, 150)]),
    st.floats(0.6, 1.3),
)
def test_a_thing_that_stands_out_is_announced_by_the_date_that_has_it(seed, colour, light):
    assert kind_of(patch(seed, None, colour, light)) == ChangeKind.APPEARED
    assert kind_of(patch(seed, colour, None, light)) == ChangeKind.DISAPPEARED


@pytest.mark.parametrize("seed", range(5))
def test_another_thing_in_the_same_place_is_replaced(seed):
    assert kind_of(patch(seed, (190, 60, 50), (50, 70, 190))) == ChangeKind.REPLACED


def test_ground_that_nobody_knows_does_not_stand_out():
    unknown = picture(0)
    unknown[..., 3] = 0
    assert not stands_out(unknown, thing_mask(0)).any()
    assert np.isfinite(stands_out(picture(0), np.zeros((SIZE, SIZE), bool))).all()
