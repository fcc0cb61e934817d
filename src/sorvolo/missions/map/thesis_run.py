"""One flight by `--method thesis`: section 3.1.1 from the selected frames to the site's tiles."""

import time
from collections.abc import Sequence

import cv2
import numpy as np

from sorvolo.errors import GeometryError, InputError
from sorvolo.geometry.arrays import Floats, ImageRGB, ImageRGBA, Matrix3
from sorvolo.geometry.camera import Camera
from sorvolo.geometry.grid import SiteGrid
from sorvolo.geometry.homography import apply_homography
from sorvolo.missions.flight.map_objects import ObjectFinder, crops_of
from sorvolo.missions.flight.report import Stage, build_report, nothing_placed
from sorvolo.missions.flight.settings import MapSettings
from sorvolo.missions.flight.setup import FlightSetup
from sorvolo.missions.map.run import FlightRun
from sorvolo.mosaic.roi_stitching import RoiStitcher, RoiStitchingSettings, Stitched, georeference
from sorvolo.registration.lens import Undistorter
from sorvolo.store.exports.map_pictures import picture
from sorvolo.store.pages.flight import report_page
from sorvolo.store.site.archive import Archive, FlightWriter
from sorvolo.survey.flight import Notice, PosedFrame
from sorvolo.survey.mosaic import PlacedFrame, Status

_SIDE_PX = 1024  # the thesis stitches at half HD (section 4.1.2): larger pictures are made as small
_MIRROR_Y = np.diag([1.0, -1.0, 1.0])


class ThesisRun(FlightRun):
    """A flight mapped as the thesis does: all of it stitched first, then anchored to its fixes."""

    def __init__(
        self, setup: FlightSetup, archive: Archive, settings: MapSettings, finder: ObjectFinder | None = None
    ) -> None:
        super().__init__(setup, archive, settings, finder=finder)
        self._lens = Undistorter(setup.source.camera.camera)
        full = self._lens.camera
        scale = min(1.0, _SIDE_PX / max(full.width_px, full.height_px))
        self._camera: Camera = full.resized(round(full.width_px * scale), round(full.height_px * scale))
        self._stitcher = RoiStitcher(RoiStitchingSettings(transform=settings.transform))
        self._frames: dict[int, PosedFrame] = {}
        self._stitched: dict[int, Stitched] = {}
        self._pictures: dict[int, ImageRGB] = {}

    def add(self, posed: PosedFrame) -> tuple[Status, str, int]:
        """Stitch one frame; what became of it. The site's tiles are painted at the end, when GPS anchors the mosaic."""
        frame = posed.frame
        with self._log.stage(Stage.UNDISTORT):
            image = self._lens.undistort(frame.image)
            size = (self._camera.width_px, self._camera.height_px)
            if image.shape[1::-1] != size:
                image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)  # type: ignore[assignment]
        with self._log.stage(Stage.REGISTER):
            found = self._stitcher.add(frame.index, image)
        if isinstance(found, Stitched):
            self._stitched[frame.index] = found
            status, reason = Status.VISION, ""
        elif posed.prior.knows_place:
            status, reason = Status.GPS_ONLY, found.reason
        else:
            return self.lose(frame.index, frame.name, frame.time_ns, found.reason)
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
        site_from_mosaic = self._georeference()
        metres = float(np.sqrt(abs(np.linalg.det(site_from_mosaic[:2, :2]))))
        self._make_site(self._settings.m_per_px or float(f"{metres:.3g}"), 0.0)
        site, writer = self._archive.site(), self._begin_flight()
        with self._log.stage(Stage.STORE):
            paths = {index: writer.save_image(index, image) for index, image in self._pictures.items()}
        with self._log.stage(Stage.PAINT):
            self._paint(site_from_mosaic, self._archive.site_grid(), writer)
        with self._log.stage(Stage.REPORT):
            placed = self._placed(site_from_mosaic)
            shown = picture(writer.tiles, 1600).rgba
        search = self._search(placed)
        report = build_report(
            self._setup, self._settings, self._log, placed, site, None, None, self._setup.source.camera.camera,
            writer.tiles, [*self._setup.notices, *notices, *self._detector_notices], time.monotonic() - started_s,
            spread=float("nan"),
        )
        report["objects"] = self._search_summary(search)
        page = report_page(report, shown, crops_of(search))
        writer.commit(placed, paths, report, page, crs=self._settings.crs, search=search)

    # ---- inside -----------------------------------------------------------------------------------------------

    def _georeference(self) -> Matrix3:
        """site_from_mosaic: each fix anchored to its frame's barycentre; mirrored pixels where there are no fixes."""
        anchored = [each for each in self._stitched if self._frames[each].prior.knows_place]
        if self._setup.track is None:
            return _MIRROR_Y
        barycentres = np.array([self._stitched[each].barycentre_px for each in anchored]).reshape(-1, 2)
        fixes_m = np.array([self._frames[each].prior.position_m[:2] for each in anchored]).reshape(-1, 2)
        try:
            return georeference(barycentres, fixes_m)
        except GeometryError as error:
            raise InputError(
                f"{len(anchored)} stitched frames of {self._setup.source.name} have a GPS fix, which is too few to "
                "place the mosaic; --method planar places each frame by its own fix"
            ) from error

    def _paint(self, site_from_mosaic: Matrix3, site_grid: SiteGrid, writer: FlightWriter) -> None:
        rgba, (x, y) = self._stitcher.mosaic()
        height, width = rgba.shape[:2]
        corner = np.array([[1.0, 0.0, x], [0.0, 1.0, y], [0.0, 0.0, 1.0]])
        site_from_rgba = site_from_mosaic @ corner
        middle_m = apply_homography(site_from_rgba, np.array([[width / 2, height / 2]]))[0]
        reach_m = float(np.linalg.norm(apply_homography(site_from_rgba, np.zeros((1, 2)))[0] - middle_m))
        grid_from_rgba = site_grid.grid_from_site_affine(middle_m, reach_m) @ site_from_rgba
        outline = apply_homography(grid_from_rgba, np.array([[0, 0], [width, 0], [width, height], [0, height]], float))
        for tile in sorted(site_grid.grid.tiles_touched(outline)):
            x0, y0, _, _ = site_grid.grid.tile_window(tile)
            shift = np.array([[1.0, 0.0, -x0], [0.0, 1.0, -y0], [0.0, 0.0, 1.0]])
            side = site_grid.grid.tile_px
            painted: ImageRGBA = cv2.warpPerspective(rgba, shift @ grid_from_rgba, (side, side), flags=cv2.INTER_LINEAR)  # type: ignore[assignment]
            seen = painted[..., 3] == 255
            known = writer.tiles.get(tile)
            result = np.zeros((side, side, 4), np.uint8) if known is None else known.copy()
            seen &= result[..., 3] == 0  # ground that the map knows stays
            if seen.any():
                result[seen] = painted[seen]
                writer.tiles[tile] = result

    def _placed(self, site_from_mosaic: Matrix3) -> list[PlacedFrame]:
        camera = self._setup.source.camera.camera
        distorted = camera.is_distorted
        corners = camera.undistort_points(camera.corners_px) if distorted else self._lens.camera.corners_px
        small = np.diag([self._camera.width_px / camera.width_px, self._camera.height_px / camera.height_px, 1.0])
        small[:2, 2] = 0.5 * np.diag(small)[:2] - 0.5  # pixel centres stay on pixel centres
        result = []
        last: Matrix3 | None = None
        for ending in self._log.endings.values():
            time_ns = self._setup.utc_ns(ending.time_ns)
            if ending.index not in self._frames:
                result.append(PlacedFrame.rejected(ending.index, ending.name, time_ns, ending.reason, camera))
                continue
            posed, stitched = self._frames[ending.index], self._stitched.get(ending.index)
            if stitched is not None:
                last = site_from_mosaic @ stitched.mosaic_from_image
            assert last is not None  # the first frame is always stitched
            site_from_image = last if stitched is not None else self._moved(last, posed.prior.position_m[:2])
            outline_m = apply_homography(site_from_image @ small, corners)
            centre_m = apply_homography(site_from_image, self._barycentre()[None])[0]
            gps = np.full(3, np.nan)
            if posed.prior.knows_place:
                gps[:2] = centre_m - posed.prior.position_m[:2]
            sigma_m = float(np.hypot(*posed.prior.position_sigma_m[:2])) if stitched is None else float("nan")
            result.append(PlacedFrame(
                ending.name, ending.index, time_ns, ending.status, ending.reason, camera, None,
                site_from_image @ small, outline_m,
                stitched.residual_px if stitched else float("nan"), sigma_m, gps_residual_m=gps,
            ))
        return result

    def _barycentre(self) -> Floats:
        return np.array([(self._camera.width_px - 1) / 2, (self._camera.height_px - 1) / 2])

    def _moved(self, site_from_image: Matrix3, place_m: Floats) -> Matrix3:
        """A frame that was not stitched: turned and scaled as the last one, its barycentre at its own fix."""
        now_m = apply_homography(site_from_image, self._barycentre()[None])[0]
        shift = np.eye(3)
        shift[:2, 2] = place_m - now_m
        return shift @ site_from_image
