"""Places on the Earth: round trips to a micrometre everywhere, odd UTM zones, projections."""

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from pyproj import Transformer

from sorvolo.errors import GeometryError, SettingsError
from sorvolo.geometry.crs import crs_from_words, transformer, vertical_name
from sorvolo.geometry.geodesy import (
    Geodetic,
    LocalFrame,
    Projection,
    check_map_crs,
    ecef_from_wgs84,
    utm_epsg,
    wgs84_from_ecef,
)

latitudes = st.floats(-90, 90)
longitudes = st.floats(-180, 180)
heights = st.floats(-400, 9000)
ECEF = Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)


@given(latitudes, longitudes, heights)
@example(90.0, 0.0, 100.0)
@example(-90.0, 45.0, 0.0)
@example(0.0, 180.0, 0.0)
def test_ecef_is_projs_and_comes_back_to_a_micrometre(latitude, longitude, height_m):
    ecef_m = ecef_from_wgs84(np.array([latitude]), np.array([longitude]), np.array([height_m]))
    np.testing.assert_allclose(ecef_m[0], ECEF.transform(longitude, latitude, height_m), atol=1e-6)
    again_m = ecef_from_wgs84(*wgs84_from_ecef(ecef_m))
    np.testing.assert_allclose(again_m, ecef_m, atol=1e-6)


@given(
    latitudes,
    longitudes,
    heights,
    st.floats(-5000, 5000),
    st.floats(-5000, 5000),
    st.floats(-200, 500),
)
@example(90.0, 0.0, 0.0, 10.0, -20.0, 5.0)
@example(-90.0, 123.0, 0.0, 10.0, -20.0, 5.0)
@example(10.0, 180.0, 0.0, 30.0, 0.0, 0.0)
@example(10.0, -180.0, 0.0, -30.0, 0.0, 0.0)
def test_site_metres_there_and_back_to_a_micrometre(latitude, longitude, height_m, east, north, up):
    frame = LocalFrame(Geodetic(latitude, longitude, height_m))
    point_m = np.array([[east, north, up]])
    back_m = frame.site_from_wgs84(*frame.wgs84_from_site(point_m))
    np.testing.assert_allclose(back_m, point_m, atol=1e-6)


@given(st.floats(-85, 85), longitudes)
def test_axes_point_east_north_and_up(latitude, longitude):
    frame = LocalFrame(Geodetic(latitude, longitude))
    above = frame.site_from_wgs84(np.array([latitude]), np.array([longitude]), np.array([7.0]))
    np.testing.assert_allclose(above, [[0, 0, 7]], atol=1e-6)
    east = frame.site_from_wgs84(np.array([latitude]), np.array([longitude + 1e-4]), np.zeros(1))[0]
    north = frame.site_from_wgs84(np.array([latitude + 1e-4]), np.array([longitude]), np.zeros(1))[
        0
    ]
    assert east[0] > 0.9
    assert abs(east[1]) < 1e-3
    assert 11.0 < north[1] < 11.2
    assert abs(north[0]) < 1e-6


def test_a_site_across_the_antimeridian_is_one_piece():
    frame = LocalFrame(Geodetic(-17.0, 179.9999))
    west, east = frame.site_from_wgs84(
        np.full(2, -17.0), np.array([179.9998, -179.9999]), np.zeros(2)
    )
    assert -12 < west[0] < -10
    assert 20 < east[0] < 22
    _, longitude, _ = frame.wgs84_from_site(np.array([[30.0, 0.0]]))
    assert longitude[0] < -179.99


def test_two_columns_are_points_on_the_sites_ground():
    frame = LocalFrame(Geodetic(45.0, 9.0, 120.0))
    on_ground = frame.wgs84_from_site(np.array([[3.0, 4.0]]))
    assert on_ground[2][0] == pytest.approx(120.0, abs=1e-5)


@pytest.mark.parametrize(
    ("latitude", "longitude", "epsg"),
    [
        (45.0, 9.0, 32632),
        (-33.9, 151.2, 32756),
        (0.0, -180.0, 32601),
        (0.0, 180.0, 32601),
        (0.0, 179.99, 32660),
        (0.0, 360.0, 32631),
        (-0.001, 0.0, 32731),
        (60.0, 5.0, 32632),
        (60.0, 2.9, 32631),
        (64.0, 5.0, 32631),
        (55.99, 5.0, 32631),  # Bergen's wide zone
        (78.0, 8.9, 32631),
        (78.0, 9.0, 32633),
        (78.0, 20.9, 32633),
        (78.0, 21.0, 32635),
        (78.0, 33.0, 32637),
        (78.0, 42.0, 32638),
        (71.9, 8.9, 32632),  # Svalbard
        (84.0, 0.0, 32661),
        (90.0, 10.0, 32661),
        (-80.0, 0.0, 32731),
        (-80.1, 0.0, 32761),
    ],
)
def test_utm_zones(latitude, longitude, epsg):
    assert utm_epsg(latitude, longitude) == epsg


@given(st.floats(-80, 83.9), longitudes)
def test_utm_there_and_back_to_a_tenth_of_a_millimetre(latitude, longitude):
    projection = Projection(f"EPSG:{utm_epsg(latitude, longitude)}")
    point_m = projection.projected_from_wgs84(np.array([latitude]), np.array([longitude]))
    assert 1e5 < point_m[0, 0] < 9e5
    lat, lon = projection.wgs84_from_projected(point_m)
    assert lat[0] == pytest.approx(latitude, abs=1e-9)
    assert np.cos(np.radians(lon[0] - longitude)) == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize("crs", ["EPSG:4326", "EPSG:99999999", "nonsense", "EPSG:4978"])
def test_a_crs_that_is_not_projected_is_refused(crs):
    with pytest.raises(SettingsError):
        Projection(crs)


@pytest.mark.parametrize(
    "place", [(90.1, 0), (-91, 0), (np.nan, 0), (0, 361), (0, -180.1), (0, np.inf)]
)
def test_places_off_the_earth_are_refused(place):
    with pytest.raises(GeometryError):
        Geodetic(*place)


@pytest.mark.parametrize(
    "words, code, heights",
    [
        ("WGS84 UTM 33T", 32633, ""),
        ("WGS 84 / UTM zone 33N", 32633, ""),
        ("WGS84 UTM 33S", 32733, ""),
        ("wgs84 utm 33h", 32733, ""),
        ("WGS84", 4326, ""),
        ("EPSG:32633+5773", 32633, "EGM96 height"),
        ("EPSG:4979", 4979, "ellipsoid"),
        ("+proj=utm +zone=33 +datum=WGS84", 32633, ""),
    ],
)
def test_words_of_a_crs(words, code, heights):
    crs = crs_from_words(words)
    horizontal = crs.sub_crs_list[0] if crs.is_compound else crs
    assert (horizontal.to_epsg(), vertical_name(crs)) == (code, heights)


@pytest.mark.parametrize(
    "words, found",
    [
        (
            "+proj=tmerc +lon_0=15 +k=0.9996 +x_0=2520000 +ellps=intl",
            "International 1924.*no datum",
        ),
        ("+proj=merc +a=6378137 +b=6378137", "no datum"),
        ("EPSG:4004", "Bessel 1841.*no datum"),
        ("EPSG:3785", "Popular Visualisation Datum"),
        ("EPSG:5773", "no CRS of a map"),
        ("WGS84 UTM 33O", "is no CRS"),
        ("WGS84 UTM 61N", "is no CRS"),
        ("+proj=utm +zone=33 +nadgrids=x", "nadgrids"),
    ],
)
def test_a_crs_of_no_known_place_is_refused(words, found):
    with pytest.raises(GeometryError, match=found):
        crs_from_words(words)


def test_a_map_and_a_projection_want_a_known_datum():
    with pytest.raises(SettingsError, match="Popular Visualisation Datum"):
        check_map_crs("EPSG:3785")
    with pytest.raises(GeometryError, match="no datum"):
        Projection("+proj=utm +zone=33 +ellps=intl").projected_from_wgs84(np.zeros(1), np.zeros(1))
    # the Italian grid with its datum: 73 m from where an ellipsoid alone would put it
    there = transformer("EPSG:3004").transform(2_320_000, 4_642_000)
    named = "+proj=tmerc +lat_0=0 +lon_0=15 +k=0.9996 +x_0=2520000 +y_0=0 +ellps=intl +units=m"
    shift = " +towgs84=-104.1,-49.1,-9.9,0.971,-2.917,0.714,-11.68"
    np.testing.assert_allclose(
        transformer(named + shift).transform(2_320_000, 4_642_000), there, atol=1e-6
    )
