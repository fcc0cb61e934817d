"""What the archive index holds of a site: its flights with what their frames show, objects and changes, in degrees."""

import hashlib
import json
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry.base import BaseGeometry

from sorvolo.geometry.arrays import Floats
from sorvolo.geometry.homography import apply_homography
from sorvolo.store.exports.places import longitude_latitude
from sorvolo.store.exports.plain import number_or_null
from sorvolo.store.site.archive import Archive
from sorvolo.store.site.catalogue import FlightEntry, StoredKeyframe
from sorvolo.survey.flight import Site


@dataclass(frozen=True, eq=False)
class PlacedRows:
    """Rows of one table: their places, and their other columns by name, in the same order."""

    places: Sequence[BaseGeometry] = ()
    columns: Sequence[Mapping[str, Any]] = ()


@dataclass(frozen=True, eq=False)
class FrameRows:
    """Frames that were placed: outlines (N, 4, 2) in degrees, longitude first; times (N,) ns; whether kept (N,)."""

    names: tuple[str, ...] = ()
    outlines: Floats = field(default_factory=lambda: np.zeros((0, 4, 2)))
    times_ns: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    is_kept: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, np.bool_))

    @property
    def place(self) -> BaseGeometry | None:
        """All ground that they show; None without frames."""
        return (
            shapely.union_all(shapely.make_valid(shapely.polygons(self.outlines)))
            if len(self.names)
            else None
        )


@dataclass(frozen=True, eq=False)
class FlightRows:
    """One complete flight; `state` changes when it enters the site again."""

    flight: str
    state: str
    kind: str
    frames: FrameRows = field(default_factory=FrameRows)
    objects: PlacedRows = field(default_factory=PlacedRows)
    changes: PlacedRows = field(default_factory=PlacedRows)

    @property
    def first_ns(self) -> int:
        """The time of the first frame, UTC; from 1970 on where no clock has a date, 0 without frames."""
        return int(self.frames.times_ns.min()) if self.frames.names else 0

    @property
    def last_ns(self) -> int:
        """The time of the last frame, as `first_ns`."""
        return int(self.frames.times_ns.max()) if self.frames.names else 0


@dataclass(frozen=True)
class SiteState:
    """What a site holds, in brief: `state` changes with each flight and each review.

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
    verdicts = (
        {} if site.is_local else {each.change_id: each.verdict.value for each in archive.reviews()}
    )
    content = json.dumps([site.name, site.is_local, flights, verdicts], sort_keys=True)
    return SiteState(
        site.name, site.is_local, hashlib.sha256(content.encode()).hexdigest(), flights, verdicts
    )


def flight_rows(archive: Archive, wanted: Collection[str]) -> Iterator[FlightRows]:
    """The rows of these flights; a broken frames.geojson counts as missing. Raises StoreError as `Archive` does."""
    site, compared = archive.site(), archive.comparisons()
    versions = {each.flight_id: each for each in archive.versions() if each.complete}
    for each in _complete(archive):
        if each.id not in wanted:
            continue
        yield FlightRows(
            each.id,
            _state_of(each),
            "compare" if versions[each.id].id in compared else "map",
            _frames(archive, each.id, site),
            _objects(archive, each.id, site),
            _changes(archive, each.id, site),
        )


def _complete(archive: Archive) -> list[FlightEntry]:
    return [each for each in archive.flights() if each.status == "complete"]


def _state_of(flight: FlightEntry) -> str:
    return f"{flight.started_utc} {flight.finished_utc} {flight.fingerprint}"


def _frames(archive: Archive, flight: str, site: Site) -> FrameRows:
    """What the flight's frames show, by its frames.geojson; by the key frames alone where that is missing."""
    keyframes = archive.keyframes(flight)
    kept = {each.name for each in keyframes}
    rows = [
        row
        for each in archive.features(f"flights/{flight}", "frames")
        if (row := _written(each, kept)) is not None
    ]
    rows = rows or [row for each in keyframes if (row := _shown(each, site)) is not None]
    if not rows:
        return FrameRows()
    names, outlines, times_ns, is_kept = zip(*rows, strict=True)
    return FrameRows(
        names, np.array(outlines), np.array(times_ns, np.int64), np.array(is_kept, np.bool_)
    )


_Row = tuple[
    str, Floats, int, bool
]  # a frame's name, outline (4, 2) in degrees, time in ns, whether it was kept


def _written(feature: Any, kept: Collection[str]) -> _Row | None:
    """A frame as the file has it; None for one that was not placed or is damaged."""
    try:
        outline = np.array(feature["geometry"]["coordinates"][0], np.float64)[:4, :2]
        name, time_ns = (
            str(feature["properties"]["frame"]),
            _nanoseconds(feature["properties"]["time"]),
        )
    except (TypeError, ValueError, KeyError, IndexError):
        return None
    return (name, outline, time_ns, name in kept) if _is_usable(outline) else None


def _shown(keyframe: StoredKeyframe, site: Site) -> _Row | None:
    """A key frame as the catalogue has it."""
    outline_m = apply_homography(keyframe.site_from_image, keyframe.camera.corners_px)
    outline = np.column_stack(longitude_latitude(outline_m, site))
    return (keyframe.name, outline, int(keyframe.time_ns), True) if _is_usable(outline) else None


def _objects(archive: Archive, flight: str, site: Site) -> PlacedRows:
    things = [each.thing for each in archive.objects(flight)]
    if not things:
        return PlacedRows()
    longitudes, latitudes = longitude_latitude(np.array([each.position_m for each in things]), site)
    return PlacedRows(
        list(shapely.points(longitudes, latitudes)),
        [
            {
                "object_id": each.id,
                "label": each.label,
                "score": float(each.score),
                "sigma_m": number_or_null(each.sigma_m),
                "first_ns": int(each.first_seen_ns),
                "last_ns": int(each.last_seen_ns),
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
                "change_id": each.id,
                "kind": each.kind.value,
                "score": float(each.score),
                "label": each.class_after or each.class_before or each.kind.value,
                "first_ns": int(each.first_seen_ns),
                "last_ns": int(each.last_seen_ns),
                "verdict": "" if each.verdict is None else each.verdict.value,
            }
            for each in found
        ],
    )


def _polygon(outline_m: Floats, site: Site) -> BaseGeometry:
    """An outline (N, 2) in degrees; of one or two points, their box grown to a millimetre or so."""
    corners = np.column_stack(longitude_latitude(np.asarray(outline_m)[:, :2], site))
    return (
        shapely.Polygon(corners)
        if len(corners) > 2
        else shapely.MultiPoint(corners).envelope.buffer(1e-8)
    )


def _is_usable(outline: Floats) -> bool:
    """Four corners, none of them as far away as the horizon, to which a frame that looks ahead may reach."""
    return outline.shape == (4, 2) and bool(
        np.isfinite(outline).all() and (np.ptp(outline, axis=0) < 1).all()
    )


def _nanoseconds(text: str) -> int:
    moment = datetime.fromisoformat(text)
    utc = moment if moment.tzinfo is not None else moment.replace(tzinfo=UTC)
    return round(utc.timestamp() * 1e6) * 1000
