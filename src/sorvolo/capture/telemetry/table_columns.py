"""The columns of flight tables: what programs call each quantity, and the units that their headers print.

DatCon (the UMCD dataset's table, thesis Table 2.2), Airdata, and the logs of DJI's apps as viewers export them
(`OSD.*`, `GIMBAL.*`, `CUSTOM.*`) are known, and plain names.
"""

import re
from collections.abc import Mapping

import numpy as np

from sorvolo.geometry.units import FOOT_M, KM_AN_HOUR_M_S, KNOT_M_S, MILE_AN_HOUR_M_S

COLUMN_NAMES: Mapping[str, tuple[str, ...]] = {
    "latitude": ("latitude", "lat", "gpslat", "gpslatitude", "osdlatitude"),
    "longitude": (
        "longitude",
        "lon",
        "long",
        "lng",
        "gpslon",
        "gpslong",
        "gpslongitude",
        "osdlongitude",
    ),
    "altitude": (
        "gpsaltitude",
        "altitudeabovesealevel",
        "altitudemsl",
        "abvsealevel",
        "osdaltitude",
    ),
    "relative_height": (
        "relativeheight",
        "heightabovetakeoff",
        "relativealtitude",
        "relalt",
        "osdheight",
    ),
    "barometer": ("baroalt",),
    "camera_yaw": ("gimbalyaw", "gimbalheading"),
    "camera_pitch": ("gimbalpitch",),
    "camera_roll": ("gimbalroll",),
    "body_yaw": ("yaw", "compassheading", "osdyaw"),
    "body_pitch": ("pitch", "osdpitch"),
    "body_roll": ("roll", "osdroll"),
    "velocity_north": ("veln", "velocitynorth", "xspeed", "osdxspeed"),
    "velocity_east": ("vele", "velocityeast", "yspeed", "osdyspeed"),
    "speed": ("groundspeed", "speed", "customhspeed"),
    "course": ("course", "directionoftravel"),
    "quaternion_w": ("quatw",),
    "quaternion_x": ("quatx",),
    "quaternion_y": ("quaty",),
    "quaternion_z": ("quatz",),
    "offset_time": ("offsettime",),
    "flight_time": ("flighttime",),
    "flown_time": ("osdflytime",),
    "time": ("time", "elapsedtime"),
    "tick": ("tick", "ticks"),
    "utc": (
        "gpsdatetimestamp",
        "datetimestamp",
        "datetimeutc",
        "utcdatetime",
        "datetime",
        "utc",
        "utctime",
        "gpstime",
        "timestamp",
        "customupdatetime",
    ),
    "date": ("customdate",),
}
"""What each quantity's column may be called: lower case without blanks and punctuation, best first."""

COUNTERS = ("offset_time", "flight_time", "flown_time", "time", "tick")
"""The columns that count time from some moment, the most trusted first."""

_DEGREES = {
    "": 1.0,
    "degrees": 1.0,
    "degree": 1.0,
    "deg": 1.0,
    "°": 1.0,
    "radians": 180 / np.pi,
    "radian": 180 / np.pi,
    "rad": 180 / np.pi,
}
_METRES = {
    "": 1.0,
    "m": 1.0,
    "meters": 1.0,
    "metres": 1.0,
    "meter": 1.0,
    "metre": 1.0,
    "feet": FOOT_M,
    "foot": FOOT_M,
    "ft": FOOT_M,
    "cm": 0.01,
    "centimeters": 0.01,
    "mm": 0.001,
    "km": 1000.0,
    "kilometers": 1000.0,
}
_METRES_A_SECOND = {
    "": 1.0,
    "m/s": 1.0,
    "mps": 1.0,
    "meters/s": 1.0,
    "km/h": KM_AN_HOUR_M_S,
    "kmh": KM_AN_HOUR_M_S,
    "kph": KM_AN_HOUR_M_S,
    "mph": MILE_AN_HOUR_M_S,
    "knots": KNOT_M_S,
    "kn": KNOT_M_S,
    "kt": KNOT_M_S,
    "feet/s": FOOT_M,
    "ft/s": FOOT_M,
    "cm/s": 0.01,
}
_SECONDS = {
    "s": 1.0,
    "sec": 1.0,
    "seconds": 1.0,
    "second": 1.0,
    "msec": 1e-3,
    "ms": 1e-3,
    "millisecond": 1e-3,
    "milliseconds": 1e-3,
    "usec": 1e-6,
    "us": 1e-6,
    "microseconds": 1e-6,
    "nsec": 1e-9,
    "ns": 1e-9,
    "minutes": 60.0,
    "min": 60.0,
}
_UNITS: Mapping[str, Mapping[str, float]] = {
    **dict.fromkeys(("altitude", "relative_height", "barometer"), _METRES),
    **dict.fromkeys(("velocity_north", "velocity_east", "speed"), _METRES_A_SECOND),
    **{f"quaternion_{axis}": {"": 1.0} for axis in "wxyz"},
    "tick": {"": 1.0},
    "offset_time": {"": 1.0, **_SECONDS},
    "flight_time": {"": 1e-3, **_SECONDS},
    "flown_time": {"": 1.0, **_SECONDS},
    "time": {"": 1.0, **_SECONDS},
    "utc": {"": 1.0, "utc": 1.0, "gps": 1.0, "local": 1.0, **_SECONDS},
    "date": {"": 1.0, "utc": 1.0, "local": 1.0},
}
_PUNCTUATION = re.compile(r"[\s_#:.\-\xa0]+")


def plain_name(cell: str) -> tuple[str, str]:
    """A header's cell as plain name and unit: "velN(M/S)" and "velN [m/s]" are ("veln", "m/s")."""
    label, _, rest = cell.replace("[", "(").replace("]", ")").partition("(")
    return _PUNCTUATION.sub("", label).lower(), rest.partition(")")[0].strip().lower()


def unit_factor(quantity: str, unit: str) -> float | None:
    """The factor to our unit (deg, m, m/s, s) of one that a header prints; None for an unknown one."""
    return _UNITS.get(quantity, _DEGREES).get(unit)
