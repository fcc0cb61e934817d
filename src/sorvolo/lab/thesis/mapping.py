"""Section 3.1.1 as a map: the frames stitched, the mosaic anchored to GPS fixes and cut into the site's tiles."""

import time
from collections.abc import MutableMapping, Sequence
from dataclasses import dataclass, field
from typing import ClassVar

import cv2
import numpy as np

from sorvolo.errors import GeometryError, InputError
from sorvolo.geometry.arrays import Floats, ImageRGB, ImageRGBA, Matrix3, PointsM, PointsPx
from sorvolo.geometry.camera import Camera
from sorvolo.geometry.grid import SiteGrid, TileIndex
from sorvolo.geometry.homography import apply_homography
from sorvolo.lab.thesis.stitching import RoiStitcher, RoiStitchingSettings, Stitched, georeference
from sorvolo.missions.flight.log import Stage, nothing_placed
from sorvolo.missions.flight.map_objects import ObjectFinder, crops_of
from sorvolo.missions.flight.report import FlightResult, build_report
from sorvolo.missions.flight.settings import MapSettings
from sorvolo.missions.flight.setup import FlightSetup
from sorvolo.missions.map.planar_run import FlightRun
from sorvolo.registration.lens import Undistorter, at_size
from sorvolo.store.exports.map_pictures import picture
from sorvolo.store.pages.flight import report_page
from sorvolo.store.site.archive import Archive
from sorvolo.survey.flight import Notice, PosedFrame
from sorvolo.survey.mosaic import PlacedFrame, Status

MIRROR_Y: Matrix3 = np.diag([1.0, -1.0, 1.0])
"""site_from_mosaic of a mosaic without fixes: mirrored pixels."""


@dataclass(frozen=True)
class ThesisMapping:
    """The method as `map_flights` takes it."""

    stitching: RoiStitchingSettings = field(default_factory=RoiStitchingSettings)

    name: ClassVar[str] = "thesis"

    def begin(
        self,
        setup: FlightSetup,
        archive: Archive,
        settings: MapSettings,
        finder: ObjectFinder | None,
        request: str,
    ) -> "ThesisRun":
        """The run of one flight."""
        return ThesisRun(self.stitching, setup, archive, settings, finder, request)


class ThesisRun(FlightRun):
    """A flight mapped as the thesis does: all of it stitched first, then anchored to its fixes."""

    def __init__(
        self,
        stitching: RoiStitchingSettings,
        setup: FlightSetup,
        archive: Archive,
        settings: MapSettings,
        finder: ObjectFinder | None,
        request: str,
    ) -> None:
        super().__init__(setup, archive, settings, finder=finder, request=request)
        self._lens = Undistorter(setup.source.camera.camera)
        full = self._lens.camera
        scale = min(1.0, stitching.side_px / max(full.width_px, full.height_px))
        self._camera: Camera = full.resized(
            round(full.width_px * scale), round(full.height_px * scale)
        )
        self._stitcher = RoiStitcher(stitching)
        self._frames: dict[int, PosedFrame] = {}
        self._stitched: dict[int, Stitched] = {}
        self._pictures: dict[int, ImageRGB] = {}

    def add(self, posed: PosedFrame) -> tuple[Status, str, int]:
        """Stitch one frame; what became of it. The site's tiles are painted at the end, when GPS anchors the mosaic."""
        frame = posed.frame
        with self._log.stage(Stage.UNDISTORT):
            image = self._lens.undistort(frame.image)
            image = at_size(image, self._camera.width_px, self._camera.height_px)
        with self._log.stage(Stage.REGISTER):
            found = self._stitcher.add(frame.index, image)
        if isinstance(found, Stitched):
            self._stitched[frame.index] = found
            status, reason = Status.VISION, ""
        elif posed.prior.knows_place:
            status, reason = Status.GPS_ONLY, found.reason
        else:
            return self.lose(frame, found.reason)
        self._log.end(frame.index, frame.name, frame.time_ns, status, reason)
        self._frames[frame.index] = posed
        self._pictures[frame.index] = image
        return status, reason, 0

    def finish(self, notices: Sequence[Notice], started_s: float) -> None:
        """Anchor the mosaic to its fixes, cut it into tiles, and make the flight part of the site.

        `started_s` is when the flight's mapping began, by the monotonic clock.
        """
        if not self._stitched:
            raise nothing_placed(self._setup.source.name, self._log)
        anchored = self._georeference()
        self._make_site(self._settings.m_per_px or mosaic_m_per_px(anchored), 0.0)
        site, writer = self._archive.site(), self._begin_flight()
        with self._log.stage(Stage.STORE):
            paths = {
                index: writer.save_image(index, image) for index, image in self._pictures.items()
            }
        with self._log.stage(Stage.PAINT):
            rgba, corner_px = self._stitcher.mosaic()
            paint_mosaic(rgba, corner_px, anchored, self._archive.site_grid(), writer.tiles)
        with self._log.stage(Stage.REPORT):
            placed = self._placed(anchored)
            shown = picture(writer.tiles, 1600)
        search = self._search(placed)
        report = build_report(
            self._setup,
            self._settings,
            self._log,
            FlightResult(placed, self._setup.source.camera.camera),
            site,
            shown,
            [*notices, *self._detector_notices],
            time.monotonic() - started_s,
        )
        report["objects"] = self._search_summary(search)
        page = report_page(report, shown.rgba, crops_of(search), self._archive.site())
        writer.commit(placed, paths, report, page, crs=self._settings.crs, search=search)

    # ---- inside -----------------------------------------------------------------------------------------------

    def _georeference(self) -> Matrix3:
        """site_from_mosaic: each fix anchored to its frame's barycentre; mirrored pixels where there are no fixes."""
        if self._setup.track is None:
            return MIRROR_Y
        anchored = [
            (stitched, self._frames[each])
            for each, stitched in self._stitched.items()
            if self._frames[each].prior.knows_place
        ]
        try:
            return site_from_mosaic(anchored)
        except GeometryError as error:
            raise InputError(
                f"{len(anchored)} stitched frames of {self._setup.source.name} have a GPS fix, which is too few to "
                "place the mosaic; --method planar places each frame by its own fix"
            ) from error

    def _placed(self, anchored: Matrix3) -> list[PlacedFrame]:
        camera = self._setup.source.camera.camera
        places = StitchedPlaces(
            camera, self._camera, anchored, has_fixes=self._setup.track is not None
        )
        result = []
        for ending in self._log.endings.values():
            time_ns = self._setup.utc_ns(ending.time_ns)
            if ending.index in self._frames:
                posed, stitched = self._frames[ending.index], self._stitched.get(ending.index)
                result.append(places.place(posed, stitched, time_ns, ending.status, ending.reason))
            else:
                result.append(
                    PlacedFrame.rejected(ending.index, ending.name, time_ns, ending.reason, camera)
                )
        return result


def site_from_mosaic(anchored: Sequence[tuple[Stitched, PosedFrame]]) -> Matrix3:
    """(3, 3) with each fix anchored to its frame's barycentre. Raises GeometryError for too few of them."""
    barycentres = np.array([each.barycentre_px for each, _ in anchored]).reshape(-1, 2)
    fixes_m = np.array([posed.prior.position_m[:2] for _, posed in anchored]).reshape(-1, 2)
    return georeference(barycentres, fixes_m)


def mosaic_m_per_px(site_from_mosaic: Matrix3) -> float:
    """The ground sampling distance of the mosaic, to three digits: a new map's."""
    return float(f"{float(np.sqrt(abs(np.linalg.det(site_from_mosaic[:2, :2])))):.3g}")


def paint_mosaic(
    rgba: ImageRGBA,
    corner_px: tuple[int, int],
    site_from_mosaic: Matrix3,
    site_grid: SiteGrid,
    tiles: MutableMapping[TileIndex, ImageRGBA],
) -> None:
    """Cut the mosaic, whose first pixel is `corner_px` in mosaic coordinates, into tiles; known ground stays."""
    height, width = rgba.shape[:2]
    x, y = corner_px
    corner = np.array([[1.0, 0.0, x], [0.0, 1.0, y], [0.0, 0.0, 1.0]])
    site_from_rgba = site_from_mosaic @ corner
    middle_m = apply_homography(site_from_rgba, np.array([[width / 2, height / 2]]))[0]
    reach_m = float(
        np.linalg.norm(apply_homography(site_from_rgba, np.zeros((1, 2)))[0] - middle_m)
    )
    grid_from_rgba = site_grid.grid_from_site_affine(middle_m, reach_m) @ site_from_rgba
    outline = apply_homography(
        grid_from_rgba, np.array([[0, 0], [width, 0], [width, height], [0, height]], float)
    )
    side = site_grid.grid.tile_px
    for tile in sorted(site_grid.grid.tiles_touched(outline)):
        x0, y0, _, _ = site_grid.grid.tile_window(tile)
        shift = np.array([[1.0, 0.0, -x0], [0.0, 1.0, -y0], [0.0, 0.0, 1.0]])
        painted: ImageRGBA = cv2.warpPerspective(
            rgba, shift @ grid_from_rgba, (side, side), flags=cv2.INTER_LINEAR
        )  # type: ignore[assignment]
        seen = painted[..., 3] == 255
        known = tiles.get(tile)
        result = np.zeros((side, side, 4), np.uint8) if known is None else known.copy()
        seen &= result[..., 3] == 0  # ground that the map knows stays
        if seen.any():
            result[seen] = painted[seen]
            tiles[tile] = result


class StitchedPlaces:
    """Places a flight's frames by the anchored mosaic, one after another: a frame that was not stitched lies as the one
    before, moved to its own fix. Only `place` changes it.

    `full` is the frames' camera, `small` the undistorted one at the size at which they were stitched. Without
    `has_fixes` the first frame's place is the site's own origin, which no frame departs from.
    """

    def __init__(
        self, full: Camera, small: Camera, site_from_mosaic: Matrix3, *, has_fixes: bool = True
    ) -> None:
        self._camera, self._site_from_mosaic, self._has_fixes = full, site_from_mosaic, has_fixes
        self._corners: PointsPx = (
            full.undistort_points(full.corners_px) if full.is_distorted else full.corners_px
        )
        scale = np.diag([small.width_px / full.width_px, small.height_px / full.height_px, 1.0])
        scale[:2, 2] = 0.5 * np.diag(scale)[:2] - 0.5  # pixel centres stay on pixel centres
        self._small_from_full: Matrix3 = scale
        self._barycentre: Floats = np.array([(small.width_px - 1) / 2, (small.height_px - 1) / 2])
        self._last: Matrix3 | None = None

    def place(
        self,
        posed: PosedFrame,
        stitched: Stitched | None,
        time_ns: int,
        status: Status,
        reason: str,
    ) -> PlacedFrame:
        """The frame's record; the first frame of a flight is always stitched."""
        if stitched is not None:
            self._last = self._site_from_mosaic @ stitched.mosaic_from_image
        assert self._last is not None
        site_from_image = (
            self._last
            if stitched is not None
            else self._moved(self._last, posed.prior.position_m[:2])
        )
        outline_m = apply_homography(site_from_image @ self._small_from_full, self._corners)
        centre_m = apply_homography(site_from_image, self._barycentre[None])[0]
        gps = np.full(3, np.nan)
        if self._has_fixes and posed.prior.knows_place:
            gps[:2] = centre_m - posed.prior.position_m[:2]
        sigma_m = (
            float(np.hypot(*posed.prior.position_sigma_m[:2])) if stitched is None else float("nan")
        )
        return PlacedFrame(
            posed.frame.name,
            posed.frame.index,
            time_ns,
            status,
            reason,
            self._camera,
            None,
            site_from_image @ self._small_from_full,
            outline_m,
            stitched.residual_px if stitched else float("nan"),
            sigma_m,
            gps_residual_m=gps,
        )

    def _moved(self, site_from_image: Matrix3, place_m: PointsM) -> Matrix3:
        """Turned and scaled as the last frame, its barycentre at its own fix."""
        now_m = apply_homography(site_from_image, self._barycentre[None])[0]
        shift = np.eye(3)
        shift[:2, 2] = place_m - now_m
        return shift @ site_from_image
