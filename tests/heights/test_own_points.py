"""The sigma of heights as the flight's own points in space judge it."""

import numpy as np
import pytest
from scenes import survey_views

from sorvolo.geometry.geodesy import Geodetic
from sorvolo.geometry.grid import SiteGrid
from sorvolo.heights.cameras import Cameras3D
from sorvolo.heights.figures import judged_by_points
from sorvolo.heights.lattice import Lattice
from sorvolo.heights.smooth_sigma import SmoothSigma
from sorvolo.heights.surface import Surface

CAMERA_M = 0.1
MATCH_M = 0.05


def level(error_m: float, stated_m: float = MATCH_M, points: int = 5000, views: int = 3):
    """Level ground whose heights err by `error_m` from cell to cell, and points on it that err by a centimetre."""
    rng = np.random.default_rng(3)
    lattice = Lattice.over(
        np.array([[-20.0, -20], [20, 20]]),
        SiteGrid.at(Geodetic(46.0, -91.0, 100.0), 0.1, "EPSG:32615"),
    )
    up_m = rng.normal(0, error_m, lattice.shape).astype(np.float32)
    sigma_m = np.full(lattice.shape, np.hypot(stated_m, CAMERA_M), np.float32)
    places = lattice.points_m().reshape(-1, 2)[rng.permutation(up_m.size)[:points]]
    points_m = np.column_stack([places, rng.normal(0, 0.01, len(places))])
    solved = Cameras3D(
        survey_views(),
        (),
        points_m,
        0.5,
        1.0,
        (0.0, 0.0),
        np.full(3, 0.1),
        100,
        SmoothSigma(least_m=CAMERA_M),
        np.full(len(places), 0.01),
        np.full(len(places), views),
    )
    return Surface(lattice, up_m, sigma_m, np.ones(lattice.shape, bool)), solved


def test_a_sigma_that_is_too_small_is_raised_to_the_errors_and_the_cameras_part_stays() -> None:
    surface, solved = level(error_m=3 * MATCH_M)
    raised, judgement = judged_by_points(surface, solved)
    assert judgement.points == pytest.approx(5000, abs=100)
    assert judgement.within_2_sigma < 0.6
    assert judgement.factor == pytest.approx(3.0, rel=0.1)
    assert np.median(raised.sigma_m) == pytest.approx(np.hypot(3 * MATCH_M, CAMERA_M), rel=0.1)
    # judged again by the same points it is right
    _, again = judged_by_points(raised, solved)
    assert again.factor == pytest.approx(1.0, abs=0.02)
    assert again.within_1_sigma == pytest.approx(0.683, abs=0.03)
    assert again.within_2_sigma == pytest.approx(0.954, abs=0.02)


def test_heavy_tails_raise_it_as_well() -> None:
    surface, solved = level(error_m=0.5 * MATCH_M)
    rng = np.random.default_rng(8)
    wild = rng.random(surface.up_m.shape) < 0.1
    surface.up_m[wild] += rng.choice([-0.4, 0.4], int(wild.sum()))
    _, judgement = judged_by_points(surface, solved)
    assert judgement.within_1_sigma > 0.8
    assert judgement.factor > 2


def test_a_sigma_that_is_large_enough_stays() -> None:
    surface, solved = level(error_m=0.5 * MATCH_M)
    same, judgement = judged_by_points(surface, solved)
    assert same is surface and judgement.factor == 1
    assert judgement.within_2_sigma > 0.99
    assert judgement.median_m == pytest.approx(0.6745 * np.hypot(0.5 * MATCH_M, 0.01), rel=0.1)


def test_points_of_two_views_and_few_points_judge_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    surface, solved = level(error_m=3 * MATCH_M, views=2)
    same, judgement = judged_by_points(surface, solved)
    assert same is surface and judgement.points == 0 and np.isnan(judgement.within_2_sigma)
    surface, solved = level(error_m=3 * MATCH_M, points=80)
    same, judgement = judged_by_points(surface, solved)
    assert same is surface and 0 < judgement.points <= 80 and judgement.factor == 1
    monkeypatch.setattr("sorvolo.heights.figures._LEAST_POINTS", 40)
    assert judged_by_points(surface, solved)[1].factor > 2


def test_holes_are_not_judged_and_stay_holes() -> None:
    surface, solved = level(error_m=3 * MATCH_M)
    surface.up_m[:, :200] = np.nan
    surface.sigma_m[:, :200] = np.nan
    raised, judgement = judged_by_points(surface, solved)
    assert 0.4 * 5000 < judgement.points < 0.6 * 5000
    np.testing.assert_array_equal(np.isnan(raised.sigma_m), np.isnan(surface.sigma_m))
