"""A picture of unknown scale searched in several sizes, an image pyramid: what they agree on (decision 0084).

A network knows objects of some sizes better than of others. Where the ground that a pixel covers is known, the picture
is shown at the right size (`tiling`); where it is not, nothing but the boxes themselves tells which look to believe.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sorvolo.detection.contract import Pyramid
from sorvolo.detection.session import Seen
from sorvolo.detection.turning import alike
from sorvolo.geometry.arrays import Floats


@dataclass(frozen=True)
class PyramidSettings:
    """How what looks of several sizes saw is put together."""

    same_iou: float = 0.5  # boxes of one class that overlap more are one object, as COCO counts them
    unseen_odds: float = -4.5  # log-odds of what a look does not show: models report from -3.9 on
    surest: float = 1 - 1e-4  # a score counts for so much at most, and for as little at least


def agreed_in_sizes(
    looks: Sequence[Seen], times: Sequence[float], label: int, pyramid: Pyramid,
    settings: PyramidSettings = PyramidSettings(),
) -> Seen:
    """What looks at one picture, each `times` as large, saw of one class: each object once, best first.

    All boxes are in the picture's own pixels. Boxes that overlap are one object, at most one of each look. Its
    log-odds are the looks' mean, weighed by how well the model knows an object of the size at which each look shows
    it (`Pyramid.trust`), a logarithmic opinion pool (Genest and Zidek 1986), and `Pyramid.shift`; its box is the mean
    of the looks' boxes by these weights times their scores.
    """
    own = [look.labels == label for look in looks]
    boxes = np.concatenate([look.boxes_px[mine] for look, mine in zip(looks, own)])
    scores = np.concatenate([look.scores[mine] for look, mine in zip(looks, own)])
    of_look = np.repeat(np.arange(len(looks)), [np.count_nonzero(mine) for mine in own])
    odds = _odds(scores, settings)
    trust = pyramid.trust(boxes, np.array(times))
    claims = odds + np.log(trust[np.arange(len(boxes)), of_look])  # the look that knows the size best leads
    order = np.argsort(-claims, kind="stable")
    found_px, found_odds = np.zeros((len(boxes), 4), np.float32), np.zeros(len(boxes))
    count = 0
    for count, group in enumerate(alike(boxes[order], settings.same_iou), start=1):
        rows, weights = order[group], trust[order[group[0]]]
        best = np.full(len(looks), settings.unseen_odds)
        np.maximum.at(best, of_look[rows], odds[rows])
        found_odds[count - 1] = weights @ best + pyramid.shift
        found_px[count - 1] = np.average(boxes[rows], axis=0, weights=weights[of_look[rows]] * scores[rows])
    best_first = np.argsort(-found_odds[:count], kind="stable")
    return Seen(
        found_px[:count][best_first], 1 / (1 + np.exp(-found_odds[:count][best_first])),
        np.full(count, label, np.int64),
    )


def _odds(scores: Floats, settings: PyramidSettings) -> Floats:
    inside = np.clip(scores, 1 - settings.surest, settings.surest)
    return np.asarray(np.log(inside / (1 - inside)))
