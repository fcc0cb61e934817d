"""Places of a site in WGS84."""

import numpy as np

from sorvolo.geometry.arrays import Floats
from sorvolo.survey.flight import Site


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
