"""The quick medians are those of NumPy, to the last bit where every pixel is asked."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from sorvolo.change.kinds import middle_and_deviation


@settings(max_examples=60, deadline=None)
@given(count=st.integers(1, 300), seed=st.integers(0, 2**32 - 1), levels=st.integers(1, 256))
def test_they_are_numpys(count, seed, levels):
    rng = np.random.default_rng(seed)
    above = rng.integers(0, levels, (count, 1, 3)).astype(np.uint8)
    where = rng.random((count, 1)) < 0.7
    where[0] = True
    values = above[where].astype(np.float32)
    middles, deviations = middle_and_deviation(above, where)
    assert (middles == np.median(values, axis=0)).all()
    assert (deviations == np.median(np.abs(values - middles), axis=0)).all()
