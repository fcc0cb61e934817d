"""A picture of unknown scale searched in several sizes, an image pyramid: what they agree on.

A network knows objects of some sizes better than of others. Where the ground that a pixel covers is known, the picture
is shown at the right size (`tiling`); where it is not, nothing but the boxes themselves shows which look to believe.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from sorvolo.detection.contract import ModelInfo, Pyramid
from sorvolo.detection.log_odds import log_odds
from sorvolo.detection.session import Seen
from sorvolo.detection.tiling import Tiles
from sorvolo.detection.turning import alike
from sorvolo.geometry.arrays import BoxesPx, Floats


@dataclass(frozen=True)
class PyramidSettings:
    """Up to which size a picture is magnified, and how what looks of several sizes saw is put together."""

    most_px: int = 20_000_000  # of a magnified picture: what a photo of that size costs; by choice
    # boxes of one class that overlap more are one object, as COCO counts them
    same_iou: float = 0.5
    unseen_odds: float = -4.5  # log-odds of what a look does not show: models report from -3.9 on
    least_sure: float = 1e-4  # no score counts for less, nor for more than 1 less this
    # of a look, beside the best one: it stays above zero, and its logarithm finite
    least_trust: float = 1e-6
    # a score from which on something small is worth a closer look: as of the second look
    least_small: float = 0.3


def sizes_for(
    size_px: tuple[int, int],
    info: ModelInfo,
    wanted: Sequence[str],
    tiles: Tiles,
    m_per_px: float,
    settings: PyramidSettings = PyramidSettings(),
) -> dict[float, tuple[str, ...]]:
    """How many times as large a picture of (height, width) `size_px` is shown besides as it is, and for which classes.

    Where "auto" does not know its scale, those of the model's `pyramid` at which it has `most_px` or less.
    """
    asked = {name: each.times for name, each in _asked(info, wanted, tiles, m_per_px).items()}
    return _within(size_px, asked, settings)


def closer_for(
    size_px: tuple[int, int],
    info: ModelInfo,
    wanted: Sequence[str],
    tiles: Tiles,
    m_per_px: float,
    looks: Sequence[Seen],
    times: Sequence[float],
    settings: PyramidSettings = PyramidSettings(),
) -> dict[float, tuple[str, ...]]:
    """The same of closer looks: for the classes of which the `looks` so far, `times` as large (the first of the picture
    as it is), show something small.

    Small is what the model knows better as large as it is shown there than in any look so far.
    """
    asked = {}
    for name, pyramid in _asked(info, wanted, tiles, m_per_px).items():
        label = info.classes.index(name)
        boxes = [
            look.boxes_px[(look.labels == label) & (look.scores >= settings.least_small)]
            for look in looks
        ]
        shown = np.array([*times, *(times[0] * each for each in pyramid.closer)])
        best = trust(np.concatenate(boxes), shown, pyramid, settings).argmax(axis=1)
        asked[name] = tuple(
            each for k, each in enumerate(pyramid.closer, len(times)) if (best == k).any()
        )
    return _within(size_px, asked, settings)


def _asked(
    info: ModelInfo, wanted: Sequence[str], tiles: Tiles, m_per_px: float
) -> dict[str, Pyramid]:
    """The classes that are looked for in several sizes."""
    if tiles != "auto" or not math.isnan(m_per_px):
        return {}
    return {name: info.pyramid[name] for name in wanted if name in info.pyramid}


def _within(
    size_px: tuple[int, int], asked: Mapping[str, Sequence[float]], settings: PyramidSettings
) -> dict[float, tuple[str, ...]]:
    """The sizes at which a picture has not too many pixels, each with its classes."""
    area_px = size_px[0] * size_px[1]
    return {
        each: tuple(name for name, times in asked.items() if each in times)
        for each in sorted({each for times in asked.values() for each in times})
        if area_px * each**2 <= settings.most_px
    }


def agreed_in_sizes(
    looks: Sequence[Seen],
    times: Sequence[float],
    label: int,
    pyramid: Pyramid,
    settings: PyramidSettings = PyramidSettings(),
) -> Seen:
    """What looks at one picture, each `times` as large, saw of one class: each object once, best first.

    All boxes are in the picture's own pixels. Boxes that overlap are one object, at most one of each look. Its
    log-odds are the looks' mean, weighed by how well the model knows an object of the size at which each look shows
    it (`trust`), a logarithmic opinion pool (Genest and Zidek 1986), and `Pyramid.shift`; its box is the mean of the
    looks' boxes by these weights times their scores.
    """
    own = [look.labels == label for look in looks]
    boxes = np.concatenate([look.boxes_px[mine] for look, mine in zip(looks, own)])
    scores = np.concatenate([look.scores[mine] for look, mine in zip(looks, own)])
    of_look = np.repeat(np.arange(len(looks)), [np.count_nonzero(mine) for mine in own])
    odds = log_odds(scores, settings.least_sure)
    weights = trust(boxes, np.array(times), pyramid, settings)
    claims = odds + np.log(
        weights[np.arange(len(boxes)), of_look]
    )  # the look that knows the size best leads
    order = np.argsort(-claims, kind="stable")
    found_px, found_odds = [np.zeros((0, 4))], []
    for group in alike(boxes[order], settings.same_iou):
        rows, own_weights = order[group], weights[order[group[0]]]
        best = np.full(len(looks), settings.unseen_odds)
        np.maximum.at(best, of_look[rows], odds[rows])
        found_odds.append(float(own_weights @ best) + pyramid.shift)
        found_px.append(
            np.average(boxes[rows], axis=0, weights=own_weights[of_look[rows]] * scores[rows])[None]
        )
    best_first = np.argsort(-np.array(found_odds), kind="stable")
    return Seen(
        np.concatenate(found_px)[best_first].astype(np.float32),
        1 / (1 + np.exp(-np.array(found_odds)[best_first])),
        np.full(len(found_odds), label, np.int64),
    )


def trust(
    boxes_px: BoxesPx,
    times: Floats,
    pyramid: Pyramid,
    settings: PyramidSettings = PyramidSettings(),
) -> Floats:
    """(N, looks) shares of the opinion on boxes (N, 4) in looks that show the picture `times` as large.

    The first look shows it as it is. A closer look is asked about what it knows best alone: larger things lose by it.
    """
    area_px = (boxes_px[:, 2] - boxes_px[:, 0]) * (boxes_px[:, 3] - boxes_px[:, 1])
    off = (
        np.log2(np.sqrt(np.maximum(area_px, 1.0))[:, None] * times / pyramid.known_px)
        / pyramid.octaves
    )
    curve = np.exp(-0.5 * (off**2 - (off**2).min(axis=1, keepdims=True))) + settings.least_trust
    is_closer = np.isin(times, times[0] * np.array(pyramid.closer))
    curve[~is_closer[curve.argmax(axis=1)][:, None] & is_closer] = settings.least_trust
    return np.asarray(curve / curve.sum(axis=1, keepdims=True))
