"""Where a camera's top points when telemetry does not say: the way the pictures show, laid over that of the fixes."""

from collections import deque
from dataclasses import dataclass

import numpy as np

from sorvolo.geometry.arrays import Floats, PointsPx

_WINDOW_S = 20.0
_LEAST_M = 6.0  # of way, rms: less is within the fixes' own errors
_LEAST_SIGMA_DEG = 4.0
_STEPS_PER_ERROR = 8.0  # neighbouring fixes, and neighbouring frames' tilts, err alike


@dataclass(frozen=True)
class Heading:
    """Clockwise from north, of the picture's top; `sigma_deg` is infinite while it is not known."""

    heading_deg: float
    sigma_deg: float


class HeadingFromMotion:
    """A downward camera's heading from its own pictures and the fixes; `add` and `lose` change it.

    `ImageMotion` lays each picture into the first one, which tells how the camera turned and moved since, all but the
    direction in which it began; the least-squares turn of that way onto the fixes of the last seconds is this direction
    (Procrustes in the plane, as complex numbers: real part right or east, imaginary part up or north).
    """

    def __init__(self) -> None:
        self._turned_rad = 0.0  # clockwise since the first picture
        self._points: deque[tuple[float, complex, complex]] = deque()

    def add(self, time_s: float, outline_px: PointsPx, place_m: Floats) -> Heading:
        """Take in one picture and tell its heading.

        `outline_px` (4, 2) are its corners, from the top-left one clockwise, in the first picture's pixels; `place_m`
        (2,) the fix, east and north.
        """
        right, down = outline_px[1] - outline_px[0]
        self._turned_rad = float(np.arctan2(down, right))
        x, y = outline_px.mean(axis=0)
        self._points.append((time_s, complex(x, -y), complex(place_m[0], place_m[1])))
        while time_s - self._points[0][0] > _WINDOW_S:
            self._points.popleft()
        return self._told()

    def lose(self) -> None:
        """The pictures' way is broken (a cut, a frame that fits nothing): begin anew."""
        self._points.clear()

    def _told(self) -> Heading:
        seen = np.array([point[1] for point in self._points])
        fixes = np.array([point[2] for point in self._points])
        seen, fixes = seen - seen.mean(), fixes - fixes.mean()
        spread_px = float(np.sqrt(np.mean(np.abs(seen) ** 2)))
        if len(seen) < 5 or float(np.sqrt(np.mean(np.abs(fixes) ** 2))) < _LEAST_M or spread_px <= 0:
            return Heading(0.0, float("inf"))
        turn = np.vdot(seen, fixes) / np.vdot(seen, seen).real
        reach_m = abs(turn) * spread_px
        miss_m = float(np.sqrt(np.mean(np.abs(fixes - turn * seen) ** 2)))
        count = max(1.0, len(seen) / _STEPS_PER_ERROR)
        sigma_deg = float(np.degrees(np.arctan2(miss_m, reach_m * np.sqrt(count))))
        heading_deg = float(np.degrees(-np.angle(turn) + self._turned_rad)) % 360
        return Heading(heading_deg, max(sigma_deg, _LEAST_SIGMA_DEG) if reach_m > 2 * miss_m else float("inf"))
