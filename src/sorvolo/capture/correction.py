"""Telemetry against the cameras that the pictures gave: how wrong it was, and the whole flight corrected by it."""

from collections.abc import Sequence
from dataclasses import replace
from math import inf

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from sorvolo.geometry.arrays import Floats, Mask, PointsM
from sorvolo.geometry.pose import Pose
from sorvolo.geometry.summary import SIGMA_PER_MEDIAN_DEVIATION
from sorvolo.survey.corrected import Bias, PathFit, TelemetryFaults
from sorvolo.survey.flight import CameraPrior

_FIXES_ALIKE = 1.5  # neighbouring fixes err alike: they are fewer than they look
_LEAST_FIXES = 4  # a similarity has four unknowns; by choice
_MOST_ROUNDS = 20  # of a search that comes nearer with each; most need five
_FAR_SIGMAS = 6.0  # from its fix: of thousands of frames chance leaves none there, and wandering fixes hardly any
_UNKNOWN = Bias(float("nan"), float("nan"), float("nan"))


# beside the flight's usual error: a map does not use angles that are so far off, either
_COMPASS_OUTLYING_DEG = 15.0
_COMPASS_AGREEING = 2 / 3  # share of the frames that must be off alike; by choice


_COURSE_AROUND_S = 1.0  # to both sides of a moment: over them a course is taken
_COURSE_HOVERING_M_S = 0.5  # below, a course is that of the gusts


def path_fit(priors: Sequence[CameraPrior], poses: Sequence[Pose], clock_sigma_s: float) -> PathFit:
    """The similarity that takes the solved path to the fixes'.

    The log's heights pull a map's scale when they are wrong, its compass the map's direction; the fixes' distances and
    directions hold both: where the two contradict each other over a long path, the fixes are right. Fixes that most
    others contradict are left out. What a clock that is off by `clock_sigma_s` does to the fit counts in its sigmas.
    """
    placed = [k for k, each in enumerate(priors) if each.knows_place]
    if len(placed) < _LEAST_FIXES:
        return PathFit(_UNKNOWN, _UNKNOWN)
    fixes, seen, speeds = (
        np.array([each[k][:2] for k in placed]) @ np.array([1, 1j])
        for each in (
            [prior.position_m for prior in priors],
            [pose.translation_m for pose in poses],
            [prior.velocity_m_s for prior in priors],
        )
    )
    kept = _usual_misses(_least_misses(seen, fixes))
    factor, scatter, a = 1.0 + 0j, 0.0, seen
    for _ in range(3):
        a, b = seen - seen[kept].mean(), fixes - fixes[kept].mean()
        factor = np.vdot(a[kept], b[kept]) / _square(a[kept])
        miss = np.abs(b - factor * a)
        scatter = float(np.sqrt(np.sum(miss[kept] ** 2) / max(2 * int(kept.sum()) - 4, 1)))
        kept = _usual_misses(miss)
    size = float(abs(factor))
    if size < 1e-6:
        return PathFit(_UNKNOWN, _UNKNOWN)
    by_chance = _FIXES_ALIKE * scatter / float(np.sqrt(_square(a[kept])))
    by_clock = clock_sigma_s * np.vdot(a[kept], speeds[kept]) / _square(a[kept]) / factor
    turn_sigma_deg = float(np.degrees(np.hypot(by_chance / size, by_clock.imag)))
    return PathFit(
        Bias(size, float(np.hypot(by_chance, size * by_clock.real)), scatter),
        Bias(float(np.degrees(np.angle(factor))), turn_sigma_deg),
    )


def fitted(poses: Sequence[Pose], path: PathFit) -> list[Pose]:
    """The cameras in the fixes' scale and direction, about the middle of their ground, where these surely differ."""
    middle_m = np.append(np.mean([each.translation_m[:2] for each in poses], axis=0), 0.0)
    turn = Rotation.from_euler("z", path.sure_turn_deg, degrees=True).as_matrix()
    return [
        Pose(
            turn @ each.rotation,
            middle_m + path.sure_scale * turn @ (each.translation_m - middle_m),
        )
        for each in poses
    ]


def telemetry_faults(
    priors: Sequence[CameraPrior],
    poses: Sequence[Pose],
    clock_s: Bias,
    path: PathFit,
    *,
    knows_height: bool,
) -> TelemetryFaults:
    """How far telemetry's cameras, at the corrected clock, were off from the solved ones of the same frames.

    `poses` have the fixes' scale and direction (`fitted`); how well these are known counts in heights and headings.
    The compass is measured against the direction of the fixes' path, since it may have turned the map itself.
    `knows_height`: telemetry's heights count from something that is taken for the ground; else they do not show it.
    An error that all fixes share does not show in the pictures: `position_m` has the scatter alone.
    """
    knows_heading = np.array([_knows_heading(each) for each in priors], bool)
    off_deg = np.array(
        [_heading_and_tilt(prior.rotation, pose) for prior, pose in zip(priors, poses)]
    ).reshape(-1, 3)[knows_heading]
    placed = np.array([each.knows_place for each in priors], bool)
    moved = np.array(
        [prior.position_m - pose.translation_m for prior, pose in zip(priors, poses)]
    ).reshape(-1, 3)
    scatter_m = _together([_bias(moved[placed, k]) for k in range(2)]).scatter / float(np.sqrt(2))
    beside_deg = _beside_usual(off_deg)
    near = beside_deg <= _COMPASS_OUTLYING_DEG
    turned = np.zeros(len(priors), bool)
    turned[knows_heading] = ~near
    # (N,) how far each frame's place lies beside where fixes usually put it, m; 0 where near, or
    # nothing is known. `moved_m` (N, 3) are the fixes less the places. Far is beyond
    # `_FAR_SIGMAS`, along an axis, of what fixes and heights state or scatter by, whichever is
    # more, from what they usually are off.
    stated_m = np.array([each.position_sigma_m for each in priors]).reshape(-1, 3)
    beside_m = np.zeros_like(moved)
    far = np.zeros(len(priors), bool)
    for axis in range(3):
        known = np.isfinite(stated_m[:, axis])
        usual = _bias(moved[known, axis])
        beside_m[known, axis] = np.abs(moved[known, axis] - usual.value)
        far[known] |= beside_m[known, axis] > _FAR_SIGMAS * np.maximum(
            stated_m[known, axis], usual.scatter
        )
    apart_m = np.where(far, np.linalg.norm(beside_m, axis=1), 0.0)
    is_misplaced = (apart_m > 0) & turned
    misplaced, apart = np.flatnonzero(is_misplaced), np.flatnonzero((apart_m > 0) & ~turned)
    outlying = turned & ~is_misplaced
    tilt_deg = _together([_bias(off_deg[near, k]) for k in (1, 2)])
    return TelemetryFaults(
        clock_s,
        _heading(off_deg[:, 0], near, path),
        tilt_deg if _agree(near) else replace(tilt_deg, sigma=inf),
        _height(moved[placed, 2], poses, path.scale) if knows_height else _UNKNOWN,
        Bias(0.0, float("nan"), scatter_m),
        path,
        tuple(np.flatnonzero(outlying).tolist()),
        float(np.median(beside_deg[outlying[knows_heading]])) if outlying.any() else 0.0,
        tuple(misplaced.tolist()),
        tuple(apart_m[misplaced].tolist()),
        tuple(apart.tolist()),
        tuple(apart_m[apart].tolist()),
    )


def corrected_poses(
    times_s: Sequence[float],
    priors: Sequence[CameraPrior],
    key_s: Sequence[float],
    key_priors: Sequence[CameraPrior],
    key_poses: Sequence[Pose],
) -> list[Pose]:
    """The cameras at any moments between the solved frames, by telemetry and what it was off at these frames.

    `priors` are telemetry's cameras at `times_s`, `key_priors` those at the solved frames' times `key_s`; between two
    of these the correction changes evenly. Where telemetry knows no heading or no place, at the moment or at the solved
    frame before or after it, the solved cameras themselves are interpolated: what stands there is a guess.
    """
    knows_heading, knows_place = (
        _known_around(
            times_s, [knows(each) for each in priors], key_s, [knows(each) for each in key_priors]
        )
        for knows in (_knows_heading, lambda each: each.knows_place)
    )
    solved = np.array([each.rotation for each in key_poses])
    turns = _turning(key_s, solved @ np.array([each.rotation.T for each in key_priors]), times_s)
    rotations = np.where(
        knows_heading[:, None, None],
        turns @ np.array([each.rotation for each in priors]),
        _turning(key_s, solved, times_s),
    )
    solved_m = np.array([each.translation_m for each in key_poses])
    shifts_m = _moving(
        key_s, solved_m - np.array([each.position_m for each in key_priors]), times_s
    )
    places_m = np.where(
        knows_place[:, None],
        np.array([each.position_m for each in priors]) + shifts_m,
        _moving(key_s, solved_m, times_s),
    )
    left, _, right = np.linalg.svd(rotations)  # orthonormal again
    return [Pose(rotation, place_m) for rotation, place_m in zip(left @ right, places_m)]


def headings_deg(
    stated_deg: Floats,
    compass: Bias,
    times_s: Sequence[float],
    poses: Sequence[Pose],
) -> list[float]:
    """The aircraft's heading at these moments, clockwise from north: as stated, (N,), less what the compass was surely
    off; NaN there: the course over ground, that of the nearest moment where it hovers.

    A flight that hovers all along is given the direction of its pictures' top.
    """
    known = np.isfinite(stated_deg)
    if known.any():
        error_deg = compass.value if compass.is_significant else 0.0
        pointing = np.exp(1j * np.radians(stated_deg[known] - error_deg))
    else:
        path_m = np.array([each.translation_m[:2] for each in poses])
        pointing, known = _courses(np.asarray(times_s), path_m)
    if not known.any():
        known = np.ones(len(poses), bool)
        pointing = np.array([-each.rotation[1, 1] - 1j * each.rotation[0, 1] for each in poses])
    # (count,) for each row the place in `known`, which is in order, of the row nearest to
    # it
    known = np.flatnonzero(known)
    count = len(poses)
    after = np.minimum(np.searchsorted(known, np.arange(count)), len(known) - 1)
    before = np.maximum(after - 1, 0)
    is_before = np.abs(known[before] - np.arange(count)) < np.abs(known[after] - np.arange(count))
    nearest = np.where(is_before, before, after)
    return [float(each) for each in np.degrees(np.angle(pointing))[nearest] % 360.0]


def even_times_s(key_s: Sequence[float], step_s: float) -> list[float]:
    """Moments from the first solved frame to the last, so far apart."""
    return [float(each) for each in np.arange(min(key_s), max(key_s) + step_s / 2, step_s)]


def _knows_heading(prior: CameraPrior) -> bool:
    return bool(np.isfinite(prior.attitude_sigma_deg[2]))


def _known_around(
    times_s: Sequence[float],
    known: Sequence[bool],
    key_s: Sequence[float],
    key_known: Sequence[bool],
) -> Mask:
    """(N,) whether something is known at each moment, and at the solved frames before and after it."""
    after = np.clip(np.searchsorted(key_s, times_s), 0, len(key_s) - 1)
    before = np.maximum(after - 1, 0)
    at_keys = np.array(key_known, bool)
    return np.array(known, bool) & at_keys[before] & at_keys[after]


def _turning(key_s: Sequence[float], rotations: Floats, times_s: Sequence[float]) -> Floats:
    """(N, 3, 3) rotations, (K, 3, 3) at `key_s`, at other moments, by the shortest turns; the ends' beyond these."""
    if len(key_s) == 1:
        return np.repeat(rotations, len(times_s), axis=0)
    within_s = np.clip(times_s, key_s[0], key_s[-1])
    return np.asarray(
        Slerp(key_s, Rotation.from_matrix(rotations))(within_s).as_matrix(), np.float64
    )


def _moving(key_s: Sequence[float], places_m: PointsM, times_s: Sequence[float]) -> PointsM:
    """(N, 3) places, (K, 3) at `key_s`, at other moments, on straight lines; the ends' beyond these."""
    return np.column_stack([np.interp(times_s, key_s, places_m[:, k]) for k in range(3)])


def _courses(times_s: Floats, path_m: PointsM) -> tuple[NDArray[np.complex128], Mask]:
    """The velocity over ground, north and east as a complex number, m/s, at those moments of a path, (N, 2), where the
    aircraft moves; and which these are, (N,)."""
    before, after = (
        np.searchsorted(times_s, times_s + side * _COURSE_AROUND_S) for side in (-1, 1)
    )
    after = np.minimum(after, len(times_s) - 1)
    passed_s = np.maximum(times_s[after] - times_s[before], 1e-6)
    velocity = (path_m[after] - path_m[before]) @ np.array([1j, 1]) / passed_s
    moves = np.abs(velocity) >= _COURSE_HOVERING_M_S
    return velocity[moves], moves


def _least_misses(seen: NDArray[np.complex128], fixes: NDArray[np.complex128]) -> Floats:
    """(N,) how far the similarity with the least sum of distances takes places from their fixes, by reweighted squares.

    One frame of a few that lies far aside bends the least squares so much that it no longer stands out itself.
    """
    miss = np.ones(len(seen))
    for _ in range(_MOST_ROUNDS):
        weights = 1 / np.maximum(miss, 1e-3 * max(float(np.median(miss)), 1e-6))
        a, b = (each - np.average(each, weights=weights) for each in (seen, fixes))
        root = np.sqrt(weights)
        miss = np.abs(b - np.vdot(root * a, root * b) / _square(root * a) * a)
    return miss


def _usual_misses(miss: Floats) -> Mask:
    """(N,) the misses that are no outliers."""
    return miss <= 3 * max(SIGMA_PER_MEDIAN_DEVIATION * float(np.median(miss)), 1e-6)


def _square(numbers: NDArray[np.complex128]) -> float:
    """The sum of the squares of these numbers' sizes, never 0."""
    return max(float(np.vdot(numbers, numbers).real), 1e-9)


def _heading_and_tilt(rotation: Floats, pose: Pose) -> Floats:
    """(3,) how far a rotation is turned from the pose's: clockwise about the vertical, the rest about east and north,
    degrees."""
    turn = Rotation.from_matrix(rotation @ pose.rotation.T)
    _, _, about_up, real = turn.as_quat()
    about_up_rad = 2 * np.arctan2(about_up, real)
    tilt_rad = (turn * Rotation.from_euler("z", -about_up_rad)).as_rotvec()
    return np.degrees([-about_up_rad, *tilt_rad[:2]])


def _beside_usual(off_deg: Floats) -> Floats:
    """(N,) how far each frame's angles lie beside what the flight's usually are off, (N, 3), degrees.

    A compass that hangs, or a strip whose pictures are turned by half a turn, hides behind the flight's median.
    """
    if not len(off_deg):
        return np.zeros(0)
    heading_deg = _wrapped(off_deg[:, 0] - _usual_angle(off_deg[:, 0]))
    alike = np.abs(heading_deg) <= _COMPASS_OUTLYING_DEG
    return np.hypot(
        heading_deg, np.linalg.norm(off_deg[:, 1:] - np.median(off_deg[alike, 1:], axis=0), axis=1)
    )


def _usual_angle(angles_deg: Floats) -> float:
    """The median of those angles that most others are near, degrees; they may lie anywhere on the circle.

    Of two groups that are nearly as large, the one nearer to 0: a small error is likelier than half a turn.
    """
    ordered_deg = np.sort(angles_deg % 360.0)
    around_deg = np.concatenate([ordered_deg - 360.0, ordered_deg, ordered_deg + 360.0])
    first, last = (
        np.searchsorted(
            around_deg, ordered_deg + side * _COMPASS_OUTLYING_DEG, "left" if side < 0 else "right"
        )
        for side in (-1, 1)
    )
    large_deg = _wrapped(ordered_deg[2 * (last - first) >= np.max(last - first)])
    usual_deg = float(large_deg[np.argmin(np.abs(large_deg))])
    for _ in range(_MOST_ROUNDS):  # the first guess may lie at the edge of its group
        beside_deg = _wrapped(angles_deg - usual_deg)
        step_deg = float(np.median(beside_deg[np.abs(beside_deg) <= _COMPASS_OUTLYING_DEG]))
        usual_deg += step_deg
        if abs(step_deg) < 1e-9:
            break
    return usual_deg


def _wrapped(angles_deg: Floats) -> Floats:
    """The same angles from -180 to 180 degrees."""
    return (angles_deg + 180.0) % 360.0 - 180.0


def _agree(near: Mask) -> bool:
    """Whether so many frames' angles are off alike that one error can be stated for all."""
    return bool(len(near)) and float(near.mean()) >= _COMPASS_AGREEING


def _heading(off_deg: Floats, near: Mask, path: PathFit) -> Bias:
    """The compass's error by those frames that agree; its sigma is infinite where too few do, or fixes are too few."""
    if not len(off_deg):
        return _UNKNOWN
    usual_deg = _usual_angle(off_deg)
    found = _bias(_wrapped(off_deg[near] - usual_deg))
    value_deg, sigma_deg = usual_deg + found.value, inf
    if np.isfinite(path.turn_deg.value):
        value_deg += path.turn_deg.value - path.sure_turn_deg
        if _agree(near):
            sigma_deg = float(np.hypot(found.sigma, path.turn_deg.sigma))
    return Bias(float(_wrapped(np.asarray(value_deg))), sigma_deg, found.scatter)


def _height(errors_m: Floats, poses: Sequence[Pose], scale: Bias) -> Bias:
    """The bias of heights; a scale that is wrong by a share makes them wrong by that share.

    Where fixes do not show the scale, the map has it from these very heights: then the sigma is infinite.
    """
    found = _bias(errors_m)
    usual_m = float(np.median([each.translation_m[2] for each in poses]))
    shared_m = usual_m * scale.sigma if np.isfinite(scale.sigma) else inf
    return Bias(found.value, float(np.hypot(found.sigma, shared_m)), found.scatter)


def _together(parts: Sequence[Bias]) -> Bias:
    """What errs in two directions, as one length."""
    rows = np.array([[each.value, each.sigma, each.scatter] for each in parts])
    return Bias(*(float(each) for each in np.linalg.norm(rows, axis=0)))


def _bias(values: Floats) -> Bias:
    """The median, its uncertainty and the scatter about it."""
    if not len(values):
        return _UNKNOWN
    middle = float(np.median(values))
    scatter = SIGMA_PER_MEDIAN_DEVIATION * float(np.median(np.abs(values - middle)))
    return Bias(middle, 1.2533 * scatter / float(np.sqrt(len(values))), scatter)
