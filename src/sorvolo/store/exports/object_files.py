"""The files of what stands on the map: objects.geojson of a flight and of the site, and the crops."""

from collections.abc import Iterable
from typing import Any

from sorvolo.store.exports.placemarks import Placemark
from sorvolo.store.exports.places import place_deg
from sorvolo.store.exports.plain import feature_collection, rounded, time_words, utc_text
from sorvolo.store.site.object_records import StoredObject
from sorvolo.survey.flight import Site
from sorvolo.survey.map_objects import MapObject

OBJECTS = "objects"
"""The name, without ending, of the files that list a flight's or a site's objects."""

CROPS = "objects"
"""The folder of a flight's crops."""


def objects_geojson(
    objects: Iterable[StoredObject], site: Site, *, crops_from_site: bool
) -> dict[str, Any]:
    """Objects as a GeoJSON FeatureCollection, a point each (docs/formats.md).

    `crop` is relative to the site folder or to the flight's. For a local site it is plain JSON with coordinates in
    pixels of the site.
    """
    features = [_feature(each, site, crops_from_site) for each in objects]
    return feature_collection(OBJECTS, features, is_local=site.is_local)


def object_placemarks(objects: Iterable[StoredObject], site: Site) -> list[Placemark]:
    """The objects of a site with a place on Earth as placemarks."""
    placemarks = []
    for each in (stored.thing for stored in objects):
        words = (
            f"score {each.score:.2f} (0 to 1), {each.views} of {each.possible_views} frames, first seen "
            f"{time_words(each.first_seen_ns)}\nposition accuracy {each.sigma_m:.2f} m (1 sigma)"
            + ("\nmoving" if each.moving else "")
        )
        placemarks.append(
            Placemark(
                f"{each.id} {each.label}",
                words,
                *place_deg(each.position_m, site),
                each.first_seen_ns,
            )
        )
    return placemarks


def crop_name(object_id: str) -> str:
    """The file name of an object's crop."""
    return f"{object_id}.jpg"


def object_crops(objects: Iterable[MapObject]) -> dict[str, bytes]:
    """The crops, JPEG, by file name."""
    return {crop_name(each.id): each.crop_jpeg for each in objects if each.crop_jpeg}


def _feature(stored: StoredObject, site: Site, crops_from_site: bool) -> dict[str, Any]:
    each = stored.thing
    folder = f"flights/{stored.flight_id}/" if crops_from_site else ""
    east_m, north_m = each.position_m
    properties: dict[str, Any] = {
        "id": each.id,
        "flight": stored.flight_id,
        "class": each.label,
        "score": rounded(each.score, 4),
    }
    if site.is_local:
        coordinates = [rounded(east_m, 4), rounded(north_m, 4)]
    else:
        coordinates = [rounded(degrees, 8) for degrees in place_deg(each.position_m, site)]
        properties |= {"latitude": coordinates[1], "longitude": coordinates[0]}
    properties |= {
        "east_m": rounded(east_m, 3),
        "north_m": rounded(north_m, 3),
        "sigma_m": rounded(each.sigma_m, 3),
        "length_m": rounded(each.length_m, 2),
        "width_m": rounded(each.width_m, 2),
        "views": each.views,
        "possible_views": each.possible_views,
        "first_seen": utc_text(each.first_seen_ns),
        "last_seen": utc_text(each.last_seen_ns),
        "flights": list(stored.flights),
        "moving": each.moving,
        "velocity_m_s": [rounded(speed, 3) for speed in each.velocity_m_s] if each.moving else None,
        "class_scores": {name: rounded(share, 4) for name, share in each.class_scores.items()},
        "best_frame": each.best_frame,
        "crop": f"{folder}{CROPS}/{crop_name(each.id)}",
    }
    return {
        "type": "Feature",
        "id": each.id,
        "geometry": {"type": "Point", "coordinates": coordinates},
        "properties": properties,
    }
