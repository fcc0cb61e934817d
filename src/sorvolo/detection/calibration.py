"""Scores that are shares: of what is reported with a score of 0.5 half is right, on photos that nobody learnt from."""

from collections.abc import Mapping

import numpy as np
from scipy.optimize import minimize

from sorvolo.detection.contract import Calibration, ModelInfo
from sorvolo.detection.session import Seen
from sorvolo.geometry.arrays import Floats, Mask

_LEAST = 1e-6  # no score counts for less, nor for more than 1 less this: log-odds stay finite


def calibrated(seen: Seen, info: ModelInfo) -> Seen:
    """What all looks at a picture came to, its scores as the model's `calibration` states them, best first."""
    if not info.calibration:
        return seen
    scores = seen.scores.copy()
    for label, name in enumerate(info.classes):
        if name in info.calibration:
            rows = seen.labels == label
            scores[rows] = platt_scaled(scores[rows], info.calibration[name])
    order = np.argsort(-scores, kind="stable")
    return Seen(seen.boxes_px[order], scores[order], seen.labels[order])


def platt_scaled(scores: Floats | float, how: Calibration) -> Floats:
    """Scores of any shape, 0 to 1, whose log-odds become `shift` and `slope` times themselves (Platt 1999)."""
    return np.asarray(1 / (1 + np.exp(-how.shift - how.slope * log_odds(scores, _LEAST))))


def platt_fit(scores: Floats, right: Mask, counts: Floats | None = None) -> Calibration | None:
    """The scale by which scores (N,) of the model's own become shares, from what of them is `right` (N,) (Platt 1999).

    `counts` (N,): how much each counts. A right one aims a little below 1, a wrong one a little above 0, by how few
    there are (eq. 4 there). None where right ones do not score higher than wrong ones, or there are none of either.
    """
    if right.all() or not right.any():
        return None
    counts = np.ones(len(scores)) if counts is None else counts
    hits, misses = float(counts[right].sum()), float(counts[~right].sum())
    aims = np.where(right, (hits + 1) / (hits + 2), 1 / (misses + 2))
    odds = log_odds(scores, _LEAST)

    def loss(weights: Floats) -> float:
        logits = weights[0] * odds + weights[1]
        return float((counts * (np.logaddexp(0, logits) - aims * logits)).sum() / counts.sum())

    slope, shift = minimize(loss, np.array([1.0, 0.0])).x.tolist()
    return Calibration(slope, shift) if slope > 0 else None


def in_own_scale(info: ModelInfo) -> dict[str, float]:
    """The model's thresholds in its networks' own scale: what reports as much where nothing is calibrated."""
    return {
        name: float(platt_scaled(least, Calibration(1 / how.slope, -how.shift / how.slope)))
        if (how := info.calibration.get(name))
        else least
        for name, least in info.thresholds.items()
    }


def scaled_thresholds(
    own: Mapping[str, float], calibration: Mapping[str, Calibration]
) -> dict[str, float]:
    """Thresholds in a model's own scale as they are after its calibration: `in_own_scale` the other way round."""
    return {
        name: float(platt_scaled(least, calibration[name])) if name in calibration else least
        for name, least in own.items()
    }


def log_odds(scores: Floats | float, least: float) -> Floats:
    """log(p / (1 - p)) of scores p of any shape, which count for `least` at least and for 1 - `least` at most."""
    inside = np.clip(scores, least, 1 - least)
    return np.asarray(np.log(inside / (1 - inside)))
