"""How heights agree with the flight's own points in space, and what that states of their sigma."""

from dataclasses import dataclass, replace

import numpy as np

from sorvolo.geometry.arrays import Floats, Floats32
from sorvolo.heights.cameras import Cameras3D
from sorvolo.heights.field import HeightField
from sorvolo.heights.surface import Surface

_SHARES = (0.6827, 0.9545)  # of a Gaussian, within one and two sigma
_ROUNDS = 30  # in which the factor settles


@dataclass(frozen=True)
class OwnPointSettings:
    """Which points judge the heights."""

    least_views: int = (
        3  # see a point: where two see it, a wrong match along the line between them goes unseen
    )
    least_points: int = 100  # fewer judge nothing: five of them would be the share beyond two sigma


@dataclass(frozen=True)
class PointJudgement:
    """The heights at points: how many of them, their median distance, the shares within one and two of the sigma of
    the match as it was, and the factor that this sigma was raised by; 1 where the points found it large enough.

    The figures are NaN without points.
    """

    points: int
    median_m: float = float("nan")
    within_1_sigma: float = float("nan")
    within_2_sigma: float = float("nan")
    factor: float = 1.0


def judged_by_points(
    surface: Surface, solved: Cameras3D, settings: OwnPointSettings = OwnPointSettings()
) -> tuple[Surface, PointJudgement]:
    """The surface with its sigma raised to what the flight's own points in space show, and their judgement.

    A point and the cell there have the cameras in common: what these err is left out of the comparison, and stays in
    the sigma as it is. The sigma is never lowered: points lie where the ground has texture, and show nothing for the
    heights of ground that has none.
    """
    judges = solved.point_views >= settings.least_views
    points_m, sigma_m = solved.points_m[judges], solved.point_sigma_m[judges]
    at_m, stated_m = HeightField(surface.lattice, surface.up_m, surface.sigma_m).at(points_m[:, :2])
    known = np.isfinite(at_m)
    if known.sum() < settings.least_points:
        return surface, PointJudgement(int(known.sum()))
    off_m, points_m, sigma_m = np.abs(at_m - points_m[:, 2])[known], points_m[known], sigma_m[known]
    match_m = _without(stated_m[known], solved.height_sigma.at(points_m[:, :2]))
    times = off_m / np.hypot(match_m, sigma_m)
    factor = _factor(off_m, match_m, sigma_m)
    judgement = PointJudgement(
        len(off_m),
        float(np.median(off_m)),
        float((times < 1).mean()),
        float((times < 2).mean()),
        factor,
    )
    if factor <= 1:
        return surface, judgement
    camera_m = solved.height_sigma.on(surface.lattice)
    raised_m = np.hypot(factor * _without(surface.sigma_m, camera_m), camera_m).astype(np.float32)
    return replace(surface, sigma_m=raised_m), judgement


def _without(sigma: Floats | Floats32, part: Floats) -> Floats:
    """A sigma less an independent part of it; NaN stays."""
    return np.sqrt(np.maximum(sigma.astype(np.float64) ** 2 - part**2, 1e-12))


def _factor(off_m: Floats, match_m: Floats, point_m: Floats) -> float:
    """By how much the match's sigma is to be raised so that as many errors lie within one and two sigma as of a
    Gaussian; at least 1. The points' own sigma is not raised."""
    factor = 1.0
    for _ in range(_ROUNDS):
        times = off_m / np.hypot(factor * match_m, point_m)
        short = max(float(np.quantile(times, share)) / (k + 1) for k, share in enumerate(_SHARES))
        factor = max(1.0, factor * short)
    return factor
