"""Places written as people write them: against GEOTRANS, and each way against the others."""

import pytest

from sorvolo.geometry.coordinates import Coordinates, place_text


@pytest.mark.parametrize(
    ("latitude", "longitude", "mgrs"),
    [
        (38.897700, -77.036500, "18S UJ 23394 07395"),  # the White House
        (48.858222, 2.294500, "31U DQ 48251 11935"),  # the Eiffel Tower
        (-33.857000, 151.215000, "56H LH 34873 52266"),  # the Sydney Opera House
        (60.392050, 5.322050, "32V KN 97355 00731"),  # Bergen lies in Norway's widened zone 32
        (78.220000, 15.650000, "33X WG 14813 83004"),  # Longyearbyen, in Svalbard's widened zone 33
    ],
)
def test_mgrs_as_geotrans_writes_it(latitude: float, longitude: float, mgrs: str) -> None:
    written = place_text(latitude, longitude, Coordinates.MGRS)
    zone, square, east, north = written.split()
    their_zone, their_square, their_east, their_north = mgrs.split()
    assert (zone, square) == (their_zone, their_square)
    assert abs(int(east) - int(their_east)) <= 1 and abs(int(north) - int(their_north)) <= 1  # m


def test_the_same_place_in_each_way() -> None:
    assert place_text(41.9, 12.5) == "41.900000, 12.500000"
    zone, easting, northing = place_text(41.9, 12.5, Coordinates.UTM).split()
    mgrs_zone, square, east, north = place_text(41.9, 12.5, Coordinates.MGRS).split()
    assert zone == mgrs_zone == "33T" and square == "TG"
    assert (
        abs(int(easting) % 100_000 - int(east)) <= 1
        and abs(int(northing) % 100_000 - int(north)) <= 1
    )


@pytest.mark.parametrize("latitude", [84.0, 89.0, -80.5])
def test_near_the_poles_there_are_degrees_only(latitude: float) -> None:
    assert place_text(latitude, 20.0, Coordinates.MGRS) == f"{latitude:.6f}, 20.000000"


def test_a_longitude_past_the_antimeridian() -> None:
    assert place_text(-17.0, 181.0) == "-17.000000, -179.000000"
    assert place_text(-17.0, 181.0, Coordinates.MGRS).startswith("1K ")
