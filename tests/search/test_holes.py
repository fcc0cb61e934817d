"""Holes of a search become an area that can be flown: whatever their pattern, no ring crosses itself."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from sorvolo.geometry.geodesy import Geodetic
from sorvolo.geometry.grid import SiteGrid
from sorvolo.search.cells import cells_over
from sorvolo.store.exports.map_pictures import picture
from sorvolo.store.exports.pod_files import (
    PICTURE_PX,
    CellGrid,
    pod_picture,
    regions_of,
    swollen_polygons,
)
from sorvolo.survey.area import Area


def test_swollen_holes_of_any_pattern_are_an_area() -> None:
    rng = np.random.default_rng(1)
    for number in range(30):
        values = gaussian_filter(rng.random((40, 50)), (0.0, 0.7, 1.5)[number % 3])
        cells = (values > np.quantile(values, rng.uniform(0.3, 0.8))).astype(np.uint8)
        grid = CellGrid((301_100.0 + rng.random(), 4_640_650.0), 1.37, "EPSG:32633", 12.6)
        holes = [each for each in regions_of(cells, grid) if each.area_m2 > 10 * grid.cell_m**2]
        area = Area(tuple(swollen_polygons(holes, grid, grid.cell_m / 2)), "holes")
        assert area.area_m2 > 0.9 * sum(each.area_m2 for each in holes)


def test_a_picture_shows_holes_beyond_the_map() -> None:
    """A map of 64 m by 64 m, and cells of 10 m from its south-west corner on, 200 m to the north and 300 m east."""
    site_grid = SiteGrid.at(Geodetic(48.0, 11.0, 0.0), 1.0, "EPSG:32632", 64)
    green = np.full((64, 64, 4), (20, 160, 20, 255), np.uint8)
    west_m, north_m = site_grid.grid.projected_from_grid(np.array([[-0.5, -0.5]]))[0]
    grid = CellGrid((west_m, north_m - 64 + 200), 10.0, "EPSG:32632", 11.0)
    classes, is_hole = np.zeros((20, 30), np.uint8), np.zeros((20, 30), bool)
    classes[17, 2], is_hole[3, 25] = (
        5,
        True,
    )  # 25 m from the corner on the map; 255 m east and 165 m north, unmapped
    shown = picture({(0, 0): green}, PICTURE_PX)
    for times in (1, 4):
        large = np.kron(green, np.ones((times, times, 1), np.uint8))
        fine = SiteGrid.at(Geodetic(48.0, 11.0, 0.0), 1.0 / times, "EPSG:32632", 64 * times)
        rgba = pod_picture(picture({(0, 0): large}, PICTURE_PX), fine, classes, is_hole, grid)
        assert rgba.shape[:2] == (
            pytest.approx(170 * times, abs=times),
            pytest.approx(260 * times, abs=times),
        )
        height = len(rgba)
        assert tuple(rgba[height - 60 * times, 60 * times]) == (20, 160, 20, 255)
        assert (
            rgba[height - 25 * times, 25 * times, 1] < 150
            and rgba[height - 25 * times, 25 * times, 3] == 255
        )
        hole = rgba[height - 165 * times, 255 * times]
        assert hole[3] == 255 and hole[0] == hole[1] and 140 < hole[0] < 170
        assert rgba[height - 165 * times, 150 * times, 3] == 0
    bounded = pod_picture(
        shown, site_grid, classes, is_hole, CellGrid(grid.corner_m, 100.0, grid.crs, 11.0)
    )
    assert max(bounded.shape[:2]) <= PICTURE_PX


def test_an_area_narrower_than_a_cell_is_its_own_cells_alone() -> None:
    site_grid = SiteGrid.at(Geodetic(48.0, 11.0, 0.0), 5.0, "EPSG:32632")
    frame_m = np.array([[-50.0, -50.0], [50.0, -50.0], [50.0, 50.0], [-50.0, 50.0]])
    speck = [[np.array([[1.0, 1.0], [1.3, 1.0], [1.3, 1.3]])]]
    path = [[np.array([[-40.0, 1.0], [40.0, 1.0], [40.0, 1.3], [-40.0, 1.3]])]]
    assert cells_over([frame_m], site_grid, speck).wanted.sum() == 1
    cells = cells_over([frame_m], site_grid, path)
    assert 16 <= cells.wanted.sum() <= 20 and np.ptp(cells.centres_m[cells.wanted][:, 0]) >= 75
    far = cells_over([frame_m + 9000.0], site_grid, speck)
    assert (
        len(far) <= 4 and far.wanted.sum() == 1 and far.wanted_from_m([*frame_m + 9000.0]) > 12_000
    )
