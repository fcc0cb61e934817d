"""Many numbers summed up in one, and chances beside what came true; numbers that are not known do not count."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from sorvolo.geometry.arrays import Floats, Mask

SIGMA_PER_MEDIAN_DEVIATION = 1.4826
"""A normal error's sigma over its median absolute deviation, which outliers leave alone: 1 / 0.6745."""


def median_of_known(values: Floats | Sequence[float]) -> float | None:
    """The median of the known numbers."""
    known = _known(values)
    return float(np.median(known)) if len(known) else None


def median_or_nan(values: Floats | Sequence[float]) -> float:
    """The median of the known numbers; NaN where none is known, for records whose unknown numbers are NaN."""
    known = _known(values)
    return float(np.median(known)) if len(known) else float("nan")


def percentile_of_known(values: Floats | Sequence[float], share: float) -> float | None:
    """The percentile `share`, 0 to 100, of the known numbers."""
    known = _known(values)
    return float(np.percentile(known, share)) if len(known) else None


def rms_of_known(values: Floats | Sequence[float]) -> float | None:
    """The root mean square of the known numbers."""
    known = _known(values)
    return float(np.sqrt(np.mean(known**2))) if len(known) else None


def _known(values: Floats | Sequence[float]) -> Floats:
    every = np.asarray(values, np.float64)
    return every[np.isfinite(every)]


_Z90 = 1.6449  # of a normal distribution: 90 % lie within


@dataclass(frozen=True)
class CalibrationBin:
    """Of `count` cases that were given a chance from `low` to `high`: the mean chance, and what came true, with its
    interval (Wilson, 90 %)."""

    low: float
    high: float
    count: int
    stated: float
    found: float
    found_low: float
    found_high: float


def calibration_bins(
    chances: Floats, found: Mask, edges: Sequence[float] = (0, 0.2, 0.4, 0.6, 0.8, 1)
) -> list[CalibrationBin]:
    """How often what was given a chance came true, by bins of the chance; empty bins are left out."""
    rows = []
    for low, high in pairwise(edges):
        inside = (chances >= low) & ((chances < high) | ((high == edges[-1]) & (chances <= high)))
        if inside.any():
            bounds = wilson(int(found[inside].sum()), int(inside.sum()))
            rows.append(
                CalibrationBin(
                    low,
                    high,
                    int(inside.sum()),
                    float(chances[inside].mean()),
                    float(found[inside].mean()),
                    *bounds,
                )
            )
    return rows


def wilson(hits: int, total: int) -> tuple[float, float]:
    """The 90 % interval of a share (Wilson 1927); 0 to 1 where nothing was tried."""
    if total == 0:
        return 0.0, 1.0
    share, z2 = hits / total, _Z90**2
    middle = (share + z2 / (2 * total)) / (1 + z2 / total)
    half = (
        _Z90 / (1 + z2 / total) * float(np.sqrt(share * (1 - share) / total + z2 / (4 * total**2)))
    )
    return max(0.0, middle - half), min(1.0, middle + half)
