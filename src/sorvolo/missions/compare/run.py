"""One later flight on its way into a site: views to evidence, evidence to changes, changes into the map."""

import time
from collections import Counter
from collections.abc import Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import cv2
import numpy as np

from sorvolo.change.evidence.evidence_map import EvidenceMap, EvidenceSettings
from sorvolo.change.map_update import is_painted, patched
from sorvolo.change.pair.thesis import thesis_steps
from sorvolo.change.reference import ReferenceMap
from sorvolo.change.shape.outlines import KnownPlace, is_known
from sorvolo.change.shape.shadows import without_shadow
from sorvolo.errors import InputError
from sorvolo.geometry.arrays import ImageRGBA, PointsM
from sorvolo.geometry.grid import TileIndex
from sorvolo.geometry.homography import apply_homography
from sorvolo.missions.compare.change_classes import ChangeClasses
from sorvolo.missions.compare.earlier_pictures import EarlierPictures
from sorvolo.missions.compare.views import ViewMaker, ViewOutcome, as_bgr
from sorvolo.missions.flight.detects import Detects
from sorvolo.missions.flight.map_objects import ObjectFinder, crops_of, search_summary, why_not_searched
from sorvolo.missions.flight.report import FlightLog, Stage, build_report
from sorvolo.missions.flight.settings import CompareSettings
from sorvolo.missions.flight.setup import FlightSetup
from sorvolo.missions.map.planar_run import PlanarRun
from sorvolo.mosaic.placing import rejected
from sorvolo.store.exports.change_files import write_pictures
from sorvolo.store.exports.map_pictures import picture
from sorvolo.store.pages.flight import report_page
from sorvolo.store.site.archive import Archive, FlightWriter
from sorvolo.survey.findings import Change, ChangeKind, ComparedView, Verdict, ViewStatus
from sorvolo.survey.flight import LostFrame, Notice, PosedFrame
from sorvolo.survey.map_objects import ObjectSearch
from sorvolo.survey.mosaic import PlacedFrame, Status

_NEW_GROUND = 0.05  # share of a frame beyond the map: with less it is not worth a place in it
_EXTENSION_OVERLAP = 0.7
_LOOK_OVERLAP = 0.75  # of frames that are searched for objects
_DARK = 0.4  # times the map's brightness: less hides things
_NIGHT = 0.25  # less hides most of them (at 0.22, 3 of 14 changes were found), and would paint new ground black
_LEVEL_TILES = 20
_COARSER = 1.25  # times the map's pixels: views less coarse than that have its pixels
_CELL_M = 1.0  # of the record of what was compared


@dataclass(frozen=True, eq=False)
class Looking:
    """A frame and how looking at it will have ended."""

    posed: PosedFrame
    outcome: "Future[ViewOutcome]"


class CompareRun:
    """A later flight on its way into a site. A context manager: leaving without `finish` leaves the site as it was."""

    def __init__(
        self, setup: FlightSetup, archive: Archive, settings: CompareSettings, base_version: int, steps: Path | None,
        detector: Detects | None = None,
    ) -> None:
        self._setup, self._archive, self._settings, self._steps = setup, archive, settings, steps
        self._base_version = base_version
        source, site_grid = setup.source, archive.site_grid()
        self._writer: FlightWriter = archive.begin_flight(
            source.name, source.fingerprint, {**vars(settings), "method": f"compare-{settings.method}"}
        )
        self._views = ViewMaker(
            setup, ReferenceMap(archive.tiles(base_version), site_grid.grid), site_grid, settings,
            EarlierPictures(archive, [source.name]) if settings.method == "robust" else None,
        )
        self._evidence: EvidenceMap | None = None
        self._rejected = [
            KnownPlace(each.outline_m, each.kind) for each in archive.reviews()
            if each.verdict is Verdict.REJECTED and each.flight_id != source.name
        ]
        self._classes: ChangeClasses | None = None
        self._finder: ObjectFinder | None = None
        self._looked_m: PointsM | None = None
        if detector is not None:
            before = {each.flight_id for each in archive.versions() if each.complete and each.id <= base_version}
            known = archive.newest_objects(before - {source.name})
            self._classes = ChangeClasses(detector, [each.thing for each in known])
            self._finder = ObjectFinder(detector, source.camera.camera)
        self._log = FlightLog()
        self._extension: PlanarRun | None = None
        self._last_outline_m: PointsM | None = None
        self._last_extending = -1
        self._shown_by: dict[int, int] = {}  # frames that show new ground as another, which extends the map, shows it
        self._placed: dict[int, PlacedFrame] = {}
        self._statuses: Counter[ViewStatus] = Counter()
        self._reasons: Counter[str] = Counter()
        self._residuals_px: list[float] = []
        self._unknown: list[float] = []
        self._ground: set[int] = set()  # cells of the site, each as one number
        sigmas_m = np.array([each.sigma_m for each in archive.keyframes() if each.flight_id != source.name])
        self._map_sigma_m = float(np.nanmedian(sigmas_m)) if np.isfinite(sigmas_m).any() else 0.0
        # two threads at different frames: OpenCV's own in each frame would only wait for each other
        self._eyes, self._witnesses = (ThreadPoolExecutor(1, thread_name_prefix=each) for each in ("looking", "asking"))
        self._opencv_threads = cv2.getNumThreads()

    def __enter__(self) -> Self:
        cv2.setNumThreads(1)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            self._eyes.shutdown(cancel_futures=True)
            self._witnesses.shutdown(cancel_futures=True)
            if self._finder is not None:
                self._finder.close()
        finally:  # also when Ctrl-C strikes again meanwhile
            cv2.setNumThreads(self._opencv_threads)
            self._writer.__exit__(kind, error, trace)

    @property
    def views(self) -> int:
        """Frames looked at so far, lost ones included."""
        return self._statuses.total()

    @property
    def compared(self) -> int:
        """Frames compared so far."""
        return self._statuses[ViewStatus.COMPARED]

    def lose(self, lost: LostFrame) -> None:
        """A frame that cannot be used."""
        self._end(ViewStatus.LOST, lost.reason)
        camera = self._setup.source.camera.camera
        time_ns = self._setup.utc_ns(lost.time_ns)
        self._placed[lost.index] = rejected(lost.index, lost.name, time_ns, lost.reason, camera)

    def look(self, posed: PosedFrame) -> Looking:
        """Begin to compare a frame, in threads beside what `add` does with those before it."""
        looked = self._eyes.submit(self._views.look, posed)
        return Looking(posed, self._witnesses.submit(lambda: self._views.ask(looked.result())))

    def add(self, looking: Looking) -> tuple[ViewOutcome, tuple[Change, ...]]:
        """Take one frame's comparison in; how that ended, and the changes that it was the last missing witness of."""
        posed = looking.posed
        with self._log.stage(Stage.COMPARE):
            outcome = looking.outcome.result()
        self._end(outcome.status, outcome.reason)
        if outcome.site_from_image is not None:
            self._residuals_px.append(outcome.residual_px)
        self._placed[posed.frame.index] = self._views.placed(posed, outcome, self._map_sigma_m)
        self._look(posed, outcome)
        announced: tuple[Change, ...] = ()
        if outcome.view is not None:
            with self._log.stage(Stage.EVIDENCE):
                if self._evidence is None:
                    self._evidence = self._begin_evidence(outcome.view)
                announced = tuple(self._told(self._evidence.add(outcome.view)))
            if announced and self._classes is not None:
                with self._log.stage(Stage.DETECT):
                    announced = tuple(self._classes.at_once(each) for each in announced)
            self._note_ground(outcome.view)
            with self._log.stage(Stage.STORE):
                self._write_masks(outcome.view)
        if outcome.status is ViewStatus.OUTSIDE or (outcome.view is not None and outcome.known < 1 - _NEW_GROUND):
            self._extend(posed, outcome)
        return outcome, announced

    def finish(self, notices: Sequence[Notice], started_s: float) -> None:
        """Conclude the evidence, bring the map up to date, and make the flight part of the site.

        `started_s` is when the comparison began, by the monotonic clock.
        """
        if not self.compared and (self._extension is None or not self._extension.images):
            reason = self._reasons.most_common(1)[0][0] if self._reasons else "there is none"
            raise InputError(
                f"no frame of {self._setup.source.name} could be compared: {reason}; is it another place, another "
                "season, or night? `sorvolo inspect` tells what the flight holds"
            )
        with self._log.stage(Stage.EVIDENCE):
            found = () if self._evidence is None else self._evidence.conclude()
            changes = self._told(found)
        images: Mapping[int, str] = {}
        extending: list[PlacedFrame] = []
        if self._extension is not None and self._settings.updates_map:
            extending = [each for each in self._extension.complete() if each.status is not Status.REJECTED]
            self._placed |= {each.index: each for each in extending}
            images = self._extension.images
        shown_as_well = self._leave_to(extending)
        with self._log.stage(Stage.PAINT):
            if self._settings.updates_map:
                self._paint(changes)
        placed = [self._placed[index] for index in sorted(self._placed)]
        search: ObjectSearch | None = None
        if self._finder is not None and self._classes is not None:
            with self._log.stage(Stage.DETECT):
                search = self._finder.conclude(placed, self._setup.source.name, has_metres=True)
                changes = [
                    self._classes.finally_named(each, search.objects, self._finder.sightings) for each in changes
                ]
        with self._log.stage(Stage.REPORT):
            shown = picture(self._writer.tiles, 800).rgba  # a day without change should cost little
        report = build_report(
            self._setup, self._settings.mapping, self._log, placed, self._archive.site(), None, None,
            self._setup.source.camera.camera, self._writer.tiles,
            [*self._setup.notices, *notices, *self._detector_notices],
            time.monotonic() - started_s, spread=float("nan"),
        )
        report["warnings"] = [*report["warnings"], *self._warnings()]
        comparison = self._summary(changes, suppressed=len(found) - len(changes))
        comparison["extension"] = {
            "frames": len(extending), "shown_as_well": shown_as_well, "area_m2": self._grown_m2(extending),
        }
        seconds = 0.0 if self._finder is None else self._finder.seconds
        report |= {
            "method": f"compare-{self._settings.method}", "settings": asdict(self._settings), "comparison": comparison,
            "objects": search_summary(search, seconds, why_not_searched(self._settings.model)),
        }
        page = report_page(report, shown, crops_of(search))
        self._writer.commit(placed, images, report, page, changes=changes, search=search)

    # ---- inside -----------------------------------------------------------------------------------------------

    def _begin_evidence(self, first: ComparedView) -> EvidenceMap:
        """Evidence in the map's pixels, or in the views' where these are coarser: finer would be drawn from nothing.

        How coarse they are, the first view says, or the telemetry's heights, whichever says less: either may be wrong.
        """
        settings, map_m_per_px = self._settings, self._archive.site_grid().grid.m_per_px
        views_m_per_px = float(np.fmin(self._views.m_per_px, first.m_per_px))
        return EvidenceMap(
            views_m_per_px if views_m_per_px > _COARSER * map_m_per_px else map_m_per_px,
            EvidenceSettings(k=settings.votes, n=settings.voters), self._setup.source.name,
        )

    def _told(self, changes: Sequence[Change]) -> list[Change]:
        """The changes around the things alone, their places as uncertain as the map's own; not those that a person
        rejected on an earlier flight."""
        finished = [without_shadow(each) for each in changes]
        return [
            replace(each, sigma_m=float(np.hypot(each.sigma_m, self._map_sigma_m))) for each in finished
            if not is_known(each.outline_m, each.kind, self._rejected)
        ]

    def _end(self, status: ViewStatus, reason: str) -> None:
        self._statuses[status] += 1
        if reason:
            self._reasons[reason] += 1

    def _extend(self, posed: PosedFrame, outcome: ViewOutcome) -> None:
        """Frames that show new ground go on to be mapped, as a first flight's would."""
        if not self._settings.updates_map or self._setup.track is None or self._is_night(posed, outcome):
            return
        outline_m = self._outline_m(posed, outcome)
        last_m = self._last_outline_m if self._setup.source.kind == "video" else None
        if outline_m is not None and last_m is not None and _overlap(last_m, outline_m) > _EXTENSION_OVERLAP:
            self._shown_by[posed.frame.index] = self._last_extending
            return
        self._last_outline_m, self._last_extending = outline_m, posed.frame.index
        if self._extension is None:
            self._extension = PlanarRun(self._setup, self._archive, self._settings.mapping, writer=self._writer)
        with self._log.stage(Stage.REGISTER):
            self._extension.add(posed)

    def _is_night(self, posed: PosedFrame, outcome: ViewOutcome) -> bool:
        """Whether new ground would be painted black. Where no ground was compared in its light yet (and method thesis
        never does), the frame's middle grey says it, against the map's."""
        brightness = outcome.brightness
        if np.isnan(brightness):
            brightness = float(np.median(posed.frame.image[::16, ::16])) / max(self._map_level, 1.0)
        return brightness < _NIGHT

    @cached_property
    def _map_level(self) -> float:
        """The middle grey of the map, by a few of its tiles."""
        tiles = self._archive.tiles(self._base_version)
        some = [tiles[index][::16, ::16] for index in sorted(tiles)[:: -(-len(tiles) // _LEVEL_TILES)]]
        levels = np.concatenate([tile[tile[..., 3] > 0][:, :3].ravel() for tile in some])
        return float(np.median(levels)) if len(levels) else 0.0

    def _leave_to(self, extending: Sequence[PlacedFrame]) -> int:
        """Leave frames that fit no known ground to those that extend the map with what they show: not being needed,
        they are not selected frames, as in a first flight. How many."""
        extend = {each.index for each in extending}
        left = [
            index for index, by in self._shown_by.items()
            if by in extend and self._placed[index].status is Status.REJECTED
        ]
        for index in left:
            del self._placed[index]
        return len(left)

    def _grown_m2(self, extending: Sequence[PlacedFrame]) -> float:
        """Ground under these frames that the map shows now and did not before."""
        site_grid, before = self._archive.site_grid(), self._archive.tiles(self._base_version)
        outlines = [site_grid.grid_from_site(each.outline_m) for each in extending]
        touched = frozenset[TileIndex]().union(*(site_grid.grid.tiles_touched(outline) for outline in outlines))
        grown = sum(_seen_px(self._writer.tiles, each) - _seen_px(before, each) for each in touched)
        return grown * site_grid.grid.m_per_px**2

    def _look(self, posed: PosedFrame, outcome: ViewOutcome) -> None:
        """Have frames that fit the map searched for objects, each stretch of ground in a few of them."""
        if self._finder is None or outcome.site_from_image is None:
            return
        outline_m = self._views.outline_m(outcome.site_from_image)
        last_m = self._looked_m if self._setup.source.kind == "video" else None
        if not np.isfinite(outline_m).all() or (last_m is not None and _overlap(last_m, outline_m) > _LOOK_OVERLAP):
            return
        self._looked_m = outline_m
        with self._log.stage(Stage.DETECT):
            self._finder.look(posed)

    @property
    def _detector_notices(self) -> tuple[Notice, ...]:
        return () if self._finder is None else self._finder.notices

    def _outline_m(self, posed: PosedFrame, outcome: ViewOutcome) -> PointsM | None:
        if outcome.site_from_image is not None:
            outline_m = self._views.outline_m(outcome.site_from_image)
        elif posed.prior.knows_place:
            outline_m = self._views.told_outline_m(posed.prior)
        else:
            return None
        return outline_m if np.isfinite(outline_m).all() else None

    def _note_ground(self, view: ComparedView) -> None:
        """Count the ground that was compared, and how much under the frame was not known."""
        height, width = view.valid.shape
        self._unknown.append(1.0 - float(view.valid.mean()))
        ys, xs = np.mgrid[8:height:16, 8:width:16]
        seen = view.valid[ys, xs]
        points_m = apply_homography(view.site_from_image, np.column_stack([xs[seen], ys[seen]]).astype(float))
        cells = np.floor(points_m / _CELL_M).astype(np.int64)
        self._ground.update(np.unique(cells @ [1 << 32, 1]).tolist())  # unique rows would take ten times as long

    def _write_masks(self, view: ComparedView) -> None:
        if self._settings.writes_masks:
            changed, valid = self._views.masks_of_frame(view)
            self._writer.save_masks(view.name, changed, valid, self._views.boxes_of_frame(view))
        if self._steps is not None:
            thesis = self._settings.thesis
            steps = thesis_steps(
                as_bgr(view.reference), as_bgr(view.image), view.valid, thesis.settings, thesis.threads
            )
            write_pictures(self._steps / view.name, steps.pictures())

    def _paint(self, changes: Sequence[Change]) -> None:
        """Paint what changed into the map: only the tiles that it touches become new."""
        site_grid, tiles = self._archive.site_grid(), self._writer.tiles
        for change in changes:
            if not is_painted(change):
                continue
            grid_from_site = site_grid.grid_from_site_affine(change.outline_m.mean(axis=0), 50.0)
            height, width = change.patch.changed.shape
            corners = np.array([[0.0, 0.0], [width, 0.0], [width, height], [0.0, height]]) - 0.5
            outline = apply_homography(grid_from_site @ change.patch.site_from_patch, corners)
            for index in sorted(site_grid.grid.tiles_touched(outline)):
                if index in tiles:
                    old = tiles[index]
                    new = patched(old, site_grid.grid.tile_window(index), grid_from_site, change.patch)
                    if new is not old:
                        tiles[index] = new

    def _warnings(self) -> list[str]:
        """What makes this comparison say less than a user would expect of it."""
        warnings = []
        views, brightness = max(1, self.views), self._views.brightness
        if brightness < _NIGHT:
            warnings.append(
                f"the flight is {brightness:.2f} times as bright as the map: most changes are missed, so that finding "
                "none means little, and new ground is not added to the map; compare flights by daylight"
            )
        elif brightness < _DARK or brightness > 1 / _DARK:
            warnings.append(
                f"the flight is {brightness:.2f} times as bright as the map: what is small, dark or of the ground's "
                "colour is missed; compare flights by daylight"
            )
        if self._statuses[ViewStatus.OUTSIDE] == self.views - self._statuses[ViewStatus.LOST]:
            warnings.append(
                f"none of {self.views} views lies on the map, which grew beside what it showed: if the flight was over "
                "the same ground, its telemetry is metres off; `sorvolo history` has the map from before"
            )
        lost = self._statuses[ViewStatus.NOT_ALIGNED] + self._statuses[ViewStatus.LOST]
        if lost > 0.3 * views:
            warnings.append(f"{lost} of {views} views do not fit the map and told nothing; `reasons` says why")
        all_changed = self._statuses[ViewStatus.ALL_CHANGED]
        if all_changed > 0.1 * views:
            warnings.append(
                f"{all_changed} of {views} views look changed all over (snow, a flood?) and were left out: "
                "map the site anew"
            )
        return warnings

    def _summary(self, changes: Sequence[Change], *, suppressed: int) -> dict[str, Any]:
        """The report's part on the comparison; specified in docs/formats.md."""
        kinds = Counter(each.kind for each in changes)
        residuals = np.array(self._residuals_px)
        return {
            "against_version": self._base_version,
            "method": self._settings.method,
            "views": {status.value: self._statuses[status] for status in ViewStatus},
            "reasons": dict(self._reasons.most_common()),
            "residual_px": {
                "median": float(np.median(residuals)) if len(residuals) else None,
                "p95": float(np.percentile(residuals, 95)) if len(residuals) else None,
            },
            "changes": {kind.value: kinds[kind] for kind in ChangeKind},
            "suppressed": suppressed,
            "compared_area_m2": len(self._ground) * _CELL_M**2,
            "unknown_share": float(np.mean(self._unknown)) if self._unknown else None,
            "votes": self._settings.votes, "voters": self._settings.voters,
            "chosen": self._views.chosen(),
            "map_updated": self._settings.updates_map,
            "most_missed": bool(self._views.brightness < _NIGHT),
        }


def _seen_px(tiles: Mapping[TileIndex, ImageRGBA], index: TileIndex) -> int:
    return int(np.count_nonzero(tiles[index][..., 3])) if index in tiles else 0


def _overlap(a_m: PointsM, b_m: PointsM) -> float:
    """The share of outline b, convex, that outline a covers."""
    centre = b_m.mean(axis=0)
    a, b = (a_m - centre).astype(np.float32), (b_m - centre).astype(np.float32)
    area, _ = cv2.intersectConvexConvex(a, b)
    return float(area / max(cv2.contourArea(b), 1e-6))
