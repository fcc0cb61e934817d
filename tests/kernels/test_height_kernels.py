"""What the heights' compiled kernels compute, against their NumPy twins."""

import numpy as np
import numpy_heights
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sorvolo import kernels


def _asked(views: int, shape: tuple[int, int], seed: int) -> dict[str, object]:
    """Photos of other sizes that look down on a window of cells and show parts of it."""
    rng = np.random.default_rng(seed)
    sizes = rng.integers(12, 30, (views, 2))
    planes = np.zeros((views, 2, 3, 3))
    planes[:, 0] = np.eye(3) * 10 + rng.normal(0, 0.01, (views, 3, 3))
    planes[:, 0, :2, 2] = rng.uniform(-40, 60, (views, 2))  # up to half of the window unseen
    planes[:, 1, :, 2] = np.column_stack([rng.uniform(-8, 8, (views, 2)), np.full(views, -0.5)])
    hidden = [rng.uniform(-2, 3, shape).astype(np.float32) for _ in range(views)]
    return {
        "pictures": [rng.normal(0.2, 1, (2, *each)).astype(np.float32) for each in sizes],
        "channel": rng.integers(0, 2, (views, views)),
        "planes": planes,
        "frames": np.column_stack([np.zeros((views, 2)), sizes[:, ::-1] - 1.0]),
        "insets": rng.uniform(0, 3, (views, 2)).astype(np.float32),
        "hidden": [each if rng.random() < 0.5 else None for each in hidden],
        "heights": np.array([-1.0, 0.0, 2.5]),
        "sides": (3, 5),
        "shape": shape,
        "share": 0.5,
    }


@settings(max_examples=40, deadline=None)
@given(st.integers(2, 5), st.integers(1, 14), st.integers(1, 14), st.integers(0, 2**32 - 1))
def test_photos_agree_as_specified(views: int, height: int, width: int, seed: int) -> None:
    asked = _asked(views, (height, width), seed)
    found, plain = kernels.agreements(**asked, threads=2), numpy_heights.agreements(**asked)
    differ = np.isnan(found) != np.isnan(plain)
    assert not differ.any()
    np.testing.assert_allclose(found, plain, atol=2e-5)


def test_something_is_seen_and_something_is_not() -> None:
    found = kernels.agreements(**_asked(4, (14, 14), 1))
    assert 0.1 < np.isfinite(found).mean() < 0.95 and np.nanmax(found) > 0.2


@settings(max_examples=40, deadline=None)
@given(
    st.integers(1, 7),
    st.integers(1, 6),
    st.integers(1, 7),
    st.floats(0, 0.5),
    st.floats(0.1, 1),
    st.integers(0, 2**32 - 1),
)
def test_paths_cost_as_specified(
    rows: int, levels: int, columns: int, one: float, more: float, seed: int
) -> None:
    cost = np.random.default_rng(seed).random((rows, levels, columns)).astype(np.float32)
    np.testing.assert_allclose(
        kernels.path_costs(cost, one, more), numpy_heights.path_costs(cost, one, more), rtol=1e-4
    )


def test_what_does_not_fit_is_refused() -> None:
    asked = _asked(3, (8, 8), 1)
    for wrong, words in (
        ({"sides": (4, 5)}, "sides are odd"),
        ({"frames": np.zeros((2, 4))}, "do not fit"),
        ({"channel": np.full((3, 3), 2)}, "channels that they have"),
        ({"hidden": [None, None, np.zeros((7, 8), np.float32)]}, "do not fit"),
    ):
        with pytest.raises(ValueError, match=words):
            kernels.agreements(**asked | wrong)
    with pytest.raises(ValueError, match="do not fit"):
        kernels.path_costs(np.zeros((2, 2), np.float32), 0.1, 0.5)
