"""One flight by `--method planar`: keyframes into the graph, the canvas and the store."""

import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cache, partial
from typing import Any, Self

from sorvolo.capture.clock_offset import OffsetEstimate, shared_motion_m_s
from sorvolo.capture.live.stream import LiveStream
from sorvolo.capture.source import LiveSource
from sorvolo.errors import InputError
from sorvolo.geometry.arrays import Floats, ImageRGB, Matrix3
from sorvolo.geometry.camera import Camera
from sorvolo.geometry.ground import footprint, is_on_ground
from sorvolo.heights.figures import camera_warnings
from sorvolo.missions.flight.control import FlightControl
from sorvolo.missions.flight.log import Ending, FlightLog, Stage, nothing_placed
from sorvolo.missions.flight.looked_at import searched_document
from sorvolo.missions.flight.map_objects import (
    ObjectFinder,
    crops_of,
    search_summary,
    why_not_searched,
    with_objects,
)
from sorvolo.missions.flight.report import FlightResult, MapShape, build_report
from sorvolo.missions.flight.request import REQUEST
from sorvolo.missions.flight.result_cache import ResultCache
from sorvolo.missions.flight.settings import TILES_MB, MapSettings, memory_budget_bytes
from sorvolo.missions.flight.setup import FlightSetup, new_site
from sorvolo.missions.heights.run import GroundModel, ground_tiles, write_heights
from sorvolo.missions.map.coverage import FlightCoverage
from sorvolo.missions.map.ground import MapGround, ground_of, pieces_of, shape_of, standing_frames
from sorvolo.missions.map.painting import FlightPainter, KnownKeyframes
from sorvolo.mosaic.base_ties import BaseReport, FoundFrame, tie_to_base
from sorvolo.mosaic.exposure import Exposure
from sorvolo.mosaic.graph_settings import PoseGraphSettings
from sorvolo.mosaic.placing import map_m_per_px, sees_horizon
from sorvolo.mosaic.planar import PlanarMapper, Registered
from sorvolo.mosaic.seen_ground import PictureOnGround
from sorvolo.mosaic.selection import Selected
from sorvolo.registration.lens import Undistorter, refined_camera
from sorvolo.store.exports.ground_files import control_documents
from sorvolo.store.exports.map_pictures import picture
from sorvolo.store.images import image_from_jpeg, jpeg_from_image
from sorvolo.store.pages.flight import report_page
from sorvolo.store.site.archive import Archive, FlightWriter
from sorvolo.store.site.catalogue import StoredKeyframe
from sorvolo.store.site.spill import SpillFile
from sorvolo.store.site.upkeep import HEIGHTS
from sorvolo.survey.control import ControlReport
from sorvolo.survey.flight import Frame, LostFrame, Notice, PosedFrame
from sorvolo.survey.map_objects import ObjectSearch
from sorvolo.survey.mosaic import FrameView, PlacedFrame, Status


class FlightRun(ABC):
    """A flight on its way into a site. A context manager: leaving without `finish` leaves the site as it was.

    `writer` is one that was begun before for this flight; whoever began it ends it. `finder` looks for objects in the
    frames; None: nobody does. `memo` has what a killed run computed. `request` is what is asked for, see `request_of`.
    """

    def __init__(
        self,
        setup: FlightSetup,
        archive: Archive,
        settings: MapSettings,
        writer: FlightWriter | None = None,
        finder: ObjectFinder | None = None,
        memo: ResultCache | None = None,
        request: str = "",
    ) -> None:
        self._setup, self._archive, self._settings, self._finder = setup, archive, settings, finder
        self._memo, self._request = ResultCache() if memo is None else memo, request
        self._log = FlightLog()
        self._writer, self._began_writer = writer, False

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *ended: Any) -> None:
        if self._finder is not None:
            self._finder.close()
        if self._writer is not None and self._began_writer:
            self._writer.__exit__(*ended)
        self._memo.end(ended[1])

    @property
    def selected(self) -> int:
        """Frames taken so far, lost ones included."""
        return len(self._log.endings)

    @property
    def by_vision(self) -> int:
        return self._log.count(Status.VISION)

    def lose(self, frame: Frame | LostFrame, reason: str) -> tuple[Status, str, int]:
        """A selected frame that cannot be used."""
        self._log.end(frame.index, frame.name, frame.time_ns, Status.REJECTED, reason)
        return Status.REJECTED, reason, 0

    def take(self, selected: Selected | LostFrame) -> tuple[Status, str, int]:
        """Take one selected frame, or one that the source lost; see `add`."""
        if isinstance(selected, LostFrame):
            ended = self.lose(selected, selected.reason)
            self._memo.end_frame(selected, reason=selected.reason)
            return ended
        posed = selected.posed
        if selected.reason:
            ended = self.lose(posed.frame, selected.reason)
        else:
            if self._finder is not None:
                with self._log.stage(Stage.DETECT):
                    self._finder.look(posed)
            ended = self.add(posed)
        self._memo.end_frame(posed.frame, posed.prior, selected.reason)
        return ended

    @abstractmethod
    def add(self, posed: PosedFrame) -> tuple[Status, str, int]:
        """Place one frame; what became of it, in words if not by vision, and how many tiles were painted meanwhile."""

    def pictures_on_ground(self) -> Sequence[PictureOnGround]:
        """Return where the pictures that have a place lie by now."""
        return ()

    def view(self, index: int, time_ns: int) -> FrameView | None:
        """Return what the frame of this index shows, as it lies now; None where the camera's place is not known."""
        return None

    def stored_frame(self, index: int) -> StoredKeyframe | None:
        """Return the frame of this index as it lies now, with the picture that the site keeps of it.

        None where it has no place, or where no picture is stored yet: it may be asked for later.
        """
        return None

    @abstractmethod
    def finish(self, notices: Sequence[Notice], started_s: float) -> None:
        """Place the flight for good, paint it and make it part of the site.

        `started_s` is when the flight's mapping began, by the monotonic clock. Raises InputError, and leaves the site
        as it was, when no frame has a place.
        """

    def _search(
        self, placed: Sequence[PlacedFrame], model: GroundModel | None = None
    ) -> ObjectSearch | None:
        """Return what stands on the ground by the frames' final places; None where nobody looked."""
        if self._finder is None:
            return None
        with self._log.stage(Stage.DETECT):
            return self._finder.conclude(
                placed,
                self._setup.source.name,
                has_metres=not self._archive.site().is_local,
                ground=None if model is None else model.bare_at,
            )

    def _add_search(
        self, report: dict[str, Any], search: ObjectSearch | None, placed: Sequence[PlacedFrame]
    ) -> dict[str, bytes]:
        """Add what was searched for to a report and its headline; the outlines of the ground that was looked at."""
        looked, ground, site = None, None, self._archive.site()
        if self._finder is not None:
            looked, ground = self._finder.looked_at(placed, site, self._settings.enough_looked_at)
        seconds = 0.0 if self._finder is None else self._finder.seconds
        report["objects"] = search_summary(
            search, looked, seconds, why_not_searched(self._settings.model)
        )
        if "headline" in report:
            report["headline"] = with_objects(report, report["headline"])
        return searched_document(ground, site)

    @property
    def _detector_notices(self) -> tuple[Notice, ...]:
        return () if self._finder is None else self._finder.notices

    def _make_site(self, m_per_px: float, ground_up_m: float) -> None:
        """Make the site if there is none; see `new_site`."""
        if not self._archive.has_site:
            name = self._archive.folder.resolve().name or "site"
            self._archive.create_site(new_site(self._setup, name, m_per_px, ground_up_m))

    def _begin_flight(self) -> FlightWriter:
        """Return the writer, begun when it is first asked for."""
        if self._writer is None:
            source = self._setup.source
            # pictures that lie around a place are painted one after the other
            camera = source.camera.camera
            picture_mb = 3 * camera.width_px * camera.height_px // 1_000_000
            images_mb = min(_IMAGES_MB, max(_LEAST_IMAGES_MB, _PICTURES * picture_mb))
            memory_mb = int(memory_budget_bytes(self._settings.memory_mb) / 1e6)
            self._writer = self._archive.begin_flight(
                source.name,
                source.fingerprint,
                {
                    **vars(self._settings),
                    "method": self._settings.method_name,
                    REQUEST: self._request,
                },
                tiles_mb=min(TILES_MB, memory_mb // 8),
                images_mb=min(images_mb, memory_mb // 2),
                journal=self._memo.journal,
            )
            self._began_writer = True
        return self._writer


_LEAST_IMAGES_MB, _IMAGES_MB = 64, 256  # for pictures, small and large: more gains nothing
_PICTURES = 6  # of the flight's that are wanted at once, those beside each other in two strips
_WAIT_FOR_HEIGHT = 12  # keyframes held back until the height above ground is seen in them
_OFFSET_ROUNDS = 3  # of finding the clock's offset, at most: what one leaves the next one finds
_LOCAL_M_PER_PX = 1.0  # without GPS: a map's unit is a pixel of its first frame
HORIZON = "the camera looks at the horizon"
"""Why a frame is rejected that shows more than the ground."""


class PlanarRun(FlightRun):
    """A flight placed keyframe by keyframe and painted as it goes; ground that the map shows already stays as it is."""

    def __init__(
        self,
        setup: FlightSetup,
        archive: Archive,
        settings: MapSettings,
        writer: FlightWriter | None = None,
        finder: ObjectFinder | None = None,
        memo: ResultCache | None = None,
        request: str = "",
        coverage: FlightCoverage | None = None,
    ) -> None:
        super().__init__(setup, archive, settings, writer, finder, memo, request)
        self._coverage = coverage
        model = setup.source.camera
        self._lens = Undistorter(model.camera)
        self._known = KnownKeyframes(archive, setup.source.name)
        offset_sigma_m = None if setup.track is None else setup.track.altitude_offset_sigma_m
        self._spill = SpillFile(archive.folder)
        self._mapper = PlanarMapper(
            PoseGraphSettings.of_flight(
                model.focal_sigma,
                offset_sigma_m,
                joins_map=len(self._known) > 0 or setup.known_ground is not None,
            ),
            known=self._known.for_graph(),
            shelf=self._spill,
            keyframe_bytes=memory_budget_bytes(settings.memory_mb) // 8,
        )
        self._times_ns: dict[int, int] = {}  # of the flight's keyframes that have a place
        self._held: dict[
            int, ImageRGB | bytes
        ] = {}  # JPEG where all of the flight waits for its place
        self._painter: FlightPainter | None = None
        self._offset: OffsetEstimate | None = None
        self._control: ControlReport | None = None
        self._base: BaseReport | None = None
        self._found: dict[
            int, FoundFrame
        ] = {}  # by keyframe, where the site's own map shows its ground

    def __exit__(self, *ended: Any) -> None:
        self._spill.close()
        super().__exit__(*ended)

    @property
    def images(self) -> Mapping[int, str]:
        """Where each frame's picture is stored, by frame index: what `FlightWriter.commit` wants."""
        return {} if self._painter is None else self._painter.images

    def begin(self) -> FlightWriter:
        """Start to write the flight into the site, if that has not begun; where there is no site yet it is made.

        Raises InputError when a site has to be made and no frame has a place that gives its scale.
        """
        if not self._archive.has_site:
            if not self._times_ns:
                raise self._nothing_placed()
            self._make_site(
                self._settings.m_per_px or self._native_m_per_px(), self._mapper.altitude_offset_m
            )
        return self._begin_flight()

    def add(self, posed: PosedFrame) -> tuple[Status, str, int]:
        """Place one frame; what became of it and how many tiles were painted meanwhile."""
        frame = posed.frame
        if sees_horizon(self._setup.source.camera.camera, posed.prior):
            return self.lose(frame, HORIZON)

        @cache
        def image() -> ImageRGB:
            with self._log.stage(Stage.UNDISTORT):
                return self._lens.undistort(frame.image)

        def register() -> Registered:
            picture = image()
            with self._log.stage(Stage.REGISTER):
                return self._mapper.register(keyframe_id, self._lens.camera, picture, posed.prior)

        keyframe_id = len(self._known) + frame.index
        registered = self._memo.of(frame, "registered", Registered, register)
        with self._log.stage(Stage.REGISTER):
            outcome = self._mapper.place(registered)
        self._log.end(frame.index, frame.name, frame.time_ns, outcome.status, outcome.reason)
        if outcome.status is Status.REJECTED:
            return outcome.status, outcome.reason, 0
        self._times_ns[keyframe_id] = frame.time_ns
        painter, painted = self._painter, 0
        with self._log.stage(Stage.STORE):
            self._keep(keyframe_id, image)
        if self._painter is not None:
            self._painter.mark(outcome.moved | {keyframe_id})
        if painter is not None and not self._memo.has_ended(frame.index):
            painted = painter.show(keyframe_id)
            if isinstance(self._setup.source, LiveStream):
                self._log.delays_s.append(painter.shown_s - self._setup.source.arrived_s)
        return outcome.status, outcome.reason, painted

    def view(self, index: int, time_ns: int) -> FrameView | None:
        """See `FlightRun.view`."""
        keyframe_id = len(self._known) + index
        if keyframe_id not in self._times_ns:
            return None
        camera = self._refined(self._setup.source.camera.camera)
        return self._setup.view(time_ns, camera, self._mapper.pose(keyframe_id))

    def pictures_on_ground(self) -> Sequence[PictureOnGround]:
        """See `FlightRun.pictures_on_ground`."""
        camera = self._refined(self._setup.source.camera.camera)
        poses = [self._mapper.pose(each) for each in self._mapper.placed()]
        outlines_m = [(pose, footprint(camera, pose)) for pose in poses]
        return [
            PictureOnGround(outline_m, float(pose.translation_m[2]) / camera.fx_px)
            for pose, outline_m in outlines_m
            if is_on_ground(outline_m)
        ]

    def stored_frame(self, index: int) -> StoredKeyframe | None:
        """See `FlightRun.stored_frame`."""
        if len(self._known) + index not in self._times_ns or index not in self.images:
            return None
        frame = self._on_ground(
            self._log.endings[index], self._refined(self._setup.source.camera.camera)
        )
        return None if frame is None else self.begin().keyframe(frame, self.images[index])

    def note_found(self, index: int, site_from_image: Matrix3, residual_px: float) -> None:
        """Where the site's map shows a frame's ground: (3, 3) of its full undistorted picture, and how well that fits.

        `complete` ties the flight to it, for across dates its features may join none of the map's keyframes.
        """
        keyframe_id, camera = len(self._known) + index, self._lens.camera
        if keyframe_id in self._times_ns:
            self._found[keyframe_id] = FoundFrame.of(
                keyframe_id, camera, site_from_image, residual_px
            )

    def complete(self, known: MapGround) -> list[PlacedFrame]:
        """Solve once more, find the clock offset, paint what moved: every selected frame as it ends, in their order.

        Nothing is committed. Frames that came to nothing are rejected; without any other nothing is painted. `known`
        is the map's ground.
        """
        painter, placed = self._settled(), self._placed()
        return placed if painter is None else self._paint_ground(painter, placed, known)[0]

    def _settled(self) -> FlightPainter | None:
        """What paints the flight, all keyframes standing where they do in the end; None where none has a place."""
        if not self._times_ns:
            return None
        with self._log.stage(Stage.REGISTER):
            self._mapper.release()
            if self._writer is not None:
                self._writer.release_memory()  # room for the largest solve
            self._mapper.settle()
            self._offset = self._find_offset()
            self._tie_to_ground()
        if self._finder is not None:  # the detector's memory is free then for painting
            with self._log.stage(Stage.DETECT):
                self._finder.rest()
        painter = self._started_painter()
        painter.settle()
        return painter

    def _paint_ground(
        self,
        painter: FlightPainter,
        placed: list[PlacedFrame],
        known: MapGround | None = None,
    ) -> tuple[list[PlacedFrame], MapShape, GroundModel | None]:
        """Paint the map, flat or over the heights of its ground; the frames as they stand on it. `known` is the map's so
        far, where not what earlier flights show."""
        shape = shape_of(
            self._mapper.report(),
            placed,
            self._settings.heights,
            is_local=self._archive.site().is_local,
            is_tied=self._setup.known_ground is not None,
            is_live=isinstance(self._setup.source, LiveSource),
        )
        model = None
        if not shape.is_flat:
            writer = self.begin()
            frames = [each for each in placed if each.status is not Status.REJECTED]
            keyframes = [writer.keyframe(each, self.images[each.index]) for each in frames]
            with self._log.stage(Stage.HEIGHTS):
                known = known or MapGround.of_map(
                    self._archive, self._setup.source.name, self._known.stored
                )
                found = ground_of(self._archive, frames, keyframes, self._memo, known)
            if isinstance(found, str):
                shape = MapShape(True, f"the map is flat, for heights could not be made: {found}")
            else:
                model = found
                shape = replace(shape, why="; ".join([shape.why, *known.remarks]))
        if model is None:
            painter.finish()
            return placed, shape, None
        index_of = {each.name: each.index for each in placed}
        shown = {len(self._known) + index_of[view.name] for view in model.solved.views}
        tiles = ground_tiles(model, self._archive.site_grid())
        painter.finish(((index, rgba) for index, rgba, _ in tiles), shown)
        model.pictures.release()
        sigmas_m = {
            each - len(self._known): sigma_m
            for each, sigma_m in self._mapper.sigmas_m(leans=False).items()
        }
        return standing_frames(placed, model, sigmas_m), shape, model

    def finish(self, notices: Sequence[Notice], started_s: float) -> None:
        """See `FlightRun.finish`."""
        painter = self._settled()
        placed = self._placed()
        if painter is None or all(each.status is Status.REJECTED for each in placed):
            raise self._nothing_placed()
        placed, shape, model = self._paint_ground(painter, placed)
        writer = self.begin()
        search = self._search(placed, model)
        with self._log.stage(Stage.REPORT):
            shown = picture(writer.tiles, 1600)
        result = FlightResult(
            placed,
            self._refined(self._setup.source.camera.camera),
            self._offset,
            self._mapper.report(),
            self._exposure.spread,
            control=self._control,
            base=self._base,
            pieces=[[each - len(self._known) for each in ids] for ids in self._mapper.pieces()]
            if model is None
            else pieces_of(placed, model),
            shape=shape,
        )
        report = build_report(
            self._setup,
            self._settings,
            self._log,
            result,
            self._archive.site(),
            shown,
            [*notices, *self._archive.notices, *self._detector_notices],
            time.monotonic() - started_s,
        )
        if model is not None:
            report["warnings"] += camera_warnings(model.solved)
        documents = self._add_search(report, search, placed)
        page = report_page(report, shown.rgba, crops_of(search), self._archive.site())
        documents |= {} if self._control is None else control_documents(self._control)
        if self._coverage is not None:
            files, report["seen"] = self._coverage.conclude(self.pictures_on_ground())
            documents.update(files)
        if model is not None:
            write_heights(
                self._archive,
                model,
                writer.staged(HEIGHTS),
                flight_id=self._setup.source.name,
                run=writer.run,
                mapped=report,
                seconds=time.monotonic() - started_s,
            )
        writer.commit(
            placed,
            self.images,
            report,
            page,
            crs=self._settings.crs,
            search=search,
            documents=documents,
        )

    # ---- inside -----------------------------------------------------------------------------------------------

    def _nothing_placed(self) -> InputError:
        return nothing_placed(self._setup.source.name, self._log)

    @property
    def _exposure(self) -> Exposure:
        return Exposure({}) if self._painter is None else self._painter.exposure

    def _keep(self, keyframe_id: int, image: Callable[[], ImageRGB]) -> None:
        """Store a keyframe's picture, or hold it until it is known how large it is on the map."""
        if self._painter is not None:
            self._painter.save(self._log.endings[keyframe_id - len(self._known)], image)
            return
        is_late = self._setup.is_placed_late
        self._held[keyframe_id] = jpeg_from_image(image()) if is_late else image()
        telemetry = self._setup.telemetry
        known = telemetry is None or telemetry.knows_ground
        if not is_late and (
            self._archive.has_site
            or (known and len(self._held) >= 2)
            or len(self._held) >= _WAIT_FOR_HEIGHT
        ):
            self._started_painter()

    def _started_painter(self) -> FlightPainter:
        """The painter, begun now that the frames show how large their pictures are on the map."""
        if self._painter is None:
            writer = self.begin()
            self._painter = FlightPainter(
                writer,
                self._archive,
                self._mapper,
                self._lens,
                self._known,
                self._native_m_per_px(),
                self._log,
                self._settings.live_s,
                self._memo,
                is_live=isinstance(self._setup.source, LiveSource),
            )
            for keyframe_id in self._held:
                ending = self._log.endings[keyframe_id - len(self._known)]
                self._painter.save(ending, partial(self._picture, keyframe_id))
            self._painter.mark(self._times_ns.keys())
            self._held.clear()
        return self._painter

    def _native_m_per_px(self) -> float:
        if self._setup.track is None and not self._setup.is_placed_late:
            return _LOCAL_M_PER_PX
        heights = [
            float(self._mapper.pose(each).translation_m[2]) for each in self._mapper.placed()
        ]
        telemetry = self._setup.telemetry
        seconds = [self._setup.seconds(time_ns) for time_ns in self._times_ns.values()]
        climb_m = 0.0 if telemetry is None else telemetry.track.climb_after_m(seconds)
        return map_m_per_px(heights, self._refined(self._lens.camera).fx_px, climb_m)

    def _refined(self, camera: Camera) -> Camera:
        return refined_camera(camera, self._mapper.focal_scale, self._mapper.radial)

    def _tie_to_ground(self) -> None:
        """Bring the map to its control points or its base map, or where the site's own map shows its frames."""
        ground = self._setup.known_ground
        if isinstance(ground, FlightControl):
            endings = self._log.endings
            keyframe_of = {
                endings[each - len(self._known)].name: each for each in self._mapper.placed()
            }
            self._control = ground.tie(self._mapper, keyframe_of, self._setup.frame)
        elif ground is None and self._found:
            m_per_px = self._archive.site_grid().grid.m_per_px
            tie_to_base(
                self._mapper,
                list(self._found.values()),
                self._lens.camera,
                m_per_px,
                is_datum=False,
            )
        elif ground is not None:
            self._base = ground.tie(
                self._mapper, self._picture, self._lens.camera, self._setup.frame
            )

    def _picture(self, keyframe_id: int) -> ImageRGB:
        """A keyframe's undistorted picture, from wherever it is kept."""
        held = self._held.get(keyframe_id)
        if held is None:
            return self.begin().image(keyframe_id - len(self._known))
        return image_from_jpeg(held, "") if isinstance(held, bytes) else held

    def _find_offset(self) -> OffsetEstimate | None:
        """The clock offset that motion shows, applied when it is well seen and none was given."""
        telemetry = self._setup.telemetry
        if telemetry is None:
            return None
        estimate = None
        applied_s = 0.0
        for _ in range(_OFFSET_ROUNDS):
            ids = self._mapper.placed()
            seconds = [self._setup.seconds(self._times_ns[each]) for each in ids]
            found = telemetry.offset_seen(seconds, self._mapper.path_m(), applied_s)
            estimate = found if estimate is None else estimate.refined(found, applied_s)
            if self._settings.offset_s is not None or not found.is_significant:
                break
            applied_s += found.offset_s
            priors = telemetry.priors(seconds, applied_s, self._setup.plan.smooth_s)
            self._mapper.retime(dict(zip(ids, priors, strict=True)))
        self._log.offset_applied_s = applied_s
        if estimate is not None:
            left_s = estimate.left_s(applied_s, telemetry.clock.sigma_s)
            moved_m = shared_motion_m_s(seconds, self._mapper.path_m())
            self._mapper.note_clock_miss(left_s * moved_m)
        return estimate

    def _placed(self) -> list[PlacedFrame]:
        camera = self._refined(self._setup.source.camera.camera)
        residuals: dict[int, float] = {}
        sigmas: dict[int, float] = {}
        gps: dict[int, Floats] = {}
        if self._times_ns:
            residuals = self._mapper.residuals_px(self._lens.camera)
            sigmas, gps = self._mapper.sigmas_m(), self._mapper.gps_residuals_m()
        result = []
        for ending in list(self._log.endings.values()):
            keyframe_id = len(self._known) + ending.index
            if keyframe_id not in self._times_ns:
                result.append(self._rejected(ending, ending.reason, camera))
                continue
            status, reason = self._mapper.ending(keyframe_id)
            frame = self._on_ground(replace(ending, status=status, reason=reason), camera)
            if frame is None:
                result.append(self._rejected(ending, HORIZON, camera))
                continue
            self._log.end(ending.index, ending.name, ending.time_ns, status, reason)
            result.append(
                replace(
                    frame,
                    residual_px=residuals.get(keyframe_id, frame.residual_px),
                    sigma_m=sigmas[keyframe_id],
                    gps_residual_m=gps[keyframe_id],
                )
            )
        return result

    def _on_ground(self, ending: Ending, camera: Camera) -> PlacedFrame | None:
        """A frame as it lies by now, how well being unknown; None where it shows more than the ground."""
        keyframe_id, unknown = len(self._known) + ending.index, float("nan")
        pose = self._mapper.pose(keyframe_id)
        outline_m = footprint(camera, pose)
        if not is_on_ground(outline_m):
            return None
        return PlacedFrame(
            ending.name,
            ending.index,
            self._setup.utc_ns(ending.time_ns),
            ending.status,
            ending.reason,
            camera,
            pose,
            self._mapper.site_from_image(keyframe_id, self._lens.camera),
            outline_m,
            unknown,
            unknown,
            self._exposure.gains_of(keyframe_id),
            vignette=self._exposure.vignette,
        )

    def _rejected(self, ending: Ending, reason: str, camera: Camera) -> PlacedFrame:
        """The record of a frame that came to nothing."""
        self._log.end(ending.index, ending.name, ending.time_ns, Status.REJECTED, reason)
        time_ns = self._setup.utc_ns(ending.time_ns)
        return PlacedFrame.rejected(ending.index, ending.name, time_ns, reason, camera)
