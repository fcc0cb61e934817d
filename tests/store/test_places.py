"""Places in words: MGRS against NGA's GEOTRANS (PyPI's mgrs 1.5), the zones' exceptions, and back by PROJ."""

import numpy as np
import pytest
from fake_flights import LOCAL_SITE, SITE
from hypothesis import given
from hypothesis import strategies as st
from pyproj import Transformer

from sorvolo.store.exports.places import grid_words, place_words


@pytest.mark.parametrize(("latitude_deg", "longitude_deg", "mgrs"), [
    (48.85824, 2.29451, "31U DQ 48252 11937"), (21.309444, -157.916861, "04Q FJ 12340 56781"),
    (-33.85678, 151.2153, "56H LH 34900 52290"), (60.39, 5.32, "32V KN 97230 00510"),
    (78.22, 15.65, "33X WG 14813 83004"), (0.0, -180.0, "01N AA 66021 00000"), (83.9, 179.9999, "60X WU 35574 17856"),
    (-79.5, -70.1, "19C DM 77622 74009"), (41.892364, 12.603457, "33T UG 01183 40602"),
    (-0.0001, 36.8, "37M BV 55134 99988"),
])
def test_as_geotrans_has_it(latitude_deg: float, longitude_deg: float, mgrs: str) -> None:
    words = grid_words(latitude_deg, longitude_deg)["mgrs"]
    assert words[:6] == mgrs[:6]
    assert np.allclose([int(each) for each in words.split()[2:]], [int(each) for each in mgrs.split()[2:]], atol=1)


@given(st.floats(-80, 83.99), st.floats(-180, 179.9999))
def test_utm_leads_back_to_the_place(latitude_deg: float, longitude_deg: float) -> None:
    zone, east, north = grid_words(latitude_deg, longitude_deg)["utm"].split()
    code = (32700 if latitude_deg < 0 else 32600) + int(zone[:-1])
    back = Transformer.from_crs(f"EPSG:{code}", "EPSG:4326", always_xy=True)
    longitude, latitude = back.transform(int(east) + 0.5, int(north) + 0.5)
    assert abs(latitude - latitude_deg) < 1e-5
    across = abs((longitude - longitude_deg + 180) % 360 - 180) * np.cos(np.radians(latitude_deg))
    assert across < 1e-5
    assert grid_words(latitude_deg, longitude_deg)["mgrs"].split()[2] == east[-5:]


def test_a_site_has_all_three_and_a_local_one_none() -> None:
    words = place_words(np.array([10.0, 20.0]), SITE)
    assert list(words) == ["degrees", "mgrs", "utm"]
    assert words["degrees"] == "46.500180, 13.250130"
    assert place_words(np.array([10.0, 20.0]), LOCAL_SITE) == {"site": "10.0, 20.0"}
