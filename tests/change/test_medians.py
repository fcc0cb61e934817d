"""The quick medians are those of NumPy, to the last bit where every pixel is asked."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sorvolo.change.shape.kinds import median_ratio, middle_and_deviation


@settings(max_examples=60, deadline=None)
@given(count=st.integers(1, 300), seed=st.integers(0, 2**32 - 1), levels=st.integers(1, 256))
def test_they_are_numpys(count, seed, levels):
    rng = np.random.default_rng(seed)
    above, below = rng.integers(0, levels, (2, count, 1, 3)).astype(np.uint8)
    where = rng.random((count, 1)) < 0.7
    where[0] = True
    values = above[where].astype(np.float32)
    middles, deviations = middle_and_deviation(above, where)
    assert (middles == np.median(values, axis=0)).all()
    assert (deviations == np.median(np.abs(values - middles), axis=0)).all()
    ratios = (values + np.float32(8)) / (below[where] + np.float32(8))
    assert (median_ratio(above, below, where, 8.0) == np.median(ratios, axis=0)).all()


def test_of_many_pixels_some_are_enough():
    rng = np.random.default_rng(1)
    below = rng.integers(20, 200, (400, 400, 3)).astype(np.uint8)
    above = np.rint(below * [1.2, 1.0, 0.8]).astype(np.uint8)
    ratio = median_ratio(above, below, np.ones((400, 400), bool), 0.0)
    assert ratio == pytest.approx([1.2, 1.0, 0.8], abs=0.01)
