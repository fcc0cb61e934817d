"""Polygons in the plane against plain definitions of the same."""

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sorvolo.geometry.polygons import (
    band_spans,
    convex_hull,
    first_crossing,
    join_spans,
    points_inside,
    polygon_area,
    signed_area,
)

SQUARE = np.array([[0.0, 0], [4, 0], [4, 4], [0, 4]])
HOLE = np.array([[1.0, 1], [1, 3], [3, 3], [3, 1]])

corner_lists = st.lists(
    st.tuples(st.integers(-9, 9), st.integers(-9, 9)), min_size=3, max_size=8, unique=True
)


def turn(a, b, c):
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])


def share_points(a, b, c, d):
    """Exactly how two integer segments meet: "no", "point" (which) or "line"."""
    r, s = (b[0] - a[0], b[1] - a[1]), (d[0] - c[0], d[1] - c[1])
    q = (c[0] - a[0], c[1] - a[1])
    across = r[0] * s[1] - r[1] * s[0]
    if across:
        t = Fraction(q[0] * s[1] - q[1] * s[0], across)
        u = Fraction(q[0] * r[1] - q[1] * r[0], across)
        return (a[0] + t * r[0], a[1] + t * r[1]) if 0 <= t <= 1 and 0 <= u <= 1 else "no"
    if turn(a, b, c):
        return "no"
    length2 = r[0] ** 2 + r[1] ** 2
    t0, t1 = sorted(
        (
            Fraction(q[0] * r[0] + q[1] * r[1], length2),
            Fraction((q[0] + s[0]) * r[0] + (q[1] + s[1]) * r[1], length2),
        )
    )
    low, high = max(t0, Fraction(0)), min(t1, Fraction(1))
    if low > high:
        return "no"
    return "line" if low < high else (a[0] + low * r[0], a[1] + low * r[1])


def is_simple(corners):
    count = len(corners)
    for i in range(count):
        for j in range(i + 1, count):
            a, b, c, d = corners[i], corners[(i + 1) % count], corners[j], corners[(j + 1) % count]
            shared = share_points(a, b, c, d)
            neighbours = j == i + 1 or (i == 0 and j == count - 1)
            corner = b if j == i + 1 else a
            if shared != "no" and not (neighbours and shared == corner):
                return False
    return True


@settings(max_examples=150, deadline=None)
@given(corner_lists)
def test_crossings_are_those_of_exact_arithmetic(corners):
    assert (first_crossing(np.array(corners, dtype=float)) is None) == is_simple(corners)


def test_a_bow_tie_crosses_itself_and_a_square_does_not():
    assert first_crossing(SQUARE) is None
    assert first_crossing(SQUARE[[0, 2, 1, 3]]) is not None


@given(corner_lists)
def test_area_turns_with_the_ring_and_ignores_where_it_starts(corners):
    ring = np.array(corners, dtype=float)
    assert signed_area(ring[::-1]) == pytest.approx(-signed_area(ring), abs=1e-9)
    assert signed_area(np.roll(ring, 2, axis=0)) == pytest.approx(signed_area(ring), abs=1e-9)
    assert signed_area(ring + np.array([1e6, -2e6])) == pytest.approx(signed_area(ring), abs=1e-6)


def test_area_and_inside_of_a_square_with_a_hole():
    assert polygon_area([SQUARE, HOLE]) == 12
    points = np.array([[0.5, 0.5], [2, 2], [3.5, 2], [5, 2], [-1, 2], [np.nan, 1]])
    assert points_inside([SQUARE, HOLE], points).tolist() == [
        True,
        False,
        True,
        False,
        False,
        False,
    ]


@settings(max_examples=100, deadline=None)
@given(corner_lists, st.integers(0, 1000))
def test_inside_does_not_depend_on_the_axes(corners, seed):
    ring = np.array(corners, dtype=float)
    points = np.random.default_rng(seed).uniform(-10, 10, (50, 2))
    # rays to the right, to the left and upwards count the same
    mirrored = points_inside([ring * [-1, 1]], points * [-1, 1])
    turned = points_inside([ring[:, ::-1]], points[:, ::-1])
    assert (points_inside([ring], points) == mirrored).all()
    assert (points_inside([ring], points) == turned).all()


@settings(max_examples=100, deadline=None)
@given(corner_lists, st.integers(0, 1000))
def test_hull_holds_all_points_and_is_convex(corners, seed):
    points = np.array(corners, dtype=float)
    hull = convex_hull(points)
    if len(hull) < 3:
        return
    for a, b in zip(hull, np.roll(hull, -1, axis=0)):
        assert all(turn(a, b, point) >= -1e-9 for point in points)
    assert {tuple(corner) for corner in hull} <= {tuple(point) for point in points}


@settings(max_examples=150, deadline=None)
@given(corner_lists, st.floats(-9.5, 9.5), st.floats(0.1, 6))
def test_band_spans_hold_exactly_the_x_of_points_in_the_band(corners, low, width):
    if not is_simple(corners):
        return
    ring = np.array(corners, dtype=float)
    (spans,) = band_spans([ring], [(low, low + width)])
    x, y = np.meshgrid(np.linspace(-9.5, 9.5, 96), np.linspace(low, low + width, 24))
    points = np.column_stack([x.ravel(), y.ravel()])
    seen = np.unique(points[points_inside([ring], points), 0])
    for each in seen:
        assert any(a - 1e-9 <= each <= b + 1e-9 for a, b in spans)
    # and no span is longer than the polygon there: its ends are corners or points of edges in the band
    for a, b in spans:
        inside_band = np.clip(ring[:, 1], low, low + width) == ring[:, 1]
        ends = list(ring[inside_band, 0])
        for (x0, y0), (x1, y1) in zip(ring, np.roll(ring, -1, axis=0)):
            for level in (low, low + width):
                if min(y0, y1) <= level <= max(y0, y1) and y0 != y1:
                    ends.append(x0 + (level - y0) / (y1 - y0) * (x1 - x0))
        assert min(abs(a - end) for end in ends) < 1e-9
        assert min(abs(b - end) for end in ends) < 1e-9


@pytest.mark.parametrize("east", [0.0, 4000.0])
@pytest.mark.parametrize("low", [-1.2e-153, -1e-14, 0.0, 1e-14])
def test_a_band_whose_edge_misses_a_corner_by_rounding(east, low):
    ring = np.array([[east, 0], [east, -1], [east + 1, -1]])
    beside, within = band_spans([ring], [(low, low + 1), (low - 1, low)])
    assert np.allclose(beside, east, atol=1e-9)
    assert np.allclose(within, [(east, east + 1)], atol=1e-9)


def test_a_hole_splits_a_narrow_band_only():
    split, whole = band_spans([SQUARE, HOLE], [(1.8, 2.2), (0.5, 2.2)])
    assert split == [(0.0, 1.0), (3.0, 4.0)] and whole == [(0.0, 4.0)]


def test_an_outline_that_crosses_itself_has_the_spans_of_its_parts():
    bow_tie = SQUARE[[0, 2, 1, 3]]  # two triangles that meet in the middle
    low, middle = band_spans([bow_tie], [(0.0, 0.5), (1.5, 2.5)])
    assert low == [(0.0, 0.5), (3.5, 4.0)] and middle == [(0.0, 4.0)]


def test_spans_join_over_small_gaps():
    assert join_spans([(5, 6), (0, 1), (1.5, 2)], 0.5) == [(0, 2), (5, 6)]
    assert join_spans([(0, 10), (2, 3)], 0.0) == [(0, 10)]
    assert join_spans([], 1.0) == []
