"""Places of a site in WGS84, and in the words that people pass on: degrees, MGRS, UTM."""

from functools import lru_cache

import numpy as np

from sorvolo.geometry.arrays import Floats
from sorvolo.geometry.geodesy import Projection, utm_epsg
from sorvolo.survey.flight import Site

SYSTEMS = {"degrees": "latitude, longitude", "mgrs": "MGRS", "utm": "UTM"}
"""The notations of a place, and what they are called."""

_BANDS = "CDEFGHJKLMNPQRSTUVWX"  # of 8 degrees of latitude from 80 S; the last has 12
_ROWS = "ABCDEFGHJKLMNPQRSTUV"
_COLUMNS = ("STUVWXYZ", "ABCDEFGH", "JKLMNPQR")  # by zone modulo 3


def longitude_latitude(points_m: Floats, site: Site) -> tuple[Floats, Floats]:
    """WGS84 degrees of site points, (N, 2) or (N, 3), (N,) each; longitudes run on where the site meets +-180."""
    latitudes, longitudes, _ = site.frame.wgs84_from_site(points_m)
    return near_longitudes(longitudes, site.origin.longitude_deg), latitudes


def near_longitudes(longitudes_deg: Floats, reference_deg: float) -> Floats:
    """The same longitudes within half a turn of the reference, so that none jumps at the antimeridian."""
    return np.asarray(longitudes_deg) + 360 * np.round((reference_deg - np.asarray(longitudes_deg)) / 360)


def wrapped_deg(longitude_deg: float) -> float:
    """The same longitude from -180 to below 180 degrees."""
    return (longitude_deg + 180) % 360 - 180


def place_words(point_m: Floats, site: Site) -> dict[str, str]:
    """A site point, (2,), in each notation of SYSTEMS that it has; of a local site, in pixels of its own ("site").

    MGRS and UTM end at 80 degrees south and 84 degrees north.
    """
    if site.is_local:
        return {"site": f"{point_m[0]:.1f}, {point_m[1]:.1f}"}
    longitudes, latitudes = longitude_latitude(np.asarray(point_m, np.float64)[None, :2], site)
    return degrees_words(float(latitudes[0]), float(longitudes[0]))


def degrees_words(latitude_deg: float, longitude_deg: float) -> dict[str, str]:
    """A place of WGS84 in each notation of SYSTEMS that it has."""
    longitude_deg = wrapped_deg(longitude_deg)
    words = {"degrees": f"{latitude_deg:.6f}, {longitude_deg:.6f}"}
    if -80 <= latitude_deg < 84:
        words |= grid_words(latitude_deg, longitude_deg)
    return words


def grid_words(latitude_deg: float, longitude_deg: float) -> dict[str, str]:
    """A place from 80 S to below 84 N in MGRS and UTM, cut to whole metres, as both have it.

    Source: NGA.STND.0037, "Universal Grids and Grid Reference Systems", 2014.
    """
    epsg = utm_epsg(latitude_deg, longitude_deg)
    zone = epsg % 100
    band = _BANDS[min(int((latitude_deg + 80) // 8), len(_BANDS) - 1)]
    east_m, north_m = _projection(epsg).projected_from_wgs84(np.array([latitude_deg]), np.array([longitude_deg]))[0]
    east, north = int(east_m), int(north_m)
    column = _COLUMNS[zone % 3][east // 100_000 - 1]
    row = _ROWS[(north // 100_000 + (5 if zone % 2 == 0 else 0)) % 20]
    return {
        "mgrs": f"{zone:02d}{band} {column}{row} {east % 100_000:05d} {north % 100_000:05d}",
        "utm": f"{zone:02d}{band} {east} {north}",
    }


@lru_cache(maxsize=8)
def _projection(epsg: int) -> Projection:
    return Projection(f"EPSG:{epsg}")
