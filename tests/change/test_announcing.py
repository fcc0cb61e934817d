"""One function decides on what the views reported: each rule of it, alone."""

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sorvolo.change.announcing import (
    Look,
    Objection,
    Tally,
    judge,
    sureness,
    views_score,
)

SURE = Tally(
    0,
    4_000_000_000,
    views=10,
    asked=10,
    score_sum=9.0,
    whole=10,
    camera_low_m=(-10.0, 0.0, 20.0),
    camera_high_m=(10.0, 0.0, 20.0),
    look=Look(1.0, 1.2),
)


def test_what_all_views_show_surely_is_announced_with_its_score():
    assert judge(SURE) is None
    assert sureness(SURE) == pytest.approx(0.9 * 11 / 12)


@pytest.mark.parametrize(
    ("reported", "reason"),
    [
        ({"score_sum": 3.0}, Objection.UNSURE),
        ({"asked": 25}, Objection.UNSURE),
        ({"restless": 0.2, "score_sum": 7.0}, Objection.UNSURE),
        ({"score_sum": 5.0, "look": Look(3.0, 2.5)}, Objection.LARGE_AND_UNSURE),
    ],
)
def test_each_rule_stops_a_candidate_alone_and_names_itself(reported, reason):
    assert judge(replace(SURE, **reported)) is reason


@pytest.mark.parametrize(
    "reported",
    [
        {"score_sum": 5.0, "look": Look(3.0, 25.0)},  # snow is longer than the flying height
        {
            "restless": 0.2,
            "views": 40,
            "asked": 40,
            "score_sum": 39.5,
            "whole": 40,
        },  # restless, but sure
    ],
)
def test_the_exceptions_are_announced(reported):
    assert judge(replace(SURE, **reported)) is None


def test_views_from_one_place_count_half_and_so_do_those_that_never_show_all_of_it():
    score = views_score(SURE)
    assert views_score(replace(SURE, camera_low_m=(9.9, 0.0, 20.0))) == pytest.approx(score / 2)
    assert views_score(replace(SURE, whole=0)) == pytest.approx(score / 2)


@given(st.integers(1, 60), st.integers(0, 60), st.floats(0, 1), st.floats(0, 0.5))
def test_one_more_view_that_shows_it_never_makes_it_less_sure(views, missed, score, restless):
    tally = replace(
        SURE,
        views=views,
        asked=views + missed,
        score_sum=views * score,
        whole=views,
        restless=restless,
    )
    more = replace(tally.with_view(5, score, 0.1, tally.camera_high_m), whole=views + 1)
    assert 0 <= sureness(tally) <= sureness(more) + 1e-9 <= 1 + 1e-9
