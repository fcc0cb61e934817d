"""Polygons in a plane: area, what lies inside, where an outline crosses itself, and what a band cuts out.

A ring is an (N, 2) array of at least three corners without the first one repeated. A polygon is a sequence of
rings, the outline first, then its holes; inside follows the even-odd rule, so a ring may turn either way.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sorvolo.geometry.arrays import Floats, PointsM


def signed_area(ring: PointsM) -> float:
    """The ring's area in the square of its unit, positive when it turns counter-clockwise (x right, y up)."""
    x, y = (ring - ring.mean(axis=0)).T
    return float(0.5 * np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y))


def polygon_area(rings: Sequence[PointsM]) -> float:
    """The area of the outline less its holes."""
    return abs(signed_area(rings[0])) - sum(abs(signed_area(hole)) for hole in rings[1:])


def points_inside(rings: Sequence[PointsM], points: PointsM) -> NDArray[np.bool_]:
    """(N,) whether each point, shape (N, 2), lies inside the polygon; NaN points do not."""
    x, y = np.asarray(points, dtype=np.float64).reshape(-1, 2).T
    inside = np.zeros(len(x), dtype=bool)
    for ring in rings:
        for (x0, y0), (x1, y1) in zip(ring, np.roll(ring, -1, axis=0)):
            if y0 != y1:
                crosses = (y0 > y) != (y1 > y)
                inside ^= crosses & (x < x0 + (y - y0) / (y1 - y0) * (x1 - x0))
    return inside


def first_crossing(ring: PointsM) -> tuple[int, int] | None:
    """The first two edges, by the index of their first corners, that meet other than at a shared corner.

    None when the ring is simple. Edges that run back over their neighbour count as meeting.
    """
    start, end = ring, np.roll(ring, -1, axis=0)
    count = len(ring)
    tolerance = 1e-12 * float(np.ptp(ring, axis=0).max()) ** 2
    for i in range(count):
        others = np.arange(i + 1, count)
        meets = _segments_meet(start[i], end[i], start[others], end[others], tolerance)
        neighbours = (others == i + 1) | ((i == 0) & (others == count - 1))
        meets[neighbours] = [
            _runs_back(start[i], end[i], start[j], end[j], tolerance) for j in others[neighbours]
        ]
        if meets.any():
            return i, int(others[np.argmax(meets)])
    return None


def band_spans(rings: Sequence[PointsM], low: float, high: float) -> list[tuple[float, float]]:
    """The x-extents of the polygon's parts with low <= y <= high, in order of x, touching ones joined.

    The outline of each part is made of pieces of the polygon's edges and of chords along the two band lines;
    the extents of those pieces together are the extent of the part.
    """
    spans: list[tuple[float, float]] = []
    for ring in rings:
        for a, b in zip(ring, np.roll(ring, -1, axis=0)):
            if max(a[1], b[1]) < low or min(a[1], b[1]) > high:
                continue
            rise = b[1] - a[1]
            if rise == 0:
                ends = np.array([0.0, 1.0])
            else:
                ends = np.clip(np.sort((np.array([low, high]) - a[1]) / rise), 0.0, 1.0)
            x0, x1 = sorted(a[0] + ends * (b[0] - a[0]))
            spans.append((float(x0), float(x1)))
    for level in (low, high):
        crossings = _crossings(rings, level)
        spans += list(zip(crossings[::2], crossings[1::2]))
    return join_spans(spans, 0.0)


def join_spans(spans: Sequence[tuple[float, float]], gap: float) -> list[tuple[float, float]]:
    """The spans in order, those joined into one that overlap or lie no more than `gap` apart."""
    joined: list[tuple[float, float]] = []
    for low, high in sorted(spans):
        if joined and low <= joined[-1][1] + gap:
            joined[-1] = (joined[-1][0], max(joined[-1][1], high))
        else:
            joined.append((low, high))
    return joined


def convex_hull(points: PointsM) -> PointsM:
    """(M, 2) corners of the convex hull of points, shape (N, 2), counter-clockwise (Andrew's chain)."""
    ordered = np.unique(np.asarray(points, dtype=np.float64), axis=0)
    if len(ordered) < 3:
        return ordered
    halves = []
    for sweep in (ordered, ordered[::-1]):
        chain: list[Floats] = []
        for point in sweep:
            while len(chain) > 1 and _turn(chain[-2], chain[-1], point) <= 0:
                chain.pop()
            chain.append(point)
        halves += chain[:-1]
    return np.array(halves)


def narrowest_extent(points: PointsM) -> tuple[float, Floats]:
    """The least width of points, shape (N, 2), in any direction, and the unit vector, (2,), at right angles.

    The vector runs along the points' longer way (rotating calipers over the hull). The width of points on one
    line is zero. Of equally narrow ways, as in a square, the one along the hull's longest edge is taken.
    """
    hull = convex_hull(points)
    edges = np.roll(hull, -1, axis=0) - hull
    lengths = np.linalg.norm(edges, axis=1)
    if lengths.max() == 0:
        return 0.0, np.array([1.0, 0.0])
    along = edges / lengths[:, None]
    spread = np.ptp(hull @ np.column_stack([-along[:, 1], along[:, 0]]).T, axis=0)
    best = np.lexsort((-lengths, np.round(spread, 6)))[0]
    return float(spread[best]), along[best]


def _crossings(rings: Sequence[PointsM], level: float) -> list[float]:
    found: list[float] = []
    for ring in rings:
        a, b = ring, np.roll(ring, -1, axis=0)
        hit = (a[:, 1] > level) != (b[:, 1] > level)
        a, b = a[hit], b[hit]
        found += list(a[:, 0] + (level - a[:, 1]) / (b[:, 1] - a[:, 1]) * (b[:, 0] - a[:, 0]))
    return sorted(found)


def _turn(a: Floats, b: Floats, c: Floats) -> Floats:
    """Twice the signed area of the triangles a, b, c; arrays (..., 2)."""
    ab, ac = b - a, c - a
    return ab[..., 0] * ac[..., 1] - ab[..., 1] * ac[..., 0]


def _segments_meet(a: Floats, b: Floats, c: Floats, d: Floats, tolerance: float) -> NDArray[np.bool_]:
    """Whether the segment a-b, (2,) each, meets the segments c-d, (N, 2) each, ends included."""
    c_side, d_side = _turn(a, b, c), _turn(a, b, d)
    a_side, b_side = _turn(c, d, a), _turn(c, d, b)
    straddle = (c_side * d_side <= tolerance**2) & (a_side * b_side <= tolerance**2)
    boxes = (
        (np.maximum(c, d) >= np.minimum(a, b) - 1e-12).all(axis=-1)
        & (np.minimum(c, d) <= np.maximum(a, b) + 1e-12).all(axis=-1)
    )
    return straddle & boxes


def _runs_back(a: Floats, b: Floats, c: Floats, d: Floats, tolerance: float) -> bool:
    """Whether two edges that share a corner lie on one line and overlap beyond it."""
    first, second = b - a, d - c
    across = first[0] * second[1] - first[1] * second[0]
    return bool(abs(across) <= tolerance and first @ second < 0)
