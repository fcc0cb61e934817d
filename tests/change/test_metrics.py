"""Counts as in the thesis's tables, and events: each found once, on time, in its place."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from sorvolo.errors import SettingsError
from sorvolo.lab.evaluation.change_metrics import (
    Counts,
    FoundEvent,
    TrueEvent,
    frame_counts,
    match_events,
    pixel_counts,
    score_events,
)
from sorvolo.survey.findings import ChangeKind

APPEARED, GONE, REPLACED, _, MOVING = ChangeKind
BOX = np.array([[-0.5, -0.25], [0.5, -0.25], [0.5, 0.25], [-0.5, 0.25]])
SECOND = 10**9


def found(name: str, at, kind=APPEARED, size=1.0, sigma_m=math.nan, announced_s=None) -> FoundEvent:
    announced_ns = None if announced_s is None else round(announced_s * SECOND)
    return FoundEvent(name, kind, np.asarray(at) + size * BOX, sigma_m, announced_ns)


def true(name: str, at, kind=APPEARED, must_find=True, path=(), length_m=1.0) -> TrueEvent:
    clear_ns = np.array([10, 10.2, 10.4, 10.6]) * SECOND
    return TrueEvent(
        name,
        kind,
        np.asarray(at) + BOX,
        length_m,
        clear_ns.astype(np.int64),
        np.array(path, float).reshape(-1, 2),
        must_find,
    )


def test_the_published_counts_give_the_published_rates():
    """Tables 4.3 and 4.4."""
    counts = Counts(tp=3167, fp=884, fn=41, tn=9779)
    rates = [counts.precision, counts.recall, counts.accuracy, counts.f1]
    assert rates == pytest.approx([0.7818, 0.9872, 0.9333, 0.8726], abs=6e-5)


MASKS = arrays.arrays(bool, (3, 7, 9))


@given(MASKS)
def test_every_pixel_is_counted_once_and_rates_agree_with_their_definition(masks):
    seen, truth, unknown = masks
    counts = pixel_counts(seen, truth, unknown)
    assert counts.tp + counts.fp + counts.fn + counts.tn + counts.unknown == truth.size
    assert counts.unknown == unknown.sum()
    assert counts.fn == (~seen & truth & ~unknown).sum()
    if counts.tp:
        precision, recall = counts.precision, counts.recall
        assert counts.f1 == pytest.approx(2 * precision * recall / (precision + recall))
    mirrored = pixel_counts(truth, seen, unknown)
    assert (mirrored.fp, mirrored.fn) == (counts.fn, counts.fp)


def test_rates_without_a_denominator_are_not_numbers():
    nothing = pixel_counts(np.zeros((4, 4), bool), np.zeros((4, 4), bool))
    assert math.isnan(nothing.precision) and math.isnan(nothing.recall) and math.isnan(nothing.f1)
    assert nothing.accuracy == 1.0
    assert math.isnan(Counts().accuracy)


@pytest.mark.parametrize(
    ("seen", "there", "least_px", "expected"),
    [
        (1, 1, 1, Counts(tp=1)),
        (0, 1, 1, Counts(fn=1)),
        (1, 0, 1, Counts(fp=1)),
        (0, 0, 1, Counts(tn=1)),
        (5, 3, 4, Counts(unknown=1)),
        (3, 0, 4, Counts(tn=1)),
        (3, 5, 4, Counts(fn=1)),
        (4, 4, 4, Counts(tp=1)),
    ],
)
def test_a_frame_is_positive_from_so_many_pixels_on(seen, there, least_px, expected):
    masks = np.zeros((2, 30), bool)
    masks[0, :seen] = masks[1, :there] = True
    assert frame_counts(masks[:1], masks[1:], least_px=least_px) == expected


def test_unknown_pixels_make_no_frame_positive():
    mask = np.zeros((2, 5), bool)
    mask[0] = True
    assert frame_counts(mask, np.zeros_like(mask), mask) == Counts(tn=1)
    assert frame_counts(mask, mask, mask) == Counts(tn=1)
    assert frame_counts(mask, mask, np.ones_like(mask)) == Counts(unknown=1)


def test_masks_of_different_size_are_refused():
    with pytest.raises(SettingsError):
        frame_counts(np.zeros((3, 4), bool), np.zeros((3, 4), bool), least_px=0)


def test_each_event_ends_in_exactly_one_place():
    trues = [
        true("found", (0, 0)),
        true("missed", (10, 0)),
        true("hidden", (20, 0), must_find=False),
        true("seen by luck", (30, 0), must_find=False),
    ]
    reports = [
        found("right", (0.1, 0.0)),
        found("again", (0.3, 0.2)),
        found("nothing", (50, 0)),
        found("luck", (30, 0)),
    ]
    match = match_events(reports, trues)
    assert [(pair.true.id, pair.found.id) for pair in match.pairs] == [("found", "right")]
    assert [each.id for each in match.missed] == ["missed"]
    assert [each.id for each in match.skipped] == ["hidden", "seen by luck"]
    assert [each.id for each in match.twice] == ["again"]
    assert [each.id for each in match.false] == ["nothing"]
    assert [each.id for each in match.optional] == ["luck"]
    scores = score_events(match, 5000.0)
    assert (scores.must_find, scores.found, scores.twice, scores.false, scores.optional) == (
        2,
        1,
        1,
        1,
        1,
    )
    assert scores.found_share == 0.5
    assert scores.false_per_hectare == pytest.approx(2.0)


@given(
    st.lists(st.tuples(st.floats(-3, 3), st.floats(-3, 3)), max_size=6),
    st.lists(st.tuples(st.floats(-3, 3), st.floats(-3, 3), st.booleans()), max_size=6),
)
def test_no_report_and_no_truth_is_lost(reports, truths):
    match = match_events(
        [found(str(i), at) for i, at in enumerate(reports)],
        [true(str(i), at[:2], must_find=at[2]) for i, at in enumerate(truths)],
    )
    mine = [*(pair.found for pair in match.pairs), *match.twice, *match.false, *match.optional]
    assert sorted(each.id for each in mine) == sorted(map(str, range(len(reports))))
    theirs = [*(pair.true for pair in match.pairs), *match.missed, *match.skipped]
    assert sorted(each.id for each in theirs) == sorted(map(str, range(len(truths))))


def test_near_means_touching_or_within_half_the_length():
    place = true("car", (0, 0), length_m=4.6)
    assert match_events([found("a", (2.2, 0), size=0.1)], [place]).pairs
    assert not match_events([found("a", (2.4, 0), size=0.1)], [place]).pairs
    small = true("box", (0, 0), length_m=0.4)
    assert match_events([found("a", (0.45, 0), size=0.01)], [small]).pairs
    assert not match_events([found("a", (0.6, 0), size=0.01)], [small]).pairs
    assert match_events([found("its long shadow, too", (2.0, 0), size=4.0)], [small]).pairs


def test_crossing_outlines_touch_though_no_corner_lies_in_the_other():
    across = FoundEvent(
        "a", APPEARED, np.array([[-0.1, -9.0], [0.1, -9.0], [0.1, 5.0], [-0.1, 5.0]])
    )
    assert match_events([across], [true("b", (0, 0))]).pairs


def test_the_same_kind_wins_over_the_nearer():
    trues = [true("left", (0, 0), GONE), true("came", (0.4, 0), APPEARED)]
    reports = [found("1", (0.3, 0), GONE), found("2", (0.1, 0), APPEARED)]
    match = match_events(reports, trues)
    assert {(pair.true.id, pair.found.id) for pair in match.pairs} == {("left", "1"), ("came", "2")}
    assert score_events(match, 1e4).named_right == 2


def test_what_moves_is_found_anywhere_on_its_path():
    walker = true("walker", (0, 0), MOVING, path=[(0, 0), (3, 0), (6, 4)])
    late = found("there", (5.9, 3.9), MOVING, size=0.2)
    (pair,) = match_events([late], [walker]).pairs
    assert pair.error_m < 0.2
    whole = FoundEvent("track", MOVING, np.array([[-1.0, -1], [9, -1], [9, 6], [-1, 6]]))
    assert match_events([whole], [walker]).pairs
    match = match_events([late, found("as if it stood", (2, 0.1), APPEARED, size=0.2)], [walker])
    assert [each.id for each in match.twice] == ["as if it stood"]
    assert math.isnan(score_events(match, 1e4).error_median_m)  # its place is not one place


@pytest.mark.parametrize(
    ("announced_s", "judged", "late"), [(10.4, 1, 0), (11.3, 1, 0), (11.5, 1, 1), (None, 0, 0)]
)
def test_late_is_more_than_a_second_after_the_third_clear_view(announced_s, judged, late):
    scores = score_events(
        match_events([found("a", (0, 0), announced_s=announced_s)], [true("b", (0, 0))]), 1e4
    )
    assert (scores.judged_late, scores.late) == (judged, late)


def test_errors_and_what_sigma_claims():
    trues = [true(str(i), (10 * i, 0)) for i in range(4)]
    errors = [(0.1, 0.0), (0.0, 0.3), (0.0, 0.0), (0.25, 0.25)]
    reports = [
        found(str(i), (10 * i + x, y), sigma_m=0.1 if i < 3 else math.nan)
        for i, (x, y) in enumerate(errors)
    ]
    scores = score_events(match_events(reports, trues), 1e4)
    assert scores.error_median_m == pytest.approx(0.2)
    assert scores.within_two_sigma == pytest.approx(5 / 6)  # one of six axes is 0.3 off
    assert scores.sigma_median_m == pytest.approx(0.1)
    assert math.isnan(scores.world_within_two_sigma)


def test_errors_in_the_world_include_what_the_map_is_off_by():
    on_map = [true(str(i), (10 * i, 0)) for i in range(2)]
    off = [replace(each, map_off_m=np.array([0.7, 0.0])) for each in on_map]
    reports = [
        replace(found(str(i), (10 * i + 0.05, 0.0), sigma_m=0.1), world_sigma_m=sigma_m)
        for i, sigma_m in enumerate((0.3, 0.5))
    ]
    scores = score_events(match_events(reports, off), 1e4)
    assert scores.within_two_sigma == 1.0 and scores.error_median_m == pytest.approx(0.05)
    assert scores.world_within_two_sigma == pytest.approx(3 / 4)  # 0.75 m are more than twice 0.3 m
    assert scores.world_sigma_median_m == pytest.approx(0.4)


def test_scores_by_kind():
    trues = [true("a", (0, 0), GONE), true("b", (10, 0), GONE), true("c", (20, 0), REPLACED)]
    reports = [found("1", (0, 0), GONE), found("2", (10, 0), APPEARED), found("3", (40, 0), MOVING)]
    by_kind = score_events(match_events(reports, trues), 1e4).by_kind
    assert (by_kind["disappeared"].found, by_kind["disappeared"].named_right) == (2, 1)
    assert (by_kind["replaced"].must_find, by_kind["replaced"].found) == (1, 0)
    assert by_kind["moving"].false == 1
    empty = score_events(match_events([], []), 0.0)
    assert math.isnan(empty.found_share) and math.isnan(empty.false_per_hectare)
