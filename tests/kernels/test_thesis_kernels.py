"""The compiled kernels give what their NumPy twins give, to the last pixel."""

from typing import Any

import cv2
import numpy as np
import numpy_thesis
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sorvolo import kernels

sizes = st.tuples(st.integers(1, 40), st.integers(1, 170))
windows = st.tuples(st.integers(1, 19), st.integers(1, 19))
seeds = st.integers(0, 2**32 - 1)
threads = st.integers(1, 5)


def picture(seed: int, size: tuple[int, int], channels: int = 3) -> Any:
    """Smooth or rough, of many values or few, so that ties and flat pieces occur."""
    rng = np.random.default_rng(seed)
    values = rng.integers(0, rng.choice([2, 5, 256]), (*size, channels), np.uint8) * rng.choice(
        [1, 50]
    )
    if rng.random() < 0.5:
        values = cv2.blur(values.astype(np.uint8), (5, 5)).reshape(*size, channels)
    return values.astype(np.uint8)


def some(seed: int, size: tuple[int, int]) -> Any:
    rng = np.random.default_rng(seed + 1)
    return (rng.random(size) < rng.choice([0.0, 0.03, 0.5, 1.0])).astype(np.uint8) * 255


@settings(max_examples=60, deadline=None)
@given(seeds, sizes, threads, st.booleans())
def test_equalising_tables_agree(
    seed: int, size: tuple[int, int], threads: int, holes: bool
) -> None:
    image, known = picture(seed, size), some(seed, size) if holes else None
    expected = numpy_thesis.equalising_tables(image, known, 1)
    np.testing.assert_array_equal(kernels.equalising_tables(image, known, threads), expected)


@settings(max_examples=60, deadline=None)
@given(seeds, sizes, windows, threads)
def test_averaged_agrees(
    seed: int, size: tuple[int, int], window: tuple[int, int], threads: int
) -> None:
    image = picture(seed, size)
    tables = np.random.default_rng(seed).integers(0, 256, (3, 256), np.uint8)
    expected = numpy_thesis.averaged(image, tables, *window, 1)
    for found, right in zip(
        kernels.averaged(image, tables, *window, threads), expected, strict=True
    ):
        np.testing.assert_array_equal(found, right)


@settings(max_examples=80, deadline=None)
@given(seeds, sizes, windows, threads, st.floats(0, 0.7))
def test_texture_changes_agree(
    seed: int, size: tuple[int, int], window: tuple[int, int], threads: int, share: float
) -> None:
    before, after = (
        np.ascontiguousarray(picture(seed + k, size).transpose(2, 0, 1)) for k in range(2)
    )
    asked, most = some(seed, size), int(share * 3 * window[0] * window[1])
    expected = numpy_thesis.texture_changes(before, after, asked, *window, most, 1)
    np.testing.assert_array_equal(
        kernels.texture_changes(before, after, asked, *window, most, threads), expected
    )


@settings(max_examples=60, deadline=None)
@given(seeds, sizes, st.tuples(st.integers(1, 60), st.integers(1, 60)), threads, st.floats(0, 1))
def test_isolations_agree(
    seed: int, size: tuple[int, int], window: tuple[int, int], threads: int, share: float
) -> None:
    mask, most = some(seed, size), int(share * window[0] * window[1])
    expected = numpy_thesis.without_isolations(mask, *window, most, 1)
    np.testing.assert_array_equal(
        kernels.without_isolations(mask, *window, most, threads), expected
    )


@settings(max_examples=100, deadline=None)
@given(seeds, sizes, st.floats(0.02, 0.98))
def test_regions_and_their_histograms_agree(seed: int, size: tuple[int, int], share: float) -> None:
    rng = np.random.default_rng(seed)
    mask = (rng.random(size) < share).astype(np.uint8) * 255
    boxes = numpy_thesis.region_boxes(mask)
    np.testing.assert_array_equal(kernels.region_boxes(mask), boxes)
    image, tables = picture(seed, size), rng.integers(0, 256, (3, 256), np.uint8)
    for known in (None, some(seed, size)):
        expected = numpy_thesis.gray_histograms(image, tables, boxes, known)
        np.testing.assert_array_equal(
            kernels.gray_histograms(image, tables, boxes, known), expected
        )


def test_regions_are_those_of_opencv() -> None:
    rng = np.random.default_rng(5)
    mask = cv2.blur((rng.random((150, 210)) * 255).astype(np.uint8), (5, 5)) // 140 * 255
    _, _, stats, _ = cv2.connectedComponentsWithStats(mask, connectivity=8)
    boxes = kernels.region_boxes(mask)
    assert len(boxes) > 10
    assert {tuple(box) for box in boxes} == {tuple(each[:4]) for each in stats[1:]}


def test_equalisation_and_gray_are_those_of_opencv() -> None:
    image = picture(3, (90, 120))
    equalised = numpy_thesis.looked_up(image, kernels.equalising_tables(image))
    expected = np.stack(
        [cv2.equalizeHist(np.ascontiguousarray(image[..., each])) for each in range(3)], axis=-1
    )
    assert np.abs(equalised.astype(int) - expected).max() <= 1  # OpenCV rounds a float product
    np.testing.assert_array_equal(
        numpy_thesis.gray_of(image), cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    )


def test_a_window_of_ten_is_the_mean_from_five_before_to_four_after() -> None:
    image = np.random.default_rng(4).integers(0, 256, (30, 40, 3), np.uint8)
    identity = np.tile(np.arange(256, dtype=np.uint8), (3, 1))
    planes, _ = kernels.averaged(image, identity, 10, 10)
    assert planes[1, 12, 20] == int(image[7:17, 15:25, 1].mean() + 0.5)
    expected = cv2.blur(image, (10, 10)).transpose(2, 0, 1)
    assert np.abs(planes.astype(int) - expected).max() <= 1


@pytest.mark.parametrize("window", [(0, 3), (3, 128)])
def test_windows_out_of_range_are_refused(window: tuple[int, int]) -> None:
    with pytest.raises(ValueError, match="a window is 1 to 127 px"):
        kernels.without_isolations(np.zeros((5, 5), np.uint8), *window, 3)


def test_arrays_that_do_not_fit_are_refused() -> None:
    image, identity = np.zeros((4, 5, 3), np.uint8), np.zeros((3, 256), np.uint8)
    with pytest.raises(ValueError, match="not empty"):
        kernels.equalising_tables(image[:0])
    with pytest.raises(ValueError, match="does not fit"):
        kernels.equalising_tables(image, np.zeros((5, 4), np.uint8))
    with pytest.raises(ValueError, match="outside of the 5 x 4 px image"):
        kernels.gray_histograms(image, identity, np.array([[2, 1, 4, 1]]))
    with pytest.raises(ValueError, match="do not fit"):
        kernels.texture_changes(
            np.zeros((3, 4, 5), np.uint8), np.zeros((3, 4, 6), np.uint8), image[..., 0], 3, 3, 1
        )
