"""Scores that are shares: of what is reported with a score of 0.5 half is right, on photos that nobody learnt from."""

import numpy as np

from sorvolo.detection.contract import ModelInfo
from sorvolo.detection.log_odds import log_odds
from sorvolo.detection.session import Seen
from sorvolo.geometry.arrays import Floats

_LEAST = 1e-6  # no score counts for less, nor for more than 1 less this: log-odds stay finite


def calibrated(seen: Seen, info: ModelInfo) -> Seen:
    """What all looks at a picture came to, its scores as the model's `calibration` states them, best first."""
    if not info.calibration:
        return seen
    scores = seen.scores.copy()
    for label, name in enumerate(info.classes):
        if name in info.calibration:
            rows, how = seen.labels == label, info.calibration[name]
            scores[rows] = platt_scaled(scores[rows], how.slope, how.shift)
    order = np.argsort(-scores, kind="stable")
    return Seen(seen.boxes_px[order], scores[order], seen.labels[order])


def platt_scaled(scores: Floats, slope: float, shift: float) -> Floats:
    """Scores (N,), 0 to 1, whose log-odds become `shift` and `slope` times themselves (Platt 1999)."""
    return np.asarray(1 / (1 + np.exp(-shift - slope * log_odds(scores, _LEAST))))
