"""The files of a comparison: changes as GeoJSON, their crops before and after, and the views' masks."""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path, PurePath
from typing import Any

import cv2
import numpy as np

from sorvolo.findings.register import UNNAMED, GroundFinding
from sorvolo.geometry.arrays import Boxes, Floats, ImageGray, ImageRGB, Mask
from sorvolo.geometry.polygons import signed_area
from sorvolo.store.atomic import atomic_write_bytes, make_folder
from sorvolo.store.exports.places import Placemark, place_deg, ring
from sorvolo.store.exports.plain import (
    feature,
    feature_collection,
    frame_number,
    rounded,
    time_words,
    utc_text,
)
from sorvolo.store.images import png_from_rgba
from sorvolo.store.site.change_records import StoredChange, StoredObject, grouped_changes
from sorvolo.survey.findings import Change, Verdict
from sorvolo.survey.flight import Site
from sorvolo.survey.map_objects import MapObject

CHANGED, UNCHANGED, UNKNOWN = 255, 0, 128
"""The meaning of a pixel in a view's mask."""

BOXES_FILE = "boxes.json"
_SIZES = ("area_m2", "length_m", "sigma_m", "sigma_in_map_m")
_PICTURE_ENDINGS = {".jpg", ".jpeg", ".png", ".tif", ".tiff", ".dng", ".bmp"}


def changes_geojson(changes: Iterable[StoredChange], site: Site) -> dict[str, Any]:
    """The changes of a flight as a GeoJSON FeatureCollection, one polygon each (docs/formats.md).

    Rings turn counter-clockwise, ten decimals. Longitudes run on beyond 180 degrees where a site meets the
    antimeridian. For a local site it is plain JSON with coordinates in pixels of the site.
    """
    stored = list(changes)
    places, ranked = {}, Counter[str]()
    for group in grouped_changes(stored):
        for each in group:
            ranked[each.flight_id] += 1
            places[each.id] = {"rank": ranked[each.flight_id], "group": group[0].id}
    features = [_feature(change, site, places[change.id]) for change in stored]
    return feature_collection("changes", features, is_local=site.is_local)


def change_placemarks(changes: Iterable[StoredChange], site: Site) -> list[Placemark]:
    """The changes of a site with a place on Earth as placemarks, rejected ones left out."""
    return [
        Placemark(
            f"{each.id} {each.kind.value}",
            _description(each),
            *place_deg(each.centre_m, site),
            each.first_seen_ns,
            tuple((x, y) for x, y in _ring(each.outline_m, site)[:-1]),
        )
        for each in changes
        if each.verdict is not Verdict.REJECTED
    ]


def crop_files(changes: Sequence[Change]) -> dict[str, bytes]:
    """The PNG pictures of the changes before and after, by file name."""
    return {
        name: png_from_rgba(rgba)
        for each in changes
        for name, rgba in zip(crop_names(each.id), (each.patch.before, each.patch.after))
    }


def crop_names(change_id: str) -> tuple[str, str]:
    """The file names of a change's pictures before and after."""
    return f"{change_id}-before.png", f"{change_id}-after.png"


def write_view_masks(folder: Path, name: str, changed: ImageGray, valid: Mask) -> Path:
    """Write one view's mask `<name>.png` into the folder: 255 changed, 0 unchanged, 128 unknown; return its path.

    `changed` and `valid` are (H, W), as in `survey.findings.ComparedView`. Raises StoreError on a full disk.
    """
    mask: ImageGray = np.where(valid, np.where(changed > 0, CHANGED, UNCHANGED), UNKNOWN).astype(
        np.uint8
    )
    path = folder / f"{name}.png"
    _, data = cv2.imencode(".png", mask)
    atomic_write_bytes(path, data.tobytes(), durable=False)
    return path


def write_pictures(folder: Path, pictures: Mapping[str, ImageRGB | ImageGray]) -> None:
    """Write pictures, RGB or gray uint8, as `<name>.png` into the folder, which is made; StoreError on a full disk."""
    make_folder(folder)
    for name, picture in pictures.items():
        shown = picture if picture.ndim == 2 else cv2.cvtColor(picture, cv2.COLOR_RGB2BGR)
        _, data = cv2.imencode(".png", shown)
        atomic_write_bytes(folder / f"{name}.png", data.tobytes(), durable=False)


def mask_name(frame_name: str, taken: Iterable[str] = ()) -> str:
    """The name of a frame's mask without its ending: a photo's name without its own, unless that is `taken`."""
    path = PurePath(frame_name)
    short = path.stem if path.suffix.lower() in _PICTURE_ENDINGS else path.name
    return path.name if short in set(taken) else short


def boxes_json(boxes: Boxes) -> list[list[int]]:
    """(N, 4) boxes as lists of x, y, width, height."""
    return [[int(number) for number in box] for box in np.asarray(boxes).reshape(-1, 4)]


def _feature(change: StoredChange, site: Site, of_list: Mapping[str, Any]) -> dict[str, Any]:
    east_m, north_m = change.centre_m
    is_still, risen = not np.any(change.velocity_m_s), change.height_change
    properties = {
        "id": change.id,
        "number": change.number,
        "kind": change.kind.value,
        **of_list,
        "score": rounded(change.score, 4),
        "first_seen": utc_text(change.first_seen_ns),
        "last_seen": utc_text(change.last_seen_ns),
        "announced": utc_text(change.announced_ns) if change.announced_ns >= 0 else None,
        "views": change.views,
        "single_view": change.is_single_view,
        **{name: rounded(getattr(change, name), 4) for name in _SIZES},
        "height_change_m": None if risen is None else rounded(risen.rise_m, 3),
        "height_change_sigma_m": None if risen is None else rounded(risen.sigma_m, 3),
        "class_before": change.class_before or None,
        "class_after": change.class_after or None,
        "east_m": rounded(east_m, 4),
        "north_m": rounded(north_m, 4),
        "velocity_m_s": None if is_still else [rounded(each, 3) for each in change.velocity_m_s],
        "review": None if change.verdict is None else change.verdict.value,
        "note": change.note or None,
    }
    geometry = {"type": "Polygon", "coordinates": [_ring(change.outline_m, site)]}
    outline_m = [[rounded(east, 4), rounded(north, 4)] for east, north in change.outline_m]
    return feature(geometry, properties, id=change.id) | {"outline_m": outline_m}


def _description(change: StoredChange) -> str:
    """A change in words, a line each."""
    views = "one view alone" if change.is_single_view else f"{change.views} views"
    lines = [
        f"score {change.score:.2f} (0 to 1), {views}, first seen {time_words(change.first_seen_ns)}",
        f"length {change.length_m:.2f} m, area {change.area_m2:.2f} m2",
        f"position accuracy {change.sigma_m:.2f} m (1 sigma)",
    ]
    if change.height_change is not None:
        risen = change.height_change
        lines.append(
            f"height change {risen.rise_m:+.2f} m, accuracy {risen.sigma_m:.2f} m (1 sigma)"
        )
    lines += [
        f"{words}: {name}"
        for words, name in (("before", change.class_before), ("now", change.class_after))
        if name
    ]
    if change.verdict is not None:
        lines.append(change.verdict.value + (f": {change.note}" if change.note else ""))
    return "\n".join(lines)


def _ring(outline_m: Floats, site: Site) -> list[list[float]]:
    return ring(outline_m if signed_area(outline_m) >= 0 else outline_m[::-1], site, 10)


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
    features = [_feature_object(each, site, crops_from_site) for each in objects]
    return feature_collection(OBJECTS, features, is_local=site.is_local)


def object_placemarks(objects: Iterable[StoredObject], site: Site) -> list[Placemark]:
    """The objects of a site with a place on Earth as placemarks."""
    placemarks = []
    for stored in objects:
        each = _as_found(stored)
        words = (
            f"score {each.score:.2f} (0 to 1), {each.views} of {each.possible_views} frames, first seen "
            f"{time_words(each.first_seen_ns)}\nposition accuracy {each.sigma_m:.2f} m (1 sigma)"
            + ("\nmoving" if each.moving else "")
        )
        placemarks.append(
            Placemark(
                f"{_identity(stored)} {each.label}",
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


def finding_feature(found: GroundFinding, site: Site) -> dict[str, Any]:
    """A finding as a point of GeoJSON; of a local site in its own pixels."""
    east_m, north_m = found.position_m.tolist()
    place = (east_m, north_m) if site.is_local else place_deg(found.position_m, site)
    properties = {
        "id": found.id,
        "class": found.label or UNNAMED,
        "score": rounded(found.newest.score, 4),
        "east_m": rounded(east_m, 3),
        "north_m": rounded(north_m, 3),
        "sigma_m": rounded(found.sigma_m, 3),
        "length_m": rounded(found.newest.length_m, 2),
        "origins": sorted({each.origin.value for each in found.sightings}),
        "flights": list(found.dates),
        "gone": found.gone or None,
        "first_seen": utc_text(found.first_ns),
        "last_seen": utc_text(found.last_ns),
    }
    geometry = {"type": "Point", "coordinates": [round(each, 8) for each in place]}
    return feature(geometry, properties, id=found.id)


def _identity(stored: StoredObject) -> str:
    """The finding's id where the list is the site's; in a flight's own, the object's."""
    return stored.thing.id if stored.finding is None else stored.finding.id


def _as_found(stored: StoredObject) -> MapObject:
    """The object with class, place and times of its finding, where it has one."""
    found = stored.finding
    if found is None:
        return stored.thing
    return replace(
        stored.thing,
        label=found.label,
        class_scores=found.class_scores,
        position_m=found.position_m,
        sigma_m=found.sigma_m,
        first_seen_ns=found.first_ns,
        last_seen_ns=found.last_ns,
    )


def _feature_object(stored: StoredObject, site: Site, crops_from_site: bool) -> dict[str, Any]:
    each = _as_found(stored)
    folder = f"flights/{stored.flight_id}/" if crops_from_site else ""
    east_m, north_m = each.position_m
    found = stored.finding
    properties: dict[str, Any] = {
        "id": _identity(stored),
        "flight": stored.flight_id,
        "object": each.id,
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
        "flights": [stored.flight_id] if found is None else list(found.dates),
        "moving": each.moving,
        "velocity_m_s": [rounded(speed, 3) for speed in each.velocity_m_s] if each.moving else None,
        "class_scores": {name: rounded(share, 4) for name, share in each.class_scores.items()},
        "best_frame": frame_number(each.best_frame),
        "crop": f"{folder}{CROPS}/{crop_name(each.id)}",
    }
    geometry = {"type": "Point", "coordinates": coordinates}
    return feature(geometry, properties, id=_identity(stored))
