"""Holes of a search become an area that can be flown: whatever their pattern, no ring crosses itself."""

import numpy as np
from scipy.ndimage import gaussian_filter

from sorvolo.store.exports.pod_files import CellGrid, regions_of, swollen_polygons
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
