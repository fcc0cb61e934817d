"""A thing's score on a map: all views that could show it count, those that show nothing there too."""

import numpy as np
import pytest

from sorvolo.tracking.view_evidence import (
    LEAST_SEEN,
    SHARED,
    USUAL_LOG_ODDS,
    least_seen,
    score_from_views,
)


def test_views_without_it_count_against_it() -> None:
    """The same three sightings, of three to ten views: each view more that shows nothing lowers the score."""
    scores = [score_from_views([0.9, 0.85, 0.9], views, "car") for views in range(3, 11)]
    assert all(np.diff(scores) < 0)
    assert scores[0] > 0.78 and scores[-1] < 0.3


@pytest.mark.parametrize("score", [0.3, 0.7, 0.94])
def test_one_view_counts_for_what_it_is(score: float) -> None:
    """A single photo reports it with the same score as a map that it alone shows."""
    assert score_from_views([score], 1, "car") == pytest.approx(score)


def test_many_views_are_worth_a_few_that_err_apart() -> None:
    """What every view scores 0.7 becomes surer with each, but never surer than 1 / shared views that err apart."""
    scores = [score_from_views([0.7] * views, views, "car") for views in (1, 2, 5, 20, 2000)]
    assert all(np.diff(scores) > 0)
    bound = USUAL_LOG_ODDS + (np.log(0.7 / 0.3) - USUAL_LOG_ODDS) / SHARED
    assert scores[-1] == pytest.approx(1 / (1 + np.exp(-bound)), abs=0.001)
    assert scores[-1] < 0.92


def test_what_is_as_weak_as_usual_says_nothing() -> None:
    """Views of the share of all that is shown leave it where it is; surer ones raise it, weaker ones lower it."""
    usual = 1 / (1 + np.exp(-USUAL_LOG_ODDS))
    assert score_from_views([usual] * 9, 9, "car") == pytest.approx(usual)
    assert score_from_views([0.4, 0.4], 2, "car") > 0.4
    assert score_from_views([0.4, usual - 0.05], 2, "car") < score_from_views(
        [0.4, usual], 2, "car"
    )


def test_a_weak_sighting_is_less_against_it_than_none() -> None:
    strong = [0.9, 0.9, 0.9]
    assert (
        score_from_views([*strong, 0.4], 4, "car")
        > score_from_views(strong, 4, "car")
        > score_from_views(strong, 6, "car")
    )


@pytest.mark.parametrize("score", [0.0, 1.0])
def test_scores_at_the_ends_are_numbers(score: float) -> None:
    assert 0 < score_from_views([score], 1, "car") < 1


def test_views_of_a_person_err_more_apart_than_those_of_a_car() -> None:
    """A cyclist of brighton_beach: a person shows one side or another; what looks like a car does so from all sides."""
    scores = {
        name: score_from_views([0.85, 0.65, 0.35, 0.14, 0.11], 6, name)
        for name in ("person", "car")
    }
    assert scores["car"] < 0.4 < 0.45 < scores["person"]
    alone = {score_from_views([0.8], 1, name) for name in ("person", "car", "elk")}
    assert len(alone) == 1


def test_sightings_count_from_the_least_that_is_reported() -> None:
    """A model that reports from lower on than others' weak sightings is searched from there."""
    assert least_seen({"person": 0.78, "car": 0.72}) == LEAST_SEEN
    assert least_seen({"person": 0.05, "car": 0.72}) == 0.05
