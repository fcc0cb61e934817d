"""The station answers: sites, versions, tiles that may be kept for ever, problems in words."""

import tracemalloc
from pathlib import Path
from typing import ClassVar

import cv2
import numpy as np
import pytest
from fake_flights import LOCAL_SITE, SITE, map_flight
from starlette.testclient import TestClient

from sorvolo.errors import SettingsError
from sorvolo.station.app import station_app
from sorvolo.station.settings import StationSettings
from sorvolo.station.sites import bounds_lonlat
from sorvolo.station.tiles import TilePyramid, render
from sorvolo.store.images import BytesCache
from sorvolo.store.site.archive import Archive
from waiting import wait_for

FIELD = "/api/sites/field"


def tile_of(longitude_deg: float, latitude_deg: float, z: int) -> str:
    """z/x/y of the tile that shows a place (OpenStreetMap's formula)."""
    y = (1 - np.arcsinh(np.tan(np.radians(latitude_deg))) / np.pi) / 2
    return f"{z}/{int((longitude_deg + 180) / 360 * 2**z)}/{int(y * 2**z)}"


def pixels(data: bytes) -> np.ndarray:
    """RGBA of an encoded tile."""
    return cv2.cvtColor(
        cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED), cv2.COLOR_BGRA2RGBA
    )


def test_status_and_sites(client: TestClient) -> None:
    """What stands on the disk is listed, with places in WGS84."""
    status = client.get("/api/status").json()
    assert status["role"] == "operate" and status["sites"] == 1 and status["disk_free_gb"] > 0
    (site,) = client.get("/api/sites").json()
    assert site["id"] == "field" and site["flights"] == 2 and site["versions"] == 2
    west, south, east, north = site["bounds_wgs84"]
    assert west < site["center_wgs84"][0] < east and south < site["center_wgs84"][1] < north
    assert abs(site["center_wgs84"][0] - SITE.origin.longitude_deg) < 0.01
    detail = client.get(FIELD).json()
    assert [(each["n"], each["flight"]) for each in detail["versions"]] == [(1, "a"), (2, "b")]
    assert [
        (each["id"], each["kind"], each["matched"], each["rejected"]) for each in detail["flights"]
    ] == [
        ("a", "map", 4, 1),
        ("b", "compare", 4, 1),
    ]


def test_head_answers_as_get_without_the_body(client: TestClient) -> None:
    west, south, east, north = client.get(FIELD).json()["bounds_wgs84"]
    tile = f"{FIELD}/tiles/2/{tile_of((west + east) / 2, (south + north) / 2, 20)}.webp"
    for path in ("/", "/page/sw.js", "/page/main.js", "/api/status", FIELD, tile, f"{FIELD}/exports/site.gpkg",
                 f"{FIELD}/collections/changes/items", "/api/sites/nowhere", "/api/uploads", "/nothing"):  # fmt: skip
        got, head = client.get(path), client.head(path)
        assert (head.status_code, head.content) == (got.status_code, b""), path
        for name in ("content-type", "cache-control"):
            assert head.headers.get(name) == got.headers.get(name), (path, name)
        assert int(head.headers["content-length"]) > 0
    assert client.head("/api/session").status_code == 405


def test_a_sites_one_folder_deeper_are_found_and_links_are_not(root: Path, tmp_path: Path) -> None:
    """`sorvolo demo` puts its site one deeper; a link could lead anywhere."""
    (root / "demo").mkdir()
    (root / "field").rename(root / "demo" / "site")
    (root / "link").symlink_to(root / "demo" / "site")
    with TestClient(station_app(StationSettings(root)), base_url="http://localhost:8750") as client:
        assert [each["id"] for each in client.get("/api/sites").json()] == ["demo:site"]
        assert client.get("/api/sites/demo:site").status_code == 200
        assert client.get("/api/sites/link").status_code == 404


def test_tiles_show_the_map_where_it_lies(client: TestClient, root: Path) -> None:
    """The colour of the ground at a place is the site tile's own there."""
    with Archive.open(root / "field", write=False) as archive:
        grid, source = archive.site_grid(), archive.tiles(2)[0, 0]
    place_px = np.array([[300.0, 200.0]])
    site_from_grid = np.linalg.inv(grid.grid_from_site_affine(np.zeros(2), 50.0))
    place_m = place_px @ site_from_grid[:2, :2].T + site_from_grid[:2, 2]
    latitude, longitude, _ = (float(each[0]) for each in grid.frame.wgs84_from_site(place_m))
    for z in (19, 21, 22):
        answer = client.get(f"{FIELD}/tiles/2/{tile_of(longitude, latitude, z)}.png")
        assert answer.status_code == 200 and "immutable" in answer.headers["cache-control"]
        n = 2**z
        x = (longitude + 180) / 360 * n % 1 * 256
        y = (1 - np.arcsinh(np.tan(np.radians(latitude))) / np.pi) / 2 * n % 1 * 256
        shown = pixels(answer.content)[int(y), int(x)].astype(int)
        step = (
            4 if z == 19 else 2
        )  # grid pixels a tile's pixel covers: the gradient runs half a level a grid pixel
        assert np.abs(shown - [*source[200, 300, :3], 255]).max() <= step, (z, shown)


def test_versions_differ_and_live_has_a_revision(client: TestClient) -> None:
    """Only an address that names its content may be kept for ever."""
    place = tile_of(*client.get(FIELD).json()["center_wgs84"], 20)
    first, second = (client.get(f"{FIELD}/tiles/{version}/{place}.webp") for version in (1, 2))
    assert first.headers["content-type"] == "image/webp" and first.content != second.content
    revision = client.get(FIELD).json()["live_revision"]
    live = client.get(f"{FIELD}/tiles/live-{revision}/{place}.webp")
    assert live.content == second.content and "immutable" in live.headers["cache-control"]
    old = client.get(f"{FIELD}/tiles/live-0123456789ab/{place}.webp")
    assert old.content == second.content and old.headers["cache-control"] == "no-cache"


def test_the_growing_map_is_shown_while_a_flight_is_mapped(client: TestClient, root: Path) -> None:
    """A flush changes the live revision and its tiles; complete versions stay."""
    before = client.get(FIELD).json()["live_revision"]
    place = tile_of(*client.get(FIELD).json()["center_wgs84"], 20)
    shown = client.get(f"{FIELD}/tiles/live-{before}/{place}.webp").content
    with (
        Archive.open(root / "field", write=True) as archive,
        archive.begin_flight("c", "c", {}) as writer,
    ):
        for column in (-1, 0, 1, 2):
            writer.tiles[column, 0] = np.full((512, 512, 4), 255, np.uint8)
        writer.flush()
        after = client.get(FIELD).json()["live_revision"]
        assert after != before
        assert client.get(f"{FIELD}/tiles/live-{after}/{place}.webp").content != shown
        assert client.get(f"{FIELD}/tiles/2/{place}.webp").content == shown


@pytest.mark.parametrize(
    "path",
    [
        "tiles/2/20/0/0.webp",
        "tiles/2/3/4/2.webp",
        "tiles/live/20/5/5.png",
    ],
)
def test_where_the_map_is_not_there_is_no_tile(reader: TestClient, path: str) -> None:
    """The other side of the Earth, and far out, have no picture; that is no error."""
    assert reader.get(f"{FIELD}/{path}").status_code == 204


@pytest.mark.parametrize(
    "path",
    [
        "/api/sites/nowhere",
        f"{FIELD}/tiles/9/20/1/1.webp",
        f"{FIELD}/tiles/2/40/1/1.webp",
        f"{FIELD}/tiles/x/2/1/1.webp",
        "/api/nothing",
    ],
)
def test_problems_are_documents(reader: TestClient, path: str) -> None:
    """RFC 9457: title, status, detail."""
    answer = reader.get(path)
    assert answer.status_code == 404
    assert answer.headers["content-type"] == "application/problem+json"
    assert answer.json()["status"] == 404 and answer.json()["title"] and answer.json()["detail"]


def test_a_site_deleted_while_it_is_looked_at(client: TestClient, root: Path) -> None:
    """It is gone, which is reported; a new one in its place is another site."""
    assert client.get(FIELD).status_code == 200
    (root / "field").rename(root.parent / "elsewhere")
    assert client.get(FIELD).status_code in (404, 410)
    with Archive.open(root / "field", write=True) as archive:
        archive.create_site(SITE)
        map_flight(archive, "new", 10, count=1)
    wait_for(lambda: client.get(FIELD).status_code == 200)
    assert [each["id"] for each in client.get(FIELD).json()["flights"]] == ["new"]


def test_a_local_site_is_shown_without_a_place_on_earth(root: Path) -> None:
    """Its tiles lie around 0, 0."""
    with Archive.open(root / "pond", write=True) as archive:
        archive.create_site(LOCAL_SITE)
        map_flight(archive, "a", 10, count=1)
    with TestClient(station_app(StationSettings(root)), base_url="http://127.0.0.1:8750") as client:
        site = client.get("/api/sites/pond").json()
        assert site["is_local"]
        place = tile_of(*site["center_wgs84"], 17)
        assert client.get(f"/api/sites/pond/tiles/1/{place}.png").status_code == 200


class _OneTile(dict[tuple[int, int], np.ndarray]):
    """The tiles of a map of one tile, away from the site's origin."""

    hashes: ClassVar = {(1, 1): "a" * 64}


def test_a_small_map_is_shown_from_afar_without_gathering_the_country(tmp_path: Path) -> None:
    """A web tile of kilometres over one tile of the map took gigabytes: it was gathered at the map's own resolution."""
    with Archive.open(tmp_path / "site", write=True) as archive:
        archive.create_site(SITE)
        grid = archive.site_grid()
    picture = np.full((512, 512, 4), 200, np.uint8)
    state = TilePyramid(
        _OneTile({(1, 1): picture}), 512, BytesCache(10**8, lambda each: each.nbytes)
    )  # type: ignore[arg-type]
    west, south, east, north = bounds_lonlat(state.corner_tiles, grid) or [0.0] * 4
    z, x, y = (int(each) for each in tile_of((west + east) / 2, (south + north) / 2, 16).split("/"))
    tracemalloc.start()
    try:
        assert pixels(render(state, grid, z, x, y, ".png"))[..., 3].any()
        assert tracemalloc.get_traced_memory()[1] < 50e6
    finally:
        tracemalloc.stop()


def test_an_error_of_the_station_is_answered_in_words(
    root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As a problem document, without what is inside."""
    app = station_app(StationSettings(root))
    with TestClient(app, base_url="http://localhost:8750", raise_server_exceptions=False) as client:
        monkeypatch.setattr(app.state.station.shelf, "open", lambda _: 1 / 0)
        answer = client.get(FIELD)
        assert (
            answer.status_code == 500
            and answer.headers["content-type"] == "application/problem+json"
        )
        assert "ZeroDivisionError" in answer.json()["detail"] and "division by" not in answer.text


def test_a_base_map_of_the_stations_own_is_read_in_ranges(root: Path, tmp_path: Path) -> None:
    """Pages read pieces of a PMTiles file that may have gigabytes; another file is refused before the start."""
    (tmp_path / "base.pmtiles").write_bytes(b"PMTiles\x03" + bytes(range(200)))
    settings = StationSettings(root, base_map=tmp_path / "base.pmtiles")
    with TestClient(station_app(settings), base_url="http://127.0.0.1:8750") as client:
        url = client.get("/api/status").json()["base_map_url"]
        part = client.get(url, headers={"range": "bytes=8-11"})
        assert part.status_code == 206 and part.content == bytes([0, 1, 2, 3])
    (tmp_path / "base.pmtiles").write_bytes(b"<html>")
    with pytest.raises(SettingsError, match="PMTiles"):
        StationSettings(root, base_map=tmp_path / "base.pmtiles")


def test_a_station_without_a_base_map(client: TestClient) -> None:
    """It offers none."""
    assert client.get("/api/status").json()["base_map_url"] is None
    assert client.get("/api/base-map.pmtiles").status_code == 404
