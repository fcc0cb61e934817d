"""Files that a browser may take away: those of the site, by id; a GeoPackage; heights along a line."""

import json
import re
import sqlite3
import struct
import tempfile
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from xml.etree.ElementTree import canonicalize, fromstring, tostring

import pytest
import rasterio
import shapely
from fake_changes import fake_change
from fake_flights import frame, image
from pyogrio import read_dataframe
from pyproj import CRS
from rasterio.enums import ColorInterp
from starlette.testclient import TestClient
from test_objects_store import commit, search, thing

from sorvolo.station.app import station_app
from sorvolo.station.settings import StationSettings
from sorvolo.store.exports.geopackage import write_geopackage
from sorvolo.store.exports.plain import feature
from sorvolo.store.site.archive import Archive

HOST = "http://127.0.0.1:8750"
URL = "/api/sites/field/exports"


def test_listed_files_can_be_taken_and_nothing_else(client: TestClient, root: Path) -> None:
    written = (root / "field" / "mosaic.tif").read_bytes()
    listed = {each["id"]: each for each in client.get(URL).json()}
    assert listed["mosaic.tif"]["bytes"] == len(written)
    answer = client.get(listed["mosaic.tif"]["url"])
    assert answer.content == written
    assert answer.headers["content-disposition"].startswith(
        "attachment; filename*=UTF-8''field-mosaic.tif"
    )
    for wrong in ("site.db", "..%2Fstation%2Fstation.db", "pod.tif"):
        assert client.get(f"{URL}/{wrong}").status_code == 404


def test_a_damaged_file_is_refused(client: TestClient, root: Path) -> None:
    (root / "field" / "mosaic.tif").write_bytes(b"II*\0 a map")
    answer = client.get(f"{URL}/mosaic.tif")
    assert answer.status_code == 409 and "mosaic.tif is damaged" in answer.text


def test_a_link_in_a_files_place_is_refused(client: TestClient, root: Path) -> None:
    secret = root / "secret"
    secret.write_text("hidden")
    (root / "field" / "objects.kml").symlink_to(secret)
    answer = client.get(f"{URL}/objects.kml")
    assert answer.status_code == 409
    assert "hidden" not in answer.text


def test_geopackage_holds_what_the_map_shows(client: TestClient, tmp_path: Path) -> None:
    answer = client.get(f"{URL}/site.gpkg")
    assert answer.status_code == 200
    path = tmp_path / "site.gpkg"
    path.write_bytes(answer.content)
    features = client.get("/api/sites/field/collections/changes/items").json()["features"]
    with sqlite3.connect(path) as file:
        assert file.execute("PRAGMA application_id").fetchone()[0] == 0x47504B47
        rows = file.execute("SELECT id, kind FROM changes ORDER BY fid").fetchall()
        query = "SELECT geometry_type_name, srs_id FROM gpkg_geometry_columns WHERE table_name = 'changes'"
        kind, srs = file.execute(query).fetchone()
        (qml,) = file.execute(
            "SELECT styleQML FROM layer_styles WHERE f_table_name = 'changes'"
        ).fetchone()
    assert rows == [(each["id"], each["properties"]["kind"]) for each in features]
    assert (kind, srs) == ("POLYGON", 4326)
    renderer = fromstring(qml).find("renderer-v2")
    assert renderer is not None and renderer.get("attr") == "kind"
    categories = {each.get("value"): each.get("symbol") for each in renderer.iter("category")}
    drawn = {each.get("name") for each in renderer.iter("symbol")}
    assert {row[1] for row in rows} <= set(categories) and set(categories.values()) == drawn


def test_all_formats_state_the_same_of_each_object(tmp_path: Path) -> None:
    """A car that a detector and a comparison saw, and one that stood before: same place, class, times, verdict."""
    folder = tmp_path / "maps" / "field"
    commit(folder, "a", search((thing("a-o1", 3.0, 4.0),)))
    late_ns = 1_700_100_000 * 10**9
    seen = {"first_seen_ns": late_ns, "last_seen_ns": late_ns + 10**9}
    with Archive.open(folder, write=True) as archive, archive.begin_flight("b", "b", {}) as writer:
        found = search((thing("b-o1", 3.1, 4.1, **seen), thing("b-o2", 21.0, 4.0, **seen)))
        came = fake_change(1, "b", east_m=20.4, north_m=4.3)
        came = replace(came, class_after="car", last_seen_ns=late_ns + 5 * 10**9, sigma_m=0.3)
        writer.commit(
            [frame(0)], {0: writer.save_image(0, image(0))}, {}, "", search=found, changes=[came]
        )
    with Archive.open(folder, write=False) as archive:
        rows = {each["id"]: each for each in archive.findings()}
    old, new = sorted(rows, key=lambda name: len(rows[name]["properties"]["flights"]))[::-1]
    assert rows[new]["properties"]["origins"] == ["changed", "detected"]
    app = station_app(StationSettings(tmp_path / "maps"))
    with TestClient(app, base_url=HOST, client=("127.0.0.1", 5000)) as client:
        wish = {"kind": "object", "id": new, "verdict": "rejected", "note": "a trailer"}
        assert client.post("/api/sites/field/reviews", json=wish).status_code == 201
        for name in ("site.gpkg", "objects.kml", "objects.gpx", "objects.geojson"):
            (tmp_path / name).write_bytes(client.get(f"{URL}/{name}").content)
        address = "/api/sites/field/collections/{}/items"
        shown = [
            client.get(address.format(name)).json()["features"] for name in ("objects", "findings")
        ]
        for query, found in (
            ("flight=a", {old}),  # which the later flight saw, too
            ("flight=b", {old, new}),
            ("datetime=2023-11-14", {old, new}),  # a day, not its midnight
            ("datetime=2023-11-13", set()),
            ("datetime=../2023-11-14", {old, new}),
        ):
            rest = client.get(f"{address.format('findings')}?{query}").json()["features"]
            assert {each["id"] for each in rest} == found, query
    files = [json.loads((tmp_path / "objects.geojson").read_text())["features"], *shown]
    names = ("class", "flights", "first_seen", "last_seen", "east_m", "north_m", "sigma_m")
    for features in files:
        assert {each["id"] for each in features} == {old, new}
        for each in features:
            same, stated = rows[each["id"]]["properties"], each["properties"]
            assert [stated[name] for name in names] == [same[name] for name in names]
            assert each["geometry"] == rows[each["id"]]["geometry"]
            place = [stated[name] for name in ("longitude", "latitude")]
            assert place == each["geometry"]["coordinates"]
    for layer in ("objects", "findings"):
        table = read_dataframe(tmp_path / "site.gpkg", layer=layer).set_index("id")
        assert table.loc[new, ["review", "note"]].tolist() == ["rejected", "a trailer"]
        for name, row in table.iterrows():
            assert [row.geometry.x, row.geometry.y] == rows[name]["geometry"]["coordinates"]
            first = datetime.fromisoformat(rows[name]["properties"]["first_seen"])
            assert 0 <= (first - row["first_seen"]).total_seconds() < 1e-3  # as GeoPackages hold
            assert [row["east_m"], row["sigma_m"]] == [
                rows[name]["properties"][column] for column in ("east_m", "sigma_m")
            ]
    for path in ("objects.kml", "objects.gpx"):
        texts = re.findall(
            r"(?s)<name>(\w{12}) car</name>.*?first seen ([\d: -]+)", (tmp_path / path).read_text()
        )
        assert dict(texts) == {
            name: rows[name]["properties"]["first_seen"][:19].replace("T", " ") for name in rows
        }


def test_the_qgis_project_finds_what_lies_beside_it(client: TestClient, tmp_path: Path) -> None:
    """Saved as the station names them, GDAL opens all that the project names; styles are those of the GeoPackage.

    QGIS itself is not tried: the elements are those that its QgsProject and QgsMapLayer read.
    """
    listed = {each["id"] for each in client.get(URL).json()}
    for each in ("site.qgs", "site.gpkg", "mosaic.tif"):
        assert each in listed
        answer = client.get(f"{URL}/{each}")
        name = answer.headers["content-disposition"].rpartition("''")[2]
        (tmp_path / name).write_bytes(answer.content)
    (path,) = tmp_path.glob("*.qgs")
    project = fromstring(path.read_bytes())
    assert project.tag == "qgis" and project.get("version", "").startswith("3.")
    assert project.findtext("properties/Paths/Absolute") == "false"
    # without this number and each CRS's WKT QGIS 3 reads none: QgsProject, QgsCoordinateReferenceSystem::readXml
    assert project.findtext("properties/SpatialRefSys/ProjectionsEnabled") == "1"
    systems = {
        each.findtext("authid"): CRS.from_wkt(each.findtext("wkt", ""))
        for each in project.iter("spatialrefsys")
    }
    assert (
        all(f"EPSG:{crs.to_epsg()}" == name for name, crs in systems.items()) and len(systems) == 2
    )
    layers = {each.findtext("id"): each for each in project.findall("projectlayers/maplayer")}
    shown = [each.get("id") for each in project.iter("layer-tree-layer")]
    assert shown[-1] == "mosaic" and set(shown) == set(layers)  # the map below all others
    sources = {name: each.findtext("datasource", "") for name, each in layers.items()}
    assert all(each.startswith("./") for each in sources.values())
    with rasterio.open(path.parent / sources.pop("mosaic")) as map_:
        assert project.findtext("projectCrs//authid") == map_.crs.to_string()
        extent = project.find("mapcanvas/extent")
        assert extent is not None
        assert [float(each.text or "") for each in extent] == pytest.approx(map_.bounds)
        renderer = layers["mosaic"].find("pipe/rasterrenderer")
        assert renderer is not None and map_.colorinterp[
            int(renderer.get("alphaBand", "")) - 1
        ] == (ColorInterp.alpha)
    assert {"changes", "frames"} <= set(sources)
    for name, source in sources.items():
        file, _, layer = source.partition("|layername=")
        assert layer == name and len(read_dataframe(path.parent / file, layer=layer)) > 0
    with sqlite3.connect(path.parent / "field.gpkg") as file:
        styles = dict(file.execute("SELECT f_table_name, styleQML FROM layer_styles").fetchall())
    for name in sources:
        drawn = layers[name].find("renderer-v2")
        assert (drawn is None) == (name not in styles)
        if drawn is not None:
            stored = fromstring(styles[name]).find("renderer-v2")
            assert stored is not None and canonicalize(tostring(drawn)) == (
                canonicalize(tostring(stored))
            )


def test_a_project_needs_a_map(client: TestClient, root: Path) -> None:
    (root / "field" / "mosaic.tif").unlink()
    answer = client.get(f"{URL}/site.qgs")
    assert answer.status_code == 404 and "map a flight first" in answer.json()["detail"]


def test_google_earth_is_told_to_load_the_objects_again(client: TestClient, root: Path) -> None:
    (root / "field" / "objects.kml").write_text("<kml/>")
    assert "site.kml" in {each["id"] for each in client.get(URL).json()}
    answer = client.get(f"{URL}/site.kml")
    namespace = "{http://www.opengis.net/kml/2.2}"
    link = fromstring(answer.content).find(f".//{namespace}NetworkLink/{namespace}Link")
    assert link is not None
    words = {each.tag.removeprefix(namespace): each.text for each in link}
    assert (words["refreshMode"], float(words["refreshInterval"])) == ("onInterval", 30)
    for each in (answer, client.get(words["href"])):
        assert each.status_code == 200
        assert each.headers["content-type"].startswith("application/vnd.google-earth.kml+xml")


def test_a_column_of_lengths_is_numbers_also_where_none_is_known(tmp_path: Path) -> None:
    point = {"type": "Point", "coordinates": [13.0, 46.0]}
    values = {"height_change_m": None, "area_m2": None, "velocity_m_s": None, "note": None}
    write_geopackage(tmp_path / "a.gpkg", {"changes": [feature(point, values)]})
    with sqlite3.connect(tmp_path / "a.gpkg") as file:
        kinds = {row[1]: row[2] for row in file.execute("PRAGMA table_info(changes)")}
    assert [kinds[name] for name in values] == ["REAL", "REAL", "TEXT", "TEXT"]


def test_a_geopackage_leaves_nothing_behind(
    client: TestClient, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    before = set(tmp_path.iterdir())
    for wanted in ("bytes=0-9", "bytes=99999999-", "nonsense"):
        answer = client.get(f"{URL}/site.gpkg", headers={"range": wanted})
        assert answer.status_code == 200 and len(answer.content) > 1000
    head = client.head(f"{URL}/site.gpkg")
    assert int(head.headers["content-length"]) > 1000 and not head.content
    assert set(tmp_path.iterdir()) == before


def test_geopackage_mixes_polygons_and_odd_names(tmp_path: Path) -> None:
    ring = [[0, 0], [1, 0], [1, 1], [0, 0]]
    features = [
        {
            "geometry": {"type": "Polygon", "coordinates": [ring]},
            "properties": {'a"b': 1, "A": None, "list": [1], "fid": 7},
        },
        {
            "geometry": {"type": "MultiPolygon", "coordinates": [[ring]]},
            "properties": {
                'a"b': 2.5,
                "a": "2016-12-31T23:59:60Z",
                "yes": True,
                "seen": "2026-05-01T12:00:00.25+02:00",
            },
        },
    ]
    write_geopackage(tmp_path / "x.gpkg", {"some": features, "none": []})
    with sqlite3.connect(tmp_path / "x.gpkg") as file:
        rows = file.execute('SELECT "a""b", list, yes FROM some').fetchall()
        seen = file.execute("SELECT seen FROM some").fetchall()
        types = {each[1]: each[2] for each in file.execute("PRAGMA table_info(some)")}
        kind = file.execute("SELECT geometry_type_name FROM gpkg_geometry_columns").fetchall()
        (blob,) = file.execute("SELECT geom FROM some").fetchone()
        contents = file.execute("SELECT srs_id, min_x, min_y, max_x, max_y FROM gpkg_contents")
        place = contents.fetchone()
        (definition,) = file.execute(
            "SELECT definition FROM gpkg_spatial_ref_sys WHERE srs_id = ?", place[:1]
        ).fetchone()
    assert rows == [(1.0, "[1]", None), (2.5, None, 1)]
    assert (types["seen"], seen) == ("DATETIME", [(None,), ("2026-05-01T10:00:00.250Z",)])
    assert types["A"] == "TEXT"  # no clock of Python's shows that second
    assert kind == [("MULTIPOLYGON",)]
    # the table, each geometry's header (OGC 12-128r19, 2.1.3) and the definition name one CRS
    assert place == (4326, 0.0, 0.0, 1.0, 1.0)
    assert blob[:2] == b"GP" and struct.unpack_from("<i", blob, 4) == (4326,)
    assert CRS.from_wkt(definition).to_epsg() == 4326
    envelope_bytes = {0: 0, 1: 32}[(blob[3] >> 1) & 7]
    assert shapely.from_wkb(blob[8 + envelope_bytes :]).bounds == place[1:]
    write_geopackage(tmp_path / "local.gpkg", {"some": features}, is_local=True)
    with sqlite3.connect(tmp_path / "local.gpkg") as file:  # a map without GPS is nowhere on Earth
        (blob,) = file.execute("SELECT geom FROM some").fetchone()
        tables = ("gpkg_contents", "gpkg_geometry_columns")
        stated = [file.execute(f"SELECT srs_id FROM {each}").fetchone() for each in tables]
    assert stated == [(0,), (0,)] and struct.unpack_from("<i", blob, 4) == (0,)


def test_profile_of_a_site_without_heights(client: TestClient) -> None:
    answer = client.get("/api/sites/field/profile?line=12,41;12.001,41")
    assert answer.status_code == 404
    assert "sorvolo heights" in answer.json()["detail"]
    assert client.get("/api/sites/field/profile?line=12,41").status_code == 400
