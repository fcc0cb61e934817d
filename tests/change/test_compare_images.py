"""The public comparison of two pictures: what it gives, and what it answers to input that it cannot use."""

from typing import Any

import cv2
import numpy as np
import pytest

import sorvolo
from sorvolo.change.robust import compare_robust
from sorvolo.errors import InputError


def scene() -> tuple[Any, Any]:
    before = np.random.default_rng(3).integers(60, 120, (96, 128, 3), np.uint8)
    after = before.copy()
    after[30:60, 40:80] = (240, 220, 30)
    after[40:50, 50:70] = 10
    return before, after


COMPARE = [sorvolo.compare_images, sorvolo.compare_thesis]


@pytest.mark.parametrize("compare", COMPARE)
def test_mask_and_boxes(compare: Any) -> None:
    mask, boxes = compare(*scene())
    assert mask.shape == (96, 128) and mask.dtype == np.uint8 and set(np.unique(mask)) <= {0, 255}
    assert boxes.ndim == 2 and boxes.shape[1] == 4 and boxes.dtype == np.int64


def test_the_thesis_compares_with_any_number_of_threads_and_any_layout() -> None:
    before, after = scene()
    found = sorvolo.compare_thesis(before, after)
    assert found.mask[40:50, 50:70].all() and len(found.boxes) == 1
    wide = np.zeros((96, 256, 3), np.uint8)
    wide[:, ::2] = after
    again = sorvolo.compare_thesis(sorvolo.prepare_reference(before), wide[:, ::2], threads=3)
    np.testing.assert_array_equal(found.mask, again.mask)
    np.testing.assert_array_equal(found.boxes, again.boxes)


def test_pictures_are_red_green_blue_as_everywhere_else() -> None:
    before = np.full((96, 128, 3), 90, np.uint8)
    after = before.copy()
    after[30:60, 40:80] = (90, 90, 190)  # blue, of which a grey level has the least
    flipped = [np.ascontiguousarray(each[..., ::-1]) for each in (before, after)]
    robust = compare_robust(*flipped)
    np.testing.assert_array_equal(sorvolo.compare_images(before, after).mask, robust.mask)
    before, after = scene()
    steps = sorvolo.thesis_steps(before, after)
    assert np.corrcoef(steps.query_equalised[..., 0].ravel(), after[..., 0].ravel())[0, 1] > 0.7
    gray = cv2.cvtColor(steps.query_averaged, cv2.COLOR_RGB2GRAY)
    assert cv2.absdiff(gray, sorvolo.prepare_reference(after).gray).max() <= 1


PICTURE = np.zeros((40, 50, 3), np.uint8)


@pytest.mark.parametrize("compare", COMPARE)
@pytest.mark.parametrize(
    ("reference", "query", "valid", "message"),
    [
        (PICTURE[:-1], PICTURE, None, "reference is 50 x 39 px, query 50 x 40 px"),
        (PICTURE.astype(np.float32), PICTURE, None, "reference holds float32; give uint8"),
        (PICTURE, PICTURE[..., 0], None, r"query has the shape \(40, 50\)"),
        (PICTURE, np.zeros((40, 50, 4), np.uint8), None, r"query has the shape \(40, 50, 4\)"),
        (PICTURE[:0], PICTURE[:0], None, "reference is empty"),
        ([[1, 2]], PICTURE, None, "reference is a list"),
        (PICTURE, None, None, "query is a NoneType"),
        (PICTURE, PICTURE, np.ones((50, 40), bool), r"valid has the shape \(50, 40\)"),
        (PICTURE, PICTURE, PICTURE[..., 0], "valid is an array of uint8"),
        (PICTURE, PICTURE, "yes", "valid is a str"),
    ],
)
def test_input_that_cannot_be_used_is_named(
    compare: Any, reference: Any, query: Any, valid: Any, message: str
) -> None:
    with pytest.raises(InputError, match=message):
        compare(reference, query, valid)


def test_pictures_too_small_to_compare_are_refused() -> None:
    with pytest.raises(InputError, match="50 x 20 px; at least 32"):
        sorvolo.compare_images(PICTURE[:20], PICTURE[:20])
