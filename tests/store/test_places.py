"""Places in words: MGRS against NGA's GEOTRANS (PyPI's mgrs 1.5), the zones' exceptions."""

import numpy as np
import pytest
from fake_flights import LOCAL_SITE, SITE

from sorvolo.geometry.coordinates import Coordinates, place_text
from sorvolo.store.exports.places import degrees_words, place_words


@pytest.mark.parametrize(
    ("latitude_deg", "longitude_deg", "mgrs"),
    [
        (48.85824, 2.29451, "31U DQ 48252 11937"),
        (21.309444, -157.916861, "04Q FJ 12340 56781"),
        (-33.85678, 151.2153, "56H LH 34900 52290"),
        (60.39, 5.32, "32V KN 97230 00510"),
        (78.22, 15.65, "33X WG 14813 83004"),
        (0.0, -180.0, "01N AA 66021 00000"),
        (83.9, 179.9999, "60X WU 35574 17856"),
        (-79.5, -70.1, "19C DM 77622 74009"),
        (41.892364, 12.603457, "33T UG 01183 40602"),
        (-0.0001, 36.8, "37M BV 55134 99988"),
    ],
)
def test_as_geotrans_has_it(latitude_deg: float, longitude_deg: float, mgrs: str) -> None:
    words = place_text(latitude_deg, longitude_deg, Coordinates.MGRS)
    assert words[: len(mgrs[:6].lstrip("0"))] == mgrs[:6].lstrip("0")
    assert np.allclose(
        [int(each) for each in words.split()[2:]], [int(each) for each in mgrs.split()[2:]], atol=1
    )


def test_a_site_has_all_three_and_a_local_one_none() -> None:
    words = place_words(np.array([10.0, 20.0]), SITE)
    assert list(words) == ["latlon", "utm", "mgrs"]
    assert words["latlon"] == "46.500180, 13.250130"
    assert list(degrees_words(85.0, 10.0)) == ["latlon"]
    assert place_words(np.array([10.0, 20.0]), LOCAL_SITE) == {"site": "10.0, 20.0"}
