"""One flight by `--method planar`: keyframes into the graph, the canvas and the store."""

import time
from collections.abc import Mapping, Sequence

import cv2
import numpy as np

from sorvolo.capture.sync import OffsetEstimate, estimate_offset, shifted
from sorvolo.errors import InputError
from sorvolo.geometry.arrays import Anything, Floats, ImageRGB, Matrix3
from sorvolo.geometry.camera import Camera
from sorvolo.geometry.grid import SiteGrid
from sorvolo.geometry.ground import footprint
from sorvolo.geometry.homography import pose_from_homography, site_from_image_homography
from sorvolo.missions.flight.map_objects import ObjectFinder, crops_of
from sorvolo.missions.flight.report import Stage, build_report, nothing_placed
from sorvolo.missions.flight.settings import MapSettings
from sorvolo.missions.flight.setup import FlightSetup
from sorvolo.missions.map.run import FlightRun
from sorvolo.mosaic.canvas import Canvas
from sorvolo.mosaic.canvas_frame import CanvasFrame
from sorvolo.mosaic.exposure import Exposure
from sorvolo.mosaic.placing import canvas_frame
from sorvolo.mosaic.planar import KnownKeyframe, PlanarMapper
from sorvolo.mosaic.pose_graph import PoseGraphSettings
from sorvolo.registration.lens import Undistorter, refined_camera
from sorvolo.store.exports.map_pictures import picture, write_live_preview
from sorvolo.store.images import ImageCache
from sorvolo.store.pages.flight import report_page
from sorvolo.store.site.archive import Archive, FlightWriter
from sorvolo.store.site.catalogue import StoredKeyframe
from sorvolo.survey.flight import Notice, PosedFrame
from sorvolo.survey.mosaic import PlacedFrame, Status

_WAIT_FOR_HEIGHT = 12  # keyframes held back until the height above ground is seen in them
_PAINT_EVERY = 8  # keyframes painted together: tiles that several touch are rendered once
_PAINT_REST = 4  # times as long as a painting took: showing a map that still moves must not hold up the flight
_LOCAL_M_PER_PX = 1.0
_TILT_OFFSET_DEG = 2.0  # a gimbal's zero, or a camera's mount
_HEADING_OFFSET_DEG = 5.0  # a drone's compass beside its motors
_HORIZON_MARGIN_DEG = 5.0


class PlanarRun(FlightRun):
    """A flight placed keyframe by keyframe and painted as it goes; ground that the map shows already stays as it is."""

    def __init__(
        self, setup: FlightSetup, archive: Archive, settings: MapSettings, writer: FlightWriter | None = None,
        finder: ObjectFinder | None = None,
    ) -> None:
        super().__init__(setup, archive, settings, writer, finder)
        model = setup.source.camera
        self._lens = Undistorter(model.camera)
        self._known = _known_keyframes(archive, setup)
        calibrated = model.focal_sigma <= 0.005
        height_known = setup.track is not None and np.isfinite(setup.track.altitude_offset_sigma_m)
        offset_sigma_m = setup.track.altitude_offset_sigma_m if setup.track is not None and height_known else 1e4
        self._mapper = PlanarMapper(
            PoseGraphSettings(
                focal_sigma=0.0 if calibrated or not height_known else model.focal_sigma,
                radial_sigma=0.0 if calibrated else 0.03,
                altitude_offset_sigma_m=offset_sigma_m if setup.track is not None else 0.0,
                gps_offset_sigma_m=5.0 if self._known else 0.0,
                tilt_offset_sigma_deg=_TILT_OFFSET_DEG if setup.track is not None else 0.0,
                heading_offset_sigma_deg=_HEADING_OFFSET_DEG if setup.track is not None else 0.0,
            ),
            known=[each.keyframe for each in self._known.values()],
        )
        self._first_id = len(self._known)
        self._frames: dict[int, PosedFrame] = {}
        self._images: dict[int, str] = {}
        self._held: dict[int, ImageRGB] = {}
        self._canvas: Canvas | None = None
        self._stored: Camera = model.camera.undistorted()
        self._dirty: set[int] = set()
        self._painted_at = 0
        self._paint_again_s = 0.0
        self._shown_s = time.monotonic()
        self._exposure = Exposure({}, {}, 0.0)
        self._valid: Anything | None = None
        self._known_cache = ImageCache(
            lambda each: archive.image(self._known[each].stored), 128 * 1024 * 1024
        )
        self._offset: OffsetEstimate | None = None

    @property
    def images(self) -> Mapping[int, str]:
        """Where each frame's picture is stored, by frame index: what `FlightWriter.commit` wants."""
        return self._images

    def begin(self) -> FlightWriter:
        """Start to write the flight into the site, if that has not begun; where there is no site yet it is made.

        Raises InputError when a site has to be made and no frame has a place that tells its scale.
        """
        if not self._archive.has_site:
            if not self._frames:
                raise self._nothing_placed()
            self._make_site(self._settings.m_per_px or self._native_m_per_px(), self._mapper.altitude_offset_m)
        return self._begin_flight()

    def add(self, posed: PosedFrame) -> tuple[Status, str, int]:
        """Place one frame; what became of it and how many tiles were painted meanwhile."""
        frame = posed.frame
        if _sees_horizon(self._setup.source.camera.camera, posed):
            return self.lose(frame.index, frame.name, frame.time_ns, "the camera looks at the horizon")
        with self._log.stage(Stage.UNDISTORT):
            image = self._lens.undistort(frame.image)
        keyframe_id = self._first_id + frame.index
        with self._log.stage(Stage.REGISTER):
            outcome = self._mapper.add(keyframe_id, self._lens.camera, image, posed.prior)
        self._log.end(frame.index, frame.name, frame.time_ns, outcome.status, outcome.reason)
        if outcome.status is Status.REJECTED:
            return outcome.status, outcome.reason, 0
        self._frames[keyframe_id] = posed
        self._dirty |= outcome.moved | {keyframe_id}
        with self._log.stage(Stage.STORE):
            self._keep(keyframe_id, image)
        return outcome.status, outcome.reason, self._show()

    def complete(self) -> list[PlacedFrame]:
        """Solve once more, find the clock offset, paint what moved: every selected frame as it ends, in their order.

        Nothing is committed. Frames that came to nothing are rejected; without any other nothing is painted.
        """
        if self._frames:
            with self._log.stage(Stage.REGISTER):
                self._mapper.settle()
                self._offset = self._find_offset()
            self._start_painting()
            self._exposure = self._mapper.exposure()
            self._straighten()
            self._start_over()
            self._paint()
        return self._placed()

    def finish(self, notices: Sequence[Notice], started_s: float) -> None:
        """See `FlightRun.finish`."""
        placed = self.complete()
        if all(each.status is Status.REJECTED for each in placed):
            raise self._nothing_placed()
        writer = self.begin()
        search = self._search(placed)
        with self._log.stage(Stage.REPORT):
            shown = picture(writer.tiles, 1600).rgba
        report = build_report(
            self._setup, self._settings, self._log, placed, self._archive.site(), self._offset, self._mapper.report(),
            self._refined(self._setup.source.camera.camera), writer.tiles,
            [*self._setup.notices, *notices, *self._detector_notices],
            time.monotonic() - started_s, spread=self._exposure.spread,
        )
        report["objects"] = self._search_summary(search)
        page = report_page(report, shown, crops_of(search))
        writer.commit(placed, self._images, report, page, crs=self._settings.crs, search=search)

    # ---- inside -----------------------------------------------------------------------------------------------

    def _nothing_placed(self) -> InputError:
        return nothing_placed(self._setup.source.name, self._log)

    def _keep(self, keyframe_id: int, image: ImageRGB) -> None:
        if self._canvas is not None:
            self._save(keyframe_id, image)
            return
        self._held[keyframe_id] = image
        known = self._setup.track is None or np.isfinite(self._setup.track.altitude_offset_sigma_m)
        if self._archive.has_site or (known and len(self._held) >= 2) or len(self._held) >= _WAIT_FOR_HEIGHT:
            self._start_painting()

    def _start_painting(self) -> None:
        """Lay the canvas over the site's map, now that the frames tell how large their pictures are on it."""
        if self._canvas is not None:
            return
        writer = self.begin()
        shrink = self._native_m_per_px() / self._archive.site_grid().grid.m_per_px
        if shrink < 0.77:  # a coarse map does not need every pixel of the pictures
            full = self._lens.camera
            self._stored = full.resized(max(16, round(full.width_px * shrink)), max(16, round(full.height_px * shrink)))
        self._valid = self._lens.valid(self._stored.width_px, self._stored.height_px)
        self._canvas = self._new_canvas(writer)
        for keyframe_id, image in self._held.items():
            self._save(keyframe_id, image)
        self._held.clear()

    def _new_canvas(self, writer: FlightWriter) -> Canvas:
        site_grid = self._archive.site_grid()
        canvas = Canvas(
            site_grid.grid, writer.tiles, self._image,
            painted=[each.canvas_frame(site_grid) for each in self._known.values()], keeps_known_ground=True,
        )
        if self._known:
            canvas.paint([], forget=[each for each, known in self._known.items() if known.is_superseded])
        return canvas

    def _start_over(self) -> None:
        """Take back what was shown while frames still moved: when that was painted, which a clock decides, and how
        little a frame had to move to be left as it was must not be seen in the map."""
        assert self._writer is not None
        if self._painted_at:
            self._writer.take_back_tiles()
            self._canvas = self._new_canvas(self._writer)
        self._dirty = set(self._frames)

    def _native_m_per_px(self) -> float:
        if self._setup.track is None:
            return _LOCAL_M_PER_PX
        heights = [self._mapper.pose(each).translation_m[2] for each in self._mapper.placed()]
        focal_px = self._refined(self._lens.camera).fx_px
        return float(f"{np.median(heights) / focal_px:.3g}")

    def _save(self, keyframe_id: int, image: ImageRGB) -> None:
        assert self._writer is not None
        if (image.shape[1], image.shape[0]) != (self._stored.width_px, self._stored.height_px):
            size = (self._stored.width_px, self._stored.height_px)
            image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)  # type: ignore[assignment]
        index = keyframe_id - self._first_id
        self._images[index] = self._writer.save_image(index, image)

    def _image(self, keyframe_id: int) -> ImageRGB:
        if keyframe_id < self._first_id:
            return self._known_cache.get(keyframe_id)
        assert self._writer is not None
        return self._writer.image(keyframe_id - self._first_id)

    def _refined(self, camera: Camera) -> Camera:
        return refined_camera(camera, self._mapper.focal_scale, self._mapper.radial)

    def _straighten(self) -> None:
        """Where the flight showed a distortion that the calibration left over, take it out of the kept pictures."""
        assert self._writer is not None
        radial = self._mapper.radial
        lens = Undistorter.left_over(self._stored, radial)
        if lens is None:
            return
        for keyframe_id in self._frames:
            index = keyframe_id - self._first_id
            self._images[index] = self._writer.save_image(index, lens.undistort(self._writer.image(index)))
        self._valid = lens.valid(self._stored.width_px, self._stored.height_px)

    def _site_from_image(self, keyframe_id: int, camera: Camera) -> Matrix3:
        """Of an undistorted image of the size that `camera` has: the stored one's or the frame's own."""
        refined = camera.with_focal_px(camera.fx_px * self._mapper.focal_scale)
        return site_from_image_homography(refined, self._mapper.pose(keyframe_id))

    def _show(self) -> int:
        """Paint what moved and let readers see it, now and then; how many tiles were painted."""
        if self._canvas is None or self._writer is None:
            return 0
        started_s = time.monotonic()
        if len(self._frames) - self._painted_at < _PAINT_EVERY or started_s < self._paint_again_s:
            return 0
        with self._log.stage(Stage.PAINT):
            self._exposure = self._mapper.exposure()
        painted = self._paint()
        self._paint_again_s = time.monotonic() + _PAINT_REST * (time.monotonic() - started_s)
        if time.monotonic() - self._shown_s > self._settings.live_s:
            with self._log.stage(Stage.STORE):
                self._writer.flush()
                write_live_preview(self._writer.tiles, self._archive.live_preview_path)
            self._shown_s = time.monotonic()
        return painted

    def _paint(self) -> int:
        """Paint what moved; how many tiles were painted."""
        assert self._canvas is not None
        self._painted_at = len(self._frames)
        site_grid = self._archive.site_grid()
        with self._log.stage(Stage.PAINT):
            painted = {each: self._canvas_frame(each, site_grid) for each in sorted(self._dirty)}
            tiles = self._canvas.paint(
                [frame for frame in painted.values() if frame is not None],
                forget=[each for each, frame in painted.items() if frame is None],
            )
            self._dirty.clear()
        return len(tiles)

    def _canvas_frame(self, keyframe_id: int, site_grid: SiteGrid) -> CanvasFrame | None:
        return canvas_frame(
            keyframe_id, self._rank(), self._stored, self._site_from_image(keyframe_id, self._stored), site_grid,
            self._exposure.gains.get(keyframe_id, np.ones(3)), self._exposure.vignettes.get(0, np.zeros(2)),
            self._valid,
        )

    def _rank(self) -> int:
        return 1 + max((each.rank for each in self._known.values()), default=-1)

    def _find_offset(self) -> OffsetEstimate | None:
        """The clock offset that motion shows, applied when it is well seen and none was given."""
        setup = self._setup
        if setup.track is None or setup.clock is None or setup.clock.sigma_s == 0:
            return None
        estimate = None
        track = setup.track
        applied_s = 0.0
        for _ in range(3):
            ids = self._mapper.placed()
            path = self._mapper.path_m()
            tied = np.isfinite(path[:, 0])
            times = np.array([setup.seconds(self._frames[each].frame) for each in ids])
            reach_s = 4 * setup.clock.sigma_s if not applied_s else 1.0
            found = estimate_offset(shifted(track, applied_s), times[tied], path[tied, :2], reach_s=reach_s)
            estimate = found if estimate is None else OffsetEstimate(
                applied_s + found.offset_s, found.sigma_s, estimate.rms_at_zero_m, found.rms_m
            )
            if self._settings.offset_s is not None or not found.is_significant:
                break
            applied_s += found.offset_s
            moved_track = shifted(track, applied_s)
            self._mapper.retime({
                each: moved_track.prior(seconds, smooth_s=setup.plan.smooth_s)
                for each, seconds in zip(ids, times, strict=True)
            })
        self._log.offset_applied_s = applied_s
        return estimate

    def _placed(self) -> list[PlacedFrame]:
        camera = self._refined(self._setup.source.camera.camera)
        result = []
        residuals: dict[int, float] = {}
        sigmas: dict[int, float] = {}
        gps: dict[int, Floats] = {}
        if self._frames:
            residuals = self._mapper.residuals_px(self._lens.camera)
            sigmas, gps = self._mapper.sigmas_m(), self._mapper.gps_residuals_m()
        for ending in self._log.endings.values():
            keyframe_id = self._first_id + ending.index
            time_ns = self._setup.utc_ns(ending.time_ns)
            if keyframe_id not in self._frames:
                result.append(PlacedFrame.rejected(ending.index, ending.name, time_ns, ending.reason, camera))
                continue
            status, reason = self._mapper.ending(keyframe_id)
            pose = self._mapper.pose(keyframe_id)
            outline_m = footprint(camera, pose)
            if not np.isfinite(outline_m).all():
                reason = "the camera looks at the horizon"
                self._log.end(ending.index, ending.name, ending.time_ns, Status.REJECTED, reason)
                result.append(PlacedFrame.rejected(ending.index, ending.name, time_ns, reason, camera))
                continue
            self._log.end(ending.index, ending.name, ending.time_ns, status, reason)
            result.append(PlacedFrame(
                ending.name, ending.index, time_ns, status, reason, camera, pose,
                self._site_from_image(keyframe_id, self._lens.camera), outline_m,
                residuals.get(keyframe_id, float("nan")), sigmas[keyframe_id],
                self._exposure.gains.get(keyframe_id, np.ones(3)), gps[keyframe_id],
                self._exposure.vignettes.get(0, np.zeros(2)),
            ))
        return result


class _Known:
    """A keyframe of an earlier flight on this site, as the map has it."""

    def __init__(self, keyframe_id: int, stored: StoredKeyframe, rank: int, archive: Archive, superseded: bool) -> None:
        self.id, self.stored, self.rank, self.is_superseded = keyframe_id, stored, rank, superseded
        # the thesis's method knows a similarity only: that of a camera looking straight down
        pose = stored.site_from_camera or pose_from_homography(stored.site_from_image, stored.camera)
        assert pose is not None
        self.keyframe = KnownKeyframe(
            keyframe_id, stored.camera, pose, stored.sigma_m, lambda: archive.image(stored)
        )

    def canvas_frame(self, site_grid: SiteGrid) -> CanvasFrame:
        found = canvas_frame(
            self.id, self.rank, self.stored.camera, self.stored.site_from_image, site_grid, self.stored.gains,
            self.stored.vignette, None,
        )
        assert found is not None  # it was painted before
        return found


def _known_keyframes(archive: Archive, setup: FlightSetup) -> dict[int, _Known]:
    """The site's keyframes by canvas id; those of this flight's own earlier run are marked as superseded.

    When that run made the newest map its tiles are taken back anyway, and its keyframes are left out.
    """
    if not archive.has_site:
        return {}
    ranks = {flight.id: flight.rank for flight in archive.flights()}
    newest = next((v for v in reversed(archive.versions()) if v.complete), None)
    stored = [
        each for each in archive.keyframes()
        if not (newest is not None and newest.flight_id == setup.source.name == each.flight_id)
    ]
    return {
        k: _Known(k, each, ranks[each.flight_id], archive, each.flight_id == setup.source.name)
        for k, each in enumerate(stored)
    }


def _sees_horizon(camera: Camera, posed: PosedFrame) -> bool:
    if posed.prior.attitude_sigma_deg[:2].max() > 4.0:
        return False
    rays = camera.rays_from_pixels(camera.corners_px) @ posed.prior.rotation.T
    down = -rays[:, 2] / np.linalg.norm(rays, axis=1)
    return bool(np.degrees(np.arcsin(down.min())) < _HORIZON_MARGIN_DEG)
