"""Outlines of changed ground and the pictures around them."""

from dataclasses import replace

import numpy as np
import pytest
from blob_world import CAMERA_HEIGHT_M, Thing, view_of
from hypothesis import given
from hypothesis import strategies as st

from sorvolo.change.ground import CellWindow, EvidenceGrid, LaidView, lay
from sorvolo.change.outlines import (
    KnownPlace,
    is_known,
    mask_of,
    measures,
    outline_of,
    overlap,
)
from sorvolo.change.patches import PatchWindow, cut, moved
from sorvolo.survey.findings import ChangeKind

SITE_FROM_MASK = np.array([[0.1, 0, 5], [0, -0.1, 9], [0, 0, 1.0]])


def square(east, north, side=1.0):
    return np.array([east, north]) + side * np.array([[0, 0], [1, 0], [1, 1], [0, 1.0]])


@given(st.integers(1, 30), st.integers(1, 30), st.integers(1, 20), st.integers(1, 20))
def test_a_boxs_outline_has_its_area_and_place(x, y, w, h):
    mask = np.zeros((60, 60), bool)
    mask[y : y + h, x : x + w] = True
    outline_m = outline_of(mask, SITE_FROM_MASK, 0.5, 0)
    size = measures(outline_m)
    assert abs(size.area_m2 - 0.01 * w * h) <= 0.01 * 0.6 * (w + h) + 1e-9
    middle = SITE_FROM_MASK @ [x + (w - 1) / 2, y + (h - 1) / 2, 1]
    assert np.hypot(*(np.array(size.centre_m) - middle[:2])) < 0.06
    assert abs(size.length_m - 0.1 * max(w, h)) < 0.11


def test_no_pixels_have_no_outline():
    assert outline_of(np.zeros((4, 4), bool), SITE_FROM_MASK, 0.5, 3) is None


def test_pieces_that_nearly_touch_are_joined_and_specks_far_off_are_left_out():
    mask = np.zeros((80, 80), bool)
    mask[10:30, 10:20] = mask[10:30, 22:32] = mask[70, 70] = True
    size = measures(outline_of(mask, SITE_FROM_MASK, 0.5, 3))
    assert size.area_m2 == pytest.approx(0.1 * 0.1 * 20 * 22, rel=0.1)


def test_overlap_is_of_the_union_and_of_the_first():
    shared, own = overlap(square(0, 0, 1), square(0.5, 0, 1))
    assert shared == pytest.approx(1 / 3, abs=0.02) and own == pytest.approx(0.5, abs=0.02)
    assert overlap(square(0, 0), square(5, 5)) == (0, 0)
    assert overlap(square(0.4, 0.4, 0.2), square(0, 0, 1))[1] == pytest.approx(1, abs=0.02)


def test_a_known_place_needs_the_kind_and_most_of_the_area():
    place = KnownPlace(square(0, 0, 2), ChangeKind.APPEARED)
    assert is_known(square(0.1, 0.2, 1.5), ChangeKind.APPEARED, [place])
    assert not is_known(square(0.1, 0.2, 1.5), ChangeKind.DISAPPEARED, [place])
    assert not is_known(square(1.8, 1.8, 2), ChangeKind.APPEARED, [place])


def test_the_mask_of_an_outline_is_its_inside():
    outline_m = square(6, 7, 1)
    mask = mask_of(outline_m, SITE_FROM_MASK, (60, 60))
    assert np.count_nonzero(mask) == pytest.approx(100, abs=25)


def test_patch_windows_hold_the_thing_with_its_surroundings_and_stay_small():
    window = PatchWindow.around(np.array([0.0, 0.0]), np.array([1.0, 0.4]), 0.02, 512)
    assert window.holds(np.array([0.0, 0.0]), np.array([1.0, 0.4]))
    assert window.m_per_px == 0.02 and max(window.size_px) == pytest.approx(100, abs=2)
    large = PatchWindow.around(np.array([0.0, 0.0]), np.array([100.0, 80.0]), 0.02, 512)
    assert max(large.size_px) <= 512 and large.m_per_px > 0.3


def test_a_cut_shows_the_ground_at_its_place_and_nothing_where_nothing_is_known():
    view = view_of(
        0, 0, (0, 0, CAMERA_HEIGHT_M), [Thing(1, 1, colour=(250, 0, 0))], hole_m=(-3, -3, 0, 3)
    )
    window = PatchWindow.around(np.array([0.0, 0.0]), np.array([2.0, 2.0]), 0.05, 512)
    pictures = cut(view, window)
    inside = mask_of(
        square(0.6, 0.6, 0.8), window.site_from_patch, (window.height_px, window.width_px)
    )
    assert (
        np.median(pictures.after[inside][:, 0]) > 240
        and np.median(pictures.before[inside][:, 0]) < 200
    )
    unknown = mask_of(
        square(-0.9, 0.2, 0.8), window.site_from_patch, (window.height_px, window.width_px)
    )
    assert (pictures.after[unknown] == 0).all() and (pictures.after[inside][:, 3] == 255).all()


def test_rasters_move_between_windows_without_loss():
    small = PatchWindow(1.0, 3.0, 0.05, 20, 30)
    large = PatchWindow(0.5, 3.5, 0.05, 60, 60)
    picture = np.random.default_rng(0).integers(1, 255, (30, 20)).astype(np.uint8)
    assert np.array_equal(moved(picture, large, small)[10:40, 10:30], picture)


def laid_of(flags, seen, window):
    nothing = np.zeros_like(flags)
    score, legs = np.full(flags.shape, 200, np.uint8), np.zeros(flags.shape, np.int32)
    return LaidView(window, flags & seen, seen, score, nothing, legs)


def test_a_piece_that_ends_at_unknown_ground_is_at_the_rim():
    seen = np.ones((20, 20), bool)
    seen[:4] = False
    flags = np.zeros_like(seen)
    flags[4:12, 3:6] = flags[8:12, 15:18] = True  # one of two reaches the view's rim
    laid = laid_of(flags, seen, CellWindow(0, 0, 20, 20))
    assert np.array_equal(laid.at_rim, flags & (np.arange(20) < 6))


@given(st.lists(st.tuples(st.booleans(), st.booleans()), min_size=1, max_size=20))
def test_a_cell_remembers_the_last_views_that_saw_it(history):
    grid, window = EvidenceGrid(5), CellWindow(-3, -2, 70, 4)
    shape = window.shape
    for flag, seen in history:
        evidence = grid.record(laid_of(np.full(shape, flag), np.full(shape, seen), window), True)
    announced = [flag for flag, seen in history if seen]
    assert (evidence.votes == sum(announced[-5:])).all()
    assert (evidence.changed == sum(announced)).all()


def test_ground_where_nothing_changes_costs_no_memory_and_the_oldest_goes_first():
    grid = EvidenceGrid(5, most_chunks=3)
    earlier = CellWindow(-640, 0, -576, 64)
    grid.record(laid_of(np.ones(earlier.shape, bool), np.ones(earlier.shape, bool), earlier), True)
    quiet = CellWindow(0, 0, 640, 640)
    grid.record(laid_of(np.zeros(quiet.shape, bool), np.ones(quiet.shape, bool), quiet), True)
    assert (grid.read(earlier).votes == 1).all()  # 100 quiet pieces would have taken its place
    for step in range(6):
        window = CellWindow(64 * step, 0, 64 * step + 64, 64)
        grid.record(laid_of(np.ones(window.shape, bool), np.ones(window.shape, bool), window), True)
    assert (grid.read(earlier).votes == 0).all()
    assert (grid.read(CellWindow(128, 0, 192, 64)).votes == 0).all()
    assert (grid.read(CellWindow(192, 0, 256, 64)).votes == 1).all()  # three are kept
    assert (grid.read(CellWindow(320, 0, 384, 64)).votes == 1).all()
    assert (grid.read(CellWindow(320, 0, 384, 64)).seen == 2).all()  # the quiet view counts, too


def test_an_oblique_view_sees_no_ground_behind_its_horizon():
    view = view_of(0, 0, (0, 0, CAMERA_HEIGHT_M), [])
    tilted = np.array(
        [[1, 0, -160], [0, -1, 0], [0, 0.02, -0.6]], float
    )  # the horizon is at row 30
    laid = lay(
        replace(view, site_from_image=tilted),
        0.15,
        np.zeros(0, bool),
        np.zeros(0, bool),
        np.zeros(0, int),
    )
    assert max(laid.window.shape) <= 2 * 5 * CAMERA_HEIGHT_M / 0.15 + 2
    rows = np.nonzero(laid.seen.any(axis=1))[0]
    assert len(rows)
    north_m = -(laid.window.y0 + rows + 0.5) * 0.15
    assert (north_m < 0).all()  # in front of the camera, which looks south
