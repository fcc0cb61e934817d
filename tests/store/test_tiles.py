"""The growing map behaves like a dict of tiles, whatever is evicted, written, dropped or shared."""

import errno
import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sorvolo.errors import StoreError
from sorvolo.geometry.grid import TileIndex
from sorvolo.store.images import (
    ImageCache,
    image_from_jpeg,
    jpeg_from_image,
    png_from_rgba,
    rgba_from_png,
    weighted,
)
from sorvolo.store.site.tiles import GrowingTiles, TileBlobs

SIDE = 16
INDICES = st.tuples(st.integers(-1, 1), st.integers(-1, 1))
STEPS = st.lists(
    st.one_of(
        st.tuples(st.just("set"), INDICES, st.integers(0, 3)),
        st.tuples(st.just("get"), INDICES, st.just(0)),
        st.tuples(st.just("delete"), INDICES, st.just(0)),
        st.tuples(st.just("save"), INDICES, st.just(0)),
        st.tuples(st.just("take back"), INDICES, st.just(0)),
    ),
    max_size=40,
)


def flat(colour: int) -> np.ndarray:
    """A tile of one colour; colour 0 is transparent."""
    return np.full((SIDE, SIDE, 4), colour, np.uint8)


@settings(max_examples=60, deadline=None)
@given(steps=STEPS, limit_tiles=st.integers(0, 4))
def test_growing_tiles_are_a_dict(
    steps: list[tuple[str, TileIndex, int]], limit_tiles: int
) -> None:
    with tempfile.TemporaryDirectory() as folder:
        blobs = TileBlobs(Path(folder))
        base = {(0, 0): blobs.save(flat(1)), (1, 1): blobs.save(flat(2))}
        tiles = GrowingTiles(blobs, base, SIDE, limit_tiles * SIDE * SIDE * 4)
        truth = {(0, 0): 1, (1, 1): 2}
        rows: dict[TileIndex, str] = dict(base)  # what the catalogue would hold
        for action, index, colour in steps:
            if action == "set":
                tiles[index] = flat(colour)
                truth.pop(index, None)
                truth |= {index: colour} if colour else {}
            elif action == "get":
                assert (int(tiles[index][0, 0, 0]) if index in tiles else 0) == truth.get(index, 0)
            elif action == "delete" and index in truth:
                del tiles[index], truth[index]
            elif action == "take back":
                tiles.take_back()
                truth = {(0, 0): 1, (1, 1): 2}
            elif action == "save":
                rows = {**rows, **tiles.save()}
                rows = {key: sha256 for key, sha256 in rows.items() if sha256 is not None}
                blobs.remove(tiles.take_superseded() - set(base.values()))
                assert {
                    key: int(blobs.load(sha256)[0, 0, 0]) for key, sha256 in rows.items()
                } == truth
                assert blobs.stored() == set(rows.values()) | set(base.values())
            assert set(tiles) == set(truth) and len(tiles) == len(truth)
        assert {key: int(tile[0, 0, 0]) for key, tile in tiles.items()} == truth
        tiles.close()  # before their folder goes
        blobs.sync()


def test_a_tile_that_could_not_be_written_is_still_to_be_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Threads write; what fails there is raised by who asks next, and nothing is lost by it."""
    blobs = TileBlobs(tmp_path / "tiles")
    tiles = GrowingTiles(blobs, {}, 16, 2 * 16 * 16 * 4)
    painted = {(column, 0): np.full((16, 16, 4), 40 + column, np.uint8) for column in range(12)}
    is_full, keep = True, TileBlobs.keep

    def full_at_times(self: TileBlobs, data: bytes) -> str:
        if is_full:
            raise OSError(errno.ENOSPC, "No space left on device")
        return keep(self, data)

    monkeypatch.setattr(TileBlobs, "keep", full_at_times)
    failed = 0
    for index, tile in painted.items():
        try:
            tiles[index] = tile
        except OSError:
            failed += 1
    with pytest.raises(OSError, match="No space"):
        tiles.save()
    assert failed
    is_full = False
    for index, tile in painted.items():
        if index not in tiles:  # it was being set when another one's failure was raised
            tiles[index] = tile
    assert set(tiles.save()) == set(painted)
    for index, tile in painted.items():
        np.testing.assert_array_equal(tiles[index], tile)


def test_tiles_read_lately_are_kept_until_they_are_removed(tmp_path: Path) -> None:
    blobs = TileBlobs(tmp_path)
    sha256 = blobs.save(flat(5))
    tile = blobs.load(sha256)
    assert blobs.load(sha256) is tile
    with pytest.raises(ValueError, match="read-only"):
        tile[0, 0] = 1  # it is everybody's
    blobs.remove({sha256})
    with pytest.raises(FileNotFoundError):
        blobs.load(sha256)


def test_what_is_released_is_read_again_from_the_disk(tmp_path: Path) -> None:
    tiles = GrowingTiles(TileBlobs(tmp_path), {}, 512, 8 << 20)
    painted = np.full((512, 512, 4), 9, np.uint8)
    tiles[0, 0] = painted
    tiles.save()
    tiles[0, 1] = painted + 1
    tiles.release()
    assert set(tiles._loaded) == {(0, 1)} and tiles._bytes == painted.nbytes
    assert (tiles[0, 0] == 9).all() and (tiles[0, 1] == 10).all()


def test_no_more_tiles_are_kept_than_memory_is_given(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sorvolo.store.site.tiles._CACHE_BYTES", 2 * flat(1).nbytes)
    blobs = TileBlobs(tmp_path)
    first, second, third = (blobs.save(flat(colour)) for colour in (1, 2, 3))
    kept = blobs.load(first)
    for each in (second, third):
        blobs.load(each)
    assert blobs.load(third) is blobs.load(third)
    assert blobs.load(first) is not kept and np.array_equal(blobs.load(first), kept)


@pytest.mark.parametrize("alphas", [(0, 255), (0, 90, 255)])
def test_what_is_unseen_darkens_nothing(alphas: tuple[int, ...]) -> None:
    rng = np.random.default_rng(2)
    rgba = np.dstack([rng.integers(0, 256, (8, 8, 3)), rng.choice(alphas, (8, 8))]).astype(np.uint8)
    expected = rgba.astype(np.float32)
    expected[..., :3] *= expected[..., 3:] / 255
    assert np.array_equal(weighted(rgba), expected)


def test_png_keeps_every_value_under_transparency() -> None:
    rgba = np.random.default_rng(3).integers(0, 256, (40, 50, 4), dtype=np.uint8)
    assert np.array_equal(rgba_from_png(png_from_rgba(rgba), "x"), rgba)


def test_an_enlarged_tile_is_kept_as_it_is_in_few_bytes() -> None:
    small = np.random.default_rng(1).integers(0, 255, (64, 64, 4), np.uint8)
    enlarged = small.repeat(4, axis=0).repeat(4, axis=1)
    data = png_from_rgba(enlarged)
    assert np.array_equal(rgba_from_png(data, "enlarged"), enlarged)
    assert len(data) < 0.4 * len(
        png_from_rgba(np.roll(enlarged, 1, axis=0))
    )  # rows that repeat, but not in pairs


def test_jpeg_keeps_colour_at_full_resolution() -> None:
    image = np.zeros((32, 32, 3), np.uint8)
    image[:, 16:] = (255, 0, 0)
    image[:, 17:] = (0, 0, 255)  # a red line one pixel wide between black and blue
    read = image_from_jpeg(jpeg_from_image(image), "x")
    assert read[16, 16, 0] > 180 and read[16, 18, 0] < 60


@pytest.mark.parametrize("data", [b"", b"text", png_from_rgba(flat(3))[:40]])
def test_damaged_pictures_are_named(data: bytes) -> None:
    with pytest.raises(StoreError, match=r"tile\.png"):
        rgba_from_png(data, "tile.png")
    with pytest.raises(StoreError, match=r"frame\.jpg"):
        image_from_jpeg(data[:20], "frame.jpg")


def test_the_image_cache_is_bounded_in_bytes() -> None:
    loaded: list[int] = []

    def load(index: int) -> np.ndarray:
        loaded.append(index)
        return np.full((10, 10, 3), index, np.uint8)

    cache = ImageCache(load, 600)
    for index in (1, 2, 1, 3, 1, 2):  # two fit; 2 is the one used longest ago when 3 comes
        assert cache.get(index)[0, 0, 0] == index
    assert loaded == [1, 2, 3, 2]
    cache.forget(1)
    cache.get(1)
    assert loaded == [1, 2, 3, 2, 1]


def test_tiles_read_from_disk_take_no_more_memory_than_is_allowed(tmp_path: Path) -> None:
    blobs = TileBlobs(tmp_path)
    blobs.cache.most_bytes = 2 * SIDE * SIDE * 4
    hashes = [blobs.save(flat(colour)) for colour in (1, 2, 3)]
    first, second, third = (blobs.load(each) for each in hashes)
    assert blobs.load(hashes[2]) is third
    assert blobs.load(hashes[1]) is second
    assert blobs.load(hashes[0]) is not first
