"""Frames of a later flight to views compared with the map: aligned, resampled, searched for differences."""

from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np

from sorvolo.change.alignment import Aligned, Aligner
from sorvolo.change.pair.corroboration import LEAST_SURENESS, Difference, believed
from sorvolo.change.pair.flight_tuning import FlightTuning
from sorvolo.change.pair.robust import RobustSettings, compare_robust
from sorvolo.change.pair.thesis import compare_thesis
from sorvolo.change.reference import ReferenceMap
from sorvolo.geometry.arrays import Anything, Boxes, ImageGray, ImageRGB, Mask, Matrix3, PointsM
from sorvolo.geometry.camera import Camera
from sorvolo.geometry.grid import SiteGrid
from sorvolo.geometry.ground import footprint
from sorvolo.geometry.homography import apply_homography, pose_from_homography
from sorvolo.geometry.pose import Pose
from sorvolo.missions.compare.earlier_pictures import EarlierPictures
from sorvolo.missions.flight.settings import CompareSettings
from sorvolo.missions.flight.setup import FlightSetup
from sorvolo.mosaic.lens import Undistorter
from sorvolo.mosaic.placing import rejected
from sorvolo.survey.findings import ComparedView, ViewStatus
from sorvolo.survey.flight import CameraPrior, PosedFrame
from sorvolo.survey.mosaic import PlacedFrame, Status

_LEAST_SIDE_PX = 480
_VIDEO_SIDE_PX, _PHOTO_SIDE_PX = 1280, 1600  # frames come faster than photos, and show a place more often
_KNOWN_ENOUGH = 0.1  # share of a frame on known ground: with less there is nothing to compare
_WITNESSES = 2  # earlier pictures asked about a difference: one from each side
_ALL_CHANGED = 0.5  # share of a view: more is snow, a flood or another place, not a list of changes


@dataclass(frozen=True, eq=False)
class ViewOutcome:
    """How one frame's comparison ended. `view` exists when it was compared, `site_from_image` (of the full undistorted
    frame) when it was aligned. `known` is the share of the frame that lies on known ground, `brightness` how many times
    as bright as the map the flight is so far, NaN where that is not known."""

    status: ViewStatus
    reason: str
    residual_px: float  # in pixels of the full frame
    known: float
    site_from_image: Matrix3 | None = None
    view: ComparedView | None = None
    brightness: float = float("nan")


@dataclass(frozen=True, eq=False)
class OneSided:
    """A frame compared with the map, before earlier pictures are asked; `image` is RGB, `query` the same as BGR.

    `settings` are those by which earlier pictures are to be compared, `told` is what is known of its outcome.
    """

    posed: PosedFrame
    aligned: Aligned
    image: ImageRGB
    reference: ImageRGB
    query: Anything
    valid: Mask
    found: Difference
    settings: RobustSettings | None
    told: ViewOutcome


class ViewMaker:
    """Compares the frames of one flight with one version of the map, in order of time.

    `look` says what differs from the map, `ask` what earlier pictures say of that. Either is to be called for the
    frames in their order; one may run while the other does, in another thread.
    """

    def __init__(
        self, setup: FlightSetup, reference: ReferenceMap, site_grid: SiteGrid, settings: CompareSettings,
        pictures: EarlierPictures | None,
    ) -> None:
        self._setup, self._reference, self._site_grid = setup, reference, site_grid
        self._full = setup.source.camera.camera
        side_px = settings.side_px or (_VIDEO_SIDE_PX if setup.source.kind == "video" else _PHOTO_SIDE_PX)
        self._camera = _comparison_camera(self._full, setup, site_grid.grid.m_per_px, side_px)
        self._lens = Undistorter(self._camera, self._full)
        size = self._camera.width_px, self._camera.height_px
        seen = self._lens.valid(*size)
        self._lens_sees: Mask = np.ones(size[::-1], bool) if seen is None else seen
        self._pictures = pictures
        self._aligner = Aligner(reference, site_grid)
        self._tuning = FlightTuning() if settings.method == "robust" else None
        self._thesis = settings.thesis
        self._frame_maps: tuple[Anything, Anything] | None = None

    def look(self, posed: PosedFrame) -> ViewOutcome | OneSided:
        """Align one frame and compare it with the map; a `ViewOutcome` if that ended it."""
        frame = posed.frame
        image = self._lens.undistort(frame.image)
        aligned = self._aligner.align(image, self._lens.camera, posed.prior, frame.time_ns)
        to_full = self._full.width_px / self._camera.width_px
        if not isinstance(aligned, Aligned):
            status = ViewStatus.OUTSIDE if aligned.is_outside else ViewStatus.NOT_ALIGNED
            return ViewOutcome(status, aligned.reason, aligned.residual_px * to_full, 0.0, brightness=self.brightness)
        residual_px = aligned.residual_px * to_full
        site_from_full = aligned.site_from_image @ self._small_from_full()
        reference, known = self._reference.seen_from(
            self._grid_from_image(aligned.site_from_image), self._camera.width_px, self._camera.height_px
        )
        valid = known & self._lens_sees
        share = np.count_nonzero(valid) / np.count_nonzero(self._lens_sees)
        if share < _KNOWN_ENOUGH:
            reason = f"less than {_KNOWN_ENOUGH:.0%} of it lies on the map"
            return ViewOutcome(
                ViewStatus.OUTSIDE, reason, residual_px, share, site_from_full, brightness=self.brightness
            )
        query = as_bgr(image)
        found = self._difference(as_bgr(reference), query, valid)
        told = ViewOutcome(
            ViewStatus.COMPARED, "", residual_px, share, site_from_full, brightness=self.brightness
        )
        return OneSided(posed, aligned, image, reference, query, valid, found, self._settings_now(), told)

    def ask(self, looked: ViewOutcome | OneSided) -> ViewOutcome:
        """Ask earlier pictures what they say of a frame's differences: how its comparison ended."""
        if isinstance(looked, ViewOutcome):
            return looked
        frame, aligned, valid, told = looked.posed.frame, looked.aligned, looked.valid, looked.told
        found = self._attested(looked)
        changed = np.count_nonzero(found.mask) / max(1, int(np.count_nonzero(valid)))
        if changed > _ALL_CHANGED:
            reason = f"{changed:.0%} of it looks changed: snow, a flood, night or another place?"
            return replace(told, status=ViewStatus.ALL_CHANGED, reason=reason)
        return replace(told, view=ComparedView(
            frame.index, frame.name, self._setup.utc_ns(frame.time_ns), aligned.site_from_image, aligned.camera_m,
            looked.image, looked.reference, valid, found.mask, found.boxes, found.scores, aligned.residual_px,
        ))

    def placed(self, posed: PosedFrame, outcome: ViewOutcome, map_sigma_m: float) -> PlacedFrame:
        """The frame's record: placed by the map it fits, or rejected with the reason."""
        frame, camera = posed.frame, self._full
        time_ns = self._setup.utc_ns(frame.time_ns)
        if outcome.site_from_image is None:
            nowhere = rejected(frame.index, frame.name, time_ns, outcome.reason, camera)
            return replace(nowhere, residual_px=outcome.residual_px)
        pose = pose_from_homography(outcome.site_from_image, camera.undistorted())
        outline_m = self.outline_m(outcome.site_from_image)
        if pose is None or not np.isfinite(outline_m).all():
            return rejected(frame.index, frame.name, time_ns, "it looks at the horizon", camera)
        gps_m = pose.translation_m - posed.prior.position_m if posed.prior.knows_place else np.full(3, np.nan)
        m_per_px = pose.translation_m[2] / camera.fx_px
        return PlacedFrame(
            frame.name, frame.index, time_ns, Status.VISION, "", camera, pose, outcome.site_from_image, outline_m,
            outcome.residual_px, float(np.hypot(map_sigma_m, outcome.residual_px * m_per_px)), gps_residual_m=gps_m,
        )

    def outline_m(self, site_from_image: Matrix3) -> PointsM:
        """(4, 2) the frame's corners on the ground, site metres."""
        return apply_homography(site_from_image, self._full.undistort_points(self._full.corners_px))

    def told_outline_m(self, prior: CameraPrior) -> PointsM:
        """(4, 2) the frame's corners on the ground as telemetry alone gives them; NaN at the horizon."""
        return footprint(self._full, Pose(prior.rotation, prior.position_m))

    def masks_of_frame(self, view: ComparedView) -> tuple[ImageGray, Mask]:
        """The change mask and the valid mask in the frame's own pixels, lens distortion and all."""
        if self._frame_maps is None:
            x, y = np.meshgrid(np.arange(self._full.width_px), np.arange(self._full.height_px))
            ideal = self._full.undistort_points(np.column_stack([x.ravel(), y.ravel()]).astype(float))
            small = apply_homography(self._small_from_full(), ideal).astype(np.float32).reshape(*x.shape, 2)
            self._frame_maps = cv2.convertMaps(small[..., 0], small[..., 1], cv2.CV_16SC2, nninterpolation=True)
        x_map, y_map = self._frame_maps
        changed: Anything = cv2.remap(view.changed, x_map, y_map, cv2.INTER_NEAREST)
        valid: Anything = cv2.remap(view.valid.view(np.uint8), x_map, y_map, cv2.INTER_NEAREST)
        return changed, valid > 0

    def boxes_of_frame(self, view: ComparedView) -> Boxes:
        """The view's boxes in the frame's own pixels."""
        result = []
        full_from_small = np.linalg.inv(self._small_from_full())
        for x, y, width, height in view.boxes:
            around = np.array([
                [x, y], [x + width / 2, y], [x + width, y], [x + width, y + height / 2],
                [x + width, y + height], [x + width / 2, y + height], [x, y + height], [x, y + height / 2],
            ], float) - 0.5
            ideal = apply_homography(full_from_small, around)
            corners = self._full.pixels_from_points(self._full.undistorted().rays_from_pixels(ideal))
            limit = [self._full.width_px - 1, self._full.height_px - 1]
            low = np.clip(np.floor(corners.min(axis=0) + 0.5), 0, limit).astype(int)
            high = np.clip(np.ceil(corners.max(axis=0) + 0.5), low + 1, np.array(limit) + 1).astype(int)
            result.append([*low, *(high - low)])
        return np.array(result, np.int64).reshape(-1, 4)

    def chosen(self) -> dict[str, Any]:
        """What the robust method's parameters set themselves to on this flight; nothing for method thesis."""
        return {} if self._tuning is None else self._tuning.chosen()

    @property
    def m_per_px(self) -> float:
        """Ground metres of a compared picture's pixel, at the flight's usual height; NaN where that is not known."""
        return _usual_height_m(self._setup) / self._camera.fx_px

    @property
    def brightness(self) -> float:
        """How many times as bright as the map the flight is; NaN where that is not known."""
        return float("nan") if self._tuning is None else self._tuning.brightness

    # ---- inside -----------------------------------------------------------------------------------------------

    def _small_from_full(self) -> Matrix3:
        sx, sy = self._camera.width_px / self._full.width_px, self._camera.height_px / self._full.height_px
        return np.array([[sx, 0, (sx - 1) / 2], [0, sy, (sy - 1) / 2], [0, 0, 1.0]])

    def _grid_from_image(self, site_from_image: Matrix3) -> Matrix3:
        centre = site_from_image @ np.array([self._camera.cx_px, self._camera.cy_px, 1.0])
        return self._site_grid.grid_from_site_affine(centre[:2] / centre[2], 50.0) @ site_from_image

    def _attested(self, looked: OneSided) -> Difference:
        """What differs from the map or from one of the earlier pictures taken nearest, as far as they bear it out."""
        if self._pictures is None or looked.settings is None:
            return looked.found
        height, width = looked.valid.shape
        earlier = []
        for picture, sees in self._pictures.seen_from(
            looked.aligned.site_from_image, looked.aligned.camera_m, width, height, _WITNESSES
        ):
            sees &= self._lens_sees
            found = compare_robust(picture, looked.query, sees, looked.settings)
            earlier.append((Difference(found.mask, found.boxes, found.scores), sees))
        return believed((looked.found, looked.valid), earlier)

    def _difference(self, reference: Anything, query: Anything, valid: Mask) -> Difference:
        """What differs from the map; the flight's tuning learns of it."""
        settings = self._settings_now()
        if self._tuning is None or settings is None:
            thesis = compare_thesis(
                reference, query, valid, self._thesis.settings, self._thesis.threads
            )
            return Difference(thesis.mask, thesis.boxes, np.full(len(thesis.boxes), 0.5))
        found = compare_robust(reference, query, valid, settings)
        self._tuning.observe(found)
        return Difference(found.mask, found.boxes, found.scores)

    def _settings_now(self) -> RobustSettings | None:
        """Those of the robust method as the flight has set them so far; None for method thesis."""
        return None if self._tuning is None else replace(self._tuning.settings(), least_score=LEAST_SURENESS)


def as_bgr(image: ImageRGB) -> Anything:
    """The picture with its channels in OpenCV's order."""
    return cv2.cvtColor(image, cv2.COLOR_RGB2BGR)


def _comparison_camera(full: Camera, setup: FlightSetup, map_m_per_px: float, side_px: int) -> Camera:
    """The frame's camera, made so small that the frame is no finer than the map and no larger than asked for."""
    side = max(full.width_px, full.height_px)
    share = min(1.0, side_px / side)
    height_m = _usual_height_m(setup)
    if height_m > 1.0:
        share = min(share, max(height_m / full.fx_px / map_m_per_px, _LEAST_SIDE_PX / side))
    share = min(share, 1.0)
    return full.resized(round(full.width_px * share), round(full.height_px * share)) if share < 1 else full


def _usual_height_m(setup: FlightSetup) -> float:
    """The median of the camera's height above the ground; NaN where the telemetry does not tell."""
    return float("nan") if setup.track is None else float(np.nanmedian(setup.track.up_m))


