"""One picture in the light of another: a power law per channel for the camera, a smooth gain for clouds' shadows."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from sorvolo.change.pair.moved_shadows import STEPS, moved_shades
from sorvolo.geometry.arrays import Floats, Mask
from sorvolo.kernels import detail_products, relight, slopes

Bgr = NDArray[np.uint8]
"""(height, width, 3) uint8, blue green red."""

BLACK_LEVEL = 8.0  # added before logarithms: below it a camera shows noise, not light
CELL_PX = 8
FINE = 4  # pixels of a cell each way, where structure is compared
DETAIL_PX = 9  # details of the finest structure are what is smaller
NO_SLOPE = 2e-4  # squared octaves a cell by which a slope is drawn to one where there is little to see
MEDIAN_CELLS = 5  # what is smaller than half of it cannot change the local gain
LEAST_ALIKE, MOST_ALIKE = 0.25, 0.5  # correlation of details: the ground is another one, and surely the same
FLAT = 6.0  # what noise leaves of the variance of details, in squared steps of the logarithm
FLAT_TRUST = 0.003  # of cells without any structure: they tell where nothing better is near
REACHES_CELLS = ((3, 1.0), (7, 0.1), (17, 0.01), (49, 1e-3))  # how far a cell's gain tells about its neighbours'
NEAR_CELLS = 11  # around things: there the ground tells the light once it is known what hides it
LEAST_HIDDEN = 12  # of 255: cells that are hidden to more do not count
LEAST_GAIN = 0.02  # of a gain: less makes no difference
STEPS_PER_OCTAVE = 48.0
GAIN_ONE = 4096
CURVE_ONE = 16

_LOG = (np.log2(np.arange(256) + BLACK_LEVEL) * 48).astype(np.float32)
_OCTAVES = np.log2(np.arange(256, dtype=np.float32) + np.float32(BLACK_LEVEL))


@dataclass(frozen=True, eq=False)
class Light:
    """What turns the reference's light into the query's: query + 8 = 2**offset * (reference + 8)**exponent * gain.

    `exponents` and `offsets` (3,) are per channel, blue green red; `gains` (h, w, 3) float32 are factors on a coarse
    grid over the picture; `unevenness` is their spread in octaves, what clouds do. `cells` is what the gains are from.
    `shades` (h, w, 3) are further factors on a finer grid, where shadows of tall things moved; None if nowhere.
    """

    exponents: Floats
    offsets: Floats
    gains: NDArray[np.float32]
    unevenness: float
    cells: "Cells"
    shades: NDArray[np.float32] | None = None

    @property
    def brightness(self) -> Floats:
        """(3,) by which factor a middle grey of the reference is brighter in the query."""
        middle = np.log2(100.0 + BLACK_LEVEL)
        return np.asarray(2.0 ** (self.offsets + (self.exponents - 1.0) * middle))


@dataclass(frozen=True, eq=False)
class Cells:
    """The local gain by each cell alone: `steps` (h, w, 3) float32, `STEPS_PER_OCTAVE` to an octave.

    `trust` (h, w) float32, 0 to 1, is how sure it shows the same ground; nothing is known of it where not `known`.
    """

    steps: NDArray[np.float32]
    trust: NDArray[np.float32]
    known: Mask | None


def fit_light(reference: Bgr, query: Bgr, known: Mask | None = None) -> Light:
    """The light of `query` seen against `reference`, aligned to a few pixels; where not `known` it is the middle one.

    The exponents come from what both pictures show at middle scales, where neither clouds nor pixels' noise matter;
    fits are robust against things that changed.
    """
    height, width = reference.shape[:2]
    size = max(4, width // CELL_PX), max(4, height // CELL_PX)
    fine = FINE * size[0], FINE * size[1]
    reference, query = _smaller(reference, fine), _smaller(query, fine)
    before, after = (_logarithm(_smaller(each, size)) for each in (reference, query))
    sure = _surely(known, size)
    if sure is not None and sure.sum() < 16:
        nothing = np.zeros((*size[::-1], 3), np.float32)
        return Light(np.ones(3), np.zeros(3), nothing + 1, 0.0, Cells(nothing, nothing[..., 0], sure))
    window = (9, 9)
    detail_before = _chosen(before - cv2.blur(before, window), sure)[::2]
    detail_after = _chosen(after - cv2.blur(after, window), sure)[::2]
    # the ratio of spreads, the geometric mean of the regressions of each on the other: that of the query on the
    # reference alone would be too low by what noise, misalignment and clouds add to the spread of the reference
    exponents = slopes(detail_before, detail_after, NO_SLOPE * len(detail_before)).clip(0.5, 2.0)
    offset = after - exponents.astype(np.float32) * before
    kept = _chosen(offset, sure)
    offsets = np.median(kept, axis=0).astype(np.float64)
    shades = _shades(reference, query, exponents, offsets, known)
    if shades is not None:
        offset -= cv2.resize(shades, size, interpolation=cv2.INTER_AREA)
    local = np.clip(np.rint((offset - offsets.astype(np.float32)) * STEPS_PER_OCTAVE + 128), 0, 255).astype(np.uint8)
    same = _sameness(reference, query)
    if sure is not None:
        same[~sure] = 0
    cells = Cells(cv2.medianBlur(local, MEDIAN_CELLS).astype(np.float32) - 128, same, sure)
    octaves = _spread(cells.steps, same) / STEPS_PER_OCTAVE
    unevenness = float(_chosen(octaves, sure).mean(axis=1).std())
    factors = None if shades is None else np.exp2(shades)
    return Light(exponents, offsets, np.exp2(octaves).astype(np.float32), unevenness, cells, factors)


def light_around(light: Light, things: NDArray[np.uint8]) -> Light:
    """The light where it is known what hides the ground: `things` (h, w) uint8, 255 or 0, of the pictures' size.

    All other ground near is trusted, plain ground too. The same `light` where that makes no difference near a thing.
    """
    size = light.cells.trust.shape[1], light.cells.trust.shape[0]
    covers = cv2.resize(cv2.dilate(things, np.ones((5, 5), np.uint8)), size, interpolation=cv2.INTER_AREA)
    hidden = covers > LEAST_HIDDEN
    near = cv2.dilate(hidden.view(np.uint8), np.ones((NEAR_CELLS, NEAR_CELLS), np.uint8)) > 0
    trusted = near & ~hidden if light.cells.known is None else near & ~hidden & light.cells.known
    trust = np.where(hidden, np.float32(0), np.where(trusted, np.float32(1), light.cells.trust))
    gains = np.exp2(_spread(light.cells.steps, trust) / STEPS_PER_OCTAVE).astype(np.float32)
    changes = np.abs(gains[near] - light.gains[near]) > LEAST_GAIN * light.gains[near]
    return replace(light, gains=gains) if changes.any() else light


def relit(image: Bgr, light: Light, out: Bgr | None = None) -> Bgr:
    """`image`, of the reference, in the query's light; written to `out` (h, w, 3) where it is given."""
    return relight(image, *_curves_and_gains(light, image.shape[1]), out=out)


def relit_parts(image: Bgr, light: Light, parts: Sequence[tuple[slice, slice]]) -> Bgr:
    """Some parts of `image`, of the reference, in the query's light; the rest of the picture holds anything."""
    return relight(image, *_curves_and_gains(light, image.shape[1]), parts)


def _curves_and_gains(light: Light, width: int) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
    """The light of pictures of a width as `relight` takes it."""
    levels = np.log2(np.arange(256) + BLACK_LEVEL)
    curves = 2.0 ** (light.exponents[:, None] * levels + light.offsets[:, None])
    table = np.clip(np.rint(curves * CURVE_ONE), 0, 16383).astype(np.int32)
    grid = light.gains
    if light.shades is not None:
        gains = cv2.resize(grid, light.shades.shape[1::-1], interpolation=cv2.INTER_LINEAR)
        grid = np.asarray(cv2.multiply(light.shades, gains), np.float32)
    steps = np.clip(np.rint(grid * GAIN_ONE), 0, 65535).astype(np.float32)
    return table, np.asarray(cv2.resize(steps, (width, len(steps)), interpolation=cv2.INTER_LINEAR), np.float32)


def _shades(
    reference: Bgr, query: Bgr, exponents: Floats, offsets: Floats, known: Mask | None
) -> NDArray[np.float32] | None:
    """Octaves (h, w, 3) by which shadows that moved changed the ground of two pictures (h, w, 3); None if nowhere."""
    levels, black = np.log2(np.arange(256)[:, None] + BLACK_LEVEL), np.log2(BLACK_LEVEL)
    tables = (
        np.clip(np.rint((each - black) * 2 * STEPS), 0, 255).astype(np.uint8)[None]
        for each in (exponents * levels + offsets, np.repeat(levels, 3, axis=1))
    )
    before, after = (np.asarray(cv2.LUT(*each), np.uint8) for each in zip((reference, query), tables))
    return moved_shades(before, after, _surely(known, (reference.shape[1], reference.shape[0])))


def _chosen(values: NDArray[np.float32], sure: Mask | None) -> NDArray[np.float32]:
    """Values (h, w, 3) of the cells that are `sure` (h, w), of all without it: (N, 3)."""
    return values.reshape(-1, 3) if sure is None else values[sure]


def _sameness(reference: Bgr, query: Bgr) -> NDArray[np.float32]:
    """How sure each cell (h, w) of `FINE` pixels a side shows the same ground, 0 to 1: both have its finest structure.

    Things put on the ground, however large, hide its structure: their cells do not count for the light.
    """
    before, after = (cv2.cvtColor(each, cv2.COLOR_BGR2GRAY) for each in (reference, query))
    products = detail_products(np.asarray(before, np.uint8), np.asarray(after, np.uint8), _LOG, DETAIL_PX, FINE)
    sums = [cv2.blur(each, (5, 5)) for each in products]
    alike = sums[0] / np.sqrt((sums[1] + FLAT) * (sums[2] + FLAT))
    sure = np.clip((alike - LEAST_ALIKE) / (MOST_ALIKE - LEAST_ALIKE), 0, 1)
    flat = np.exp(-(sums[1] + sums[2]) / (2 * FLAT)) * np.float32(FLAT_TRUST)
    return np.asarray(np.maximum(cv2.erode(sure, np.ones((3, 3), np.uint8)), flat), np.float32)


def _spread(values: NDArray[np.float32], weights: NDArray[np.float32]) -> NDArray[np.float32]:
    """Values (h, w, 3) smoothed with weights (h, w); where there are none, those of the nearest around."""
    stack = np.dstack([values * weights[..., None], weights])
    total = np.zeros_like(stack)
    for reach, weight in REACHES_CELLS:
        total += np.float32(weight) * cv2.blur(stack, (reach, reach))
    return np.asarray(total[..., :3] / (total[..., 3:] + np.float32(1e-6)), np.float32)


def _logarithm(image: NDArray[np.uint8]) -> NDArray[np.float32]:
    return np.asarray(cv2.LUT(image, _OCTAVES), np.float32)


def _smaller(image: NDArray[Any], size: tuple[int, int]) -> NDArray[np.uint8]:
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)


def _surely(known: Mask | None, size: tuple[int, int]) -> Mask | None:
    """Which pixels of a picture of `size` (w, h) lie on known ground alone; None where everything does."""
    return None if known is None else _smaller(known.astype(np.uint8) * 255, size) > 250
