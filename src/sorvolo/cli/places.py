"""Places in a terminal's lists: on the Earth in the format that was asked for, else in the map's own units."""

from collections.abc import Callable
from typing import TYPE_CHECKING

from sorvolo.cli.options import PlaceFormat

if TYPE_CHECKING:
    from sorvolo.geometry.arrays import Floats
    from sorvolo.survey.flight import Site


def place_heading(site_is_local: bool, form: PlaceFormat) -> str:
    """What stands over a column of places."""
    from sorvolo.geometry.coordinates import Coordinates

    return "east, north" if site_is_local else Coordinates(form.value).heading


def place_words(site: "Site", form: PlaceFormat) -> "Callable[[Floats], str]":
    """A function that writes a place of the site, (2,) or (3,) east, north (up) metres."""
    from sorvolo.geometry.coordinates import Coordinates, place_text

    def words(point_m: "Floats") -> str:
        if site.is_local:
            return f"{point_m[0]:+.1f}, {point_m[1]:+.1f}"
        latitude, longitude, _ = site.frame.wgs84_from_site(point_m[None])
        return place_text(float(latitude[0]), float(longitude[0]), Coordinates(form.value))

    return words
