"""People below crowns: views of a made-up forest put together on its floor."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
from thermal_forest import Forest, fly, make_forest, photograph

from sorvolo.canopy.finds import Finds, find_people, look_under_trees
from sorvolo.canopy.integral import (
    Floor,
    UnderTrees,
    against_surroundings,
    focus,
    integrate,
    levelled,
)
from sorvolo.errors import InputError
from sorvolo.geometry.camera import Camera
from sorvolo.heights.lattice import Lattice
from sorvolo.heights.views import View

_CELL_M = 0.12
_SIDE = 250
_LATTICE = Lattice(
    np.array([[_CELL_M, 0, -15], [0, -_CELL_M, 15], [0, 0, 1]]), _SIDE, _SIDE, _CELL_M
)
_FLOOR_M = -3.0
_PEOPLE_M = np.array([[-6.0, -4.0], [5.0, 6.0], [7.0, -7.0]])


@pytest.fixture(scope="module")
def forest() -> Forest:
    return make_forest(5, 60, 2.5, _PEOPLE_M, _FLOOR_M)


@pytest.fixture(scope="module")
def views(forest: Forest) -> list[View]:
    return fly(forest, np.arange(-12, 13, 4.0), np.arange(-14, 15, 2.0))


@pytest.fixture(scope="module")
def pictures(forest: Forest, views: list[View]) -> list[np.ndarray]:
    return [levelled(photograph(forest, view)) for view in views]


@pytest.fixture(scope="module")
def looked(views: list[View], pictures: list[np.ndarray]) -> tuple[UnderTrees, Floor, Finds]:
    return look_under_trees(views, pictures.__getitem__, _LATTICE, -9.0, 7.0)


def test_all_people_are_found_and_nothing_else(looked: tuple[UnderTrees, Floor, Finds]) -> None:
    places_m = np.array([each.place_m[:2] for each in looked[2].people])
    assert len(places_m) == len(_PEOPLE_M)
    away_m = np.linalg.norm(places_m[:, None] - _PEOPLE_M, axis=2).min(axis=0)
    assert away_m.max() < 0.5


def test_single_pictures_show_less_than_the_integral(
    looked: tuple[UnderTrees, Floor, Finds], forest: Forest, pictures: list[np.ndarray]
) -> None:
    hidden = np.mean([photograph(replace(forest, ground=forest.ground * 0), view) > 60
                      for view in fly(forest, np.array([0.0]), np.array([0.0]))])  # fmt: skip
    assert hidden > 0.3
    single = np.std(against_surroundings(pictures[0][..., None].astype(np.float32), _CELL_M))
    assert np.nanstd(looked[0].contrast) < single / 3


def test_focus_states_the_floors_height(looked: tuple[UnderTrees, Floor, Finds]) -> None:
    off_m = looked[1].on(_LATTICE) - _FLOOR_M
    assert np.sqrt(np.mean(off_m**2)) < 1.0
    assert 0.0 < np.median(looked[1].sigma_m) < 2.0


def test_what_is_sharp_by_chance_below_the_floor_is_no_floor() -> None:
    bodies_m = np.array([[-4.0, -3.0], [4.0, 5.0]])
    wood = make_forest(2, 50, 3.0, bodies_m, _FLOOR_M)
    camera = Camera.from_angle_of_view(256, 256, 50)
    views = fly(wood, np.arange(-9, 10, 4.5), np.arange(-9, 10, 3.0), seed=2, camera=camera)
    pictures = [levelled(photograph(wood, view)) for view in views]
    coarse = Lattice(np.array([[0.15, 0, -12], [0, -0.15, 12], [0, 0, 1]]), 160, 160, 0.15)
    floor = focus(views, pictures.__getitem__, coarse, -28.0, 7.0)
    assert abs(np.median(floor.up_m) - _FLOOR_M) < 1.0


def test_warm_leaves_in_a_crown_are_no_people(
    forest: Forest, views: list[View], pictures: list[np.ndarray]
) -> None:
    """A hot spot 25 m up, seen by many views."""
    hot = replace(
        forest, ground=forest.ground * 0, leaves=np.array([[0, 0, _FLOOR_M + 25, 0.5, 250]])
    )
    seen = [
        np.maximum(levelled(photograph(hot, view)), picture)
        for view, picture in zip(views, pictures)
    ]
    floor_m = np.full(_LATTICE.shape, _FLOOR_M, np.float32)
    under = integrate(views, seen.__getitem__, _LATTICE, floor_m)
    assert len(find_people(under, views, seen.__getitem__).people) == len(_PEOPLE_M)


def test_one_strip_straight_on_a_spot_names_no_person(
    forest: Forest, views: list[View], pictures: list[np.ndarray]
) -> None:
    """Views from one place keep what is above the floor sharp at every height."""
    near = [replace(views[52], name=f"{k:03d}.jpg") for k in range(30)]
    floor_m = np.full(_LATTICE.shape, _FLOOR_M, np.float32)
    under = integrate(near, lambda _: pictures[52], _LATTICE, floor_m)
    found = find_people(under, near, lambda _: pictures[52])
    assert not found.people
    with pytest.raises(InputError, match="into focus"):
        focus(near[:1], lambda _: pictures[52], _LATTICE, -9.0, 7.0)


def test_water_which_shows_nothing_twice_has_no_floor(views: list[View]) -> None:
    draw = np.random.default_rng(3)
    waves = [levelled(np.clip(draw.normal(90, 4, (512, 512)), 0, 255)) for _ in views]
    with pytest.raises(InputError, match="shows nothing \\(water\\)"):
        focus(views, waves.__getitem__, _LATTICE, -9.0, 7.0)


def test_ground_that_too_few_views_show_is_not_called_empty() -> None:
    bare = make_forest(5, 60, 0.0, _PEOPLE_M, _FLOOR_M)
    views = fly(bare, np.arange(-12, 13, 6.0), np.arange(-12, 13, 8.0))
    pictures = [levelled(photograph(bare, view)) for view in views]
    with pytest.raises(InputError, match="more than 20 pictures, 24 are needed"):
        look_under_trees(views, pictures.__getitem__, _LATTICE, -9.0, 7.0)


def test_cameras_a_metre_off_show_nobody(views: list[View], pictures: list[np.ndarray]) -> None:
    draw = np.random.default_rng(3)
    off = [
        replace(
            view,
            site_from_camera=replace(
                view.site_from_camera,
                translation_m=view.site_from_camera.translation_m + draw.normal(0, 1.5, 3),
            ),
        )
        for view in views
    ]
    floor_m = np.full(_LATTICE.shape, _FLOOR_M, np.float32)
    found = find_people(
        integrate(off, pictures.__getitem__, _LATTICE, floor_m), off, pictures.__getitem__
    )
    assert not found.people


def test_an_odd_colour_is_found_that_is_neither_bright_nor_dark() -> None:
    draw = np.random.default_rng(2)
    bare = make_forest(5, 60, 0.0, _PEOPLE_M[:0], _FLOOR_M)
    views = fly(bare, np.arange(-12, 13, 4.0), np.arange(-12, 13, 4.0))
    warm = replace(make_forest(5, 60, 0.0, _PEOPLE_M, _FLOOR_M), leaves=bare.leaves)
    colour = []
    for view in views:
        body = photograph(warm, view).astype(int) - photograph(bare, view)
        green = np.clip(draw.normal(100, 4, body.shape) - body // 2, 0, 255)
        red = np.clip(draw.normal(100, 4, body.shape) + body // 2, 0, 255)
        colour.append(levelled(np.dstack([red, green, np.full_like(red, 80)])))
    floor_m = np.full(_LATTICE.shape, _FLOOR_M, np.float32)
    under = integrate(views, colour.__getitem__, _LATTICE, floor_m)
    assert len(find_people(under, views, colour.__getitem__).people) == len(_PEOPLE_M)


@pytest.fixture(autouse=True)
def _no_warnings() -> None:
    warnings.simplefilter("error", RuntimeWarning)
