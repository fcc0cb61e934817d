"""Heights, bare ground and orthophoto against a scene whose height is known everywhere."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scenes import HOUSE, hills, hills_with_houses, photo, survey_views, texture

from sorvolo.geometry.geodesy import Geodetic
from sorvolo.geometry.grid import SiteGrid
from sorvolo.geometry.pose import NADIR_CAMERA_NORTH_UP, Pose
from sorvolo.heights.borders import beyond_borders
from sorvolo.heights.figures import (
    PointJudgement,
    relief_picture,
    surface_figures,
    surface_warnings,
)
from sorvolo.heights.free_space import seen_through
from sorvolo.heights.lattice import Lattice
from sorvolo.heights.obstacles import Obstacles
from sorvolo.heights.orthophoto import choose_photos, paint_orthophoto, visible
from sorvolo.heights.smooth_sigma import SmoothSigma
from sorvolo.heights.surface import Surface, sizes_m, sweep_surface
from sorvolo.heights.sweep import SweepSettings, choose_views
from sorvolo.heights.terrain import closed, filled, terrain
from sorvolo.heights.views import inside
from sorvolo.kernels import path_costs
from sorvolo.registration.features import gray_from_rgb

ORIGIN, CRS = Geodetic(46.0, -91.0, 100.0), "EPSG:32615"


@pytest.fixture(scope="module")
def survey():
    views, look = survey_views(side_px=320), texture()
    return views, [photo(view, hills_with_houses, look) for view in views], look


@pytest.fixture(scope="module")
def surface(survey) -> Surface:
    views, pictures, _ = survey
    gsd_m = 30 / views[0].camera.fx_px
    lattice = Lattice.over(np.array([[-12.0, -10], [12, 11]]), SiteGrid.at(ORIGIN, gsd_m, CRS))

    def gray(number: int, size_m: float):
        picture, scale = gray_from_rgb(pictures[number]), min(1.0, gsd_m / size_m)
        return cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)

    points = lattice.points_m().reshape(-1, 2)[::300]
    points = np.column_stack([points, hills_with_houses(*points.T)])
    *shares, found = sweep_surface(lattice, views, gray, points, SmoothSigma())
    assert shares[-1] == 1.0 and np.all(np.diff(shares) > 0)
    assert isinstance(found, Surface)
    return found


def true_heights(lattice: Lattice):
    points = lattice.points_m()
    return hills_with_houses(points[..., 0], points[..., 1])


def away_from_edges(true) -> np.ndarray:
    edges = cv2.Laplacian(true.astype(np.float32), -1) ** 2 > 0.04
    return cv2.dilate(edges.astype(np.uint8), np.ones((17, 17), np.uint8)) == 0


def test_heights_are_right_to_two_pixels_and_their_sigma_is_honest(surface: Surface) -> None:
    true = true_heights(surface.lattice)
    off, known = surface.up_m - true, np.isfinite(surface.up_m)
    assert known.mean() > 0.98
    calm = known & away_from_edges(true)
    assert np.sqrt((off[calm] ** 2).mean()) < 1.0 * surface.lattice.cell_m  # a cell is a pixel here
    inside = np.abs(off[known]) < 2 * surface.sigma_m[known]
    assert inside.mean() > 0.9


def test_the_roof_has_its_height(surface: Surface) -> None:
    points = surface.lattice.points_m()
    west, south, east, north, tall = HOUSE
    roof = (
        (points[..., 0] > west + 1)
        & (points[..., 0] < east - 1)
        & (points[..., 1] > south + 1)
        & (points[..., 1] < north - 1)
    )
    floor = float(hills(np.array((west + east) / 2), np.array((south + north) / 2)))
    assert np.nanmedian(surface.up_m[roof]) == pytest.approx(floor + tall, abs=0.1)


def test_the_ground_beside_walls_is_not_as_high_as_the_roof(surface: Surface) -> None:
    points = surface.lattice.points_m()
    x, y = points[..., 0], points[..., 1]
    west, south, east, north, _ = HOUSE
    near = (x > west - 2) & (x < east + 2) & (y > south - 2) & (y < north + 2)
    beside = near & ~((x > west - 0.4) & (x < east + 0.4) & (y > south - 0.4) & (y < north + 0.4))
    off = surface.up_m - true_heights(surface.lattice)
    # 76 cells were up to 5 m too high and 76 without height, when photos counted from which the house hides it
    assert (np.abs(off[beside]) > 1).sum() < 20
    assert np.isnan(off[beside]).sum() < 40


def test_bare_ground_is_what_the_houses_stand_on(surface: Surface) -> None:
    ground, shows = terrain(surface.lattice, surface.up_m)
    points = surface.lattice.points_m()
    off = ground - hills(points[..., 0], points[..., 1])
    assert np.sqrt((off**2).mean()) < 0.4
    west, south, east, north, _ = HOUSE
    roof = (
        (points[..., 0] > west + 1)
        & (points[..., 0] < east - 1)
        & (points[..., 1] > south + 1)
        & (points[..., 1] < north - 1)
    )
    assert not shows[roof].any() and shows.mean() > 0.6


def test_holes_are_closed_from_around() -> None:
    plane = np.add.outer(np.arange(40.0), np.zeros(50)).astype(np.float32)
    known = np.ones(plane.shape, bool)
    known[15:20, 20:28] = False
    closed = filled(np.where(known, plane, np.nan), known)
    assert np.abs(closed - plane).max() < 2.0
    np.testing.assert_array_equal(closed[known], plane[known])
    assert np.isfinite(filled(np.full((8, 8), np.nan), np.zeros((8, 8), bool))).all()


def test_a_wall_hides_the_ground_behind_it() -> None:
    view = survey_views(strips=1, photos=1)[0]
    lattice = Lattice.over(np.array([[-12.0, -10], [12, 11]]), SiteGrid.at(ORIGIN, 0.2, CRS))
    up_m = np.zeros(lattice.shape, np.float32)
    points = lattice.points_m()
    x, y = points[..., 0], points[..., 1]
    eye = view.site_from_camera.translation_m
    up_m[(x > 5) & (x < 6) & (np.abs(y) < 3)] = 6.0
    seen = visible(lattice, up_m, view)
    # the shadow of the wall's far edge, seen from the eye, reaches to 6 + 6 (6 - eye) / (eye up - 6)
    reach = 6 + 6 * (6 - eye[0]) / (eye[2] - 6)
    behind = (x > 6.3) & (x < reach - 0.8) & (np.abs(y) < 2)
    assert not seen[behind].any()
    assert seen[(x > reach + 0.8) & (np.abs(y) < 2)].all()
    assert seen[x < 4.5].all()


def test_a_piece_that_photos_see_through_is_found_and_the_house_is_not(survey) -> None:
    views, pictures, _ = survey
    lattice = Lattice.over(np.array([[-12.0, -10], [12, 11]]), SiteGrid.at(ORIGIN, 0.2, CRS))
    true = true_heights(lattice).astype(np.float32)
    x, y = np.moveaxis(lattice.points_m(), 2, 0)
    beside = (np.abs(x + 1) < 3) & (y > 1.2) & (y < 2.6)  # a match by chance, higher than the house
    wrong = np.where(beside, np.float32(8), true)

    def found_in(up_m: np.ndarray) -> np.ndarray:
        def gray(number: int) -> np.ndarray:
            return gray_from_rgb(pictures[number])

        return seen_through(lattice, up_m, views, gray, 60, SweepSettings(window_cells=(3, 7)))

    assert found_in(true).mean() < 0.002
    found = found_in(wrong)
    assert found[beside].all() and found[~beside].mean() < 0.001


def test_single_cells_of_a_wide_roof_that_photos_see_through_are_found(survey) -> None:
    views, pictures, _ = survey
    lattice = Lattice.over(np.array([[-12.0, -10], [12, 11]]), SiteGrid.at(ORIGIN, 0.2, CRS))
    true = true_heights(lattice).astype(np.float32)
    x, y = np.moveaxis(lattice.points_m(), 2, 0)
    west, south, east, north, tall = HOUSE
    beside = (
        (x > east) & (x < east + 1.5) & (y > south) & (y < north)
    )  # the roof goes on: one piece with it
    roof = (x > west) & (x < east) & (y > south) & (y < north)
    floor = float(hills(np.array((west + east) / 2), np.array((south + north) / 2)))
    wrong = np.where(beside, np.float32(floor + tall), true)
    found = seen_through(
        lattice,
        wrong,
        views,
        lambda number: gray_from_rgb(pictures[number]),
        60,
        SweepSettings(window_cells=(3, 7)),
    )
    assert found[beside].mean() > 0.5
    assert found[roof].mean() < 0.02 and found[~beside & ~roof].mean() < 0.01


def test_a_photo_of_which_no_cell_can_be_compared_sees_through_nothing(survey) -> None:
    """Photos from very different heights may show the same ground and yet look alike nowhere (a crash before)."""
    views, _, _ = survey
    lattice = Lattice.over(np.array([[-12.0, -10], [12, 11]]), SiteGrid.at(ORIGIN, 0.2, CRS))
    true = true_heights(lattice).astype(np.float32)
    black = np.zeros((views[0].camera.height_px, views[0].camera.width_px), np.uint8)
    assert not seen_through(
        lattice, true, views, lambda _: black, 60, SweepSettings(window_cells=(3, 7))
    ).any()


def _wall(lattice: Lattice) -> np.ndarray:
    """The heights of a wall of 6 m on level ground."""
    x, y = np.moveaxis(lattice.points_m(), 2, 0)
    return np.where((x > 5) & (x < 7) & (np.abs(y) < 3), np.float32(6), np.float32(0))


def test_what_patches_gave_to_a_roof_is_given_back_to_the_ground(survey) -> None:
    views, pictures, _ = survey
    grays = [gray_from_rgb(each) for each in pictures]
    lattice = Lattice.over(
        np.array([[-12.0, -10], [12, 11]]), SiteGrid.at(ORIGIN, 30 / views[0].camera.fx_px, CRS)
    )
    true = true_heights(lattice).astype(np.float32)
    points = lattice.points_m()
    bare = hills(points[..., 0], points[..., 1])
    stands = true - bare > 1
    wide = cv2.dilate(stands.astype(np.uint8), np.ones((13, 13), np.uint8)) > 0
    given = wide & ~stands
    model = np.where(given, cv2.dilate(true, np.ones((13, 13), np.uint8)), true).astype(np.float32)
    ground = beyond_borders(lattice, model, views, lambda i: grays[i], 150, SweepSettings())
    moved = np.isfinite(ground)
    assert moved[given].mean() > 0.9
    inner = cv2.erode(stands.astype(np.uint8), np.ones((9, 9), np.uint8)) > 0
    assert (
        moved[stands].mean() < 0.2 and not moved[inner].any()
    )  # the border is right to some two cells
    assert not moved[~wide].any()
    assert np.abs(ground[moved & given] - bare[moved & given]).max() < 0.3


def test_right_borders_stay(survey) -> None:
    views, pictures, _ = survey
    grays = [gray_from_rgb(each) for each in pictures]
    lattice = Lattice.over(
        np.array([[-12.0, -10], [12, 11]]), SiteGrid.at(ORIGIN, 30 / views[0].camera.fx_px, CRS)
    )
    true = true_heights(lattice).astype(np.float32)
    stands = true - hills(lattice.points_m()[..., 0], lattice.points_m()[..., 1]) > 1
    ground = beyond_borders(lattice, true, views, lambda i: grays[i], 150, SweepSettings())
    assert np.isfinite(ground).sum() < 0.05 * stands.sum()


def test_a_camera_does_not_see_the_ground_behind_what_stands() -> None:
    view = survey_views(strips=1, photos=1)[0]
    lattice = Lattice.over(np.array([[-12.0, -10], [14, 11]]), SiteGrid.at(ORIGIN, 0.2, CRS))
    eye_m = view.site_from_camera.translation_m
    hidden_m = Obstacles(lattice, _wall(lattice)).hidden_below_m(lattice, eye_m)
    assert hidden_m is not None
    x, y = np.moveaxis(lattice.points_m(), 2, 0)
    away = 7 + 1.0  # a metre behind the wall the line of sight over it is so high
    line_m = 6 - (eye_m[2] - 6) * (away - 7) / (7 - eye_m[0])
    at = (np.abs(x - away) < 0.2) & (np.abs(y) < 1)
    assert hidden_m[at].mean() == pytest.approx(line_m - 0.3, abs=0.7)  # 0.3 m: the margin
    assert np.isneginf(hidden_m[x < 4.5]).all() and np.isneginf(hidden_m[np.abs(y) > 6]).all()


def test_what_hides_nothing_is_not_asked_about() -> None:
    view = survey_views(strips=1, photos=1)[0]
    lattice = Lattice.over(np.array([[-12.0, -10], [14, 11]]), SiteGrid.at(ORIGIN, 0.2, CRS))
    level = Obstacles(lattice, np.zeros(lattice.shape, np.float32))
    assert level.hidden_below_m(lattice, view.site_from_camera.translation_m) is None


def test_only_what_stands_everywhere_around_stands_surely() -> None:
    lattice = Lattice.over(np.array([[-12.0, -10], [14, 11]]), SiteGrid.at(ORIGIN, 0.2, CRS))
    up_m = _wall(lattice)
    holes = lattice.points_m()[..., 1] > 8
    up_m[holes] = np.nan
    sure = Obstacles.surely(lattice, up_m, 7)
    assert np.isfinite(sure.up_m).all() and (sure.up_m == 0)[holes].all()
    known = ~holes
    assert (sure.up_m[known] <= up_m[known]).all()
    assert 0 < (sure.up_m == 6).sum() < (up_m == 6).sum()
    nothing = Obstacles.surely(lattice, np.full(lattice.shape, np.nan, np.float32), 7)
    assert np.isfinite(nothing.up_m).all()


def test_photos_that_see_the_ground_beside_a_house_are_chosen(survey) -> None:
    views, _, _ = survey
    lattice = Lattice.over(np.array([[-12.0, -10], [12, 11]]), SiteGrid.at(ORIGIN, 0.2, CRS))
    obstacles = Obstacles(lattice, true_heights(lattice).astype(np.float32))
    places, shown = obstacles.shown(lattice, views)
    level = np.array([inside(view.pixels_from_site(places), view.camera) for view in views])
    assert (shown <= level).all() and (level & ~shown).sum() > 20
    chosen = choose_views(lattice, views, 0.0, 4, obstacles)
    assert (shown[chosen].sum(axis=0) < np.minimum(shown.sum(axis=0), 2)).mean() < 0.1


def test_photos_are_chosen_from_above(survey) -> None:
    views, _, _ = survey
    lattice = Lattice.over(np.array([[-12.0, -10], [12, 11]]), SiteGrid.at(ORIGIN, 0.2, CRS))
    labels = choose_photos(lattice, np.zeros(lattice.shape, np.float32), views)
    eyes = np.array([view.site_from_camera.translation_m[:2] for view in views])
    away = np.linalg.norm(lattice.points_m()[:, :, None] - eyes, axis=3)
    chosen = np.take_along_axis(away, np.maximum(labels, 0)[..., None].astype(int), axis=2)[..., 0]
    assert (labels >= 0).all()
    assert np.median(chosen - away.min(axis=2)) < 1.0


def test_the_orthophoto_shows_roofs_and_ground_in_their_place(survey, surface: Surface) -> None:
    """Against the ground's own picture; laid on level ground the roof would lean outwards."""
    views, pictures, look = survey
    site_grid = SiteGrid.at(ORIGIN, 30 / views[0].camera.fx_px, CRS)
    whole = closed(surface.lattice, surface.up_m, terrain(surface.lattice, surface.up_m)[0])
    tiles = {
        index: rgba
        for index, rgba, _ in paint_orthophoto(
            surface.lattice, whole, site_grid, views, lambda k: pictures[k]
        )
    }
    lattice = surface.lattice
    picture = np.zeros((*lattice.shape, 4), np.uint8)
    first = lattice.first
    for (column, row), rgba in tiles.items():
        for y in range(512):
            at = row * 512 + y - first[1]
            x0 = column * 512 - first[0]
            if 0 <= at < lattice.height:
                left, right = max(0, x0), min(lattice.width, x0 + 512)
                if left < right:
                    picture[at, left:right] = rgba[y, left - x0 : right - x0]
    points = lattice.points_m()
    true = look(points[..., 0], points[..., 1])
    west, south, east, north, _ = HOUSE
    inner = (slice(20, -20), slice(20, -20))
    assert (picture[inner][..., 3] == 255).mean() > 0.99
    roof = (
        (points[..., 0] > west + 0.6)
        & (points[..., 0] < east - 0.6)
        & (points[..., 1] > south + 0.6)
        & (points[..., 1] < north - 0.6)
    )
    x, y = np.flatnonzero(roof.any(axis=0)), np.flatnonzero(roof.any(axis=1))
    piece = slice(y[0], y[-1] + 1), slice(x[0], x[-1] + 1)
    shift, likeness = cv2.phaseCorrelate(
        cv2.cvtColor(picture[piece][..., :3], cv2.COLOR_RGB2GRAY).astype(np.float32),
        cv2.cvtColor(np.clip(true[piece], 0, 255).astype(np.uint8), cv2.COLOR_RGB2GRAY).astype(
            np.float32
        ),
    )
    assert np.hypot(*shift) < 1.0 and likeness > 0.3


def test_smoothing_keeps_a_step_and_drops_a_lone_cell() -> None:
    cost = np.ones((9, 6, 12), np.float32)
    for row in range(9):
        for column in range(12):
            cost[row, 1 if column < 6 else 4, column] = 0.2
    cost[4, 1, 3], cost[4, 5, 3] = 0.5, 0.3
    best = path_costs(cost, 0.1, 0.5).argmin(axis=1)
    assert (best[:, :6] == 1).all() and (best[:, 6:] == 4).all()


def test_heights_as_a_picture_have_holes(surface: Surface) -> None:
    up_m = surface.up_m.copy()
    up_m[:10] = np.nan
    picture = relief_picture(Surface(surface.lattice, up_m, surface.sigma_m, surface.covered))
    assert (picture[:9, :, 3] == 0).all() and (picture[12:, :, 3] == 255).mean() > 0.95


def test_water_and_oblique_views_are_named(surface: Surface) -> None:
    """Half of the ground without texture, as water is, gets holes that the report names."""
    up_m = surface.up_m.copy()
    up_m[:, : up_m.shape[1] // 2] = np.nan
    half = Surface(surface.lattice, up_m, surface.sigma_m, np.ones(up_m.shape, bool))
    assert any("water" in each for each in surface_warnings(half))
    assert not surface_warnings(
        Surface(surface.lattice, surface.up_m, surface.sigma_m, np.isfinite(surface.up_m))
    )
    figures = surface_figures(half, np.zeros(up_m.shape, bool), PointJudgement(7))
    assert figures["own_points"]["points"] == 7 and figures["own_points"]["within_2_sigma"] is None
    assert 0.45 < figures["holes_share"] < 0.6


def test_ground_without_texture_is_a_hole_or_unsure(survey) -> None:
    """Photos that are grey all over agree at every height: no height comes of them."""
    views, _, _ = survey
    lattice = Lattice.over(np.array([[-3.0, -3], [3, 3]]), SiteGrid.at(ORIGIN, 0.2, CRS))
    grey = np.full((240, 320), 128, np.uint8)
    places = lattice.points_m().reshape(-1, 2)[::50]
    points = np.column_stack([places, np.zeros(len(places))])
    *_, found = sweep_surface(lattice, views, lambda number, size_m: grey, points, SmoothSigma())
    assert isinstance(found, Surface) and np.isnan(found.up_m).all()


def kerbs_and_a_house(x, y):
    """Level ground with a house of 6 m at the south rim of what a strip along x sees."""
    return np.where((np.abs(x) < 4) & (y < -9), 6.0, 0.0)


@pytest.fixture(scope="module")
def one_strip() -> Surface:
    """Heights of one strip along x, over lines along x too: nothing but texture between them shows the height."""
    views, look = survey_views(strips=1, photos=5, side_px=320), texture()

    def kerbs(x, y):
        lines = (np.abs(y - 5.0) < 0.25) | (np.abs(y + 3.0) < 0.25)
        return np.where(lines[..., None], 235.0, 0.6 * look(x, y))

    pictures = [photo(view, kerbs_and_a_house, kerbs, 6.3, -0.1) for view in views]
    gsd_m = 30 / views[0].camera.fx_px
    lattice = Lattice.over(np.array([[-14.0, -14], [14, 10]]), SiteGrid.at(ORIGIN, gsd_m, CRS))

    def gray(number: int, size_m: float):
        picture, scale = gray_from_rgb(pictures[number]), min(1.0, gsd_m / size_m)
        return cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)

    points = np.array([[0.0, 0, 0], [3, 3, 0], [0, -10, 6]])
    *_, found = sweep_surface(lattice, views, gray, points, SmoothSigma())
    assert isinstance(found, Surface)
    return found


def test_an_edge_along_the_flight_is_no_evidence_of_height(one_strip: Surface) -> None:
    """It fits itself at every height, and would pull the ground beside it up into a ramp."""
    points = one_strip.lattice.points_m()
    x, y = points[..., 0], points[..., 1]
    ground = (y > -6) & (y < 7) & (np.abs(x) < 6)
    known = ground & np.isfinite(one_strip.up_m)
    assert known.sum() > 0.97 * ground.sum()
    assert np.abs(one_strip.up_m[known]).max() < 0.6


def test_a_roof_that_reaches_out_of_the_photos_is_right_or_a_hole(one_strip: Surface) -> None:
    """The photos see less of the roof's height than of the ground's: beyond, no height is right."""
    points = one_strip.lattice.points_m()
    roof = (np.abs(points[..., 0]) < 2.5) & (points[..., 1] < -9.6)
    known = roof & np.isfinite(one_strip.up_m)
    assert 0.05 < known.sum() / roof.sum() < 0.9
    assert np.median(np.abs(one_strip.up_m[known] - 6)) < 0.3
    assert (np.abs(one_strip.up_m[known] - 6) > 1).mean() < 0.2


def test_a_pattern_that_repeats_fits_at_several_heights_and_is_a_hole() -> None:
    views = [
        replace(each, site_from_camera=Pose(NADIR_CAMERA_NORTH_UP, np.array([12.0 * k - 6, 0, 30])))
        for k, each in enumerate(survey_views(strips=1, photos=2, side_px=240))
    ]
    patch = np.random.default_rng(8).uniform(40, 215, (8, 4, 3)).astype(np.float32)
    side_m = 12 * 1.5 / (30 - 1.5)  # the photos lie alike on planes 1.5 m apart

    def tiles(x, y):
        return patch[
            np.floor(4 / side_m * y).astype(int) % 8, np.floor(4 / side_m * x).astype(int) % 4
        ]

    pictures = [photo(view, lambda x, y: 0 * x, tiles, 0.1, -0.1) for view in views]
    gsd_m = 30 / views[0].camera.fx_px
    lattice = Lattice.over(np.array([[-4.0, -4], [4, 4]]), SiteGrid.at(ORIGIN, gsd_m, CRS))

    def gray(number: int, size_m: float):
        picture, scale = gray_from_rgb(pictures[number]), min(1.0, gsd_m / size_m)
        return cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)

    points = np.array([[-1.0, 0, 0], [0, 1, 0], [1, -2, 0], [1, 2, 0.1]])
    holes, wrong = [], []
    for unsure_cells in (3.0, np.inf):
        given = lattice, views, gray, points, SmoothSigma()
        *_, found = sweep_surface(*given, unsure_cells=unsure_cells, island_cells=0)
        assert isinstance(found, Surface)
        holes.append(np.isnan(found.up_m).mean())
        wrong.append((np.abs(found.up_m) > 1).mean())
    assert holes[0] > 0.2 and holes[1] < 0.1 and wrong[0] < 0.7 * wrong[1], (holes, wrong)


@pytest.mark.parametrize(
    "step", [(1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (1, -1), (-1, 1), (-1, -1)]
)
def test_what_one_cell_knows_reaches_its_neighbours_in_all_eight_directions(step) -> None:
    """Semi-global matching: among cells that know nothing one is sure; straight paths from it carry its level."""
    cost = np.full((9, 6, 9), 0.5, np.float32)
    cost[4, :, 4], cost[4, 2, 4] = 1.0, 0.0
    best = path_costs(cost, 0.1, 0.5)
    row, column = 4 + 3 * step[0], 4 + 3 * step[1]
    assert best[row, :, column].argmin() == 2
    assert np.ptp(best[row, :, column]) > 0.2


def test_the_picture_of_heights_has_a_colour_for_each_height() -> None:
    lattice = Lattice.over(np.array([[0.0, 0], [10, 10]]), SiteGrid.at(ORIGIN, 0.1, CRS))
    rows, columns = lattice.points_m().shape[:2]
    up_m = np.tile(np.linspace(0, 5, rows, dtype=np.float32)[:, None], columns)
    slope = Surface(lattice, up_m, np.ones_like(up_m), np.ones(up_m.shape, bool))
    colours = relief_picture(slope)[:, 0, :3].astype(int)[:: rows // 8]
    assert np.abs(np.diff(colours, axis=0)).sum(axis=1).min() > 10


def test_what_heights_a_tile_has_is_looked_for_in_coarser_pictures() -> None:
    coarse_m, fine_m = sizes_m(0.1)
    assert coarse_m > fine_m == 0.1


def test_a_large_hole_is_closed_with_bare_ground_a_small_one_from_around() -> None:
    """Between a wood's crowns the ground is not half as high as these."""
    lattice = Lattice.over(np.array([[-20.0, -20], [20, 20]]), SiteGrid.at(ORIGIN, 0.2, CRS))
    bare_m = np.full(lattice.shape, 3.0, np.float32)
    up_m = bare_m + np.float32(8)
    middle = lattice.height // 2, lattice.width // 2
    up_m[middle[0] - 60 : middle[0] + 60, middle[1] - 60 : middle[1] + 60] = np.nan
    up_m[10:12, 10:12] = np.nan
    whole = closed(lattice, up_m, bare_m)
    assert abs(whole[middle] - 3) < 0.1
    assert np.abs(whole[10:12, 10:12] - 11).max() < 0.1
    known = np.isfinite(up_m)
    np.testing.assert_array_equal(whole[known], up_m[known])
