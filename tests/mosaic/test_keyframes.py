"""Keyframes that memory has no room for come back from the shelf as they were, and the map is the same."""

import numpy as np
import pytest

from sorvolo.geometry.camera import Camera
from sorvolo.mosaic.planar import Keyframes
from sorvolo.survey.flight import CameraPrior
from sorvolo.survey.mosaic import Features, Keyframe

_CAMERA = Camera(fx_px=100.0, fy_px=100.0, cx_px=31.5, cy_px=23.5, width_px=64, height_px=48)
_PRIOR = CameraPrior(np.zeros(3), np.ones(3), np.eye(3), np.ones(3))


class _Shelf:
    def __init__(self) -> None:
        self.kept: dict[int, bytes] = {}

    def put(self, key: int, data: bytes) -> None:
        assert key not in self.kept, "written once"
        self.kept[key] = data

    def get(self, key: int) -> bytes:
        return self.kept[key]


def _keyframe(keyframe_id: int) -> tuple[Keyframe, np.ndarray]:
    rng = np.random.default_rng(keyframe_id)
    features = Features(
        "orb", rng.uniform(0, 60, (5, 2)), rng.integers(0, 256, (5, 32), dtype=np.uint8)
    )
    gray = rng.integers(0, 256, (48, 64), dtype=np.uint8)
    return Keyframe(keyframe_id, _CAMERA, gray, features, _PRIOR), rng.integers(
        0, 256, (12, 16, 3), dtype=np.uint8
    )


def test_what_comes_back_is_what_was_put_away() -> None:
    shelf = _Shelf()
    kept = Keyframes(shelf, most_bytes=8000)  # two of them
    for each in range(10):
        kept.add(*_keyframe(each))
    assert len(shelf.kept) == 8
    for each in (0, 9, 3, 0, 7):
        wanted, small = _keyframe(each)
        found = kept.keyframe(each)
        assert found.id == each and found.camera is _CAMERA and found.prior is _PRIOR
        np.testing.assert_array_equal(found.gray, wanted.gray)
        np.testing.assert_array_equal(found.features.points_px, wanted.features.points_px)
        np.testing.assert_array_equal(found.features.descriptors, wanted.features.descriptors)
        assert found.features.kind == "orb" and found.features.descriptors.dtype == np.uint8
        np.testing.assert_array_equal(kept.thumbnail(each), small)
    assert 5 in kept and 10 not in kept


def test_without_a_shelf_all_stay_in_memory() -> None:
    kept = Keyframes(most_bytes=1)
    first, _ = _keyframe(0)
    kept.add(first, _keyframe(0)[1])
    kept.add(*_keyframe(1))
    assert kept.keyframe(0) is first


def test_one_larger_than_the_memory_is_there_all_the_same() -> None:
    kept = Keyframes(_Shelf(), most_bytes=1)
    kept.add(*_keyframe(0))
    kept.add(*_keyframe(1))
    np.testing.assert_array_equal(kept.keyframe(0).gray, _keyframe(0)[0].gray)
    with pytest.raises(KeyError):
        kept.keyframe(2)


def test_what_is_released_comes_back_from_the_shelf() -> None:
    shelf = _Shelf()
    kept = Keyframes(shelf)
    for number in range(3):
        kept.add(*_keyframe(number))
    kept.release()
    assert not kept._near and kept._bytes == 0
    for number in range(3):
        np.testing.assert_array_equal(kept.keyframe(number).gray, _keyframe(number)[0].gray)
        np.testing.assert_array_equal(kept.thumbnail(number), _keyframe(number)[1])
    alone = Keyframes()
    alone.add(*_keyframe(0))
    alone.release()
    np.testing.assert_array_equal(alone.keyframe(0).gray, _keyframe(0)[0].gray)
