"""Where a camera's top points when telemetry does not say: the way the pictures show, laid over that of the fixes."""

from collections import deque
from dataclasses import dataclass

import numpy as np

from sorvolo.geometry.arrays import Floats

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
    """A downward camera's heading from its own pictures and the fixes; only `add` changes it.

    The pictures tell how the camera turned and moved, all but the direction in which it began; the least-squares turn
    of that way onto the fixes of the last seconds is this direction (Procrustes in the plane, as complex numbers: real
    part right or east, imaginary part up or north).
    """

    def __init__(self) -> None:
        self._turned_rad = 0.0
        self._way = 0.0 + 0.0j
        self._points: deque[tuple[float, complex, complex]] = deque()

    def add(self, time_s: float, turned_rad: float, moved_px: Floats, place_m: Floats) -> Heading:
        """Take in one frame and tell its heading.

        `turned_rad` is how far the picture's content turned since the frame before, clockwise as seen (y is down);
        `moved_px` (2,) where the middle's content went, right and down; `place_m` (2,) the fix, east and north.
        """
        self._turned_rad -= turned_rad
        step = complex(-moved_px[0], moved_px[1])
        self._way += step * np.exp(-1j * self._turned_rad)
        self._points.append((time_s, self._way, complex(place_m[0], place_m[1])))
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
