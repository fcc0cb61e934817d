"""Thresholds that follow the light."""

import numpy as np
import pytest

from sorvolo.lab.thesis.changes import (
    ThesisSettings,
    light_difference,
    prepare_reference,
    thesis_steps,
)


def test_thresholds_rise_with_the_difference_of_light() -> None:
    open_ones = ThesisSettings(gray_threshold=None, hamming_share=None)
    like, unlike, dark = (open_ones.in_light(levels) for levels in (0.0, 28.0, 400.0))
    assert (like.gray_threshold, like.hamming_share) == (40, 0.3)  # Table 4.2
    assert unlike.gray_threshold == 56 and unlike.hamming_share == pytest.approx(0.42)
    assert dark.gray_threshold == 255 and dark.hamming_share == 0.45
    assert ThesisSettings().in_light(28.0) == ThesisSettings()


def test_light_is_what_pre_processing_leaves_and_a_cloud_raises_the_threshold() -> None:
    rng = np.random.default_rng(5)
    ground = np.repeat(np.repeat(rng.integers(40, 200, (24, 32, 3)), 8, axis=0), 8, axis=1).astype(
        np.uint8
    )
    brighter = (ground * 0.8).astype(np.uint8)
    clouded = ground.copy()
    clouded[:, 176:] //= 2
    levels = {
        name: light_difference(prepare_reference(ground), prepare_reference(query))
        for name, query in (("same", ground), ("darker", brighter), ("cloud", clouded))
    }
    assert levels["same"] == 0 and levels["darker"] < 3  # equalisation removes it
    assert levels["cloud"] > 25
    chosen = ThesisSettings(gray_threshold=None).in_light(levels["cloud"]).gray_threshold
    every = [
        ThesisSettings(gray_threshold=level, hamming_share=0.0) for level in (40, None, chosen)
    ]
    differing = [
        np.count_nonzero(thesis_steps(ground, clouded, settings=each).difference) for each in every
    ]
    assert differing[1] == differing[2] < differing[0]  # Table 4.2 takes the cloud for a change
