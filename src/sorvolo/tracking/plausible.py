"""Whether a detection's size on the ground is one that its class can have, and how likely it is there."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from math import exp, hypot, log
from types import MappingProxyType

import numpy as np

from sorvolo.geometry.arrays import Floats, Mask
from sorvolo.survey.objects import TYPICAL_SIZE_M

TOO_SHORT_CUT_PX = 3.0
"""Pieces of cars at the picture's edge end up to so far from it: nearer, their length means nothing."""


@dataclass(frozen=True)
class SizeSettings:
    """Which sizes a class may have."""

    least_length: float = (
        0.4  # of its usual length: what is shorter is none, however sure the detector is
    )
    most_width: float = 2.5  # times its largest dimension: what is wider is none; trucks are as wide as cars are long
    scale_sigmas: float = (
        2.0  # by which heights may be off before something is called too short or too wide
    )


@dataclass(frozen=True)
class LengthSettings:
    """How much shorter than usual a class's members look from above, in logarithms.

    Cars: boxes of whole cars lie 0.06 to 0.11 (rms) below their median in `cats` (6 videos) and 395 cars of HIT-UAV,
    under 1 in 300 of them 0.36 or more.
    """

    shorter_sigma: Mapping[str, float] = field(
        default_factory=lambda: MappingProxyType({"car": 0.11})
    )
    partly_seen: float = (
        0.05  # of a class's members, of which a tree or a roof hides a part; by choice
    )


def usual_length_m(name: str) -> float:
    """How long a class's members usually are; 0 for classes that are not ours."""
    return TYPICAL_SIZE_M[name][0] if name in TYPICAL_SIZE_M else 0.0


def impossible_size(
    names: Sequence[str],
    sides_m: Floats,
    cut: Mask,
    scale_sigma: float | Floats = 0.0,
    settings: SizeSettings = SizeSettings(),
) -> Mask:
    """(N,) bool: what is far too short or far too wide for its class, as a window or a lawn is for a car.

    `sides_m` (N, 2) are the box's sides on the ground, known to the relative error `scale_sigma`, one or (N,); `cut`
    (N, 4) as `cut_edges` gives it with `TOO_SHORT_CUT_PX`: what the picture's edge cuts may look too short, not too
    wide. Seen aslant, a standing person's box is long on the ground, but not wide: the shorter side is compared.
    """
    longest_m = sides_m.max(axis=1, initial=0.0) * (1.0 + settings.scale_sigmas * scale_sigma)
    usual_m = np.array([usual_length_m(name) for name in names])
    short = ~cut.any(axis=1) & (longest_m < settings.least_length * usual_m)
    shortest_m = sides_m.min(axis=1, initial=np.inf) * np.maximum(
        0.0, 1.0 - settings.scale_sigmas * scale_sigma
    )
    largest_m = np.array([max(TYPICAL_SIZE_M.get(name, (np.inf,))) for name in names])
    wide: Mask = shortest_m > settings.most_width * largest_m
    return np.asarray(short | wide, bool)


def length_log_odds(
    name: str, length_m: float, scale_sigma: float, settings: LengthSettings = LengthSettings()
) -> float:
    """What a length on the ground counts for a thing's being of a class: below 0 where it is shorter than usual.

    The logarithm of how likely members of the class look so short, beside those of usual length; the length is known to
    the relative error `scale_sigma`. 0 where nothing is known of the class's lengths, or of the thing's (NaN): what is
    longer is not judged, since vans and what is seen aslant are.
    """
    sigma = settings.shorter_sigma.get(name, 0.0)
    if not sigma or not length_m < usual_length_m(name):
        return 0.0
    off = log(max(length_m, 1e-3) / usual_length_m(name)) / hypot(sigma, scale_sigma)
    return log((1.0 - settings.partly_seen) * exp(-off * off / 2) + settings.partly_seen)


def with_log_odds(score: float, more: float) -> float:
    """A score, 0 to 1, with what else is known, in log-odds."""
    if not more:
        return score
    inside = min(max(score, 1e-3), 1.0 - 1e-3)
    return 1.0 / (1.0 + exp(-log(inside / (1.0 - inside)) - more))
