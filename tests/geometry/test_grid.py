"""The grid: pixels and metres, tiles touched against brute force, and the way from the site."""

import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st

from sorvolo.errors import GeometryError
from sorvolo.geometry.geodesy import Geodetic, utm_epsg
from sorvolo.geometry.grid import Grid, SiteGrid
from sorvolo.geometry.homography import apply_homography
from sorvolo.geometry.polygons import convex_hull, points_inside

GRID = Grid((0.0, 0.0), 0.05, 16)
corners = st.lists(st.tuples(st.floats(-60, 60), st.floats(-60, 60)), min_size=3, max_size=6)


@given(st.floats(-1e6, 1e6), st.floats(-1e6, 1e6), st.floats(0.001, 10))
def test_pixels_to_metres_and_back(east, north, m_per_px):
    grid = Grid((4e5 + east, 5e6 + north), m_per_px)
    points_px = np.array([[0.0, 0], [100, 200], [-5, 7.5]])
    points_m = grid.projected_from_grid(points_px)
    np.testing.assert_allclose(points_m[0], grid.origin_m)
    assert points_m[1, 1] < points_m[0, 1]  # y runs south
    np.testing.assert_allclose(grid.grid_from_projected(points_m), points_px, atol=1e-4)


@settings(max_examples=150, deadline=None)
@given(corners)
@example([(0.0, 0.8617786960760228), (0.0, -0.5), (1.0, 0.0)])  # a corner on a tile's rim
def test_tiles_touched_are_those_that_brute_force_finds(points):
    outline = convex_hull(np.round(np.array(points), 3))
    assume(len(outline) >= 3)
    touched = GRID.tiles_touched(outline)
    # every tile with a sample of the outline's inside or border is touched
    steps = np.linspace(0, 1, 50)[:, None]
    border = np.concatenate(
        [a + steps * (b - a) for a, b in zip(outline, np.roll(outline, -1, axis=0))]
    )
    x, y = np.meshgrid(np.linspace(-60, 60, 150), np.linspace(-60, 60, 150))
    samples = np.column_stack([x.ravel(), y.ravel()])
    samples = np.concatenate([border, samples[points_inside([outline], samples)]])
    # a sample on a tile's rim falls to either side by rounding: only those clearly inside a tile count
    in_tile = (samples + 0.5) / 16 % 1
    clear = samples[np.all((in_tile > 1e-9) & (in_tile < 1 - 1e-9), axis=1)]
    tiles = {tuple(tile) for tile in np.floor((clear + 0.5) / 16).astype(int)}
    assert tiles <= touched
    # and a touched tile has a point of the outline within a sampling step of its square
    for tile in touched - tiles:
        x0, y0, x1, y1 = np.array(GRID.tile_window(tile)) - 0.5
        gap = np.maximum([x0, y0] - samples, samples - [x1, y1]).max(axis=1)
        assert gap.min() < 3.5


def test_a_slanted_outline_does_not_touch_all_tiles_of_its_box():
    strip = np.array([[0.0, 0], [8, 0], [160, 152], [160, 160], [152, 160], [0, 8]])
    touched = GRID.tiles_touched(strip)
    assert (0, 9) not in touched
    assert (9, 0) not in touched
    assert {(n, n) for n in range(10)} <= touched


def test_tiles_may_be_negative_and_their_windows_fit_together():
    assert GRID.tile_window((-1, 2)) == (-16, 32, 0, 48)
    # the border between tiles lies half a pixel before a tile's first pixel centre
    assert GRID.tiles_touched(np.array([[-0.4, -0.4], [0.4, -0.4], [0.4, 0.4]])) == {(0, 0)}
    assert (-1, 0) in GRID.tiles_touched(np.array([[-0.6, 0.0], [0.4, 0.0], [0.4, 0.4]]))


@settings(max_examples=40, deadline=None)
@given(st.floats(-70, 70), st.floats(-180, 180), st.floats(-800, 800), st.floats(-800, 800))
def test_the_affine_map_is_the_exact_one_nearby(latitude, longitude, east, north):
    place = Geodetic(latitude, longitude)
    site_grid = SiteGrid.at(place, 0.05, f"EPSG:{utm_epsg(latitude, longitude)}")
    centre_m = np.array([east, north])
    points_m = centre_m + np.random.default_rng(6).uniform(-40, 40, (10, 2))
    affine = site_grid.grid_from_site_affine(centre_m, 40.0)
    error_px = np.abs(apply_homography(affine, points_m) - site_grid.grid_from_site(points_m)).max()
    assert error_px * 0.05 < 0.001


def test_the_sites_origin_lies_on_the_grids_first_pixel():
    site_grid = SiteGrid.at(Geodetic(45.0, 9.3), 0.1, "EPSG:32632")
    assert np.abs(site_grid.grid_from_site(np.zeros((1, 2)))).max() <= 0.5 + 1e-6
    east_m, north_m = site_grid.grid.origin_m
    assert east_m / 0.1 == pytest.approx(round(east_m / 0.1), abs=1e-6)
    assert north_m / 0.1 == pytest.approx(round(north_m / 0.1), abs=1e-6)


def test_a_grid_without_crs_is_the_sites_own():
    site_grid = SiteGrid.at(Geodetic(0.0, 0.0), 0.5, "")
    np.testing.assert_allclose(site_grid.grid_from_site(np.array([[5.0, 10.0]])), [[10.0, -20.0]])


@pytest.mark.parametrize(
    "arguments", [((0, 0), 0.0), ((0, 0), np.nan), ((0, 0), -1.0), ((0, 0), 0.1, 8)]
)
def test_impossible_grids_are_refused(arguments):
    with pytest.raises(GeometryError):
        Grid(*arguments)
