"""Bundle adjustment: cameras with six freedoms, points, and what all pictures share of the lens, solved together.

Triggs et al. 2000: Levenberg-Marquardt on a Cauchy loss; the points are eliminated first (Schur complement), so that a
step costs one small system of the cameras. Sums over points are NumPy's and SciPy's: no solver of C++ is needed
(docs/decisions/0023-heights.md).
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve
from scipy.sparse import block_array, bsr_array, csr_matrix, eye_array, kron

from sorvolo.geometry.arrays import Floats, Mask, PointsM, Rows
from sorvolo.geometry.pose import rotation_from_vector

_SHARED = 5  # logarithm of the focal scale, left-over distortion of third and fifth order, optical centre x and y
_SIX = np.arange(6)


_ROBUST_SIGMAS = 2.0  # where the Cauchy loss bends
_FOCAL_SIGMA = 0.02  # relative, of the focal length that the map's flight settled on
_RADIAL_SIGMA = (0.02, 0.02)  # of third and fifth order
_CENTRE_SIGMA = 0.01  # of the optical centre, in focal lengths
_ITERATIONS = 25  # at most; by choice
LEAST_SIGMA_PX = 0.1  # of a feature's place, however well all fit


@dataclass(frozen=True)
class AdjustmentSettings:
    """How observations and priors are weighed."""

    sigma_px: float = 0.5  # of a feature's place
    # of all the map's attitudes in common: they lean where the ground is not level
    attitude_sigma_deg: float = 3.0
    lens_freedom: float = 1.0  # times the usual sigmas of the lens
    is_steady: bool = False  # cameras have one tilt in common: each turns about the vertical alone


@dataclass(frozen=True, eq=False)
class Scene:
    """N cameras, P points, M observations.

    `rotations` (N, 3, 3) site_from_camera, `centres_m` (N, 3), `focal_px` (N,); `points_m` (P, 3); `view` and `point`
    (M,) rows; `seen` (M, 2) undistorted points as normalised rays (x / z, y / z). `shared` (5,): a point is
    seen at exp(shared[0]) x / z = seen (1 + shared[1] |seen|^2 + shared[2] |seen|^4) + shared[3:].
    """

    rotations: Floats
    centres_m: PointsM
    focal_px: Floats
    points_m: PointsM
    view: Rows
    point: Rows
    seen: Floats
    shared: Floats

    def residuals_px(self) -> Floats:
        """(M, 2) predicted minus seen, px; NaN behind a camera."""
        offset = self.points_m[self.point] - self.centres_m[self.view]
        local = np.einsum("mji,mj->mi", self.rotations[self.view], offset)
        with np.errstate(divide="ignore", invalid="ignore"):
            image = np.where(local[:, 2:] > 1e-6, local[:, :2] / local[:, 2:], np.nan)
        return self.focal_px[self.view, None] * (np.exp(self.shared[0]) * image - self.corrected())

    def corrected(self) -> Floats:
        """(M, 2) where the points would be seen by the lens as it was found."""
        # (M, 2) normalised rays without the left-over distortion and shift of `shared` (see
        # Scene)
        square = (self.seen**2).sum(axis=1, keepdims=True)
        return (
            self.seen * (1 + self.shared[1] * square + self.shared[2] * square**2) + self.shared[3:]
        )

    def keeping(self, observations: Mask) -> "Scene":
        """The scene with these observations, (M,) bool, only, and the points that two of them still see."""
        count = np.bincount(self.point[observations], minlength=len(self.points_m))
        observations = observations & (count[self.point] >= 2)
        used, point = np.unique(self.point[observations], return_inverse=True)
        return replace(
            self,
            points_m=self.points_m[used],
            view=self.view[observations],
            point=point,
            seen=self.seen[observations],
        )


@dataclass(frozen=True, eq=False)
class Priors:
    """What is known of the cameras beside the pictures: fixes (N, 3) with sigmas (N, 3; inf: none), attitudes."""

    fixes_m: PointsM
    sigmas_m: Floats
    rotations: Floats


@dataclass(frozen=True, eq=False)
class _Normal:
    """One linearisation: the cameras' system without the points, and what gives the points back."""

    cost: float
    cameras: Floats  # (6 N + 5, 6 N + 2)
    gradient: Floats  # (6 N + 5,)
    coupling: bsr_array  # (6 N + 6, 3 P), in blocks of (6, 3); the last row is 0
    points: Floats  # (P, 3, 3)
    point_gradient: Floats  # (P, 3)


def triangulate(scene: Scene) -> PointsM:
    """(P, 3) the points nearest to the rays of their observations; NaN where rays are almost parallel."""
    rays = np.concatenate(
        [scene.corrected() / np.exp(scene.shared[0]), np.ones((len(scene.seen), 1))], axis=1
    )
    rays = np.einsum("mij,mj->mi", scene.rotations[scene.view], rays)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    count = len(scene.points_m)
    left = _summed(across.reshape(-1, 9), scene.point, count).reshape(-1, 3, 3)
    right = _summed(
        np.einsum("mij,mj->mi", across, scene.centres_m[scene.view]), scene.point, count
    )
    # the least eigenvalue is the spread of the rays' directions: 1e-5 is about 0.3 degrees between two
    weak = np.linalg.eigvalsh(left)[:, 0] < 1e-5
    points = np.asarray(
        np.linalg.solve(np.where(weak[:, None, None], np.eye(3), left), right[..., None])[..., 0]
    )
    points[weak] = np.nan
    return points


def adjust(scene: Scene, priors: Priors, settings: AdjustmentSettings) -> Scene:
    """The scene that observations and priors agree best on."""
    damping = 1e-4
    normal = _linearise(scene, priors, settings)
    for _ in range(_ITERATIONS):
        # The steps of the cameras and shared unknowns, (6 N + 5,), and of the points, (P, 3).
        damped = normal.points * (1 + damping * np.eye(3)) + 1e-9 * np.eye(3)
        inverse: Floats = np.asarray(np.linalg.inv(damped), np.float64)
        reduced, pulled = _eliminated(normal, inverse)
        system = normal.cameras - reduced
        system[np.diag_indices_from(system)] += damping * np.diag(normal.cameras) + 1e-9
        gradient = normal.gradient - pulled
        if settings.is_steady:
            free = _steady(scene)
            cameras = free @ _solution(free.T @ (free.T @ system).T, free.T @ gradient)
        else:
            cameras = _solution(system, gradient)
        points = np.einsum(
            "pij,pj->pi",
            inverse,
            normal.point_gradient - (normal.coupling.T @ np.append(cameras, 0)).reshape(-1, 3),
        )
        moved = _advance(scene, *(cameras, points))
        trial = _linearise(moved, priors, settings)
        if not trial.cost <= normal.cost:
            damping *= 4
            if damping > 1e4:
                break
            continue
        gain = normal.cost - trial.cost
        scene, normal, damping = moved, trial, max(damping / 3, 1e-8)
        if gain < 1e-5 * normal.cost:
            break
    return scene


def _solution(system: Floats, gradient: Floats) -> Floats:
    """The step that a system gives; where it is not positive definite, the least that fits it best."""
    try:
        return np.asarray(cho_solve(cho_factor(system), gradient))
    except LinAlgError:
        return np.asarray(np.linalg.lstsq(system, gradient, rcond=None)[0])


def _steady(scene: Scene) -> csr_matrix:
    """(6 N + 5, 4 N + 7) the steps of cameras with one tilt from its own two, each camera's turn and place, the lens."""
    across = np.linalg.svd(scene.rotations[:1, 2])[2][
        1:
    ]  # (2, 3) about what is level in all of them
    tilts = np.einsum("nij,kj->nik", scene.rotations, across)
    tilts = np.concatenate([tilts, np.zeros_like(tilts)], axis=1).reshape(-1, 2)
    own = kron(eye_array(len(scene.rotations)), np.eye(6)[:, 2:])
    return block_array([[tilts, own, None], [None, None, eye_array(_SHARED)]]).tocsr()


def height_deviations(scene: Scene, priors: Priors, settings: AdjustmentSettings) -> Floats:
    """(P,) what the heights of the points err, one sigma in m, by the error of cameras and lens.

    What all heights err in common is left out: the points' mean height.
    """
    normal = _linearise(scene, priors, settings)
    inverse: Floats = np.asarray(np.linalg.inv(normal.points + 1e-9 * np.eye(3)), np.float64)
    count = len(inverse)
    rows, columns = np.repeat(np.arange(count), 3), np.arange(3 * count)
    up = csr_matrix((inverse[:, 2].ravel(), (rows, columns)), shape=(count, 3 * count))
    moved = -(up @ normal.coupling.T).toarray()[:, :-1]
    moved -= moved.mean(axis=0)
    system = normal.cameras - _eliminated(normal, inverse)[0]
    half = np.linalg.solve(np.linalg.cholesky(system + 1e-9 * np.eye(len(system))), moved.T)
    return np.sqrt((half**2).sum(axis=0))


def matched_deviations(scene: Scene, priors: Priors, settings: AdjustmentSettings) -> Floats:
    """(P,) what the heights of the points err, one sigma in m, by the places of their features alone.

    The cameras count as known: what they err, all heights near a point err alike.
    """
    return np.sqrt(
        np.linalg.inv(_linearise(scene, priors, settings).points + 1e-9 * np.eye(3))[:, 2, 2]
    )


def _linearise(scene: Scene, priors: Priors, settings: AdjustmentSettings) -> _Normal:
    residual, by_camera, by_shared, by_point = _derivatives(scene)
    white = residual / settings.sigma_px
    squared = (white**2).sum(axis=1) / _ROBUST_SIGMAS**2
    usable = np.isfinite(squared)
    root = np.sqrt(np.where(usable, 1 / (1 + np.where(usable, squared, 0)), 0)) / settings.sigma_px
    cost = _ROBUST_SIGMAS**2 * float(np.log1p(np.where(usable, squared, 1e6)).sum())
    residual = np.where(usable[:, None], residual, 0.0) * root[:, None]
    by_camera, by_shared, by_point = (
        np.where(usable[:, None, None], each, 0.0) * root[:, None, None]
        for each in (by_camera, by_shared, by_point)
    )
    views, points = len(scene.centres_m), len(scene.points_m)
    size = 6 * views + _SHARED
    system, gradient = np.zeros((size, size)), np.zeros(size)
    own = _summed(_products(by_camera, by_camera), scene.view, views).reshape(-1, 6, 6)
    mixed = _summed(_products(by_camera, by_shared), scene.view, views).reshape(-1, 6, _SHARED)
    for number in range(views):
        at = slice(6 * number, 6 * number + 6)
        system[at, at], system[at, -_SHARED:] = own[number], mixed[number]
        system[-_SHARED:, at] = mixed[number].T
    system[-_SHARED:, -_SHARED:] = (
        _products(by_shared, by_shared).sum(axis=0).reshape(_SHARED, _SHARED)
    )
    gradient[:-_SHARED] = -_summed(_pulls(by_camera, residual), scene.view, views).ravel()
    gradient[-_SHARED:] = -_pulls(by_shared, residual).sum(axis=0)
    cost += _add_priors(scene, priors, settings, system, gradient)
    # a tilt that all cameras share is what their optical centre would be
    centre_sigma = _CENTRE_SIGMA * (0.1 if settings.is_steady else 1.0)
    usual = np.array([_FOCAL_SIGMA, *_RADIAL_SIGMA, *2 * (centre_sigma,)])
    lens_sigma = settings.lens_freedom * usual
    system[-_SHARED:, -_SHARED:] += np.diag(1 / lens_sigma**2)
    gradient[-_SHARED:] -= scene.shared / lens_sigma**2
    cost += float(((scene.shared / lens_sigma) ** 2).sum())
    blocks = _summed(_products(by_point, by_point), scene.point, points).reshape(-1, 3, 3)
    point_gradient = -_summed(_pulls(by_point, residual), scene.point, points)
    shared_coupling = _summed(_products(by_shared, by_point), scene.point, points).reshape(
        -1, _SHARED, 3
    )
    # The lens counts as one more camera here: its block has a row of zeros, so that all blocks have one shape.
    order = np.argsort(scene.view, kind="stable")
    values = np.concatenate(
        [
            _products(by_camera, by_point).reshape(-1, 6, 3)[order],
            np.pad(shared_coupling, ((0, 0), (0, 1), (0, 0))),
        ]
    )
    columns = np.concatenate([scene.point[order], np.arange(points)])
    starts = np.cumsum([0, *np.bincount(scene.view, minlength=views), points])
    coupling = bsr_array((values, columns, starts), shape=(size + 1, 3 * points))
    return _Normal(cost, system, gradient, coupling, blocks, point_gradient)


def _derivatives(scene: Scene) -> tuple[Floats, Floats, Floats, Floats]:
    """Residuals (M, 2), px, and their derivatives: camera (M, 2, 6), shared (M, 2, 5), point (M, 2, 3)."""
    turn = scene.rotations[scene.view]
    offset = scene.points_m[scene.point] - scene.centres_m[scene.view]
    local = np.einsum("mji,mj->mi", turn, offset)
    depth = np.where(local[:, 2] > 1e-6, local[:, 2], np.nan)[:, None]
    image = local[:, :2] / depth
    focal = scene.focal_px[scene.view, None]
    scale, square = np.exp(scene.shared[0]), (scene.seen**2).sum(axis=1, keepdims=True)
    residual = focal * (scale * image - scene.corrected())
    across = turn.transpose(0, 2, 1)
    by_point = (focal * scale / depth)[..., None] * (
        across[:, :2] - image[..., None] * across[:, 2:]
    )
    by_turn = np.cross(by_point, offset[:, None, :])
    by_camera = np.concatenate([by_turn, -by_point], axis=2)
    shift = np.broadcast_to(-focal[..., None] * np.eye(2), (len(image), 2, 2))
    lens = np.stack(
        [focal * scale * image, -focal * scene.seen * square, -focal * scene.seen * square**2],
        axis=2,
    )
    by_shared = np.concatenate([lens, shift], axis=2)
    return residual, by_camera, by_shared, by_point


def _add_priors(
    scene: Scene, priors: Priors, settings: AdjustmentSettings, system: Floats, gradient: Floats
) -> float:
    """Add fixes and attitudes to the cameras' system; returns their cost."""
    known = np.isfinite(priors.sigmas_m) & np.isfinite(priors.fixes_m)
    sigma = np.where(known, priors.sigmas_m, 1.0)
    miss = np.where(known, scene.centres_m - np.where(known, priors.fixes_m, 0.0), 0.0)
    squared = (miss / sigma / 3.0) ** 2
    information = known / sigma**2 / (1 + squared)
    rows = 6 * np.arange(len(miss))[:, None] + _SIX
    place = rows[:, 3:]
    system[place, place] += information
    gradient[place] -= information * miss
    turned = scene.rotations @ priors.rotations.transpose(0, 2, 1)
    axis = (
        np.stack(
            [
                turned[:, 2, 1] - turned[:, 1, 2],
                turned[:, 0, 2] - turned[:, 2, 0],
                turned[:, 1, 0] - turned[:, 0, 1],
            ],
            axis=1,
        )
        / 2
    )
    weight = 1 / np.radians(settings.attitude_sigma_deg) ** 2
    system[rows[:, :3], rows[:, :3]] += weight
    gradient[rows[:, :3]] -= weight * axis
    return float(9.0 * np.log1p(squared)[known].sum() + weight * (axis**2).sum())


def _eliminated(normal: _Normal, inverse: Floats) -> tuple[Floats, Floats]:
    """What the points, their blocks (P, 3, 3) inverted, take from the cameras' system and from its gradient."""
    coupling = normal.coupling
    through = bsr_array(
        (coupling.data @ inverse[coupling.indices], coupling.indices, coupling.indptr),
        shape=coupling.shape,
    )
    taken = (through @ coupling.T).toarray()
    return taken[:-1, :-1], (through @ normal.point_gradient.ravel())[:-1]


def _advance(scene: Scene, cameras: Floats, points: Floats) -> Scene:
    steps = cameras[:-_SHARED].reshape(-1, 6)
    u, _, vt = np.linalg.svd(rotation_from_vector(steps[:, :3]) @ scene.rotations)
    return replace(
        scene,
        rotations=u @ vt,
        centres_m=scene.centres_m + steps[:, 3:],
        points_m=scene.points_m + points,
        shared=scene.shared + cameras[-_SHARED:],
    )


def _products(left: Floats, right: Floats) -> Floats:
    """(M, a * b) left^T right of each observation, (M, 2, a) and (M, 2, b)."""
    return (left.transpose(0, 2, 1) @ right).reshape(len(left), -1)


def _pulls(derivative: Floats, residual: Floats) -> Floats:
    return np.einsum("mki,mk->mi", derivative, residual)


def _summed(values: Floats, at: Rows, count: int) -> Floats:
    """(count, K) sums of the rows of `values`, (M, K), that belong to each place."""
    sums = csr_matrix((np.ones(len(at)), (at, np.arange(len(at)))), shape=(count, len(at)))
    return sums @ values
