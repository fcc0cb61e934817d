"""Rows of detections, kept by masks and by indices."""

import numpy as np
import pytest

from sorvolo.survey.objects import Detections


@pytest.mark.parametrize(
    ("keep", "left"),
    [([], 0), ([1], 1), (np.array([True, False]), 1), (np.zeros(2, bool), 0), (range(2), 2)],
)
def test_rows_are_kept_by_a_mask_or_by_any_sequence_of_indices(keep, left):
    two = Detections(np.zeros((2, 4)), np.array([0.9, 0.8]), np.array([0, 1]), ("person", "car"))
    assert len(two.only(keep)) == left
