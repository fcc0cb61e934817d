"""The normal equations of a solve: gathered camera by camera and link by link, then factorised."""

import numpy as np
from scipy.sparse import coo_matrix, csc_matrix
from scipy.sparse.linalg import SuperLU, splu

from sorvolo.geometry.arrays import Floats, Mask, Rows

_CAMERA = 6  # unknowns


class NormalEquations:
    """The information matrix and the gradient of some cameras' unknowns, six each, and of those that all share, last.

    Terms of one camera are summed as they come, so that only what two cameras have in common grows with the links.
    """

    def __init__(self, cameras: int, shared: int) -> None:
        self.cost = 0.0
        self._cameras, self._shared = np.zeros((cameras, _CAMERA, _CAMERA)), np.zeros((shared, shared))
        self._with_shared = np.zeros((cameras, _CAMERA, shared))
        self._pull, self._shared_pull = np.zeros((cameras, _CAMERA)), np.zeros(shared)
        self._between: list[tuple[Rows, Rows, Floats]] = []

    def add(self, jacobian: Floats, residual: Floats, cameras: tuple[Rows, ...]) -> None:
        """Whitened, weighted rows: `jacobian` (n, r, w), `residual` (n, r).

        Its first columns belong to the one or two `cameras`, (n,) each, negative where the camera is held; the last to
        the first of the shared unknowns.
        """
        information = jacobian.transpose(0, 2, 1) @ jacobian
        pull = -np.einsum("nri,nr->ni", jacobian, residual)
        rest = slice(_CAMERA * len(cameras), None)
        few = jacobian.shape[2] - _CAMERA * len(cameras)
        for k, at in enumerate(cameras):
            here, free = slice(_CAMERA * k, _CAMERA * (k + 1)), at >= 0
            np.add.at(self._cameras, at[free], information[free, here, here])
            np.add.at(self._with_shared[:, :, :few], at[free], information[free, here, rest])
            np.add.at(self._pull, at[free], pull[free, here])
        if len(cameras) == 2:
            one, other = cameras
            both = (one >= 0) & (other >= 0)
            self._between.append((one[both], other[both], information[both, :_CAMERA, _CAMERA:2 * _CAMERA]))
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
        """(6 n + shared) square, symmetric, sparse."""
        count, shared = self._with_shared.shape[0], len(self._shared)
        one, other, blocks = (
            (np.concatenate(each) for each in zip(*self._between, strict=True))
            if self._between else (np.zeros(0, int), np.zeros(0, int), np.zeros((0, _CAMERA, _CAMERA)))
        )
        each, end = _CAMERA * np.arange(count), np.full(count, _CAMERA * count)
        one, other, last = _CAMERA * one, _CAMERA * other, np.array([_CAMERA * count])
        parts = (
            (each, each, self._cameras), (one, other, blocks), (other, one, blocks.transpose(0, 2, 1)),
            (each, end, self._with_shared), (end, each, self._with_shared.transpose(0, 2, 1)),
            (last, last, self._shared[None]),
        )
        numbers = sum(some.size for _, _, some in parts)
        rows, columns, values = np.empty(numbers, np.int32), np.empty(numbers, np.int32), np.empty(numbers)
        first = 0
        for part in parts:  # each at its place: of a long flight they are a hundred megabytes, which none holds twice
            here = slice(first, first + part[2].size)
            rows[here], columns[here], values[here] = _entries(*part)
            first = here.stop
        size = _CAMERA * count + shared
        return coo_matrix((values, (rows, columns)), shape=(size, size)).tocsc()


def factorised(normal: csc_matrix) -> SuperLU:
    """Symmetric, positive definite equations, ready to be solved.

    The diagonal is taken as it comes: to seek larger pivots off it is not needed here, and would undo the ordering that
    keeps the factors sparse.
    """
    return splu(normal, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True}, diag_pivot_thresh=0.0)


def _entries(rows: Rows, columns: Rows, blocks: Floats) -> tuple[Rows, Rows, Floats]:
    """Row, column and value of each number of the blocks (n, h, w) that begin at these rows and columns, (n,) each."""
    height, width = blocks.shape[1:]
    r = rows.astype(np.int32)[:, None, None] + np.arange(height, dtype=np.int32)[None, :, None]
    c = columns.astype(np.int32)[:, None, None] + np.arange(width, dtype=np.int32)[None, None, :]
    r, c = np.broadcast_to(r, blocks.shape), np.broadcast_to(c, blocks.shape)
    return r.ravel(), c.ravel(), blocks.ravel()
