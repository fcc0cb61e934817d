"""Coarse tiles are the fine ones made smaller, whether computed or taken from the map's GeoTIFF."""

from pathlib import Path

import numpy as np
import pytest

from sorvolo.station.tiles import MapOverview, TilePyramid, halved
from sorvolo.store.images import BytesCache
from sorvolo.store.site.archive import Archive
from sorvolo.store.site.tiles import TileView


def pyramid(archive: Archive, version: int = 2) -> TilePyramid:
    """Of the site's version, computed from its tiles."""
    cache = BytesCache[str, np.ndarray](10**9, lambda each: int(each.nbytes))
    return TilePyramid(archive.tiles(version), 512, cache)


def test_halved_tiles_average_the_ground_and_keep_its_edge(made_site: Path) -> None:
    """No dark fringe where the map ends."""
    with Archive.open(made_site, write=False) as archive:
        state = pyramid(archive)
        assert [len(each) for each in state.keys[:2]] == [4, 3] and set(state.keys[-1]) <= {
            (-1, 0),
            (0, 0),
        }
        fine, coarse = archive.tiles(2)[0, 0], state.picture(1, (0, 0))
        assert coarse is not None
        expected = fine[..., :3].reshape(256, 2, 256, 2, 3).mean(axis=(1, 3))
        assert np.abs(coarse[:256, :256, :3] - expected).max() <= 1
        assert state.picture(1, (7, 7)) is None
        edge = pyramid(archive, 1).picture(2, (0, 0))
        assert (
            edge is not None and int(edge[..., 0][edge[..., 3] > 0].min()) >= 42
        )  # the darkest red of any tile


@pytest.mark.parametrize("alphas", [(255,), (0, 255), (0, 40, 255), (0,)])
def test_a_picture_at_half_its_size_is_the_mean_by_alpha(alphas: tuple[int, ...]) -> None:
    """Of each four pixels, to the gray level; in double precision beside it."""
    random = np.random.default_rng(len(alphas))
    rgba = random.integers(0, 256, (32, 48, 4), dtype=np.uint8)
    rgba[..., 3] = random.choice(alphas, (32, 48))
    small = halved(rgba)
    fours = rgba.astype(np.float64).reshape(16, 2, 24, 2, 4)
    share = fours[..., 3:]
    total = share.sum(axis=(1, 3))
    expected = (fours[..., :3] * share).sum(axis=(1, 3)) / np.maximum(total, 1e-9)
    is_seen = total[..., 0] > 0
    assert small.shape == (16, 24, 4) and np.abs(small[..., 3] - total[..., 0] / 4).max() <= 0.51
    assert np.abs(small[..., :3] - expected)[is_seen].max(initial=0.0) <= 0.51


def test_a_tile_of_the_web_reads_only_the_tiles_under_it(
    made_site: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """While a map grows each of them was painted anew."""
    with Archive.open(made_site, write=False) as archive:
        state, read = pyramid(archive), set[tuple[int, int]]()
        of_site = type(state._tiles).__getitem__

        def noted(view: TileView, index: tuple[int, int]) -> np.ndarray:
            read.add(index)
            return of_site(view, index)

        monkeypatch.setattr(type(state._tiles), "__getitem__", noted)
        side_px, pieces = state.pieces(1)
        assert side_px == 256 and len(pieces) == 4 > len(state.keys[1])
        piece = state.piece(1, (0, 0))
        assert piece is not None and read == {(0, 0)}
        whole = state.picture(1, (0, 0))
        assert whole is not None and np.array_equal(whole[:256, :256], piece)


def test_the_geotiffs_overviews_are_the_same_tiles(made_site: Path) -> None:
    """Within the rounding of its steps; a file that was replaced gives nothing."""
    with Archive.open(made_site, write=False) as archive:
        assert archive.exported_version == 2
        state, overview = (
            pyramid(archive),
            MapOverview(archive.mosaic_path, archive.site_grid().grid),
        )
        for level in (1, 2):
            for index in state.keys[level]:
                computed, read = state.picture(level, index), overview.tile(level, index)
                assert computed is not None and read is not None
                inside = (computed[..., 3] == 255) & (read[..., 3] == 255)
                assert abs((computed[..., 3] > 0).mean() - (read[..., 3] > 0).mean()) < 0.02
                assert np.abs(computed.astype(int) - read)[inside].max() <= 2 + level
        assert overview.tile(12, (0, 0)) is None
        assert (
            MapOverview(made_site / "preview.png", archive.site_grid().grid).tile(2, (0, 0)) is None
        )


def test_the_same_tiles_have_the_same_revision_and_others_another(made_site: Path) -> None:
    """What changed between two states is named."""
    with Archive.open(made_site, write=False) as archive:
        one, two = pyramid(archive, 1), pyramid(archive, 2)
        assert pyramid(archive, 2).revision == two.revision != one.revision
        assert set(two.changed_since(one)) == set(archive.tiles(2))


def test_what_many_ask_for_is_made_once() -> None:
    """And forgotten when there is too much of it."""
    made: list[int] = []
    cache = BytesCache[int, bytes](10, len)
    for key in (1, 1, 2, 1, 3, 2):
        cache.get(key, lambda key=key: made.append(key) or bytes(4))  # type: ignore[misc]
    assert made == [1, 2, 3, 2]
