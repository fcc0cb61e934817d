"""One picture in the light of another: a power law per channel for the camera, a smooth gain for clouds' shadows."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from sorvolo.change.pair.moved_shadows import STEPS, MovedShadowSettings, moved_shades
from sorvolo.geometry.arrays import Floats, Mask
from sorvolo.kernels import detail_products, relight, slopes

Bgr = NDArray[np.uint8]
"""(height, width, 3) uint8, blue green red."""

BLACK_LEVEL = 8.0  # grey levels added before logarithms: below it a camera shows noise, not light
STEPS_PER_OCTAVE = 48.0  # of local gains in a byte
GAIN_ONE, CURVE_ONE = 4096, 16  # fixed point of the kernel `relight`

_LOG = (np.log2(np.arange(256) + BLACK_LEVEL) * STEPS_PER_OCTAVE).astype(np.float32)
_OCTAVES = np.log2(np.arange(256, dtype=np.float32) + np.float32(BLACK_LEVEL))


@dataclass(frozen=True)
class LightSettings:
    """How the light is fitted (0007). Lengths in px of the half size pictures, or in cells."""

    cell_px: int = 8  # side of a cell that has one gain
    fine: int = (
        4  # pixels of a cell each way, where structure is compared and moved shadows are looked for
    )
    detail_px: int = 9  # details of the finest structure are what is smaller; fine pixels
    median_cells: int = 5  # what is smaller than half of it cannot change the local gain
    no_slope: float = (
        2e-4  # squared octaves a cell by which a slope is drawn to one where there is little to see
    )
    alike: tuple[float, float] = (
        0.25,
        0.5,
    )  # correlation of details: the ground is another one, and surely the same
    flat: float = (
        6.0  # what noise leaves of the variance of details, in squared steps of the logarithm
    )
    flat_trust: float = (
        0.003  # of cells without any structure: they count where nothing better is near
    )
    reaches: tuple[tuple[int, float], ...] = ((3, 1.0), (7, 0.1), (17, 0.01), (49, 1e-3))
    # cells each way within which a cell's gain counts for its neighbours', and with what weight
    moved: MovedShadowSettings = field(default_factory=MovedShadowSettings)


@dataclass(frozen=True, eq=False)
class Light:
    """What turns the reference's light into the query's: query + 8 = 2**offset * (reference + 8)**exponent * gain.

    `exponents` and `offsets` (3,) are per channel, blue green red; `gains` (h, w, 3) float32 are factors on a coarse
    grid over the picture; `unevenness` is their spread in octaves, what clouds do. `shades` (h, w, 3) are further
    factors on a finer grid, where shadows of tall things moved; None if nowhere.
    """

    exponents: Floats
    offsets: Floats
    gains: NDArray[np.float32]
    unevenness: float
    shades: NDArray[np.float32] | None = None

    @property
    def brightness(self) -> Floats:
        """(3,) by which factor a middle grey of the reference is brighter in the query."""
        middle = np.log2(100.0 + BLACK_LEVEL)
        return np.asarray(2.0 ** (self.offsets + (self.exponents - 1.0) * middle))


def fit_light(
    reference: Bgr, query: Bgr, known: Mask | None = None, settings: LightSettings = LightSettings()
) -> Light:
    """The light of `query` seen against `reference`, aligned to a few pixels; where not `known` it is the middle one.

    The exponents come from what both pictures show at middle scales, where neither clouds nor pixels' noise matter;
    fits are robust against things that changed.
    """
    height, width = reference.shape[:2]
    size = max(4, width // settings.cell_px), max(4, height // settings.cell_px)
    fine = settings.fine * size[0], settings.fine * size[1]
    reference, query = _smaller(reference, fine), _smaller(query, fine)
    before, after = (_logarithm(_smaller(each, size)) for each in (reference, query))
    sure = _surely(known, size)
    if sure is not None and sure.sum() < 16:
        return Light(np.ones(3), np.zeros(3), np.ones((*size[::-1], 3), np.float32), 0.0)
    window = (9, 9)
    detail_before = _chosen(before - cv2.blur(before, window), sure)[::2]
    detail_after = _chosen(after - cv2.blur(after, window), sure)[::2]
    # the ratio of spreads, the geometric mean of the regressions of each on the other: that of the query on the
    # reference alone would be too low by what noise, misalignment and clouds add to the spread of the reference
    exponents = slopes(detail_before, detail_after, settings.no_slope * len(detail_before)).clip(
        0.5, 2.0
    )
    offset = after - exponents.astype(np.float32) * before
    kept = _chosen(offset, sure)
    offsets = np.median(kept, axis=0).astype(np.float64)
    shades = _shades(reference, query, exponents, offsets, known, settings.moved)
    if shades is not None:
        offset -= cv2.resize(shades, size, interpolation=cv2.INTER_AREA)
    local = np.clip(
        np.rint((offset - offsets.astype(np.float32)) * STEPS_PER_OCTAVE + 128), 0, 255
    ).astype(np.uint8)
    same = _sameness(reference, query, settings)
    if sure is not None:
        same[~sure] = 0
    steps = cv2.medianBlur(local, settings.median_cells).astype(np.float32) - 128
    octaves = _spread(steps, same, settings.reaches) / STEPS_PER_OCTAVE
    unevenness = float(_chosen(octaves, sure).mean(axis=1).std())
    factors = None if shades is None else np.exp2(shades)
    return Light(exponents, offsets, np.exp2(octaves).astype(np.float32), unevenness, factors)


def relit(image: Bgr, light: Light, out: Bgr | None = None) -> Bgr:
    """`image`, of the reference, in the query's light; written to `out` (h, w, 3) where it is given."""
    return relight(image, *_curves_and_gains(light, image.shape[1]), out=out)


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
    return table, np.asarray(
        cv2.resize(steps, (width, len(steps)), interpolation=cv2.INTER_LINEAR), np.float32
    )


def _shades(
    reference: Bgr,
    query: Bgr,
    exponents: Floats,
    offsets: Floats,
    known: Mask | None,
    settings: MovedShadowSettings,
) -> NDArray[np.float32] | None:
    """Octaves (h, w, 3) by which shadows that moved changed the ground of two pictures (h, w, 3); None if nowhere."""
    levels, black = np.log2(np.arange(256)[:, None] + BLACK_LEVEL), np.log2(BLACK_LEVEL)
    tables = (
        np.clip(np.rint((each - black) * 2 * STEPS), 0, 255).astype(np.uint8)[None]
        for each in (exponents * levels + offsets, np.repeat(levels, 3, axis=1))
    )
    before, after = (
        np.asarray(cv2.LUT(*each), np.uint8) for each in zip((reference, query), tables)
    )
    return moved_shades(
        before, after, _surely(known, (reference.shape[1], reference.shape[0])), settings
    )


def _chosen(values: NDArray[np.float32], sure: Mask | None) -> NDArray[np.float32]:
    """Values (h, w, 3) of the cells that are `sure` (h, w), of all without it: (N, 3)."""
    return values.reshape(-1, 3) if sure is None else values[sure]


def _sameness(reference: Bgr, query: Bgr, settings: LightSettings) -> NDArray[np.float32]:
    """How sure each cell (h, w) shows the same ground, 0 to 1: both pictures have its finest structure.

    Things put on the ground, however large, hide its structure: their cells do not count for the light.
    """
    before, after = (cv2.cvtColor(each, cv2.COLOR_BGR2GRAY) for each in (reference, query))
    grays = np.asarray(before, np.uint8), np.asarray(after, np.uint8)
    products = detail_products(*grays, _LOG, settings.detail_px, settings.fine)
    sums = [cv2.blur(each, (5, 5)) for each in products]
    noise = settings.flat
    alike = sums[0] / np.sqrt((sums[1] + noise) * (sums[2] + noise))
    least, most = settings.alike
    sure = np.clip((alike - least) / (most - least), 0, 1)
    flat = np.exp(-(sums[1] + sums[2]) / (2 * noise)) * np.float32(settings.flat_trust)
    return np.asarray(np.maximum(cv2.erode(sure, np.ones((3, 3), np.uint8)), flat), np.float32)


def _spread(
    values: NDArray[np.float32], weights: NDArray[np.float32], reaches: Sequence[tuple[int, float]]
) -> NDArray[np.float32]:
    """Values (h, w, 3) smoothed with weights (h, w); where there are none, those of the nearest around."""
    stack = np.dstack([values * weights[..., None], weights])
    total = np.zeros_like(stack)
    for reach, weight in reaches:
        total += np.float32(weight) * cv2.blur(stack, (reach, reach))
    return np.asarray(total[..., :3] / (total[..., 3:] + np.float32(1e-6)), np.float32)


def _logarithm(image: NDArray[np.uint8]) -> NDArray[np.float32]:
    return np.asarray(cv2.LUT(image, _OCTAVES), np.float32)


def _smaller(image: NDArray[Any], size: tuple[int, int]) -> NDArray[np.uint8]:
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)


def _surely(known: Mask | None, size: tuple[int, int]) -> Mask | None:
    """Which pixels of a picture of `size` (w, h) lie on known ground alone; None where everything does."""
    return None if known is None else _smaller(known.astype(np.uint8) * 255, size) > 250
