"""Whether ground that is all shade on one date is the moved shadow of what stands on both, however wide or tall.

A point `h` up throws its shadow `h` times a slide off; the slide follows from the sun. So whatever stands, each piece
of one date's shadow has a piece of the other date's, `h` times the difference of both slides away. What came or left
threw a shadow on one date alone, and has none there.
"""

import numpy as np

from sorvolo.geometry.arrays import Floats, Mask


def share_moved(own: Mask, other: Mask, step: Floats, most: float) -> float:
    """The greatest share of a shade, `own` (h, w), that lies on the `other` date's shade when it is moved by a multiple
    up to `most` of `step`, (2,) columns and rows."""
    rows, columns = np.nonzero(own)
    longest = float(np.abs(step).max()) * most
    if not len(rows) or longest < 1:
        return 0.0
    best = 0
    for times in np.arange(1.0, longest + 1) / longest * most:
        x, y = (
            np.rint(each + times * along).astype(int)
            for each, along in ((columns, step[0]), (rows, step[1]))
        )
        inside = (x >= 0) & (y >= 0) & (x < other.shape[1]) & (y < other.shape[0])
        best = max(best, int(np.count_nonzero(other[y[inside], x[inside]])))
    return best / len(rows)
