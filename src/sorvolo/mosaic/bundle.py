"""The mathematics of the pose graph: transfer residuals over level ground, their derivatives, one robust solve.

A keyframe is a 6-DoF camera over the plane up = 0. A pixel of the old keyframe of a link is cast to the ground and
projected into the new one; the miss in pixels is the residual. Residuals are in pixels, not in metres: in metres
the whole map would gain by shrinking to a point.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from sorvolo.geometry.arrays import Floats, Mask, Rows
from sorvolo.geometry.pose import rotation_from_vector
from sorvolo.mosaic.normal_equations import NormalEquations

SHARED = (
    "log_focal",
    "radial",
    "altitude_offset_m",
    "east_offset_m",
    "north_offset_m",
    "boresight_x_rad",
    "boresight_y_rad",
    "boresight_z_rad",
)
"""Unknowns that all keyframes of a flight share: focal length (log of its scale), the first radial distortion that
the calibration left over, the constant offsets of the altitude's zero and of GPS against the map, and the constant
turn of the camera, about its own axes, against the attitude that telemetry states (mounting, gimbal, compass)."""


ROBUST_SIGMAS = 3.0  # of the Cauchy loss
LINKS_AT_ONCE = 256  # some megabytes of derivatives
_STEPS_AS_ONE = 4  # of the whole map at once, before its cameras move one by one


@dataclass(frozen=True, eq=False)
class Nodes:
    """The unknown cameras, N of them, and what telemetry reports of each (infinite sigma: nothing)."""

    rotations: Floats  # (N, 3, 3) site_from_camera
    centres_m: Floats  # (N, 3)
    prior_centres_m: Floats  # (N, 3)
    prior_sigma_m: Floats  # (N, 3)
    prior_rotations: Floats  # (N, 3, 3)
    prior_sigma_rad: Floats  # (N, 3) about the camera's own axes
    own: NDArray[
        np.bool_
    ]  # (N,) bool: of the flight being mapped; the others are the known map and never move


@dataclass(frozen=True, eq=False)
class Pairs:
    """Matched points of L links, K pairs each (padded; weight 0), in focal lengths from the optical centre."""

    old: Rows  # (L,) node index
    new: Rows  # (L,)
    old_ideal: Floats  # (L, K, 2)
    new_ideal: Floats  # (L, K, 2)
    weight: Floats  # (L, K)
    focal_px: Floats  # (L,) of the new keyframe
    sigma_px: Floats  # (L,) across the parallax
    sigma_relief_m: Floats  # (L,) height of things above the ground, from what residuals along the parallax show

    def of(self, chosen: Rows | slice) -> "Pairs":
        """The pairs of some links only."""
        return Pairs(*(getattr(self, name)[chosen] for name in self.__dataclass_fields__))

    def batches(self) -> "Iterator[Pairs]":
        """See `Linked`."""
        for first in range(0, len(self.old), LINKS_AT_ONCE):
            yield self.of(slice(first, first + LINKS_AT_ONCE))


class Linked(Protocol):
    """The links of a solve, L of them, between nodes `old` and `new`, (L,) each."""

    @property
    def old(self) -> Rows:
        """(L,) node index."""

    @property
    def new(self) -> Rows:
        """(L,) node index."""

    def batches(self) -> Iterator[Pairs]:
        """Some links after the others, so few at once that their derivatives stay small, however long the flight."""


@dataclass(frozen=True, eq=False)
class Ground:
    """Image points whose place in the site is known, M of them: marks of control points, matches with a base map."""

    node: Rows  # (M,) node index
    ideal: Floats  # (M, 2) in focal lengths from the optical centre
    place_m: Floats  # (M, 3)
    focal_px: Floats  # (M,)
    sigma_px: Floats  # (M,) of the mark
    sigma_m: Floats  # (M,) of the place

    def among(self, nodes: Rows) -> "Ground":
        """The points of some nodes, sorted, which are counted from 0 as they are listed."""
        if not len(self.node):
            return self
        theirs = np.isin(self.node, nodes)
        picked = Ground(*(getattr(self, name)[theirs] for name in self.__dataclass_fields__))
        return replace(picked, node=np.searchsorted(nodes, picked.node))


NO_GROUND = Ground(
    np.zeros(0, int), np.zeros((0, 2)), np.zeros((0, 3)), np.zeros(0), np.zeros(0), np.zeros(0)
)


@dataclass(frozen=True, eq=False)
class GroundRows:
    """Misses (M, 2) in px, derivatives by the camera (M, 2, 6) and by focal length and distortion (M, 2, 2).

    `sigma_px` (M,) holds the mark's and the place's errors together; `seen` (M,) is False behind the camera.
    """

    residual_px: Floats
    by_camera: Floats
    by_shared: Floats
    sigma_px: Floats
    seen: Mask


@dataclass(frozen=True, eq=False)
class Linearised:
    """Residuals (L, K, 2) in px, derivatives by the old, the new camera (L, K, 2, 6) and the shared ones (L, K, 2, 2).

    A camera's six are turn (left, rad, site axes) and shift (m). `parallax` (L, K, 2) is the px that a point moves per
    metre of height; `seen` (L, K) is False where the geometry breaks down.
    """

    residual_px: Floats
    by_old: Floats
    by_new: Floats
    by_shared: Floats
    parallax: Floats
    seen: Mask


def linearise(nodes: Nodes, pairs: Pairs, shared: Floats) -> Linearised:
    """Transfer every pair from the old to the new camera over the ground."""
    log_focal, radial = shared[0], shared[1]
    old_own, new_own = nodes.own[pairs.old], nodes.own[pairs.new]
    rotation_old, rotation_new = nodes.rotations[pairs.old], nodes.rotations[pairs.new]
    centre_old = nodes.centres_m[pairs.old][:, None]
    centre_new = nodes.centres_m[pairs.new][:, None]
    focal_old = np.where(old_own, np.exp(-log_focal), 1.0)[:, None, None]
    focal_new = np.where(new_own, np.exp(log_focal), 1.0)[:, None, None]
    r2_old = (pairs.old_ideal**2).sum(-1, keepdims=True) * old_own[:, None, None]
    r2_new = (pairs.new_ideal**2).sum(-1, keepdims=True) * new_own[:, None, None]

    ideal_old = pairs.old_ideal * (1 + radial * r2_old) * focal_old
    ray = ideal_old @ rotation_old[:, :, :2].transpose(0, 2, 1) + rotation_old[:, None, :, 2]
    down = np.where(ray[..., 2] < -1e-3, ray[..., 2], -1e-3)[..., None]
    slope = ray / down
    height = centre_old[..., 2:]
    ground = centre_old - height * slope
    offset = ground - centre_new
    local = offset @ rotation_new
    depth = np.where(local[..., 2] > 1e-3, local[..., 2], 1e-3)[..., None]
    image = local[..., :2] / depth
    focal_px = pairs.focal_px[:, None, None]
    residual = focal_px * (focal_new * image - pairs.new_ideal * (1 + radial * r2_new))
    seen = (ray[..., 2] < -1e-3) & (local[..., 2] > 1e-3)

    # px per metre of ground, (L, K, 2, 3)
    scale = (focal_px * focal_new / depth)[..., None]
    across = rotation_new.transpose(0, 2, 1)[:, None]
    by_ground = scale * (across[..., :2, :] - image[..., None] * across[..., 2:, :])
    parallax = np.einsum("lkij,lkj->lki", by_ground, slope)
    by_centre_old = by_ground.copy()
    by_centre_old[..., 2] -= parallax
    by_ray = by_centre_old * (-height / down)[..., None]
    by_old = np.concatenate([_times_cross(by_ray, -ray), by_centre_old], axis=-1)
    by_new = np.concatenate([_times_cross(by_ground, offset), -by_ground], axis=-1)

    turned = by_ray @ rotation_old[:, None, :, :2]
    by_focal = -np.einsum("lkij,lkj->lki", turned, ideal_old) * old_own[:, None, None]
    by_focal = by_focal + focal_px * focal_new * image * new_own[:, None, None]
    by_radial = np.einsum("lkij,lkj->lki", turned, pairs.old_ideal * r2_old * focal_old)
    by_radial = by_radial - focal_px * pairs.new_ideal * r2_new
    by_shared = np.stack([by_focal, by_radial], axis=-1)
    return Linearised(residual, by_old, by_new, by_shared, parallax, seen)


def linearise_ground(nodes: Nodes, ground: Ground, shared: Floats) -> GroundRows:
    """Project known places into their cameras."""
    log_focal, radial = shared[0], shared[1]
    rotation, offset = nodes.rotations[ground.node], ground.place_m - nodes.centres_m[ground.node]
    local = np.einsum("mji,mj->mi", rotation, offset)
    seen = local[:, 2] > 1e-3
    depth = np.where(seen, local[:, 2], 1e-3)[:, None]
    image = local[:, :2] / depth
    focal_px = ground.focal_px[:, None] * np.exp(log_focal)
    r2 = (ground.ideal**2).sum(-1, keepdims=True)
    residual = focal_px * image - ground.focal_px[:, None] * ground.ideal * (1 + radial * r2)
    across = rotation.transpose(0, 2, 1)
    by_place = (focal_px / depth)[..., None] * (across[:, :2] - image[..., None] * across[:, 2:])
    by_camera = np.concatenate([_times_cross(by_place, offset), -by_place], axis=-1)
    by_shared = np.stack([focal_px * image, -ground.focal_px[:, None] * ground.ideal * r2], axis=-1)
    sigma_px = np.hypot(ground.sigma_px, ground.sigma_m * focal_px[:, 0] / depth[:, 0])
    return GroundRows(residual, by_camera, by_shared, sigma_px, seen)


def whiten(line: Linearised, pairs: Pairs) -> Floats:
    """(L, K, 2, 2) matrices that turn residuals into sigmas: loose along the parallax, tight across it.

    A point at height z above the ground is off by z times the parallax; with a spread of heights sigma_relief_m the
    covariance is sigma_px^2 I + sigma_relief_m^2 parallax parallax^T. No unknown per point is needed.
    """
    length = np.linalg.norm(line.parallax, axis=-1)
    along = line.parallax / np.maximum(length, 1e-9)[..., None]
    sigma = pairs.sigma_px[:, None]
    loose = 1 / np.sqrt(sigma**2 + (pairs.sigma_relief_m[:, None] * length) ** 2)
    outer = along[..., :, None] * along[..., None, :]
    return (1 / sigma)[..., None, None] * (np.eye(2) - outer) + loose[..., None, None] * outer


@dataclass(frozen=True, eq=False)
class Solution:
    """Where a solve ended; `equations` and `position` let the caller ask for covariances."""

    nodes: Nodes
    shared: Floats
    equations: NormalEquations
    position: Rows  # (N,) place of each node in it, -1 for those held


def solve(
    nodes: Nodes,
    pairs: Linked,
    shared: Floats,
    shared_sigma: Floats,
    free: Mask,
    iterations: int,
    ground: Ground = NO_GROUND,
) -> Solution:
    """Levenberg-Marquardt with a Cauchy loss over the free nodes, (N,) bool, and the shared unknowns.

    `shared_sigma` (8,) is each shared unknown's prior sigma about 0; 0 holds it at its present value.
    """
    damping = 1e-6
    position = np.full(len(free), -1)
    position[free] = np.arange(int(free.sum()))
    problem = _Problem(pairs, ground, shared_sigma, position)
    if iterations and free.sum() > 2 and np.array_equal(free, nodes.own):
        nodes, shared = _moved_as_one(problem, nodes, shared)
    equations = _normal_equations(problem, nodes, shared)
    for _ in range(iterations):
        step = equations.factorised(damping).solve(equations.gradient())
        moved, moved_shared = _advance(nodes, shared, step, problem.position)
        trial = _normal_equations(problem, moved, moved_shared)
        if trial.cost > equations.cost * (1 + 1e-9) or not np.isfinite(trial.cost):
            damping = max(damping * 30, 1e-4)
            if damping > 1e3:
                break
            continue
        gain = equations.cost - trial.cost
        nodes, shared, equations = moved, moved_shared, trial
        damping = max(damping / 10, 1e-9)
        if gain < 1e-5 * equations.cost + 1e-9:
            break
    return Solution(nodes, shared, equations, problem.position)


@dataclass(frozen=True, eq=False)
class _Problem:
    """What stays the same during a solve."""

    pairs: Linked
    ground: Ground
    shared_sigma: Floats  # (8,)
    position: Rows  # (N,) of each node among those that move, -1 for those held


def _moved_as_one(problem: _Problem, nodes: Nodes, shared: Floats) -> tuple[Nodes, Floats]:
    """All own cameras shifted, turned about the vertical and scaled as one, and the shared unknowns, to the least cost.

    Links hardly notice such a motion, so telemetry alone decides it. Camera by camera it is a long way: straight steps
    along a turn stretch the map, and Levenberg-Marquardt allows only short ones. Here the turn is exact.
    """
    equations = _normal_equations(problem, nodes, shared)
    for _ in range(_STEPS_AS_ONE):
        middle_m = nodes.centres_m[nodes.own].mean(axis=0) * [1, 1, 0]
        # (6 n + 8, 12) how n cameras' six unknowns, and the shared ones, follow a shift east and
        # north, a turn, a scale. `offsets_m` (n, 3): the cameras from the point on the ground
        # about which they turn and grow.
        offsets_m = nodes.centres_m[nodes.own] - middle_m
        count = len(offsets_m)
        motions = np.zeros((count, 6, 4))
        motions[:, 3, 0] = motions[:, 4, 1] = motions[:, 2, 2] = 1.0
        motions[:, 3, 2], motions[:, 4, 2] = -offsets_m[:, 1], offsets_m[:, 0]
        motions[:, 3:, 3] = offsets_m
        basis = np.zeros((6 * count + len(SHARED), 4 + len(SHARED)))
        basis[: 6 * count, :4] = motions.reshape(-1, 4)
        basis[6 * count :, 4:] = np.eye(len(SHARED))
        among, pull = basis.T @ (equations.matrix() @ basis), basis.T @ equations.gradient()
        step = np.linalg.lstsq(among, pull, rcond=None)[0]
        trial_nodes, trial_shared = _move_as_one(nodes, middle_m, step[:4]), shared + step[4:]
        trial = _normal_equations(problem, trial_nodes, trial_shared)
        if not trial.cost < equations.cost * (1 - 1e-4):
            break
        nodes, shared, equations = trial_nodes, trial_shared, trial
    return nodes, shared


def _move_as_one(nodes: Nodes, middle_m: Floats, step: Floats) -> Nodes:
    turn = rotation_from_vector(np.array([[0.0, 0.0, step[2]]]))[0]
    shift_m = np.array([step[0], step[1], 0.0])
    rotations, centres_m = nodes.rotations.copy(), nodes.centres_m.copy()
    rotations[nodes.own] = turn @ rotations[nodes.own]
    centres_m[nodes.own] = (
        middle_m + shift_m + np.exp(step[3]) * (centres_m[nodes.own] - middle_m) @ turn.T
    )
    return replace(nodes, rotations=rotations, centres_m=centres_m)


def _normal_equations(problem: _Problem, nodes: Nodes, shared: Floats) -> NormalEquations:
    index = np.flatnonzero(problem.position >= 0)  # in the order of their positions
    into = NormalEquations(len(index), len(SHARED))
    if len(problem.pairs.old):
        _add_links(into, nodes, problem.pairs, shared, problem.position)
    if len(problem.ground.node):
        rows = linearise_ground(nodes, problem.ground, shared)
        residual = rows.residual_px / rows.sigma_px[:, None]
        squared = (residual**2).sum(-1) / ROBUST_SIGMAS**2
        into.cost += float((rows.seen * np.log1p(squared)).sum()) * ROBUST_SIGMAS**2
        root = np.sqrt(rows.seen / (1 + squared))[:, None]
        jacobian = (
            np.concatenate([rows.by_camera, rows.by_shared], axis=-1) / rows.sigma_px[:, None, None]
        )
        into.add(
            jacobian * root[..., None], residual * root, (problem.position[problem.ground.node],)
        )
    blocks, coupling = np.zeros((len(index), 6, 6)), np.zeros((len(index), 6, len(SHARED)))
    own, shared_pull = np.zeros((len(SHARED), len(SHARED))), np.zeros(len(SHARED))
    # place: GPS belongs to the camera, up to the offsets that the flight shares
    root = 1 / nodes.prior_sigma_m[index]
    miss = nodes.centres_m[index] + shared[[3, 4, 2]] - nodes.prior_centres_m[index]
    white = miss * root
    squared = (
        np.column_stack([(white[:, :2] ** 2).sum(1), (white[:, :2] ** 2).sum(1), white[:, 2] ** 2])
        / ROBUST_SIGMAS**2
    )
    into.cost += float((np.log1p(squared[:, 1]) + np.log1p(squared[:, 2])).sum()) * ROBUST_SIGMAS**2
    information = root**2 / (1 + squared)
    blocks[:, [3, 4, 5], [3, 4, 5]] = information
    coupling[:, [3, 4, 5], [3, 4, 2]] = information
    own[[3, 4, 2], [3, 4, 2]] = information.sum(axis=0)
    shift_pull = -information * miss
    shared_pull[[3, 4, 2]] = shift_pull.sum(axis=0)
    # attitude, about the camera's own axes
    rotation = nodes.rotations[index]
    relative = nodes.prior_rotations[index].transpose(0, 2, 1) @ rotation
    error = Rotation.from_matrix(relative).as_rotvec() - shared[5:]
    root = 1 / nodes.prior_sigma_rad[index]
    squared = (error * root) ** 2 / ROBUST_SIGMAS**2
    into.cost += float(np.log1p(squared).sum()) * ROBUST_SIGMAS**2
    information = root**2 / (1 + squared)
    blocks[:, :3, :3] = (rotation * information[:, None, :]) @ rotation.transpose(0, 2, 1)
    turn_pull = -np.einsum("nij,nj->ni", rotation, information * error)
    coupling[:, :3, 5:] = -rotation * information[:, None, :]
    own[[5, 6, 7], [5, 6, 7]] = information.sum(axis=0)
    shared_pull[5:] = (information * error).sum(axis=0)
    into.add_cameras(blocks, coupling, np.concatenate([turn_pull, shift_pull], axis=1))
    into.add_shared(own, shared_pull)
    held = problem.shared_sigma <= 0
    prior = np.where(held, 1e12, 1 / np.maximum(problem.shared_sigma, 1e-12) ** 2)
    into.add_shared(np.diag(prior), np.where(held, 0.0, -prior * shared))
    into.hold_shared(held)
    into.cost += float(np.where(held, 0.0, prior * shared**2).sum())
    return into


def _add_links(
    into: NormalEquations,
    nodes: Nodes,
    pairs: Linked,
    shared: Floats,
    position: Rows,
) -> None:
    for some in pairs.batches():
        line = linearise(nodes, some, shared)
        white = whiten(line, some)
        residual = np.einsum("lkij,lkj->lki", white, line.residual_px)
        weight = some.weight * line.seen
        squared = (residual**2).sum(-1) / ROBUST_SIGMAS**2
        into.cost += float((weight * np.log1p(squared)).sum()) * ROBUST_SIGMAS**2
        root = np.sqrt(weight / (1 + squared))[..., None]
        residual = (residual * root).reshape(len(some.old), -1)
        jacobian = np.concatenate([line.by_old, line.by_new, line.by_shared], axis=-1)
        jacobian = (white @ jacobian * root[..., None]).reshape(
            len(some.old), residual.shape[1], -1
        )
        into.add(jacobian, residual, (position[some.old], position[some.new]))


def _advance(nodes: Nodes, shared: Floats, step: Floats, position: Rows) -> tuple[Nodes, Floats]:
    index = np.flatnonzero(position >= 0)
    steps = step[: 6 * len(index)].reshape(-1, 6)
    rotations, centres = nodes.rotations.copy(), nodes.centres_m.copy()
    turn = steps[:, :3]
    size = np.linalg.norm(turn, axis=1, keepdims=True)
    turn = turn * np.minimum(1.0, 0.3 / np.maximum(size, 1e-12))
    u, _, vt = np.linalg.svd(rotation_from_vector(turn) @ rotations[index])
    rotations[index] = u @ vt  # rounding would add up over thousands of steps
    shift = steps[:, 3:].copy()
    limit = 0.5 * np.abs(centres[index, 2])
    # a camera may not dive through the ground in one step
    shift[:, 2] = np.clip(shift[:, 2], -limit, limit)
    centres[index] += shift
    return replace(nodes, rotations=rotations, centres_m=centres), shared + step[6 * len(index) :]


def _times_cross(rows: Floats, vector: Floats) -> Floats:
    """`rows` (..., 2, 3) times the cross-product matrix of `vector` (..., 3)."""
    return np.cross(rows, vector[..., None, :])
