"""The ground that pictures show, by how many, and the holes between them, against rectangles whose areas are known."""

import numpy as np
import pytest

from sorvolo.mosaic.seen_ground import PictureOnGround, coverage_figures, seen_ground

WIDE_M, LONG_M = 40.0, 24.0


def picture(x: float, y: float, m_per_px: float = 0.02) -> PictureOnGround:
    """One whose south-western corner lies there."""
    outline = np.array([[x, y + LONG_M], [x + WIDE_M, y + LONG_M], [x + WIDE_M, y], [x, y]])
    return PictureOnGround(outline, m_per_px)


def box(west: float, south: float, east: float, north: float) -> np.ndarray:
    return np.array([[west, south], [east, south], [east, north], [west, north]], float)


def test_nothing_is_seen_without_pictures() -> None:
    assert seen_ground([]) == []
    assert coverage_figures([])["holes"] == 0


def test_ground_is_counted_by_the_pictures_that_show_it() -> None:
    parts = seen_ground([picture(0, 0), picture(0, 12, 0.03)])
    found = {each.views: each for each in parts}
    assert set(found) == {1, 2}
    assert found[2].area_m2 == pytest.approx(WIDE_M * 12, rel=0.1) and found[
        2
    ].m_per_px == pytest.approx(0.02)
    assert found[1].area_m2 == pytest.approx(2 * WIDE_M * 12, rel=0.1)
    figures = coverage_figures(parts)
    assert figures["seen_m2"] == pytest.approx(WIDE_M * 36, rel=0.05) and figures["holes"] == 0
    assert figures["one_view_m2"] == found[1].area_m2


def test_a_gap_between_strips_is_a_hole_and_what_lies_beside_the_flight_is_none() -> None:
    """Two strips of five pictures each, 10 m apart."""
    strips = [picture(x, y) for x in (0.0, WIDE_M + 10) for y in np.arange(5) * 12.0]
    holes = [each for each in seen_ground(strips) if not each.views]
    assert len(holes) == 1 and holes[0].area_m2 == pytest.approx(10 * (4 * 12 + LONG_M), rel=0.15)
    ((outline,),) = holes[0].polygons
    assert outline.min(axis=0) == pytest.approx([WIDE_M, 0], abs=2) and np.isnan(holes[0].m_per_px)
    far = [picture(x, y) for x in (0.0, WIDE_M + 40) for y in np.arange(5) * 12.0]
    assert all(each.views for each in seen_ground(far))  # two places, not one with a gap


def test_what_the_flight_went_around_is_a_hole() -> None:
    ring = [
        picture(x, y)
        for x in (0.0, 36.0, 72.0, 108.0)
        for y in (0.0, 20.0, 40.0, 60.0, 80.0)
        if not (x in (36.0, 72.0) and y in (20.0, 40.0, 60.0))
    ]
    (hole,) = [each for each in seen_ground(ring) if not each.views]
    assert hole.area_m2 == pytest.approx((108 - 40) * (80 - 24), rel=0.15)


def test_all_of_the_area_that_was_asked_for_and_not_seen_is_a_hole_and_nothing_else() -> None:
    area = [[box(-10, 0, WIDE_M, LONG_M)]]
    parts = seen_ground([picture(0, 0), picture(WIDE_M + 10, 0)], area)
    (hole,) = [each for each in parts if not each.views]
    assert hole.area_m2 == pytest.approx(10 * LONG_M, rel=0.15)


def test_a_long_flight_keeps_to_the_raster_s_bound() -> None:
    pictures = [picture(0, 12.0 * number) for number in range(2000)]
    parts = seen_ground(pictures)
    assert sum(each.area_m2 for each in parts) == pytest.approx(WIDE_M * 2000 * 12, rel=0.2)
