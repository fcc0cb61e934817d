"""Heights that stand alone: a piece as large as one patch that one pair of photos shows is a chance match."""

import numpy as np

from sorvolo.heights.free_space import islands


def test_lone_pieces_of_one_pair_of_photos_are_found_and_nothing_else() -> None:
    up_m = np.zeros((120, 150), np.float32)
    up_m[:, 75:] = np.linspace(0, 6, 75)  # a slope is one piece
    up_m[:, :8] = np.nan
    shown_by = np.full(up_m.shape, 2, np.uint8)
    chance, shed, kept, roof = (
        np.s_[10:20, 8:20],
        np.s_[40:50, 30:42],
        np.s_[60:70, 30:42],
        np.s_[80:110, 30:60],
    )
    for piece in (chance, shed, kept, roof):
        up_m[piece] = 3.0
    shown_by[kept] = 3
    found = islands(up_m, shown_by, 0.1)
    expected = np.zeros(up_m.shape, bool)
    expected[chance] = expected[shed] = True
    np.testing.assert_array_equal(found, expected)
    np.testing.assert_array_equal(islands(up_m, shown_by, 0.1, window=37, margin=40), found)
