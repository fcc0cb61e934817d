"""The error that all sightings of a frame have in common: GPS and tilt shift a whole frame, not one object in it.

A sighting lies at its object's place plus the frame's shift plus its own error. The shift wanders as GPS does; a place
that was first seen with a wrong shift is wrong by as much, and so are all that were seen with it. One Kalman filter
over the shift and the errors of all places (as in simultaneous localisation and mapping, Smith, Self and Cheeseman
1990) keeps what they share: an old object seen again corrects the shift and with it all new ones. East and north err
alike, so that one covariance serves both.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sorvolo.geometry.arrays import Floats, PointsM, Rows

_TINY = 1e-9

_FORGETS_S = 60.0  # how long a GPS error lasts
# of the shared sigma: what changes from frame to frame, until the frames show it ...
_FIRST_JITTER = 0.4
_LEAST_JITTER = 0.03  # ... and is never less
_LEARNS = 0.05  # weight of a frame in what changes from frame to frame
# places kept with what they share; those not seen for longest keep their own sigma only
_MOST_ROWS = 300


@dataclass(frozen=True, eq=False)
class FittedShift:
    """What M matched objects show: of each, what its others predict it beside its place, (M, 2), with variance (M,).

    `jump_m` (2,) is the frame's own part of the shift, gone with it. The rest is what the filter's next state is made
    of: the objects' `rows` in it (M,), its `crosses` (rows, M) with what was seen, `gains` (rows, M), and the inverse
    covariance of what was seen, `trusts` (M, M), which makes `solved` (M, 2) of the `gaps_m` (M, 2).
    """

    of_others_m: PointsM
    of_others_m2: Floats
    rows: Rows
    gains: Floats
    crosses: Floats
    gaps_m: Floats
    solved: Floats
    trusts: Floats
    jump_m: Floats


class CommonShift:
    """The shift of frames and the errors of places, by the ids of their tracks."""

    def __init__(self) -> None:
        self.mean_m = np.zeros(2)
        self.jitter_m2 = -1.0
        self.jump_m = np.zeros(2)
        self._shared_m2, self._lessons = 0.0, 0
        self._left_m2 = 0.0  # variance of the frame's own jump, as far as the frame leaves it open
        self._covariance = np.zeros((1, 1))  # row 0 is the shift's
        self._rows: dict[int, int] = {}
        self._seen: dict[int, int] = {}  # in order of the frames in which they were last matched
        self._frozen: dict[int, float] = {}
        self._frame = 0

    def move_on(self, elapsed_s: float, shared_sigma_m: float) -> None:
        """A frame `elapsed_s` later, whose sightings share an error of `shared_sigma_m` per axis."""
        self._shared_m2 = shared_m2 = shared_sigma_m**2
        self._frame += 1
        self.jump_m = np.zeros(2)
        if self.jitter_m2 < 0:
            self.jitter_m2 = _FIRST_JITTER**2 * shared_m2
            self._covariance[0, 0] = shared_m2
        self._left_m2 = self.jitter_m2
        keeps = float(np.exp(-elapsed_s / _FORGETS_S))
        slow_m2 = max(shared_m2 - self.jitter_m2, 0.25 * shared_m2)
        self.mean_m = keeps * self.mean_m
        self._covariance[0] *= keeps
        self._covariance[:, 0] *= keeps
        self._covariance[0, 0] += (1 - keeps**2) * slow_m2

    def loosen(self, variance_m2: float) -> None:
        """The shift has jumped, as receivers' do now and then."""
        self._covariance[0, 0] += variance_m2

    def begin(self, ids: Sequence[int]) -> None:
        """Places seen first in this frame, at their sighting less the shift: wrong together by as much as that is."""
        first = len(self._covariance)
        for number in ids:
            line = -self._covariance[0]
            line[first:] = self._covariance[0, 0] + self._left_m2
            self._append(number, line, float(self._covariance[0, 0]) + self._left_m2)

    def variance_m2(self, number: int) -> float:
        """How far a place may lie off on the ground, per axis, beside what its own sightings err."""
        row = self._rows.get(number)
        return self._frozen.get(number, 0.0) if row is None else float(self._covariance[row, row])

    def drop(self, numbers: Sequence[int]) -> None:
        """Forget tracks."""
        rows = [self._rows[number] for number in numbers if number in self._rows]
        for number in numbers:
            self._frozen.pop(number, None)
            self._rows.pop(number, None)
            self._seen.pop(number, None)
        if rows:
            self._covariance = np.delete(np.delete(self._covariance, rows, axis=0), rows, axis=1)
            left = sorted(self._rows, key=self._rows.__getitem__)
            self._rows = {number: place for place, number in enumerate(left, 1)}

    def predict(self, ids: Sequence[int]) -> tuple[Floats, Floats]:
        """Of each track (N,): how much of an error of the shift its sightings would show, and the variance of both."""
        across, own = self._known(ids)
        shift_m2 = self._covariance[0, 0]
        return 1 + across / max(shift_m2, _TINY), np.maximum(shift_m2 + 2 * across + own, 0.0)

    @property
    def slow_m2(self) -> float:
        """Variance per axis of what the frame's shift has in common with its neighbours'."""
        return float(self._covariance[0, 0])

    def fit(self, ids: Sequence[int], gaps_m: PointsM, variances_m2: Floats) -> FittedShift:
        """What matched tracks show of each other: (M, 2) seen less known places and shift, variances (M,) of each."""
        for number in ids:
            if number not in self._rows:
                self._append(number, np.zeros(len(self._covariance)), self._frozen.pop(number, 0.0))
        rows = np.array([self._rows[number] for number in ids])
        crosses = self._covariance[:, :1] + self._covariance[:, rows]
        spread = crosses[0][None] + crosses[rows] + self.jitter_m2 + np.diag(variances_m2 + _TINY)
        trusts = np.linalg.inv((spread + spread.T) / 2)
        solved = trusts @ gaps_m
        own_trust = np.diag(trusts)
        misses_m = solved / own_trust[:, None]  # what is seen less what all others predict
        return FittedShift(
            misses_m,
            np.maximum(1 / own_trust - variances_m2, 0.0),
            rows,
            crosses @ trusts,
            crosses,
            gaps_m,
            solved,
            trusts,
            self.jitter_m2 * solved.sum(axis=0),
        )

    def offsets(self, fitted: FittedShift, ids: Sequence[int]) -> tuple[PointsM, Floats]:
        """How far beside place and shift a frame's sightings of tracks lie by the fit, (N, 2), with variance (N,)."""
        _, before = self.predict(ids)
        lines = (
            np.array(
                [
                    fitted.crosses[self._rows[number]]
                    if number in self._rows
                    else np.zeros(fitted.crosses.shape[1])
                    for number in ids
                ]
            ).reshape(len(ids), -1)
            + fitted.crosses[0]
            + self.jitter_m2
        )
        gained = np.einsum("nm,mk,nk->n", lines, fitted.trusts, lines)
        return lines @ fitted.solved, np.maximum(before + self.jitter_m2 - gained, 0.0)

    def settle(
        self, fitted: FittedShift, ids: Sequence[int], movers: Sequence[int]
    ) -> dict[int, Floats]:
        """Take a fit over; how far places of tracks move by it, (2,) each, of those fitted by what the others show.

        Places of `movers` hold no map: they are new in every frame.
        """
        moved = fitted.crosses @ fitted.solved
        self._left_m2 = max(self.jitter_m2 - self.jitter_m2**2 * float(fitted.trusts.sum()), 0.0)
        if len(ids) > 1:
            # How much frames jump, from how far all of one frame's objects together lie from
            # where they were expected.
            weights = fitted.trusts.sum(axis=0) / fitted.trusts.sum()
            expected_m2 = 1 / float(fitted.trusts.sum())  # of the weighted mean of all gaps
            together_m = weights @ fitted.gaps_m
            seen_m2 = float(together_m @ together_m) / 2 - expected_m2 + self.jitter_m2
            self._lessons += 1
            rate = max(_LEARNS, 1 / (self._lessons + 3))
            least_m2, most_m2 = _LEAST_JITTER**2 * self._shared_m2, self._shared_m2
            self.jitter_m2 = float(
                np.clip((1 - rate) * self.jitter_m2 + rate * seen_m2, least_m2, most_m2)
            )
        self._covariance -= fitted.gains @ fitted.crosses.T
        self._covariance = (self._covariance + self._covariance.T) / 2
        self.mean_m, self.jump_m = self.mean_m + moved[0], fitted.jump_m
        for place, row in enumerate(fitted.rows):
            moved[row] -= fitted.gains[row, place] * fitted.of_others_m[place]
        for number in movers:
            row = self._rows[number]
            self._covariance[row] = -self._covariance[0]
            self._covariance[:, row] = -self._covariance[:, 0]
            self._covariance[row, row] = self._covariance[0, 0]
        for number in ids:
            self._seen.pop(number, None)
            self._seen[number] = self._frame
        self._freeze()
        return {
            number: moved[row]
            for number, row in self._rows.items()
            if row < len(moved) and abs(moved[row, 0]) + abs(moved[row, 1]) > 1e-4
        }

    def _known(self, ids: Sequence[int]) -> tuple[Floats, Floats]:
        """(N,) covariances with the shift and variances of places."""
        rows = np.array([self._rows.get(number, -1) for number in ids], np.int64)
        frozen = np.array([self._frozen.get(number, 0.0) for number in ids])
        across = np.where(rows >= 0, self._covariance[0, rows], 0.0)
        return across, np.where(rows >= 0, self._covariance[rows, rows], frozen)

    def _append(self, number: int, line: Floats, variance_m2: float) -> None:
        size = len(self._covariance)
        grown = np.empty((size + 1, size + 1))
        grown[:size, :size] = self._covariance
        grown[size, :size] = grown[:size, size] = line
        grown[size, size] = variance_m2
        self._covariance, self._rows[number], self._seen[number] = grown, size, self._frame

    def _freeze(self) -> None:
        if len(self._rows) <= _MOST_ROWS + 50:
            return
        oldest = sorted(self._seen, key=self._seen.__getitem__)[: len(self._rows) - _MOST_ROWS]
        kept = {number: self.variance_m2(number) for number in oldest}
        self.drop(oldest)
        self._frozen.update(kept)
