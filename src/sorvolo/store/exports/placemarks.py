"""Places to look at, for maps and receivers: KML for Google Earth and phones, GPX 1.1 for GPS receivers."""

import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime

import gpxpy.gpx
import simplekml

from sorvolo.geometry.units import DAY_NS

_NUMBERING = threading.Lock()


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


@contextmanager
def kml_from_one(title: str) -> Iterator[simplekml.Kml]:
    """A document whose elements are numbered from 1, so that the same content gives the same bytes: simplekml counts
    for the whole process, so no other thread may make one within the block."""
    with _NUMBERING:
        simplekml.Kml.resetidcounter()
        yield simplekml.Kml(name=title)


def kml_bytes(title: str, placemarks: Sequence[Placemark]) -> bytes:
    """The places as KML: a point each, and its outline where it has one."""
    with kml_from_one(_printable(title)) as document:
        for each in placemarks:
            folder = document.newmultigeometry(
                name=_printable(each.name), description=_printable(each.description)
            )
            folder.newpoint(coords=[(each.longitude_deg, each.latitude_deg)])
            if each.outline_deg:
                folder.newpolygon(outerboundaryis=[*each.outline_deg, each.outline_deg[0]])
            folder.style.polystyle.fill = 0
            folder.style.linestyle.width = 3
            folder.style.linestyle.color = simplekml.Color.red
            if each.seen_ns >= DAY_NS:
                folder.timestamp.when = _moment(each.seen_ns).strftime("%Y-%m-%dT%H:%M:%SZ")
        return str(document.kml()).encode()


def gpx_bytes(title: str, placemarks: Sequence[Placemark]) -> bytes:
    """The places as GPX 1.1 waypoints."""
    document = gpxpy.gpx.GPX()
    document.creator, document.name = "Sorvolo", _printable(title)
    for each in placemarks:
        document.waypoints.append(
            gpxpy.gpx.GPXWaypoint(
                latitude=round(each.latitude_deg, 8),
                longitude=round((each.longitude_deg + 180) % 360 - 180, 8),
                name=_printable(each.name),
                description=_printable(each.description),
                time=_moment(each.seen_ns) if each.seen_ns >= DAY_NS else None,
            )
        )
    return document.to_xml(version="1.1").encode()


def _moment(time_ns: int) -> datetime:
    return datetime.fromtimestamp(time_ns // 1_000_000_000, UTC)


def _printable(text: str) -> str:
    """The text without letters that XML cannot hold; somebody else's model may name anything."""
    return "".join(letter for letter in text if letter.isprintable() or letter == "\n")
