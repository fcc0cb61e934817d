"""Places of a site in WGS84, and in the words that people pass on: degrees, MGRS, UTM."""

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

import gpxpy.gpx
import numpy as np

from sorvolo.geometry.arrays import Floats
from sorvolo.geometry.coordinates import Coordinates, place_text
from sorvolo.geometry.units import DAY_NS
from sorvolo.store.pages.words import render
from sorvolo.survey.flight import Site

SYSTEMS = {system.value: system.heading for system in Coordinates}
"""The notations of a place, and what they are called."""


def longitude_latitude(points_m: Floats, site: Site) -> tuple[Floats, Floats]:
    """WGS84 degrees of site points, (N, 2) or (N, 3), (N,) each; longitudes run on where the site meets +-180."""
    latitudes, longitudes, _ = site.frame.wgs84_from_site(points_m)
    return near_longitudes(longitudes, site.origin.longitude_deg), latitudes


def place_deg(point_m: Floats, site: Site) -> tuple[float, float]:
    """WGS84 longitude and latitude of one site point, (2,) or (3,)."""
    longitudes, latitudes = longitude_latitude(np.asarray(point_m)[None], site)
    return float(longitudes[0]), float(latitudes[0])


def ring(corners_m: Floats, site: Site, digits: int) -> list[list[float]]:
    """The closed ring of GeoJSON around corners (N, 2), in degrees; of a local site in its own pixels."""
    corners = corners_m if site.is_local else np.column_stack(longitude_latitude(corners_m, site))
    return [[round(float(x), digits), round(float(y), digits)] for x, y in [*corners, corners[0]]]


def near_longitudes(longitudes_deg: Floats, reference_deg: float) -> Floats:
    """The same longitudes within half a turn of the reference, so that none jumps at the antimeridian."""
    return np.asarray(longitudes_deg) + 360 * np.round(
        (reference_deg - np.asarray(longitudes_deg)) / 360
    )


def wrapped_deg(longitude_deg: float) -> float:
    """The same longitude from -180 to below 180 degrees."""
    return (longitude_deg + 180) % 360 - 180


def place_words(point_m: Floats, site: Site) -> dict[str, str]:
    """A site point, (2,), in each notation of SYSTEMS that it has; of a local site, in pixels of its own ("site").

    MGRS and UTM end at 80 degrees south and 84 degrees north.
    """
    if site.is_local:
        return {"site": f"{point_m[0]:.1f}, {point_m[1]:.1f}"}
    longitude_deg, latitude_deg = place_deg(np.asarray(point_m, np.float64)[:2], site)
    return degrees_words(latitude_deg, longitude_deg)


def degrees_words(latitude_deg: float, longitude_deg: float) -> dict[str, str]:
    """A place of WGS84 in each notation of SYSTEMS that it has."""
    words = {
        system.value: place_text(latitude_deg, longitude_deg, system) for system in Coordinates
    }
    degrees = words[Coordinates.LATLON.value]
    return {
        name: text
        for name, text in words.items()
        if name == Coordinates.LATLON.value or text != degrees
    }


@dataclass(frozen=True)
class Placemark:
    """One place of WGS84 with its name, what stands there, and when it was seen (UTC; a clock without date counts
    from 1970). `outline_deg` are longitude and latitude of its corners, none for a point."""

    name: str
    description: str
    longitude_deg: float
    latitude_deg: float
    seen_ns: int
    outline_deg: tuple[tuple[float, float], ...] = ()

    @property
    def when(self) -> datetime | None:
        """When it was seen, to the second; None where no clock knew the date."""
        seconds = self.seen_ns // 1_000_000_000
        return datetime.fromtimestamp(seconds, UTC) if self.seen_ns >= DAY_NS else None


def kml_bytes(title: str, places: Sequence[Placemark] = (), **content: Any) -> bytes:
    """KML of places, a point each and its outline where it has one, and of what else `places.xml` knows: overlays, a
    line, a link that Google Earth loads again and again."""
    known: dict[str, Any] = {"places": places, "printable": printable, **content}
    return render("places.xml", package="sorvolo.store.exports", title=title, **known).encode()


def gpx_bytes(title: str, placemarks: Sequence[Placemark]) -> bytes:
    """The places as GPX 1.1 waypoints."""
    document = gpxpy.gpx.GPX()
    document.creator, document.name = "Sorvolo", printable(title)
    for each in placemarks:
        document.waypoints.append(
            gpxpy.gpx.GPXWaypoint(
                latitude=round(each.latitude_deg, 8),
                longitude=round(wrapped_deg(each.longitude_deg), 8),
                name=printable(each.name),
                description=printable(each.description),
                time=each.when,
            )
        )
    return document.to_xml(version="1.1").encode()


def printable(text: str) -> str:
    """The text without letters that XML cannot hold; somebody else's model may name anything."""
    return "".join(letter for letter in text if letter.isprintable() or letter == "\n")
