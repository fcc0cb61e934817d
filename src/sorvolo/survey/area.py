"""The area of interest: polygons on the Earth that a map is wanted of."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from sorvolo.errors import GeometryError
from sorvolo.geometry.arrays import Floats, PointsM, Vector3, frozen
from sorvolo.geometry.geodesy import Geodetic, LocalFrame, ecef_from_wgs84, wgs84_from_ecef
from sorvolo.geometry.polygons import first_crossing, narrowest_extent, points_inside, polygon_area


@dataclass(frozen=True, eq=False)
class Area:
    """The union of one or more polygons on WGS84.

    A polygon is a tuple of rings, (N, 2) arrays of longitude and latitude in degrees: its outline, then its
    holes. A ring may come closed (the first point repeated at the end); it is kept open. Edges are straight
    on the ground. Raises GeometryError for a ring with fewer than three different points, off the Earth,
    without any extent, or crossing itself.
    """

    polygons_lonlat: tuple[tuple[Floats, ...], ...]
    name: str = "area"

    def __post_init__(self) -> None:
        if not self.polygons_lonlat or not all(self.polygons_lonlat):
            raise GeometryError("an area needs at least one polygon")
        polygons = tuple(
            tuple(_open_ring(ring) for ring in rings) for rings in self.polygons_lonlat
        )
        object.__setattr__(self, "polygons_lonlat", polygons)
        for rings_m in self.polygons_m(self.frame):
            for ring_m in rings_m:
                _check_ring(ring_m)
            if polygon_area(rings_m) <= 0:
                raise GeometryError("the holes of a polygon leave nothing of it")

    @property
    def rings_lonlat(self) -> tuple[Floats, ...]:
        """Every ring of every polygon, outlines and holes, (N, 2) each."""
        return tuple(ring for rings in self.polygons_lonlat for ring in rings)

    @cached_property
    def centre(self) -> Geodetic:
        """The middle of the area's corners, on the ellipsoid; right at the antimeridian and the poles too."""
        lonlat = np.concatenate([rings[0] for rings in self.polygons_lonlat])
        ecef_m = ecef_from_wgs84(lonlat[:, 1], lonlat[:, 0], np.zeros(len(lonlat)))
        latitude, longitude, _ = wgs84_from_ecef(ecef_m.mean(axis=0)[None])
        return Geodetic(float(latitude[0]), float(longitude[0]))

    @cached_property
    def frame(self) -> LocalFrame:
        """East-north-up metres around the area's centre."""
        return LocalFrame(self.centre)

    @cached_property
    def area_m2(self) -> float:
        """The polygons' areas added up; ground that two of them share counts twice."""
        return float(sum(polygon_area(rings_m) for rings_m in self.polygons_m(self.frame)))

    def polygons_m(self, frame: LocalFrame) -> tuple[tuple[PointsM, ...], ...]:
        """The polygons' rings as east, north metres of `frame`, (N, 2) each."""
        return tuple(
            tuple(_metres_from_lonlat(frame, ring)[:, :2] for ring in rings)
            for rings in self.polygons_lonlat
        )

    def distances_m(self, place: Geodetic) -> list[float]:
        """How far each polygon's nearest corner is from a place, along the chord, m; 0 where it holds the place."""
        here_m = ecef_from_wgs84(
            *(np.array([each]) for each in (place.latitude_deg, place.longitude_deg, 0.0))
        )
        distances_m = []
        for rings in self.polygons_lonlat:
            corners_m = ecef_from_wgs84(rings[0][:, 1], rings[0][:, 0], np.zeros(len(rings[0])))
            inside = Area((rings,)).contains(np.array([[place.longitude_deg, place.latitude_deg]]))[
                0
            ]
            distances_m.append(
                0.0 if inside else float(np.linalg.norm(corners_m - here_m, axis=1).min())
            )
        return distances_m

    def contains(self, lonlat: Floats) -> NDArray[np.bool_]:
        """(N,) whether each place, (N, 2) longitude and latitude in degrees, lies inside; NaN does not."""
        points_m = _metres_from_lonlat(
            self.frame, np.asarray(lonlat, dtype=np.float64).reshape(-1, 2)
        )
        # the far side of the Earth has the same east and north
        near = points_m[:, 2] > -3e6
        return near & inside_any(self.polygons_m(self.frame), points_m[:, :2])

    def holds(self, frame: LocalFrame, position_m: Vector3) -> bool:
        """Whether a place, (3,) metres of `frame`, lies inside."""
        latitude, longitude, _ = frame.wgs84_from_site(position_m[None])
        return bool(self.contains(np.column_stack([longitude, latitude]))[0])


def inside_any(polygons: Sequence[Sequence[PointsM]], points: PointsM) -> NDArray[np.bool_]:
    """(N,) whether each point, shape (N, 2), lies inside at least one polygon in the same plane."""
    inside = np.zeros(len(points), dtype=bool)
    for rings in polygons:
        inside |= points_inside(rings, points)
    return inside


def _metres_from_lonlat(frame: LocalFrame, lonlat: Floats) -> PointsM:
    height_m = np.full(len(lonlat), frame.origin.height_m)
    return frame.site_from_wgs84(lonlat[:, 1], lonlat[:, 0], height_m)


def _open_ring(ring: Floats) -> Floats:
    lonlat = frozen(ring)
    if lonlat.ndim != 2 or lonlat.shape[1] != 2:
        raise GeometryError(f"a ring is (N, 2) longitude and latitude, got shape {lonlat.shape}")
    if not np.isfinite(lonlat).all():
        raise GeometryError("a ring has a coordinate that is not a number")
    for column, name, limit_deg in ((1, "latitude", 90), (0, "longitude", 360)):
        worst = lonlat[np.argmax(np.abs(lonlat[:, column])), column] if len(lonlat) else 0.0
        if abs(worst) > limit_deg:
            raise GeometryError(f"{name} {worst} lies outside [-{limit_deg}, {limit_deg}] deg")
    # repeated corners add nothing and would look like edges without a direction
    distinct = lonlat[(lonlat != np.roll(lonlat, 1, axis=0)).any(axis=1)]
    if len(distinct) < 3:
        raise GeometryError(f"a ring needs at least 3 different points, got {len(distinct)}")
    return frozen(distinct)


def _check_ring(ring_m: PointsM) -> None:
    extent_m = float(np.ptp(ring_m, axis=0).max())
    if extent_m > 500e3:
        raise GeometryError("a ring spans more than 500 km; an area of interest is local")
    # points along a parallel are on one line for the person who drew them, though not on the Earth
    if narrowest_extent(ring_m)[0] < max(0.05, 5e-4 * extent_m):
        raise GeometryError("a ring encloses no ground: its points lie on one line")
    if crossing := first_crossing(ring_m):
        raise GeometryError(
            f"a ring crosses itself: its edges from points {crossing[0] + 1} and {crossing[1] + 1} meet"
        )
