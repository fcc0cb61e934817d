"""What the archive index knows of a place: the flights that saw it in a span of time, and what they found there."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray
from sqlalchemy import Connection, Row, Select, Table, column, func, literal, select, table

from sorvolo.errors import SettingsError
from sorvolo.geometry.arrays import Floats
from sorvolo.geometry.units import M_PER_DEG_LATITUDE
from sorvolo.store.index import tables

EARLIEST_NS, LATEST_NS = -(2**62), 2**62
"""Bounds of time, ns since 1970: the years 1824 and 2116."""

_MOST_VALUES = 10_000  # in a query: SQLite bounds their number
_HEAD_BYTES = 9  # of a collection: byte order, type, number of members
_POLYGON = np.dtype(
    [("head", "u1", 13), ("corners", "<f8", (5, 2))]
)  # ... of which each is a ring of five points
_ABOUT = (tables.flights.c.flight, tables.flights.c.kind, tables.sites.c.path, tables.sites.c.name)


@dataclass(frozen=True)
class Place:
    """What is asked: a place in degrees of WGS84, what counts as there, and when; times are UTC.

    What was found within `within_m` counts as there, also by a flight of which no frame shows the place itself. With
    `classes` only flights that found one of them there.
    """

    latitude_deg: float
    longitude_deg: float
    within_m: float = 2.0
    first_ns: int = EARLIEST_NS
    last_ns: int = LATEST_NS
    classes: frozenset[str] = frozenset()

    def __post_init__(self) -> None:
        if not (-90 <= self.latitude_deg <= 90 and -360 <= self.longitude_deg <= 360):
            raise SettingsError(
                f"{self.latitude_deg}, {self.longitude_deg} is no place: latitude from -90 to 90 and longitude from "
                "-180 to 180 degrees were needed"
            )
        if not 0 < self.within_m <= 10_000:
            raise SettingsError(
                f"within {self.within_m} m: more than 0 and at most 10,000 m was needed"
            )
        if self.first_ns > self.last_ns:
            raise SettingsError(
                "the first moment asked for is after the last one; give them in order"
            )


@dataclass(frozen=True)
class FoundThing:
    """An object ("object") or a change at the place; `kind` and `verdict` are "" where there is none."""

    type: str
    id: str
    label: str
    kind: str
    score: float
    first_ns: int
    last_ns: int
    distance_m: float
    verdict: str = ""


@dataclass(frozen=True)
class FoundFlight:
    """A flight that saw the place, or found something near it: in how many frames, when, and which frame shows it best.

    The best frame is one whose picture was kept, if any, and of those the one with the place farthest from its edge.
    """

    site: str
    site_name: str
    flight: str
    kind: str
    frames: int
    first_ns: int
    last_ns: int
    best_frame: str
    best_is_kept: bool
    things: tuple[FoundThing, ...] = field(default_factory=tuple)


def find(connection: Connection, place: Place) -> list[FoundFlight]:
    """The flights that saw the place or found something within reach of it, in order of time."""
    things = _things(connection, place)
    if place.classes and not things:
        return []
    found = []
    for longitude in _turns(place.longitude_deg, 0.0):
        found += _seen(connection, place, longitude, things)
    if missing := sorted(things.keys() - {number for number, _ in found}):
        for row in _flights(connection, missing):
            of = things[row.id]
            times = min(each.first_ns for each in of), max(each.last_ns for each in of)
            about = row.path, row.name, row.flight, row.kind
            found.append((row.id, FoundFlight(*about, 0, *times, "", False, tuple(of))))
    kept = [each for number, each in found if not place.classes or number in things]
    return sorted(kept, key=lambda each: (each.first_ns, each.site, each.flight))


def _seen(
    connection: Connection,
    place: Place,
    longitude_deg: float,
    things: Mapping[int, Sequence[FoundThing]],
) -> list[tuple[int, FoundFlight]]:
    """The flights with a frame that shows the place, by their numbers in the index."""
    c = tables.flights.c
    columns = (c.id, *_ABOUT, c.frames, c.frame_names, c.frame_times, c.frame_kept, c.outlines)
    query = _near(
        connection, tables.flights, columns, longitude_deg, place.latitude_deg, np.zeros(2)
    )
    if place.classes and len(things) <= _MOST_VALUES:  # what others saw is not asked for
        query = query.where(c.id.in_(things))
    rows = connection.execute(_then(query, place, c.first_ns, c.last_ns).join(tables.sites)).all()
    if not rows:
        return []
    numbers, flights, kinds, paths, names, counts, frame_names, times, kept, outlines = zip(
        *rows, strict=True
    )
    owner = np.repeat(np.arange(len(rows)), counts)
    start = np.cumsum([0, *counts])
    times_ns, is_kept = (
        np.frombuffer(b"".join(times), "<i8"),
        np.frombuffer(b"".join(kept), np.bool_),
    )
    origin, scale = [longitude_deg, place.latitude_deg], _metres_per_degree(place.latitude_deg)
    # (N, 4, 2) the corners of collections of polygons of four corners each, as well-known binary
    # has them.
    polygons = np.frombuffer(b"".join(each[_HEAD_BYTES:] for each in outlines), _POLYGON)
    corners_m = (np.asarray(polygons["corners"][:, :4], np.float64) - origin) * scale
    inside = _contain_origin(corners_m) & (times_ns >= place.first_ns) & (times_ns <= place.last_ns)
    frames = np.flatnonzero(inside)
    if not len(frames):
        return []
    # the best frame of a flight comes last: kept ones after others, and then by how far inside the place lies
    frames = frames[
        np.lexsort((_distance_to_edge_m(corners_m[frames]), is_kept[frames], owner[frames]))
    ]
    begins = np.flatnonzero(np.diff(owner[frames], prepend=-1))
    ends = np.append(begins[1:], len(frames))
    best, which = frames[ends - 1], owner[frames[begins]]
    columns_of_found = (
        which,
        ends - begins,
        np.minimum.reduceat(times_ns[frames], begins),
        np.maximum.reduceat(times_ns[frames], begins),
        best - start[which],
        is_kept[best],
    )
    return [
        (
            numbers[k],
            FoundFlight(
                paths[k],
                names[k],
                flights[k],
                kinds[k],
                count,
                first_ns,
                last_ns,
                frame_names[k].split("\n")[frame],
                is_best_kept,
                tuple(things.get(numbers[k], ())),
            ),
        )
        for k, count, first_ns, last_ns, frame, is_best_kept in zip(
            *(each.tolist() for each in columns_of_found)
        )
    ]


def _contain_origin(corners_m: Floats) -> NDArray[np.bool_]:
    """Which outlines (N, 4, 2) go around the origin: where a ray from it crosses an odd number of edges."""
    inside = np.zeros(len(corners_m), np.bool_)
    for k in range(4):
        (x0, y0), (x1, y1) = corners_m[:, k].T, corners_m[:, (k + 1) % 4].T
        with np.errstate(divide="ignore", invalid="ignore"):
            inside ^= ((y0 > 0) != (y1 > 0)) & (x0 - y0 * (x1 - x0) / (y1 - y0) > 0)
    return inside


def _distance_to_edge_m(corners_m: Floats) -> Floats:
    """(N,) from the origin to the nearest edge of outlines (N, 4, 2)."""
    nearest = np.full(len(corners_m), np.inf)
    for k in range(4):
        start, along = corners_m[:, k], corners_m[:, (k + 1) % 4] - corners_m[:, k]
        share = -(start * along).sum(axis=1) / np.maximum((along * along).sum(axis=1), 1e-12)
        nearest = np.minimum(nearest, np.hypot(*(start + along * np.clip(share, 0, 1)[:, None]).T))
    return nearest


def _things(connection: Connection, place: Place) -> dict[int, list[FoundThing]]:
    """Objects and changes within reach, by flight, the nearest first."""
    found: dict[int, list[FoundThing]] = {}
    reach_deg = place.within_m / _metres_per_degree(place.latitude_deg)
    o, h = tables.objects.c, tables.changes.c
    asked: tuple[tuple[Table, tuple[Any, ...]], ...] = (
        (
            tables.objects,
            (o.object_id.label("name"), literal("").label("kind"), literal("").label("verdict")),
        ),
        (tables.changes, (h.change_id.label("name"), h.kind, h.verdict)),
    )
    for kept, own in asked:
        c = kept.c
        columns = (
            c.flight_id,
            *own,
            c.label.label("what"),
            c.score,
            c.first_ns,
            c.last_ns,
            c.place,
        )
        rows, distances_m = _meeting(connection, kept, columns, place, reach_deg)
        for row, distance_m in zip(rows, distances_m.tolist(), strict=True):
            if distance_m <= place.within_m and (not place.classes or row.what in place.classes):
                found.setdefault(row.flight_id, []).append(
                    FoundThing(
                        "object" if kept is tables.objects else "change",
                        row.name,
                        row.what,
                        row.kind,
                        row.score,
                        row.first_ns,
                        row.last_ns,
                        distance_m,
                        row.verdict,
                    )
                )
    return {
        flight: sorted(each, key=lambda thing: thing.distance_m) for flight, each in found.items()
    }


def _meeting(
    connection: Connection, kept: Table, columns: Sequence[Any], place: Place, reach_deg: Floats
) -> tuple[list[Row[Any]], Floats]:
    """The rows whose box is within `reach_deg` (2,), and the distance of the place from each, m."""
    rows: list[Row[Any]] = []
    distances_m = []
    for longitude in _turns(place.longitude_deg, float(reach_deg[0])):
        query = _near(connection, kept, columns, longitude, place.latitude_deg, reach_deg)
        found = connection.execute(_then(query, place, kept.c.first_ns, kept.c.last_ns)).all()
        rows += found
        distances_m.append(
            _distances_m([row.place for row in found], longitude, place.latitude_deg)
        )
    return rows, np.concatenate(distances_m)


def _near(
    connection: Connection,
    kept: Table,
    columns: Sequence[Any],
    longitude_deg: float,
    latitude_deg: float,
    reach_deg: Floats,
) -> Select[Any]:
    """Rows whose box comes so near (2,) to a place, by the spatial index."""
    west, south = longitude_deg - float(reach_deg[0]), latitude_deg - float(reach_deg[1])
    east, north = longitude_deg + float(reach_deg[0]), latitude_deg + float(reach_deg[1])
    query = select(*columns).select_from(kept)
    if connection.dialect.name != "sqlite":
        box = func.ST_MakeEnvelope(west, south, east, north, 4326)
        return query.where(kept.c.place.op("&&", is_comparison=True)(box))
    tree = table(f"{kept.name}_places", *map(column, ("id", "west", "east", "south", "north")))
    inside = (
        tree.c.west <= east,
        tree.c.east >= west,
        tree.c.south <= north,
        tree.c.north >= south,
    )
    return query.where(kept.c.id.in_(select(tree.c.id).where(*inside)))


def _then(query: Select[Any], place: Place, first: Any, last: Any) -> Select[Any]:
    """Only the rows within the span of time."""
    return query.where(last >= place.first_ns, first <= place.last_ns)


def _distances_m(places: Sequence[bytes], longitude_deg: float, latitude_deg: float) -> Floats:
    """From a point to geometries, m; 0 within them."""
    if not places:
        return np.zeros(0)
    scale, origin = _metres_per_degree(latitude_deg), np.array([longitude_deg, latitude_deg])
    shapes = shapely.transform(
        shapely.from_wkb([bytes(each) for each in places]), lambda each: (each - origin) * scale
    )
    return np.asarray(shapely.distance(shapes, shapely.Point(0.0, 0.0)), np.float64)


def _metres_per_degree(latitude_deg: float) -> Floats:
    """(2,) of longitude and of latitude."""
    return np.array(
        [M_PER_DEG_LATITUDE * max(1e-6, np.cos(np.radians(latitude_deg))), M_PER_DEG_LATITUDE]
    )


def _turns(longitude_deg: float, reach_deg: float) -> list[float]:
    """The longitude, and beside the antimeridian the same one a turn further: footprints run on beyond 180 degrees."""
    here = (longitude_deg + 180) % 360 - 180
    return [here] if abs(here) + reach_deg < 179 else [here, here - 360 * np.sign(here or 1.0)]


def _flights(connection: Connection, ids: Sequence[int]) -> list[Any]:
    found: list[Any] = []
    for start in range(0, len(ids), _MOST_VALUES):
        query = select(tables.flights.c.id, *_ABOUT).select_from(tables.flights).join(tables.sites)
        found += connection.execute(
            query.where(tables.flights.c.id.in_(ids[start : start + _MOST_VALUES]))
        ).all()
    return found
