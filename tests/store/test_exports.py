"""Frames, pictures and KMZ lie where the site has them, and name what is not known."""

import json
import re
import time
import zipfile
from dataclasses import dataclass, replace
from enum import StrEnum
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest
from fake_flights import LOCAL_SITE, ORIGIN, SITE, frame, tile

from sorvolo.geometry.geodesy import Geodetic, Projection
from sorvolo.geometry.grid import SiteGrid
from sorvolo.store.exports.ground_files import frames_geojson
from sorvolo.store.exports.map_pictures import (
    LivePreview,
    picture,
    pictures,
    small_map_of,
    write_kmz,
    write_preview,
    write_small_maps,
)
from sorvolo.store.exports.places import Placemark, kml_bytes
from sorvolo.store.exports.plain import FeatureList, geojson_bytes, plain_json, utc_text
from sorvolo.store.images import shrink, unweighted, weighted
from sorvolo.survey.flight import Site
from sorvolo.survey.mosaic import Status

PROMISED = {
    "frame",
    "time",
    "status",
    "reason",
    "camera_longitude_deg",
    "camera_latitude_deg",
    "camera_height_m",
    "height_above_ground_m",
    "residual_px",
    "sigma_m",
}


def feature(collection: dict, number: int = 0) -> dict:
    return json.loads(geojson_bytes(collection))["features"][number]


def test_a_frame_is_the_ground_polygon_of_its_corners_in_order() -> None:
    placed = frame(2)
    made = feature(frames_geojson([placed], SITE))
    assert set(made["properties"]) >= PROMISED
    (ring,) = made["geometry"]["coordinates"]
    assert made["geometry"]["type"] == "Polygon"
    assert len(ring) == 5 and ring[0] == ring[4]
    back_m = SITE.frame.site_from_wgs84(
        np.array(ring)[:4, 1], np.array(ring)[:4, 0], np.full(4, ORIGIN.height_m)
    )
    assert (
        np.abs(back_m[:, :2] - placed.outline_m).max() < 1e-4
    )  # 1e-10 deg is a hundredth of a millimetre
    assert max(len(str(number).split(".")[1]) for number in ring[0]) >= 9


def test_a_frames_properties_state_where_its_camera_was() -> None:
    properties = feature(frames_geojson([frame(2)], SITE))["properties"]
    camera_m = SITE.frame.site_from_wgs84(
        np.array([properties["camera_latitude_deg"]]),
        np.array([properties["camera_longitude_deg"]]),
        np.array([properties["camera_height_m"]]),
    )[0]
    assert np.abs(camera_m - [20.0, 5.0, 20.0]).max() < 0.001
    assert properties["camera_height_m"] == ORIGIN.height_m + 20
    assert properties["height_above_ground_m"] == 20
    assert properties["height_reference"] == "ellipsoidal"
    assert (properties["camera_yaw_deg"], properties["camera_pitch_deg"]) == (30, -85)
    assert properties["gps_residual_north_m"] == -0.2
    assert properties["gps_residual_up_m"] is None
    assert properties["time"] == "2023-11-14T22:13:20.123456002Z"


def test_a_rejected_frame_has_a_reason_and_no_place() -> None:
    made = feature(frames_geojson([frame(3, Status.REJECTED)], SITE))
    assert made["geometry"] is None
    assert (made["properties"]["status"], made["properties"]["reason"]) == ("rejected", "blurred")
    for name in (
        "camera_longitude_deg",
        "camera_height_m",
        "residual_px",
        "sigma_m",
        "camera_yaw_deg",
    ):
        assert made["properties"][name] is None


def test_video_frames_are_named_by_number_and_photos_by_file() -> None:
    names = [frame(7), frame(7, name="DJI_0007.JPG"), frame(7, name="0007")]
    features = frames_geojson(names, SITE)["features"]
    assert [one["properties"]["frame"] for one in features] == [7, "DJI_0007.JPG", "0007"]


def test_a_local_site_has_units_and_no_degrees() -> None:
    placed = frame(2)
    collection = json.loads(geojson_bytes(frames_geojson([placed], LOCAL_SITE)))
    assert collection["crs"] is None
    assert "crs" not in frames_geojson([placed], SITE)
    (made,) = collection["features"]
    assert np.abs(np.array(made["geometry"]["coordinates"][0][:4]) - placed.outline_m).max() < 1e-9
    assert made["properties"]["camera_longitude_deg"] is None
    assert (made["properties"]["camera_east"], made["properties"]["camera_north"]) == (20, 5)


def test_longitudes_do_not_jump_at_the_antimeridian() -> None:
    fiji = Site("fiji", Geodetic(-17.0, 179.99985), "EPSG:32760", 0.05)
    longitudes = [
        point[0]
        for made in frames_geojson([frame(index) for index in range(6)], fiji)["features"]
        for point in made["geometry"]["coordinates"][0]
    ]
    assert max(longitudes) > 180 > min(longitudes) > 179.99


@pytest.mark.parametrize(
    ("time_ns", "text"),
    [
        (0, "1970-01-01T00:00:00.000000Z"),
        (1_700_000_000_000_001_000, "2023-11-14T22:13:20.000001Z"),
        (1_700_000_000_000_000_001, "2023-11-14T22:13:20.000000001Z"),
        (-1_000, "1969-12-31T23:59:59.999999Z"),
    ],
)
def test_times_are_utc_and_lose_nothing(time_ns: int, text: str) -> None:
    assert utc_text(time_ns) == text


def test_a_feature_is_a_line_whatever_its_values_are() -> None:
    values = (
        ([1.5, "\u00e9"], [1.5, "\u00e9"]),
        (float("nan"), None),
        (np.float32(0.5), 0.5),
        (Status.VISION, "vision"),
    )
    for plain, written in values:
        lines = (
            geojson_bytes({"name": "x", "features": [{"a": plain}, {"b": 1}]}).decode().splitlines()
        )
        assert [json.loads(line.rstrip(",")) for line in lines[1:-1]] == [{"a": written}, {"b": 1}]


def test_plain_json_holds_what_json_can() -> None:
    @dataclass(frozen=True)
    class Settings:
        gsd_m: float
        path: Path

    class Kind(StrEnum):
        FAST = "fast"

    value = {
        "settings": Settings(np.float64(0.5), Path("a/b")),
        "kind": Kind.FAST,
        "nan": np.nan,
        3: np.arange(2),
        "flags": (True, None, np.bool_(False)),
        "inf": np.float32(np.inf),
    }
    assert json.loads(json.dumps(plain_json(value), allow_nan=False)) == {
        "settings": {"gsd_m": 0.5, "path": "a/b"},
        "kind": "fast",
        "nan": None,
        "3": [0, 1],
        "flags": [True, None, False],
        "inf": None,
    }
    with pytest.raises(TypeError, match="object"):
        plain_json(object())


def marked_tiles(pixel: tuple[int, int]) -> dict[tuple[int, int], np.ndarray]:
    """Dark tiles of 3 x 2, the lower left one missing, with a white patch of 16 px around a grid pixel."""
    tiles = {(column, row): tile(0) for column in (-2, -1, 0) for row in (4, 5)}
    del tiles[-2, 5]
    for one in tiles.values():
        one[..., :3] = 10
    for y in range(pixel[1] - 8, pixel[1] + 8):
        for x in range(pixel[0] - 8, pixel[0] + 8):
            tiles[x // 512, y // 512][y % 512, x % 512, :3] = 250
    return tiles


def patch_centre(rgba: np.ndarray) -> np.ndarray:
    weight = np.clip(rgba[..., 0].astype(float) - 12, 0, None) * (rgba[..., 3] > 128)
    rows, columns = np.indices(weight.shape)
    return np.array([(weight * columns).sum(), (weight * rows).sum()]) / weight.sum()


@pytest.mark.parametrize("max_px", [4096, 1000, 200])
def test_a_small_picture_knows_where_it_lies(max_px: int) -> None:
    pixel = (-700, 2300)
    small = picture(marked_tiles(pixel), max_px)
    assert max(small.rgba.shape) <= max_px
    assert small.rgba[0, 0, 3] == 255 and small.rgba[-1, 0, 3] == 0
    place_px = (patch_centre(small.rgba) + 0.5) * small.step_px + small.corner_px
    assert np.abs(place_px - (np.array(pixel) - 0.5)).max() < 0.01 * small.step_px


def test_a_small_picture_is_cropped_and_keeps_the_colour_of_its_rim() -> None:
    half = np.zeros((512, 512, 4), np.uint8)
    half[100:, 3:203] = (200, 150, 100, 255)
    small = picture({(0, 0): half}, 64)
    assert small.rgba.shape == (52, 26, 4)
    seen = small.rgba[small.rgba[..., 3] > 0]
    assert np.abs(seen[:, :3].astype(int) - [200, 150, 100]).max() <= 1


def test_previews_are_png_with_a_transparent_background(tmp_path: Path) -> None:
    write_preview(marked_tiles((0, 2300)), tmp_path / "preview.png", 512)
    image = cv2.imread(str(tmp_path / "preview.png"), cv2.IMREAD_UNCHANGED)
    assert image.shape == (256, 384, 4)
    assert (image[200, 60, 3], image[60, 60, 3]) == (0, 255)


class Counted(dict):
    """Tiles that count how often one is read."""

    reads = 0

    def __getitem__(self, index: tuple[int, int]) -> np.ndarray:
        self.reads += 1
        return super().__getitem__(index)


def test_the_growing_map_is_shown_small_by_the_tiles_that_changed(tmp_path: Path) -> None:
    preview, path = LivePreview(512), tmp_path / "live.png"
    preview.write({}, (), path)
    assert not path.exists()
    tiles = Counted({(0, 0): tile(9)})
    preview.write(tiles, [(0, 0)], path)
    assert cv2.imread(str(path))[0, 0].tolist() == [0, 0, 9]
    tiles |= {(column, 0): tile(20 + column) for column in range(1, 5)}
    preview.write(tiles, [], path)
    assert tiles.reads == 5
    tiles[0, 0] = tile(70)
    del tiles[2, 0]
    preview.write(tiles, [(0, 0), (2, 0)], path)
    assert tiles.reads == 6
    assert np.array_equal(
        cv2.imread(str(path), cv2.IMREAD_UNCHANGED)[..., [2, 1, 0, 3]], picture(tiles, 1024).rgba
    )


def test_a_picture_knows_how_much_ground_the_map_shows() -> None:
    half = np.zeros((512, 512, 4), np.uint8)
    half[100:, 3:203] = (200, 150, 100, 255)
    assert picture({(0, 0): half, (7, 3): half}, 64).shown_m2(0.5) == 2 * 412 * 200 * 0.25


@pytest.mark.parametrize("size", [64, 128, 256])
def test_a_picture_is_made_smaller_by_the_mean_of_what_is_seen(size: int) -> None:
    rng = np.random.default_rng(size)
    rgba = rng.integers(0, 256, (512, 512, 4), dtype=np.uint8)
    rgba[..., 3] = 255 * (np.add.outer(np.arange(512), np.arange(512)) % 700 < 400)
    wanted = unweighted(cv2.resize(weighted(rgba), (size, size), interpolation=cv2.INTER_AREA))
    small = shrink(rgba, size, size)
    seen = small[..., 3] > 0
    assert np.abs(small.astype(int) - wanted)[seen].max() <= 1  # halves are rounded up or to even
    assert np.array_equal(seen, wanted[..., 3] > 0)


def test_a_large_picture_is_made_smaller_part_by_part() -> None:
    rng = np.random.default_rng(8)
    rgba = rng.integers(0, 256, (2600, 1500, 4), dtype=np.uint8)
    wanted = unweighted(cv2.resize(weighted(rgba), (750, 1300), interpolation=cv2.INTER_AREA))
    assert np.array_equal(shrink(rgba, 750, 1300), wanted)


def test_small_maps_are_written_of_tiles_as_they_pass_by(tmp_path: Path) -> None:
    tiles, site_grid = marked_tiles((-700, 2300)), SiteGrid.at(ORIGIN, 0.2, "EPSG:32633")
    write_preview(tiles, tmp_path / "preview.png")
    write_kmz(tiles, site_grid, "two fields", tmp_path / "two.kmz")
    small = small_map_of(tiles, 512)
    for index in reversed(sorted(tiles)):
        small.take(index, tiles[index])
    write_small_maps(small, site_grid, "two fields", tmp_path / "small.png", tmp_path / "small.kmz")
    assert (tmp_path / "small.kmz").read_bytes() == (tmp_path / "two.kmz").read_bytes()
    one, two = (
        cv2.imread(str(tmp_path / name), cv2.IMREAD_UNCHANGED)
        for name in ("preview.png", "small.png")
    )
    assert np.abs(np.array(one.shape) - two.shape).max() <= 1 and max(two.shape) <= 2048


@pytest.mark.parametrize("origin", [ORIGIN, Geodetic(-17.0, 179.9999), Geodetic(78.2, 15.6)])
def test_a_kmz_lies_on_the_map(tmp_path: Path, origin: Geodetic) -> None:
    crs = {46.5: "EPSG:32633", -17.0: "EPSG:32701", 78.2: "EPSG:32633"}[origin.latitude_deg]
    site_grid = SiteGrid.at(origin, 0.2, crs)
    pixel = (-700, 2300)
    write_kmz(marked_tiles(pixel), site_grid, "two fields", tmp_path / "mosaic.kmz")
    latitude, longitude = Projection(crs).wgs84_from_projected(
        site_grid.grid.projected_from_grid(np.array([pixel]) - 0.5)
    )
    found = 0
    with zipfile.ZipFile(tmp_path / "mosaic.kmz") as archive:
        document = ElementTree.fromstring(archive.read("doc.kml"))
        overlays = [one for one in document.iter() if one.tag.endswith("GroundOverlay")]
        for overlay in overlays:
            text = {one.tag.split("}")[1]: one.text for one in overlay.iter()}
            data = np.frombuffer(archive.read(text["href"]), np.uint8)
            rgba = cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
            assert max(rgba.shape) <= 1024
            if not (rgba[..., 0] > 100).any():
                continue
            found += 1
            x, y = (patch_centre(rgba) + 0.5) / rgba.shape[1::-1]
            west, east, south, north = (
                float(text[side]) for side in ("west", "east", "south", "north")
            )
            assert abs(north + y * (south - north) - latitude[0]) * 111_000 < 0.1
            off_deg = (west + x * ((east - west) % 360) - longitude[0] + 180) % 360 - 180
            assert abs(off_deg) * 111_000 * np.cos(np.radians(latitude[0])) < 0.1
    assert found == 1 and len(overlays) >= 2
    assert [path.name for path in tmp_path.iterdir()] == ["mosaic.kmz"]


def test_the_same_map_gives_the_same_kmz(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    site_grid = SiteGrid.at(ORIGIN, 0.2, "EPSG:32633")
    for name, year in (("one", 2001), ("two", 2031)):
        monkeypatch.setattr(time, "time", lambda year=year: (year - 1970) * 3.156e7)
        write_kmz(marked_tiles((-700, 2300)), site_grid, "two fields", tmp_path / f"{name}.kmz")
    assert (tmp_path / "one.kmz").read_bytes() == (tmp_path / "two.kmz").read_bytes()


def test_a_site_states_what_its_height_is_counted_from() -> None:
    above_takeoff = replace(
        SITE, origin=Geodetic(46.5, 13.25, 0.0), height_reference="above take-off"
    )
    properties = feature(frames_geojson([frame(0)], above_takeoff))["properties"]
    assert (properties["camera_height_m"], properties["height_reference"]) == (20, "above take-off")


def test_two_maps_are_shown_on_the_same_ground_and_common_tiles_are_read_once() -> None:
    class Watched(dict):
        def __getitem__(self, index: tuple[int, int]) -> np.ndarray:
            read.append(index)
            return super().__getitem__(index)

    read: list[tuple[int, int]] = []
    before = {(0, 0): tile(10), (1, 0): tile(30)}
    after = Watched({(0, 0): tile(10), (1, 0): tile(60), (2, 1): tile(90)})
    one, two = pictures([before, after], 512, alike={(0, 0)})
    assert one.rgba.shape == two.rgba.shape == (256, 384, 4)
    assert one.corner_px == two.corner_px == (-0.5, -0.5) and one.step_px == two.step_px == 4
    assert np.array_equal(one.rgba[:128, :128], two.rgba[:128, :128])
    assert not one.rgba[128:, 256:, 3].any() and (two.rgba[128:, 256:, 0] == 90).all()
    assert (two.rgba[:128, 128:256, 0] == 60).all()
    assert (0, 0) not in read and {(1, 0), (2, 1)} <= set(read)
    empty, same = pictures([{}, before], 512)
    assert not empty.rgba.any() and same.rgba.shape == empty.rgba.shape


_KML_ORDER = (
    "name",
    "description",
    "TimeStamp",
    "styleUrl",
    "Style",
    *("Placemark", "GroundOverlay", "NetworkLink"),
    *("MultiGeometry", "LineString", "Icon", "LatLonBox", "Link"),
)


@pytest.mark.parametrize(
    "content",
    [
        {
            "places": [
                Placemark("a <b>", "1\n2", 12.5, 41.9, 1_700_000_000 * 10**9, ((12.5, 41.9),) * 3),
                Placemark("", "", 12.5, 41.9, 0),
            ]
        },
        {"overlays": [("a", "files/a.png", (1.0, 2.0, 3.0, 4.0), b"")]},
        {"line": [(1, 2), (3, 4)], "height_m": 30.0, "description": "{}"},
        {"link": "http://station/objects.kml?a=1&b=2"},
    ],
)
def test_kml_is_as_its_schema_has_it(content: dict[str, Any]) -> None:
    """ogckml22.xsd by hand: features' elements in its order, ids that are names and there once, styles that exist.

    Each form was held against the schema itself, by fastkml.
    """
    document = ElementTree.fromstring(kml_bytes("t & u", **content))[0]
    names = [each.tag.rpartition("}")[2] for each in document]
    assert names[0] == "name" and names == sorted(names, key=_KML_ORDER.index)
    ids = [each.get("id", "x") for each in document.iter() if each.get("id")]
    assert len(set(ids)) == len(ids) and all(
        re.fullmatch(r"[A-Za-z_][\w.-]*", each) for each in ids
    )
    features = [each for each in document if not each.tag.endswith(("name", "Style"))]
    assert len(features) == len(content.get("places", "1"))
    for feature in features:
        parts = [each.tag.rpartition("}")[2] for each in feature]
        assert parts == sorted(parts, key=_KML_ORDER.index)
        styles = [each.text for each in feature if each.tag.endswith("styleUrl")]
        assert all(str(each).removeprefix("#") in ids for each in styles)


def test_a_geodataframe_has_times_as_times() -> None:
    geopandas = pytest.importorskip("geopandas")
    rows = {"type": "Feature", "geometry": {"type": "Point", "coordinates": [13.0, 46.0]}}
    times = ["2026-04-02T12:44:00.200000Z", "2026-04-02T12:44:01.000000001Z"]
    table = FeatureList(
        [rows | {"properties": {"first_seen": each}} for each in times]
    ).to_geodataframe()
    assert isinstance(table, geopandas.GeoDataFrame)
    assert (table.first_seen[1] - table.first_seen[0]).value == 800_000_001
    lost = FeatureList([rows | {"properties": {"announced": None}}]).to_geodataframe()
    assert lost.announced.isna().all()
