"""Places on the Earth: WGS84 to a site's east-north-up metres and back, and the site's UTM zone."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from pyproj import CRS
from pyproj.exceptions import CRSError

from sorvolo.errors import GeometryError, SettingsError
from sorvolo.geometry.arrays import Floats, PointsM
from sorvolo.geometry.crs import WGS84, transformer

_SEMI_MAJOR_M = 6378137.0  # WGS84's defining figures, this and the next
_FLATTENING = 1 / 298.257223563
_ECCENTRICITY2 = _FLATTENING * (2 - _FLATTENING)


@dataclass(frozen=True)
class Geodetic:
    """A place on WGS84; `height_m` is above the ellipsoid."""

    latitude_deg: float
    longitude_deg: float
    height_m: float = 0.0

    def __post_init__(self) -> None:
        if not (np.isfinite(self.latitude_deg) and -90 <= self.latitude_deg <= 90):
            raise GeometryError(f"latitude must lie in [-90, 90] deg, got {self.latitude_deg}")
        if not (np.isfinite(self.longitude_deg) and -180 <= self.longitude_deg <= 360):
            raise GeometryError(f"longitude must lie in [-180, 360] deg, got {self.longitude_deg}")


def ecef_from_wgs84(latitude_deg: Floats, longitude_deg: Floats, height_m: Floats) -> PointsM:
    """(N, 3) Earth-centred metres of WGS84 places."""
    lat, lon = np.radians(latitude_deg), np.radians(longitude_deg)
    prime_vertical_m = _SEMI_MAJOR_M / np.sqrt(1 - _ECCENTRICITY2 * np.sin(lat) ** 2)
    return np.stack(
        [
            (prime_vertical_m + height_m) * np.cos(lat) * np.cos(lon),
            (prime_vertical_m + height_m) * np.cos(lat) * np.sin(lon),
            (prime_vertical_m * (1 - _ECCENTRICITY2) + height_m) * np.sin(lat),
        ],
        axis=-1,
    )


def wgs84_from_ecef(points_ecef_m: PointsM) -> tuple[Floats, Floats, Floats]:
    """Latitude (deg), longitude (deg) and ellipsoidal height (m) of Earth-centred points, shape (N, 3)."""
    x, y, z = np.asarray(points_ecef_m, dtype=np.float64).T
    longitude = np.arctan2(y, x)
    horizontal_m = np.hypot(x, y)
    latitude = np.arctan2(z, horizontal_m * (1 - _ECCENTRICITY2))
    for _ in range(6):  # converges to below a micrometre within four steps near the surface
        prime_vertical_m = _SEMI_MAJOR_M / np.sqrt(1 - _ECCENTRICITY2 * np.sin(latitude) ** 2)
        latitude = np.arctan2(
            z + _ECCENTRICITY2 * prime_vertical_m * np.sin(latitude), horizontal_m
        )
    prime_vertical_m = _SEMI_MAJOR_M / np.sqrt(1 - _ECCENTRICITY2 * np.sin(latitude) ** 2)
    cos_lat, sin_lat = np.cos(latitude), np.sin(latitude)
    height_m = horizontal_m * cos_lat + z * sin_lat - _SEMI_MAJOR_M**2 / prime_vertical_m
    return np.degrees(latitude), np.degrees(longitude), height_m


@dataclass(frozen=True)
class LocalFrame:
    """The site frame: east, north, up in metres around a fixed origin on WGS84."""

    origin: Geodetic

    @cached_property
    def _site_from_ecef(self) -> Floats:
        lat, lon = np.radians(self.origin.latitude_deg), np.radians(self.origin.longitude_deg)
        return np.array(
            [
                [-np.sin(lon), np.cos(lon), 0.0],
                [-np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat)],
                [np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)],
            ]
        )

    @cached_property
    def _origin_ecef_m(self) -> Floats:
        o = self.origin
        return ecef_from_wgs84(
            np.array(o.latitude_deg), np.array(o.longitude_deg), np.array(o.height_m)
        )

    def site_from_wgs84(
        self, latitude_deg: Floats, longitude_deg: Floats, height_m: Floats
    ) -> PointsM:
        """(N, 3) east, north, up metres of WGS84 places given as (N,) arrays; works across the antimeridian."""
        ecef = ecef_from_wgs84(
            np.asarray(latitude_deg), np.asarray(longitude_deg), np.asarray(height_m)
        )
        return (ecef - self._origin_ecef_m) @ self._site_from_ecef.T

    def ground_from_lonlat(self, lonlat_deg: Any) -> PointsM:
        """(N, 2) east, north of places on the site's ground: longitudes and latitudes, (N, 2) or more columns, as an
        array or as the lists of a GeoJSON file. Raises ValueError or TypeError for what are no numbers."""
        lonlat = np.asarray(lonlat_deg, dtype=np.float64)
        if lonlat.ndim != 2 or lonlat.shape[1] < 2:
            raise ValueError(f"places are (N, 2) longitudes and latitudes, got {lonlat.shape}")
        height_m = np.full(len(lonlat), self.origin.height_m)
        return self.site_from_wgs84(lonlat[:, 1], lonlat[:, 0], height_m)[:, :2]

    def wgs84_from_site(self, points_m: PointsM) -> tuple[Floats, Floats, Floats]:
        """Latitude, longitude (deg) and ellipsoidal height (m), each (N,), of site points, shape (N, 3) or (N, 2).

        Two columns mean points on the site's ground plane, up = 0.
        """
        points = np.asarray(points_m, dtype=np.float64)
        if points.shape[-1] == 2:
            points = np.column_stack([points, np.zeros(len(points))])
        return wgs84_from_ecef(points @ self._site_from_ecef + self._origin_ecef_m)


def utm_epsg(latitude_deg: float, longitude_deg: float) -> int:
    """EPSG code of the place's UTM zone, Norway's and Svalbard's odd zones included; UPS beyond 84 N and 80 S."""
    if latitude_deg >= 84:
        return 32661
    if latitude_deg < -80:
        return 32761
    longitude = (longitude_deg + 180) % 360 - 180
    zone = int((longitude + 180) // 6) + 1
    if 56 <= latitude_deg < 64 and 3 <= longitude < 12:
        zone = 32
    if latitude_deg >= 72 and 0 <= longitude < 42:
        zone = 31 + 2 * int((longitude + 3) // 12)
    return (32600 if latitude_deg >= 0 else 32700) + zone


def check_map_crs(crs: str) -> None:
    """Raise SettingsError unless a map can be written in this CRS: a projected one, or latitude and longitude."""
    try:
        parsed = CRS.from_user_input(crs)
    except CRSError as error:
        raise SettingsError(
            f"unknown coordinate reference system {crs!r}; try one as EPSG:32633"
        ) from error
    if not (parsed.is_projected or parsed.is_geographic):
        raise SettingsError(
            f"{crs} ({parsed.name}) is no CRS of a map; choose a projected one as EPSG:32633"
        )
    try:
        transformer(crs)
    except GeometryError as error:
        raise SettingsError(str(error)) from error


@dataclass(frozen=True)
class Projection:
    """A projected metric CRS and its way to and from WGS84; `crs` is anything PROJ reads, e.g. "EPSG:32633"."""

    crs: str

    def __post_init__(self) -> None:
        try:
            parsed = CRS.from_user_input(self.crs)
        except CRSError as error:
            raise SettingsError(
                f"unknown coordinate reference system {self.crs!r}: {error}"
            ) from error
        if not parsed.is_projected:
            raise SettingsError(
                f"{self.crs} is not a projected CRS; a map needs one in metres, such as EPSG:32633"
            )

    def projected_from_wgs84(self, latitude_deg: Floats, longitude_deg: Floats) -> PointsM:
        """(N, 2) easting, northing."""
        return np.stack(
            transformer(WGS84, self.crs).transform(
                np.asarray(longitude_deg), np.asarray(latitude_deg)
            ),
            axis=-1,
        )

    def wgs84_from_projected(self, points_m: PointsM) -> tuple[Floats, Floats]:
        """Latitude and longitude (deg), each (N,), of easting, northing, shape (N, 2)."""
        points = np.asarray(points_m, dtype=np.float64)
        lon, lat = transformer(WGS84, self.crs).transform(
            points[:, 0], points[:, 1], direction="INVERSE"
        )
        return lat, lon
