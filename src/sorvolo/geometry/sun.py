"""Where the sun stands, from the time and the place."""

import math

import numpy as np

from sorvolo.geometry.arrays import Vector3
from sorvolo.geometry.units import DAY_NS

_J2000_NS = 946_728_000_000_000_000  # 2000-01-01 12:00 UTC


def sun_direction(time_ns: int, latitude_deg: float, longitude_deg: float) -> Vector3:
    """(3,) the unit vector to the sun's middle, east, north and up; within 0.05 degrees from 1950 to 2050.

    `time_ns` is UTC since 1970. Refraction is left out. Source: the low-precision formulas of the Astronomical Almanac.
    """
    days = (time_ns - _J2000_NS) / DAY_NS
    mean_deg = (280.460 + 0.9856474 * days) % 360
    anomaly = math.radians((357.528 + 0.9856003 * days) % 360)
    ecliptic = math.radians(mean_deg + 1.915 * math.sin(anomaly) + 0.020 * math.sin(2 * anomaly))
    obliquity = math.radians(23.439 - 4e-7 * days)
    ascension = math.atan2(math.cos(obliquity) * math.sin(ecliptic), math.cos(ecliptic))
    declination = math.asin(math.sin(obliquity) * math.sin(ecliptic))
    sidereal_deg = (280.46062 + 360.98564737 * days + longitude_deg) % 360
    hour_angle = math.radians(sidereal_deg) - ascension
    latitude = math.radians(latitude_deg)
    return np.array(
        [
            -math.cos(declination) * math.sin(hour_angle),
            math.sin(declination) * math.cos(latitude)
            - math.cos(declination) * math.sin(latitude) * math.cos(hour_angle),
            math.sin(declination) * math.sin(latitude)
            + math.cos(declination) * math.cos(latitude) * math.cos(hour_angle),
        ]
    )


def direction_from_angles(azimuth_deg: float, elevation_deg: float) -> Vector3:
    """(3,) the unit vector, east, north and up, to an azimuth (clockwise from north) and an elevation."""
    azimuth, elevation = math.radians(azimuth_deg), math.radians(elevation_deg)
    return np.array(
        [
            math.sin(azimuth) * math.cos(elevation),
            math.cos(azimuth) * math.cos(elevation),
            math.sin(elevation),
        ]
    )
