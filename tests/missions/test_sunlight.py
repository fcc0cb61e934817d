"""The sun over a site is known where its place and the date are, and a comparison knows it on both dates."""

from dataclasses import replace

import numpy as np
import pytest

from sorvolo.geometry.geodesy import Geodetic
from sorvolo.missions.flight.setup import sun_over
from sorvolo.survey.flight import Site

ROME = Site("field", Geodetic(41.9, 12.5, 80.0), "EPSG:32633", 0.03)
NOON_NS = 1_750_504_320 * 10**9  # 2025-06-21 11:12 UTC


def test_at_noon_the_sun_stands_in_the_south_at_90_degrees_less_latitude_plus_tilt():
    east, north, up = sun_over(ROME, NOON_NS)
    assert np.degrees(np.arcsin(up)) == pytest.approx(90 - 41.9 + 23.44, abs=0.1)
    assert north < 0 and abs(np.degrees(np.arctan2(east, -north))) < 1.5


@pytest.mark.parametrize(
    ("site", "time_ns"), [(replace(ROME, is_local=True), NOON_NS), (ROME, 12_000_000_000)]
)
def test_without_a_place_or_a_date_it_is_unknown(site, time_ns):
    assert sun_over(site, time_ns) is None
