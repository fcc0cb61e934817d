"""Telemetry against the cameras that the pictures gave: how wrong it was, and the whole flight corrected by it."""

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from sorvolo.geometry.arrays import Floats, Mask
from sorvolo.geometry.pose import Pose
from sorvolo.geometry.summary import SIGMA_PER_MEDIAN_DEVIATION
from sorvolo.survey.corrected import Bias, TelemetryFaults
from sorvolo.survey.flight import CameraPrior

_FIXES_ALIKE = 1.5  # neighbouring fixes err alike: they are fewer than they look
_LEAST_SCALE = 0.01  # a change of scale that matters: 30 cm in 30 m of height
_OUTLYING_DEG = 15.0  # beside the flight's usual error: a map does not use angles that are so far off, either
_UNKNOWN = Bias(float("nan"), float("nan"), float("nan"))


def path_scale(priors: Sequence[CameraPrior], poses: Sequence[Pose]) -> Bias:
    """By how much the fixes' path is larger than the solved one: 1 where heights and fixes agree.

    The log's heights pull a map's scale when they are wrong, and the fixes' distances hold it: where the two contradict
    each other over a long path, the distances are right. Fixes that most others contradict are left out.
    """
    placed = [k for k, each in enumerate(priors) if each.knows_place]
    if len(placed) < 4:
        return _UNKNOWN
    fixes, seen = (
        np.array([each[k][:2] for k in placed]) @ np.array([1, 1j])
        for each in ([prior.position_m for prior in priors], [pose.translation_m for pose in poses])
    )
    kept = np.ones(len(placed), bool)
    scale, scatter = 1.0 + 0j, 0.0
    for _ in range(3):
        a, b = seen - seen[kept].mean(), fixes - fixes[kept].mean()
        scale = np.vdot(a[kept], b[kept]) / max(float(np.vdot(a[kept], a[kept]).real), 1e-9)
        miss = np.abs(b - scale * a)
        scatter = float(np.sqrt(np.mean(miss[kept] ** 2) / 2))
        kept = miss <= 3 * max(SIGMA_PER_MEDIAN_DEVIATION * float(np.median(miss)), 1e-6)
    reach = float(np.sqrt(np.sum(np.abs(seen[kept] - seen[kept].mean()) ** 2)))
    return Bias(float(abs(scale)), _FIXES_ALIKE * scatter / max(reach, 1e-6), scatter)


def rescaled(poses: Sequence[Pose], scale: Bias) -> list[Pose]:
    """The cameras with the fixes' scale, about the middle of their ground, where it is surely another than theirs."""
    if not np.isfinite(scale.value) or abs(scale.value - 1) < max(3 * scale.sigma, _LEAST_SCALE):
        return list(poses)
    middle_m = np.append(np.mean([each.translation_m[:2] for each in poses], axis=0), 0.0)
    return [Pose(each.rotation, middle_m + scale.value * (each.translation_m - middle_m)) for each in poses]


def telemetry_faults(
    priors: Sequence[CameraPrior], poses: Sequence[Pose], clock_s: Bias, scale: Bias, *, knows_height: bool
) -> TelemetryFaults:
    """How far telemetry's cameras, at the corrected clock, were off from the solved ones of the same frames.

    `poses` have the fixes' scale (`rescaled`), whose uncertainty is that of the heights. `knows_height`: telemetry's
    heights count from something that is taken for the ground; else they do not show it.
    An error that all fixes share does not show in the pictures: `position_m` has the scatter alone.
    """
    turned = np.array([_turn(prior.rotation, pose) for prior, pose in zip(priors, poses)]).reshape(-1, 3)
    knows_heading = np.array([np.isfinite(each.attitude_sigma_deg[2]) for each in priors], bool)
    placed = np.array([each.knows_place for each in priors], bool)
    moved = np.array([prior.position_m - pose.translation_m for prior, pose in zip(priors, poses)]).reshape(-1, 3)
    scatter_m = _together([_bias(moved[placed, k]) for k in range(2)]).scatter / float(np.sqrt(2))
    outlying, outlying_deg = _outlying(turned, knows_heading)
    return TelemetryFaults(
        clock_s, _bias(-turned[knows_heading, 2]), _together([_bias(turned[knows_heading, k]) for k in range(2)]),
        _height(moved[placed, 2], poses, scale) if knows_height else _UNKNOWN,
        Bias(0.0, float("nan"), scatter_m), outlying, outlying_deg,
    )


def corrected_poses(
    times_s: Sequence[float], priors: Sequence[CameraPrior], key_s: Sequence[float], key_priors: Sequence[CameraPrior],
    key_poses: Sequence[Pose],
) -> list[Pose]:
    """The cameras at any moments between the solved frames, by telemetry and what it was off at these frames.

    `priors` are telemetry's cameras at `times_s`, `key_priors` those at the solved frames' times `key_s`; between two
    of these the correction changes evenly.
    """
    turns = np.array([_turn(pose.rotation, Pose(prior.rotation, pose.translation_m))
                      for prior, pose in zip(key_priors, key_poses)])
    shifts = np.array([pose.translation_m - prior.position_m for prior, pose in zip(key_priors, key_poses)])
    poses = []
    for time_s, prior in zip(times_s, priors):
        turn, shift = (np.array([np.interp(time_s, key_s, each[:, k]) for k in range(3)]) for each in (turns, shifts))
        rotation = Rotation.from_rotvec(np.radians(turn)).as_matrix() @ prior.rotation
        poses.append(Pose(_orthonormal(rotation), prior.position_m + shift))
    return poses


def even_times_s(key_s: Sequence[float], step_s: float) -> list[float]:
    """Moments from the first solved frame to the last, so far apart."""
    return [float(each) for each in np.arange(min(key_s), max(key_s) + step_s / 2, step_s)]


def _turn(rotation: Floats, pose: Pose) -> Floats:
    """(3,) the turn about east, north and up that takes the pose's rotation to this one, degrees."""
    return np.degrees(Rotation.from_matrix(rotation @ pose.rotation.T).as_rotvec())


def _outlying(turned_deg: Floats, knows_heading: Mask) -> tuple[tuple[int, ...], float]:
    """Which frames' angles are far beside what the flight's usually are off, and by how much in the median, deg.

    A compass that hangs, or a strip whose pictures are turned by half a turn, hides behind the flight's median.
    """
    rows = np.flatnonzero(knows_heading)
    if not len(rows):
        return (), 0.0
    beside_deg = np.linalg.norm(turned_deg[rows] - np.median(turned_deg[rows], axis=0), axis=1)
    beside_deg = np.minimum(beside_deg, 360.0 - beside_deg)
    far = beside_deg > _OUTLYING_DEG
    return tuple(rows[far].tolist()), float(np.median(beside_deg[far])) if far.any() else 0.0


def _height(errors_m: Floats, poses: Sequence[Pose], scale: Bias) -> Bias:
    """The bias of heights; a scale that is wrong by a share makes them wrong by that share."""
    found = _bias(errors_m)
    usual_m = float(np.median([each.translation_m[2] for each in poses]))
    shared_m = usual_m * scale.sigma if np.isfinite(scale.sigma) else 0.0
    return Bias(found.value, float(np.hypot(found.sigma, shared_m)), found.scatter)


def _together(parts: Sequence[Bias]) -> Bias:
    """What errs in two directions, as one length."""
    rows = np.array([[each.value, each.sigma, each.scatter] for each in parts])
    return Bias(*(float(each) for each in np.linalg.norm(rows, axis=0)))


def _bias(values: Floats) -> Bias:
    """The median, its uncertainty and the scatter about it; angles of a flight lie far from the turn of the circle."""
    if not len(values):
        return _UNKNOWN
    middle = float(np.median(values))
    scatter = SIGMA_PER_MEDIAN_DEVIATION * float(np.median(np.abs(values - middle)))
    return Bias(middle, 1.2533 * scatter / float(np.sqrt(len(values))), scatter)


def _orthonormal(rotation: Floats) -> Floats:
    left, _, right = np.linalg.svd(rotation)
    return np.asarray(left @ right, np.float64)
