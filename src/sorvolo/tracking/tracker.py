"""Sightings over time put together to objects, each counted once across frames, passes and returns."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType

import numpy as np

from sorvolo.errors import GeometryError, SettingsError
from sorvolo.geometry.arrays import Floats, Labels, PointsM, Rows
from sorvolo.survey.objects import Sighting, Track
from sorvolo.tracking.association import (
    PairOdds,
    TrackPairs,
    class_likelihoods,
    looks_likelihoods,
    size_likelihoods,
)
from sorvolo.tracking.common_shift import CommonShift
from sorvolo.tracking.followed import (
    Followed,
    double_of,
    earlier_mover,
    frame_doubles,
    inward_m,
    neighbours,
)
from sorvolo.tracking.motion import MOVES, Motions, begun, corrected, habits_of, predicted
from sorvolo.tracking.view_evidence import USUAL_LOG_ODDS

# What is the sighting's own error and what the frame's, and when the frame's may have jumped.
_LEAST_OWN_SHARE = 0.02  # of a sighting's whole variance that is its own
_UNEVEN = 0.1  # of the shared sigma: turns and tilts do not shift a whole frame evenly
# share of a frame's sure sightings: if more belong nowhere, the shift may have jumped ...
_PUZZLED = 0.3
_JUMP_RELUCTANCE = 5.0  # ... if that explains them by so much better, a natural logarithm

# How sightings and misses become evidence, natural logarithms of odds.
_USUAL_STEP_S = 0.2  # sightings and gaps closer in time than this count less each
_FORGOTTEN_S = 120.0  # tentative tracks out of view
_MOST_EVIDENCE = 6.0  # evidence beyond this does not count: what leaves must be noticed
_MISSED = 0.4  # for each frame without it: people by day are reported in a third of the views that show them
_LEAST_EVIDENCE = 2.5  # odds of about two to one, where views err apart
_LONG_S = 1.0  # two views so far apart in time are enough
_MOVER_VIEWS = 4  # at least, until one that moves is sure: any two sightings make a mover
_FIRST_VIEWS = 15  # within which a mover may turn out to be one that was seen before
_NEIGHBOUR_M = 4.0  # within which two tracks may be one object


@dataclass(frozen=True)
class TrackerSettings:
    """When sightings make an object. `unit_m` is how many metres a unit of the places is, for speeds and distances.

    `alone` has the score of each class from which one frame that alone shows a place is enough: photos, which may show
    it once; empty for a video, which shows it in many frames.
    """

    # sightings below this only prolong tracks (Zhang et al. 2022, ByteTrack)
    sure_score: float = 0.3
    least_views: int = 3  # two are enough where they lie a second apart
    alone: Mapping[str, float] = field(default_factory=lambda: MappingProxyType({}))
    new_per_m2: float = 5e-4  # how densely objects lie that nobody has seen yet
    unit_m: float = 1.0
    size_sigma: float = 0.4  # of the natural logarithm of the longer side
    least_size: float = -3.0  # a size that fits worse counts no less: boxes are cut, bodies turn

    def __post_init__(self) -> None:
        if self.least_views < 1 or min(self.sure_score, self.new_per_m2, self.unit_m) < 0:
            raise SettingsError("least_views must be at least 1, the others not negative")


IN_PICTURES = TrackerSettings(unit_m=0.05)
"""For places in pixels of pictures from usual heights, 5 cm a pixel; within a factor of four it makes no difference."""


@dataclass(frozen=True)
class TrackUpdate:
    """What a frame brought. `track_ids` has one id per sighting, 0 for one that belongs to no track.

    `new` are ids confirmed by this frame, `updated` all that it saw, `ended` confirmed ones that are not where they
    should be. `merged` maps ids that turned out to be an object seen before to that object's.
    """

    track_ids: tuple[int, ...]
    new: tuple[int, ...]
    updated: tuple[int, ...]
    ended: tuple[int, ...]
    merged: Mapping[int, int]


class Tracker:
    """Follows objects through a flight's frames, in order of time. Only `update` and `finish` change it.

    Ids count from `first_id`; `next_id` is the next one that is free.

    Places are kept in a map that the sightings make; each frame's common error against it is found from the pattern of
    all objects (`common_shift`), so that GPS drift neither breaks tracks nor is averaged away as if it were noise.
    """

    def __init__(self, settings: TrackerSettings | None = None, *, first_id: int = 1) -> None:
        self._settings = settings or TrackerSettings()
        self._shift = CommonShift()
        self._followed: list[Followed] = []
        self.next_id = first_id
        self._time_ns: int | None = None
        self._shared_m = 0.0
        self._classes: list[str] = []

    def update(
        self,
        sightings: Sequence[Sighting],
        *,
        time_ns: int,
        footprint_m: PointsM | None = None,
        appearance: Floats | None = None,
    ) -> TrackUpdate:
        """Take in one frame's sightings; a frame dated before the last one counts as taken with it.

        `footprint_m` (4, 2) is the ground that the frame shows, corners in turn: what should be there and is not seen
        loses confidence; None when that is unknown. `appearance` (sightings, D) are vectors whose angle separates
        objects, rows of NaN for those without. Raises GeometryError for one of another length.
        """
        if appearance is not None and len(appearance) != len(sightings):
            raise GeometryError(
                f"{len(sightings)} sightings but {len(appearance)} appearance vectors"
            )
        seen = _Seen(sightings, appearance)
        time_ns, elapsed_s = self._move_on(seen, time_ns)
        near = self._near(seen, time_ns, footprint_m)
        motions = _stacked(near, time_ns)
        pairs, motions = self._matched(near, motions, seen)
        new = self._prolong(near, motions, pairs, seen, time_ns)
        prolonged = [near[row] for row in pairs.tracks]
        unmatched = np.setdiff1d(np.arange(len(near)), pairs.tracks)
        fresh = seen.fresh_rows(pairs.sightings, self._settings.sure_score)
        started = self._begin(seen, fresh)
        missing, ended = self._missed(near, motions, unmatched, time_ns, elapsed_s, footprint_m)
        new += self._alone([each for each in self._followed if each.is_out])
        ids = np.zeros(len(sightings), np.int64)
        ids[pairs.sightings] = [each.id for each in prolonged]
        ids[fresh] = [each.id for each in started]
        merged = self._join(prolonged + started, missing)
        ids = np.array(
            [merged.get(each, each) for each in seen.with_doubles(ids).tolist()], np.int64
        )
        return TrackUpdate(
            tuple(ids.tolist()),
            tuple(each for each in new if each not in merged),
            tuple(sorted(set(ids.tolist()) - {0})),
            tuple(each for each in ended if each not in merged),
            merged,
        )

    def tracks(self) -> list[Track]:
        """All tracks as they are known now, tentative ones as well, in order of their ids."""
        return [each.track(self._shift.variance_m2(each.id)) for each in self._followed]

    def finish(self) -> list[Track]:
        """All confirmed tracks, with those of the last frame alone; other tentative ones are given up."""
        self._alone(self._followed)
        self._keep([each for each in self._followed if each.confirmed])
        return self.tracks()

    def _move_on(self, seen: "_Seen", time_ns: int) -> tuple[int, float]:
        """Bring classes, clock and shift to a new frame; the time that it counts as, and the seconds since the last."""
        time_ns = time_ns if self._time_ns is None else max(time_ns, self._time_ns)
        elapsed_s = 0.0 if self._time_ns is None else (time_ns - self._time_ns) / 1e9
        self._time_ns = time_ns
        self._classes += sorted(set(seen.labels) - set(self._classes))
        if len(seen.sightings):
            self._shared_m = float(np.median([each.shared_sigma_m for each in seen.sightings]))
        if len(seen.sightings) or self._followed:
            self._shift.move_on(elapsed_s, self._shared_m)
        return time_ns, elapsed_s

    def _prolong(
        self, near: list[Followed], motions: Motions, pairs: TrackPairs, seen: "_Seen", time_ns: int
    ) -> list[int]:
        """Give matched tracks their sightings; the ids confirmed by it."""
        new: list[int] = []
        for row, column in zip(pairs.tracks, pairs.sightings):
            followed = near[row]
            followed.go_on(motions.only(slice(row, row + 1)), time_ns)
            weight = min(1.0, (time_ns - followed.last_ns) / 1e9 / _USUAL_STEP_S)
            if self._record(followed, seen, int(column), weight):
                new.append(followed.id)
        return new

    def _near(self, seen: "_Seen", time_ns: int, footprint_m: PointsM | None) -> list[Followed]:
        """The tracks that the frame may show."""
        if not self._followed:
            return []
        margin_m = 10 / self._settings.unit_m + 4 * self._shared_m
        outline_m = seen.places_m if footprint_m is None else footprint_m
        rough = np.array([each.rough for each in self._followed])
        elapsed_s = (time_ns - rough[:, 4]) / 1e9
        if not len(outline_m):
            chosen = elapsed_s < 2.0
        else:
            middle_m = (outline_m.min(axis=0) + outline_m.max(axis=0)) / 2
            reach_m = np.linalg.norm(outline_m - middle_m, axis=1).max() + margin_m
            places_m = rough[:, :2] + rough[:, 2:4] * elapsed_s[:, None]
            slack_m = 0.5 * np.linalg.norm(rough[:, 2:4], axis=1) * elapsed_s
            chosen = np.linalg.norm(places_m - middle_m, axis=1) < reach_m + slack_m
        return [each for each, is_near in zip(self._followed, chosen) if is_near]

    def _matched(
        self, near: list[Followed], motions: Motions, seen: "_Seen"
    ) -> tuple[TrackPairs, Motions]:
        """Which sightings are which tracks, and the tracks' motions with those taken in."""
        none = TrackPairs(np.zeros(0, np.int64), np.zeros(0, np.int64))
        if not near or not len(seen.places_m):
            return none, motions
        ids = [each.id for each in near]
        odds = PairOdds(
            motions,
            seen.places_m - self._shift.mean_m,
            seen.own_m2,
            self._fits(near, seen),
            float(np.log(self._settings.new_per_m2 * self._settings.unit_m**2)),
            seen.scores >= self._settings.sure_score,
        )
        pairs = self._paired(odds, ids)
        if not len(pairs):
            return none, motions
        return pairs, self._corrected(odds, ids, pairs)

    def _paired(self, odds: PairOdds, ids: list[int]) -> TrackPairs:
        """The likeliest pairs, while the frame's shift is found from their pattern."""
        shift, own_m2 = self._shift, odds.mean_own_m2
        shares, loose_m2 = shift.predict(ids)
        none_m = np.zeros((len(ids), 2))
        gain = odds.gains(none_m, loose_m2 + shift.jitter_m2)
        pairs = odds.assign(gain)
        is_puzzled = int(odds.sure.sum()) - len(pairs) >= max(2, _PUZZLED * odds.sure.sum())
        if is_puzzled and self._shared_m > 0:
            jump_m2 = self._shared_m**2
            wide = odds.gains(none_m, loose_m2 + shift.jitter_m2 + jump_m2)
            if odds.vote(
                np.ones(len(ids)), loose_m2 + shift.jitter_m2, jump_m2, wide, _JUMP_RELUCTANCE
            ).any():
                shift.loosen(jump_m2)
                shares, loose_m2 = shift.predict(ids)
                gain = wide
        if (loose_m2 > np.median(own_m2)).any():
            left_m2 = np.maximum(loose_m2 - shares**2 * shift.slow_m2, 0.0) + shift.jitter_m2
            error_m = odds.vote(shares, left_m2, shift.slow_m2, gain, 0.0)
            settled_m2 = shares**2 * min(float(np.median(own_m2)), shift.slow_m2)
            gain = odds.gains(shares[:, None] * error_m, left_m2 + settled_m2)
            pairs = odds.assign(gain)
        if len(pairs) > 1:
            fitted = shift.fit(*self._misses(odds, ids, pairs))
            pairs = odds.assign(odds.gains(*shift.offsets(fitted, ids)))
        return pairs

    def _corrected(self, odds: PairOdds, ids: list[int], pairs: TrackPairs) -> Motions:
        """The tracks' motions with their sightings taken in, the map's places and shift settled by them."""
        motions = odds.motions
        matched, gaps_m, variances_m2 = self._misses(odds, ids, pairs)
        fitted = self._shift.fit(matched, gaps_m, variances_m2)
        movers = [
            number
            for number, row in zip(matched, pairs.tracks)
            if motions.weights[row, MOVES] > 0.5
        ]
        steps_m = self._shift.settle(fitted, matched, movers)
        by_id = {each: row for row, each in enumerate(ids)}
        means, covariances, weights = (
            motions.means.copy(),
            motions.covariances.copy(),
            motions.weights.copy(),
        )
        for followed in self._followed:
            if followed.id in steps_m:
                followed.shift(steps_m[followed.id])
                if followed.id in by_id:
                    means[by_id[followed.id], :, :2] += steps_m[followed.id]
        before = replace(motions, means=means).only(pairs.tracks)
        better = corrected(
            before,
            before.places_m + fitted.of_others_m,
            odds.own_m2[pairs.sightings] + fitted.of_others_m2[:, None, None] * np.eye(2),
        )
        means[pairs.tracks], covariances[pairs.tracks] = better.means, better.covariances
        weights[pairs.tracks] = better.weights
        return replace(motions, means=means, covariances=covariances, weights=weights)

    def _misses(
        self, odds: PairOdds, ids: list[int], pairs: TrackPairs
    ) -> tuple[list[int], PointsM, Floats]:
        """How far pairs miss each other: ids, seen less known places (M, 2), and their variances (M,)."""
        matched = odds.motions.only(pairs.tracks)
        known_m2 = np.trace(matched.place_covariances_m2, axis1=1, axis2=2) / 2
        # moving objects cannot anchor the map
        restless_m2 = matched.weights[:, MOVES] * self._shared_m**2
        return (
            [ids[row] for row in pairs.tracks],
            odds.places_m[pairs.sightings] - matched.places_m,
            odds.mean_own_m2[pairs.sightings] + known_m2 + restless_m2,
        )

    def _fits(self, near: list[Followed], seen: "_Seen") -> Floats:
        """(tracks, sightings) what beside place speaks for each pair, as logs."""
        shares = np.array([[each.scores.get(name, 0.0) for name in self._classes] for each in near])
        shares /= shares.sum(axis=1, keepdims=True)
        fits = class_likelihoods(
            shares, np.array([self._classes.index(label) for label in seen.labels])
        )
        fits += size_likelihoods(
            np.array([each.sides_m[0] for each in near]),
            seen.sides_m,
            self._settings.size_sigma,
            self._settings.least_size,
        )
        if seen.looks is not None:
            unknown = np.full(seen.looks.shape[1], np.nan)
            known = np.array([unknown if each.looks is None else each.looks for each in near])
            fits += looks_likelihoods(known, seen.looks)
        fits[:, list(seen.doubles)] = -np.inf
        return fits

    def _record(self, followed: Followed, seen: "_Seen", column: int, weight: float) -> bool:
        """Give a track its sighting; whether that confirms it."""
        if followed.is_out:
            followed.passes, followed.is_out = followed.passes + 1, False
        followed.record(seen.sightings[column], seen.looks_of(column))
        for row, stronger in seen.doubles.items():
            if stronger == column:
                followed.vote(seen.labels[row], float(seen.scores[row]))
        # How much a sighting of this score speaks for an object, beyond what is usual.
        share = min(max(seen.scores[column], 0.01), 0.99)
        followed.evidence = min(
            followed.evidence
            + max(weight, 0.3)
            * float(np.clip(np.log(share / (1 - share)) - USUAL_LOG_ODDS, 0.0, 2.5)),
            _MOST_EVIDENCE,
        )
        followed.ended = False
        is_long = followed.last_ns - followed.first_ns >= _LONG_S * 1e9
        least_views = min(self._settings.least_views, 2) if is_long else self._settings.least_views
        if followed.moves:
            least_views = max(least_views, _MOVER_VIEWS)
        if (
            followed.confirmed
            or followed.views < least_views
            or followed.evidence < _LEAST_EVIDENCE
        ):
            return False
        followed.confirmed = True
        return True

    def _alone(self, gone: Sequence[Followed]) -> list[int]:
        """Confirm what the only frame that shows its place was sure of; the ids."""
        confirmed = []
        for followed in gone:
            least = self._settings.alone.get(followed.label, np.inf)
            if (
                followed.views == 1
                and not (followed.confirmed or followed.was_missed)
                and followed.score_sum >= least
            ):
                followed.confirmed = True
                confirmed.append(followed.id)
        return confirmed

    def _begin(self, seen: "_Seen", fresh: list[int]) -> list[Followed]:
        """New tracks, one for each of these rows of sightings."""
        if not fresh:
            return []
        habits = np.array([habits_of(seen.labels[row], self._settings.unit_m) for row in fresh])
        shift = self._shift
        motions = begun(
            seen.places_m[fresh] - shift.mean_m - shift.jump_m, seen.own_m2[fresh], habits
        )
        started = []
        for index, row in enumerate(fresh):
            sighting = seen.sightings[row]
            followed = Followed(
                self.next_id,
                motions.only(slice(index, index + 1)),
                sighting.time_ns,
                0.0,
                sighting.time_ns,
                sighting.time_ns,
                sighting,
            )
            self.next_id += 1
            self._record(followed, seen, row, 1.0)
            started.append(followed)
        self._followed += started
        shift.begin([each.id for each in started])
        return started

    def _missed(
        self,
        near: list[Followed],
        motions: Motions,
        rows: Rows,
        time_ns: int,
        elapsed_s: float,
        footprint_m: PointsM | None,
    ) -> tuple[list[Followed], list[int]]:
        """Tracks whose places the frame shows without them, and the ids of the confirmed that end with it.

        Near the picture's edge that is no sign that they are gone, only that neighbours are seen instead.
        """
        missing, ended = [], []
        sigmas = np.sqrt(np.trace(motions.place_covariances_m2[rows], axis1=1, axis2=2) / 2)
        depths_m = self._depths_m(
            [near[row] for row in rows], motions.only(rows), time_ns, footprint_m
        )
        for row, depth, sigma in zip(rows, depths_m, sigmas):
            followed = near[row]
            if depth < 0:
                followed.is_out = True
                continue
            missing.append(followed)
            if depth > 2 * sigma + followed.sides_m[0] / 2 or footprint_m is None:
                followed.was_missed = True
                followed.evidence -= _MISSED * min(1.0, max(elapsed_s, 0.02) / _USUAL_STEP_S)
                if followed.confirmed and not followed.ended and followed.evidence < 0:
                    followed.ended = True
                    ended.append(followed.id)
        self._forget({each.id for each in near}, time_ns)
        return missing, ended

    def _depths_m(
        self, followed: list[Followed], motions: Motions, time_ns: int, footprint_m: PointsM | None
    ) -> Floats:
        """(N,) how far within the frame tracks should lie, negative outside; by their last sighting without a frame."""
        if footprint_m is None:
            return np.array([0.0 if time_ns - each.last_ns < 2e9 else -np.inf for each in followed])
        if not followed:
            return np.zeros(0)
        return inward_m(footprint_m, motions.places_m + self._shift.mean_m + self._shift.jump_m)

    def _forget(self, near_ids: set[int], time_ns: int) -> None:
        """Note which tracks are out of view, and give up tentative ones that are doubtful or long unseen."""
        for followed in self._followed:
            followed.is_out |= followed.id not in near_ids and followed.last_ns < time_ns
        oldest_ns = time_ns - _FORGOTTEN_S * 1e9
        self._keep(
            [
                each
                for each in self._followed
                if each.confirmed or (each.evidence >= 0 and each.last_ns > oldest_ns)
            ]
        )

    def _join(self, now: list[Followed], missing: list[Followed]) -> dict[int, int]:
        """Merge tracks that turn out to be one object; the earlier id stays."""
        reach_m = _NEIGHBOUR_M / self._settings.unit_m
        # Count for each track which neighbours the frame shows together with it, and which
        # without it.
        for first, second in neighbours(now, now, reach_m):
            if first.id < second.id:
                first.together[second.id] = first.together.get(second.id, 0) + 1
                second.together[first.id] = second.together.get(first.id, 0) + 1
        for first, second in neighbours(now, missing, reach_m):
            first.apart[second.id] = first.apart.get(second.id, 0) + 1
            second.apart[first.id] = second.apart.get(first.id, 0) + 1
        merged: dict[int, int] = {}
        by_id = {each.id: each for each in self._followed}
        for followed in now:
            if followed.id in merged or followed.id not in by_id:
                continue
            # Another track of the same object, if there is one.
            other = double_of(
                followed,
                by_id,
                _NEIGHBOUR_M / self._settings.unit_m,
            )
            if other is None and followed.moves and followed.views <= _FIRST_VIEWS:
                density = self._settings.new_per_m2 * self._settings.unit_m**2
                other = earlier_mover(followed, self._followed, density)
            if other is not None:
                kept, gone = (other, followed) if other.id < followed.id else (followed, other)
                kept.join(gone)
                del by_id[gone.id]
                merged[gone.id] = kept.id
        if merged:
            self._keep([each for each in self._followed if each.id not in merged])
        return merged

    def _keep(self, kept: list[Followed]) -> None:
        ids = {each.id for each in kept}
        self._shift.drop([each.id for each in self._followed if each.id not in ids])
        self._followed = kept


class _Seen:
    """One frame's sightings as columns."""

    def __init__(self, sightings: Sequence[Sighting], looks: Floats | None) -> None:
        self.sightings, self.looks = (
            sightings,
            None if looks is None else np.asarray(looks, np.float64),
        )
        self.places_m = np.array([each.position_m for each in sightings]).reshape(-1, 2)
        self.scores = np.array([each.score for each in sightings])
        self.labels = [each.label for each in sightings]
        self.sides_m = np.array([each.size_m[0] for each in sightings])
        # (N, 2, 2) what sightings err each for itself.
        whole = np.array([each.covariance_m2 for each in sightings]).reshape(-1, 2, 2)
        shared = np.array([each.shared_sigma_m for each in sightings])
        values, vectors = np.linalg.eigh(whole)
        least = np.maximum(_LEAST_OWN_SHARE * values.mean(axis=1), 1e-6)
        own = (
            np.maximum(values - shared[:, None] ** 2, least[:, None])
            + (_UNEVEN * shared[:, None]) ** 2
        )
        self.own_m2 = (vectors * own[:, None, :]) @ vectors.swapaxes(1, 2)
        boxes_px = np.array([each.box_px for each in sightings]).reshape(-1, 4)
        self.doubles = frame_doubles(boxes_px, self.labels, self.scores)

    def looks_of(self, row: int) -> Floats | None:
        """An appearance vector, if there is one."""
        if self.looks is None or not np.isfinite(self.looks[row]).all():
            return None
        return self.looks[row]

    def fresh_rows(self, matched: Rows, sure_score: float) -> list[int]:
        """The sure sightings that are neither matched nor doubles: each begins a track."""
        known = {*matched.tolist(), *self.doubles}
        return [
            row for row, score in enumerate(self.scores) if row not in known and score >= sure_score
        ]

    def with_doubles(self, ids: Labels) -> Labels:
        """(sightings,) the ids, those of doubles being the stronger sighting's, where that has one."""
        whole = ids.copy()
        for row, stronger in self.doubles.items():
            whole[row] = whole[stronger] or whole[row]
        return whole


def _stacked(near: list[Followed], time_ns: int) -> Motions:
    """All tracks' motions, moved on to one moment."""
    if not near:
        return Motions(
            np.zeros((0, 2, 4)), np.zeros((0, 2, 4, 4)), np.zeros((0, 2)), np.zeros((0, 4))
        )
    motions = [each.motion for each in near]
    together = Motions(
        np.concatenate([each.means for each in motions]),
        np.concatenate([each.covariances for each in motions]),
        np.concatenate([each.weights for each in motions]),
        np.concatenate([each.habits for each in motions]),
    )
    return predicted(together, np.array([(time_ns - each.motion_ns) / 1e9 for each in near]))
