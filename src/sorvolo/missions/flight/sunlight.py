"""Where the sun stands over a site, as far as its place and the clock are known."""

from sorvolo.capture.sync import DATED_NS
from sorvolo.geometry.arrays import Vector3
from sorvolo.geometry.sun import sun_direction
from sorvolo.survey.flight import Site


def sun_over(site: Site, time_ns: int) -> Vector3 | None:
    """(3,) the unit vector to the sun, east, north and up, at a UTC time; None where the clock has no date, or the site
    no place on earth."""
    if site.is_local or time_ns <= DATED_NS:
        return None
    return sun_direction(time_ns, site.origin.latitude_deg, site.origin.longitude_deg)
