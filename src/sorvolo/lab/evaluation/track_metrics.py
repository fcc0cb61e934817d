"""How well objects were found: reported ones matched with true ones, counted, and their places measured."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from sorvolo.geometry.arrays import Floats, Matrix3, frozen
from sorvolo.geometry.homography import apply_homography
from sorvolo.survey.objects import CLASSES
from sorvolo.tracking.association import least_cost

_REACH_M = 2.0  # a found object may lie so far from the true one, the map's own shift taken out
_OTHER_CLASS_M = 1.0  # so much farther a true object of another class seems
_APART = 1e6  # the cost of a pair that cannot be


@dataclass(frozen=True, eq=False)
class ObjectCounts:
    """Of one class or of all: true objects that had to be found, those found, those found under the right class.

    `twice` are reported objects beside one that is found already, `false` those where nothing is. What needed not be
    found (hardly seen, or hidden) is no error either way.
    """

    must_find: int
    found: int
    named_right: int
    twice: int
    false: int


@dataclass(frozen=True, eq=False)
class FlightObjects:
    """One flight's objects against the truth.

    `rms_m` and `p95_m` are distances of the places as they lie, `own_rms_m` without the map's own shift, which is
    `map_shift_m`. `within_two_sigma` is the share of single-axis errors under twice the stated sigma (0.954 if that is
    honest and errors are normal). `count_error` is reported less true, as a share of the true ones. `moving_right`
    counts the found ones that are rightly reported as moving or standing. `length_error_m` is the median error of the
    longer side. NaN: nothing to measure.
    """

    flight: str
    by_class: Mapping[str, ObjectCounts]
    all: ObjectCounts
    count_error: float
    rms_m: float
    p95_m: float
    own_rms_m: float
    map_shift_m: float
    within_two_sigma: float
    sigma_median_m: float
    length_error_m: float
    moving: int
    moving_right: int
    missed: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class JudgedObject:
    """A true or a found object; of a true one `place_m` is where it was in the middle of the flight."""

    name: str
    label: str
    place_m: Floats
    velocity_m_s: Floats
    length_m: float
    sigma_m: float = math.nan
    last_seen_ns: int = 0
    must_find: bool = True

    def __post_init__(self) -> None:
        for name in ("place_m", "velocity_m_s"):
            object.__setattr__(self, name, frozen(getattr(self, name)))

    @property
    def moves(self) -> bool:
        """Whether it moves."""
        return bool(np.any(self.velocity_m_s))


@dataclass(frozen=True, eq=False)
class ObjectMatch:
    """Found and true ones in pairs; found ones beside a true one that has its pair (`twice`), or beside nothing."""

    pairs: tuple[tuple[JudgedObject, JudgedObject], ...]
    twice: tuple[JudgedObject, ...]
    false: tuple[JudgedObject, ...]


def match_objects(
    found: Sequence[JudgedObject],
    true: Sequence[JudgedObject],
    middle_ns: int,
    map_from_truth: Matrix3,
) -> ObjectMatch:
    """Pair found and true ones by their distances without the map's own shift, `map_from_truth` (3, 3).

    `middle_ns` is the time at which true ones are at their `place_m`.
    """
    if not found or not true:
        return ObjectMatch((), (), tuple(found))
    every = [(one, other) for one in found for other in true]
    apart_m = np.hypot(*_offsets_m(every, middle_ns, map_from_truth).T).reshape(
        len(found), len(true)
    )
    differs = np.array([one.label != other.label for one, other in every]).reshape(apart_m.shape)
    cost = np.where(apart_m <= _REACH_M, apart_m + _OTHER_CLASS_M * differs, _APART)
    rows, columns = least_cost(cost)
    pairs = tuple(
        (found[row], true[column])
        for row, column in zip(rows, columns)
        if cost[row, column] < _APART
    )
    return ObjectMatch(pairs, *_unpaired(found, pairs, (apart_m <= _REACH_M).any(axis=1)))


def score_objects(
    flight: str,
    found: Sequence[JudgedObject],
    true: Sequence[JudgedObject],
    middle_ns: int,
    map_from_truth: Matrix3,
    map_shift_m: float,
) -> FlightObjects:
    """The numbers of one flight; `map_from_truth` takes true places to where the map shows them."""
    match = match_objects(found, true, middle_ns, map_from_truth)
    pairs = match.pairs
    offsets_m = _offsets_m(pairs, middle_ns, np.eye(3))
    distances_m = np.hypot(*offsets_m.T)
    counted = [each for each in true if each.must_find]
    within, sigma_median_m = _within_two_sigma(pairs, offsets_m)
    return FlightObjects(
        flight,
        {name: _counts(name, counted, match) for name in CLASSES},
        _counts(None, counted, match),
        _count_error(found, counted, match),
        _rms(distances_m),
        float(np.percentile(distances_m, 95)) if len(pairs) else math.nan,
        _rms(np.hypot(*_offsets_m(pairs, middle_ns, map_from_truth).T)),
        map_shift_m,
        within,
        sigma_median_m,
        _median(
            [
                abs(one.length_m - other.length_m)
                for one, other in pairs
                if not math.isnan(one.length_m)
            ]
        ),
        sum(other.moves for _, other in pairs),
        sum(one.moves == other.moves for one, other in pairs),
        _missed(counted, match),
    )


def middle_of(outline_m: Floats) -> Floats:
    """(2,) the middle of the box around an outline, (N, 2)."""
    return np.asarray((outline_m.min(axis=0) + outline_m.max(axis=0)) / 2, np.float64)


def frames_over(outline_m: Floats, map_from_truth: Matrix3, outlines_m: Floats) -> int:
    """How many frames' outlines on the map, (N, 4, 2), hold the middle of a true outline."""
    place_m = apply_homography(map_from_truth, middle_of(outline_m)[None])[0]
    return sum(
        cv2.pointPolygonTest((each - place_m).astype(np.float32), (0.0, 0.0), False) > 0
        for each in outlines_m
    )


def _unpaired(
    found: Sequence[JudgedObject],
    pairs: Sequence[tuple[JudgedObject, JudgedObject]],
    is_near: NDArray[np.bool_],
) -> tuple[tuple[JudgedObject, ...], tuple[JudgedObject, ...]]:
    """Found ones without a pair: those beside a true one, by `is_near` (found,), and those beside nothing."""
    taken = {id(one) for one, _ in pairs}
    left = [(each, near) for each, near in zip(found, is_near) if id(each) not in taken]
    return tuple(each for each, near in left if near), tuple(
        each for each, near in left if not near
    )


def _within_two_sigma(
    pairs: Sequence[tuple[JudgedObject, JudgedObject]], offsets_m: Floats
) -> tuple[float, float]:
    """The share of single-axis errors under twice the stated sigma, and the median of these; NaN without any."""
    stated = [
        (offset_m, one.sigma_m)
        for offset_m, (one, _) in zip(offsets_m, pairs)
        if math.isfinite(one.sigma_m)
    ]
    within = [abs(error_m) <= 2 * sigma_m for offset_m, sigma_m in stated for error_m in offset_m]
    return float(np.mean(within)) if within else math.nan, _median(
        [sigma_m for _, sigma_m in stated]
    )


def _count_error(
    found: Sequence[JudgedObject], counted: Sequence[JudgedObject], match: ObjectMatch
) -> float:
    optional = sum(not other.must_find for _, other in match.pairs)
    return (len(found) - optional - len(counted)) / len(counted) if counted else math.nan


def _missed(counted: Sequence[JudgedObject], match: ObjectMatch) -> tuple[str, ...]:
    hit = {id(other) for _, other in match.pairs}
    return tuple(f"{each.label} {each.name}" for each in counted if id(each) not in hit)


def _place_m(true: JudgedObject, found: JudgedObject, middle_ns: int) -> Floats:
    """(2,) where the true object was when the found one was last seen."""
    return true.place_m + true.velocity_m_s * (
        (found.last_seen_ns - middle_ns) / 1e9 if true.moves else 0.0
    )


def _offsets_m(
    pairs: Sequence[tuple[JudgedObject, JudgedObject]], middle_ns: int, map_from_truth: Matrix3
) -> Floats:
    """(N, 2) how far the found ones lie from the true ones, those moved as the map lies."""
    places_m = np.array([_place_m(other, one, middle_ns) for one, other in pairs]).reshape(-1, 2)
    return np.array([one.place_m for one, _ in pairs]).reshape(-1, 2) - apply_homography(
        map_from_truth, places_m
    )


def _counts(name: str | None, counted: Sequence[JudgedObject], match: ObjectMatch) -> ObjectCounts:
    """Those of a class; None: of all."""

    def of(each: JudgedObject) -> bool:
        return name is None or each.label == name

    hits = [(one, other) for one, other in match.pairs if other.must_find and of(other)]
    return ObjectCounts(
        sum(map(of, counted)),
        len(hits),
        sum(one.label == other.label for one, other in hits),
        sum(map(of, match.twice)),
        sum(map(of, match.false)),
    )


def _rms(distances_m: Floats) -> float:
    return float(np.sqrt(np.mean(distances_m**2))) if len(distances_m) else math.nan


def _median(values: Sequence[float]) -> float:
    return float(np.median(values)) if values else math.nan
