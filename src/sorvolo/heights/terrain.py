"""The ground under a height model: what stands on it taken off, and the gap closed from the ground around.

A progressive morphological filter (Zhang 2003; Pingel 2013): what an opening takes off, and what rises above it by more
than the ground's slope explains, is no ground; windows grow up to the widest thing.
"""

import cv2
import numpy as np
from cv2.typing import MatLike

from sorvolo.geometry.arrays import Floats32, Mask
from sorvolo.heights.lattice import Lattice

_CELL_M = 0.5  # the filter's own cells, at least
_SLOPE = 0.2  # of the ground, at most
_LEAST_HEIGHT_M = 0.3  # above the ground around: lower things are ground


_WIDEST_M = 30.0  # of a building or a grove
_GOES_ON_M = 2.0  # into a hole, of what stands at its rim


def terrain(lattice: Lattice, up_m: Floats32) -> tuple[Floats32, Mask]:
    """(H, W) the ground's height, everywhere, and which cells show it; `up_m` (H, W) may have holes (NaN)."""
    factor = max(1, round(_CELL_M / lattice.cell_m))
    low, known = _lowest(up_m, factor)
    is_ground = _ground_cells(filled(low, known), known, lattice.cell_m * factor)
    ground = cv2.GaussianBlur(filled(low, is_ground), (0, 0), 1.0)
    height, width = up_m.shape
    share, shift = 1 / factor, (1 - factor) / (2 * factor)
    coarse_from_fine = np.array([[share, 0, shift], [0, share, shift]])
    fine = cv2.warpAffine(
        ground,
        coarse_from_fine,
        (width, height),
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_REPLICATE,
    )
    with np.errstate(invalid="ignore"):
        shows = np.abs(up_m - fine) < _LEAST_HEIGHT_M
    return np.where(shows, up_m, fine).astype(np.float32), shows


def closed(lattice: Lattice, up_m: Floats32, bare_m: Floats32) -> Floats32:
    """(H, W) a surface without its holes (NaN): what stands beside one goes on a little, then it is bare ground."""
    levels = max(1, round(np.log2(_GOES_ON_M / lattice.cell_m)))
    return np.asarray(bare_m + filled(up_m - bare_m, np.isfinite(up_m), levels), np.float32)


def filled(up_m: Floats32, known: Mask, most_levels: int | None = None) -> Floats32:
    """(H, W) the heights with what is not known continued from around, coarse to fine; 0 where nothing known lies
    within so many halvings of the size."""
    values: Floats32 = np.where(known, up_m, 0).astype(np.float32)
    weights: Floats32 = known.astype(np.float32)
    levels: list[tuple[Floats32, Floats32]] = []
    while min(weights.shape) > 2 and weights.min() <= 0 and len(levels) != most_levels:
        levels.append((values, weights))
        values, weights = (np.asarray(cv2.pyrDown(each), np.float32) for each in (values, weights))
    mean = float(up_m[known].mean()) if most_levels is None and known.any() else 0.0
    result = np.where(weights > 1e-6, values / np.maximum(weights, 1e-6), mean).astype(np.float32)
    for values, weights in reversed(levels):
        wider = cv2.pyrUp(result, dstsize=weights.shape[1::-1])
        result = np.where(weights > 1e-3, values / np.maximum(weights, 1e-3), wider).astype(
            np.float32
        )
    return result


def _lowest(up_m: Floats32, factor: int) -> tuple[Floats32, Mask]:
    """The lowest height but for the lowest tenth of each block of cells, and which blocks have any."""
    height, width = (-(-side // factor) for side in up_m.shape)
    padded = np.full((height * factor, width * factor), np.nan, np.float32)
    padded[: up_m.shape[0], : up_m.shape[1]] = up_m
    blocks = (
        padded.reshape(height, factor, width, factor)
        .transpose(0, 2, 1, 3)
        .reshape(height, width, -1)
    )
    known = np.isfinite(blocks).sum(axis=2) >= max(1, blocks.shape[2] // 4)
    blocks = np.sort(np.where(np.isfinite(blocks), blocks, np.inf), axis=2)
    low = blocks[..., blocks.shape[2] // 10]
    return np.where(known, low, np.nan).astype(np.float32), known & np.isfinite(low)


def _ground_cells(low: Floats32, known: Mask, cell_m: float) -> Mask:
    # lone low cells are false matches: an opening of the negative takes them off before they pull the ground down
    surface = cv2.morphologyEx(cv2.medianBlur(low.astype(np.float32), 3), cv2.MORPH_CLOSE, _disk(1))
    is_ground = known.copy()
    opened = surface
    radius, before = 1, 0
    while radius * cell_m <= _WIDEST_M / 2 + cell_m:
        opened_now = cv2.morphologyEx(
            opened, cv2.MORPH_OPEN, _disk(radius), borderType=cv2.BORDER_REPLICATE
        )
        allowed = _LEAST_HEIGHT_M + _SLOPE * (radius - before) * cell_m
        is_ground &= opened - opened_now <= allowed
        opened, before = opened_now, radius
        radius = max(radius + 1, round(radius * 1.4))
    return is_ground & (np.abs(low - surface) < _LEAST_HEIGHT_M)


def _disk(radius: int) -> MatLike:
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
