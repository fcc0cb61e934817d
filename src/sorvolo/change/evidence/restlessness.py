"""How restless the ground around a change is: where much comes and goes between views, views agree by chance.

Crowns, walls that lean into view and wind make views differ from the map all around, now here, now there. What really
came or left stands out on calm ground: its neighbours differ in no view, or like itself in all.
"""

import cv2
import numpy as np

from sorvolo.change.evidence.cells import CellGrid, CellWindow
from sorvolo.geometry.arrays import Mask

_AROUND_M = 5.0  # a crown's width
_APART_M, _LEAN = 0.5, 0.2  # nearer lies the change's own rim, and so many of its lengths what leans with it
_PASSING = 0.5  # of its views at most: more, and the ground there is changed itself
_RESTLESS = 0.05  # share of views in which ground around is flagged for nothing, at which half of the score is left


def restlessness(grid: CellGrid, window: CellWindow, own: Mask, cell_m: float) -> float:
    """The share of the views of the ground around a change that flag it although most others do not, 0 to 1.

    `own` (rows, columns) are the change's cells in `window`. Where no other ground was seen twice, nothing is known and
    the answer is 0.
    """
    apart_m = max(_APART_M, _LEAN * max(window.shape) * cell_m)
    reach = int(np.ceil((apart_m + _AROUND_M) / cell_m))
    evidence = grid.read(window.grown(reach))
    free = cv2.copyMakeBorder((~own).view(np.uint8), reach, reach, reach, reach, cv2.BORDER_CONSTANT, value=1)
    away_m = cv2.distanceTransform(free, cv2.DIST_L2, 5) * cell_m
    around = (away_m > apart_m) & (away_m <= apart_m + _AROUND_M) & (evidence.seen >= 2)
    seen, changed = evidence.seen[around].astype(float), evidence.changed[around]
    if not seen.size:
        return 0.0
    return float(np.where(changed <= _PASSING * seen, changed / seen, 0.0).mean())


def calmness(restless: float) -> float:
    """What is left of a score, 1 to 0, on ground so restless."""
    return 1 / (1 + (restless / _RESTLESS) ** 2)
