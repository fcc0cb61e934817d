"""Random fields and series: textures that never repeat, and numbers that wander smoothly over time."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d

from sorvolo.geometry.arrays import Floats

FieldF32 = NDArray[np.float32]
"""(height, width) float32."""

_KNOTS_PER_CORRELATION = 2.0  # of a wandering series: enough for a smooth curve


def layer(rng: np.random.Generator, shape: tuple[int, int], scale_px: float) -> FieldF32:
    """Gaussian noise of about unit spread, (height, width), whose blobs are about `scale_px` wide."""
    height, width = shape
    if scale_px <= 1.0:
        return rng.standard_normal(shape, dtype=np.float32)
    rows, columns = max(4, int(height / scale_px) + 4), max(4, int(width / scale_px) + 4)
    knots = rng.standard_normal((rows, columns), dtype=np.float32)
    # two knots are spare on every side, so that no edge of the field is stretched
    grown = cv2.resize(
        knots,
        (int(np.ceil(columns * scale_px)), int(np.ceil(rows * scale_px))),
        interpolation=cv2.INTER_CUBIC,
    )
    top, left = int(scale_px), int(scale_px)
    if grown.shape[0] < top + height or grown.shape[1] < left + width:
        grown = cv2.resize(grown, (left + width, top + height), interpolation=cv2.INTER_LINEAR)
    return np.ascontiguousarray(grown[top : top + height, left : left + width]) * np.float32(1.25)


def fractal(
    rng: np.random.Generator,
    shape: tuple[int, int],
    m_per_px: float,
    scales_m: Sequence[float],
    weights: Sequence[float],
) -> FieldF32:
    """A sum of `layer`s of these scales in metres, (height, width), brought to unit spread.

    Scales finer than a pixel are drawn as white noise, weaker in proportion: what a pixel averages.
    """
    total = np.zeros(shape, np.float32)
    for scale_m, weight in zip(scales_m, weights):
        scale_px = scale_m / m_per_px
        total += np.float32(weight * min(1.0, scale_px)) * layer(rng, shape, scale_px)
    spread = float(
        np.sqrt(sum((w * min(1.0, s / m_per_px)) ** 2 for s, w in zip(scales_m, weights)))
    )
    return total / np.float32(max(spread, 1e-9))


@dataclass(frozen=True, eq=False)
class SmoothSeries:
    """A number that wanders over time; call it with times in seconds, within its span."""

    spline: CubicSpline

    def __call__(self, time_s: Floats | float) -> Floats:
        """The number at these times, in their shape."""
        return np.asarray(self.spline(time_s), dtype=np.float64)


def smooth_series(
    rng: np.random.Generator, start_s: float, end_s: float, correlation_s: float, rms: float
) -> SmoothSeries:
    """A zero-mean series over [start_s, end_s] that forgets itself after about `correlation_s` seconds.

    Its root mean square over the span is `rms`; a span shorter than a few correlation times keeps its mean.
    """
    step_s = correlation_s / _KNOTS_PER_CORRELATION
    count = max(8, int(np.ceil((end_s - start_s) / step_s)) + 7)
    knots = gaussian_filter1d(rng.standard_normal(count), _KNOTS_PER_CORRELATION / 2, mode="wrap")
    if count * step_s > 6 * correlation_s:
        knots -= knots.mean()
    times_s = start_s + (np.arange(count) - 3) * step_s
    spline = CubicSpline(times_s, knots)
    probe = np.asarray(spline(np.linspace(start_s, end_s, 16 * count)))
    # the spread of what is flown, not of the knots: a spline's arcs between knots are flatter or steeper
    spread = float(np.sqrt(np.mean(probe**2)))
    return SmoothSeries(CubicSpline(times_s, knots * (rms / max(spread, 1e-12))))
