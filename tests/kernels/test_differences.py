"""What two pictures differ by, their tint, rims and parts of regions: compiled kernels against their NumPy twins."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import numpy_robust
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sorvolo import kernels
from sorvolo.change.regions import MOST_KEPT_PX, Scratch, find_regions
from sorvolo.change.robust import compare_robust

SIDES = st.integers(2, 40)


def pictures(height: int, width: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Two noisy pictures with steps, so that every branch of clipping is met."""
    rng = np.random.default_rng(seed)
    before = rng.integers(0, 256, (height, width, 3), dtype=np.uint8)
    after = np.clip(before.astype(int) + rng.integers(-20, 21, before.shape), 0, 255).astype(
        np.uint8
    )
    before[height // 2 :, : width // 2] = rng.choice([0, 255], 3)
    after[: height // 2, width // 2 :] = rng.choice([0, 255], 3)
    return before, after


@settings(max_examples=60, deadline=None)
@given(SIDES, SIDES, st.integers(0, 5), st.integers(0, 4), st.booleans(), st.integers(0, 2**32 - 1))
def test_differences_are_as_specified(
    height: int, width: int, reach: int, weight: int, masked: bool, seed: int
) -> None:
    before, after = pictures(height, width, seed)
    known = np.random.default_rng(seed).random((height, width)) < 0.7 if masked else None
    plain = np.empty((6, height, width), np.uint8)
    numpy_robust.differences(
        before, after, None if known is None else known.view(np.uint8), reach, weight, plain
    )
    assert np.array_equal(kernels.differences(before, after, known, reach, weight), plain)


@settings(max_examples=100, deadline=None)
@given(SIDES, SIDES, st.floats(0.02, 0.98), st.floats(0, 0.2), st.integers(0, 2**32 - 1))
def test_held_parts_are_as_specified(
    height: int, width: int, share: float, seeded: float, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    mask, seeds = (
        (rng.random((height, width)) < each).astype(np.uint8) * 255 for each in (share, seeded)
    )
    assert np.array_equal(kernels.held_parts(mask, seeds), numpy_robust.held_parts(mask, seeds))


@settings(max_examples=40, deadline=None)
@given(st.integers(6, 30), st.integers(6, 30), st.integers(0, 2**32 - 1))
def test_tint_and_rims_are_as_specified(height: int, width: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    before, after = pictures(height, width, seed)
    logs = np.sort(rng.integers(0, 256, 256, dtype=np.uint8))
    labels, boxes = kernels.core_regions(
        rng.integers(0, 256, (height, width), dtype=np.uint8),
        np.full((height, width), rng.integers(80, 200), np.uint8),
        1.2,
        rng.uniform(0.1, 0.9),
        3,
        8,
    )
    found, plain = (np.full((height, width), 7, np.uint8) for _ in range(2))
    kernels.tint(before, after, logs, boxes, 2, found)
    numpy_robust.tint(before, after, logs, boxes, 2, plain)
    assert np.array_equal(found, plain)
    came, went = before[..., 0], after[..., 1]
    assert np.array_equal(
        kernels.rim_balance(labels, boxes, came, went),
        numpy_robust.rim_balance(labels, boxes, came, went),
    )


def test_the_same_target_is_written_over_and_returned() -> None:
    before, after = pictures(20, 24, 1)
    out = np.full((6, 20, 24), 99, np.uint8)
    assert kernels.differences(before, after, None, 2, 2, out) is out
    assert np.array_equal(out, kernels.differences(before, after, None, 2, 2))


def test_two_threads_do_not_share_their_working_arrays() -> None:
    pairs = [pictures(90, 120, seed) for seed in range(6)]
    alone = [compare_robust(*pair) for pair in pairs]
    with ThreadPoolExecutor(2) as pool:
        together = list(pool.map(lambda pair: compare_robust(*pair), pairs * 4))
    for one, other in zip(alone * 4, together, strict=True):
        assert np.array_equal(one.mask, other.mask) and np.array_equal(one.scores, other.scores)
        assert one.noise == other.noise and one.settling.rest_px == other.settling.rest_px


def test_wide_low_pictures_are_compared_without_settling() -> None:
    before, after = pictures(100, 400, 5)
    assert compare_robust(before, after).settling.moved_px == 0  # OpenCV's flow crashes on such


def test_what_does_not_fit_is_refused() -> None:
    before, after = pictures(20, 24, 1)
    with pytest.raises(ValueError, match="do not fit"):
        kernels.differences(before, after[:10], None, 2, 2)
    with pytest.raises(ValueError, match="reach"):
        kernels.differences(before, after, None, 99, 2)
    with pytest.raises(ValueError, match="known"):
        kernels.differences(before, after, np.ones((3, 3), bool), 2, 2)
    with pytest.raises(ValueError, match="C order"):
        kernels.differences(before, after, None, 2, 2, np.empty((6, 24, 20), np.uint8))
    labels = np.ones((20, 24), np.uint8)
    with pytest.raises(ValueError, match="boxes outside"):
        kernels.rim_balance(labels, np.int32([[20, 0, 9, 3]]), before[..., 0], before[..., 1])
    with pytest.raises(ValueError, match="a byte"):
        kernels.core_regions(before[..., 0], after[..., 0], 1.5, 0.5, 3, 256)


def test_what_is_handed_out_survives_the_next_pictures() -> None:
    before, after = pictures(60, 80, 1)
    regions = find_regions(before, after, None, 0.1, 0.0)
    kept = (
        regions.weak.copy(),
        regions.labels.copy(),
        regions.features.copy(),
        regions.strength.copy(),
    )
    find_regions(*pictures(60, 80, 2), None, 0.1, 0.0)
    now = regions.weak, regions.labels, regions.features, regions.strength
    assert all(np.array_equal(a, b) for a, b in zip(kept, now, strict=True))


def test_scratch_keeps_one_size_and_nothing_large() -> None:
    scratch = Scratch()
    first = scratch.stack("a", (10, 20), 3)
    assert first.shape == (3, 10, 20) and scratch.stack("a", (10, 20), 3) is first
    assert scratch.take("b", (10, 20), margin_px=2).shape == (14, 24)
    assert scratch.take("b", (10, 20), (3,)).shape == (10, 20, 3)
    scratch.take("a", (11, 20))
    assert scratch.stack("a", (10, 20), 3) is not first
    large = (MOST_KEPT_PX, 2)
    assert scratch.stack("c", large, 1) is not scratch.stack("c", large, 1)


@settings(max_examples=25, deadline=None)
@given(st.integers(1, 140), st.integers(1, 100), st.integers(0, 9), st.integers(0, 2**32 - 1))
def test_narrow_wide_and_stepped_windows_are_matched_as_specified(
    wide: int, high: int, reach: int, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    query = rng.integers(0, 256, (high + 3, wide + 5), dtype=np.uint8)
    searched = rng.integers(0, 256, (high + 3 + 2 * reach, wide + 5 + 2 * reach), dtype=np.uint8)
    boxes = np.int32([[5, 3, wide, high], [0, 0, wide, high]])
    found = kernels.match_regions(query, searched, boxes, reach)
    assert np.array_equal(found, numpy_robust.match_regions(query, searched, boxes, reach))
