"""Many numbers summed up in one; numbers that are not known (not finite) do not count, None where none is known."""

from collections.abc import Sequence

import numpy as np

from sorvolo.geometry.arrays import Floats

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
