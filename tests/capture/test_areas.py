"""Area files in every format, what lies inside, and files that are none."""

import json
import zipfile
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pyproj import Transformer

from sorvolo.capture.areas import CORRIDOR_M, read_area
from sorvolo.errors import GeometryError, InputError
from sorvolo.geometry.geodesy import Geodetic, LocalFrame
from sorvolo.survey.area import Area

FIELD = [[12.0, 45.0], [12.01, 45.0], [12.01, 45.01], [12.0, 45.01], [12.0, 45.0]]
POND = [[12.004, 45.004], [12.006, 45.004], [12.006, 45.006], [12.004, 45.006], [12.004, 45.004]]
INSIDE, IN_POND, OUTSIDE = [12.002, 45.002], [12.005, 45.005], [12.02, 45.005]


@pytest.fixture
def read(tmp_path):
    def read_text(text, name="field.geojson"):
        path = tmp_path / name
        path.write_text(text if isinstance(text, str) else json.dumps(text))
        return read_area(path)

    return read_text


def polygon(*rings):
    return {"type": "Polygon", "coordinates": list(rings)}


def kml(*rings, tag="Polygon"):
    texts = [" ".join(",".join(map(str, [*point, 120.5])) for point in ring) for ring in rings]
    if tag == "LineString":
        body = f"<LineString><coordinates>{texts[0]}</coordinates></LineString>"
    else:
        names = ["outerBoundaryIs"] + ["innerBoundaryIs"] * (len(texts) - 1)
        body = "".join(
            f"<{name}><LinearRing><coordinates>\n{text}\n</coordinates></LinearRing></{name}>"
            for name, text in zip(names, texts)
        )
        body = f"<Polygon>{body}</Polygon>"
    return (
        '<?xml version="1.0" encoding="UTF-8"?><kml xmlns="http://www.opengis.net/kml/2.2"><Document><Placemark>'
        f"<name>field</name>{body}</Placemark></Document></kml>"
    )


@pytest.mark.parametrize(
    "text",
    [
        polygon(FIELD, POND),
        {"type": "Feature", "properties": None, "geometry": polygon(FIELD, POND)},
        {
            "type": "FeatureCollection",
            "features": [
                {"type": "Feature", "properties": {}, "geometry": None},
                {
                    "type": "Feature",
                    "properties": {},
                    "geometry": {"type": "Point", "coordinates": [0, 0]},
                },
                {"type": "Feature", "properties": {}, "geometry": polygon(FIELD, POND)},
            ],
        },
        {"type": "MultiPolygon", "coordinates": [[FIELD, POND]]},
        {"type": "GeometryCollection", "geometries": [polygon(FIELD, POND)]},
        polygon([[*point, 300.0] for point in FIELD], POND[::-1]),
        kml(FIELD, POND),
        "\ufeff" + json.dumps(polygon(FIELD, POND)),
    ],
)
def test_a_field_with_a_pond(read, text):
    area = read(text)
    assert area.name == "field"
    points = np.array([INSIDE, IN_POND, OUTSIDE, [np.nan, 45.0]])
    assert area.contains(points).tolist() == [True, False, False, False]
    frame = area.frame
    outline_m = area.polygons_m(frame)[0][0]
    assert outline_m.shape == (4, 2)
    width_m = np.ptp(outline_m[:, 0])
    assert 780 < width_m < 800
    assert area.area_m2 == pytest.approx(787.6 * 1111.4 * 0.96, rel=0.01)


def test_kmz(tmp_path):
    path = tmp_path / "field.kmz"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("files/note.txt", "x")
        archive.writestr("doc.kml", kml(FIELD, POND))
    assert read_area(path).contains(np.array([INSIDE, IN_POND])).tolist() == [True, False]


def test_the_main_document_of_a_kmz_is_read(tmp_path):
    path = tmp_path / "field.kmz"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("files/links.kml", "<kml><Document/></kml>")
        archive.writestr("doc.kml", kml(FIELD, POND))
    assert read_area(path).contains(np.array([INSIDE, OUTSIDE])).tolist() == [True, False]


@pytest.mark.parametrize("encoding", ["UTF-16", "ISO-8859-1", "windows-1252"])
def test_kml_is_decoded_as_it_states(tmp_path, encoding):
    text = kml(FIELD, POND).replace("UTF-8", encoding).replace(">field<", ">Würmsee<")
    (tmp_path / "field.kml").write_bytes(text.encode(encoding))
    area = read_area(tmp_path / "field.kml")
    assert area.contains(np.array([INSIDE, IN_POND])).tolist() == [True, False]


@pytest.mark.parametrize(
    "old, new, is_clear",
    [(",", ", ", True), (",", " , ", True), (" ", ", ", False), (",120.5", ", ", False)],
)
def test_blanks_beside_the_commas_of_kml(read, old, new, is_clear):
    """Where each position still ends in a blank, they are read; else the reason is named."""
    text = kml(FIELD, POND)
    start, end = text.index("<coordinates>"), text.rindex("</coordinates>")
    changed = text[:start] + text[start:end].replace(old, new) + text[end:]
    if is_clear:
        assert read(changed).contains(np.array([INSIDE, IN_POND])).tolist() == [True, False]
    else:
        with pytest.raises(InputError, match="blanks after commas are not valid KML"):
            read(changed)


def test_the_survey_of_a_qgroundcontrol_plan(read):
    survey = {
        "type": "ComplexItem",
        "complexItemType": "survey",
        "polygon": [[latitude, longitude] for longitude, latitude in FIELD[:-1]],
    }
    takeoff = {"type": "SimpleItem", "command": 22, "params": [0, 0, 0, None, 45.0, 12.0, 50]}
    plan = {"fileType": "Plan", "version": 1, "mission": {"items": [takeoff, survey]}}
    assert read(plan, "a.plan").contains(np.array([INSIDE, OUTSIDE])).tolist() == [True, False]
    plan["mission"]["items"].pop()
    with pytest.raises(InputError, match="QGroundControl plan without a survey's polygon"):
        read(plan, "a.plan")


def test_geojson_of_another_crs_is_taken_to_wgs84(read):
    """QGIS writes the member `crs`: degrees of another datum are 50 m and more off, and metres are no degrees."""
    for code in (3004, 4265, 32633):
        there = Transformer.from_crs(4326, code, always_xy=True)
        crs = {"type": "name", "properties": {"name": f"urn:ogc:def:crs:EPSG::{code}"}}
        outline = [list(there.transform(*point)) for point in FIELD]
        area = read(polygon(outline) | {"crs": crs})
        np.testing.assert_allclose(
            sorted(area.polygons_lonlat[0][0].tolist()), sorted(FIELD[:-1]), atol=1e-7
        )
    stated = {"crs": {"type": "name", "properties": {"name": "urn:ogc:def:crs:OGC:1.3:CRS84"}}}
    assert read(polygon(FIELD) | stated).contains(np.array([INSIDE])).all()
    with pytest.raises(InputError, match=r"an ellipsoid .Bessel 1841. but no datum"):
        read(polygon(FIELD) | {"crs": {"properties": {"name": "EPSG:4004"}}})


def test_overlapping_polygons_are_a_union(read):
    shifted = [[lon + 0.005, lat] for lon, lat in FIELD]
    area = read({"type": "MultiPolygon", "coordinates": [[FIELD], [shifted]]})
    assert area.contains(np.array([[12.007, 45.005], [12.012, 45.005], [12.002, 45.005]])).all()


@pytest.mark.parametrize(
    "text",
    [
        "45.0, 12.0\n45.0, 12.01\n45.01, 12.01\n45.01, 12.0\n45.0, 12.0\n",
        "45.0 12.0\n45.0 12.01\n45.01 12.01\n45.01 12.0",
        "# my field\n45.0;12.0\n45.0;12.01 # a corner\n45.01;12.01\n45.01;12.0\n",
        "name,longitude,latitude\na,12.0,45.0\nb,12.01,45.0\nc,12.01,45.01\nd,12.0,45.01\n",
        "Lat\tLng\theight\n45.0\t12.0\t3\n45.0\t12.01\t3\n45.01\t12.01\t3\n45.01\t12.0\t3\n",
    ],
)
def test_lists_that_close_are_polygons(read, text):
    area = read(text, "field.txt")
    assert area.contains(np.array([INSIDE, IN_POND, OUTSIDE])).tolist() == [True, True, False]


def test_lists_of_several_areas(read):
    area = read("45 12\n45 12.01\n45.01 12.01\n\n\n46 12\n46 12.01\n46.01 12.01\n", "two.txt")
    assert len(area.polygons_lonlat) == 2
    assert area.contains(
        np.array([[12.009, 45.001], [12.009, 46.001], [12.009, 45.5]])
    ).tolist() == [
        True,
        True,
        False,
    ]


PATH = [
    [12.0, 45.0],
    [12.003, 45.0],
    [12.003, 45.001],
    [12.0, 45.001],
    [12.0, 45.002],
    [12.003, 45.002],
]


@pytest.mark.parametrize(
    ("text", "name"),
    [
        ("\n".join(f"{lat}, {lon}" for lon, lat in PATH), "path.csv"),
        (json.dumps({"type": "LineString", "coordinates": PATH}), "path.geojson"),
        (kml(PATH, tag="LineString"), "path.kml"),
    ],
)
def test_a_path_is_the_corridor_about_it(read, text, name):
    area = read(text, name)
    frame = LocalFrame(Geodetic(45.0, 12.0))
    corners_m = frame.site_from_wgs84(*np.array(PATH).T[::-1], np.zeros(len(PATH)))[:, :2]
    points_m = np.random.default_rng(1).uniform([-60, -60], [300, 290], (3000, 2))
    distance_m = np.full(len(points_m), np.inf)
    for a, b in pairwise(corners_m):
        along = np.clip((points_m - a) @ (b - a) / ((b - a) @ (b - a)), 0, 1)
        distance_m = np.minimum(
            distance_m, np.linalg.norm(points_m - a - along[:, None] * (b - a), axis=1)
        )
    latitude, longitude, _ = frame.wgs84_from_site(points_m)
    inside = area.contains(np.column_stack([longitude, latitude]))
    assert inside[distance_m < CORRIDOR_M - 0.1].all()
    assert not inside[distance_m > CORRIDOR_M * 1.03].any()


def test_an_area_across_the_antimeridian(read):
    ring = [[179.99, -17.0], [-179.99, -17.0], [-179.99, -16.99], [179.99, -16.99], [179.99, -17.0]]
    continued = [[lon % 360, lat] for lon, lat in ring]
    for text in (polygon(ring), polygon(continued)):
        area = read(text)
        points = np.array(
            [
                [180.0, -16.995],
                [-180.0, -16.995],
                [179.995, -16.995],
                [-179.995, -16.995],
                [179.98, -16.995],
                [0.0, -16.995],
                [180.0, 17.0],
            ]
        )
        assert area.contains(points).tolist() == [True, True, True, True, False, False, False]
        assert 1e6 < area.area_m2 < 3e6


def test_an_area_around_the_pole():
    area = Area(((np.array([[0, 89.9], [90, 89.9], [180, 89.9], [-90, 89.9]]),),))
    assert area.contains(
        np.array([[17.0, 89.99], [200.0, 89.95], [0.0, 89.8], [0.0, -90.0]])
    ).tolist() == [
        True,
        True,
        False,
        False,
    ]


@settings(max_examples=50, deadline=None)
@given(st.floats(-85, 85), st.floats(-180, 180), st.integers(3, 12), st.integers(0, 10**6))
def test_contains_does_not_depend_on_where_on_earth(latitude, longitude, corners, seed):
    rng = np.random.default_rng(seed)
    angles = 2 * np.pi * (np.arange(corners) + rng.uniform(0, 0.8, corners)) / corners
    ring_m = rng.uniform(50, 300, corners)[:, None] * np.column_stack(
        [np.cos(angles), np.sin(angles)]
    )
    frame = LocalFrame(Geodetic(latitude, longitude))

    def lonlat(points_m):
        latitude_deg, longitude_deg, _ = frame.wgs84_from_site(points_m)
        return np.column_stack([longitude_deg, latitude_deg])

    area = Area(((lonlat(ring_m),),))
    assert area.contains(lonlat(0.9 * ring_m)).all() or corners == 3
    assert not area.contains(lonlat(1.1 * ring_m)).any() or corners == 3
    np.testing.assert_allclose(area.polygons_m(frame)[0][0], ring_m, atol=0.01)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "empty"),
        ("{", "broken GeoJSON"),
        ("[" * 3000, "latitude and a longitude"),
        ('{"type":' * 3000, "broken GeoJSON"),
        ('{"a": 1}', "expected member"),
        ('{"type": "FeatureCollection", "features": []}', "neither a polygon nor a path"),
        (json.dumps({"type": "Point", "coordinates": [1, 2]}), "neither a polygon nor a path"),
        (json.dumps(polygon()), "at least one polygon"),
        (json.dumps(polygon(FIELD[:2])), "3 different points"),
        (json.dumps(polygon([FIELD[0]] * 5)), "3 different points"),
        (json.dumps(polygon([[12, 45], [13, "x"], [13, 46]])), "pair of numbers"),
        (json.dumps(polygon([[12, 45], [13, True], [13, 46]])), "pair of numbers.*got true"),
        (json.dumps(polygon([[12], [13], [14]])), "pair of numbers"),
        (json.dumps(polygon([FIELD[0], FIELD[2], FIELD[1], FIELD[3]])), "crosses itself"),
        (json.dumps(polygon([[12, 45], [12.1, 45], [12.2, 45]])), "one line"),
        (json.dumps(polygon([[45, 120], [46, 120], [46, 121]])), "swapped"),
        (json.dumps(polygon([[500000, 4600000], [500100, 4600000], [500100, 4600100]])), "metres"),
        (json.dumps(polygon(FIELD, FIELD)), "leave nothing"),
        (json.dumps(polygon([[0, 0], [20, 0], [20, 20]])), "500 km"),
        ("<kml><Document>", "broken KML"),
        ("<kml><Document/></kml>", "neither a polygon nor a path"),
        ("<kml><Polygon/></kml>", "outerBoundaryIs"),
        ('<!DOCTYPE a [<!ENTITY b "c">]><kml>&b;</kml>', "broken KML"),
        ("45.0", "latitude and a longitude"),
        ("45.0 12.0", "single point"),
        ("45 12\n46 north\n", "line 2"),
        ("120 45\n120 46\n121 46\n", "swapped"),
        ("nan nan\n45 12\n45 13", "no place"),
        ("latitude height\n45 12\n", "names no latitude and longitude"),
        ("lat lon\n", "no coordinates"),
        ("# nothing\n", "no coordinates"),
        ("45.0 12.0\n45.01 12.01\n45.0 12.01\n45.01 12.0\n45.0 12.0", "crosses itself"),
    ],
)
def test_files_that_are_no_area_name_the_reason(read, text, message):
    with pytest.raises(InputError, match=message):
        read(text, "bad.txt")


def test_files_that_cannot_be_read(tmp_path):
    with pytest.raises(InputError, match="cannot be read"):
        read_area(tmp_path / "missing.kml")
    (tmp_path / "a.kmz").write_bytes(b"PK\x03\x04 not really a zip")
    with pytest.raises(InputError, match="broken KMZ"):
        read_area(tmp_path / "a.kmz")
    with zipfile.ZipFile(tmp_path / "b.kmz", "w") as archive:
        archive.writestr("readme.txt", "x")
    with pytest.raises(InputError, match=r"no .kml"):
        read_area(tmp_path / "b.kmz")
    (tmp_path / "c.geojson").write_bytes(bytes(range(256)))
    with pytest.raises(InputError, match=r"not text.*GeoJSON"):
        read_area(tmp_path / "c.geojson")


@settings(max_examples=100, deadline=None)
@given(
    st.sampled_from(
        [json.dumps(polygon(FIELD, POND)), kml(FIELD, POND), "45 12\n45 12.01\n45.01 12.01\n"]
    ),
    st.data(),
)
def test_damaged_files_are_read_or_refused_never_worse(tmp_path_factory, text, data):
    good = text.encode()
    start = data.draw(st.integers(0, len(good)))
    end = data.draw(st.integers(start, min(len(good), start + 30)))
    path = tmp_path_factory.getbasetemp() / "damaged_area.txt"
    path.write_bytes(good[:start] + data.draw(st.binary(max_size=8)) + good[end:])
    try:
        area = read_area(path)
    except InputError:
        return
    assert area.area_m2 > 0


def test_records_check_themselves():
    with pytest.raises(GeometryError, match="at least one"):
        Area(())
    with pytest.raises(GeometryError, match="latitude"):
        Area(((np.array([[0, 95.0], [1, 95], [1, 96]]),),))
    with pytest.raises(GeometryError, match="not a number"):
        Area(((np.array([[0, np.nan], [1, 5], [1, 6]]),),))
    with pytest.raises(GeometryError, match="shape"):
        Area(((np.zeros((3, 3)),),))
