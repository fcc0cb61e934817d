"""A thing's score on a map: all views that could show it count, those that show nothing there too."""

import numpy as np
import pytest

from sorvolo.tracking.view_evidence import EvidenceSettings, least_seen, score_from_views


def test_views_without_it_count_against_it() -> None:
    """The same three sightings, of three to ten views: each view more that shows nothing lowers the score."""
    scores = [score_from_views([0.9, 0.85, 0.9], views) for views in range(3, 11)]
    assert all(np.diff(scores) < 0)
    assert scores[0] > 0.78 and scores[-1] < 0.3


def test_more_views_make_it_better_known_not_surer() -> None:
    """What every view scores 0.7 comes nearer to 0.7 with each, and never above: views of one thing err together."""
    scores = [score_from_views([0.7] * views, views) for views in (1, 2, 5, 20, 200)]
    assert all(np.diff(scores) > 0)
    assert scores[0] < 0.6 and scores[-1] == pytest.approx(0.7, abs=0.005)


def test_a_weak_sighting_is_less_against_it_than_none() -> None:
    strong = [0.9, 0.9, 0.9]
    assert score_from_views([*strong, 0.4], 4) > score_from_views(strong, 4) > score_from_views(strong, 6)


@pytest.mark.parametrize("score", [0.0, 1.0])
def test_scores_at_the_ends_are_numbers(score: float) -> None:
    assert 0 < score_from_views([score], 1) < 1


def test_sightings_count_from_the_least_that_is_reported() -> None:
    """A model that reports from lower on than others' weak sightings is searched from there."""
    assert least_seen({"person": 0.78, "car": 0.72}) == EvidenceSettings().least_seen
    assert least_seen({"person": 0.05, "car": 0.72}) == 0.05
