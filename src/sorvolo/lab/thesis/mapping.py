"""Section 3.1.1 as a map: the frames stitched, the mosaic anchored to GPS fixes and painted into the site's tiles."""

import time
from collections.abc import Sequence, Set
from dataclasses import dataclass, field
from functools import partial
from typing import ClassVar

import numpy as np

from sorvolo.capture.source import LiveSource
from sorvolo.change.alignment import Aligned, Aligner
from sorvolo.change.reference import ReferenceMap
from sorvolo.errors import GeometryError, InputError
from sorvolo.geometry.arrays import Floats, ImageRGB, Matrix3
from sorvolo.geometry.camera import Camera
from sorvolo.geometry.homography import apply_homography, resized, shifted
from sorvolo.lab.thesis.stitching import (
    SIDE_PX,
    RoiStitcher,
    RoiStitchingSettings,
    Stitched,
    georeference,
)
from sorvolo.missions.flight.log import Ending, Stage, nothing_placed
from sorvolo.missions.flight.map_objects import ObjectFinder, crops_of
from sorvolo.missions.flight.report import FlightResult, build_report
from sorvolo.missions.flight.settings import MapSettings
from sorvolo.missions.flight.setup import FlightSetup
from sorvolo.missions.map.painting import FlightPainter, KnownKeyframes
from sorvolo.missions.map.planar_run import FlightRun
from sorvolo.mosaic.exposure import Exposure
from sorvolo.registration.lens import Undistorter, at_size
from sorvolo.store.exports.map_pictures import picture
from sorvolo.store.pages.flight import report_page
from sorvolo.store.site.archive import Archive
from sorvolo.survey.flight import CameraPrior, Notice, PosedFrame
from sorvolo.survey.mosaic import PlacedFrame, Status

_DRIFT = 1.25  # the largest gain over the smallest that needs no notice


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


class StitchedFlight:
    """Where a flight's stitched frames lie on the site: the mosaic, anchored as a whole to the frames' fixes.

    `full` is the frames' camera, `small` the undistorted one at the size at which they are stitched. Keyframes have ids
    from `first_id` on. Only `add` and `anchor` change it.
    """

    radial = 0.0

    def __init__(
        self, stitcher: RoiStitcher, full: Camera, small: Camera, first_id: int = 0
    ) -> None:
        self._stitcher, self._camera, self._small, self._first_id = stitcher, full, small, first_id
        self._corners = (
            full.undistort_points(full.corners_px) if full.is_distorted else full.corners_px
        )
        self._middle: Floats = np.array([[(small.width_px - 1) / 2, (small.height_px - 1) / 2]])
        self.stitched: dict[int, Stitched] = {}
        self.site_from_mosaic: Matrix3 = np.diag([1.0, -1.0, 1.0])  # mirrored pixels: no fixes
        self._fixes_m: dict[int, Floats] = {}
        self._map_fixes_m: dict[int, Floats] = {}

    def add(
        self, stitched: Stitched, fix_m: Floats | None, site_from_image: Matrix3 | None
    ) -> None:
        """Take a frame, its fix (2,) where it has one, and (3, 3) of it where the site's map shows its ground."""
        self.stitched[stitched.frame_id] = stitched
        if fix_m is not None:
            self._fixes_m[stitched.frame_id] = fix_m
        if site_from_image is not None:
            on_map_m = apply_homography(site_from_image, self._middle)[0]
            self._map_fixes_m[stitched.frame_id] = on_map_m

    def anchor(self) -> None:
        """Lay the mosaic on its fixes. Raises GeometryError for fewer than two different ones.

        Frames that the map shows are anchored to it; the others to GPS, moved by how GPS and map differ.
        """
        both = self._fixes_m.keys() & self._map_fixes_m.keys()
        differ_m = [self._map_fixes_m[each] - self._fixes_m[each] for each in both]
        offset_m = np.mean(differ_m or [np.zeros(2)], axis=0)
        fixes_m = {each: fix_m + offset_m for each, fix_m in self._fixes_m.items()}
        fixes_m |= self._map_fixes_m
        barycentres = [self.stitched[each].barycentre_px for each in fixes_m]
        self.site_from_mosaic = georeference(
            np.reshape(barycentres, (-1, 2)), np.reshape([*fixes_m.values()], (-1, 2))
        )

    @property
    def fixed(self) -> Set[int]:
        """The frames that have a fix."""
        return self._fixes_m.keys() | self._map_fixes_m.keys()

    @property
    def m_per_px(self) -> float:
        """The ground sampling distance of the mosaic, to three digits."""
        return float(f"{float(np.sqrt(abs(np.linalg.det(self.site_from_mosaic[:2, :2])))):.3g}")

    def site_from_image(self, keyframe_id: int, camera: Camera) -> Matrix3:
        """(3, 3) of an undistorted image of the size that `camera` has."""
        small_from_image = resized(
            self._small.width_px / camera.width_px, self._small.height_px / camera.height_px
        )
        stitched = self.stitched[keyframe_id - self._first_id]
        return self.site_from_mosaic @ stitched.mosaic_from_image @ small_from_image

    def exposure(self) -> Exposure:
        """The gain of each frame; no vignette."""
        gains = self._stitcher.gains()
        return Exposure({self._first_id + k: np.full(3, g) for k, g in gains.items()})

    recent_exposure = exposure

    def release(self) -> None:
        """Keep all: it is small."""

    def place(
        self,
        ending: Ending,
        time_ns: int,
        prior: CameraPrior,
        gains: Floats,
        *,
        has_fixes: bool = True,
    ) -> PlacedFrame:
        """The record of a frame. One that was not stitched lies as the last one before it, moved to its own fix.

        Without `has_fixes` the first frame's place is the site's own origin, which no frame departs from.
        """
        stitched = self.stitched.get(ending.index)
        nearest = max(each for each in self.stitched if each <= ending.index)
        site_from_image = self.site_from_image(self._first_id + nearest, self._camera)
        middle = np.array([[(self._camera.width_px - 1) / 2, (self._camera.height_px - 1) / 2]])
        gps = np.full(3, np.nan)
        off_m = apply_homography(site_from_image, middle)[0] - prior.position_m[:2]
        if stitched is None:
            site_from_image, off_m = shifted(*-off_m) @ site_from_image, np.zeros(2)
        if has_fixes and prior.knows_place:
            gps[:2] = off_m
        return PlacedFrame(
            ending.name,
            ending.index,
            time_ns,
            ending.status,
            ending.reason,
            self._camera,
            None,
            site_from_image,
            apply_homography(site_from_image, self._corners),
            stitched.residual_px if stitched else float("nan"),
            float("nan") if stitched else float(np.hypot(*prior.position_sigma_m[:2])),
            gains,
            gps_residual_m=gps,
        )


class ThesisRun(FlightRun):
    """A flight mapped as the thesis does: stitched frame by frame, anchored to the fixes so far, and painted."""

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
        full = setup.source.camera.camera
        scale = min(1.0, SIDE_PX / max(full.width_px, full.height_px))
        small = full.resized(round(full.width_px * scale), round(full.height_px * scale))
        self._lens, self._small_lens = Undistorter(full), Undistorter(small)
        self._camera = self._small_lens.camera
        self._known = KnownKeyframes(archive, setup.source.name)
        self._stitcher = RoiStitcher(stitching)
        self._flight = StitchedFlight(self._stitcher, full, self._camera, len(self._known))
        self._aligner: Aligner | None = None
        if archive.has_site and setup.track is not None:
            site_grid = archive.site_grid()
            self._aligner = Aligner(ReferenceMap(archive.tiles(), site_grid.grid), site_grid)
        self._priors: dict[int, CameraPrior] = {}
        self._held: dict[int, ImageRGB] = {}  # until it is known where and how large they are
        self._painter: FlightPainter | None = None

    def add(self, posed: PosedFrame) -> tuple[Status, str, int]:
        """Stitch one frame and paint it; what became of it, and how many tiles were painted."""
        frame = posed.frame
        with self._log.stage(Stage.UNDISTORT):
            image = self._lens.undistort(frame.image)
            image = at_size(image, self._camera.width_px, self._camera.height_px)
        with self._log.stage(Stage.REGISTER):
            found = self._stitcher.add(frame.index, image)
        status, reason = Status.VISION, ""
        if isinstance(found, Stitched):
            on_map = None
            if self._aligner is not None:
                with self._log.stage(Stage.REGISTER):
                    on_map = self._aligner.align(image, self._camera, posed.prior, frame.time_ns)
            self._flight.add(
                found,
                posed.prior.position_m[:2] if posed.prior.knows_place else None,
                on_map.site_from_image if isinstance(on_map, Aligned) else None,
            )
        elif posed.prior.knows_place:
            status, reason = Status.GPS_ONLY, found
        else:
            return self.lose(frame, found)
        self._log.end(frame.index, frame.name, frame.time_ns, status, reason)
        self._priors[frame.index] = posed.prior
        self._held[frame.index] = image
        if self._painter is None and not self._is_firm():
            return status, reason, 0
        painter = self._paint()
        return status, reason, painter.show(max(self._flight.stitched) + len(self._known))

    def finish(self, notices: Sequence[Notice], started_s: float) -> None:
        """See `FlightRun.finish`."""
        if not self._flight.stitched:
            raise nothing_placed(self._setup.source.name, self._log)
        painter = self._paint()
        painter.settle()
        painter.finish()
        site, writer = self._archive.site(), self._begin_flight()
        gains = [float(each[0]) for each in painter.exposure.gains.values()]
        text = (
            f"the brightness of the pictures changes along the flight: they were multiplied by {min(gains):.2f} to "
            f"{max(gains):.2f} to make neighbours alike"
        )
        is_drift = max(gains) >= _DRIFT * min(gains)
        drift = [Notice("brightness_drifts", len(gains), text)] if is_drift else []
        with self._log.stage(Stage.REPORT):
            placed = self._placed(painter.exposure)
            shown = picture(writer.tiles, 1600)
        search = self._search(placed)
        report = build_report(
            self._setup,
            self._settings,
            self._log,
            FlightResult(placed, self._setup.source.camera.camera),
            site,
            shown,
            [*notices, *self._detector_notices, *drift],
            time.monotonic() - started_s,
        )
        self._add_search(report, search, placed)
        page = report_page(report, shown.rgba, crops_of(search), site)
        writer.commit(placed, painter.images, report, page, crs=self._settings.crs, search=search)

    # ---- inside -----------------------------------------------------------------------------------------------

    def _is_firm(self) -> bool:
        """Whether the fixes so far lie far enough apart to show the mosaic's scale and direction."""
        flight = self._flight
        fixed = flight.stitched.keys() if self._setup.track is None else flight.fixed
        centres = np.array([flight.stitched[each].barycentre_px for each in fixed]).reshape(-1, 2)
        spread = np.linalg.norm(np.ptp(centres, axis=0)) if len(centres) else 0.0
        return bool(spread >= self._camera.width_px / 2)

    def _paint(self) -> FlightPainter:
        """Anchor the mosaic to the fixes so far and hand what came since to the painter, begun where there is none."""
        flight = self._flight
        if self._setup.track is not None:
            try:
                flight.anchor()
            except GeometryError as error:
                raise InputError(
                    f"{len(flight.fixed)} stitched frames of {self._setup.source.name} have a GPS fix, which is too few to "
                    "place the mosaic; --method planar places each frame by its own fix"
                ) from error
        if self._painter is None:
            self._make_site(self._settings.m_per_px or flight.m_per_px, 0.0)
            self._painter = FlightPainter(
                self._begin_flight(),
                self._archive,
                flight,
                self._small_lens,
                self._known,
                flight.m_per_px,
                self._log,
                self._settings.live_s,
                self._memo,
                is_live=isinstance(self._setup.source, LiveSource),
            )
        with self._log.stage(Stage.STORE):
            for index, image in self._held.items():
                self._painter.save(
                    self._log.endings[index],
                    partial(at_size, image, self._camera.width_px, self._camera.height_px),
                )
        self._held.clear()
        self._painter.mark([len(self._known) + each for each in flight.stitched])
        return self._painter

    def _placed(self, exposure: Exposure) -> list[PlacedFrame]:
        result = []
        for ending in self._log.endings.values():
            time_ns = self._setup.utc_ns(ending.time_ns)
            prior = self._priors.get(ending.index)
            if prior is None:
                camera = self._setup.source.camera.camera
                rejected = ending.index, ending.name, time_ns, ending.reason, camera
                result.append(PlacedFrame.rejected(*rejected))
            else:
                gains = exposure.gains_of(len(self._known) + ending.index)
                has_fixes = self._setup.track is not None
                result.append(
                    self._flight.place(ending, time_ns, prior, gains, has_fixes=has_fixes)
                )
        return result
