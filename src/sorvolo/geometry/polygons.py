"""Polygons in a plane, by shapely: area, what lies inside, self-crossing outlines, spans within a band.

A ring is an (N, 2) array of at least three corners without the first one repeated. A polygon is a sequence of
rings, the outline first, then its holes; a ring may turn either way.
"""

import re
from collections.abc import Sequence
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from sorvolo.geometry.arrays import Floats, PointsM

_MOST_HULL_CORNERS = 1000  # what follows takes the square of their number
_HULL_TOLERANCE = 1e-6  # of the extent, where a hull has more corners than that
_PARTED = 1e-3  # of the reach: what touches is parted so far, by choice; far above rounding, far below what is flown
_ROUNDING_M = 1e-9  # parts of a band so near touch
_LOCATION = re.compile(r"\[(\S+) (\S+)\]$")


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
    polygon = _polygon(rings)
    shapely.prepare(polygon)
    return np.asarray(shapely.contains_xy(polygon, x, y), dtype=np.bool_)


def first_crossing(ring: PointsM) -> tuple[int, int] | None:
    """Two edges, by the index of their first corners, that meet other than at a corner they share.

    None when the ring is simple. Edges that run back over their neighbour count as meeting.
    """
    polygon = _polygon([ring])
    if shapely.is_valid(polygon):
        return None
    place = _LOCATION.search(shapely.is_valid_reason(polygon))
    edges = shapely.linestrings(np.stack([ring, np.roll(ring, -1, axis=0)], axis=1))
    point = shapely.Point(float(place[1]), float(place[2])) if place else shapely.Point(*ring[0])
    distances = shapely.distance(edges, point)
    # the message prints the place with few digits where its numbers are large
    meeting = np.flatnonzero(distances <= 1e-9 * float(np.ptp(ring, axis=0).max()))
    if len(meeting) < 2:
        meeting = np.sort(np.argsort(distances)[:2])
    return int(meeting[0]), int(meeting[len(meeting) // 2])


def band_spans(
    rings: Sequence[PointsM], bands: Sequence[tuple[float, float]]
) -> list[list[tuple[float, float]]]:
    """For each band low <= y <= high the x-extents of the polygon's parts in it, in order, touching ones joined.

    A polygon that crosses itself is first made one that does not, by the even-odd rule. What has no area is no part.
    """
    polygon = _polygon(rings)
    if not shapely.is_valid(polygon):
        polygon = shapely.make_valid(polygon)
    left, _, right, _ = shapely.bounds(polygon)
    found = []
    for low, high in bands:
        # not clip_by_rect, which fails where a band's edge and a corner differ by rounding alone
        parts = shapely.get_parts(
            shapely.intersection(polygon, shapely.box(left - 1.0, low, right + 1.0, high))
        )
        is_area = shapely.area(parts) > 0
        spans = [(float(x0), float(x1)) for x0, _, x1, _ in shapely.bounds(parts[is_area])]
        found.append(join_spans(spans, _ROUNDING_M))
    return found


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
    """(M, 2) corners of the convex hull of points, shape (N, 2), counter-clockwise; two for points on one line."""
    hull = shapely.convex_hull(shapely.multipoints(np.asarray(points, dtype=np.float64)))
    corners = np.asarray(shapely.get_coordinates(hull), dtype=np.float64)
    if shapely.get_type_id(hull) != shapely.GeometryType.POLYGON:
        return corners
    corners = corners[:-1]
    return corners if signed_area(corners) > 0 else corners[::-1]


def narrowest_extent(points: PointsM) -> tuple[float, Floats]:
    """The least width of points, shape (N, 2), in any direction, and the unit vector, (2,), at right angles.

    The vector runs along the points' longer way (rotating calipers over the hull). The width of points on one
    line is zero. Of equally narrow ways, as in a square, the one along the hull's longest edge is taken. Hulls of
    more than a thousand corners are simplified to a millionth of their extent first.
    """
    hull = convex_hull(points)
    if len(hull) > _MOST_HULL_CORNERS:
        tolerance = _HULL_TOLERANCE * float(np.ptp(hull, axis=0).max())
        hull = shapely.get_coordinates(shapely.simplify(_polygon([hull]), tolerance))[:-1]
    edges = np.roll(hull, -1, axis=0) - hull
    lengths = np.linalg.norm(edges, axis=1)
    if lengths.max() == 0:
        return 0.0, np.array([1.0, 0.0])
    along = edges / lengths[:, None]
    spread = np.ptp(hull @ np.column_stack([-along[:, 1], along[:, 0]]).T, axis=0)
    best = np.lexsort((-lengths, np.round(spread, 6)))[0]
    return float(spread[best]), along[best]


def widened_line(line: PointsM, reach: float) -> list[list[PointsM]]:
    """The polygons of everything within `reach` of a line, shape (N, 2); round ends become half 16-gons.

    The 16-gon holds the circle. Gaps that the line leaves free count only where they are wider than a tenth of
    `reach` all over: narrower ones are filled.
    """
    outer = reach / np.cos(np.pi / 16)
    widened = shapely.buffer(shapely.linestrings(line), outer, quad_segs=4)
    polygons = []
    for polygon in shapely.get_parts(widened):
        rings = [_open(ring) for ring in shapely.get_rings(polygon)]
        holes = [ring for ring in rings[1:] if narrowest_extent(ring)[0] > 0.1 * reach]
        polygons.append([rings[0], *holes])
    return polygons


def swollen(polygons: Sequence[Sequence[PointsM]], reach: float) -> list[list[PointsM]]:
    """The polygons of everything within `reach` of any of these; corners stay corners, what meets becomes one.

    Gaps narrower than `reach` all over are filled.
    """
    widened = shapely.buffer(
        shapely.union_all([_polygon(rings) for rings in polygons]), reach, join_style="mitre"
    )
    simple = shapely.simplify(widened, reach / 2)
    # rings that touch themselves at a corner cross by rounding once they are laid on the Earth: opened there
    parted = shapely.buffer(simple, -_PARTED * reach, join_style="mitre")
    found = []
    for polygon in shapely.get_parts(parted):
        rings = [_open(ring) for ring in shapely.get_rings(polygon)]
        found.append([rings[0], *(ring for ring in rings[1:] if narrowest_extent(ring)[0] > reach)])
    return found


def _polygon(rings: Sequence[PointsM]) -> Any:
    return shapely.polygons(
        shapely.linearrings(rings[0]), [shapely.linearrings(ring) for ring in rings[1:]] or None
    )


def _open(ring: Any) -> PointsM:
    return np.asarray(shapely.get_coordinates(ring)[:-1], dtype=np.float64)


def gap(a: PointsM, b: PointsM) -> float:
    """The distance of the areas within two rings, (N, 2) each, in their unit; 0 where they overlap."""
    return float(shapely.distance(*(shapely.make_valid(_polygon([ring])) for ring in (a, b))))


def union_of_boxes(boxes: Floats) -> list[list[PointsM]]:
    """The polygons that boxes, (N, 4) west, south, east, north, cover together: each its outline, then its holes."""
    joined = shapely.union_all(shapely.box(*np.asarray(boxes, float).T))
    parts = shapely.get_parts(shapely.simplify(joined, 0.0))
    return [
        [np.asarray(ring.coords)[:-1] for ring in (part.exterior, *part.interiors)]
        for part in parts
        if not part.is_empty
    ]
