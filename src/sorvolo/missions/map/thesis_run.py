"""One flight by `--method thesis`: section 3.1.1 from the selected frames to the site's tiles."""

import time
from collections.abc import Sequence

from sorvolo.errors import GeometryError, InputError
from sorvolo.geometry.arrays import ImageRGB, Matrix3
from sorvolo.geometry.camera import Camera
from sorvolo.missions.flight.log import Stage, nothing_placed
from sorvolo.missions.flight.map_objects import ObjectFinder, crops_of
from sorvolo.missions.flight.report import FlightResult, build_report
from sorvolo.missions.flight.settings import MapSettings
from sorvolo.missions.flight.setup import FlightSetup
from sorvolo.missions.map.run import FlightRun
from sorvolo.mosaic.roi_stitching import RoiStitcher, Stitched
from sorvolo.mosaic.stitched_map import (
    MIRROR_Y,
    StitchedPlaces,
    mosaic_m_per_px,
    paint_mosaic,
    site_from_mosaic,
)
from sorvolo.registration.lens import Undistorter, at_size
from sorvolo.store.exports.map_pictures import picture
from sorvolo.store.pages.flight import report_page
from sorvolo.store.site.archive import Archive
from sorvolo.survey.flight import Notice, PosedFrame
from sorvolo.survey.mosaic import PlacedFrame, Status


class ThesisRun(FlightRun):
    """A flight mapped as the thesis does: all of it stitched first, then anchored to its fixes."""

    def __init__(
        self,
        setup: FlightSetup,
        archive: Archive,
        settings: MapSettings,
        finder: ObjectFinder | None = None,
        request: str = "",
    ) -> None:
        super().__init__(setup, archive, settings, finder=finder, request=request)
        self._lens = Undistorter(setup.source.camera.camera)
        full = self._lens.camera
        scale = min(1.0, settings.thesis.side_px / max(full.width_px, full.height_px))
        self._camera: Camera = full.resized(
            round(full.width_px * scale), round(full.height_px * scale)
        )
        self._stitcher = RoiStitcher(settings.thesis)
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
