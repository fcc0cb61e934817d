"""Table 4.2 by the thesis's names, and thresholds that follow the light."""

import numpy as np
import pytest

from sorvolo.change.pair.thesis import (
    ThesisSettings,
    light_difference,
    prepare_reference,
    thesis_steps,
)
from sorvolo.change.pair.thesis_options import NAMES, ThesisOptions, thesis_options
from sorvolo.errors import SettingsError
from sorvolo.missions.flight.settings import CompareSettings


def test_every_value_of_table_4_2_can_be_written() -> None:
    table = [
        "W_a=10x10",
        "W_l=15x15",
        "T_gray=40",
        "T_H=0.3",
        "W_i=37x37",
        "T_iso=0.25",
        "T_area=0.000648",
        "T_B=0.3",
    ]
    assert thesis_options(table) == ThesisOptions() == thesis_options([])
    other = thesis_options(
        [
            "w_a=8x6",
            "W_l=9x9",
            "T_gray=light",
            "T_H=light",
            "W_i=5x7",
            "T_iso=0.5",
            "T_area=0.01",
            "T_B=0.2",
            "eq3.21=printed",
            "threads=4",
        ]
    )
    assert other == ThesisOptions(
        ThesisSettings((8, 6), (9, 9), None, None, (5, 7), 0.5, True, 0.01, 0.2), 4
    )
    assert len(NAMES) == 10


@pytest.mark.parametrize(
    ("written", "needed"),
    [
        ("T_gry=40", "T_gray"),
        ("T_gray", "NAME=VALUE"),
        ("T_gray=", "NAME=VALUE"),
        ("T_gray=dark", "or light"),
        ("T_gray=900", "0 to 255"),
        ("W_a=10", "10x10"),
        ("W_a=0x9", "1 to"),
        ("T_H=2", "0 to 1"),
        ("T_H=nan", "or light"),
        ("T_iso=light", "0 to 1"),
        ("eq3.21=both", "printed or corrected"),
        ("threads=0", "1 to 256"),
    ],
)
def test_what_cannot_be_read_is_refused_with_what_is_needed(written: str, needed: str) -> None:
    with pytest.raises(SettingsError, match=needed):
        thesis_options([written])


def test_table_4_2_without_method_thesis_is_refused() -> None:
    with pytest.raises(SettingsError, match="--method thesis"):
        CompareSettings(thesis=thesis_options(["threads=2"]))
    assert (
        CompareSettings(method="thesis", thesis=thesis_options(["threads=2"])).thesis.threads == 2
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
