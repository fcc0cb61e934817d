"""One picture in the light of another: a power law per channel for the camera, a smooth gain for clouds' shadows."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from sorvolo.geometry.arrays import Bytes, Floats, Floats32, Ints32, Mask, shrunk, square
from sorvolo.kernels import detail_products, relight, slopes

Bgr = NDArray[np.uint8]
"""(height, width, 3) uint8, blue green red."""

BLACK_LEVEL = 8.0  # grey levels added before logarithms: below it a camera shows noise, not light
STEPS_PER_OCTAVE = 48.0  # of local gains in a byte
GAIN_ONE, CURVE_ONE = 4096, 16  # fixed point of the kernel `relight`

_LOG = (np.log2(np.arange(256) + BLACK_LEVEL) * STEPS_PER_OCTAVE).astype(np.float32)
OCTAVES = np.log2(np.arange(256, dtype=np.float32) + np.float32(BLACK_LEVEL))  # of each grey level


# How the light is fitted. Lengths in px of the half size pictures, or in cells.
_CELL_PX = 8  # side of a cell that has one gain
_FINE = 4  # pixels of a cell each way, where structure is compared
_DETAIL_PX = 9  # details of the finest structure are what is smaller; fine pixels
_MEDIAN_CELLS = 5  # what is smaller than half of it cannot change the local gain
# squared octaves a cell by which a slope is drawn to one where there is little to see
_NO_SLOPE = 0.0002
_LIGHT_ALIKE = (0.25, 0.5)  # correlation of details: the ground is another one, and surely the same
_FLAT = 6.0  # what noise leaves of the variance of details, in squared steps of the logarithm
_FLAT_TRUST = 0.003  # of cells without any structure: they count where nothing better is near
_REACHES = ((3, 1.0), (7, 0.1), (17, 0.01), (49, 0.001))


@dataclass(frozen=True, eq=False)
class PairLight:
    """What turns the reference's light into the query's: query + 8 = 2**offset * (reference + 8)**exponent * gain.

    `exponents` and `offsets` (3,) are per channel, blue green red; `gains` (h, w, 3) float32 are factors on a coarse
    grid over the picture; `unevenness` is their spread in octaves, what clouds do.
    """

    exponents: Floats
    offsets: Floats
    gains: Floats32
    unevenness: float

    @property
    def brightness(self) -> Floats:
        """(3,) by which factor a middle grey of the reference is brighter in the query."""
        middle = np.log2(100.0 + BLACK_LEVEL)
        return 2.0 ** (self.offsets + (self.exponents - 1.0) * middle)


def fit_light(reference: Bgr, query: Bgr, known: Mask | None = None) -> PairLight:
    """The light of `query` seen against `reference`, aligned to a few pixels; where not `known` it is the middle one.

    The exponents come from what both pictures show at middle scales, where neither clouds nor pixels' noise matter;
    fits are robust against things that changed.
    """
    height, width = reference.shape[:2]
    size = max(4, width // _CELL_PX), max(4, height // _CELL_PX)
    fine = _FINE * size[0], _FINE * size[1]
    reference, query = shrunk(reference, fine), shrunk(query, fine)
    before, after = (_logarithm(shrunk(each, size)) for each in (reference, query))
    sure = _surely(known, size)
    if sure is not None and sure.sum() < 16:
        return PairLight(np.ones(3), np.zeros(3), np.ones((*size[::-1], 3), np.float32), 0.0)
    window = (9, 9)
    detail_before = _chosen(before - cv2.blur(before, window), sure)[::2]
    detail_after = _chosen(after - cv2.blur(after, window), sure)[::2]
    # the ratio of spreads, the geometric mean of the regressions of each on the other: that of the query on the
    # reference alone would be too low by what noise, misalignment and clouds add to the spread of the reference
    exponents = slopes(detail_before, detail_after, _NO_SLOPE * len(detail_before)).clip(0.5, 2.0)
    offset = after - exponents.astype(np.float32) * before
    offsets = np.median(_chosen(offset, sure), axis=0).astype(np.float64)
    local = np.clip(
        np.rint((offset - offsets.astype(np.float32)) * STEPS_PER_OCTAVE + 128), 0, 255
    ).astype(np.uint8)
    same = _sameness(reference, query)
    if sure is not None:
        same[~sure] = 0
    steps = cv2.medianBlur(local, _MEDIAN_CELLS).astype(np.float32) - 128
    octaves = _spread(steps, same) / STEPS_PER_OCTAVE
    unevenness = float(_chosen(octaves, sure).mean(axis=1).std())
    return PairLight(exponents, offsets, np.exp2(octaves).astype(np.float32), unevenness)


def relit(image: Bgr, light: PairLight, out: Bgr | None = None) -> Bgr:
    """`image`, of the reference, in the query's light; written to `out` (h, w, 3) where it is given."""
    return relight(image, *_curves_and_gains(light, image.shape[1]), out=out)


def _curves_and_gains(light: PairLight, width: int) -> tuple[Ints32, Floats32]:
    """The light of pictures of a width as `relight` takes it."""
    levels = np.log2(np.arange(256) + BLACK_LEVEL)
    curves = 2.0 ** (light.exponents[:, None] * levels + light.offsets[:, None])
    table = np.clip(np.rint(curves * CURVE_ONE), 0, 16383).astype(np.int32)
    steps = np.clip(np.rint(light.gains * GAIN_ONE), 0, 65535).astype(np.float32)
    return table, np.asarray(
        cv2.resize(steps, (width, len(steps)), interpolation=cv2.INTER_LINEAR), np.float32
    )


def _chosen(values: Floats32, sure: Mask | None) -> Floats32:
    """Values (h, w, 3) of the cells that are `sure` (h, w), of all without it: (N, 3)."""
    return values.reshape(-1, 3) if sure is None else values[sure]


def _sameness(reference: Bgr, query: Bgr) -> Floats32:
    """How sure each cell (h, w) shows the same ground, 0 to 1: both pictures have its finest structure.

    Things put on the ground, however large, hide its structure: their cells do not count for the light.
    """
    before, after = (cv2.cvtColor(each, cv2.COLOR_BGR2GRAY) for each in (reference, query))
    grays = np.asarray(before, np.uint8), np.asarray(after, np.uint8)
    products = detail_products(*grays, _LOG, _DETAIL_PX, _FINE)
    sums = [cv2.blur(each, (5, 5)) for each in products]
    alike = sums[0] / np.sqrt((sums[1] + _FLAT) * (sums[2] + _FLAT))
    least, most = _LIGHT_ALIKE
    sure = np.clip((alike - least) / (most - least), 0, 1)
    flat = np.exp(-(sums[1] + sums[2]) / (2 * _FLAT)) * np.float32(_FLAT_TRUST)
    return np.asarray(np.maximum(cv2.erode(sure, square(3)), flat), np.float32)


def _spread(values: Floats32, weights: Floats32) -> Floats32:
    """Values (h, w, 3) smoothed with weights (h, w); where there are none, those of the nearest around."""
    stack = np.dstack([values * weights[..., None], weights])
    total = np.zeros_like(stack)
    for reach, weight in _REACHES:
        total += np.float32(weight) * cv2.blur(stack, (reach, reach))
    return np.asarray(total[..., :3] / (total[..., 3:] + np.float32(1e-6)), np.float32)


def _logarithm(image: Bytes) -> Floats32:
    return np.asarray(cv2.LUT(image, OCTAVES), np.float32)


def _surely(known: Mask | None, size: tuple[int, int]) -> Mask | None:
    """Which pixels of a picture of `size` (w, h) lie on known ground alone; None where everything does."""
    return None if known is None else shrunk(known.astype(np.uint8) * 255, size) > 250
