"""Things without the shadows they throw, and parted from neighbours that a shadow joins to them."""

from dataclasses import replace

import numpy as np
import pytest
from blob_world import M_PER_PX, START_NS, Thing, flight

from sorvolo.change.evidence import EvidenceMap, EvidenceSettings
from sorvolo.change.shade import shade_between
from sorvolo.change.things import thing_of, things_of
from sorvolo.survey.findings import ChangeKind, Patch

SHADOW = (58, 58, 58)  # of ground as bright as 110


def patch_with(*painted: tuple[slice, slice, tuple[int, int, int]]) -> Patch:
    """100 x 200 pixels of 0.05 m with rectangles that came; all of them changed."""
    before = np.full((100, 200, 4), (110, 110, 110, 255), np.uint8)
    after, changed = before.copy(), np.zeros((100, 200), bool)
    for rows, columns, colour in painted:
        after[rows, columns, :3], changed[rows, columns] = colour, True
    return shaded(
        Patch(0.0, 0.0, M_PER_PX, before, after, changed, np.zeros(changed.shape, np.uint8))
    )


def shaded(patch: Patch) -> Patch:
    """The patch with the shade of its pictures as they are now."""
    return replace(
        patch, shade=shade_between(patch.before[..., :3].copy(), patch.after[..., :3].copy())
    )


def test_specks_at_the_rim_of_a_shadow_do_not_stretch_the_thing():
    changed = np.zeros((60, 20), bool)
    changed[5:55, 5:15] = True
    shadow = changed.copy()
    shadow[5:15] = False
    clean = thing_of(changed, shadow)
    shadow[50:52, 13:15] = False
    assert np.array_equal(thing_of(changed, shadow), clean)
    assert 100 <= np.count_nonzero(clean) <= 130


def test_two_things_joined_by_a_shadow_are_two_with_kinds_of_their_own():
    patch = patch_with(
        (np.s_[40:50], np.s_[60:100], SHADOW),
        (np.s_[40:50], np.s_[50:60], (220, 40, 40)),
        (np.s_[38:52], np.s_[100:112], (40, 60, 230)),
    )
    patch.before[38:52, 100:112, :3], patch.after[38:52, 100:112, :3] = (40, 60, 230), 110
    things = things_of(shaded(patch), ChangeKind.APPEARED, patch.changed)
    assert sorted(kind for _, kind in things) == [ChangeKind.APPEARED, ChangeKind.DISAPPEARED]
    came, left = (mask for mask, _ in sorted(things, key=lambda each: each[1]))
    assert left[45, 105] and not left[45, 90]  # the shadow belongs to what came
    assert came[45, 55] and came[45, 90]
    assert np.array_equal(left | came, patch.changed)


def test_a_dark_car_with_bright_ends_is_one_thing():
    dark = (np.s_[30:66], np.s_[50:138], SHADOW)
    ends = [(np.s_[32:64], np.s_[x : x + 6], (230, 60, 60)) for x in (51, 131)]
    patch = patch_with(dark, *ends)
    assert len(things_of(shaded(patch), ChangeKind.APPEARED, patch.changed)) == 1


def test_a_car_that_came_touching_the_place_of_one_that_left_has_replaced_it():
    patch = patch_with((np.s_[10:95], np.s_[40:75], (30, 60, 150)))
    patch.before[10:95, 77:112, :3] = (215, 215, 210)
    patch.changed[10:95, 40:112] = True
    assert len(things_of(shaded(patch), ChangeKind.REPLACED, patch.changed)) == 1


def test_a_car_in_the_place_of_another_stays_one_replacement():
    patch = patch_with((np.s_[10:95], np.s_[40:75], (30, 60, 150)))
    patch.before[14:98, 44:78, :3] = (215, 215, 210)
    patch.changed[10:98, 40:78] = True
    assert len(things_of(shaded(patch), ChangeKind.REPLACED, patch.changed)) == 1


def test_a_shadow_that_went_round_its_thing_is_not_two_things():
    patch = patch_with((np.s_[30:60], np.s_[40:52], SHADOW))
    patch.before[30:60, 60:72, :3] = SHADOW
    patch.changed[30:60, 40:72] = True
    assert len(things_of(shaded(patch), ChangeKind.REPLACED, patch.changed)) == 1


@pytest.mark.parametrize("gap_px, count", [(20, 2), (4, 1)])
def test_dark_pieces_far_enough_apart_are_things_of_their_own(gap_px, count):
    patch = patch_with(
        (np.s_[20:80], np.s_[20:110], (200, 200, 190)),
        (np.s_[44:54], np.s_[110 + gap_px : 122 + gap_px], (70, 20, 20)),
    )
    assert len(things_of(shaded(patch), ChangeKind.APPEARED, patch.changed)) == count


def test_lit_specks_of_a_dark_car_are_no_things_of_their_own():
    specks = [
        (np.s_[y : y + 4, x : x + 4], (40, 58, 90))
        for columns in (range(24, 56, 9), range(80, 112, 9))
        for x in columns
        for y in range(30, 60, 9)
    ]
    walker = (np.s_[44:54], np.s_[150:156], (240, 240, 60))
    patch = patch_with((np.s_[20:70], np.s_[20:150], SHADOW), walker)
    for part, colour in specks:
        patch.after[(*part, np.s_[:3])] = colour
    things = things_of(shaded(patch), ChangeKind.APPEARED, patch.changed)
    assert len(things) == 1


def test_people_whose_shadows_join_them_are_two():
    people = [(np.s_[x : x + 4], np.s_[50:54], (240, 240, 240)) for x in (10, 60)]
    shadows = [(np.s_[x : x + 46], np.s_[51:55], SHADOW) for x in (14, 64)]
    patch = patch_with(*shadows, *people)
    assert len(things_of(shaded(patch), ChangeKind.APPEARED, patch.changed)) == 2


@pytest.mark.parametrize("gap_m", [1.2, 2.0])
def test_neighbours_in_a_shadow_are_announced_as_two_while_the_flight_lasts_and_keep_their_ids(
    gap_m,
):
    things = [
        Thing(0.5 + gap_m / 2, 0, (gap_m, 0.4), colour=SHADOW),
        Thing(0.2, 0, (0.6, 0.6)),
        Thing(1.05 + gap_m, 0, (0.5, 0.5), colour=(40, 60, 230)),
    ]
    evidence = EvidenceMap(M_PER_PX, EvidenceSettings(), "f")
    announced = [change for view in flight(things) for change in evidence.add(view)]
    final = evidence.conclude()
    assert [each.id for each in announced] == [each.id for each in final] == ["f-1", "f-2"]
    assert [each.id for each in evidence.conclude()] == ["f-1", "f-2"]
    whole_in_view_s = (
        1.3 + gap_m
    ) / 3  # a drone that flies 3 m/s sees just what it flies over at the start
    assert all((change.announced_ns - START_NS) * 1e-9 < whole_in_view_s + 1.0 for change in final)
