"""The normal equations of a solve: gathered camera by camera and link by link, then solved."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import LinAlgError, cholesky, eigh, qr
from scipy.linalg.blas import dtrsm
from scipy.sparse import coo_matrix, csc_matrix
from scipy.sparse.linalg import splu

from sorvolo.geometry.arrays import Floats, Mask, Rows

SIDE = 6  # unknowns of a camera
# cameras that go out together whatever they are tied to: so few are not worth an order
_AT_ONCE = 20
_FILLED = 0.1  # of a piece's numbers may be zeros that a smaller piece would not hold


@dataclass(frozen=True, eq=False)
class _Front:
    """Cameras that go out together, `out`, and later ones that they are tied to by then, `rest`; both sorted by when
    they go out. `into` is the front in which the first of the rest goes out, -1 without any."""

    out: Rows
    rest: Rows
    into: int


class Elimination:
    """In which order and in which pieces the unknowns of `count` cameras go out, ties being (L,) between two each."""

    def __init__(self, count: int, one: Rows, other: Rows) -> None:
        self.count, self.one, self.other = count, one, other
        self._fronts = _fronts(count, one, other)
        at = np.empty(count, int)
        for number, front in enumerate(self._fronts):
            at[front.out] = number
        # that front takes a tie in, in which the first of its cameras goes out
        first = np.minimum(at[one], at[other])
        order = np.argsort(first, kind="stable")
        self._ties = np.split(order, np.searchsorted(first[order], np.arange(1, len(self._fronts))))

    @property
    def ties(self) -> int:
        """How many there are."""
        return len(self.one)

    def factorised(self, diagonal: Floats, between: Floats) -> "BlockFactors":
        """The factors of the matrix with `diagonal` (n, 6, 6) and `between` (L, 6, 6), which has the rows of the ties'
        one and the columns of their other camera.

        Directions that only rounding leaves without weight get as little as rounding leaves.
        """
        waiting: dict[int, list[tuple[Rows, Floats]]] = {}
        pieces = _pieces(self._fronts)
        place = np.empty(self.count, int)
        for number, front in enumerate(self._fronts):
            cameras = np.concatenate([front.out, front.rest])
            place[cameras] = np.arange(len(cameras))
            full = np.zeros((len(cameras), SIDE, len(cameras), SIDE))
            own = np.arange(len(front.out))
            full[own, :, own, :] = diagonal[front.out]
            ties = self._ties[number]
            one, other = place[self.one[ties]], place[self.other[ties]]
            blocks = full.transpose(0, 2, 1, 3)
            np.add.at(blocks, (one, other), between[ties])
            np.add.at(blocks, (other, one), between[ties].transpose(0, 2, 1))
            matrix = full.reshape(SIDE * len(cameras), SIDE * len(cameras))
            for rest, update in waiting.pop(number, ()):
                into = _unknowns(place[rest])
                matrix[into[:, None], into] += update
            split = SIDE * len(front.out)
            corner, below = pieces[number]
            corner[:] = _corner(matrix[:split, :split])
            below[:] = dtrsm(1.0, corner.T, matrix[split:, :split], side=1)
            if front.into >= 0:
                update = below @ below.T
                np.subtract(matrix[split:, split:], update, out=update)
                waiting.setdefault(front.into, []).append((front.rest, update))
        return BlockFactors(self._fronts, pieces)


class BlockFactors:
    """What `Elimination.factorised` gives: the equations, ready to be solved."""

    def __init__(self, fronts: Sequence[_Front], pieces: Sequence[tuple[Floats, Floats]]) -> None:
        self._fronts, self._pieces = fronts, pieces

    def solve(self, right: Floats) -> Floats:
        """(6 n,) or (6 n, k) right-hand sides to as many solutions."""
        found = right.reshape(len(right), -1).copy()
        for front, (corner, below) in zip(self._fronts, self._pieces, strict=True):
            out = _unknowns(front.out)
            found[out] = dtrsm(1.0, corner.T, found[out], trans_a=1)
            if len(front.rest):
                found[_unknowns(front.rest)] -= below @ found[out]
        for front, (corner, below) in zip(
            reversed(self._fronts), reversed(self._pieces), strict=True
        ):
            out = _unknowns(front.out)
            known = (
                found[out] - below.T @ found[_unknowns(front.rest)]
                if len(front.rest)
                else found[out]
            )
            found[out] = dtrsm(1.0, corner.T, known)
        return found.reshape(right.shape)


def _fronts(count: int, one: Rows, other: Rows) -> list[_Front]:
    """In the order in which they go out."""
    if count <= _AT_ONCE:
        return [_Front(np.arange(count), np.zeros(0, int), -1)]
    # (count,) when each camera goes out, so that few ties arise: by least degree, the cameras of
    # a branch together.
    ties = coo_matrix((np.full(len(one), -1.0), (one, other)), shape=(count, count))
    ties = ties + ties.T
    degree = np.asarray(ties.sum(axis=0)).ravel()
    regular = csc_matrix(
        ties - coo_matrix((degree - 1, (np.arange(count), np.arange(count))), shape=(count, count))
    )
    when = splu(
        regular, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True}, diag_pivot_thresh=0.0
    ).perm_c.astype(int)
    # for each camera, in the order of `when`, the later ones that it is tied to when it
    # goes out, sorted: those that it was tied to from the first, and what those had left
    # that went out before and reached it first
    first, last = np.minimum(when[one], when[other]), np.maximum(when[one], when[other])
    order = np.argsort(first, kind="stable")
    parts = [
        [each]
        for each in np.split(last[order], np.searchsorted(first[order], np.arange(1, len(when))))
    ]
    tied = []
    for at, some in enumerate(parts):
        here = np.unique(np.concatenate(some))
        here = here[here > at]
        tied.append(here)
        if len(here):
            parts[here[0]].append(here)
    camera = np.argsort(when)
    merged: list[
        list[int]
    ] = []  # for each camera the ones that go out with it, itself last, in the order of `when`
    zeros = [0] * count
    before: list[list[int]] = [[] for _ in range(count)]  # whose first remaining tie is to this one
    joined = np.full(count, -1)
    for at, rest in enumerate(tied):
        merged.append([at])
        for child in sorted(before[at], key=lambda each: -len(tied[each])):
            out, more = len(merged[child]), len(merged[at])
            empty = zeros[child] + zeros[at] + out * (more + len(rest) - len(tied[child]))
            if empty <= _FILLED * (out + more) * ((out + more + 1) / 2 + len(rest)):
                merged[at], zeros[at], joined[child] = merged[child] + merged[at], empty, at
        if len(rest):
            before[rest[0]].append(at)
    ends = _waiting_little([at for at in range(count) if joined[at] < 0], merged, tied)
    number = np.empty(count, int)
    for position, end in enumerate(ends):
        number[merged[end]] = position
    return [
        _Front(
            camera[merged[end]], camera[tied[end]], number[tied[end][0]] if len(tied[end]) else -1
        )
        for end in ends
    ]


def _waiting_little(
    ends: Sequence[int], merged: Sequence[Sequence[int]], tied: Sequence[Rows]
) -> list[int]:
    """The fronts, each by its last camera, in the order in which what waits to be taken in by a later one needs the
    least memory (Liu 1986): of those that one takes in the first are those that need the most for themselves."""
    front_of = {at: end for end in ends for at in merged[end]}
    before: dict[int, list[int]] = {end: [] for end in ends}
    need: dict[int, int] = {}
    branch: dict[int, list[int]] = {}  # all that go out before a front and it itself
    for end in ends:  # whatever one takes in stands before it
        children = sorted(before[end], key=lambda each: len(tied[each]) ** 2 - need[each])
        waiting, most, order = 0, 0, []
        for child in children:
            most, waiting = max(most, waiting + need[child]), waiting + len(tied[child]) ** 2
            order += branch.pop(child)
        whole = (len(merged[end]) + len(tied[end])) ** 2
        need[end], branch[end] = max(most, waiting + whole + len(tied[end]) ** 2), [*order, end]
        if len(tied[end]):
            before[front_of[tied[end][0]]].append(end)
    return [each for order in branch.values() for each in order]


def _pieces(fronts: Sequence[_Front]) -> list[tuple[Floats, Floats]]:
    """Room for the triangle of each front and for what stands below it, in one stretch of memory: among the matrices
    that come and go meanwhile they would leave gaps as large as themselves."""
    shapes = [(SIDE * len(each.out), SIDE * len(each.rest)) for each in fronts]
    numbers = np.empty(sum(out * (out + rest) for out, rest in shapes))
    found, at = [], 0
    for out, rest in shapes:
        middle, end = at + out * out, at + out * (out + rest)
        found.append((numbers[at:middle].reshape(out, out), numbers[middle:end].reshape(rest, out)))
        at = end
    return found


def _unknowns(cameras: Rows) -> Rows:
    return (SIDE * cameras[:, None] + np.arange(SIDE)).ravel()


def _corner(matrix: Floats) -> Floats:
    """Lower triangular, times its transpose the matrix."""
    try:
        return cholesky(matrix, lower=True, check_finite=False)
    except LinAlgError:
        weights, axes = eigh(matrix, check_finite=False)
        weights = np.maximum(weights, np.finfo(float).eps * max(weights[-1], 1.0))
        return qr((axes * np.sqrt(weights)).T, mode="r", check_finite=False)[0].T


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
