"""A flight whose photos were laid on each other, found on the map as one: what each shows too weakly adds up."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from sorvolo.change.map_search import MapSearch
from sorvolo.geometry.arrays import (
    Floats,
    ImageGray,
    ImageRGB,
    Mask,
    Matrix3,
    PointsM,
    Rows,
    shrunk,
    size_within,
)
from sorvolo.geometry.camera import Camera
from sorvolo.geometry.homography import apply_homography, fit_similarity
from sorvolo.geometry.pose import Pose
from sorvolo.registration.features import gray_from_rgb, learned_features, match_learned
from sorvolo.survey.mosaic import Features

# How photos whose places beside each other are known are looked for on the map together; pixels are
# those of the photos, at most `side_px` wide.
_SIDE_PX = 1024  # longest side of a photo
_POINTS = 2048  # learned features of a photo, the strongest
_MARGIN = 0.1  # of a photo's size: map searched beyond each side
_REACH_PX = 73.0  # pairs of points lie so far apart at most (10 m from 100 m up) ...
_SHIFT_PX = 58.0  # ... and all photos in common: what GPS errs by on both dates
_MOST_SCALE = 0.1  # by which the flight, laid by its GPS, is larger or smaller than the map
_MOST_TURN_DEG = 10.0  # by which it is turned; both, as far as that moves its rim by the most shift
# of its ground, from the middle: less fits too many places within what GPS errs
_LEAST_RIM_PX = 146.0
_STEP_PX = 3.5  # at its rim, between scales and turns that are tried
_LEAST_LIKENESS = 0.7  # of a pair's descriptors: likeness beyond that is its vote
_GROUND_PX = 28.0  # side of the squares of ground that vote once for a shift
_CELL_PX = 1.2  # of the raster of shifts on which pairs vote
_SPREAD_PX = 2.5  # one sigma of what right pairs scatter: another light, and maps are distorted
# of the votes of one place over the mean one's: other ground leaves up to 7.2, ...
_LEAST_RATIO = 7.0
_LEAST_AGREE = 100  # ... of 40 pairs within the band: few in all stand out by chance
# of a photo's pairs on another place, and twice those on the flight's: it lies elsewhere
_OWN_SHARE = 0.25
_LEAST_SPREAD = 1.4  # times the squares that chance would leave; other ground has about one
_ROUNDS = 10  # of the least squares that follow, over the pairs within ...
_BAND_PX = 7.0  # ... this, about three sigmas


@dataclass(frozen=True, eq=False)
class PhotoFeatures:
    """The learned features of an undistorted photo, of `camera`'s size."""

    camera: Camera
    features: Features


@dataclass(frozen=True, eq=False)
class FlightFit:
    """Where a flight lies on a map: `map_from_flight` is a similarity (3, 3) of site metres. `ratio` is how many times
    the votes of the mean place it has, `agree` how many pairs agree with it, `spread` on how many times as many
    squares of ground as chance would leave pairs that agree, `residual_m` how far photos miss it by the mean of theirs
    (median). `elsewhere` are photos whose own pairs have them elsewhere: the flight is bent there."""

    map_from_flight: Matrix3
    ratio: float
    agree: int
    spread: float
    residual_m: float
    elsewhere: frozenset[int]


@dataclass(frozen=True, eq=False)
class _Pairs:
    """Ground of a flight, (N, 2), as its photos have it, with the map's that is most like it around; (N,) of which
    photo, and votes."""

    photo: Rows
    flight_m: PointsM
    map_m: PointsM
    votes: Floats

    @classmethod
    def joined(cls, parts: Sequence["_Pairs"]) -> "_Pairs":
        """Those of several photos."""
        return cls(
            *(np.concatenate([getattr(each, name) for each in parts]) for name in vars(parts[0]))
        )

    def of(self, rows: Rows) -> "_Pairs":
        """Some of them."""
        return _Pairs(*(each[rows] for each in vars(self).values()))


@dataclass(frozen=True, eq=False)
class _Raster:
    """Shifts in cells of `cell_m`: their middles along an axis (n,), and which are sought, (n, n)."""

    cell_m: float
    blur: float  # cells, one sigma
    middles_m: Floats
    is_sought: Mask

    @classmethod
    def of(cls, px_m: float) -> "_Raster":
        """That of pairs as far apart as they may be."""
        side, cell_m = (
            2 * int(np.ceil(_REACH_PX / _CELL_PX)),
            _CELL_PX * px_m,
        )
        middles_m: Floats = (np.arange(side, dtype=np.float64) - side // 2 + 0.5) * cell_m
        is_sought = np.hypot(*np.meshgrid(middles_m, middles_m)) < _SHIFT_PX * px_m
        return cls(cell_m, _SPREAD_PX / _CELL_PX, middles_m, is_sought)

    def most_voted(self, apart_m: PointsM, votes: Floats) -> tuple[Floats, float]:
        """The shift (2,) that most of the pairs, (N, 2) apart, vote for, and how many times the mean one's votes it
        has."""
        side = len(self.middles_m)
        cells = np.floor(apart_m / self.cell_m).astype(np.int64) + side // 2
        inside = ((cells >= 0) & (cells < side)).all(axis=1)
        of_cell = np.bincount(
            cells[inside, 0] * side + cells[inside, 1], votes[inside], side * side
        )
        smooth = cv2.GaussianBlur(
            of_cell.reshape(side, side), (0, 0), self.blur, borderType=cv2.BORDER_CONSTANT
        )
        east, north = np.unravel_index(
            int(np.argmax(np.where(self.is_sought, smooth, -1.0))), smooth.shape
        )
        mean = max(float(smooth[self.is_sought].mean()), 1e-9)
        return np.array([self.middles_m[east], self.middles_m[north]]), float(
            smooth[east, north]
        ) / mean


class FlightOnMap:
    """Looks for the photos of one flight on the map that `search` knows."""

    def __init__(self, search: MapSearch) -> None:
        self._search = search

    def features(self, image: ImageRGB, camera: Camera) -> PhotoFeatures:
        """What `find` needs of an undistorted photo, (H, W, 3)."""
        size = size_within(image, _SIDE_PX)
        gray: ImageGray = shrunk(gray_from_rgb(image), size)
        return PhotoFeatures(camera.resized(*size), learned_features(gray, _POINTS))

    def find(
        self, photos: Mapping[int, PhotoFeatures], poses: Mapping[int, Pose]
    ) -> FlightFit | None:
        """Where the flight lies on the map, by photos of it and where their cameras are beside each other (by index);
        None where no place has many more votes than chance leaves."""
        parts = [self._pairs(index, photo, poses[index]) for index, photo in photos.items()]
        seen = [each for each in parts if each is not None]
        if not seen:
            return None
        px_m = float(
            np.median(
                [
                    poses[index].translation_m[2] / each.camera.fx_px
                    for index, each in photos.items()
                ]
            )
        )
        pairs = _once(_Pairs.joined(seen), px_m)
        if _rim_m(pairs) < _LEAST_RIM_PX * px_m:
            return None
        started, ratio = _most_votes(pairs, px_m)
        if ratio < _LEAST_RATIO:
            return None
        fit = _refined(pairs, started, ratio, px_m)
        is_right = fit.agree >= _LEAST_AGREE and fit.spread >= _LEAST_SPREAD
        return fit if is_right else None

    def _pairs(self, index: int, photo: PhotoFeatures, pose: Pose) -> _Pairs | None:
        """What a photo shows of the map around where its pose puts it; None beside the map."""
        new = photo.features
        seen = self._search.map_features(photo.camera, pose, _MARGIN)
        if seen is None:
            return None
        site_from_image, old = seen
        pairs = match_learned(new, old, np.eye(3), _REACH_PX)
        ours, theirs = (np.asarray(each.descriptors, np.float32) for each in (new, old))
        likeness = np.einsum("nd,nd->n", ours[pairs[:, 0]], theirs[pairs[:, 1]])
        votes = likeness - _LEAST_LIKENESS
        kept = pairs[votes > 0]
        return _Pairs(
            np.full(len(kept), index),
            apply_homography(site_from_image, new.points_px[kept[:, 0]]),
            apply_homography(site_from_image, old.points_px[kept[:, 1]]),
            votes[votes > 0],
        )


def _once(pairs: _Pairs, px_m: float) -> _Pairs:
    """The likest pair of each piece of ground for each shift: overlapping photos, and ground that repeats itself, would
    vote again and again."""
    places = np.floor(pairs.flight_m / (_GROUND_PX * px_m))
    shifts = np.floor((pairs.map_m - pairs.flight_m) / (_SPREAD_PX * px_m))
    likest = np.argsort(-pairs.votes, kind="stable")
    _, first = np.unique(np.column_stack([places, shifts])[likest], axis=0, return_index=True)
    return pairs.of(np.sort(likest[first]))


def _rim_m(pairs: _Pairs) -> float:
    """How far from its middle the flight's ground reaches; but for a tenth of it."""
    arms_m = np.linalg.norm(pairs.flight_m - pairs.flight_m.mean(axis=0), axis=1)
    return float(np.percentile(arms_m, 90)) if len(arms_m) else 0.0


def _most_votes(pairs: _Pairs, px_m: float) -> tuple[Matrix3, float]:
    """The similarity, map_from_flight, that most votes fall to, and how many times those of the mean one it has."""
    middle_m = pairs.flight_m.mean(axis=0)
    arms_m = pairs.flight_m - middle_m
    rim_m = _rim_m(pairs)
    scales, turns = (
        _tried(min(most, _SHIFT_PX * px_m / rim_m), _STEP_PX * px_m / rim_m)
        for most in (_MOST_SCALE, float(np.radians(_MOST_TURN_DEG)))
    )
    raster = _Raster.of(px_m)
    best, ratio = np.eye(3), 0.0
    for scale in scales:
        for turn in turns:
            linear = np.array([[1 + scale, -turn], [turn, 1 + scale]])
            shift_m, own_ratio = raster.most_voted(
                pairs.map_m - middle_m - arms_m @ linear.T, pairs.votes
            )
            if own_ratio > ratio:
                ratio, best = own_ratio, np.eye(3)
                best[:2, :2], best[:2, 2] = linear, middle_m + shift_m - linear @ middle_m
    return best, ratio


def _tried(most: float, step: float) -> Floats:
    """Values from -most to most, about a step apart, 0 among them."""
    count = int(np.ceil(most / step))
    return np.linspace(-most, most, 2 * count + 1)


def _refined(pairs: _Pairs, started: Matrix3, ratio: float, px_m: float) -> FlightFit:
    """The similarity of the pairs that agree with the one that had most votes."""
    found, agree, miss_m = started, np.zeros(0, bool), np.zeros(0)
    for _ in range(_ROUNDS):
        miss_m = np.linalg.norm(apply_homography(found, pairs.flight_m) - pairs.map_m, axis=1)
        agree = miss_m < _BAND_PX * px_m
        if agree.sum() < _LEAST_AGREE:
            break
        found = fit_similarity(pairs.map_m[agree], pairs.flight_m[agree])
    return FlightFit(
        found,
        ratio,
        int(agree.sum()),
        _spread(pairs, agree, px_m),
        _photos_miss_m(pairs, found, agree),
        _elsewhere(pairs, found, px_m),
    )


def _elsewhere(pairs: _Pairs, map_from_flight: Matrix3, px_m: float) -> frozenset[int]:
    """The photos of which many pairs agree on another place than the flight's."""
    apart_m = apply_homography(map_from_flight, pairs.flight_m) - pairs.map_m
    beside = int(np.ceil(_REACH_PX / (2 * _BAND_PX)))
    edges_m = (
        np.arange(-beside - 0.5, beside + 1) * 2 * _BAND_PX * px_m
    )  # the flight's place is in the middle
    result = set()
    for photo in np.unique(pairs.photo):
        own_m = apart_m[pairs.photo == photo]
        counts, _, _ = np.histogram2d(own_m[:, 0], own_m[:, 1], bins=(edges_m, edges_m))
        if counts.max() > max(_OWN_SHARE * len(own_m), 2 * counts[beside, beside]):
            result.add(int(photo))
    return frozenset(result)


def _spread(pairs: _Pairs, agree: Mask, px_m: float) -> float:
    """Squares of ground with pairs that agree, over those that chance would leave some in: right ones lie all over the
    ground that stayed; ground that repeats itself, and is taken for what is beside it, lies in few places."""
    squares = np.floor(pairs.flight_m / (_GROUND_PX * px_m))
    _, of_pair, counts = np.unique(squares, axis=0, return_inverse=True, return_counts=True)
    by_chance = float((1 - (1 - (_BAND_PX / _REACH_PX) ** 2) ** counts).sum())
    return len(np.unique(of_pair.ravel()[agree])) / max(by_chance, 1.0)


def _photos_miss_m(pairs: _Pairs, map_from_flight: Matrix3, agree: Mask) -> float:
    """How far photos lie off by the mean of their own agreeing pairs, the median over them; NaN without any."""
    apart_m = apply_homography(map_from_flight, pairs.flight_m[agree]) - pairs.map_m[agree]
    counts = np.bincount(pairs.photo[agree])
    sums_m = (np.bincount(pairs.photo[agree], each) for each in apart_m.T)
    means_m = np.hypot(*sums_m) / np.maximum(counts, 1)
    return float(np.median(means_m[counts > 0])) if agree.any() else float("nan")
