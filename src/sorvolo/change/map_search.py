"""Frames that ORB does not find on the map: learned features, telemetry and the places of their neighbours together."""

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np

from sorvolo.change.reference import ReferenceMap
from sorvolo.errors import GeometryError
from sorvolo.geometry.arrays import ImageGray, Matrix3, PointsM, PointsPx, Vector3
from sorvolo.geometry.camera import Camera
from sorvolo.geometry.grid import SiteGrid
from sorvolo.geometry.homography import (
    apply_homography,
    pose_from_homography,
    shifted,
    site_from_image_homography,
)
from sorvolo.geometry.pose import Pose, rotation_from_vector
from sorvolo.geometry.summary import SIGMA_PER_MEDIAN_DEVIATION
from sorvolo.registration.camera_fit import CameraFit, PosePrior, fit_camera, similar
from sorvolo.registration.features import (
    LEARNED,
    FeatureSettings,
    filled,
    gray_from_rgb,
    known_only,
    learned_features,
    match_learned,
    orb_features,
)
from sorvolo.registration.matching import fit_homography, match
from sorvolo.survey.flight import CameraPrior
from sorvolo.survey.mosaic import Features

_FEATURES = FeatureSettings(orb_count=900)  # of a frame beside its neighbours
_QUARTERS_DEG = (0.0, 90.0, -90.0, 180.0)  # headings that are tried where none is known


# How far frames are searched around their telemetry, and what counts as found; pixels are those of
# the search.
_MARGIN = 0.25  # of the frame's size: map searched beyond each side
_FRAME_POINTS = 2048  # learned features of a frame, the strongest ...
_MAP_POINTS = 4096  # ... and of the map around, which shows more ground
_RIM_PX = 15  # window of known ground that a point of the map stands in
_MOST_SCALE = 1.35  # heights of consumer drones err by a fifth
_COARSE_PX = 6.0  # band of the first fit
_NEAR_PX = 24.0  # pairs around the first fit that compete for the second
_BAND_PX = 5.0  # band of the final fit: 1 m from 100 m, what maps differ by locally
_LEAST_PAIRS = 20  # that agree; chance leaves fewer
_WEAK_PAIRS = 10  # of a place that something else must confirm ...
_WEAK_RATIO = 1.6  # ... and its least ratio
_FIRST_RATIO = 4.0  # times the pairs that chance leaves in the band; other ground leaves 0.3 to 2.8
_LEAST_RATIO = 2.5  # the same once the flight is known to lie on this map
_LEAST_SURPLUS = 3.0  # beside a neighbour, whose place is known: standard deviations above chance
_NEIGHBOURS = 3  # placed frames nearest in time, beside which a frame is tried
_MOST_KEPT = 200  # frames remembered: 0.2 MB each
_STRONG_RATIO = 5.0  # frames that correct the flight's telemetry have so many times chance's pairs
_LEAST_STRONG = 3  # frames
_ODD = 4.0  # sigmas off telemetry: a homography that swings


@dataclass(frozen=True, eq=False)
class Found:
    """A frame placed by the search. `new_px` and `ground_m`, (N, 2) each, are the pairs with the map that agree."""

    fit: CameraFit
    new_px: PointsPx
    ground_m: PointsM
    ratio: float
    is_sure: bool = (
        True  # False: too few pairs agree to believe it unless something else confirms it
    )


@dataclass(frozen=True, eq=False)
class _Placed:
    even: ImageGray
    camera: Camera
    site_from_image: Matrix3
    place_m: Vector3
    off_m: Vector3  # from where telemetry has it
    turned_rad: float  # heading, from telemetry's
    is_strong: bool


@dataclass(frozen=True, eq=False)
class _Sought:
    """A frame that is looked for: gray as taken and with its contrast normalised, and what telemetry has of it."""

    gray: ImageGray
    even: ImageGray
    camera: Camera
    prior: CameraPrior
    pose: Pose


@dataclass(frozen=True, eq=False)
class _Pairs:
    image_px: PointsPx
    ground_m: PointsM

    def joined(self, other: "_Pairs") -> "_Pairs":
        return _Pairs(
            np.concatenate([self.image_px, other.image_px]),
            np.concatenate([self.ground_m, other.ground_m]),
        )

    def __len__(self) -> int:
        return len(self.image_px)


_NO_PAIRS = _Pairs(np.zeros((0, 2)), np.zeros((0, 2)))


class MapSearch:
    """Searches one flight's frames on a map; knows where earlier ones were placed. Only `remember` changes it."""

    def __init__(self, reference: ReferenceMap, site_grid: SiteGrid) -> None:
        self._reference, self._site_grid = reference, site_grid
        self._placed: list[_Placed] = []
        self._orb: dict[int, Features] = {}

    def remember(
        self,
        even: ImageGray,
        camera: Camera,
        prior: CameraPrior,
        pose: Pose,
        site_from_image: Matrix3,
        ratio: float,
    ) -> None:
        """Note a frame that was placed; `even` is its gray, contrast normalised, `ratio` how sure, infinite by ORB."""
        off_m = pose.translation_m - prior.position_m if prior.knows_place else np.full(3, np.nan)
        turn, _ = cv2.Rodrigues(prior.rotation.T @ pose.rotation)
        is_strong = ratio >= _STRONG_RATIO
        place = _Placed(
            even, camera, site_from_image, pose.translation_m, off_m, float(turn[2, 0]), is_strong
        )
        self._placed = [*self._placed[1 - _MOST_KEPT :], place]

    def find(
        self,
        gray: ImageGray,
        even: ImageGray,
        camera: Camera,
        prior: CameraPrior,
        by_telemetry: Pose,
    ) -> Found | None:
        """Where a frame lies, or None. `by_telemetry` is where telemetry has its camera, or, without it, where a
        frame that was placed before had its own; `even` is its gray, contrast normalised.

        Beside a frame that was placed, the search starts from their common features; else around telemetry's place,
        turned as frames before were, then as telemetry has it, then by quarters: a compass may be off by any angle.
        """
        sought = _Sought(gray, even, camera, prior, by_telemetry)
        features = learned_features(gray, _FRAME_POINTS)
        best = None
        for found in self._tries(sought, features):
            if found.is_sure:
                return found
            if best is None or found.ratio > best.ratio:
                best = found
        return best

    def is_odd(self, pose: Pose, prior: CameraPrior) -> bool:
        """Whether a camera lies far from where telemetry, less what it was off by so far, has it."""
        off_m = self._strong_off_m()
        if len(off_m) < _LEAST_STRONG or not prior.knows_place:
            return False
        usual_m = np.median(off_m, axis=0)
        spread_m = SIGMA_PER_MEDIAN_DEVIATION * np.median(np.abs(off_m - usual_m), axis=0)
        sigma_m = np.maximum(np.clip(prior.position_sigma_m, 1.0, 1e3), spread_m)
        return bool(
            (np.abs(pose.translation_m - prior.position_m - usual_m) > _ODD * sigma_m).any()
        )

    # ---- inside -----------------------------------------------------------------------------------------------

    def _tries(self, sought: _Sought, features: Features) -> Iterator[Found]:
        """The places that a frame could have, beside its neighbours first."""
        # Pairs of the frame's points and the ground where placed neighbours show them.
        pairs, own = _NO_PAIRS, None
        for near in self._neighbours(sought):
            own = orb_features(sought.even, _FEATURES) if own is None else own
            if id(near) not in self._orb:
                alive = {id(each) for each in self._placed}
                self._orb = {key: each for key, each in self._orb.items() if key in alive}
                self._orb[id(near)] = orb_features(near.even, _FEATURES)
            old = self._orb[id(near)]
            both = match(own, old, None, 0.0)
            fitted = fit_homography(own.points_px[both[:, 0]], old.points_px[both[:, 1]], 3.0)
            if fitted is None or fitted[1].sum() < 2 * _LEAST_PAIRS:
                continue
            agree = np.flatnonzero(fitted[1])[:: max(1, int(fitted[1].sum()) // 40)]
            ground_m = apply_homography(near.site_from_image, old.points_px[both[agree, 1]])
            pairs = pairs.joined(_Pairs(own.points_px[both[agree, 0]], ground_m))
        beside = pairs
        found = self._near_neighbours(sought, features, beside) if len(beside) else None
        if found is not None:
            yield found
        for turn_rad in self._turns_rad():
            found = self._around(sought, features, turn_rad)
            if found is not None:
                yield found

    def _turns_rad(self) -> list[float]:
        turned = [each.turned_rad for each in self._placed if each.is_strong]
        quarters = [float(np.radians(each)) for each in _QUARTERS_DEG]
        if not turned:
            return quarters
        last = turned[-1]
        return [
            last,
            *(each for each in quarters if abs(np.angle(np.exp(1j * (each - last)))) > np.pi / 8),
        ]

    def _prior(self, sought: _Sought, pose: Pose) -> PosePrior:
        """What is known of the camera: telemetry, less what it was off by where this flight's frames were placed."""
        prior = sought.prior
        off_m = self._strong_off_m()
        sigma_m = np.clip(prior.position_sigma_m, 1.5, 1e3)
        sigma_rad = np.radians(np.clip(prior.attitude_sigma_deg, 1.0, 15.0))
        place_m = sought.pose.translation_m
        if len(off_m) >= _LEAST_STRONG and prior.knows_place:
            place_m = place_m + np.median(off_m, axis=0)
        else:
            sigma_m[2] += 0.03 * place_m[2]  # heights are above a ground that may lie elsewhere
        return PosePrior(Pose(pose.rotation, place_m), sigma_m, sigma_rad)

    def _strong_off_m(self) -> PointsM:
        """(N, 3) what telemetry was off by where frames of this flight were placed for sure, the last hundred."""
        off_m = np.array([each.off_m for each in self._placed if each.is_strong][-100:]).reshape(
            -1, 3
        )
        return off_m[np.isfinite(off_m).all(axis=1)]

    def _around(self, sought: _Sought, features: Features, turn_rad: float) -> Found | None:
        """The frame looked for around telemetry's place with the heading turned."""
        prior = sought.prior
        start = self._prior(sought, sought.pose).pose
        start = Pose(
            start.rotation @ rotation_from_vector(np.array([0.0, 0.0, turn_rad])),
            start.translation_m,
        )
        seen = self.map_features(sought.camera, start, _MARGIN)
        if seen is None:
            return None
        site_from_start, old = seen
        m_per_px = start.translation_m[2] / sought.camera.fx_px
        sigma_rad = np.radians(min(float(prior.attitude_sigma_deg[:2].max()), 15.0))
        reach_px = 3 * (
            float(np.clip(prior.position_sigma_m[:2].max(), 1.5, 50)) / m_per_px
            + np.tan(sigma_rad) * sought.camera.fx_px
        )
        pairs = match_learned(features, old, np.eye(3), reach_px)
        coarse = similar(
            features.points_px[pairs[:, 0]],
            old.points_px[pairs[:, 1]],
            _COARSE_PX,
            _MOST_SCALE,
        )
        if coarse is None:
            return None
        pose = pose_from_homography(site_from_start @ np.linalg.inv(coarse[0]), sought.camera)
        if pose is None:
            return None
        near = self._near(features, old, site_from_start, coarse[0])
        fit = fit_camera(
            near.image_px,
            near.ground_m,
            sought.camera,
            self._prior(sought, pose),
            start_px=20.0,
            band_px=_BAND_PX,
        )
        is_known = len(self._strong_off_m()) >= _LEAST_STRONG
        least_ratio = _LEAST_RATIO if is_known else _FIRST_RATIO
        return None if fit is None else self._judged(fit, near, least_ratio)

    def _near_neighbours(self, sought: _Sought, features: Features, beside: _Pairs) -> Found | None:
        """The frame placed by what it shares with placed frames and with the map around there."""
        found = fit_homography(beside.image_px, beside.ground_m, 3.0)
        if found is None:
            return None
        site_from_image: Matrix3 = np.linalg.inv(found[0]).astype(np.float64)
        pose = pose_from_homography(site_from_image, sought.camera)
        if pose is None:
            return None
        prior = self._prior(sought, pose)
        first = fit_camera(
            beside.image_px,
            beside.ground_m,
            sought.camera,
            prior,
            start_px=10.0,
            band_px=_BAND_PX,
        )
        seen = None if first is None else self.map_features(sought.camera, first.pose, 0.1)
        if first is None or seen is None:
            return None
        near = self._near(features, seen[1], seen[0], np.eye(3))
        joined = near.joined(beside)
        fit = fit_camera(
            joined.image_px,
            joined.ground_m,
            sought.camera,
            self._prior(sought, first.pose),
            start_px=10.0,
            band_px=_BAND_PX,
        )
        if fit is None:
            return None
        of_map = CameraFit(fit.pose, fit.site_from_image, fit.agree[: len(near)], fit.residual_px)
        chance = len(near) * (_BAND_PX / _NEAR_PX) ** 2
        return self._judged(of_map, near, 1 + _LEAST_SURPLUS / max(np.sqrt(chance), 1.0))

    def _judged(self, fit: CameraFit, pairs: _Pairs, least_ratio: float) -> Found | None:
        """The fit where more pairs agree than chance leaves in the band; none where hardly any do."""
        agree = fit.agree
        chance = len(pairs) * (_BAND_PX / _NEAR_PX) ** 2
        ratio = float(agree.sum() / max(chance, 1.0))
        if agree.sum() < _WEAK_PAIRS or ratio < _WEAK_RATIO:
            return None
        is_sure = bool(agree.sum() >= _LEAST_PAIRS and ratio >= least_ratio)
        return Found(fit, pairs.image_px[agree], pairs.ground_m[agree], ratio, is_sure)

    def _near(
        self, features: Features, old: Features, site_from_old: Matrix3, new_from_old: Matrix3
    ) -> _Pairs:
        pairs = match_learned(features, old, new_from_old, _NEAR_PX)
        return _Pairs(
            features.points_px[pairs[:, 0]],
            apply_homography(site_from_old, old.points_px[pairs[:, 1]]),
        )

    def map_features(
        self, camera: Camera, pose: Pose, margin: float
    ) -> tuple[Matrix3, Features] | None:
        """site_from_image of a frame at this pose, and the map's learned features there, in that frame's pixels."""
        try:
            site_from_image = site_from_image_homography(camera, pose)
        except GeometryError:
            return None
        width, height = camera.width_px, camera.height_px
        spare = np.round(np.array([width, height]) * margin)
        image_from_large = shifted(-spare[0], -spare[1])
        centre = site_from_image @ np.array([camera.cx_px, camera.cy_px, 1.0])
        if centre[2] <= 0:
            return None
        grid_from_site = self._site_grid.grid_from_site_affine(centre[:2] / centre[2], 50.0)
        rgb, known = self._reference.seen_from(
            grid_from_site @ site_from_image @ image_from_large,
            int(width + 2 * spare[0]),
            int(height + 2 * spare[1]),
        )
        if not known.any():
            return None
        found = learned_features(filled(gray_from_rgb(rgb), known), _MAP_POINTS)
        found = known_only(found, known, _RIM_PX)
        return site_from_image, Features(LEARNED, found.points_px - spare, found.descriptors)

    def _neighbours(self, sought: _Sought) -> Iterator[_Placed]:
        """The nearest placed frames that may show some of the same ground."""
        if not self._placed:
            return
        away_m = np.array(
            [
                np.linalg.norm(each.place_m[:2] - sought.pose.translation_m[:2])
                for each in self._placed
            ]
        )
        reach_m = sought.camera.width_px / sought.camera.fx_px * sought.pose.translation_m[2]
        for index in np.argsort(away_m, kind="stable")[:_NEIGHBOURS]:
            if away_m[index] < reach_m:
                yield self._placed[index]
