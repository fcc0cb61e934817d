"""The normal equations of a solve: gathered camera by camera and link by link, then solved."""

import numpy as np
from scipy.sparse import bmat, coo_matrix, csc_matrix
from scipy.sparse.linalg import SuperLU, splu

from sorvolo.geometry.arrays import Floats, Mask, Rows

_SIDE = 6  # unknowns of a camera
_HELD = (
    1e-12  # of each unknown's own information: else a direction that nothing holds has no solution
)


class NormalEquations:
    """The information matrix and the gradient of some cameras' unknowns, six each, and of those that all share, last.

    Terms of one camera are summed as they come, so that only what two cameras have in common grows with the links.
    """

    def __init__(self, cameras: int, shared: int) -> None:
        self.cost = 0.0
        self._cameras, self._shared = np.zeros((cameras, _SIDE, _SIDE)), np.zeros((shared, shared))
        self._with_shared = np.zeros((cameras, _SIDE, shared))
        self._pull, self._shared_pull = np.zeros((cameras, _SIDE)), np.zeros(shared)
        self._tied: list[tuple[Rows, Rows, Floats]] = []  # (L,) cameras each, and (L, 6, 6)

    def add(self, jacobian: Floats, residual: Floats, cameras: tuple[Rows, ...]) -> None:
        """Whitened, weighted rows: `jacobian` (n, r, w), `residual` (n, r).

        Its first columns belong to the one or two `cameras`, (n,) each, negative where the camera is held; the last to
        the first of the shared unknowns.
        """
        information = jacobian.transpose(0, 2, 1) @ jacobian
        pull = -np.einsum("nri,nr->ni", jacobian, residual)
        rest = slice(_SIDE * len(cameras), None)
        few = jacobian.shape[2] - _SIDE * len(cameras)
        for k, at in enumerate(cameras):
            here, free = slice(_SIDE * k, _SIDE * (k + 1)), at >= 0
            np.add.at(self._cameras, at[free], information[free, here, here])
            np.add.at(self._with_shared[:, :, :few], at[free], information[free, here, rest])
            np.add.at(self._pull, at[free], pull[free, here])
        if len(cameras) == 2:
            one, other = cameras
            both = (one >= 0) & (other >= 0)
            between = information[both, :_SIDE, _SIDE : 2 * _SIDE]
            self._tied.append((one[both], other[both], between))
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

    def gradient(self) -> Floats:
        """(6 n + shared,)."""
        return np.concatenate([self._pull.ravel(), self._shared_pull])

    def matrix(self) -> csc_matrix:
        """The information matrix, 6 n + shared a side."""
        number = np.arange(len(self._cameras))
        blocks: list[tuple[Rows, Rows, Floats]] = [(number, number, self._cameras)]
        for one, other, between in self._tied:
            blocks += [(one, other, between), (other, one, between.transpose(0, 2, 1))]
        down, across, values = (np.concatenate(part) for part in zip(*blocks, strict=True))
        inner = np.arange(_SIDE)
        rows, columns = np.broadcast_arrays(
            _SIDE * down[:, None, None] + inner[:, None], _SIDE * across[:, None, None] + inner
        )
        cameras = coo_matrix(
            (values.ravel(), (rows.ravel(), columns.ravel())),
            shape=(self._pull.size, self._pull.size),
        )
        coupling = self._with_shared.reshape(self._pull.size, len(self._shared))
        return bmat([[cameras, coupling], [coupling.T, self._shared]], format="csc")

    def factorised(self, damping: float = _HELD) -> SuperLU:
        """The equations, ready to be solved; each unknown held by `damping` times its own information, and a little."""
        matrix = self.matrix()
        matrix.setdiag((1 + damping) * matrix.diagonal() + 1e-9)
        # pivots off the diagonal would undo the order, which is for few new entries
        symmetric = {"SymmetricMode": True}
        return splu(matrix, "MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=symmetric)
