"""Cameras in 3D from poses that are off: bundle adjustment against cameras and points that are known."""

from dataclasses import replace

import numpy as np
import pytest
from scenes import hills_with_houses, photo, survey_views, texture

from sorvolo.errors import InputError
from sorvolo.geometry.arrays import ImageGray
from sorvolo.geometry.pose import NADIR_CAMERA_NORTH_UP, Pose, rotation_from_vector
from sorvolo.heights.adjustment import (
    AdjustmentSettings,
    Priors,
    Scene,
    _add_priors,
    adjust,
    height_deviations,
    matched_deviations,
    triangulate,
)
from sorvolo.heights.cameras import Cameras3D, Matches, find_tracks, solve_tracks
from sorvolo.heights.figures import camera_warnings
from sorvolo.heights.smooth_sigma import SmoothSigma
from sorvolo.registration.features import gray_from_rgb


def scene(
    focal_scale: float = 1.0, radial: float = 0.0, centre: tuple[float, float] = (0.0, 0.0)
) -> Scene:
    """Nine cameras over 200 points with 4 m of relief, seen without noise by a lens that is off as given."""
    rng = np.random.default_rng(1)
    grid = np.array([(x, y) for x in (-10.0, 0, 10) for y in (-10.0, 0, 10)])
    rotations = rotation_from_vector(rng.normal(0, 0.03, (9, 3))) @ NADIR_CAMERA_NORTH_UP
    centres = np.column_stack([grid, 40 + rng.normal(0, 1, 9)])
    points = rng.uniform([-14, -14, -2], [14, 14, 2], (200, 3))
    view, point = np.repeat(np.arange(9), 200), np.tile(np.arange(200), 9)
    made = Scene(
        rotations,
        centres,
        np.full(9, 1000.0),
        points,
        view,
        point,
        np.zeros((1800, 2)),
        np.zeros(5),
    )
    local = np.einsum("mji,mj->mi", rotations[view], points[point] - centres[view])
    ideal = focal_scale * local[:, :2] / local[:, 2:] - centre
    seen = ideal.copy()
    for _ in range(50):
        seen = ideal / (1 + radial * (seen**2).sum(axis=1, keepdims=True))
    return replace(made, seen=seen)


def test_derivatives_are_those_of_the_residuals() -> None:
    from sorvolo.heights.adjustment import _advance, _derivatives

    made = replace(scene(), shared=np.array([0.02, 0.01, -0.02, 0.003, -0.004]))
    residual, by_camera, by_shared, by_point = _derivatives(made)
    step = 1e-6
    for k in range(6):
        cameras = np.zeros((9, 6))
        cameras[:, k] = step
        moved = _advance(
            made, np.concatenate([cameras.ravel(), np.zeros(5)]), np.zeros_like(made.points_m)
        )
        np.testing.assert_allclose(
            (moved.residuals_px() - residual) / step, by_camera[:, :, k], atol=0.01
        )
    for k in range(5):
        cameras = np.zeros(59)
        cameras[54 + k] = step
        moved = _advance(made, cameras, np.zeros_like(made.points_m))
        np.testing.assert_allclose(
            (moved.residuals_px() - residual) / step, by_shared[:, :, k], atol=0.01
        )
    for k in range(3):
        points = np.zeros_like(made.points_m)
        points[:, k] = step
        moved = _advance(made, np.zeros(59), points)
        np.testing.assert_allclose(
            (moved.residuals_px() - residual) / step, by_point[:, :, k], atol=0.01
        )


def test_points_are_triangulated_where_they_are() -> None:
    made = scene()
    np.testing.assert_allclose(triangulate(made), made.points_m, atol=1e-6)


def test_adjustment_finds_cameras_points_and_lens() -> None:
    true = scene(focal_scale=1.01, radial=0.02, centre=(0.004, -0.003))
    rng = np.random.default_rng(4)
    turn = rotation_from_vector(rng.normal(0, 0.01, (9, 3)))
    off = replace(
        true,
        rotations=turn @ true.rotations,
        centres_m=true.centres_m + rng.normal(0, 0.5, (9, 3)),
    )
    off = replace(off, points_m=triangulate(off))
    priors = Priors(true.centres_m, np.full((9, 3), 0.05), true.rotations)
    found = adjust(off, priors, AdjustmentSettings())
    assert np.sqrt((found.residuals_px() ** 2).mean()) < 0.05
    assert np.abs(found.centres_m - true.centres_m).max() < 0.1
    assert np.abs(found.points_m - true.points_m).max() < 0.1
    np.testing.assert_allclose(np.exp(found.shared[0]), 1.01, atol=0.002)
    np.testing.assert_allclose(found.shared[1], 0.02, atol=0.004)
    np.testing.assert_allclose(found.shared[3:], [0.004, -0.003], atol=0.001)


def test_heights_err_more_away_from_the_middle_where_fixes_scatter() -> None:
    """What GPS leaves open of the tilt and the scale shows at the rim; better fixes lower it."""
    made = scene()
    errors = [
        height_deviations(
            made,
            Priors(made.centres_m, np.full((9, 3), sigma_m), made.rotations),
            AdjustmentSettings(sigma_px=0.1),
        )
        for sigma_m in (0.4, 0.2)
    ]
    away = np.linalg.norm(made.points_m[:, :2], axis=1)
    assert np.median(errors[0][away > 12]) > 2 * np.median(errors[0][away < 5])
    assert (
        0.45 < np.median(errors[1] / errors[0]) < 0.7
    )  # attitudes and the lens have sigmas of their own
    # nine fixes of 0.4 m over 8.2 m rms either way: a tilt of 0.016
    tilted_m = 0.4 / 3 * np.median(away[away > 12]) / np.sqrt(200 / 3)
    assert np.median(errors[0][away > 12]) == pytest.approx(tilted_m, rel=0.5)
    smooth = SmoothSigma.fitted(made.points_m[:, :2], errors[0])
    np.testing.assert_allclose(smooth.at(made.points_m[:, :2]), errors[0], atol=0.05)


def test_a_few_wild_points_do_not_spoil_the_cameras_sigma() -> None:
    """A point on almost parallel rays errs by tens of metres; one of 9,000 made all other sigmas far too small."""
    rng = np.random.default_rng(6)
    places = rng.uniform(-20, 20, (2000, 2))
    sigma_m = np.sqrt(0.002 + 0.00003 * places[:, 0] ** 2 + 0.0001 * places[:, 1] ** 2)
    wild = sigma_m.copy()
    wild[rng.permutation(2000)[:20]] = rng.uniform(2, 20, 20)
    np.testing.assert_allclose(SmoothSigma.fitted(places, wild).at(places), sigma_m, rtol=0.05)
    np.testing.assert_allclose(SmoothSigma.fitted(places, sigma_m).at(places), sigma_m, rtol=0.01)


def test_points_err_by_their_features_as_stated() -> None:
    """Of 200 points seen by nine cameras that are known, with features off by 0.3 pixels."""
    true = scene()
    rng = np.random.default_rng(5)
    priors = Priors(true.centres_m, np.full((9, 3), 0.05), true.rotations)
    sigma_m = matched_deviations(true, priors, AdjustmentSettings(sigma_px=0.3))
    off_m = triangulate(replace(true, seen=true.seen + rng.normal(0, 0.3 / 1000, true.seen.shape)))[
        :, 2
    ]
    times = (off_m - true.points_m[:, 2]) / sigma_m
    assert np.sqrt((times**2).mean()) == pytest.approx(1.0, abs=0.2)


def test_wrong_matches_do_not_bend_the_cameras() -> None:
    true = scene()
    rng = np.random.default_rng(2)
    seen = true.seen.copy()
    wrong = rng.random(len(seen)) < 0.1
    seen[wrong] += rng.normal(0, 0.1, (int(wrong.sum()), 2))
    priors = Priors(true.centres_m, np.full((9, 3), 0.5), true.rotations)
    found = adjust(replace(true, seen=seen), priors, AdjustmentSettings())
    assert np.abs(found.centres_m - true.centres_m).max() < 0.05


@pytest.fixture(scope="module")
def survey():
    views = survey_views(strips=2, photos=4, side_px=320)
    look = texture()
    return views, [gray_from_rgb(photo(view, hills_with_houses, look)) for view in views]


def test_cameras_are_solved_from_pictures(survey) -> None:
    """Poses off by decimetres and a degree, as a map of level ground leaves them, come back to centimetres."""
    views, pictures = survey
    rng = np.random.default_rng(0)
    off = [
        replace(
            view,
            site_from_camera=Pose(
                rotation_from_vector(rng.normal(0, 0.015, (1, 3)))[0]
                @ view.site_from_camera.rotation,
                view.site_from_camera.translation_m + rng.normal(0, 0.4, 3),
            ),
        )
        for view in views
    ]
    solved = solve_tracks(off, find_tracks(off, lambda number: pictures[number]))
    assert not solved.lost
    places = np.array([view.site_from_camera.translation_m for view in solved.views])
    true = np.array([view.site_from_camera.translation_m for view in views])
    start = np.array([view.site_from_camera.translation_m for view in off])
    shape = places - places.mean(axis=0) - (true - true.mean(axis=0))
    before = start - start.mean(axis=0) - (true - true.mean(axis=0))
    assert np.sqrt((shape[:, :2] ** 2).sum(axis=1).mean()) < 0.25
    assert (shape**2).sum() < 0.3 * (before**2).sum()
    assert solved.residual_px < 0.5
    assert not camera_warnings(solved)
    loose = replace(solved, residual_px=0.6)  # as of a rolling shutter
    assert any("fit each other in space to 0.60 px only" in each for each in camera_warnings(loose))


def test_a_map_that_leans_on_a_slope_does_not_tilt_the_heights(survey) -> None:
    """A level map of a slope turns all cameras alike and puts them up and down: the fixes decide, not they."""
    views, pictures = survey
    lean = rotation_from_vector(np.array([[0.0, np.radians(6), 0.0]]))[0]
    off = [
        replace(
            view,
            site_from_camera=Pose(
                lean @ view.site_from_camera.rotation,
                view.site_from_camera.translation_m + np.array([0.0, 0.0, 1.2 * (number % 3 - 1)]),
            ),
        )
        for number, view in enumerate(views)
    ]
    solved = solve_tracks(off, find_tracks(off, lambda number: pictures[number]))
    axes = np.array(
        [
            (view.site_from_camera.rotation - true.site_from_camera.rotation)[:, 2]
            for view, true in zip(solved.views, views, strict=True)
        ]
    )
    assert np.degrees(np.linalg.norm(axes.mean(axis=0))) < 1.0


def test_one_strip_is_named_as_weak(survey) -> None:
    views, pictures = survey
    solved = solve_tracks(views[:4], find_tracks(views[:4], lambda number: pictures[number]))
    assert any("one strip" in each for each in camera_warnings(solved))


def test_what_was_found_before_is_not_sought_again(survey) -> None:
    """Two looks at more and more of a flight end in the points that one look at all of it finds."""
    views, pictures = survey
    before, opened = Matches(), list[int]()

    def gray(number: int) -> ImageGray:
        opened.append(number)
        return pictures[number]

    first, whole = find_tracks(views[:4], gray, before), find_tracks(views[:6], gray, before)
    assert first.count > 50 and opened == [*range(6)]
    alone = find_tracks(views[:6], lambda number: pictures[number])
    for field in ("view", "point", "seen"):
        np.testing.assert_array_equal(getattr(whole, field), getattr(alone, field))
    before.shared.clear()
    assert find_tracks(views[:6], gray, before).count == whole.count and len(opened) == 6


def test_an_oblique_orbit_is_named_as_weak() -> None:
    views = tuple(
        replace(
            view,
            site_from_camera=Pose(
                rotation_from_vector(np.array([[0.7, 0.0, 0.0]]))[0]
                @ view.site_from_camera.rotation,
                view.site_from_camera.translation_m,
            ),
        )
        for view in survey_views()
    )
    solved = Cameras3D(views, (), np.zeros((1, 3)), 0.5, 1.0, (0.0, 0.0), np.full(3, 0.1), 100)
    assert any("off the vertical" in each for each in camera_warnings(solved))


def test_pictures_without_common_points_are_refused() -> None:
    views = survey_views(strips=2, photos=2, side_px=320)
    rng = np.random.default_rng(0)
    noise = [rng.integers(0, 255, (240, 320), dtype=np.uint8) for _ in views]
    with pytest.raises(InputError, match="overlap"):
        solve_tracks(views, find_tracks(views, lambda number: noise[number]))


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_an_attitude_of_the_map_pulls_a_camera_back_about_each_axis(axis: int) -> None:
    upright = scene().rotations[:1]
    turn = 0.01 * np.eye(3)[axis]
    priors = Priors(np.zeros((1, 3)), np.full((1, 3), np.inf), upright)
    turned = replace(
        scene(), rotations=rotation_from_vector(turn[None]) @ upright, centres_m=np.zeros((1, 3))
    )
    system, gradient = np.zeros((6, 6)), np.zeros(6)
    _add_priors(
        turned, priors, AdjustmentSettings(attitude_sigma_deg=np.degrees(1.0)), system, gradient
    )
    np.testing.assert_allclose(gradient, [*-turn, 0, 0, 0], atol=1e-6)
