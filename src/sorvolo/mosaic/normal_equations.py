"""The normal equations of a solve: gathered camera by camera and link by link, then solved."""

import numpy as np

from sorvolo.geometry.arrays import Floats, Mask, Rows
from sorvolo.mosaic.block_cholesky import SIDE, Elimination


class NormalEquations:
    """The information matrix and the gradient of some cameras' unknowns, six each, and of those that all share, last.

    The cameras, and which of them links tie, are those of the `elimination`. Terms of one camera are summed as they
    come, so that only what two cameras have in common grows with the links.
    """

    def __init__(self, elimination: Elimination, shared: int) -> None:
        self.cost = 0.0
        self._elimination = elimination
        cameras = elimination.count
        self._cameras, self._shared = np.zeros((cameras, SIDE, SIDE)), np.zeros((shared, shared))
        self._with_shared = np.zeros((cameras, SIDE, shared))
        self._pull, self._shared_pull = np.zeros((cameras, SIDE)), np.zeros(shared)
        self._between = np.zeros((elimination.ties, SIDE, SIDE))
        self._ties = 0  # so many of them have come

    def add(self, jacobian: Floats, residual: Floats, cameras: tuple[Rows, ...]) -> None:
        """Whitened, weighted rows: `jacobian` (n, r, w), `residual` (n, r).

        Its first columns belong to the one or two `cameras`, (n,) each, negative where the camera is held; the last to
        the first of the shared unknowns. Two cameras come in the order of the elimination's ties.
        """
        information = jacobian.transpose(0, 2, 1) @ jacobian
        pull = -np.einsum("nri,nr->ni", jacobian, residual)
        rest = slice(SIDE * len(cameras), None)
        few = jacobian.shape[2] - SIDE * len(cameras)
        for k, at in enumerate(cameras):
            here, free = slice(SIDE * k, SIDE * (k + 1)), at >= 0
            np.add.at(self._cameras, at[free], information[free, here, here])
            np.add.at(self._with_shared[:, :, :few], at[free], information[free, here, rest])
            np.add.at(self._pull, at[free], pull[free, here])
        if len(cameras) == 2:
            one, other = cameras
            both = (one >= 0) & (other >= 0)
            end = self._ties + int(both.sum())
            self._between[self._ties : end] = information[both, :SIDE, SIDE : 2 * SIDE]
            self._ties = end
        self._shared[:few, :few] += information[:, rest, rest].sum(axis=0)
        self._shared_pull[:few] += pull[:, rest].sum(axis=0)

    def add_cameras(self, blocks: Floats, with_shared: Floats, pull: Floats) -> None:
        """Terms of each camera: (n, 6, 6) of itself, (n, 6, shared) with the shared unknowns, (n, 6) the gradient."""
        self._cameras += blocks
        self._with_shared += with_shared
        self._pull += pull

    def add_shared(self, block: Floats, pull: Floats) -> None:
        """Terms of the shared unknowns alone: (shared, shared) and the gradient (shared,)."""
        self._shared += block
        self._shared_pull += pull

    def hold_shared(self, held: Mask) -> None:
        """Nothing pulls at these shared unknowns, (shared,)."""
        self._shared_pull[held] = 0.0

    @property
    def size(self) -> int:
        """Unknowns: 6 n + shared."""
        return self._pull.size + len(self._shared)

    def gradient(self) -> Floats:
        """(6 n + shared,)."""
        return np.concatenate([self._pull.ravel(), self._shared_pull])

    def times(self, vectors: Floats) -> Floats:
        """The information matrix times (6 n + shared, k) vectors."""
        own = vectors[: -len(self._shared)].reshape(*self._pull.shape, -1)
        shared = vectors[-len(self._shared) :]
        found = self._cameras @ own + self._with_shared @ shared
        one, other = self._elimination.one, self._elimination.other
        np.add.at(found, one, self._between @ own[other])
        np.add.at(found, other, self._between.transpose(0, 2, 1) @ own[one])
        along = np.einsum("nis,nik->sk", self._with_shared, own) + self._shared @ shared
        return np.concatenate([found.reshape(self._pull.size, -1), along])

    def factorised(self, damping: float = 0.0) -> "Factors":
        """The equations, ready to be solved; each unknown held by `damping` times its own information, and a little."""
        if not damping:
            return Factors(
                self._elimination, self._cameras, self._between, self._with_shared, self._shared
            )
        cameras, shared = self._cameras.copy(), self._shared.copy()
        for blocks in (cameras, shared):
            own = np.arange(blocks.shape[-1])
            blocks[..., own, own] += damping * blocks[..., own, own] + 1e-9
        return Factors(self._elimination, cameras, self._between, self._with_shared, shared)


class Factors:
    """Normal equations in factors: those of the cameras, and what the shared unknowns have to do with them."""

    def __init__(
        self,
        elimination: Elimination,
        cameras: Floats,
        between: Floats,
        with_shared: Floats,
        shared: Floats,
    ) -> None:
        self.size = cameras.shape[0] * SIDE + len(shared)
        self._cameras = elimination.factorised(cameras, between)
        self._with_shared = with_shared.reshape(-1, len(shared))
        self._per_shared = self._cameras.solve(self._with_shared)
        self._shared = shared - self._with_shared.T @ self._per_shared

    def solve(self, right: Floats) -> Floats:
        """(6 n + shared,) or (6 n + shared, k) right-hand sides to as many solutions."""
        split = len(self._with_shared)
        cameras = self._cameras.solve(right[:split])
        shared = np.linalg.solve(self._shared, right[split:] - self._with_shared.T @ cameras)
        return np.concatenate([cameras - self._per_shared @ shared, shared])
