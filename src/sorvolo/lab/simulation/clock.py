"""When a simulated flight begins, and where the sun stands then: shadows follow from the flight's time and place."""

import math
from dataclasses import dataclass

import numpy as np

from sorvolo.geometry.arrays import Vector3
from sorvolo.geometry.sun import direction_from_angles, sun_direction
from sorvolo.geometry.units import DAY_NS
from sorvolo.lab.simulation.settings import DEFAULT_ORIGIN, SimulationSettings

_FIRST_NS = (
    1_775_133_840 * 10**9
)  # 2026-04-02 12:44 UTC at the default origin; elsewhere at the same solar time
_YEAR_DAYS = 365  # so long after a flight, at the same hour, the sun stands where it stood within 0.1 degrees
_STEP_NS = 60 * 10**9  # the minute in which a flight begins is drawn


@dataclass(frozen=True)
class DateSettings:
    """When later flights in another light begin, and under which sun."""

    apart_days: float = 84.0  # between such flights, of which ...
    drawn_days: float = 70.0  # ... so many are drawn by the seed
    sun_deg: tuple[float, float] = (
        28.0,
        62.0,
    )  # its height, least and most, where the day has them
    least_sun_deg: float = (
        10.0  # in a polar night: shadows of a lower sun leave the ground that is drawn
    )


def start_ns(
    settings: SimulationSettings, flight: int, dates: DateSettings = DateSettings()
) -> int:
    """UTC of the first frame of a flight, counted from 1: later ones in another light begin weeks later at a drawn
    hour, those in the same light years later at the same hour."""
    origin = settings.scene.origin
    first_ns = _FIRST_NS - _whole_minutes(
        (origin.longitude_deg - DEFAULT_ORIGIN.longitude_deg) / 360 * DAY_NS
    )
    if flight == 1:
        return first_ns
    if not settings.later.weather.has_other_light:
        return first_ns + (flight - 1) * _YEAR_DAYS * DAY_NS
    rng = np.random.default_rng([settings.seed, 11, flight])
    days = math.floor(dates.apart_days * (flight - 1) - dates.drawn_days * rng.random())
    times_ns = first_ns + days * DAY_NS + np.arange(-DAY_NS // 2, DAY_NS // 2, _STEP_NS)
    heights_deg = np.array(
        [math.degrees(math.asin(_sun(int(each), settings)[2])) for each in times_ns]
    )
    low_deg, high_deg = dates.sun_deg
    (possible,) = np.nonzero((heights_deg >= low_deg) & (heights_deg <= high_deg))
    return int(times_ns[rng.choice(possible) if len(possible) else heights_deg.argmax()])


def sun_of_flight(
    settings: SimulationSettings, flight: int, dates: DateSettings = DateSettings()
) -> Vector3:
    """(3,) the unit vector to the sun, east, north and up, when a flight begins; never lower than 10 degrees."""
    sun = _sun(start_ns(settings, flight, dates), settings)
    if sun[2] >= math.sin(math.radians(dates.least_sun_deg)):
        return sun
    return direction_from_angles(math.degrees(math.atan2(sun[0], sun[1])), dates.least_sun_deg)


def _sun(time_ns: int, settings: SimulationSettings) -> Vector3:
    origin = settings.scene.origin
    return sun_direction(time_ns, origin.latitude_deg, origin.longitude_deg)


def _whole_minutes(duration_ns: float) -> int:
    return round(duration_ns / _STEP_NS) * _STEP_NS
