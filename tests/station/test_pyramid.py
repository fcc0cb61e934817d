"""Coarse tiles are the fine ones made smaller, whether computed or taken from the map's GeoTIFF."""

from pathlib import Path

import numpy as np

from sorvolo.station.map_overview import MapOverview
from sorvolo.station.pyramid import BytesCache, Pyramid
from sorvolo.store.site.archive import Archive


def pyramid(archive: Archive, version: int = 2) -> Pyramid:
    """Of the site's version, computed from its tiles."""
    cache = BytesCache[str, np.ndarray](10**9, lambda each: int(each.nbytes))
    return Pyramid(archive.tiles(version), 512, cache)


def test_halved_tiles_average_the_ground_and_keep_its_edge(made_site: Path) -> None:
    """No dark fringe where the map ends."""
    with Archive.open(made_site, write=False) as archive:
        state = pyramid(archive)
        assert [len(each) for each in state.keys[:2]] == [4, 3] and set(state.keys[-1]) <= {(-1, 0), (0, 0)}
        fine, coarse = archive.tiles(2)[0, 0], state.picture(1, (0, 0))
        assert coarse is not None
        expected = fine[..., :3].reshape(256, 2, 256, 2, 3).mean(axis=(1, 3))
        assert np.abs(coarse[:256, :256, :3] - expected).max() <= 1
        assert state.picture(1, (7, 7)) is None
        edge = pyramid(archive, 1).picture(2, (0, 0))
        assert edge is not None and int(edge[..., 0][edge[..., 3] > 0].min()) >= 42  # the darkest red of any tile


def test_the_geotiffs_overviews_are_the_same_tiles(made_site: Path) -> None:
    """Within the rounding of its steps; a file that was replaced gives nothing."""
    with Archive.open(made_site, write=False) as archive:
        assert archive.exported_version == 2
        state, overview = pyramid(archive), MapOverview(archive.mosaic_path, archive.site_grid().grid)
        for level in (1, 2):
            for index in state.keys[level]:
                computed, read = state.picture(level, index), overview.tile(level, index)
                assert computed is not None and read is not None
                inside = (computed[..., 3] == 255) & (read[..., 3] == 255)
                assert abs((computed[..., 3] > 0).mean() - (read[..., 3] > 0).mean()) < 0.02
                assert np.abs(computed.astype(int) - read)[inside].max() <= 2 + level
        assert overview.tile(12, (0, 0)) is None
        assert MapOverview(made_site / "preview.png", archive.site_grid().grid).tile(2, (0, 0)) is None


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
