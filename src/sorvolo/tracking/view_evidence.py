"""How sure a thing on a map is: by all views that could show it, those that show nothing there included."""

from collections.abc import Mapping, Sequence

import numpy as np

USUAL_LOG_ODDS = -1.7
"""Log-odds of whatever a detector shows, however weakly: 0.15 is right. On photos that the packaged ones did not learn
from it is 0.16 of people by day, 0.31 of cars, thermal 0.19 and 0.12; one for all, by choice."""


LEAST_SEEN = 0.05  # lower scores are misses; a miss scores this
# shares of the variance of log-odds that lie between things, not between views of one: each view of a person shows
# another side of a pose (98 simulated people by day: 0.35 to 0.51)
SHARED, SHARED_BY_PEOPLE = 0.63, 0.44


def score_from_views(
    scores: Sequence[float], views: int, name: str, more_log_odds: float = 0.0
) -> float:
    """The score, 0 to 1, of a thing of class `name` that views of these scores show, of `views` that could show it.

    `scores`, each 0 to 1, hold one a view and at most `views`; `more_log_odds` is what else is known. The views'
    log-odds beyond the usual ones are added to these, as likelihood ratios are. But views of one thing err together, so
    that n of them count as n / (1 + (n - 1) shared): the design effect of a sample drawn in clusters (Kish 1965). One
    view counts for what it is.
    """
    every = np.concatenate(
        [np.asarray(scores, np.float64), np.full(views - len(scores), LEAST_SEEN)]
    )
    inside = np.clip(every, 1e-3, 1 - 1e-3)
    beyond = float((np.log(inside / (1 - inside)) - USUAL_LOG_ODDS).sum())
    shared = SHARED_BY_PEOPLE if name == "person" else SHARED
    odds = USUAL_LOG_ODDS + beyond / (1 + (views - 1) * shared) + more_log_odds
    return float(1 / (1 + np.exp(-odds)))


def least_seen(thresholds: Mapping[str, float]) -> float:
    """From which score on a view's sightings are evidence, where each class is reported from `thresholds` on."""
    return min([LEAST_SEEN, *thresholds.values()])
