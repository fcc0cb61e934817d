"""Scores as log-odds, in which opinions are added and averaged."""

import numpy as np

from sorvolo.geometry.arrays import Floats


def log_odds(scores: Floats | float, least: float) -> Floats:
    """log(p / (1 - p)) of scores p of any shape, which count for `least` at least and for 1 - `least` at most."""
    inside = np.clip(scores, least, 1 - least)
    return np.asarray(np.log(inside / (1 - inside)))
