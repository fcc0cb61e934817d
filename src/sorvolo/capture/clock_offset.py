"""The clock offset that motion shows: telemetry's path against the one seen in the pictures."""

from dataclasses import dataclass, replace

import numpy as np

from sorvolo.capture.sync import Track
from sorvolo.geometry.arrays import Floats, PointsM
from sorvolo.geometry.homography import fit_similarity


@dataclass(frozen=True)
class OffsetSettings:
    """When an offset is looked for, how fixes become a smooth path, and how their noise is learnt; all by choice.

    A similarity and an offset have five unknowns: fewer than `least_fixes` or `least_frames` show none. The path is a
    parabola through `reach` fixes to each side, weighted by nearness with one sigma of `width` intervals of the
    receiver, at which its noise hardly depends on where between two fixes it is; fewer than `around` fixes within two
    sigmas (of seven) stand at an end or a gap, where a parabola would run away. `shares` are of the noise's variance,
    that neighbouring frames may have in common.
    """

    least_fixes: int = 4
    least_frames: int = 6
    width: float = 1.5
    steps: int = 4  # places of the smooth path in each interval
    reach: int = 6  # four sigmas
    around: int = 5
    most_frames: int = 400  # that a noise is learnt from
    shares: tuple[float, ...] = (0.0, 0.25, 0.5, 0.75, 0.9, 0.97)
    memories: int = 6  # times in which it is forgotten that are tried, from one frame's step to the whole flight


@dataclass(frozen=True)
class OffsetEstimate:
    """A clock offset seen in motion, with its one-sigma uncertainty, and what a fit at 0 and at it leaves over."""

    offset_s: float
    sigma_s: float
    rms_at_zero_m: float
    rms_m: float

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
        return OffsetEstimate(
            applied_s + found.offset_s, found.sigma_s, self.rms_at_zero_m, found.rms_m
        )


def estimate_offset(
    track: Track,
    times_s: Floats,
    seen_m: PointsM,
    *,
    reach_s: float,
    settings: OffsetSettings = OffsetSettings(),
) -> OffsetEstimate:
    """The clock offset that makes telemetry's path fit the path seen in the pictures (N, 2), up to a similarity.

    Straight flight at constant speed fits at any offset: then the uncertainty comes out infinite or large. It comes
    from the motion that the pictures show, with the misfit as the noise: the fixes' own noise bends a path as well,
    and would pass for motion. How far neighbouring misfits err alike is learnt from them (`_offset_sigma_s`).
    """
    usable = np.isfinite(track.east_north_m[:, 0])
    unknown = OffsetEstimate(0.0, float("inf"), float("nan"), float("nan"))
    if usable.sum() < settings.least_fixes or len(times_s) < settings.least_frames or reach_s <= 0:
        return unknown
    within_s = float(times_s.min()) - reach_s, float(times_s.max()) + reach_s
    path_s, path_m = _smooth_path(
        track.sample_s[usable], track.east_north_m[usable], track.interval_s, within_s, settings
    )

    def laid(offset_s: float) -> tuple[Floats, PointsM, PointsM]:
        """The times within the path, the fixes then, and the seen path laid on these."""
        at = times_s + offset_s
        inside = (at >= path_s[0]) & (at <= path_s[-1])
        fixes = np.column_stack([np.interp(at[inside], path_s, path_m[:, k]) for k in range(2)])
        seen = seen_m[inside]
        if (
            inside.sum() < max(settings.least_frames, 0.6 * len(at))
            or np.ptp(seen, axis=0).max() <= 0
        ):
            return times_s[:0], fixes[:0], seen[:0]
        change = fit_similarity(fixes, seen)
        return times_s[inside], fixes, seen @ change[:2, :2].T + change[:2, 2]

    def misfit(offset_s: float) -> float:
        _, fixes, places = laid(offset_s)
        if not len(fixes):
            return float("inf")
        miss = np.linalg.norm(places - fixes, axis=1)
        return float(np.mean(np.minimum(miss, _outlying_m(miss)) ** 2))

    step = max(0.02, reach_s / 100)
    offsets = np.arange(-reach_s, reach_s + step / 2, step)
    costs = np.array([misfit(each) for each in offsets])
    if not np.isfinite(costs).any():
        return unknown
    best = float(offsets[int(np.argmin(costs))])
    for _ in range(3):
        step /= 4
        nearby = best + step * np.arange(-4, 5)
        best = float(nearby[int(np.argmin([misfit(each) for each in nearby]))])
    rms_at_zero_m, rms_m = (float(np.sqrt(misfit(each))) for each in (0.0, best))
    if abs(best) > 0.97 * reach_s:
        return replace(unknown, rms_at_zero_m=rms_at_zero_m, rms_m=rms_m)
    return OffsetEstimate(best, _offset_sigma_s(*laid(best), settings), rms_at_zero_m, rms_m)


def _outlying_m(miss_m: Floats) -> float:
    """From which distance on a fix counts as wrong."""
    return 3 * float(np.median(miss_m)) + 1e-9


def _smooth_path(
    fix_s: Floats,
    fixes_m: PointsM,
    interval_s: float,
    within_s: tuple[float, float],
    settings: OffsetSettings,
) -> tuple[Floats, PointsM]:
    """Fixes as a path, (M,) s and (M, 2), from the one to the other time: by a parabola through the fixes around
    each moment, weighted by nearness; as they are where these are few, and of photos, which carry one each.

    On straight lines from fix to fix noise is halved midway between two. Where frames and fixes keep step, an offset of
    half an interval then fits better than the true one: by 0.04 s on flights with fixes ten times a second.
    """
    reach = settings.reach
    if interval_s <= 0 or len(fix_s) <= 2 * reach:
        return fix_s, fixes_m
    step_s = interval_s / settings.steps
    first_s, last_s = max(fix_s[0], within_s[0] - step_s), min(fix_s[-1], within_s[1] + step_s)
    path_s = np.arange(first_s, last_s + step_s / 2, step_s)
    if len(path_s) < 2:
        return fix_s, fixes_m
    first = np.clip(np.searchsorted(fix_s, path_s) - reach, 0, len(fix_s) - 2 * reach)
    rows = first[:, None] + np.arange(2 * reach)
    along = (fix_s[rows] - path_s[:, None]) / (settings.width * interval_s)
    weight = np.exp(-0.5 * along**2)
    powers = along[..., None] ** np.arange(3)
    normal = np.einsum("nk,nki,nkj->nij", weight, powers, powers)
    straight_m = np.column_stack([np.interp(path_s, fix_s, fixes_m[:, k]) for k in range(2)])
    fitted = (np.abs(along) <= 2.0).sum(axis=1) >= settings.around
    if fitted.any():
        right = np.einsum("nk,nki,nkd->nid", weight, powers, fixes_m[rows])
        straight_m[fitted] = np.linalg.solve(normal[fitted], right[fitted])[:, 0]
    return path_s, straight_m


def _offset_sigma_s(
    times_s: Floats, fixes_m: PointsM, places_m: PointsM, settings: OffsetSettings
) -> float:
    """One sigma of an offset by what it leaves between N fixes and places, (N, 2) each; infinite without motion.

    Receivers wander, so that neighbouring frames err alike, and a strip's frames, which all pull an offset one way, are
    worth less than their number. The noise is taken as one part new for each frame and one that is forgotten
    exponentially; their shares and the time are weighed by the restricted likelihood of the misfits, which counts what
    the fit has taken up (Patterson and Thompson, 1971), and the offset's variances by that weight. Of longer flights
    some frames, evenly spread, make it too large rather than too small.
    """
    miss_m = np.linalg.norm(fixes_m - places_m, axis=1)
    rows = np.flatnonzero(miss_m <= _outlying_m(miss_m))
    velocity_m_s = np.gradient(places_m, times_s, axis=0)[rows]
    some = np.unique(np.linspace(0, len(rows) - 1, settings.most_frames).round().astype(int))
    rows, velocity_m_s = rows[some], velocity_m_s[some]
    at_s, places, misses = times_s[rows], places_m[rows], (fixes_m - places_m)[rows].T.ravel()
    # (2N, 4) how N places, all their easts before their norths, move with a similarity of their
    # plane.
    east, north = (places - places.mean(axis=0)).T
    one, zero = np.ones(len(places)), np.zeros(len(places))
    similar = np.column_stack(
        [
            np.concatenate([one, zero]),
            np.concatenate([zero, one]),
            np.concatenate([east, north]),
            np.concatenate([-north, east]),
        ]
    )
    taken_up, *_ = np.linalg.lstsq(similar, velocity_m_s.T.ravel(), rcond=None)
    motion = (
        velocity_m_s.T.ravel() - similar @ taken_up
    )  # m/s, that no similarity of the path can stand in for
    if motion @ motion <= 1e-9 * len(rows) or len(motion) <= similar.shape[1] + 1:
        return float("inf")
    model = np.column_stack([similar, motion])
    apart_s = np.abs(at_s[:, None] - at_s)
    likelihoods, variances = [], []
    for memory_s in np.geomspace(
        float(np.median(np.diff(at_s))), at_s[-1] - at_s[0], settings.memories
    ):
        for share in settings.shares:
            alike = (1 - share) * np.eye(len(at_s)) + share * np.exp(-apart_s / memory_s)
            likelihood, noise = _restricted_likelihood(alike, model, misses)
            likelihoods.append(likelihood)
            pull = motion.reshape(2, -1)
            variances.append(
                noise * float(np.sum(pull * (pull @ alike))) / float(motion @ motion) ** 2
            )
    weights = np.exp(np.array(likelihoods) - max(likelihoods))
    return float(np.sqrt(np.average(variances, weights=weights)))


def _restricted_likelihood(alike: Floats, model: Floats, misses: Floats) -> tuple[float, float]:
    """The logarithm of the restricted likelihood of misses, (2N,), whose two axes both have the correlations `alike`,
    (N, N), less a constant; and the variance of one. `model` (2N, P) are the unknowns that were fitted."""
    root = np.linalg.cholesky(alike)
    count = len(alike)
    white_model, white = (
        np.concatenate([np.linalg.solve(root, each[:count]), np.linalg.solve(root, each[count:])])
        for each in (model, misses)
    )
    normal = white_model.T @ white_model
    right = white_model.T @ white
    left_over = max(float(white @ white - right @ np.linalg.solve(normal, right)), 1e-12)
    freedom = len(misses) - model.shape[1]
    of_noise = 4 * float(np.log(np.diag(root)).sum())  # of both axes
    of_model = float(np.linalg.slogdet(normal)[1])
    return -0.5 * (freedom * float(np.log(left_over)) + of_noise + of_model), left_over / freedom
