"""The sun over a site is known where its place and the date are, and a comparison knows it on both dates."""

import json
from dataclasses import replace

import numpy as np
import pytest

from small_flights import simulate_into, small_flight
from sorvolo.change import evidence as evidence_map
from sorvolo.change.shadows import ShadowDoubt
from sorvolo.geometry.geodesy import Geodetic
from sorvolo.lab.simulation.settings import LaterSettings, WeatherSettings
from sorvolo.missions.compare.flights import compare_flights
from sorvolo.missions.flight.settings import CompareSettings, MapSettings
from sorvolo.missions.flight.sunlight import sun_over
from sorvolo.missions.map.flights import map_flights
from sorvolo.store.site.archive import Archive
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


def test_the_moved_shadows_of_people_who_stay_are_no_changes_between_two_dates(
    tmp_path, monkeypatch
):
    """The comparison judges shadows by the suns of the site. That they explain these shadows, tests of it show: which
    of the few views here show one hangs on the last bits of the poses."""
    suns = []

    class Observed(ShadowDoubt):
        def __init__(self, earlier, sun_at, *others):
            suns.append(sun_at)
            super().__init__(earlier, sun_at, *others)

    monkeypatch.setattr(evidence_map, "ShadowDoubt", Observed)
    stay = small_flight(
        4, height_m=14, length_m=14, size_px=(480, 270), noise_m=0.1, fps=3, people=4, speed_m_s=3
    )
    nothing = LaterSettings(
        people=0,
        cars=0,
        small_objects=0,
        removed=0,
        moved=0,
        weather=WeatherSettings(has_clouds=False, wind_m=0),
    )
    flown = simulate_into(
        tmp_path / "flown",
        replace(stay, flights=2, scene=replace(stay.scene, moving_share=0), later=nothing),
    )
    site, camera = tmp_path / "site", flown / "camera.xml"
    list(map_flights([flown / "flight1"], site, MapSettings(model="none"), camera=camera))
    list(compare_flights([flown / "flight2"], site, CompareSettings(model="none"), camera=camera))
    candidates = json.loads((site / "flights" / "flight2" / "report.json").read_text())[
        "comparison"
    ]["candidates"]
    assert candidates["announced"] == {"still": 0, "moving": 0}
    with Archive.open(site, write=False) as archive:
        place = archive.site()
    (sun_at,) = suns
    assert np.allclose(sun_at(NOON_NS), sun_over(place, NOON_NS))
