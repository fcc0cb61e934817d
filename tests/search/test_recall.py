"""Chances learnt from plants: right where the truth is known, honest where little is known."""

import numpy as np
import pytest

from sorvolo.geometry.summary import calibration_bins, wilson
from sorvolo.search.recall import (
    Chances,
    figures,
    fit_recall,
    held_out_chances,
    map_chances,
    segment,
    together,
)


def _tried(count: int, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    columns = rng.normal(size=(count, 3))
    true = 1 / (1 + np.exp(-(0.4 + 1.2 * columns[:, 0])))
    return columns, true, rng.uniform(size=count) < true


def test_chances_fit_the_truth_and_their_intervals_hold_it() -> None:
    columns, _, found = _tried(400, 1)
    other, true, _ = _tried(300, 2)
    chances = fit_recall(columns, found).of(other)
    assert np.abs(chances.mean - true).mean() < 0.05
    inside = (chances.low <= true) & (true <= chances.high)
    assert inside.mean() > 0.8


def test_what_is_stated_as_eight_of_ten_comes_true_eight_times_of_ten() -> None:
    columns, _, found = _tried(1500, 3)
    for each in calibration_bins(held_out_chances(columns, found), found):
        assert each.count < 60 or abs(each.stated - each.found) < 0.07


def test_few_plants_leave_wide_intervals() -> None:
    columns, _, found = _tried(300, 4)
    few, many = (
        fit_recall(columns[:8], found[:8]).of(columns),
        fit_recall(columns, found).of(columns),
    )
    assert (few.high - few.low).mean() > 2 * (many.high - many.low).mean()


def test_all_found_is_not_certainty_and_beyond_the_plants_nothing_is_extrapolated() -> None:
    columns, _, _ = _tried(40, 5)
    recall = fit_recall(columns, np.ones(40, bool))
    assert 0.85 < recall.of(np.zeros((1, 3))).low[0] < 0.999
    far, farther = recall.of(np.array([[-9.0, 0, 0], [-90.0, 0, 0]])).mean
    assert far == pytest.approx(farther)


def test_unseen_cells_stay_unknown_and_hidden_ones_are_nought() -> None:
    columns, _, found = _tried(60, 6)
    cells = np.array([[0.0, 0, 0], [np.nan, 0, 0], [0.0, 0, 0]])
    chances = map_chances(fit_recall(columns, found), cells, np.array([False, False, True]))
    assert np.isnan(chances.mean[1]) and chances.mean[2] == 0 and chances.mean[0] > 0.3
    assert np.isnan(map_chances(None, cells, np.zeros(3, bool)).mean).all()


def test_wilson_interval_of_eight_out_of_ten() -> None:
    low, high = wilson(8, 10)
    assert low == pytest.approx(0.541, abs=0.002) and high == pytest.approx(0.931, abs=0.002)
    assert wilson(0, 0) == (0.0, 1.0)


def test_flights_together_miss_what_each_misses() -> None:
    first = Chances(
        np.array([0.5, np.nan, np.nan]),
        np.array([0.4, np.nan, np.nan]),
        np.array([0.6, np.nan, np.nan]),
    )
    second = Chances(
        np.array([0.6, 0.3, np.nan]), np.array([0.5, 0.2, np.nan]), np.array([0.7, 0.4, np.nan])
    )
    both = together([first, second])
    assert both.mean[:2] == pytest.approx([0.8, 0.3]) and np.isnan(both.mean[2])
    assert both.low[0] == pytest.approx(0.7) and both.high[0] == pytest.approx(0.88)


def test_figures_count_unseen_ground_as_nought() -> None:
    mean = np.array([0.8, 0.8, np.nan, 0.8])
    chances = Chances(mean, mean - 0.1, mean + 0.1)
    found = figures([chances], np.array([True, True, True, False]), 10.0, 20.0)
    assert found.area_m2 == 300 and found.seen_m2 == 200
    assert found.pod == pytest.approx(1.6 / 3) and found.swept_m2 == pytest.approx(160)
    assert found.sweep_width_m == pytest.approx(12.0) and found.random_pod == pytest.approx(
        1 - np.exp(-1.6 / 3)
    )
    north = segment("north", 0.6, chances, np.array([True, True, False, False]), 10.0, 400.0)
    assert (
        north.pod == pytest.approx(0.4)
        and north.pos == pytest.approx(0.24)
        and north.left == pytest.approx(0.36)
    )


def test_the_effort_of_two_flights_adds_up_and_their_sweep_width_stays() -> None:
    """The same flight twice: twice the coverage, the same sweep width, a probability below 1."""
    mean = np.array([0.7, 0.7, np.nan])
    chances, wanted = Chances(mean, mean - 0.1, mean + 0.1), np.ones(3, bool)
    once, twice = (figures([chances] * count, wanted, 10.0, 20.0 * count) for count in (1, 2))
    assert once.coverage == pytest.approx(1.4 / 3) and twice.coverage == pytest.approx(2.8 / 3)
    assert twice.swept_m2 == pytest.approx(2 * once.swept_m2)
    assert twice.sweep_width_m == pytest.approx(once.sweep_width_m)
    assert twice.random_pod == pytest.approx(1 - np.exp(-2.8 / 3))
    assert twice.pod == pytest.approx(2 / 3 * (1 - 0.3**2)) and twice.seen_m2 == once.seen_m2
