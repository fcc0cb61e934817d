"""What the archive index holds of a site: its flights with what their frames show, objects and changes, in degrees."""

import hashlib
import json
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from sorvolo.errors import GeometryError
from sorvolo.geometry.arrays import Floats
from sorvolo.geometry.homography import apply_homography
from sorvolo.store.exports.places import longitude_latitude
from sorvolo.store.site.archive import Archive
from sorvolo.store.site.catalogue import FlightEntry
from sorvolo.survey.flight import Site


@dataclass(frozen=True, eq=False)
class PlacedRows:
    """Rows of one table: their places, and their other columns by name, in the same order."""

    places: Sequence[BaseGeometry] = ()
    columns: Sequence[Mapping[str, Any]] = ()


@dataclass(frozen=True, eq=False)
class FlightRows:
    """One complete flight; `state` changes when it enters the site again, `place` is all that it shows, if any."""

    flight: str
    state: str
    kind: str
    first_ns: int
    last_ns: int
    place: BaseGeometry | None
    frames: PlacedRows = field(default_factory=PlacedRows)
    objects: PlacedRows = field(default_factory=PlacedRows)
    changes: PlacedRows = field(default_factory=PlacedRows)


@dataclass(frozen=True)
class SiteState:
    """What a site holds, told cheaply: `state` is another one after each flight and each review.

    `flights` are the states of its complete flights, `verdicts` those on its changes, by id; a local site has neither.
    """

    name: str
    is_local: bool
    state: str
    flights: Mapping[str, str]
    verdicts: Mapping[str, str]


def site_state(archive: Archive) -> SiteState:
    """The state of a site; one without any map has no flights. Raises StoreError for a damaged catalogue."""
    if not archive.has_site:
        return SiteState(archive.folder.name, False, "", {}, {})
    site = archive.site()
    flights = {} if site.is_local else {each.id: _state_of(each) for each in _complete(archive)}
    verdicts = {} if site.is_local else {each.change_id: each.verdict.value for each in archive.reviews()}
    content = json.dumps([site.name, site.is_local, flights, verdicts], sort_keys=True)
    return SiteState(site.name, site.is_local, hashlib.sha256(content.encode()).hexdigest(), flights, verdicts)


def flight_rows(archive: Archive, wanted: Collection[str]) -> Iterator[FlightRows]:
    """The rows of these flights; a broken frames.geojson counts as missing. Raises StoreError as `Archive` does."""
    site, compared = archive.site(), archive.comparisons()
    versions = {each.flight_id: each for each in archive.versions() if each.complete}
    for each in _complete(archive):
        if each.id not in wanted:
            continue
        frames = _frames(archive, each.id, site)
        times_ns = [int(row["time_ns"]) for row in frames.columns] or [0]
        kind = "compare" if versions[each.id].id in compared else "map"
        place = shapely.union_all(frames.places).simplify(0) if frames.places else None
        yield FlightRows(
            each.id, _state_of(each), kind, min(times_ns), max(times_ns), place, frames,
            _objects(archive, each.id, site), _changes(archive, each.id, site),
        )


def _complete(archive: Archive) -> list[FlightEntry]:
    return [each for each in archive.flights() if each.status == "complete"]


def _state_of(flight: FlightEntry) -> str:
    return f"{flight.started_utc} {flight.finished_utc} {flight.fingerprint}"


def _frames(archive: Archive, flight: str, site: Site) -> PlacedRows:
    """What the flight's frames show, by its frames.geojson; of the key frames alone where somebody took that away."""
    keyframes = archive.keyframes(flight)
    kept = {each.name for each in keyframes}
    places, columns = [], []
    for each in archive.frames(flight):
        try:
            place, values = shapely.Polygon(each["geometry"]["coordinates"][0]), each["properties"]
            name, time_ns = str(values["frame"]), _nanoseconds(values["time"])
            sigma_m = None if values.get("sigma_m") is None else float(values["sigma_m"])
        except (TypeError, ValueError, KeyError, IndexError, shapely.errors.ShapelyError):
            continue  # a frame that was not placed has no geometry
        if _is_usable(place):
            places.append(place)
            columns.append({"name": name, "time_ns": time_ns, "is_kept": name in kept, "sigma_m": sigma_m})
    if places:
        return PlacedRows(places, columns)
    for keyframe in keyframes:
        try:
            outline_m = apply_homography(keyframe.site_from_image, keyframe.camera.corners_px)
        except GeometryError:
            continue
        place = _polygon(outline_m, site)
        if _is_usable(place):
            places.append(place)
            columns.append({
                "name": keyframe.name, "time_ns": keyframe.time_ns, "is_kept": True,
                "sigma_m": _known(keyframe.sigma_m),
            })
    return PlacedRows(places, columns)


def _objects(archive: Archive, flight: str, site: Site) -> PlacedRows:
    things = [each.thing for each in archive.objects(flight)]
    if not things:
        return PlacedRows()
    longitudes, latitudes = longitude_latitude(np.array([each.position_m for each in things]), site)
    return PlacedRows(
        list(shapely.points(longitudes, latitudes)),
        [
            {
                "object_id": each.id, "label": each.label, "score": float(each.score), "sigma_m": _known(each.sigma_m),
                "first_ns": int(each.first_seen_ns), "last_ns": int(each.last_seen_ns),
            }
            for each in things
        ],
    )


def _changes(archive: Archive, flight: str, site: Site) -> PlacedRows:
    found = archive.changes(flight)
    return PlacedRows(
        [_polygon(each.outline_m, site) for each in found],
        [
            {
                "change_id": each.id, "kind": each.kind.value, "score": float(each.score),
                "label": each.class_after or each.class_before or each.kind.value,
                "first_ns": int(each.first_seen_ns), "last_ns": int(each.last_seen_ns),
                "verdict": "" if each.verdict is None else each.verdict.value,
            }
            for each in found
        ],
    )


def _polygon(outline_m: Floats, site: Site) -> BaseGeometry:
    """An outline (N, 2) in degrees; of one or two points, their box grown to a millimetre or so."""
    corners = np.column_stack(longitude_latitude(np.asarray(outline_m)[:, :2], site))
    return shapely.Polygon(corners) if len(corners) > 2 else shapely.MultiPoint(corners).envelope.buffer(1e-8)


def _is_usable(place: BaseGeometry) -> bool:
    """Neither empty nor reaching to the horizon, as a frame that looks far ahead may."""
    west, south, east, north = place.bounds if not place.is_empty else (np.nan,) * 4
    return bool(east - west < 1 and north - south < 1 and place.is_valid)


def _nanoseconds(text: str) -> int:
    moment = datetime.fromisoformat(text)
    utc = moment if moment.tzinfo is not None else moment.replace(tzinfo=UTC)
    return round(utc.timestamp() * 1e6) * 1000


def _known(number: float) -> float | None:
    return float(number) if np.isfinite(number) else None
