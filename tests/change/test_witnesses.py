"""A frame's differences are believed where the map and the earlier pictures bear each other out."""

import numpy as np
import pytest

from sorvolo.change.pair.corroboration import Difference, believed

SHAPE = (60, 80)
ALL = np.ones(SHAPE, bool)


def says(*things: tuple[int, float]) -> Difference:
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
        return says() if sureness is None else says((30, sureness))

    found = believed((opinion(by_map), ALL), [(opinion(each), ALL) for each in earlier])
    assert len(found.boxes) == len(found.scores) == int(is_believed)
    assert np.count_nonzero(found.mask) == 100 * is_believed


def test_who_does_not_see_the_place_is_not_asked():
    blind = ALL.copy()
    blind[:, 25:45] = False
    assert len(believed((says((30, 0.9)), ALL), [(says(), blind)]).boxes) == 1
    assert len(believed((says((30, 0.9)), ALL), [(says(), ALL)]).boxes) == 0


def test_what_lies_a_few_pixels_beside_is_the_same_and_announced_once():
    found = believed((says((30, 0.9)), ALL), [(says((34, 0.9)), ALL), (says((28, 0.8)), ALL)])
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
    assert not believed((says((30, 0.9)), known), [(says((30, 0.9)), ALL), (says((30, 0.9)), ALL)]).mask.any()
