"""How a place on the Earth is written for people: latitude and longitude, UTM, or MGRS."""

from enum import StrEnum

import numpy as np

from sorvolo.errors import SettingsError
from sorvolo.geometry.geodesy import Projection, utm_epsg

_BANDS = "CDEFGHJKLMNPQRSTUVWX"  # of latitude, 8 deg each from 80 S; the last has 12
_COLUMNS = ("ABCDEFGH", "JKLMNPQR", "STUVWXYZ")  # of 100 km squares, in zones 1, 2, 3, 4 (as 1) ...
_ROWS = "ABCDEFGHJKLMNPQRSTUV"  # repeat every 2,000 km; even zones begin at F
_SQUARE_M = 100_000  # MGRS's squares of 100 km


class Coordinates(StrEnum):
    """A way to write a place."""

    LATLON = "latlon"
    UTM = "utm"
    MGRS = "mgrs"

    @property
    def heading(self) -> str:
        """What stands over a column of such places."""
        return {
            Coordinates.LATLON: "latitude, longitude",
            Coordinates.UTM: "UTM",
            Coordinates.MGRS: "MGRS",
        }[self]


def lonlat_from_text(text: str) -> tuple[float, float]:
    """Longitude and latitude of "41.9, 12.5" (latitude first, degrees). Raises SettingsError for anything else."""
    try:
        latitude_deg, longitude_deg = (float(each) for each in text.split(","))
    except ValueError as error:
        raise SettingsError(
            f"{text!r} is no place; give LAT,LON in degrees, such as 41.9,12.5"
        ) from error
    if not (abs(latitude_deg) <= 90 and abs(longitude_deg) <= 360):
        raise SettingsError(
            f"{text!r} lies off the Earth; give latitude first, then longitude, in degrees"
        )
    return longitude_deg, latitude_deg


def place_text(
    latitude_deg: float, longitude_deg: float, system: Coordinates = Coordinates.LATLON
) -> str:
    """A WGS84 place in words for people: "41.900000, 12.500000", "33T 292645 4641872" or "33T TG 92645 41872".

    Latitude and longitude have six decimals, UTM (zone, band, easting, northing) and MGRS whole metres; MGRS metres are
    cut off, not rounded, as NGA.STND.0037 asks. North of 84 N and south of 80 S there is neither UTM nor MGRS here:
    latitude and longitude are given. Longitudes beyond 180 deg are brought into -180 to 180.
    """
    longitude_deg = (longitude_deg + 180) % 360 - 180
    if system is Coordinates.LATLON or not -80 <= latitude_deg < 84:
        return f"{latitude_deg:.6f}, {longitude_deg:.6f}"
    epsg = utm_epsg(latitude_deg, longitude_deg)
    easting, northing = Projection(f"EPSG:{epsg}").projected_from_wgs84(
        np.array([latitude_deg]), np.array([longitude_deg])
    )[0]
    zone = epsg % 100
    band = f"{zone}{_BANDS[min(int((latitude_deg + 80) // 8), len(_BANDS) - 1)]}"
    if system is Coordinates.UTM:
        return f"{band} {round(easting):06d} {round(northing):07d}"
    east_m, north_m = int(easting), int(northing)
    column = _COLUMNS[(zone - 1) % 3][east_m // _SQUARE_M - 1]
    row = _ROWS[(north_m // _SQUARE_M + (5 if zone % 2 == 0 else 0)) % len(_ROWS)]
    return f"{band} {column}{row} {east_m % _SQUARE_M:05d} {north_m % _SQUARE_M:05d}"
