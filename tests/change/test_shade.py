"""The shade mask of a view: what is no brighter on one date, all colours alike, whatever the light of the day."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sorvolo.change.shade import shade_between, shade_of_view
from sorvolo.survey.findings import Shade

SHADOW, THING = np.s_[160:190, 60:120], np.s_[160:190, 260:290]


def ground() -> np.ndarray:
    """(360, 640, 3) uint8 rough ground."""
    rng = np.random.default_rng(3)
    grain = sum(cv2.resize(rng.normal(0, 9, (360 // k, 640 // k)), (640, 360)) for k in (2, 5))
    return np.clip(np.array([120, 130, 90]) + grain[..., None], 0, 255).astype(np.uint8)


@pytest.mark.parametrize("light", [(1.0, 1.0, 1.0), (1.4, 1.3, 1.2), (0.6, 0.65, 0.75)])
def test_a_shadow_that_came_is_shade_and_a_thing_is_not(light):
    reference = ground()
    image = reference * np.array(light)
    image[SHADOW] *= [0.4, 0.45, 0.52]
    image[THING] = [190, 60, 50]
    shade = shade_of_view(
        reference, np.clip(image, 0, 255).astype(np.uint8), np.ones((360, 640), bool)
    )
    assert ((shade[SHADOW] & Shade.LATER_DARK) > 0).mean() > 0.98
    assert not (shade[THING] & (Shade.LATER | Shade.EARLIER)).any()
    far = shade[:, 400:]
    assert ((far & Shade.LATER) > 0).mean() > 0.95 and not (far & Shade.LATER_DARK).any()


def test_unknown_ground_has_no_shade():
    valid = np.ones((360, 640), bool)
    valid[:, :100] = False
    shade = shade_of_view(ground(), ground(), valid)
    assert not shade[~valid].any() and shade[valid].all()


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), most=st.integers(1, 255))
def test_swapping_the_dates_swaps_the_bits_and_dark_is_no_brighter(seed, most):
    before, after = (
        np.random.default_rng(seed).integers(0, most + 1, (2, 12, 16, 3)).astype(np.uint8)
    )
    one, other = shade_between(before, after), shade_between(after, before)
    for bit, swapped in ((Shade.LATER, Shade.EARLIER), (Shade.LATER_DARK, Shade.EARLIER_DARK)):
        assert (((one & bit) > 0) == ((other & swapped) > 0)).all()
    assert not ((one & Shade.LATER_DARK) > 0)[(one & Shade.LATER) == 0].any()
