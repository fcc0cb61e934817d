"""How sure a thing on a map is: by all views that could show it, those that show nothing there included."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class EvidenceSettings:
    """What a view is worth; fitted on the things that the packaged detector saw in 29 photos of `caliterra` and the 32
    of `fixed_wing`, nearly all of them false (decision 0039).

    Views of one thing err together, so that more of them make it better known, not surer: a false thing may be seen in
    22 of 22 views.
    """

    least_seen: float = 0.2  # weaker sightings are none
    missed: float = -2.2  # log-odds of a view without a sighting: a score of 0.1, half of the least
    usual: float = -1.0  # mean log-odds of the things that any view shows
    shared: float = 0.63  # share of the variance of log-odds that lies between things, not between views of one


def score_from_views(scores: Sequence[float], views: int, settings: EvidenceSettings = EvidenceSettings()) -> float:
    """The score, 0 to 1, of a thing that views of these scores show, of `views` that could show it.

    `scores`, each 0 to 1, hold one a view and at most `views`. The best linear predictor of the thing's own log-odds
    from those of its views: their mean, drawn towards what is usual as far as few views leave it open (random effects,
    Laird and Ware 1982).
    """
    inside = np.clip(np.asarray(scores, np.float64), 1e-3, 1 - 1e-3)
    seen = float(np.log(inside / (1 - inside)).sum())
    doubt = (1 - settings.shared) / settings.shared
    total = seen + (views - len(scores)) * settings.missed + doubt * settings.usual
    return float(1 / (1 + np.exp(-total / (views + doubt))))


def least_seen(thresholds: Mapping[str, float], settings: EvidenceSettings = EvidenceSettings()) -> float:
    """From which score on a view's sightings are evidence, where each class is reported from `thresholds` on."""
    return min([settings.least_seen, *thresholds.values()])
