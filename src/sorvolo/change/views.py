"""Frames of a later flight to views compared with the map: aligned, resampled, searched for differences."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from cv2.typing import MatLike

from sorvolo.change.alignment import Aligned, Aligner, AlignStep, Caution, FlightPlace
from sorvolo.change.areas import leaning, level_of
from sorvolo.change.compare import PairMethod
from sorvolo.change.corroboration import (
    LEAST_SCORE,
    SURE,
    Difference,
    believed,
    is_whole,
    unwitnessed,
)
from sorvolo.change.earlier_pictures import EarlierPictures
from sorvolo.change.map_search import MapSearch
from sorvolo.change.measures import FlightMeasures, PairMeasures
from sorvolo.change.planting import Planted, Planting
from sorvolo.change.reference import ReferenceMap
from sorvolo.change.robust import as_bgr, compare_robust
from sorvolo.change.shade import shade_of_view
from sorvolo.geometry.arrays import (
    Boxes,
    Floats,
    ImageBGR,
    ImageGray,
    ImageRGB,
    Mask,
    Matrix3,
    PointsM,
    Vector3,
)
from sorvolo.geometry.camera import Camera
from sorvolo.geometry.grid import SiteGrid
from sorvolo.geometry.ground import footprint
from sorvolo.geometry.homography import apply_homography, pose_from_homography, resized
from sorvolo.geometry.pose import Pose
from sorvolo.registration.lens import Undistorter
from sorvolo.survey.findings import ComparedView, ViewStatus
from sorvolo.survey.flight import Frame, PosedFrame
from sorvolo.survey.mosaic import PlacedFrame, Status

_LEAST_SIDE_PX = 480  # longer side of a frame, however coarse the map; by choice
_NO_PLACE_M: Vector3 = np.full(3, np.nan)


class FramePixels:
    """The pixels of frames as taken (`full`, with the lens's distortion) and as compared (`small`, without)."""

    def __init__(self, full: Camera, small: Camera) -> None:
        self.full, self.small = full, small
        self._maps: tuple[MatLike, MatLike] | None = None
        sx, sy = small.width_px / full.width_px, small.height_px / full.height_px
        self.small_from_full: Matrix3 = resized(sx, sy)
        """(3, 3) from undistorted pixels of the full size."""

    def outline_m(self, site_from_image: Matrix3) -> PointsM:
        """(4, 2) the frame's corners on the ground, site metres."""
        return apply_homography(site_from_image, self.full.undistort_points(self.full.corners_px))

    def ground_m(self, posed: PosedFrame, site_from_image: Matrix3 | None) -> PointsM | None:
        """(4, 2) the frame's corners on the ground: as it fits the map, else by telemetry; None where neither gives
        all four."""
        if site_from_image is not None:
            outline_m = self.outline_m(site_from_image)
        elif posed.prior.knows_place:
            outline_m = footprint(self.full, Pose(posed.prior.rotation, posed.prior.position_m))
        else:
            return None
        return outline_m if np.isfinite(outline_m).all() else None

    def pose(self, site_from_image: Matrix3 | None) -> Pose | None:
        """The camera over level ground that sees a frame there, by undistorted pixels of the full size; None where it
        lies nowhere or no camera sees it so."""
        return (
            None
            if site_from_image is None
            else pose_from_homography(site_from_image, self.full.undistorted())
        )

    def masks(self, view: ComparedView) -> tuple[ImageGray, Mask]:
        """The change mask and the valid mask in the frame's own pixels, with the lens's distortion."""
        if self._maps is None:
            x, y = np.meshgrid(np.arange(self.full.width_px), np.arange(self.full.height_px))
            ideal = self.full.undistort_points(
                np.column_stack([x.ravel(), y.ravel()]).astype(float)
            )
            small = (
                apply_homography(self.small_from_full, ideal)
                .astype(np.float32)
                .reshape(*x.shape, 2)
            )
            self._maps = cv2.convertMaps(
                small[..., 0], small[..., 1], cv2.CV_16SC2, nninterpolation=True
            )
        x_map, y_map = self._maps
        changed = np.asarray(cv2.remap(view.changed, x_map, y_map, cv2.INTER_NEAREST), np.uint8)
        valid = cv2.remap(view.valid.view(np.uint8), x_map, y_map, cv2.INTER_NEAREST)
        return changed, valid > 0

    def boxes(self, view: ComparedView) -> Boxes:
        """The view's boxes in the frame's own pixels."""
        result = []
        full_from_small = np.linalg.inv(self.small_from_full)
        for x, y, width, height in view.boxes:
            around = (
                np.array(
                    [
                        [x, y],
                        [x + width / 2, y],
                        [x + width, y],
                        [x + width, y + height / 2],
                        [x + width, y + height],
                        [x + width / 2, y + height],
                        [x, y + height],
                        [x, y + height / 2],
                    ],
                    float,
                )
                - 0.5
            )
            ideal = apply_homography(full_from_small, around)
            corners = self.full.pixels_from_points(self.full.undistorted().rays_from_pixels(ideal))
            limit = [self.full.width_px - 1, self.full.height_px - 1]
            low = np.clip(np.floor(corners.min(axis=0) + 0.5), 0, limit).astype(int)
            high = np.clip(np.ceil(corners.max(axis=0) + 0.5), low + 1, np.array(limit) + 1).astype(
                int
            )
            result.append([*low, *(high - low)])
        return np.array(result, np.int64).reshape(-1, 4)

    def placed(
        self,
        posed: PosedFrame,
        time_ns: int,
        site_from_image: Matrix3 | None,
        reason: str,
        residual_px: float,
        map_sigma_m: float,
        stand: Pose | None = None,
    ) -> PlacedFrame:
        """The frame's record: where it fits the map, by pixels of the full size, or rejected with the reason. `stand`
        is its camera in space, None for the one over level ground."""
        frame = posed.frame
        if site_from_image is None:
            return PlacedFrame.rejected(
                frame.index, frame.name, time_ns, reason, self.full, residual_px
            )
        pose = stand or self.pose(site_from_image)
        outline_m = self.outline_m(site_from_image)
        if pose is None or not np.isfinite(outline_m).all():
            return PlacedFrame.rejected(
                frame.index, frame.name, time_ns, "the camera looks at the horizon", self.full
            )
        gps_m = (
            pose.translation_m - posed.prior.position_m if posed.prior.knows_place else _NO_PLACE_M
        )
        m_per_px = pose.translation_m[2] / self.full.fx_px
        return PlacedFrame(
            frame.name,
            frame.index,
            time_ns,
            Status.VISION,
            "",
            self.full,
            pose,
            site_from_image,
            outline_m,
            residual_px,
            float(np.hypot(map_sigma_m, residual_px * m_per_px)),
            gps_residual_m=gps_m,
        )


def comparison_camera(
    full: Camera, height_m: float, map_m_per_px: float, side_px: int, finer: float = 1.0
) -> Camera:
    """The camera at the size at which its frames are compared: no longer than `side_px`, and at most `finer` times as
    fine as the frame and as the map.

    `height_m` is the flight's usual height above the ground, NaN where it is not known. Pictures are looked at in half
    of their size: with `finer` 2 nothing that both show is lost.
    """
    side = max(full.width_px, full.height_px)
    share = min(finer, side_px / side)
    if height_m > 1.0:
        share = min(share, max(finer * height_m / full.fx_px / map_m_per_px, _LEAST_SIDE_PX / side))
    return (
        full.resized(round(full.width_px * share), round(full.height_px * share))
        if share != 1
        else full
    )


_ALL_CHANGED_REASON = "more than half of it looks changed (water, snow, ploughing?)"


# Which frames are compared, and with how many earlier pictures.
_LEAST_KNOWN = 0.1  # share of a frame on known ground: with less there is nothing to compare
_WITNESSES = 2  # earlier pictures asked about a difference: one from each side
_FURTHER = 3  # pictures asked besides where those do not show all of it
_COARSER = 1.25  # times the map's pixels: views less coarse than that have its pixels
_ALL_CHANGED = 0.5  # share of a view: more is snow, a flood or another place, not a list of changes
_TURNED_SIGMA_DEG = 3.0  # of a camera's angles as it fits the map: tilt and place are seen together


@dataclass(frozen=True, eq=False)
class ViewTraces:
    """What a frame's comparison left in its `ViewMaker`: `measured` is None where nothing was compared, or by another
    method."""

    step: AlignStep
    aligned: Aligned | None
    measured: PairMeasures | None


@dataclass(frozen=True, eq=False)
class ViewOutcome:
    """How one frame's comparison ended. `view` exists when it was compared, `site_from_image` (of the full undistorted
    frame) when it was aligned. `known` is the share of the frame that lies on known ground, `brightness` how many times
    as bright as the map the flight is so far, NaN where that is not known. `doubted` (h, w) is what surely differs from
    the map in a compared view and is contradicted by earlier pictures, `leans` (h, w) what leans another way in those,
    `planted` what is found of things drawn in. `local_m` is how far a local fit moved the frame on the map (median, m),
    0 without any. `with_flight` is that of `Aligned`, `comes_again` that of `NotAligned`.
    """

    status: ViewStatus
    reason: str
    residual_px: float  # in pixels of the full frame
    known: float
    site_from_image: Matrix3 | None = None
    view: ComparedView | None = None
    brightness: float = float("nan")
    doubted: Mask | None = None
    leans: Mask | None = None
    planted: tuple[Planted, ...] = ()
    local_m: float = 0.0
    with_flight: bool = False
    comes_again: bool = False
    traces: ViewTraces | None = None


@dataclass(frozen=True, eq=False)
class ViewRecord:
    """A frame's comparison without its pictures, of which `ViewMaker.recall` makes the same outcome again.

    `outcome` has no view; of the view, where there is one, `changed` is its mask (h, w), with its boxes and scores.
    """

    outcome: ViewOutcome
    changed: Mask | None
    boxes: Boxes | None
    scores: Floats | None

    @classmethod
    def of(cls, outcome: ViewOutcome) -> "ViewRecord":
        """That of an outcome."""
        view = outcome.view
        if view is None:
            return cls(outcome, None, None, None)
        return cls(replace(outcome, view=None), view.changed > 0, view.boxes, view.scores)


@dataclass(frozen=True, eq=False)
class OneSided:
    """A frame compared with the map, before earlier pictures corroborate it; `image` is RGB, `query` the same as BGR,
    `known` (h, w) the ground that the map shows, `valid` what of it was compared.

    `outcome` is what is known of its ending.
    """

    posed: PosedFrame
    aligned: Aligned
    image: ImageRGB
    reference: ImageRGB
    query: ImageBGR
    known: Mask
    valid: Mask
    found: Difference
    outcome: ViewOutcome


@dataclass(frozen=True, eq=False)
class FlightCamera:
    """The camera of a flight to be compared, its usual height above ground (m, NaN: unknown), the longest side of a
    compared picture, how a frame's time becomes UTC, and how many times as fine as frame and map a compared picture may
    be."""

    full: Camera
    height_m: float
    side_px: int
    utc_ns: Callable[[int], int]
    finer: float = 1.0


class ViewMaker:
    """Compares the frames of one flight with one version of the map, in order of time.

    `compare_with_map` finds what differs from the map, `corroborate` keeps what earlier pictures confirm. Either is
    called for the frames in their order; one may run while the other does, in another thread. The frames that an
    earlier process compared come first, each to `recall`. A `method` given compares in place of the robust one; it asks
    no earlier pictures.
    """

    def __init__(
        self,
        flight: FlightCamera,
        reference: ReferenceMap,
        site_grid: SiteGrid,
        method: PairMethod | None,
        pictures: EarlierPictures | None,
    ) -> None:
        self._flight, self._reference, self._site_grid = flight, reference, site_grid
        small = comparison_camera(
            flight.full, flight.height_m, site_grid.grid.m_per_px, flight.side_px, flight.finer
        )
        self.pixels = FramePixels(flight.full, small)
        self._lens = Undistorter(small, flight.full)
        size = small.width_px, small.height_px
        seen = self._lens.valid(*size)
        self._lens_sees: Mask = np.ones(size[::-1], bool) if seen is None else seen
        self._pictures = pictures
        self.surface = None if pictures is None else pictures.surface
        """The heights that views are laid over; None where the map is flat."""
        self._aligner = Aligner(reference, site_grid, self.surface)
        self._method = method
        self._measures = FlightMeasures() if method is None else None
        self._planting = Planting()

    def compare_with_map(
        self, posed: PosedFrame, place: FlightPlace | None = None, caution: Caution = Caution.NEVER
    ) -> ViewOutcome | OneSided:
        """Align one frame and compare it with the map; a `ViewOutcome` if that ended it. `place` and `caution` are
        those of `Aligner.align`."""
        frame, small = posed.frame, self.pixels.small
        image = self.undistorted(posed)
        aligned = self._aligner.align(
            image, self._lens.camera, posed.prior, frame.time_ns, place, caution
        )
        to_full = self._flight.full.width_px / small.width_px
        if not isinstance(aligned, Aligned):
            status = ViewStatus.OUTSIDE if aligned.is_outside else ViewStatus.NOT_ALIGNED
            return ViewOutcome(
                status,
                aligned.reason,
                aligned.residual_px * to_full,
                0.0,
                brightness=self.brightness,
                traces=ViewTraces(self._aligner.step, None, None),
                comes_again=aligned.comes_again,
            )
        residual_px = aligned.residual_px * to_full
        site_from_full = aligned.site_from_image @ self.pixels.small_from_full
        reference, known = self._map_under(aligned)
        share = np.count_nonzero(known) / np.count_nonzero(self._lens_sees)
        if share < _LEAST_KNOWN:
            reason = f"less than {_LEAST_KNOWN:.0%} of it lies on the map"
            return ViewOutcome(
                ViewStatus.OUTSIDE,
                reason,
                residual_px,
                share,
                site_from_full,
                brightness=self.brightness,
                traces=ViewTraces(self._aligner.step, aligned, None),
            )
        image, valid = self._laid(aligned, image, known)
        query = as_bgr(image)
        found, measured = self._difference(reference, image, query, valid)
        outcome = ViewOutcome(
            ViewStatus.COMPARED,
            "",
            residual_px,
            share,
            site_from_full,
            brightness=self.brightness,
            local_m=aligned.local_m,
            with_flight=aligned.with_flight,
            traces=ViewTraces(self._aligner.step, aligned, measured),
        )
        return OneSided(posed, aligned, image, reference, query, known, valid, found, outcome)

    def corroborate(self, compared: ViewOutcome | OneSided) -> ViewOutcome:
        """Keep the differences that earlier pictures of the ground confirm: how the frame's comparison ended."""
        if isinstance(compared, ViewOutcome):
            return compared
        frame, aligned, valid, outcome = (
            compared.posed.frame,
            compared.aligned,
            compared.valid,
            compared.outcome,
        )
        found, leans = self._corroborated(compared)
        changed = np.count_nonzero(found.mask) / max(1, int(np.count_nonzero(valid)))
        if changed > _ALL_CHANGED:
            return replace(outcome, status=ViewStatus.ALL_CHANGED, reason=_ALL_CHANGED_REASON)
        view = self._view(frame, aligned, (compared.image, compared.reference, valid), found)
        doubted = _doubted(compared.found, found, SURE)
        if aligned.stand is not None:
            doubted |= compared.known & ~valid
        planted = self._plant(view, compared)
        return replace(outcome, view=view, doubted=doubted, leans=leans, planted=planted)

    def recall(self, posed: PosedFrame, image: ImageRGB, record: ViewRecord) -> ViewOutcome:
        """The outcome of a frame that an earlier process compared; `image` is that frame `undistorted`."""
        outcome, traces = record.outcome, record.outcome.traces
        assert traces is not None  # a comparison leaves them
        self._aligner.recall(
            image, self._lens.camera, posed.prior, posed.frame.time_ns, traces.step
        )
        if traces.measured is not None and self._measures is not None:
            self._measures.observe(traces.measured)
        aligned, boxes, scores = traces.aligned, record.boxes, record.scores
        if record.changed is None or aligned is None or boxes is None or scores is None:
            return outcome
        if self._measures is not None:
            self._planting.pass_over()
        reference, known = self._map_under(aligned)
        image, valid = self._laid(aligned, image, known)
        found = Difference(np.where(record.changed, np.uint8(255), np.uint8(0)), boxes, scores)
        return replace(
            outcome, view=self._view(posed.frame, aligned, (image, reference, valid), found)
        )

    @property
    def search(self) -> MapSearch:
        """What looks for the flight's frames on the map."""
        return self._aligner.search

    @property
    def undistorted_camera(self) -> Camera:
        """The camera of `undistorted` pictures."""
        return self._lens.camera

    def undistorted(self, posed: PosedFrame) -> ImageRGB:
        """A frame's picture at the size at which it is compared, without the lens's distortion."""
        return self._lens.undistort(posed.frame.image)

    def placed(self, posed: PosedFrame, outcome: ViewOutcome, map_sigma_m: float) -> PlacedFrame:
        """The frame's record: placed by the map it fits, or rejected with the reason."""
        aligned = None if outcome.traces is None else outcome.traces.aligned
        return self.pixels.placed(
            posed,
            self._flight.utc_ns(posed.frame.time_ns),
            outcome.site_from_image,
            outcome.reason,
            outcome.residual_px,
            map_sigma_m,
            stand=None if aligned is None else aligned.stand,
        )

    def turned_as_found(self, posed: PosedFrame, outcome: ViewOutcome) -> PosedFrame:
        """The frame with its camera turned as it fits the map, where it does: a compass may be off by any angle."""
        pose = self.pixels.pose(outcome.site_from_image)
        if pose is None:
            return posed
        sigma_deg = np.full(3, _TURNED_SIGMA_DEG)
        return replace(
            posed, prior=replace(posed.prior, rotation=pose.rotation, attitude_sigma_deg=sigma_deg)
        )

    def measured(self) -> dict[str, Any]:
        """What the robust method measured of this flight's unchanged ground; nothing by another method."""
        return {} if self._measures is None else self._measures.summary()

    def change_m_per_px(self, first: ComparedView) -> float:
        """Of the pictures of changes: the map's pixels, or the views' where these are coarser.

        How coarse they are, the first view gives, or the flight's height, whichever is finer: either may be wrong.
        """
        map_m_per_px = self._site_grid.grid.m_per_px
        views_m_per_px = float(np.fmin(self._m_per_px, first.m_per_px))
        return views_m_per_px if views_m_per_px > _COARSER * map_m_per_px else map_m_per_px

    def brightness_beside_map(self, posed: PosedFrame, outcome: ViewOutcome) -> float:
        """How many times as bright as the map a frame is. Where no ground was compared in its light yet (and another
        method never does), its middle grey gives it."""
        if np.isnan(outcome.brightness):
            return self._reference.brightness_of(posed.frame.image)
        return outcome.brightness

    @property
    def brightness(self) -> float:
        """How many times as bright as the map the flight is; NaN where that is not known."""
        return float("nan") if self._measures is None else self._measures.brightness

    @property
    def times_coarser(self) -> float:
        """The map's pixels over those of the flight's own frames, at its usual height; NaN where that is not known."""
        return self._site_grid.grid.m_per_px * self._flight.full.fx_px / self._flight.height_m

    # ---- inside -----------------------------------------------------------------------------------------------

    @property
    def _m_per_px(self) -> float:
        """Ground metres of a compared picture's pixel, at the flight's usual height; NaN where that is not known."""
        return self._flight.height_m / self.pixels.small.fx_px

    def _grid_from_image(self, site_from_image: Matrix3) -> Matrix3:
        camera = self.pixels.small
        centre = site_from_image @ np.array([camera.cx_px, camera.cy_px, 1.0])
        return self._site_grid.grid_from_site_affine(centre[:2] / centre[2], 50.0) @ site_from_image

    def _map_under(self, aligned: Aligned) -> tuple[ImageRGB, Mask]:
        """The map's picture (h, w, 3) where a frame lies, and where (h, w) it is known and the lens sees."""
        small = self.pixels.small
        reference, known = self._reference.seen_from(
            self._grid_from_image(aligned.site_from_image), small.width_px, small.height_px
        )
        return reference, known & self._lens_sees

    def _laid(self, aligned: Aligned, image: ImageRGB, known: Mask) -> tuple[ImageRGB, Mask]:
        """A frame (h, w, 3) laid on the map's picture, over its heights where it has any, and where (h, w) both are
        known."""
        if self.surface is None or aligned.stand is None:
            return _laid_level(aligned, image, known)
        x, y, sees = self.surface.lay(
            aligned.site_from_image, known.shape[::-1], self._lens.camera, aligned.stand
        )
        laid = cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(laid, np.uint8), known & sees

    def _by_level_ground(self, compared: OneSided) -> tuple[Difference, Mask]:
        """What differs from the map where the frame lies on it as over level ground, and where that is known."""
        image = self.undistorted(compared.posed)
        image, known = _laid_level(compared.aligned, image, compared.known)
        found = compare_robust(as_bgr(compared.reference), as_bgr(image), known, LEAST_SCORE)
        return Difference(found.mask, found.boxes, found.scores), known

    def _view(
        self,
        frame: Frame,
        aligned: Aligned,
        pictures: tuple[ImageRGB, ImageRGB, Mask],
        found: Difference,
    ) -> ComparedView:
        """The compared view: `pictures` are the frame, the map and where both are valid."""
        image, reference, valid = pictures
        shade = shade_of_view(reference, image, valid) if len(found.boxes) else found.mask
        return ComparedView(
            frame.index,
            frame.name,
            self._flight.utc_ns(frame.time_ns),
            aligned.site_from_image,
            aligned.camera_m,
            *pictures,
            found.mask,
            found.boxes,
            found.scores,
            aligned.residual_px,
            shade,
        )

    def _corroborated(self, compared: OneSided) -> tuple[Difference, Mask | None]:
        """What differs from the map or from one of the nearest earlier pictures, as far as they confirm it; and the
        ground (h, w) that leans another way in them."""
        if self._pictures is None or self._measures is None:
            return compared.found, None
        (height, width) = compared.valid.shape
        leans, level = np.zeros((height, width), bool), level_of(as_bgr(compared.reference))
        earlier: list[tuple[Difference, Mask]] = []
        pictures = self._pictures.seen_from(
            compared.aligned.site_from_image,
            compared.aligned.camera_m,
            width,
            height,
            _WITNESSES + _FURTHER,
        )
        for number in range(_WITNESSES + _FURTHER):
            is_further = number >= _WITNESSES
            seen = [each for _, each in earlier]
            open_parts = unwitnessed(compared.found, seen) if is_further else []
            if is_further and not open_parts:
                break
            picture, sees = next(
                pictures, (None, None)
            )  # made only now: most views need no further ones
            if picture is None or sees is None:
                break
            sees &= self._lens_sees
            mask = compared.found.mask
            if is_further and not any(is_whole(mask, each, sees) for each in open_parts):
                continue
            found = compare_robust(picture, compared.query, sees, LEAST_SCORE)
            earlier.append((Difference(found.mask, found.boxes, found.scores), sees))
            leans |= leaning(level, picture, sees & compared.valid)
        if compared.aligned.stand is not None and len(compared.found.boxes):
            # heights have errors of their own, by walls and crowns: what they alone show is no change
            earlier.append(self._by_level_ground(compared))
        return believed((compared.found, compared.valid), earlier), leans

    def _plant(self, view: ComparedView, compared: OneSided) -> tuple[Planted, ...]:
        """What is found of things drawn into a view, if it is its turn; nothing by another method."""
        if self._measures is None:
            return ()
        reference = as_bgr(compared.reference)
        return self._planting.plant(
            view,
            lambda picture: (
                compare_robust(reference, as_bgr(picture), compared.valid, SURE).mask > 0
            ),
        )

    def _difference(
        self, reference: ImageRGB, image: ImageRGB, query: ImageBGR, valid: Mask
    ) -> tuple[Difference, PairMeasures | None]:
        """What differs from the map, and what was measured."""
        if self._measures is None:
            assert self._method is not None
            other = self._method.compare(reference, image, valid)
            return Difference(other.mask, other.boxes, np.full(len(other.boxes), 0.5)), None
        found = compare_robust(as_bgr(reference), query, valid, LEAST_SCORE)
        measured = PairMeasures.of(found)
        self._measures.observe(measured)
        return Difference(found.mask, found.boxes, found.scores), measured


def _laid_level(aligned: Aligned, image: ImageRGB, known: Mask) -> tuple[ImageRGB, Mask]:
    """A frame (h, w, 3) laid on the map's picture as over level ground, and where (h, w) both are known."""
    return (image, known) if aligned.local is None else aligned.local.warped(image, known)


def _doubted(found: Difference, kept: Difference, least_score: float) -> Mask:
    """(h, w) what a view surely shows to differ from the map, less what was kept of it."""
    sure = np.zeros(found.mask.shape, bool)
    for x, y, w, h in found.boxes[found.scores >= least_score]:
        sure[y : y + h, x : x + w] = True
    return sure & (found.mask > 0) & (kept.mask == 0)
