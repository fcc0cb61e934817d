"""Volumes, profiles and contours of height models whose answer is known."""

import numpy as np
import pytest

from sorvolo.errors import GeometryError, InputError
from sorvolo.geometry.geodesy import Geodetic
from sorvolo.geometry.grid import SiteGrid
from sorvolo.heights.field import HeightField, along
from sorvolo.heights.lattice import MOST_SIDE, Lattice
from sorvolo.heights.volumes import (
    above_rim,
    between,
    contours,
    height_changes,
    tie,
)

GRID = SiteGrid.at(Geodetic(46.0, -91.0, 100.0), 0.2, "EPSG:32615")
COARSE = SiteGrid.at(Geodetic(46.0, -91.0, 100.0), 0.25, "EPSG:32615")
BOX = np.array([[-20.0, -15], [20, 15]])
SQUARE = ((np.array([[-5.0, -5], [5, -5], [5, 5], [-5, 5]]),),)


def rolling(x, y):
    return 0.6 * np.sin(x / 3) + 0.4 * np.cos(y / 2.5)


def field(grid, heights, sigma_m=0.05, seed=0) -> HeightField:
    lattice = Lattice.over(BOX, grid)
    points = lattice.points_m()
    noise = np.random.default_rng(seed).normal(0, 0.02, lattice.shape)
    up_m = (heights(points[..., 0], points[..., 1]) + noise).astype(np.float32)
    return HeightField(lattice, up_m, np.full(lattice.shape, sigma_m, np.float32))


def test_a_later_model_that_lies_off_is_tied_and_its_volume_is_right() -> None:
    """A pile of 3 x 4 x 1 m and a pit of 2 x 2 x 0.5 m; the later model lies 0.3, -0.2, 0.7 m off."""

    def later(x, y):
        x, y = x - 0.3, y + 0.2
        pile = (np.abs(x + 2) < 1.5) & (np.abs(y) < 2)
        pit = (np.abs(x - 3) < 1) & (np.abs(y) < 1)
        return rolling(x, y) + pile * 1.0 - pit * 0.5 + 0.7

    first, second = field(GRID, rolling), field(COARSE, later, seed=1)
    inside = first.inside(SQUARE)
    tied = tie(first, second, ~inside)
    np.testing.assert_allclose(tied.shift_m, [-0.3, 0.2, -0.7], atol=0.02)
    assert tied.sigma_m < 0.02
    found = between(first, second, SQUARE, tied)
    # noise of each cell, whose sign is not known, is cut or fill as well: compare their difference exactly
    assert found.net_m3 == pytest.approx(12 - 2, abs=0.5)
    assert found.fill_m3 == pytest.approx(12, abs=1.5) and found.cut_m3 == pytest.approx(2, abs=1.5)
    assert abs(found.net_m3 - 10) < 2 * found.sigma_m3 < 10
    assert found.area_m2 == pytest.approx(100, rel=0.03) and found.known_share > 0.99


def test_a_pile_is_measured_from_the_ground_around_it() -> None:
    pile = field(GRID, lambda x, y: 0.1 * x + np.maximum(0, 2 - np.hypot(x, y)))
    found = above_rim(pile, SQUARE)
    assert found.net_m3 == pytest.approx(np.pi * 4 * 2 / 3, abs=2.0)  # a cone


def test_areas_without_heights_or_ground_to_tie_by_are_refused() -> None:
    first, second = field(GRID, rolling), field(GRID, rolling, seed=1)
    everywhere = np.ones(first.lattice.shape, bool)
    with pytest.raises(InputError, match="outside the area"):
        tie(first, second, ~everywhere)
    holes = HeightField(first.lattice, np.full_like(first.up_m, np.nan), first.sigma_m)
    with pytest.raises(InputError, match="has heights"):
        between(first, holes, SQUARE, tie(first, second, everywhere))
    with pytest.raises(InputError, match="around the area"):
        above_rim(first, [[20 * SQUARE[0][0]]])


def test_what_lies_beyond_the_heights_is_not_known(monkeypatch: pytest.MonkeyPatch) -> None:
    """An area half beside the height model: half of its volume is not known, and one elsewhere is named as such."""
    pile = field(GRID, lambda x, y: 0.1 * x + np.maximum(0, 2 - np.hypot(x, y)))
    reach = float(BOX[:, 0].max())
    half = np.array([[-2, -4], [2 * reach + 2, -4], [2 * reach + 2, 4], [-2, 4]], float)
    with monkeypatch.context() as patch:
        patch.setattr("sorvolo.heights.volumes._LEAST_KNOWN", 0.3)
        found = above_rim(pile, [[half]])
    assert found.area_m2 == pytest.approx(
        8 * (2 * reach + 4)
    ) and found.known_share == pytest.approx(0.5, abs=0.02)
    with pytest.raises(InputError, match="beyond the flight's heights"):
        above_rim(pile, [[half + np.array([reach / 2, 0])]])
    with pytest.raises(InputError, match=r"only 0% of the area has heights.*100% of it is beyond"):
        above_rim(pile, [[half + np.array([4 * reach, 0])]])


def test_heights_along_a_line() -> None:
    ramp = field(GRID, lambda x, y: 0.5 * x)
    points, ways = along(np.array([[-10.0, 0], [10, 0], [10, 10]]), 0.5)
    assert ways[0] == 0 and ways[-1] == 30 and len(points) == 61
    heights, sigmas = ramp.at(points)
    np.testing.assert_allclose(heights, 0.5 * points[:, 0], atol=0.1)
    np.testing.assert_allclose(sigmas, 0.05, atol=1e-6)
    assert [len(each) for each in ramp.at(np.zeros((0, 2)))] == [0, 0]
    assert np.isnan(ramp.at(np.array([[100.0, 0]]))[0]).all()


def test_a_line_around_the_earth_is_refused() -> None:
    """Its points would take all memory: whoever may look at a station may ask for a profile."""
    with pytest.raises(InputError, match="shorter line"):
        along(np.array([[-2e7, 0.0], [2e7, 0.0]]), 0.001)


def test_contours_of_a_cone_are_closed_circles() -> None:
    cone = field(GRID, lambda x, y: 5 - np.hypot(x, y) / 2, sigma_m=0.0)
    smooth = HeightField(
        cone.lattice,
        (5 - np.hypot(*np.moveaxis(cone.lattice.points_m(), 2, 0)) / 2).astype(np.float32),
        cone.sigma_m,
    )
    found = list(contours(smooth, 1.0, zero_m=100.0))
    assert {level for level, _ in found} >= {101.0, 102.0, 103.0, 104.0}
    for level, line in found:
        radius = np.linalg.norm(line, axis=1)
        np.testing.assert_allclose(radius, 2 * (105 - level), atol=0.02)
        if level >= 99:  # those that the model holds as a whole
            np.testing.assert_array_equal(line[0], line[-1])
    assert sum(level == 103.0 for level, _ in found) == 1


def test_a_long_corridor_has_cells_that_its_raster_can_hold() -> None:
    """A power line of 6 km mapped at 2 cm: OpenCV resamples no picture of more than 32,766 pixels a side."""
    corridor = np.array([[-3000.0, -20], [3000, 20]])
    cell_m = Lattice.cell_for(corridor, 0.02)
    lattice = Lattice.over(
        corridor, SiteGrid.at(Geodetic(46.0, -91.0, 100.0), cell_m, "EPSG:32615")
    )
    assert 25_000 < max(lattice.shape) <= MOST_SIDE
    with pytest.raises(GeometryError, match=r"cells larger than 0\.06 m \(cell_m\)"):
        Lattice.over(corridor, SiteGrid.at(Geodetic(46.0, -91.0, 100.0), 0.06, "EPSG:32615"))


def test_heights_at_more_places_than_a_picture_has_rows() -> None:
    """A profile of a long line; outside of the model there are none."""
    plane = field(GRID, lambda x, y: x / 10 + 0 * y)
    points = np.column_stack([np.linspace(-25, 15, 40_000), np.zeros(40_000)])
    heights, sigmas = plane.at(points)
    inside = points[:, 0] > -19.5
    np.testing.assert_allclose(heights[inside], points[inside, 0] / 10, atol=0.12)
    np.testing.assert_allclose(sigmas[inside], 0.05, rtol=1e-5)
    assert np.isnan(heights[points[:, 0] < -21]).all()


def test_areas_get_the_height_by_which_their_ground_rose_where_both_dates_have_it() -> None:
    """A heap of 1.2 m on 4 x 4 m and ground taken away, 0.5 m; the later model lies 0.3, -0.2 and 0.7 m off."""

    def later(x, y):
        x, y = x - 0.3, y + 0.2
        heap, pit = (np.hypot(x + 10, y) < 4), (np.hypot(x - 10, y) < 4)
        return rolling(x, y) + heap * 1.2 - pit * 0.5 + 0.7

    around = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    ring = 3.5 * np.column_stack([np.cos(around), np.sin(around)])
    heap, pit, outside = (ring + np.array([east_m, 0.0]) for east_m in (-10, 10, 100))
    first, second = field(GRID, rolling), field(COARSE, later, seed=1)
    rose, sank, unknown = height_changes(first, second, [heap, pit, outside], [heap, pit, outside])
    assert rose is not None and sank is not None and unknown is None
    assert abs(rose.rise_m - 1.2) < 2 * rose.sigma_m < 0.3
    assert abs(sank.rise_m + 0.5) < 2 * sank.sigma_m < 0.3
    holes = HeightField(second.lattice, np.full_like(second.up_m, np.nan), second.sigma_m)
    assert height_changes(first, holes, [heap, pit], [heap, pit]) == [None, None]
