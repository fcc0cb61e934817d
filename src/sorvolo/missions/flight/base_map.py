"""A flight tied to a map that exists already: an orthophoto, or the map of another site."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from sorvolo.capture.source import Source
from sorvolo.change.alignment import Aligned, Aligner
from sorvolo.change.flight_on_map import FlightOnMap
from sorvolo.change.map_search import MapSearch
from sorvolo.change.reference import ReferenceMap
from sorvolo.errors import InputError
from sorvolo.geometry.arrays import ImageRGB, PointsM
from sorvolo.geometry.camera import Camera
from sorvolo.geometry.geodesy import LocalFrame, utm_epsg
from sorvolo.geometry.grid import SiteGrid
from sorvolo.geometry.homography import site_from_image_homography
from sorvolo.mosaic.base_ties import (
    BaseReport,
    FoundFrame,
    around,
    as_overview,
    base_grid,
    find_flight,
    prior_on_map,
    sought_keyframes,
    tie_to_base,
)
from sorvolo.mosaic.planar import PlanarMapper
from sorvolo.store.rasters.base_map import BaseMap
from sorvolo.store.site.archive import Archive
from sorvolo.store.site.catalogue_place import is_site
from sorvolo.survey.flight import Notice

_COARSEST = 8.0  # times the photos' own pixels
_OVERVIEW_PX = 1400  # longer side of the flight's picture that is searched for on the base map
_GPS_SIGMA_M = 5.0  # one sigma of a fix without corrections; by choice
_LEAST_FRAMES, _LEAST_SHARE = 3, 0.2
_ANOTHER_PLACE_M = 500.0  # beyond what oblique frames show and what GPS errs
_MARGIN = 1.5  # heights around the cameras
_APART_NS = 60_000_000_000  # frames are looked for one by one: none foretells the next


@dataclass(frozen=True, eq=False)
class FlightBase:
    """The base map of one flight. `is_datum`: the flight has no GPS, the base map alone places it."""

    source: Source
    base: BaseMap
    is_datum: bool

    notices: tuple[Notice, ...] = ()

    @property
    def words(self) -> str:
        """It, in words."""
        return f"the base map ({self.base.path.name})"

    @property
    def frame(self) -> LocalFrame:
        """A site frame around the base map, for a flight without GPS."""
        return LocalFrame(self.base.middle)

    def tie(
        self,
        mapper: PlanarMapper,
        picture: Callable[[int], ImageRGB],
        camera: Camera,
        frame: LocalFrame,
    ) -> BaseReport:
        """Find the flight's keyframes on the base map and tie them there.

        `picture` loads a keyframe's undistorted picture, `camera` is that of such pictures at full size. Raises
        InputError where the flight is not found.
        """
        crs = f"EPSG:{utm_epsg(frame.origin.latitude_deg, frame.origin.longitude_deg)}"
        sigma_m = self._find_all(mapper, camera, frame, crs) if self.is_datum else _GPS_SIGMA_M
        native_m = self._native_m(mapper, camera)
        site_grid = base_grid(frame, crs, self.base.m_per_px, native_m, camera.width_px)
        tiles = self.base.tiles(site_grid, around(mapper, _MARGIN))
        if not tiles:
            raise self._of_another_place(frame)
        reference = ReferenceMap(tiles, site_grid.grid)
        aligner = Aligner(reference, site_grid)
        sought, found = sought_keyframes(mapper), []
        for number, each in enumerate(sought):
            image = picture(each)
            height_px, width_px = image.shape[:2]
            seen = mapper.refined(camera).resized(width_px, height_px)
            aligned = aligner.align(
                image, seen, prior_on_map(mapper, each, sigma_m), number * _APART_NS
            )
            if isinstance(aligned, Aligned):
                misfit_m = aligned.residual_px * native_m * camera.width_px / width_px
                found.append(
                    FoundFrame(
                        each, camera.resized(width_px, height_px), aligned.site_from_image, misfit_m
                    )
                )
        least = max(_LEAST_FRAMES, _LEAST_SHARE * len(sought))
        if len(found) < least:
            together = _found_as_one(
                mapper, sought, picture, camera, FlightOnMap(MapSearch(reference, site_grid))
            )
            found = together or found
        if len(found) < least:
            raise InputError(
                f"{len(found)} of {len(sought)} frames of {self.source.name} were found on the base map "
                f"{self.base.path}: it shows other ground, or the same at too coarse a scale or too different a time; "
                "give another one"
            )
        before = mapper.path_m()
        left_out, residual_m = tie_to_base(
            mapper, found, camera, self.base.m_per_px, is_datum=self.is_datum
        )
        self._native_m(mapper, camera)  # without GPS its scale was a guess before
        return BaseReport(
            self.base.path.name,
            self.base.m_per_px,
            len(sought),
            len(found),
            left_out,
            residual_m,
            float("nan") if self.is_datum else mapper.median_move_m(before),
        )

    def check_place(self, fixes_m: PointsM, frame: LocalFrame) -> None:
        """Raise InputError where all the flight's fixes, (N, 2) site metres, lie far beside the map: before it is
        mapped."""
        if self.base.beside_m(fixes_m, frame) > _ANOTHER_PLACE_M:
            raise self._of_another_place(frame)

    def _of_another_place(self, frame: LocalFrame) -> InputError:
        west, south, east, north = self.base.bounds_deg
        place = frame.origin
        return InputError(
            f"{self.base.path} shows ground from {south:.5f}, {west:.5f} to {north:.5f}, {east:.5f}, and the "
            f"flight {self.source.name} is at {place.latitude_deg:.5f}, {place.longitude_deg:.5f}: give a map of "
            "its ground"
        )

    def _find_all(self, mapper: PlanarMapper, camera: Camera, frame: LocalFrame, crs: str) -> float:
        """Find a flight of unknown place; how well its place is known then, m."""
        overview = mapper.overview(_OVERVIEW_PX)
        coarse_m = max(self.base.m_per_px, self.base.extent_m / _OVERVIEW_PX)
        site_grid = SiteGrid.at(frame.origin, coarse_m, crs)
        ground = as_overview(*self.base.overview(site_grid), site_grid)
        if overview is None or not find_flight(mapper, overview, ground, camera):
            raise InputError(
                f"the flight {self.source.name} has no GPS and was not found on the base map {self.base.path}: it "
                "shows other ground, or too much of it; give a smaller map of the flight's ground, photos with GPS, or "
                "control points (--gcp)"
            )
        return 4 * ground.unit_per_px

    def _native_m(self, mapper: PlanarMapper, camera: Camera) -> float:
        """Metres a pixel of the flight's pictures; raises InputError for a base map that is much coarser."""
        native_m = mapper.m_per_px(camera)
        if self.base.m_per_px > _COARSEST * native_m:
            raise InputError(
                f"{self.base.path} has pixels of {100 * self.base.m_per_px:.0f} cm, the flight's pictures have "
                f"{100 * native_m:.1f} cm: a base map may be {_COARSEST:.0f} times coarser at most"
            )
        return native_m


def _found_as_one(
    mapper: PlanarMapper,
    sought: Sequence[int],
    picture: Callable[[int], ImageRGB],
    camera: Camera,
    on_map: FlightOnMap,
) -> list[FoundFrame]:
    """The keyframes where all of them together are found on the base map (0087); none where they are not."""
    refined = mapper.refined(camera)
    photos = {}
    for each in sought:
        image = picture(each)
        photos[each] = on_map.features(image, refined.resized(image.shape[1], image.shape[0]))
    poses = {each: mapper.pose(each) for each in sought}
    fit = on_map.find(photos, poses)
    if fit is None:
        return []
    return [
        FoundFrame(
            each,
            camera,
            fit.map_from_flight @ site_from_image_homography(refined, poses[each]),
            fit.residual_m,
        )
        for each in sought
        if each not in fit.elsewhere
    ]


def open_base(path: Path, source: Source) -> FlightBase:
    """Open a flight's base map. Raises InputError with what to do, StoreError for a site whose map is damaged."""
    if is_site(path):
        with Archive.open(path, write=False) as archive:
            archive.require_sound(archive.mosaic_path.name)
    return FlightBase(source, BaseMap.open(path), not source.telemetry.has_fixes)
