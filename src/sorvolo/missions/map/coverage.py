"""The ground that a flight has seen by now and the holes in it, kept up to date while the crew can still fly them."""

import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from statistics import median
from typing import Any

from sorvolo.errors import GeometryError
from sorvolo.missions.flight.setup import FlightSetup
from sorvolo.missions.map.painting import REST
from sorvolo.missions.plan_flight import REFLY_BESIDE, REFLY_MOST_HOLES, fly_again
from sorvolo.mosaic.seen_ground import PictureOnGround, coverage_figures, seen_ground
from sorvolo.store.atomic import atomic_write_bytes
from sorvolo.store.exports.ground_files import COVERAGE, holes_lonlat, seen_geojson
from sorvolo.store.exports.plain import features_name, geojson_bytes
from sorvolo.store.site.archive import Archive
from sorvolo.survey.area import Area
from sorvolo.survey.coverage import SeenGround


class FlightCoverage:
    """A flight's coverage: a GeoJSON file beside the growing map, and waypoints over the holes in the files `refly`.

    `area` is what was to be covered; without it, holes are gaps amid what was seen. `show` and `conclude` take what
    gives the pictures that have a place. Waypoints are written where there are holes, and taken away where there are
    none any more.
    """

    def __init__(
        self,
        setup: FlightSetup,
        archive: Archive,
        area: Area | None,
        refly: Sequence[Path],
        live_s: float,
    ) -> None:

        self._setup, self._archive, self._refly, self._live_s = setup, archive, tuple(refly), live_s
        is_known = area is not None and setup.telemetry is not None
        self._area_m = area.polygons_m(setup.frame) if area is not None and is_known else ()
        self._again_s = time.monotonic() + live_s
        self._is_planned = False

    def show(self, pictures: Callable[[], Sequence[PictureOnGround]]) -> None:
        """Write from time to time what was seen so far."""
        started_s = time.monotonic()
        if started_s < self._again_s or not self._archive.has_site:
            return
        placed = pictures()
        ground = seen_ground(placed, self._area_m)
        atomic_write_bytes(self._archive.live_coverage_path, self._geojson(ground), durable=False)
        self._plan(ground, placed)
        self._again_s = time.monotonic() + max(self._live_s, REST * (time.monotonic() - started_s))

    def conclude(
        self, placed: Sequence[PictureOnGround]
    ) -> tuple[Mapping[str, bytes], dict[str, Any]]:
        """What all of the flight saw: a file for the flight's folder by its name, and its figures for the report."""
        ground = seen_ground(placed, self._area_m)
        files = self._plan(ground, placed)
        name = features_name(COVERAGE, is_local=self._archive.site().is_local)
        return {name: self._geojson(ground)}, {
            **coverage_figures(ground),
            "refly": [str(each) for each in files],
        }

    def _geojson(self, ground: Sequence[SeenGround]) -> bytes:
        return geojson_bytes(seen_geojson(ground, self._archive.site()))

    def _plan(
        self, ground: Sequence[SeenGround], placed: Sequence[PictureOnGround]
    ) -> tuple[Path, ...]:
        """Write the waypoints over the holes; the files, none where there are no holes or no place on Earth."""
        holes = [each for each in ground if not each.views][:REFLY_MOST_HOLES]
        site = self._archive.site()
        if not self._refly or site.is_local:
            return ()
        if not holes:
            for path in self._refly if self._is_planned else ():
                path.unlink(missing_ok=True)
            return ()
        camera = self._setup.source.camera.camera
        height_m = median(each.m_per_px for each in placed) * camera.fx_px
        try:
            rings = holes_lonlat(holes, site, REFLY_BESIDE * height_m)
            area = Area(rings, f"holes of {self._setup.source.name}")
            fly_again(area, camera, height_m, self._refly)
        except GeometryError:
            return ()  # too small or too odd to be flown over; they stay in the file of the coverage
        self._is_planned = True
        return self._refly
