"""Boxes of overlapping tiles, joined: every object once and whole."""

import numpy as np
import pytest

from sorvolo.detection.fusing import SeenTile, merge_tiles
from sorvolo.detection.session import Seen
from sorvolo.geometry.box_overlap import cover_matrix, iou_matrix

_SIZE = (100, 180)
_LEFT, _RIGHT = (0, 0, 100, 100), (80, 0, 180, 100)


def _tile(
    place: tuple[int, int, int, int], *rows: tuple[float, float, float, float, float, int]
) -> SeenTile:
    table = np.array(rows, float).reshape(-1, 6)
    return SeenTile(
        place, Seen(table[:, :4].astype(np.float32), table[:, 4], table[:, 5].astype(np.int64))
    )


def test_overlap_and_cover_by_hand() -> None:
    a = np.array([[0, 0, 10, 10]], np.float32)
    b = np.array([[5, 0, 15, 10], [2, 2, 4, 4], [20, 20, 30, 30]], np.float32)
    np.testing.assert_allclose(iou_matrix(a, b), [[50 / 150, 0.04, 0]])
    np.testing.assert_allclose(cover_matrix(b, a), [[0.5], [1], [0]])


def test_a_cut_piece_gives_way_to_the_whole() -> None:
    found = merge_tiles(
        [_tile(_LEFT, (60, 10, 90, 30, 0.6, 0)), _tile(_RIGHT, (80, 10, 91, 30, 0.9, 0))], _SIZE
    )
    np.testing.assert_allclose(found.boxes_px, [[60, 10, 90, 30]])
    assert found.scores.tolist() == [0.9], "the best of both"


def test_of_two_whole_ones_the_more_central_states_where() -> None:
    found = merge_tiles(
        [_tile(_LEFT, (82, 40, 92, 50, 0.9, 0)), _tile(_RIGHT, (83, 40, 93, 50, 0.5, 0))], _SIZE
    )
    np.testing.assert_allclose(found.boxes_px, [[82, 40, 92, 50]])
    mirrored = merge_tiles(
        [_tile(_LEFT, (88, 40, 96, 50, 0.9, 0)), _tile(_RIGHT, (89, 40, 97, 50, 0.5, 0))], _SIZE
    )
    np.testing.assert_allclose(mirrored.boxes_px, [[89, 40, 97, 50]])


def test_what_is_longer_than_the_overlap_is_joined() -> None:
    found = merge_tiles(
        [_tile(_LEFT, (10, 20, 100, 60, 0.7, 1)), _tile(_RIGHT, (80, 21, 150, 60, 0.6, 1))], _SIZE
    )
    np.testing.assert_allclose(found.boxes_px, [[10, 20, 150, 60]])


@pytest.mark.parametrize("labels", [(0, 1), (1, 0)])
def test_classes_are_not_mixed(labels: tuple[int, int]) -> None:
    tiles = [
        _tile(_LEFT, (60, 10, 90, 30, 0.6, labels[0])),
        _tile(_RIGHT, (82, 10, 112, 30, 0.9, labels[1])),
    ]
    assert len(merge_tiles(tiles, _SIZE).scores) == 2


def test_a_corner_that_looked_like_something_else_is_dropped() -> None:
    car, corner = (50, 10, 95, 40, 0.9, 1), (80, 12, 94, 38, 0.7, 0)
    found = merge_tiles([_tile(_LEFT, car), _tile(_RIGHT, corner)], _SIZE)
    assert found.labels.tolist() == [1]
    seen_in_one_tile = merge_tiles(
        [_tile(_LEFT, car, (85, 12, 99, 38, 0.7, 0)), _tile(_RIGHT)], _SIZE
    )
    assert sorted(seen_in_one_tile.labels.tolist()) == [0, 1], (
        "one tile that separates both is believed"
    )


def test_neighbours_in_the_shared_window_stay_two() -> None:
    two = [(81, 10, 88, 30, 0.9, 0), (89, 10, 97, 30, 0.8, 0)]
    found = merge_tiles([_tile(_LEFT, *two), _tile(_RIGHT, *two)], _SIZE)
    np.testing.assert_allclose(found.boxes_px, [each[:4] for each in two])
    overlapping = [
        (80, 10, 95, 30, 0.9, 0),
        (86, 10, 101, 30, 0.8, 0),
    ]  # IoU 0.43: two people side by side
    cut = [overlapping[0], (86, 10, 100, 30, 0.8, 0)]
    assert len(merge_tiles([_tile(_LEFT, *cut), _tile(_RIGHT, *overlapping)], _SIZE).scores) == 2


def test_nothing_seen_is_nothing_found() -> None:
    assert len(merge_tiles([_tile(_LEFT), _tile(_RIGHT)], _SIZE).scores) == 0


def test_imprecise_boxes_are_counted_once() -> None:
    """Boxes that stray by 5 % of their size: at most one in a hundred is counted twice, none is lost."""
    rng = np.random.default_rng(5)
    places = [(x, y, x + 200, y + 200) for y in (0, 140, 280) for x in (0, 140, 280)]
    true = np.array([(x + 9, y + 7, x + 9 + w, y + 7 + h) for y in range(0, 440, 40) for x in range(0, 440, 40)
                     for w, h in [rng.uniform(12, 28, 2)]], np.float32)  # fmt: skip
    lost = doubled = 0
    for _ in range(20):
        tiles = []
        for place in places:
            low, high = np.array(place[:2]), np.array(place[2:])
            shown = np.concatenate(
                [np.clip(true[:, :2], low, high), np.clip(true[:, 2:], low, high)], axis=1
            )
            sides = shown[:, 2:] - shown[:, :2]
            shown = shown[sides.min(axis=1) > 4]
            shown += rng.normal(0, 0.05, shown.shape) * np.tile(shown[:, 2:] - shown[:, :2], 2)
            shown = np.concatenate(
                [np.clip(shown[:, :2], low, high), np.clip(shown[:, 2:], low, high)], axis=1
            )
            tiles.append(_tile(place, *[(*box, 0.9, 0) for box in shown]))
        overlap = iou_matrix(merge_tiles(tiles, (480, 480)).boxes_px, true)
        lost += int((overlap.max(axis=0) < 0.5).sum())
        doubled += len(overlap) - int((overlap.max(axis=0) >= 0.5).sum())
    assert lost == 0
    assert doubled <= 0.01 * 20 * len(true)


@pytest.mark.parametrize(("right", "count"), [(90.0, 2), (96.0, 1)])
def test_a_piece_goes_only_where_another_tiles_box_covers_most_of_it(
    right: float, count: int
) -> None:
    """The piece (80 to 100 px) lies to a half, or to four fifths, within the whole box of another class."""
    piece = _tile(_RIGHT, (80, 10, 100, 30, 0.4, 1))
    whole = _tile((0, 0, 140, 100), (50, 8, right, 60, 0.9, 0))
    assert len(merge_tiles([whole, piece], _SIZE).scores) == count
