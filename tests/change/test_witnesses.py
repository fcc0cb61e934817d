"""A frame's differences are believed where the map and the earlier pictures bear each other out."""

import numpy as np
import pytest

from sorvolo.change.corroboration import Difference, believed, is_whole, unwitnessed
from sorvolo.change.robust import compare_robust

SHAPE = (60, 80)
ALL = np.ones(SHAPE, bool)


def differing(*things: tuple[int, float]) -> Difference:
    """A difference of 10 x 10 px at each (left, sureness)."""
    mask = np.zeros(SHAPE, np.uint8)
    for left, _ in things:
        mask[20:30, left : left + 10] = 255
    boxes = np.array([[left, 20, 10, 10] for left, _ in things], np.int64).reshape(-1, 4)
    return Difference(mask, boxes, np.array([sureness for _, sureness in things]))


@pytest.mark.parametrize(
    ("by_map", "earlier", "is_believed"),
    [
        (0.9, [], True),
        (0.4, [], False),
        (0.9, [0.3, 0.3], True),
        (0.9, [0.9, None], False),
        (None, [0.9, 0.3], True),
        (None, [0.85], False),
        (None, [0.95], True),
        (0.3, [0.9], True),
        (0.4, [0.4, 0.4], False),
    ],
)
def test_one_must_be_sure_and_all_earlier_pictures_must_show_it(by_map, earlier, is_believed):
    def opinion(sureness):
        return differing() if sureness is None else differing((30, sureness))

    found = believed((opinion(by_map), ALL), [(opinion(each), ALL) for each in earlier])
    assert len(found.boxes) == len(found.scores) == int(is_believed)
    assert np.count_nonzero(found.mask) == 100 * is_believed


def test_who_does_not_see_the_place_is_not_asked():
    blind = ALL.copy()
    blind[:, 25:45] = False
    assert len(believed((differing((30, 0.9)), ALL), [(differing(), blind)]).boxes) == 1
    assert len(believed((differing((30, 0.9)), ALL), [(differing(), ALL)]).boxes) == 0


def test_what_lies_a_few_pixels_beside_is_the_same_and_announced_once():
    found = believed(
        (differing((30, 0.9)), ALL), [(differing((34, 0.9)), ALL), (differing((28, 0.8)), ALL)]
    )
    assert found.boxes.tolist() == [[30, 20, 10, 10]]


def test_neighbours_whose_boxes_overlap_are_both_reported():
    mask = np.zeros(SHAPE, np.uint8)
    mask[20:40, 20:34] = mask[10:30, 34:40] = 255
    both = Difference(mask, np.array([[20, 20, 20, 20], [34, 10, 6, 20]]), np.array([0.9, 0.8]))
    found = believed((both, ALL), [(both, ALL)])
    assert len(found.boxes) == 2 and np.array_equal(found.mask, mask)


def test_nothing_is_found_where_the_map_knows_no_ground():
    known = ALL.copy()
    known[:, :60] = False
    twice = [(differing((30, 0.9)), ALL), (differing((30, 0.9)), ALL)]
    assert not believed((differing((30, 0.9)), known), twice).mask.any()


def test_a_seam_of_the_map_through_a_thing_is_no_change_where_a_whole_picture_shows_it(ground):
    """The left half of a car comes from one photo of the map, the right half from another that lies 14 px off."""
    whole = ground.copy()
    whole[150:180, 200:262] = (200, 60, 40)
    whole[156:174, 215:230] = (40, 30, 30)
    torn = whole.copy()
    torn[:, 230:] = np.roll(whole, 14, axis=0)[:, 230:]
    sees = np.ones(ground.shape[:2], bool)

    def differences(reference: np.ndarray) -> Difference:
        found = compare_robust(reference, whole, sees, 0.2)
        return Difference(found.mask, found.boxes, found.scores)

    by_map = differences(torn)
    assert len(believed((by_map, sees), []).boxes) > 0
    assert unwitnessed(by_map, [])
    half = sees.copy()
    half[:, 232:] = False
    assert unwitnessed(by_map, [half])  # a picture that ends within the thing is no witness
    assert all(is_whole(by_map.mask, part, sees) for part in unwitnessed(by_map, [half]))
    assert not unwitnessed(by_map, [half, sees])
    assert len(believed((by_map, sees), [(differences(whole), sees)]).boxes) == 0
