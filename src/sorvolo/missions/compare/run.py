"""One later flight on its way into a site: views to evidence, evidence to changes, changes into the map."""

import time
from collections.abc import Generator, Iterable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any, Self

from sorvolo.change.alignment import Caution, FlightPlace
from sorvolo.change.earlier_pictures import EarlierPicture, EarlierPictures, with_known_pixels
from sorvolo.change.flight_on_map import FlightFit, FlightOnMap
from sorvolo.change.map_update import paint_changes
from sorvolo.change.outlines import KnownPlace
from sorvolo.change.reconcile import reported
from sorvolo.change.reference import ReferenceMap
from sorvolo.change.views import FlightCamera, ViewMaker, ViewOutcome, ViewRecord
from sorvolo.errors import InputError
from sorvolo.geometry.arrays import ImageRGBA, Mask, PointsM
from sorvolo.geometry.summary import median_of_known
from sorvolo.missions.compare.extension import MapExtension
from sorvolo.missions.compare.flight_changes import ComparePlan, FlightChanges
from sorvolo.missions.compare.objects import ComparisonObjects
from sorvolo.missions.compare.report import (
    ViewCounts,
    comparison_summary,
    comparison_warnings,
    flight_notices,
    flight_summary,
    map_doubt,
    views_notices,
    with_height_changes,
)
from sorvolo.missions.compare.whole_flight import WholeFlight
from sorvolo.missions.flight.detector_protocol import ObjectDetector
from sorvolo.missions.flight.log import FlightLog, Stage
from sorvolo.missions.flight.map_objects import crops_of, with_objects
from sorvolo.missions.flight.report import FlightResult, build_report
from sorvolo.missions.flight.request import REQUEST
from sorvolo.missions.flight.result_cache import ResultCache
from sorvolo.missions.flight.settings import CompareSettings
from sorvolo.missions.flight.setup import FlightSetup
from sorvolo.missions.heights.measure import flight_with_heights, radial_of
from sorvolo.missions.heights.run import lens_left_over
from sorvolo.missions.map.ground import flights_over_heights, map_surface
from sorvolo.registration.lens import Undistorter
from sorvolo.store.exports.change_files import write_pictures
from sorvolo.store.exports.ground_files import COVERAGE, coverage_geojson
from sorvolo.store.exports.map_pictures import picture
from sorvolo.store.exports.plain import features_name, geojson_bytes
from sorvolo.store.images import ImageCache
from sorvolo.store.pages.flight import report_page
from sorvolo.store.site.archive import Archive, FlightWriter
from sorvolo.survey.findings import Change, ComparedView, Verdict, ViewStatus
from sorvolo.survey.flight import LostFrame, Notice, PosedFrame
from sorvolo.survey.mosaic import FrameView, PlacedFrame, Status

VIEW, VIEW_AGAIN = "view", "view again"  # stages of a comparison in the cache
_CACHE_BYTES = 128 * 2**20  # of earlier pictures at hand


@dataclass(frozen=True, eq=False)
class Pending:
    """A frame and how its comparison will have ended.

    `stage` names the comparison's result in the cache: a frame that is looked for again has two. `is_resumed`: a run
    that was killed has compared it.
    """

    posed: PosedFrame
    outcome: "Future[ViewOutcome]"
    stage: str
    is_resumed: bool

    @property
    def is_unplaced(self) -> bool:
        """Whether the frame was not found on the map; waits for its comparison."""
        return self.outcome.result().status is ViewStatus.NOT_ALIGNED

    @property
    def comes_again(self) -> bool:
        """Whether the frame is to be retried; waits for its comparison."""
        return self.outcome.result().comes_again


@dataclass(frozen=True, eq=False)
class Again:
    """A frame queued for retry; `is_resumed`: the interrupted run queued it."""

    posed: PosedFrame
    is_resumed: bool


class CompareRun:
    """A later flight on its way into a site. A context manager: leaving without `finish` leaves the site as it was.

    `memo` has what a killed run computed.
    """

    def __init__(
        self,
        setup: FlightSetup,
        archive: Archive,
        settings: CompareSettings,
        base_version: int,
        steps: Path | None,
        detector: ObjectDetector | None = None,
        request: str = "",
        memo: ResultCache | None = None,
    ) -> None:
        self._setup, self._archive, self._settings, self._steps = setup, archive, settings, steps
        self._base_version = base_version
        self._memo = ResultCache() if memo is None else memo
        source = setup.source
        self._writer: FlightWriter = archive.begin_flight(
            source.name,
            source.fingerprint,
            {**vars(settings), "method": f"compare-{settings.method_name}", REQUEST: request},
            journal=self._memo.journal,
        )
        self._views = view_maker(setup, archive, settings, base_version)
        self._changes = FlightChanges(
            source.name,
            self._views,
            settings,
            ComparePlan.of(source, archive.site_grid().grid.m_per_px, settings),
        )
        self._rejected = [
            KnownPlace(each.outline_m, each.kind)
            for each in archive.reviews()
            if each.verdict is Verdict.REJECTED and each.flight_id != source.name
        ]
        self._objects = ComparisonObjects(
            detector, setup, archive, base_version, settings, self._memo
        )
        self._extension = MapExtension(
            setup, archive, settings, self._writer, self._views, self._memo
        )
        self._log = FlightLog()
        self._counts = ViewCounts()
        self._placed: dict[int, PlacedFrame] = {}
        self._flight_fit: FlightFit | None = None
        sigmas_m = [each.sigma_m for each in archive.keyframes() if each.flight_id != source.name]
        self._map_sigma_m = median_of_known(sigmas_m) or 0.0
        self._comparing, self._corroborating = (
            ThreadPoolExecutor(1, thread_name_prefix=each)
            for each in ("comparing", "corroborating")
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *ended: Any) -> None:
        try:
            self._comparing.shutdown(cancel_futures=True)
            self._corroborating.shutdown(cancel_futures=True)
            self._objects.close()
        finally:  # also when Ctrl-C strikes again meanwhile
            self._writer.__exit__(*ended)
            self._memo.end(ended[1])

    @property
    def views(self) -> int:
        """Frames that ended so far, lost ones included."""
        return self._counts.total

    @property
    def compared(self) -> int:
        """Frames compared so far."""
        return self._counts[ViewStatus.COMPARED]

    def lose(self, lost: LostFrame) -> None:
        """A frame that cannot be used."""
        self._counts.end(ViewStatus.LOST, lost.reason)
        camera = self._setup.source.camera.camera
        time_ns = self._setup.utc_ns(lost.time_ns)
        self._placed[lost.index] = PlacedFrame.rejected(
            lost.index, lost.name, time_ns, lost.reason, camera
        )

    def begin(
        self,
        posed: PosedFrame,
        place: FlightPlace | None = None,
        caution: Caution = Caution.NEVER,
        *,
        is_again: bool = False,
    ) -> Pending:
        """Begin to compare a frame, in threads beside what `add` does with those before it. `place` and `caution`
        are those of `Aligner.align`; `is_again`: it was put off."""
        index, stage = posed.frame.index, VIEW_AGAIN if is_again else VIEW
        record = self._memo.known(index, stage, ViewRecord)
        if record is not None:
            recalled = self._comparing.submit(
                lambda: self._views.recall(posed, self._views.undistorted(posed), record)
            )
            return Pending(posed, recalled, stage, is_resumed=True)
        compared = self._comparing.submit(self._views.compare_with_map, posed, place, caution)
        outcome = self._corroborating.submit(lambda: self._views.corroborate(compared.result()))
        return Pending(posed, outcome, stage, is_resumed=False)

    def add(self, pending: Pending) -> tuple[ViewOutcome, tuple[Change, ...]]:
        """Take one frame's comparison in; how that ended, and the changes that it was the last missing proof of."""
        posed = pending.posed
        with self._log.stage(Stage.COMPARE):
            outcome = pending.outcome.result()
        self._counts.take(outcome, self._views.pixels.ground_m(posed, outcome.site_from_image))
        self._placed[posed.frame.index] = self._views.placed(posed, outcome, self._map_sigma_m)
        with self._log.stage(Stage.DETECT):
            self._objects.search(posed, outcome, self._views)
        announced = () if outcome.view is None else self._add_view(outcome.view, outcome.leans)
        with self._log.stage(Stage.REGISTER):
            self._extension.add(posed, outcome)
        self._keep(pending)
        return outcome, announced

    def outline_m(self, posed: PosedFrame) -> PointsM | None:
        """(4, 2) the ground under a frame by telemetry; None where that does not place it."""
        return self._views.pixels.ground_m(posed, None)

    def places_with_flight(
        self, photos: Iterable[PosedFrame], count: int
    ) -> Generator[Again, None, Mapping[int, FlightPlace]]:
        """Where so many photos of the flight lie, by index, laid on each other and found on the map as one; none where
        they are not. Yields each as it is laid."""
        on_map = FlightOnMap(self._views.search)
        with WholeFlight(self._setup, self._archive, self._views, on_map, count) as whole:
            for each in photos:
                with self._log.stage(Stage.REGISTER):
                    whole.add(each)
                yield Again(each, is_resumed=False)
            with self._log.stage(Stage.REGISTER):
                places = whole.places()
        self._flight_fit = whole.fit
        return places

    def put_off(self, pending: Pending) -> None:
        """A frame that was not found on the map is tried again after the others."""
        self._keep(pending)

    def leave_out(self, frames: int) -> None:
        """Count frames skipped because others cover their ground."""
        self._counts.left_out += frames

    def view(self, posed: PosedFrame) -> FrameView | None:
        """What a frame that was added shows; None where it was not laid on the map, or from an unknown place."""
        placed = self._placed[posed.frame.index]
        return self._setup.view(posed.frame.time_ns, placed.camera, placed.site_from_camera)

    def finish(self, notices: Sequence[Notice], started_s: float) -> None:
        """Conclude the evidence, bring the map up to date, and make the flight part of the site.

        `started_s` is when the comparison began, by the monotonic clock.
        """
        if not self.compared and not self._extension.images:
            raise InputError(
                f"no frame of {self._setup.source.name} could be compared: {self._counts.commonest_reason}; is it "
                "another place, another season, or night? `sorvolo inspect` shows what the flight holds"
            )
        site, name = self._archive.site(), self._setup.source.name
        concluding = self._comparing.submit(
            self._changes.conclude
        )  # which takes about as long as the map's extension
        shown_as_well = self._extend_map()
        placed = [self._placed[index] for index in sorted(self._placed)]
        with self._log.stage(Stage.DETECT):
            search = self._objects.conclude(placed)
        with self._log.stage(Stage.EVIDENCE):
            found = concluding.result()
            changes = self._reported(found)
            of_objects = self._changes.of_objects(changes, self._objects.on_one_date(search))
            changes += self._reported(of_objects)
        suppressed = len(found) + len(of_objects) - len(changes)
        with self._log.stage(Stage.PAINT):
            if self._settings.updates_map:
                paint_changes(changes, self._writer.tiles, self._archive.site_grid())
        with self._log.stage(Stage.DETECT):
            changes, search = self._objects.classified(changes, search)
            changes, of_heights = with_height_changes(self._archive, name, changes)
        with self._log.stage(Stage.REPORT):
            shown = picture(self._writer.tiles, 800)  # a day without change should cost little
        ground = self._counts.ground.parts([each.outline_m for each in changes])
        report = build_report(
            self._setup,
            self._settings.mapping,
            self._log,
            FlightResult(placed, self._setup.source.camera.camera, makes_map=False),
            site,
            shown,
            [
                *notices,
                *of_heights,
                *self._archive.notices,
                *self._objects.notices,
                *flight_notices(self._counts, self._flight_fit),
                *views_notices(placed, self._settings.votes),
            ],
            time.monotonic() - started_s,
        )
        report["objects"], searched = self._objects.summary(search, placed, site)
        comparison = comparison_summary(
            changes,
            suppressed,
            self._counts,
            self._views,
            self._settings,
            self._base_version,
            ground,
            is_local=site.is_local,
            doubt=map_doubt(self._archive, self._setup.flown_ns, self._base_version),
        )
        comparison |= {
            "headline": with_objects(report, comparison["headline"]),
            "with_flight": flight_summary(self._counts, self._flight_fit),
            "candidates": self._changes.candidates(),
            "heights_of": flight_with_heights(self._archive, but=name),
            "extension": {
                "frames": len(self._extension.frames),
                "shown_as_well": shown_as_well,
                "area_m2": self._extension.grown_m2(self._base_version),
            },
        }
        report |= {
            "method": f"compare-{self._settings.method_name}",
            "settings": asdict(self._settings),
            "comparison": comparison,
        }
        report["warnings"] += comparison_warnings(
            self._counts, self._views.brightness, self._views.times_coarser
        )
        page = report_page(report, shown.rgba, crops_of(search), site)
        documents = searched | {
            features_name(COVERAGE, is_local=site.is_local): geojson_bytes(
                coverage_geojson(ground, site)
            )
        }
        self._writer.commit(
            placed,
            self._extension.images,
            report,
            page,
            changes=changes,
            search=search,
            documents=documents,
        )

    # ---- inside -----------------------------------------------------------------------------------------------

    def _keep(self, pending: Pending) -> None:
        if not pending.is_resumed:
            frame, record = pending.posed.frame, ViewRecord.of(pending.outcome.result())
            self._memo.keep(frame, pending.stage, record, compresses=True)
            self._memo.end_frame(frame, pending.posed.prior)

    def _add_view(self, view: ComparedView, leans: Mask | None) -> tuple[Change, ...]:
        """Add a compared view to the evidence; the changes announced by it."""
        with self._log.stage(Stage.EVIDENCE):
            announced: Sequence[Change] = self._reported(self._changes.add(view, leans))
        if announced:
            with self._log.stage(Stage.DETECT):
                announced = self._objects.named(announced)
        with self._log.stage(Stage.STORE):
            self._write_masks(view)
        return tuple(announced)

    def _reported(self, changes: Sequence[Change]) -> list[Change]:
        return reported(changes, self._map_sigma_m, self._rejected)

    def _extend_map(self) -> int:
        """Place the frames that extend the map for good; how many others their pictures make needless."""
        self._placed |= {each.index: each for each in self._extension.complete(self._placed)}
        shown_as_well = self._extension.shown_as_well(self._placed)
        for index in shown_as_well:
            del self._placed[index]
        return len(shown_as_well)

    def _write_masks(self, view: ComparedView) -> None:
        if self._settings.writes_masks:
            changed, valid = self._views.pixels.masks(view)
            self._writer.save_masks(view.name, changed, valid, self._views.pixels.boxes(view))
        method = self._settings.method
        if self._steps is not None and method is not None:
            steps = method.steps(view.reference, view.image, view.valid)
            write_pictures(self._steps / view.name, steps)


def view_maker(
    setup: FlightSetup, archive: Archive, settings: CompareSettings, base_version: int
) -> ViewMaker:
    """What compares a flight's frames with a version of the map of a site."""
    source, site_grid = setup.source, archive.site_grid()
    plan = ComparePlan.of(source, site_grid.grid.m_per_px, settings)
    flight = FlightCamera(
        source.camera.camera, setup.usual_height_m, plan.side_px, setup.utc_ns, plan.finer
    )
    reference = ReferenceMap(archive.tiles(base_version), site_grid.grid)
    if settings.method is not None:
        return ViewMaker(flight, reference, site_grid, settings.method, None)
    return ViewMaker(flight, reference, site_grid, None, _earlier_pictures(archive, source.name))


def _earlier_pictures(archive: Archive, superseded: str) -> EarlierPictures:
    """The keyframes of earlier flights, rendered over the newest heights; not those of a flight that the map does not
    show any more."""
    keyframes = [
        each
        for each in archive.sound_keyframes()
        if each.flight_id != superseded and each.status is Status.VISION
    ]
    painted = flights_over_heights(archive, but=superseded)

    @cache
    def lens(flight_id: str) -> Undistorter | None:
        camera = next(each.camera for each in keyframes if each.flight_id == flight_id)
        return lens_left_over(camera, radial_of(archive, flight_id))

    def load(index: int) -> ImageRGBA:
        keyframe = keyframes[index]
        straight = lens(keyframe.flight_id) if keyframe.flight_id in painted else None
        image = archive.image(keyframe)
        return with_known_pixels(image if straight is None else straight.undistort(image))

    images = ImageCache(load, _CACHE_BYTES)
    return EarlierPictures(
        [
            EarlierPicture(each.camera, each.site_from_image, each.site_from_camera)
            for each in keyframes
        ],
        images.get,
        map_surface(archive, painted),
    )
