"""Which sighting of a frame is which track: place, class, size and looks weighed against its being something new."""

from dataclasses import dataclass

import numpy as np

from sorvolo.geometry.arrays import Floats, Mask, PointsM, Rows
from sorvolo.tracking.motion import Motions

_NEVER = -1e6  # a logarithm of odds that adds nothing beside any other

_GATE = 11.8  # squared distance in sigmas, two axes: 3 in 1000 of one object's sightings lie beyond
_LOOKS_WEIGHT = 4.0  # for each unit that the cosine of the angle of two looks lacks
_CLASS_FLOOR = 0.03  # chance of a class that a track never had
_MOST_VOTES = 24  # pairs that are asked for the frame's shift


@dataclass(frozen=True, eq=False)
class TrackPairs:
    """Rows of tracks and of sightings that belong together, (M,) each, in order of the tracks."""

    tracks: Rows
    sightings: Rows

    def __len__(self) -> int:
        return len(self.tracks)


@dataclass(frozen=True, eq=False)
class PairOdds:
    """What speaks for each pair of a near track and a sighting, as natural logarithms.

    `places_m` (sightings, 2) are without the shift's mean, `own_m2` (sightings, 2, 2) what each errs for itself, `fits`
    (tracks, sightings) what beside place speaks for a pair, `unseen` the log density of new objects, `sure`
    (sightings,) which may begin a track.
    """

    motions: Motions
    places_m: PointsM
    own_m2: Floats
    fits: Floats
    unseen: float
    sure: Mask

    @property
    def mean_own_m2(self) -> Floats:
        """(sightings,) what each errs for itself, per axis."""
        return np.asarray(np.trace(self.own_m2, axis1=1, axis2=2) / 2, np.float64)

    def gains(self, offsets_m: PointsM, offsets_m2: Floats) -> Floats:
        """(tracks, sightings) how much likelier pairs are than new objects; very low beyond the gate.

        A track's sightings would lie `offsets_m` (tracks, 2) beside it, with variance `offsets_m2` (tracks,) per axis.
        """
        motions = self.motions
        gaps = (
            self.places_m[None, None] - (motions.means[:, :, :2] + offsets_m[:, None])[:, :, None]
        )  # (N, 2, M, 2)
        loose = offsets_m2[:, None, None, None, None] * np.eye(2)
        inverse = _inverse(
            motions.covariances[:, :, None, :2, :2] + self.own_m2[None, None] + loose
        )
        squared = _squared(inverse, gaps[..., 0], gaps[..., 1])
        logs = -0.5 * (squared - np.log(_determinant(inverse))) - np.log(2 * np.pi)
        logs = np.where(squared <= _GATE, logs + np.log(motions.weights)[:, :, None], _NEVER)
        return np.logaddexp(logs[:, 0], logs[:, 1]) + self.fits - self.unseen

    def assign(self, gain: Floats) -> TrackPairs:
        """The best pairs, sure sightings first."""
        first = assigned(np.where(self.sure, gain, -1.0))
        gain = gain.copy()
        gain[first.tracks], gain[:, first.sightings], gain[:, self.sure] = -1.0, -1.0, -1.0
        rest = assigned(gain)
        return TrackPairs(
            np.concatenate([first.tracks, rest.tracks]),
            np.concatenate([first.sightings, rest.sightings]),
        )

    def vote(
        self, shares: Floats, loose_m2: Floats, slow_m2: float, gains: Floats, reluctance: float
    ) -> PointsM:
        """(2,) the error of the frame's shift under which the pattern of its sightings fits the tracks best.

        Each likely pair votes for the error that brings it together; an error's worth is that of all sightings with
        their best tracks. It has variance `slow_m2` per axis; a track shows its share of it (tracks,), with variance
        `loose_m2` (tracks,) beside. `gains` (tracks, sightings) is what speaks for pairs in all; an error must be worth
        `reluctance` more than none.
        """
        rows, columns = np.nonzero((gains > 0) & (shares > 0.3)[:, None])
        if not len(rows):
            return np.zeros(2)
        best = np.argsort(-gains[rows, columns], kind="stable")[:_MOST_VOTES]
        tracks_m = self.motions.places_m
        track_m2 = self.motions.place_covariances_m2 + loose_m2[:, None, None] * np.eye(2)
        asked = (self.places_m[columns[best]] - tracks_m[rows[best]]) / shares[rows[best], None]
        errors = np.concatenate([np.zeros((1, 2)), asked])
        near, seen = (np.unique(places) for places in np.nonzero(gains > 0))
        gaps = self.places_m[None, seen] - tracks_m[near][:, None]  # (N, M, 2)
        inverse = _inverse(track_m2[near][:, None] + self.own_m2[seen][None])
        base = (
            0.5 * np.log(_determinant(inverse))
            - np.log(2 * np.pi)
            + self.fits[np.ix_(near, seen)]
            - self.unseen
        )
        steps = errors[:, None, :] * shares[near][None, :, None]  # (S, N, 2)
        x, y = np.moveaxis(gaps[None] - steps[:, :, None], -1, 0)  # (S, N, M) each
        worth = np.maximum(base - 0.5 * _squared(inverse, x, y), 0.0).max(axis=1).sum(axis=1)
        worth -= 0.5 * (errors**2).sum(axis=1) / max(slow_m2, 1e-9)
        worth[1:] -= reluctance
        chosen: PointsM = errors[int(np.argmax(worth))]
        return chosen


def size_likelihoods(
    track_sides_m: Floats, seen_sides_m: Floats, sigma: float, least: float
) -> Floats:
    """(tracks, sightings) how well longer sides fit, `least` .. 0, their logarithms spread by `sigma`."""
    ratio = (
        np.log(np.maximum(seen_sides_m, 1e-3))[None]
        - np.log(np.maximum(track_sides_m, 1e-3))[:, None]
    )
    return np.maximum(-0.5 * (ratio / sigma) ** 2, least)


def looks_likelihoods(track_looks: Floats, seen_looks: Floats) -> Floats:
    """(tracks, sightings) how well appearance vectors fit, (tracks, D) and (sightings, D), at best 0; NaN: unknown.

    Vectors are histograms or embeddings of any scale; their angle counts.
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        a = track_looks / np.linalg.norm(track_looks, axis=1, keepdims=True)
        b = seen_looks / np.linalg.norm(seen_looks, axis=1, keepdims=True)
    return np.nan_to_num(_LOOKS_WEIGHT * (a @ b.T - 1.0))


def class_likelihoods(shares: Floats, labels: Rows) -> Floats:
    """(tracks, sightings) log of how likely each sighting's class is, by the tracks' shares (tracks, classes)."""
    return np.log(_CLASS_FLOOR + (1 - _CLASS_FLOOR) * shares[:, labels])


def least_cost(costs: Floats) -> tuple[Rows, Rows]:
    """Rows and columns of the pairs with the least sum of costs (N, M); each is in one pair at most (Kuhn 1955)."""
    # 14 MB and a tenth of a second, which a mission that looks for no objects need not spend
    from scipy.optimize import linear_sum_assignment

    rows, columns = linear_sum_assignment(costs)
    return rows, columns


def assigned(gains: Floats) -> TrackPairs:
    """The pairs with the largest sum of gains (tracks, sightings); pairs without gain stay apart."""
    rows, columns = least_cost(np.minimum(-gains, 0.0))
    keep = gains[rows, columns] > 0
    return TrackPairs(rows[keep], columns[keep])


def _squared(inverse: Floats, x: Floats, y: Floats) -> Floats:
    return inverse[..., 0, 0] * x * x + 2 * inverse[..., 0, 1] * x * y + inverse[..., 1, 1] * y * y


def _inverse(matrices: Floats) -> Floats:
    """Of (..., 2, 2) symmetric ones; much faster than the general one."""
    a, b, d = matrices[..., 0, 0], matrices[..., 0, 1], matrices[..., 1, 1]
    turned = np.empty_like(matrices)
    turned[..., 0, 0], turned[..., 1, 1] = d, a
    turned[..., 0, 1] = turned[..., 1, 0] = -b
    return turned / (a * d - b * b)[..., None, None]


def _determinant(matrices: Floats) -> Floats:
    return matrices[..., 0, 0] * matrices[..., 1, 1] - matrices[..., 0, 1] ** 2
