"""Ground that changed as an area is one change with its outline; what light does to the same ground is none."""

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
import pytest

from sorvolo.change.areas import (
    AreaMap,
    GroundSigns,
    leaning,
    level_of,
    segments,
)
from sorvolo.change.ground import GroundPictures
from sorvolo.change.outlines import overlap
from sorvolo.change.patches import PatchWindow, cut
from sorvolo.change.reconcile import with_areas
from sorvolo.lab.simulation.ground import GroundKind, paint_ground
from sorvolo.lab.simulation.ground_painting import GroundArea
from sorvolo.survey.findings import Change, ChangeKind, ComparedView, Patch

M_PER_PX = 0.05
VIEW_PX = 640, 480  # 32 x 24 m
REPAVED_M = np.array([[22.0, -18.0], [42.0, -18.0], [42.0, -28.0], [22.0, -28.0]])  # 20 x 10 m

Rgb = np.ndarray


def painted(kind: GroundKind, seed: int) -> Rgb:
    """64 x 48 m of ground, north up, its north west corner at the site's origin."""
    return paint_ground(
        kind, GroundArea(0.0, -48.0, 64.0, 0.0), M_PER_PX, np.random.default_rng(seed)
    ).raster.rgb.copy()


@pytest.fixture(scope="module")
def grass() -> Rgb:
    return painted(GroundKind.COUNTRYSIDE, 1)


def same_light(image: Rgb, index: int) -> Rgb:
    return image


def changes_of(
    before: Rgb,
    after: Rgb,
    light: Callable[[Rgb, int], Rgb] = same_light,
) -> tuple[Change, ...]:
    """The areas that a flight of nine views finds; `light` gives a view's picture its light."""
    areas, rng = AreaMap(), np.random.default_rng(3)
    for index in range(9):
        x, y = 300 * (index % 3), 220 * (index // 3)
        part = np.s_[y : y + VIEW_PX[1], x : x + VIEW_PX[0]]
        seen = light(after[part], index).astype(float) + rng.normal(0, 2.0, (*VIEW_PX[::-1], 3))
        areas.add(
            view_of(
                before[part].copy(), np.clip(np.rint(seen), 0, 255).astype(np.uint8), index, x, y
            )
        )
    return areas.conclude("b", 7)


def view_of(before: Rgb, after: Rgb, index: int = 0, x: int = 0, y: int = 0) -> ComparedView:
    """A view whose top left pixel is pixel (x, y) of the ground."""
    site_from_image = np.array(
        [[M_PER_PX, 0, x * M_PER_PX], [0, -M_PER_PX, -y * M_PER_PX], [0, 0, 1.0]]
    )
    return ComparedView(
        index,
        f"{index}",
        index * 10**9,
        site_from_image,
        np.array([x * M_PER_PX + 16, -y * M_PER_PX - 12, 40.0]),
        after,
        before,
        np.ones(VIEW_PX[::-1], bool),
        np.zeros(VIEW_PX[::-1], np.uint8),
        np.zeros((0, 4), np.int64),
        np.zeros(0),
        0.4,
        np.zeros(VIEW_PX[::-1], np.uint8),
    )


def laid(ground: Rgb, other: Rgb, outline_m: np.ndarray) -> Rgb:
    """The ground with another one inside of an outline."""
    inside = np.zeros(ground.shape[:2], np.uint8)
    cv2.fillPoly(inside, [np.rint(outline_m / M_PER_PX * [1, -1]).astype(np.int32)], 255)
    share = cv2.GaussianBlur(inside, (0, 0), 1.0)[..., None] / 255.0
    return np.rint(ground * (1 - share) + other * share).astype(np.uint8)


@pytest.mark.parametrize("deep", [30, 120, 200])
def test_an_area_keeps_its_inside_however_far_from_unchanged_ground(deep):
    """A band of so many of 260 cells, flooded; light is looked for within 35 cells at first."""
    rng, shape = np.random.default_rng(1), (260, 260)
    is_wet = np.arange(shape[0])[:, None] < np.full(shape[1], deep)
    likeness = np.where(is_wet, 0.1, 0.85) + rng.normal(0, 0.03, shape)
    colour = rng.normal(0, 0.02, (*shape, 2)) + np.array([0.5, -0.4]) * is_wet[..., None]
    detail = rng.normal(0, 0.1, shape) - 2.0 * is_wet
    signs = GroundSigns(
        *(each.astype(np.float32) for each in (likeness, colour, detail, colour)),
        known=np.ones(shape, bool),
    )
    found = np.any([cells for cells, _ in segments(signs)], axis=0)
    assert found[is_wet].mean() > 0.97 and found[~is_wet].mean() < 0.05


@pytest.mark.parametrize("kind", [GroundKind.URBAN, GroundKind.DIRT])
def test_a_repaved_area_is_one_change_with_its_outline(grass, kind):
    (found,) = changes_of(grass, laid(grass, painted(kind, 2), REPAVED_M))
    assert found.kind is ChangeKind.AREA and found.id == "b-7" and found.score > 0.5
    union, _ = overlap(found.outline_m, REPAVED_M)
    assert union > 0.75
    assert found.area_m2 == pytest.approx(200, rel=0.25) and found.length_m == pytest.approx(
        20, rel=0.15
    )
    middle = found.patch.changed.shape[0] // 2, found.patch.changed.shape[1] // 2
    assert (
        found.patch.changed[middle]
        and found.patch.before[middle][3] == found.patch.after[middle][3] == 255
    )
    assert (
        np.abs(found.patch.before[middle][:3].astype(int) - found.patch.after[middle][:3]).max()
        > 15
    )


def test_what_is_no_larger_than_things_are_is_no_area(grass):
    """4 x 4 m is left to what finds things."""
    square_m = np.array([[22.0, -18.0], [26.0, -18.0], [26.0, -22.0], [22.0, -22.0]])
    after = laid(grass, painted(GroundKind.URBAN, 2), square_m)
    assert changes_of(grass, after) == ()


def test_an_area_far_larger_than_a_view_is_one_change(grass):
    road_m = np.array([[3.0, -18.0], [61.0, -26.0], [61.0, -34.0], [3.0, -26.0]])
    (found,) = changes_of(grass, laid(grass, painted(GroundKind.SAND, 2), road_m))
    assert overlap(found.outline_m, road_m)[0] > 0.8


@pytest.mark.parametrize(("most_px", "coarser"), [(2048, 1), (200, 2)])
def test_the_pictures_of_an_area_show_its_ground_where_it_lies(grass, most_px, coarser):
    view = view_of(grass[:480, :640].copy(), painted(GroundKind.SAND, 2)[:480, :640].copy())
    pictures = GroundPictures(0.1, side_px=32, most_patch_px=most_px)
    west, south, east, north = 3.3, -20.7, 28.1, -2.9
    squares_m = np.stack(
        np.meshgrid(np.arange(1.6, 32, 3.2), np.arange(-1.6, -27, -3.2)), axis=-1
    ).reshape(-1, 2)
    pictures.show(view, squares_m[3:])  # all but three in the north west
    patch = pictures.patch(np.array([[west, south], [east, south], [east, north], [west, north]]))
    rows, columns = patch.after.shape[:2]
    assert patch.m_per_px == pytest.approx(0.1 * coarser) and max(rows, columns) <= most_px
    fine = cut(view, PatchWindow(0.0, 0.0, 0.1, 320, 240))
    x, y = (
        patch.west_m + np.arange(columns) * patch.m_per_px,
        -patch.north_m + np.arange(rows) * patch.m_per_px,
    )
    near = [  # what the view shows there; a coarser pixel is one of those it covers
        np.ix_(
            np.rint(y / 0.1 + down).clip(0, 239).astype(int),
            np.rint(x / 0.1 + right).clip(0, 319).astype(int),
        )
        for down in range(coarser)
        for right in range(coarser)
    ]
    for found, wanted in ((patch.before, fine.before), (patch.after, fine.after)):
        known = found[..., 3] > 0
        np.testing.assert_array_equal(known, (x > 9.6 - 1e-6) | (y[:, None] > 3.2 - 1e-6))
        assert not found[~known].any()
        apart = [np.abs(found.astype(int) - wanted[each]).max(axis=-1) for each in near]
        assert np.min(apart, axis=0)[known].max() <= 1


def exposure(image: Rgb, index: int) -> Rgb:
    """Another gain, gamma and white balance in each view."""
    gain = np.array([1.0, 0.95, 0.85]) * (0.6 + 0.12 * index)
    return np.clip(255 * (image / 255.0) ** (0.8 + 0.05 * index) * gain, 0, 255)


def cloud(image: Rgb, index: int) -> Rgb:
    """A shadow of a cloud whose rim is metres wide moves through the views, and is bluer than the sun."""
    y, x = np.mgrid[: image.shape[0], : image.shape[1]]
    share = 1 / (1 + np.exp(-(np.hypot(x - 60 * index, y - 240) - 190) / 25.0))[..., None]
    return image * (share + (1 - share) * np.array([0.40, 0.44, 0.52]))


def evening(image: Rgb, index: int) -> Rgb:
    """The sun is lower and yellower, less so in one corner."""
    slope = np.linspace(0.55, 1.1, image.shape[1])[None, :, None]
    return np.clip(image * slope * [1.12, 1.0, 0.8], 0, 255)


def cast_shadow(image: Rgb, index: int) -> Rgb:
    """A wall's shadow with a sharp rim lies where it did not."""
    shaded = image.astype(float)
    shaded[120:330] *= [0.30, 0.34, 0.42]
    return shaded


@pytest.mark.parametrize("light", [exposure, cloud, evening, cast_shadow])
@pytest.mark.parametrize(
    "kind",
    [
        GroundKind.COUNTRYSIDE,
        pytest.param(GroundKind.DIRT, marks=pytest.mark.long),
        pytest.param(GroundKind.URBAN, marks=pytest.mark.long),
    ],
)
def test_light_is_no_change(kind, light):
    ground = painted(kind, 1)
    assert changes_of(ground, ground, light) == ()


@pytest.mark.parametrize("light", [exposure, cloud])
def test_an_area_is_found_in_other_light(grass, light):
    found = changes_of(grass, laid(grass, painted(GroundKind.URBAN, 2), REPAVED_M), light)
    assert len(found) == 1 and overlap(found[0].outline_m, REPAVED_M)[0] > 0.7


def test_the_last_bit_of_misalignment_is_no_change(grass):
    moved = np.roll(grass, (2, -2), axis=(0, 1))
    assert changes_of(grass, moved) == ()


def test_what_is_part_of_an_area_is_not_reported_beside_it(grass):
    (area,) = changes_of(grass, laid(grass, painted(GroundKind.URBAN, 2), REPAVED_M))
    ground = np.full((60, 60, 4), 255, np.uint8)
    ground[..., :3] = np.random.default_rng(0).normal(110, 8, (60, 60, 3)).clip(0, 255)
    inside = np.zeros((60, 60), bool)
    inside[20:40, 20:40] = True
    thing = ground.copy()
    thing[inside, :3] = 230
    plain = Patch(29.0, -21.0, 0.05, ground, ground, inside, np.zeros((60, 60), np.uint8))
    outline_m = np.array([[30.0, -22.0], [31.0, -22.0], [31.0, -23.0], [30.0, -23.0]])
    part = replace(area, id="b-1", kind=ChangeKind.REPLACED, outline_m=outline_m, patch=plain)
    car = replace(part, id="b-2", patch=replace(plain, after=thing))
    beside = replace(
        part,
        id="b-3",
        outline_m=outline_m + np.array([20.0, 0.0]),
        patch=replace(plain, west_m=49.0),
    )
    assert [each.id for each in with_areas([part, car, beside], [area])] == ["b-2", "b-3", "b-7"]
    asked = []
    found = with_areas(
        [part, car, beside], [area], lies_apart=lambda each: asked.append(each) or True
    )
    assert [each.id for each in found] == ["b-2", "b-3", "b-1", "b-7"] and len(asked) == 1
    assert asked[0] is part.outline_m
    stack = replace(car, id="b-4", outline_m=area.outline_m)
    assert [each.id for each in with_areas([stack], [area])] == ["b-4"]


def test_ground_that_leans_in_pictures_of_one_date_is_no_area(grass):
    """A crown that another photo of the same date shows elsewhere: the map shows one side of it, and no ground."""
    rng = np.random.default_rng(4)
    crown = (
        cv2.GaussianBlur(rng.normal(90, 60, (200, 200, 3)), (0, 0), 1.5)
        .clip(0, 255)
        .astype(np.uint8)
    )
    shown, other = (grass[:480, :640].copy() for _ in range(2))
    shown[100:300, 200:400] = crown
    other[100:300, 200:400] = crown[::-1]
    everywhere = np.ones((480, 640), bool)
    leans = leaning(level_of(shown), other, everywhere)
    assert leans[120:280, 220:380].mean() > 0.9 and leans[350:].mean() < 0.05
    assert leaning(level_of(shown), np.roll(shown, 1, axis=0), everywhere).mean() < 0.05
    smooth = np.full_like(shown, 120)
    assert not leaning(level_of(smooth), np.full_like(shown, 90), everywhere).any()
