"""A frame laid over the known map: by telemetry and the frames before, then by features, then to a part of a pixel."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from enum import Enum
from functools import cache, partial

import cv2
import numpy as np

from sorvolo.change.local_fit import LocalFit, fit_locally
from sorvolo.change.map_search import MapSearch
from sorvolo.change.reference import ReferenceMap, normalised
from sorvolo.change.relief import OrthoSurface
from sorvolo.errors import GeometryError
from sorvolo.geometry.arrays import (
    Floats,
    Floats32,
    ImageGray,
    ImageRGB,
    Mask,
    Matrix3,
    PointsM,
    PointsPx,
    Vector3,
    shrunk,
    size_within,
)
from sorvolo.geometry.camera import Camera
from sorvolo.geometry.grid import SiteGrid
from sorvolo.geometry.homography import (
    apply_homography,
    pose_from_homography,
    resized,
    shifted,
    site_from_image_homography,
)
from sorvolo.geometry.pose import Pose
from sorvolo.registration.camera_fit import PosePrior, fit_camera
from sorvolo.registration.features import (
    FeatureSettings,
    gray_from_rgb,
    normalise_contrast,
    orb_features,
)
from sorvolo.registration.link import LinkCache, LinkSettings, refine
from sorvolo.registration.matching import fit_homography, match
from sorvolo.survey.flight import CameraPrior
from sorvolo.survey.mosaic import Features, Keyframe, Link

_UNKNOWN = CameraPrior(np.zeros(3), np.full(3, np.inf), np.eye(3), np.full(3, np.inf))
_NO_FEATURES = Features("orb", np.zeros((0, 2)), np.zeros((0, 32), np.uint8))


# How a local fit moves a camera, and how the last fits predict the next one.
_MOVING_SIDE_PX = 960  # longest side of the pictures that a local fit is made from
_ROUNDS = 2  # of local fits, where a place moves by ...
_FAR_M = 0.6  # ... this or more
_PLACE_SIGMA_M = 2.0  # by axis: what a local fit moves a camera by, ...
_TURN_SIGMA_DEG = 2.0  # ... and turns it by
_PREDICTS_S = 2.0  # a fit older than this predicts nothing
_STANDING_ROUNDS = 3  # in which a camera is moved in space; what a round lays, the next one follows
_FITTING_ROUNDS = 4  # of one camera's fit, each leaving out what the last one left far off
_SHRINK = 4  # times smaller are the copies that are shifted onto each other


# How a frame is laid over the map, and when that counts.
_ALIGNMENT_SIDE_PX = 640  # longest side at which frames are aligned
_LEAST_KNOWN = 0.1  # share of the frame that must lie on known ground
# of the registered image: worse, and what differs is the fit, not the ground
_MOST_RESIDUAL_PX = 2.2
# a fit that leaves more is checked: a predicted one by features, others by the search
_DOUBTFUL_PX = 1.5
_LEAST_SPREAD = 0.6  # share of a frame's cells with points: with less a homography may swing
_CELLS = (4, 3)  # across and down
_SEARCHED_MISSES = 8  # frames in a row that fit nowhere: of later ones every fifth is searched for
_CONFIRMS_REST = 0.42  # of a local fit: less confirms a place in doubt; other ground had 0.53 once
_SETTLED_PX = 1.2  # a fit that leaves more is followed by a local one
_MOST_FEATURES = 60_000  # of the whole map, to look for a frame whose place is not known at all
# the same words for all frames beside the map, for reports count them
_BESIDE = f"less than {_LEAST_KNOWN:.0%} of it lies on the map"
_LINKS = LinkSettings(FeatureSettings(orb_count=900), min_inliers=20, max_pairs=150)


@dataclass(frozen=True, eq=False)
class Aligned:
    """A frame that fits the map. `site_from_image` (3, 3) takes its undistorted pixels to site metres on the ground.

    `residual_px` is the median distance that paired points keep, in the frame's own pixels. `followed`: the last fit
    predicted this one, no features were needed. `local` is what the frame is moved by on the map beyond that
    homography, None where nothing is; `local_m` how far a local fit moved it in all (median, m). `with_flight`: it was
    not found for sure by itself and lies where its flight as a whole has it. `stand` is its camera in space over a
    true orthophoto's heights; None over level ground, and where none is found.
    """

    site_from_image: Matrix3
    camera_m: Vector3
    residual_px: float
    followed: bool
    local: LocalFit | None = None
    local_m: float = 0.0
    with_flight: bool = False
    stand: Pose | None = None


class Caution(Enum):
    """When to use fast, unambiguous alignment alone; frames that it does not place are retried later."""

    NEVER = "never"
    AT_FIRST = "at first"  # until a frame of the flight was found beyond doubt
    ALWAYS = "always"


@dataclass(frozen=True)
class NotAligned:
    """A frame that fits the map nowhere, why, and the residual of the best try (NaN without any).

    `is_outside`: it lies beyond the known ground, as far as is known. `comes_again`: caution kept it from being looked
    for by all means.
    """

    reason: str
    residual_px: float
    is_outside: bool = False
    comes_again: bool = False


@dataclass(frozen=True, eq=False)
class _Fit:
    time_ns: int
    pose: Pose
    telemetry_rotation: Matrix3  # by telemetry at that time
    seen_from_ideal: Matrix3  # what the fit has beyond a perfect camera at that pose
    site_from_image: Matrix3


@dataclass(frozen=True, eq=False)
class MapPlace:
    """Where a frame lies, in pixels of the size at which frames are aligned. `ratio` is how sure the search is of it:
    infinite for homographies with points all over the frame, 0 for those that may swing where they have none."""

    site_from_image: Matrix3
    pose: Pose
    residual_px: float
    followed: bool
    ratio: float


@dataclass(frozen=True, eq=False)
class FlightPlace:
    """Where an undistorted frame lies by others of its flight, site_from_image (3, 3), and how well those fit."""

    site_from_image: Matrix3
    residual_m: float


@dataclass(frozen=True, eq=False)
class AlignStep:
    """What a frame left in an `Aligner`: its place (None: it has none), and the frames without one up to it."""

    place: MapPlace | None
    misses: int


@dataclass(frozen=True, eq=False)
class _Frame:
    """A frame that is laid over the map: as taken, its gray at the size at which frames are aligned, the same with its
    contrast normalised, what telemetry has of it, and its camera's pose by telemetry, None where that has no place.

    `inside` gives site_from_image by telemetry, None where less than the least share of that lies on known ground.
    """

    image: ImageRGB
    camera: Camera
    gray: ImageGray
    even: Keyframe
    prior: CameraPrior
    time_ns: int
    by_telemetry: Pose | None
    inside: Callable[[], Matrix3 | None]


class Aligner:
    """Lays the frames of one flight over a map, in order of time. Only `align` and `recall` change it."""

    def __init__(
        self, reference: ReferenceMap, site_grid: SiteGrid, surface: OrthoSurface | None = None
    ) -> None:
        self._reference, self._site_grid, self._surface = reference, site_grid, surface
        self._fits: list[_Fit] = []
        self.search = MapSearch(reference, site_grid)
        """What looks for frames that no homography places."""
        self._count = 0
        self._misses = 0  # frames since the last fit
        self._is_found = False  # whether a frame was found beyond doubt
        self.step = AlignStep(None, 0)
        """What the last frame left."""

    def align(
        self,
        image: ImageRGB,
        camera: Camera,
        prior: CameraPrior,
        time_ns: int,
        place: FlightPlace | None = None,
        caution: Caution = Caution.NEVER,
    ) -> Aligned | NotAligned:
        """Where an undistorted frame, (H, W, 3), of the distortion-free `camera` lies on the map. `place` is where its
        flight has it, where that is known: only a local fit moves it then."""
        size, gray = self._small(image)
        scale = min(1.0, _ALIGNMENT_SIDE_PX / max(image.shape[:2]))
        small_camera = camera.resized(*size)
        new = self._keyframe(small_camera, normalise_contrast(gray))
        by_telemetry = self._telemetry_pose(prior)
        ground = None if by_telemetry is None else _homography_of(small_camera, by_telemetry)

        @cache
        def share_known() -> float:
            if ground is None:
                return 1.0
            seen = self._seen(ground, small_camera)
            return 0.0 if seen is None else float(seen[1].mean())

        def inside() -> Matrix3 | None:
            return ground if share_known() >= _LEAST_KNOWN else None

        frame = _Frame(image, camera, gray, new, prior, time_ns, by_telemetry, inside)
        placed: MapPlace | NotAligned
        is_cautious = caution is Caution.ALWAYS or (
            caution is Caution.AT_FIRST and not self._is_found
        )
        if place is not None:
            placed = _as_known(place, camera, small_camera)
        elif is_cautious:
            # fast and unambiguous; failures do not count, for the frame is retried
            misses = self._misses
            placed = self._by_homographies(frame, is_cheap=True)
            self._misses = misses
            if isinstance(placed, MapPlace) and self._is_doubtful(placed, prior):
                placed = NotAligned("its place is in doubt", placed.residual_px)
        else:
            placed = self._by_homographies(frame)
            # a flight that fits nowhere is searched for every fifth frame
            may_search = self._misses < _SEARCHED_MISSES or self._misses % 5 == 1
            if self._is_doubtful(placed, prior) and may_search:
                placed = self._by_search(frame) or placed
        if isinstance(placed, NotAligned):
            is_outside = share_known() < _LEAST_KNOWN
            reason = _BESIDE if is_outside else placed.reason
            self.step = AlignStep(None, self._misses)
            return NotAligned(
                reason, placed.residual_px / scale, is_outside, is_cautious and not is_outside
            )
        moved, left, size_m = self._settled(frame, placed)
        stand, residual_px = self._stand(frame, moved)
        self._remember(time_ns, moved, prior, new)
        self.step = AlignStep(moved, self._misses)
        small_from_full = resized(size[0] / image.shape[1], size[1] / image.shape[0])
        return Aligned(
            moved.site_from_image @ small_from_full,
            moved.pose.translation_m,
            residual_px / scale,
            placed.followed,
            left,
            size_m,
            with_flight=place is not None,
            stand=stand,
        )

    def recall(
        self, image: ImageRGB, camera: Camera, prior: CameraPrior, time_ns: int, step: AlignStep
    ) -> None:
        """Take a frame that an earlier process aligned as it did."""
        size, gray = self._small(image)
        new = self._keyframe(camera.resized(*size), normalise_contrast(gray))
        if step.place is not None:
            self._remember(time_ns, step.place, prior, new)
        self._misses = step.misses
        self.step = step

    # ---- inside -----------------------------------------------------------------------------------------------

    def _small(self, image: ImageRGB) -> tuple[tuple[int, int], ImageGray]:
        """The size (width, height) at which a frame is aligned, and its gray there."""
        size = size_within(image, _ALIGNMENT_SIDE_PX, 16)
        return size, shrunk(gray_from_rgb(image), size)

    def _by_homographies(self, frame: _Frame, *, is_cheap: bool = False) -> MapPlace | NotAligned:
        """The frame placed by the first guess that its points confirm to a part of a pixel, or why none is."""
        nearest = NotAligned("its features are found nowhere in the map where it could be", np.nan)
        for guess, followed in self._guesses(frame, is_cheap=is_cheap):
            found = self._fit(frame.even, guess, followed=followed)
            if isinstance(found, MapPlace):
                return found
            nearest = _nearer(nearest, found)
        return nearest

    def _is_doubtful(self, placed: MapPlace | NotAligned, prior: CameraPrior) -> bool:
        """Whether a frame is nowhere, or where telemetry, as it was so far, hardly can have it."""
        if isinstance(placed, NotAligned):
            return True
        return not placed.followed and (placed.ratio == 0 or self.search.is_odd(placed.pose, prior))

    def _by_search(self, frame: _Frame) -> MapPlace | None:
        """The frame placed by learned features, telemetry and its neighbours; what these leave in doubt, or what lies
        far from where telemetry was right so far, a local fit must confirm. Without telemetry's place the search begins
        at the last frame's."""
        if frame.by_telemetry is None and self._fits and not frame.prior.knows_place:
            start = self._fits[-1].pose
        elif frame.by_telemetry is not None and frame.inside() is not None:
            start = frame.by_telemetry
        else:
            return None
        found = self.search.find(frame.gray, frame.even.gray, frame.even.camera, frame.prior, start)
        if found is None:
            return None
        place = MapPlace(
            found.fit.site_from_image, found.fit.pose, found.fit.residual_px, False, found.ratio
        )
        if found.is_sure and not self.search.is_odd(place.pose, frame.prior):
            return place
        local = self._local(frame, place)
        return place if local is not None and local.rest <= _CONFIRMS_REST else None

    def _settled(self, frame: _Frame, placed: MapPlace) -> tuple[MapPlace, LocalFit | None, float]:
        """The place moved as a camera by local fits where the last fit leaves much; what no camera explains of them, in
        the frame's own pixels, and how far they moved it in all (median, m)."""
        place, left, size_m = placed, None, 0.0
        if placed.residual_px <= _SETTLED_PX and (placed.followed or np.isinf(placed.ratio)):
            return place, left, size_m
        fine = _fine(frame.camera)
        for _ in range(_ROUNDS):
            local = self._local(frame, place)
            if local is None:
                break
            moved_m = float(local.median_px * place.pose.translation_m[2] / fine.fx_px)
            place, rest = _as_camera(place, local, fine, _small_from(fine, frame.even.camera))
            left, size_m = rest.resized(frame.camera.width_px / fine.width_px), max(moved_m, size_m)
            if moved_m < _FAR_M:
                break
        return place, left, size_m

    def _stand(self, frame: _Frame, placed: MapPlace) -> tuple[Pose | None, float]:
        """Where a frame's camera stands in space, and the median distance that points keep, px: its picture is laid over
        the heights as its place on level ground has it, points are followed from there to the map, and the camera is
        moved to see them where they are. Without heights None, and the place's own distance."""
        surface, nowhere = self._surface, (None, placed.residual_px)
        if surface is None:
            return nowhere
        camera, site_from_image = frame.even.camera, placed.site_from_image
        size = camera.width_px, camera.height_px
        seen = self._seen(site_from_image, camera)
        if seen is None:
            return nowhere
        old, up_m = self._keyframe(camera, normalised(*seen)), surface.under(site_from_image, size)
        raised_m = np.array([0.0, 0.0, np.median(up_m)])
        pose = Pose(placed.pose.rotation, placed.pose.translation_m + raised_m)
        for _ in range(_STANDING_ROUNDS):
            x, y, _ = surface.lay(site_from_image, size, camera, pose)
            laid = cv2.remap(frame.gray, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            new = self._keyframe(camera, normalise_contrast(np.asarray(laid, np.uint8)))
            found = refine(new, old, np.eye(3), _LINKS, LinkCache(_LINKS.features, 2))
            if not isinstance(found, Link):
                return nowhere
            image_px = np.column_stack([_sampled(each, found.new_px) for each in (x, y)])
            ground_m = apply_homography(site_from_image, found.old_px)
            points_m = np.column_stack([ground_m, _sampled(up_m, found.old_px)])
            stood = _seen_so(image_px, points_m, camera, pose)
            if stood is None:
                return nowhere
            pose, miss_px = stood
        return pose, miss_px

    def _local(self, frame: "_Frame", placed: MapPlace) -> LocalFit | None:
        """The local fit of a frame at its place, in pixels of the `_fine` camera."""
        fine = _fine(frame.camera)
        size = fine.width_px, fine.height_px
        seen = self._seen(placed.site_from_image @ _small_from(fine, frame.even.camera), fine)
        if seen is None:
            return None
        gray: ImageGray = shrunk(gray_from_rgb(frame.image), size)
        m_per_px = float(placed.pose.translation_m[2]) / fine.fx_px
        return fit_locally(gray_from_rgb(seen[0]), gray, seen[1], m_per_px)

    def _keyframe(self, camera: Camera, gray: ImageGray) -> Keyframe:
        self._count += 1
        return Keyframe(self._count, camera, gray, _NO_FEATURES, _UNKNOWN)

    def _telemetry_pose(self, prior: CameraPrior) -> Pose | None:
        """site_from_camera as telemetry alone gives it; None where it has no place."""
        if not prior.knows_place:
            return None
        up_m = float(prior.position_m[2])
        if self._fits:
            last_up_m = float(self._fits[-1].pose.translation_m[2])
            if not np.isfinite(prior.position_sigma_m[2]) or up_m < 0.3 * last_up_m:
                up_m = last_up_m
        return Pose(prior.rotation, np.array([*prior.position_m[:2], max(up_m, 0.5)]))

    def _guesses(self, frame: _Frame, *, is_cheap: bool) -> Iterator[tuple[Matrix3, bool]]:
        """The ladder: site_from_image good to a few pixels, the cheapest first, and whether the last fit predicted it.

        Telemetry is asked where the past is no help. The dear rung comes every fifth time: a video's next frame may be
        found by its telemetry again.
        """
        new, prior = frame.even, frame.prior
        predicted = self._predicted(new.camera, prior, frame.time_ns)
        if predicted is not None:
            yield self._shifted(new, predicted), True
        by_telemetry = frame.inside()
        features = orb_features(new.gray, _LINKS.features)
        self._misses += 1
        rungs: list[Callable[[], Matrix3 | None]] = [
            partial(self._by_features, new, features, near, prior, is_free=False)
            for near in (predicted, by_telemetry)
            if near is not None
        ]
        if by_telemetry is not None:  # a compass may be off by any angle
            rungs.append(
                partial(self._by_features, new, features, by_telemetry, prior, is_free=True)
            )
        is_dear = not is_cheap and self._misses % 5 == 1
        if is_dear and (by_telemetry is not None or not prior.knows_place):
            rungs.append(partial(self._anywhere, features))
        for rung in rungs:
            found = rung()
            if found is not None:
                yield found, False

    def _predicted(self, camera: Camera, prior: CameraPrior, time_ns: int) -> Matrix3 | None:
        """The last fit moved on at the flight's velocity, turned as telemetry has the camera turned."""
        longest_ns = _PREDICTS_S * 1e9
        if not self._fits or not 0 <= time_ns - self._fits[-1].time_ns <= longest_ns:
            return None
        last = self._fits[-1]
        since_s = (time_ns - last.time_ns) / 1e9
        if len(self._fits) > 1 and last.time_ns - self._fits[-2].time_ns <= longest_ns:
            before = self._fits[-2]
            moved_m = last.pose.translation_m - before.pose.translation_m
            velocity_m_s = moved_m / ((last.time_ns - before.time_ns) / 1e9)
        else:
            velocity_m_s = prior.velocity_m_s
        rotation = last.pose.rotation
        if prior.attitude_sigma_deg.max() <= 2.0:
            rotation = prior.rotation @ last.telemetry_rotation.T @ rotation
        place_m = last.pose.translation_m + velocity_m_s * since_s
        try:
            ideal = site_from_image_homography(
                camera, Pose(rotation, np.array([*place_m[:2], max(place_m[2], 0.5)]))
            )
        except GeometryError:
            return None
        return ideal @ np.linalg.inv(last.seen_from_ideal)

    def _remember(self, time_ns: int, placed: MapPlace, prior: CameraPrior, new: Keyframe) -> None:
        # ideal @ inv(seen_from_ideal) gives the fit back
        ideal = site_from_image_homography(new.camera, placed.pose)
        seen_from_ideal = np.linalg.inv(placed.site_from_image) @ ideal
        fit = _Fit(
            time_ns,
            placed.pose,
            prior.rotation,
            seen_from_ideal / seen_from_ideal[2, 2],
            placed.site_from_image,
        )
        self._fits = [*self._fits[-1:], fit]
        self._misses = 0
        self._is_found |= bool(np.isinf(placed.ratio))
        self.search.remember(
            new.gray, new.camera, prior, placed.pose, placed.site_from_image, placed.ratio
        )

    def _on_grid(self, site_from_image: Matrix3, camera: Camera) -> Matrix3 | None:
        """grid_from_image of a guess; None when the image's centre sees no ground."""
        centre = site_from_image @ np.array([camera.cx_px, camera.cy_px, 1.0])
        if centre[2] <= 0:
            return None
        return self._site_grid.grid_from_site_affine(centre[:2] / centre[2], 50.0) @ site_from_image

    def _seen(
        self, site_from_image: Matrix3, camera: Camera, shrink: int = 1
    ) -> tuple[ImageRGB, Mask] | None:
        grid_from_image = self._on_grid(site_from_image, camera)
        if grid_from_image is None:
            return None
        return self._reference.seen_from(grid_from_image, camera.width_px, camera.height_px, shrink)

    def _shifted(self, new: Keyframe, site_from_image: Matrix3) -> Matrix3:
        """The guess moved to where phase correlation of small copies puts it: refinement reaches a few pixels only."""
        seen = self._seen(site_from_image, new.camera, shrink=_SHRINK)
        if seen is None or seen[1].mean() < _LEAST_KNOWN:
            return site_from_image
        old = normalised(*seen).astype(np.float32)
        size = old.shape[1], old.shape[0]
        step_x, step_y = new.camera.width_px / size[0], new.camera.height_px / size[1]
        fresh = shrunk(new.gray, size).astype(np.float32)
        window = cv2.createHanningWindow(size, cv2.CV_32F)
        (dx, dy), response = cv2.phaseCorrelate(old, fresh, window)
        if response < 0.05 or abs(dx) > 0.4 * size[0] or abs(dy) > 0.4 * size[1]:
            return site_from_image
        return site_from_image @ shifted(-step_x * dx, -step_y * dy)

    def _by_features(
        self,
        new: Keyframe,
        features: Features,
        site_from_image: Matrix3,
        prior: CameraPrior,
        *,
        is_free: bool,
    ) -> Matrix3 | None:
        """The guess corrected by the map's features around it; `is_free`: turned and shifted by them."""
        grid_from_image = self._on_grid(site_from_image, new.camera)
        if grid_from_image is None:
            return None
        sigma_m = float(np.nan_to_num(prior.position_sigma_m[:2].max(), posinf=10.0))
        metres_per_px = abs(np.linalg.det(site_from_image[:2, :2] / site_from_image[2, 2])) ** 0.5
        search_px = min(
            0.25 * max(new.gray.shape) + 3 * sigma_m / max(metres_per_px, 1e-6),
            1.5 * max(new.gray.shape),
        )
        old = self._reference.features_under(
            grid_from_image,
            new.camera.width_px,
            new.camera.height_px,
            search_px / max(new.gray.shape),
        )
        return self._matched(
            features, old, grid_from_image, 0.0 if is_free else search_px, site_from_image
        )

    def _anywhere(self, features: Features) -> Matrix3 | None:
        """A frame of unknown place, looked for in the whole map at the frame's own scale and those beside it."""
        for level in range(3):
            old = self._reference.all_features(level, _MOST_FEATURES)
            if not len(old):
                continue
            centre_px = old.points_px.mean(axis=0)
            scale = float(1 << level)
            grid_from_image = np.array(
                [[scale, 0.0, centre_px[0]], [0.0, scale, centre_px[1]], [0.0, 0.0, 1.0]]
            )
            grid_from_site = self._site_grid.grid_from_site_affine(np.zeros(2), 50.0)
            near_m = apply_homography(np.linalg.inv(grid_from_site), centre_px[None])[0]
            site_from_grid = np.linalg.inv(self._site_grid.grid_from_site_affine(near_m, 50.0))
            found = self._matched(
                features, old, grid_from_image, 0.0, site_from_grid @ grid_from_image
            )
            if found is not None:
                return found
        return None

    def _matched(
        self,
        features: Features,
        old: Features,
        grid_from_image: Matrix3,
        search_px: float,
        site_from_image: Matrix3,
    ) -> Matrix3 | None:
        """The guess corrected by matched features; `search_px` 0: wherever they lie."""
        image_from_grid: Matrix3 = np.linalg.inv(grid_from_image).astype(np.float64)
        pairs = match(features, old, image_from_grid if search_px else None, search_px)
        guessed = apply_homography(image_from_grid, old.points_px[pairs[:, 1]])
        ahead = np.isfinite(guessed).all(axis=1)
        return self._corrected(features.points_px[pairs[ahead, 0]], guessed[ahead], site_from_image)

    def _corrected(
        self, new_px: PointsPx, guessed_px: PointsPx, site_from_image: Matrix3
    ) -> Matrix3 | None:
        """The guess corrected by points where they are and where it put them; None where no plane fits them."""
        if len(new_px) < _LINKS.min_inliers // 2:
            return None
        fitted = fit_homography(new_px, guessed_px, _LINKS.threshold_px)
        if fitted is None or fitted[1].sum() < _LINKS.min_inliers // 2:
            return None
        return site_from_image @ np.linalg.inv(fitted[0])

    def _fit(self, new: Keyframe, guess: Matrix3, *, followed: bool) -> MapPlace | NotAligned:
        """The place that a guess leads to, to a part of a pixel, or why there is none."""
        seen = self._seen(guess, new.camera)
        if seen is None:
            return NotAligned("it would look at the horizon", np.nan)
        if float(seen[1].mean()) < _LEAST_KNOWN:
            return NotAligned(_BESIDE, np.nan)
        old = self._keyframe(new.camera, normalised(*seen))
        found = refine(new, old, np.eye(3), _LINKS, LinkCache(_LINKS.features, 2))
        if not isinstance(found, Link):
            return NotAligned(f"it does not fit the map: {found}", np.nan)
        residual_px = float(found.sigma_px * 1.1774)  # a Rayleigh distribution's median
        if residual_px > (_DOUBTFUL_PX if followed else _MOST_RESIDUAL_PX):
            return NotAligned("its points fit the map badly", residual_px)
        is_held = residual_px <= _DOUBTFUL_PX and (
            _spread_of(found.new_px, seen[1]) >= _LEAST_SPREAD
        )
        fit = _stiffened(guess @ np.linalg.inv(found.new_from_old), found, guess, new.camera)
        pose = pose_from_homography(fit, new.camera)
        if pose is None:
            return NotAligned("the fit is none that a camera above the ground could have", np.nan)
        return MapPlace(fit, pose, residual_px, followed, np.inf if is_held else 0.0)


def _sampled(values: Floats32, points_px: PointsPx) -> Floats:
    """(N,) values (h, w) between pixels, at points (N, 2)."""
    x, y = points_px.astype(np.float32).T[..., None]
    return np.asarray(cv2.remap(values, x, y, cv2.INTER_LINEAR), np.float64).ravel()


def _seen_so(
    image_px: PointsPx, points_m: Floats, camera: Camera, start: Pose
) -> tuple[Pose, float] | None:
    """The pose from which a camera sees points in space (N, 3) where they are in its picture, (N, 2), and how far off
    they are, px, the median; what lies far off most of the others counts for nothing. None where that leads to no camera
    above them."""
    pose = start
    for _ in range(_FITTING_ROUNDS):
        seen_px = camera.pixels_from_points((points_m - pose.translation_m) @ pose.rotation)
        miss_px = np.nan_to_num(np.linalg.norm(seen_px - image_px, axis=1), nan=1e9)
        near = miss_px < 3 * max(0.5, float(np.median(miss_px)))
        if near.sum() < _LINKS.min_inliers // 2:
            return None
        try:
            pose = _refined_pose(image_px[near], points_m[near], camera, pose)
        except GeometryError:
            return None
    is_above = pose.translation_m[2] > points_m[:, 2].max()
    return (pose, float(np.median(miss_px))) if is_above else None


def _refined_pose(image_px: PointsPx, points_m: Floats, camera: Camera, start: Pose) -> Pose:
    """The pose from which a camera sees points in space (N, 3) nearest to where they are in its picture, (N, 2), from
    one close by. Raises GeometryError where that leads to none."""
    middle_m = points_m.mean(axis=0)
    rotation, _ = cv2.Rodrigues(start.rotation.T)
    offset = -start.rotation.T @ (start.translation_m - middle_m)
    rotation, offset = cv2.solvePnPRefineLM(
        points_m - middle_m, image_px, camera.matrix, np.zeros(5), rotation, offset.reshape(3, 1)
    )
    camera_from_site: Matrix3 = np.asarray(cv2.Rodrigues(rotation)[0], np.float64)
    return Pose(camera_from_site.T, middle_m - camera_from_site.T @ offset.ravel())


def _as_known(known: FlightPlace, full: Camera, camera: Camera) -> MapPlace | NotAligned:
    """The place of a frame of the `full` size in pixels of the size at which frames are aligned."""
    site_from_image = known.site_from_image @ _small_from(camera, full)
    pose = pose_from_homography(site_from_image, camera)
    if pose is None:
        return NotAligned("the fit is none that a camera above the ground could have", np.nan)
    residual_px = known.residual_m * camera.fx_px / float(pose.translation_m[2])
    return MapPlace(site_from_image, pose, residual_px, False, 0.0)


def _homography_of(camera: Camera, pose: Pose) -> Matrix3 | None:
    """site_from_image of a camera at a pose; None where it stands below the ground."""
    try:
        return site_from_image_homography(camera, pose)
    except GeometryError:
        return None


def _nearer(first: NotAligned, second: NotAligned) -> NotAligned:
    """The try with the smaller residual; the later one where neither has any."""
    if not np.isfinite(first.residual_px):
        return second
    return second if second.residual_px < first.residual_px else first


def _spread_of(points_px: PointsPx, known: Mask) -> float:
    """The share of the frame's cells on known ground, this many across and down, that hold points."""
    height, width = known.shape
    cells = np.array(_CELLS)
    on_map = shrunk(known.astype(np.float32), _CELLS) > 0.5
    held = np.zeros_like(on_map)
    x, y = (points_px * cells / [width, height]).astype(int).clip(0, cells - 1).T
    held[y, x] = True
    return float((held & on_map).sum() / max(1, on_map.sum()))


def _stiffened(
    site_from_image: Matrix3, link: Link, site_from_old: Matrix3, camera: Camera
) -> Matrix3:
    """The fit as a camera over level ground sees it, six degrees of freedom, where that explains the pairs as well.

    A free homography has two more, and swings at the corners where pairs lie in one part of the image only.
    """
    start = pose_from_homography(site_from_image, camera)
    if start is None:
        return site_from_image
    ground_m = apply_homography(site_from_old, link.old_px)
    free_miss = _miss_px(site_from_image, ground_m, link.new_px)
    near = free_miss < 3 * max(1.0, float(np.median(free_miss)))
    if near.sum() < 6:
        return site_from_image
    points_m = np.column_stack([ground_m[near], np.zeros(near.sum())])
    try:
        pose = _refined_pose(link.new_px[near], points_m, camera, start)
        stiff = site_from_image_homography(camera, pose)
    except GeometryError:
        return site_from_image
    stiff_miss = _miss_px(stiff, ground_m, link.new_px)
    worse = float(np.median(stiff_miss[near])) > 1.15 * float(np.median(free_miss[near])) + 0.1
    return site_from_image if worse else stiff


def _fine(camera: Camera) -> Camera:
    """The camera at the size at which local fits are made."""
    share = min(1.0, _MOVING_SIDE_PX / max(camera.width_px, camera.height_px))
    return camera.resized(round(camera.width_px * share), round(camera.height_px * share))


def _small_from(fine: Camera, small: Camera) -> Matrix3:
    """(3, 3) from the pixels of one size of a frame to those of another."""
    return resized(small.width_px / fine.width_px, small.height_px / fine.height_px)


def _as_camera(
    placed: MapPlace, local: LocalFit, camera: Camera, small_from_image: Matrix3
) -> tuple[MapPlace, LocalFit]:
    """The place moved as a local fit in this camera's pixels has it, as far as a camera over level ground can; and what
    is left of the fit. `small_from_image` leads to the place's own pixels."""
    old_px = local.places_px(camera.width_px, camera.height_px)
    new_px = old_px + local.moved_px.reshape(-1, 2)
    ground_m = apply_homography(placed.site_from_image @ small_from_image, old_px)
    known = local.is_known.ravel()
    prior = PosePrior(
        placed.pose,
        np.full(3, _PLACE_SIGMA_M),
        np.radians(np.full(3, _TURN_SIGMA_DEG)),
    )
    found = fit_camera(new_px[known], ground_m[known], camera, prior, start_px=6.0, band_px=3.0)
    if found is None:
        return placed, local
    left_px = new_px - apply_homography(np.linalg.inv(found.site_from_image), ground_m)
    site_from_small = found.site_from_image @ np.linalg.inv(small_from_image)
    place = replace(placed, site_from_image=site_from_small, pose=found.pose)
    return place, replace(local, moved_px=left_px.reshape(local.moved_px.shape))


def _miss_px(site_from_image: Matrix3, ground_m: PointsM, image_px: PointsPx) -> Floats:
    miss = apply_homography(np.linalg.inv(site_from_image), ground_m) - image_px
    return np.nan_to_num(np.linalg.norm(miss, axis=1), nan=1e9)
