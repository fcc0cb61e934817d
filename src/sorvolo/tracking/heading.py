"""Where a camera's top points: from the pictures' way over the ground without a compass, and how wrong a compass is."""

from collections import deque
from dataclasses import dataclass

import numpy as np

from sorvolo.geometry.arrays import Floats, PointsPx


@dataclass(frozen=True)
class HeadingSettings:
    """When the pictures' way gives a heading."""

    window_s: float = 20.0  # of the way that is laid on the fixes
    least_m: float = 6.0  # of way, rms: less is within the fixes' own errors
    least_sigma_deg: float = 4.0  # however well the way fits
    steps_per_error: float = 8.0  # neighbouring fixes, and neighbouring frames' tilts, err alike


@dataclass(frozen=True)
class CompassSettings:
    """How a compass is checked."""

    stretch_s: float = 2.0  # of the way that one check looks back
    least_way_m: float = 15.0  # a shorter one counts less: the fixes wander
    gain_per_s: float = 0.3  # of what is seen
    learns_s: float = 15.0  # after that the way back over the map moves the shift
    most_deg: float = 15.0  # corrected at most: a compass that is off by more is broken
    broken_s: float = 10.0  # a gap in time after which it begins anew


@dataclass(frozen=True)
class Heading:
    """Clockwise from north, of the picture's top; `sigma_deg` is infinite while it is not known."""

    heading_deg: float
    sigma_deg: float


class HeadingFromMotion:
    """A downward camera's heading from its own pictures and the fixes; `add` and `lose` change it.

    `ImageMotion` lays each picture into the first one, which shows how the camera turned and moved since, all but the
    direction in which it began; the least-squares turn of that way onto the fixes of the last seconds is this direction
    (Procrustes in the plane, as complex numbers: real part right or east, imaginary part up or north).
    """

    def __init__(self, settings: HeadingSettings = HeadingSettings()) -> None:
        self._settings = settings
        self._turned_rad = 0.0  # clockwise since the first picture
        self._points: deque[tuple[float, complex, complex]] = deque()

    def add(self, time_s: float, outline_px: PointsPx, place_m: Floats) -> Heading:
        """Take in one picture and return its heading.

        `outline_px` (4, 2) are its corners, from the top-left one clockwise, in the first picture's pixels; `place_m`
        (2,) the fix, east and north.
        """
        right, down = outline_px[1] - outline_px[0]
        self._turned_rad = float(np.arctan2(down, right))
        x, y = outline_px.mean(axis=0)
        self._points.append((time_s, complex(x, -y), complex(place_m[0], place_m[1])))
        while time_s - self._points[0][0] > self._settings.window_s:
            self._points.popleft()
        return self._known()

    def lose(self) -> None:
        """The pictures' way is broken (a cut, a frame that fits nothing): begin anew."""
        self._points.clear()

    def _known(self) -> Heading:
        seen = np.array([point[1] for point in self._points])
        fixes = np.array([point[2] for point in self._points])
        seen, fixes = seen - seen.mean(), fixes - fixes.mean()
        spread_px = float(np.sqrt(np.mean(np.abs(seen) ** 2)))
        if (
            len(seen) < 5
            or float(np.sqrt(np.mean(np.abs(fixes) ** 2))) < self._settings.least_m
            or spread_px <= 0
        ):
            return Heading(0.0, float("inf"))
        turn = np.vdot(seen, fixes) / np.vdot(seen, seen).real
        reach_m = abs(turn) * spread_px
        miss_m = float(np.sqrt(np.mean(np.abs(fixes - turn * seen) ** 2)))
        count = max(1.0, len(seen) / self._settings.steps_per_error)
        sigma_deg = float(np.degrees(np.arctan2(miss_m, reach_m * np.sqrt(count))))
        heading_deg = float(np.degrees(-np.angle(turn) + self._turned_rad)) % 360
        sigma_deg = max(sigma_deg, self._settings.least_sigma_deg)
        return Heading(heading_deg, sigma_deg if reach_m > 2 * miss_m else float("inf"))


class CompassError:
    """How wrong a compass is, from what the ground seems to do while the camera flies over it; only `add` changes it.

    Places laid with a heading that is wrong by an angle are turned about the camera; as it flies on, all that stands
    seems to move sideways, by this angle times its way. A tracker takes that for the frames' common shift, of which it
    follows a part: so the shift's way is held against the camera's and what they agree on is taken off bit by bit, less
    and less: on the way back over a map that was begun with the wrong heading the shift shows nothing of the compass.
    """

    def __init__(self, settings: CompassSettings = CompassSettings()) -> None:
        self._settings = settings
        self.clockwise_deg, self._learnt_s = 0.0, 0.0
        self._points: deque[tuple[float, Floats, Floats]] = deque()

    def add(self, time_s: float, camera_m: Floats, shift_m: Floats) -> float:
        """Take in one frame: where its camera was and the shift of its sightings, (2,) east and north.

        Returns by how much the compass reads too far clockwise, as known by now, in degrees.
        """
        if self._points and not 0 <= time_s - self._points[-1][0] < self._settings.broken_s:
            self._points.clear()
        self._points.append((time_s, camera_m, shift_m.copy()))
        _, camera_before_m, shift_before_m = self._points[0]
        way_m, slip_m = camera_m - camera_before_m, shift_m - shift_before_m
        if time_s - self._points[0][0] < self._settings.stretch_s:
            return self.clockwise_deg
        self._points.popleft()
        way_m2, rules = float(way_m @ way_m), self._settings
        # against the fixes' own wander a short way shows little
        seen_rad = float(way_m[0] * slip_m[1] - way_m[1] * slip_m[0]) / (
            way_m2 + rules.least_way_m**2
        )
        frame_s = time_s - self._points[-2][0] if len(self._points) > 1 else 0.0
        gain = (
            rules.gain_per_s * min(frame_s, 1.0) * float(np.exp(-self._learnt_s / rules.learns_s))
        )
        self._learnt_s += frame_s * way_m2 / (way_m2 + rules.least_way_m**2)
        change_deg = gain * float(np.degrees(seen_rad))
        self.clockwise_deg = float(
            np.clip(self.clockwise_deg + change_deg, -rules.most_deg, rules.most_deg)
        )
        return self.clockwise_deg
