"""A flight's measures from its track over ground: the speed, the length and the parallel strips."""

from dataclasses import dataclass
from itertools import groupby

import numpy as np

from sorvolo.geometry.arrays import Floats, PointsM

_WINDOW_S = 2.0  # shorter steps measure the receiver's noise instead of the speed
_STEPS_ACROSS = 25  # the steps must be long against the receiver's noise
_ALONG_DEG = 25.0  # from the strips' bearing: beyond is a turn; by choice
# length of the mean direction, 0 to 1: less is no survey of strips; by choice
_LEAST_CONCENTRATION = 0.3


@dataclass(frozen=True)
class Strips:
    """Parallel passes over an area: their bearing in [0, 180) deg and distance, NaN for one pass.

    `count` is 0 where the track has no main direction.
    """

    count: int
    bearing_deg: float
    spacing_m: float


def known_points(points_m: PointsM) -> PointsM:
    """The points, (N, 2), that are known: those without NaN."""
    return points_m[np.isfinite(points_m).all(axis=1)]


def corners_around(points_m: PointsM, margin_m: float) -> PointsM:
    """(2, 2) the south-west and north-east corners of the points' box, (N, 2), made `margin_m` larger on each side."""
    return np.array([points_m.min(axis=0) - margin_m, points_m.max(axis=0) + margin_m])


def speeds_m_s(points_m: PointsM, times_s: Floats) -> Floats:
    """Speeds of a track, points (N, 2) at times (N,), each over two seconds or one longer step."""
    later = np.searchsorted(times_s, times_s + _WINDOW_S)
    begin = np.flatnonzero(later < len(times_s))
    end = later[begin]
    distance_m = np.linalg.norm(points_m[end] - points_m[begin], axis=1)
    return distance_m / (times_s[end] - times_s[begin])


def thinned(points_m: PointsM) -> PointsM:
    """The track's points, (N, 2), without those nearer than a 25th of its extent to the one before.

    What the receiver's noise adds to a slow or hovering flight goes, and every step has a bearing.
    """
    if not len(points_m):
        return points_m
    least_m = max(1.0, float(np.ptp(points_m, axis=0).max()) / _STEPS_ACROSS)
    kept = [points_m[0]]
    for point in points_m[1:]:
        if np.hypot(*(point - kept[-1])) >= least_m:
            kept.append(point)
    return np.array(kept)


def length_m(points_m: PointsM) -> float:
    """The track's length over ground, points (N, 2), without its noise."""
    return float(np.linalg.norm(np.diff(thinned(points_m), axis=0), axis=1).sum())


def find_strips(points_m: PointsM) -> Strips:
    """The parallel passes of a track, points (N, 2), as a lawnmower flies them.

    The main direction is the mean of the steps' doubled angles, weighted by length; a pass is a run of steps
    within 25 deg of it, all one way, at least a third as long as the longest run.
    """
    points = thinned(points_m)
    steps = np.diff(points, axis=0)
    lengths = np.linalg.norm(steps, axis=1)
    if len(steps) < 2:
        return Strips(0, np.nan, np.nan)
    doubled = np.exp(2j * np.arctan2(steps[:, 0], steps[:, 1]))
    mean = (lengths * doubled).sum() / lengths.sum()
    if abs(mean) < _LEAST_CONCENTRATION:
        return Strips(0, np.nan, np.nan)
    bearing = 0.5 * np.angle(mean)
    cosines = steps @ np.array([np.sin(bearing), np.cos(bearing)]) / lengths
    ways = np.where(np.abs(cosines) >= np.cos(np.radians(_ALONG_DEG)), np.sign(cosines), 0.0)
    runs = [
        list(group)
        for way, group in groupby(range(len(steps)), key=lambda index: ways[index])
        if way
    ]
    longest_m = max((lengths[run].sum() for run in runs), default=0.0)
    passes = [points[run[0] : run[-1] + 2] for run in runs if lengths[run].sum() >= longest_m / 3]
    # the turns between passes have pulled the mean; the passes' own chords have not
    chords = np.array([each[-1] - each[0] for each in passes]).reshape(-1, 2)
    bearing = (
        0.5 * np.angle(np.sum((chords[:, 1] + 1j * chords[:, 0]) ** 2)) if len(chords) else bearing
    )
    across = np.array([np.cos(bearing), -np.sin(bearing)])
    gaps = np.diff(np.sort([float((each @ across).mean()) for each in passes]))
    # the same line flown twice is one strip
    apart = gaps[gaps > 0.2 * gaps.max(initial=0.0)]
    spacing_m = float(np.median(apart)) if len(apart) else np.nan
    return Strips(1 + len(apart), float(np.degrees(bearing)) % 180.0, spacing_m)
