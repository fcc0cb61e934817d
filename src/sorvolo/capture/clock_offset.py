"""The clock offset that motion shows: telemetry's path against the one seen in the pictures."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from sorvolo.capture.sync import CameraTrack
from sorvolo.geometry.arrays import Floats, Mask, PointsM
from sorvolo.geometry.homography import fit_similarity

# all by choice
_LEAST_FIXES = 4  # a similarity and an offset have five unknowns
_LEAST_FRAMES = 6
_STEPS = 4  # places of the smooth path in each interval
_LEAST_SHARE = 0.6  # of the way seen in the pictures that the log must cover at an offset
_ALIKE = 2.0  # times the best misfit, or half a fix's sigma: an offset that fits as well
_FREE_STEP_S = 0.5  # between offsets all over the log
_NEAR_S = 2.0  # from the best of these: searched more closely
_LEAST_ALIKE = 0.05  # of misses so many frames apart: fewer show nothing


@dataclass(frozen=True)
class OffsetEstimate:
    """A clock offset seen in motion, with its one-sigma uncertainty, and what a fit at 0 and at it leaves over.

    `rivals_s` are other offsets, far from it, at which the log fits as many pictures as well. Where the clocks' own tie
    is none of those that fit, the offset is not known and the rivals are all of them.
    """

    offset_s: float
    sigma_s: float
    rms_at_zero_m: float
    rms_m: float
    rivals_s: tuple[float, ...] = ()

    def left_s(self, applied_s: float, tie_s: float) -> float:
        """One sigma of what an offset of `applied_s` may still be off, where clocks tied so err by `tie_s`."""
        if not self.is_known:
            return tie_s
        share = tie_s**2 / (tie_s**2 + self.sigma_s**2)  # of the motion's word, beside the clocks'
        return float(np.hypot(np.sqrt(share) * self.sigma_s, share * (self.offset_s - applied_s)))

    @property
    def is_known(self) -> bool:
        """Whether the motion shows an offset at all, however badly."""
        return bool(np.isfinite(self.sigma_s))

    @property
    def is_significant(self) -> bool:
        """Whether the offset is well seen and worth applying."""
        return (
            np.isfinite(self.sigma_s)
            and abs(self.offset_s) > max(3 * self.sigma_s, 0.04)
            and self.rms_m < 0.97 * self.rms_at_zero_m
        )

    def refined(self, found: "OffsetEstimate", applied_s: float) -> "OffsetEstimate":
        """This estimate after another search, which began at `applied_s` and found so much more."""
        return replace(
            self, offset_s=applied_s + found.offset_s, sigma_s=found.sigma_s, rms_m=found.rms_m
        )


def estimate_offset(
    track: CameraTrack,
    times_s: Floats,
    seen_m: PointsM,
    *,
    reach_s: float,
    is_free: bool = False,
) -> OffsetEstimate:
    """The clock offset that makes telemetry's path fit the path seen in the pictures (N, 2), up to a similarity.

    It is looked for within `reach_s`, and with `is_free` all over the log: a clock may be right in form and of another
    moment. A similarity turns, so that a strip flown the other way fits as well where nothing else tells the two apart.

    Straight flight at constant speed fits at any offset: then the uncertainty comes out infinite or large. It comes
    from the motion that the pictures show, with the misfit as the noise: the fixes' own noise bends a path as well,
    and would pass for motion. How far neighbouring misfits err alike is learnt from them (`_offset_sigma_s`).
    """
    in_time = np.argsort(times_s, kind="stable")  # photos that were retried come last
    times_s, seen_m = times_s[in_time], seen_m[in_time]
    usable = np.isfinite(track.east_north_m[:, 0])
    unknown = OffsetEstimate(0.0, float("inf"), float("nan"), float("nan"))
    if usable.sum() < _LEAST_FIXES or len(times_s) < _LEAST_FRAMES or reach_s <= 0:
        return unknown
    within_s = (-np.inf, np.inf) if is_free else (times_s[0] - reach_s, times_s[-1] + reach_s)
    path_s, path_m = _smooth_path(
        track.sample_s[usable], track.east_north_m[usable], track.interval_s, within_s
    )
    compared = _Compared(path_s, path_m, times_s, seen_m)
    begin_s = 0.0
    rivals_s: tuple[float, ...] = ()
    if is_free:
        noise_m = float(np.median(track.horizontal_sigma_m[usable])) / 2
        begin_s, rivals_s = _hypotheses(compared, reach_s, noise_m)
        if abs(begin_s) > reach_s and rivals_s:
            return replace(unknown, rivals_s=(begin_s, *rivals_s))
        reach_s = min(reach_s, _NEAR_S)
    step = max(0.02, reach_s / 100)
    offsets = begin_s + np.arange(-reach_s, reach_s + step / 2, step)
    misfits = np.array([compared.misfit(each)[0] for each in offsets])
    if not np.isfinite(misfits).any():
        return unknown
    best = float(offsets[int(np.argmin(misfits))])
    for _ in range(3):
        step /= 4
        nearby = best + step * np.arange(-4, 5)
        best = float(nearby[int(np.argmin([compared.misfit(each)[0] for each in nearby]))])
    least, scale, _ = compared.misfit(best)
    found = replace(
        unknown,
        rms_at_zero_m=compared.misfit(0.0)[0] / scale,
        rms_m=least / scale,
        rivals_s=rivals_s,
    )
    if abs(best - begin_s) > 0.97 * reach_s or least > compared.most_misfit(best):
        return found
    at, fixes_m, places_m = compared.laid(best)
    return replace(found, offset_s=best, sigma_s=_offset_sigma_s(at, fixes_m, places_m))


class _Compared:
    """Telemetry's path, (M, 2) m at M times, and the one seen in the pictures, (N, 2) in units of its own at N times."""

    def __init__(
        self,
        path_s: Floats,
        path_m: PointsM,
        times_s: Floats,
        seen: PointsM,
    ) -> None:
        self.path_s, self._path_m, self.times_s, self._seen = path_s, path_m, times_s, seen
        legs = np.linalg.norm(np.diff(seen, axis=0), axis=1)
        self._way = np.append(legs, 0.0) + np.append(0.0, legs)  # twice that of each picture
        self._plane = seen @ np.array([1, 1j]), path_m @ np.array([1, 1j])

    def _inside(self, offset_s: float) -> Mask:
        at = self.times_s + offset_s
        return (at >= self.path_s[0]) & (at <= self.path_s[-1])

    def misfit(self, offset_s: float) -> tuple[float, float, float]:
        """How far the fixes, turned, shifted and scaled, miss the seen path, rms, units; infinite where they cover too
        little of it. Its units a metre; and the share of its way that fixes cover.

        It is measured in the pictures' own units: fixes that stand still would fit any path if that may shrink.
        """
        inside, way = self._inside(offset_s), float(self._way.sum())
        share = float(self._way[inside].sum()) / way if way > 0 else 0.0
        if inside.sum() < _LEAST_FRAMES or share < _LEAST_SHARE:
            return float("inf"), 1.0, share
        seen, path = self._plane
        fixes = np.interp(self.times_s[inside] + offset_s, self.path_s, path)
        fixes, places = fixes - fixes.mean(), seen[inside] - seen[inside].mean()
        spread = np.vdot(fixes, fixes).real
        if spread <= 0:
            return float("inf"), 1.0, share
        turn = np.vdot(fixes, places) / spread
        miss = np.abs(fixes * turn - places)
        most = 3 * float(np.sort(miss)[int(0.8 * len(miss))]) + 1e-9  # a few fixes may be wrong
        rms = float(np.sqrt(np.mean(np.minimum(miss, most) ** 2)))
        return rms, max(float(abs(turn)), 1e-9), share

    def most_misfit(self, offset_s: float) -> float:
        """Half of what the seen places spread, units: more, as while hovering, and the two paths have nothing alike."""
        places = self._plane[0][self._inside(offset_s)]
        return float(places.std()) / 2

    def laid(self, offset_s: float) -> tuple[Floats, PointsM, PointsM]:
        """The times within the path, the fixes then, and the seen path laid on these."""
        inside = self._inside(offset_s)
        at = self.times_s[inside] + offset_s
        fixes_m = np.column_stack(
            [np.interp(at, self.path_s, self._path_m[:, k]) for k in range(2)]
        )
        change = fit_similarity(fixes_m, self._seen[inside])
        places_m = self._seen[inside] @ change[:2, :2].T + change[:2, 2]
        return self.times_s[inside], fixes_m, places_m


def _hypotheses(
    compared: _Compared, reach_s: float, noise_m: float
) -> tuple[float, tuple[float, ...]]:
    """The offset near which to look, within `reach_s` where one there fits; and its rivals, see `OffsetEstimate`."""
    first_s = float(compared.path_s[0] - compared.times_s[-1])
    last_s = float(compared.path_s[-1] - compared.times_s[0])
    offsets = np.arange(first_s, last_s, _FREE_STEP_S)
    misfits, scales, shares = np.array([compared.misfit(each) for each in offsets]).T
    best = int(np.argmin(misfits))
    if not np.isfinite(misfits[best]):
        return 0.0, ()
    is_alike = misfits <= _ALIKE * max(misfits[best], noise_m * scales[best])
    # of all that fit alike, those that explain the most of the way; of these, those near the clocks' own tie
    is_near = np.abs(offsets) <= reach_s + _FREE_STEP_S
    chosen = is_alike & (shares > shares[is_alike].max() - 0.02)
    chosen = chosen & is_near if (chosen & is_near).any() else chosen
    begin = np.flatnonzero(chosen)[int(np.argmin(misfits[chosen]))]
    begin_s = float(offsets[begin])
    rivals_s: list[float] = []
    for k in np.argsort(misfits):
        apart_s = np.abs(offsets[k] - np.array([begin_s, *rivals_s]))
        # a log may end before the pictures do: the clocks' own tie is heard though it explains less
        least_share = 0.8 * shares[begin] if is_near[k] else shares[begin] - 0.02
        if is_alike[k] and shares[k] > least_share and apart_s.min() > reach_s:
            rivals_s.append(float(offsets[k]))
    return begin_s, tuple(rivals_s)


def _smooth_path(
    fix_s: Floats,
    fixes_m: PointsM,
    interval_s: float,
    within_s: tuple[float, float],
) -> tuple[Floats, PointsM]:
    """Fixes as a path, (M,) s and (M, 2), from the one to the other time: straight lines from fix to fix, each moment the
    mean of two intervals around; as they are where these are few, and of photos, which carry one each.

    On the lines alone noise is halved midway between two. Where frames and fixes keep step, an offset of half an
    interval then fits better than the true one: by 0.04 s on flights with fixes ten times a second.
    """
    step_s = interval_s / _STEPS
    first_s, last_s = max(fix_s[0], within_s[0] - step_s), min(fix_s[-1], within_s[1] + step_s)
    if interval_s <= 0 or last_s - first_s < _LEAST_FIXES * interval_s:
        return fix_s, fixes_m
    path_s = np.arange(first_s, last_s + step_s / 2, step_s)
    lines_m = np.column_stack([np.interp(path_s, fix_s, fixes_m[:, k]) for k in range(2)])
    window = 1, 2 * _STEPS + 1
    return path_s, np.asarray(cv2.blur(lines_m, window, borderType=cv2.BORDER_REPLICATE))


def _offset_sigma_s(times_s: Floats, fixes_m: PointsM, places_m: PointsM) -> float:
    """One sigma of an offset by what it leaves between N fixes and places, (N, 2) each; infinite without motion.

    Receivers wander, so that neighbouring frames err alike, and a strip's frames, which all pull an offset one way, are
    worth less than their number: how alike misses are, so many frames apart, is learnt from them until they no longer
    are (Newey and West, 1987).
    """
    size_m = np.linalg.norm(fixes_m - places_m, axis=1)
    # From which distance on a fix counts as wrong.
    rows = np.flatnonzero(size_m <= 3 * float(np.median(size_m)) + 1e-9)
    velocity_m_s = np.gradient(places_m, times_s, axis=0)[rows].T.ravel()
    similar = _similar(places_m[rows])
    taken_up, *_ = np.linalg.lstsq(similar, velocity_m_s, rcond=None)
    # m/s, that no similarity of the path can stand in for
    motion = velocity_m_s - similar @ taken_up
    if motion @ motion <= 1e-9 * len(rows) or len(motion) <= similar.shape[1] + 1:
        return float("inf")
    pull, miss_m = motion.reshape(2, -1), (fixes_m - places_m)[rows].T
    noise = max(float(np.sum(miss_m**2)), 1e-12) / (miss_m.size - similar.shape[1] - 1)
    alike = float(np.sum(pull**2))
    for apart in range(1, len(rows) // 4):
        share = float(
            np.sum(miss_m[:, apart:] * miss_m[:, :-apart]) / max(np.sum(miss_m**2), 1e-12)
        )
        if share <= _LEAST_ALIKE:
            break
        alike += 2 * share * float(np.sum(pull[:, apart:] * pull[:, :-apart]))
    return float(np.sqrt(noise * max(alike, np.sum(pull**2) / 2)) / (motion @ motion))


def _similar(places_m: PointsM) -> Floats:
    """(2N, 4) how N places, all their easts before their norths, move with a similarity of their plane."""
    east, north = (places_m - places_m.mean(axis=0)).T
    one, zero = np.ones(len(places_m)), np.zeros(len(places_m))
    return np.column_stack(
        [
            np.concatenate([one, zero]),
            np.concatenate([zero, one]),
            np.concatenate([east, north]),
            np.concatenate([-north, east]),
        ]
    )


def shared_motion_m_s(times_s: Sequence[float], places_m: PointsM) -> float:
    """How far a second of clock error moves a map that is laid on fixes, rms per axis, m.

    `places_m` (N, 2+) are those of the pictures, NaN where one has none.

    On a straight line it is all of the speed. Strips flown to and fro move against each other, and the map less.
    """
    known = np.flatnonzero(np.isfinite(places_m[:, 0]))
    known = known[np.argsort(np.array(times_s)[known], kind="stable")]
    if len(known) < 2:
        return 0.0
    known_m = places_m[known, :2]
    velocity_m_s = np.gradient(known_m, np.array(times_s)[known], axis=0).T.ravel()
    similar = _similar(known_m)
    taken_up, *_ = np.linalg.lstsq(similar, velocity_m_s, rcond=None)
    return float(np.sqrt(np.mean((similar @ taken_up) ** 2)))
