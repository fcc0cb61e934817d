"""What no homography explains: two dates whose maps differ locally, by a smooth displacement between their pictures."""

from dataclasses import dataclass, replace
from functools import lru_cache

import cv2
import numpy as np
from cv2.typing import MatLike

from sorvolo.geometry.arrays import (
    Floats,
    Floats32,
    ImageGray,
    ImageRGB,
    Mask,
    PointsPx,
    Rows,
    shrunk,
    square,
)

# How a displacement is searched; cells and pixels are those of the small copies of the pictures.
_SIDE_PX = 480  # longest side of the copies: fine texture is what two dates share
_MOST_M = 1.5  # relief and errors of maps move ground by so much
_MOST_PX = 6  # no displacement is searched beyond
_CELL_PX = 15  # agreement is gathered in cells of this side
_WINDOW_CELLS = 3.0  # sigma of the window that looks for its displacement: things are much smaller
_SMOOTH_CELLS = 2.5  # sigma over which displacements are made smooth
_BAND_PX = 0.7  # windows that differ more from those around them have little weight
_FLAT_LEVELS2 = 1.0  # grey levels squared: gradients of the sensor's noise get no full voice
_EVEN_PX = 31  # window in which gradients are made even
_HARDLY = 0.001  # of the largest weight: pulls to no displacement where nothing is known
# of what cells held back moved by, squared, is left; 0.8 to 1.4 over other ground
_MOST_REST = 0.65


@dataclass(frozen=True, eq=False)
class LocalFit:
    """A smooth displacement: what the reference shows at y the query shows at y + `moved_px` there.

    `moved_px` (rows, columns, 2) are pixels of the pictures, x and y, at places spread evenly over them; `is_known`
    (rows, columns) where both pictures show ground. `rest` is the share of squared displacement that is left in the
    windows that were held back.
    """

    moved_px: Floats
    is_known: Mask
    rest: float

    @property
    def median_px(self) -> float:
        """Its size where there is ground."""
        return (
            float(np.median(np.linalg.norm(self.moved_px[self.is_known], axis=1)))
            if self.is_known.any()
            else 0.0
        )

    def places_px(self, width_px: int, height_px: int) -> PointsPx:
        """(rows x columns, 2) where in pictures of this size the displacements are."""
        rows, columns = self.is_known.shape
        x, y = np.meshgrid((np.arange(columns) + 0.5) / columns, (np.arange(rows) + 0.5) / rows)
        return np.column_stack([x.ravel(), y.ravel()]) * [width_px, height_px] - 0.5

    def warped(self, query: ImageRGB, valid: Mask) -> tuple[ImageRGB, Mask]:
        """The query (H, W, 3) moved onto the reference, and what of `valid` (H, W) both still show.

        They may be larger or smaller than the pictures that were fitted were: `resized` comes first.
        """
        height, width = valid.shape
        moved = cv2.resize(
            self.moved_px.astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR
        )
        x = moved[..., 0] + np.arange(width, dtype=np.float32)
        y = moved[..., 1] + np.arange(height, dtype=np.float32)[:, None]
        image = cv2.remap(query, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        inside = (x > -0.5) & (x < width - 0.5) & (y > -0.5) & (y < height - 0.5)
        return np.asarray(image, np.uint8), valid & inside

    def resized(self, factor: float) -> "LocalFit":
        """The same for pictures so many times as large."""
        return replace(self, moved_px=self.moved_px * factor)


def fit_locally(
    reference: ImageGray, query: ImageGray, known: Mask, m_per_px: float
) -> LocalFit | None:
    """The displacement between two aligned pictures (H, W) of one size, None where it is not confirmed.

    Gradients of both, made even, are multiplied at every displacement up to the bound and gathered in cells. Each
    cell's window has the displacement at which they agree most; these are smoothed, those that differ from the ones
    around them counting little, so that a thing that moved is not followed. Half of the cells are held back first:
    a displacement made of the others must be what they have, too. `m_per_px` is the ground's size of a pixel.
    """
    height, width = known.shape
    scale = min(1.0, _SIDE_PX / max(height, width))
    size = round(width * scale), round(height * scale)
    most_px = _MOST_M / m_per_px * scale
    reach = int(np.clip(np.ceil(most_px), 1, _MOST_PX))
    cells = max(1, round(size[0] / _CELL_PX)), max(1, round(size[1] / _CELL_PX))
    if min(cells) < 4 or min(size) < 4 * reach:
        return None
    share = shrunk(known.astype(np.float32), size)
    seen = cv2.erode((share > 0.99).astype(np.float32), square(5))  # no gradients of the map's rim
    on_map = np.asarray(shrunk(seen, cells), np.float32)
    still, moving = (_even_gradients(image, size) for image in (reference, query))
    agreement = _agreement((still[0] * seen, still[1] * seen), moving, reach, cells)
    checks = np.indices(cells[::-1]).sum(axis=0) % 2 == 0
    rest = _rest(agreement, (on_map * checks, on_map * ~checks), reach)
    if rest > _MOST_REST:
        return None
    moved, _, _ = _field(agreement, on_map, reach)
    return LocalFit(_bounded(moved, most_px) / scale, on_map > 0.5, rest)


def _even_gradients(image: ImageGray, size: tuple[int, int]) -> tuple[MatLike, MatLike]:
    """Gradients in x and y, (h, w) each, of a small copy, of like strength everywhere: light falls out of them."""
    gray = shrunk(image, size).astype(np.float32)
    across, down = (cv2.Scharr(gray, cv2.CV_32F, 1 - axis, axis, scale=1 / 16) for axis in (0, 1))
    strength = cv2.add(cv2.multiply(across, across), cv2.multiply(down, down))
    around = cv2.blur(strength, (_EVEN_PX, _EVEN_PX))
    even = cv2.sqrt(np.asarray(strength) + np.asarray(around) + np.float32(_FLAT_LEVELS2))
    return cv2.divide(across, even), cv2.divide(down, even)


def _agreement(
    still: tuple[MatLike, MatLike],
    moving: tuple[MatLike, MatLike],
    reach: int,
    cells: tuple[int, int],
) -> Floats32:
    """((2 reach + 1)^2, rows, columns): how well gradients agree, by displacement (y first) and cell."""
    height, width = still[0].shape
    padded = [
        cv2.copyMakeBorder(each, reach, reach, reach, reach, cv2.BORDER_CONSTANT) for each in moving
    ]
    side = 2 * reach + 1
    result = np.empty((side * side, cells[1], cells[0]), np.float32)
    across, down = np.empty((height, width), np.float32), np.empty((height, width), np.float32)
    for index in range(side * side):
        y, x = divmod(index, side)
        cv2.multiply(still[0], padded[0][y : y + height, x : x + width], dst=across)
        cv2.multiply(still[1], padded[1][y : y + height, x : x + width], dst=down)
        cv2.add(across, down, dst=across)
        result[index] = shrunk(across, cells)
    return result


def _rest(agreement: Floats32, halves: tuple[Floats32, Floats32], reach: int) -> float:
    """The share of the second half's displacements that is left by the smooth one of the first; 1 where it is none.

    Each half's cells have windows of their own, so that the noise of one half is independent of the other's.
    """
    field, _, _ = _field(agreement, halves[0], reach)
    _, moved, sure = _field(agreement, halves[1], reach)
    if not sure.any():
        return 1.0
    before, after = (float(_capped(each) @ sure.ravel()) for each in (moved, moved - field))
    return after / max(before, 1e-9)


def _capped(moved: Floats) -> Floats:
    """(N,) lengths squared, of which those far beyond the band count alike."""
    square: Floats = np.square(moved).sum(axis=2).ravel()
    capped: Floats = square / (square + 9.0 * _BAND_PX**2)
    return capped


def _field(agreement: Floats32, counts: Floats32, reach: int) -> tuple[Floats, Floats, Floats]:
    """The smooth displacement, x and y, that cells agree on, (rows, columns, 2); each window's own, and how sure that
    is, (rows, columns). `counts` (rows, columns) is what each cell counts, 0 to 1."""
    side = 2 * reach + 1
    gathered = _smooth(agreement * counts, _WINDOW_CELLS)
    gathered /= np.maximum(_smooth(counts[None], _WINDOW_CELLS), np.float32(1e-3))
    best = gathered.argmax(axis=0)
    y, x = np.divmod(best, side)
    top, spread = gathered.max(axis=0), gathered.std(axis=0) + 1e-6
    moved: Floats = (
        np.stack([_peak(gathered, best, x, side, 1), _peak(gathered, best, y, side, side)], axis=2)
        - reach
    )
    is_inside = (x > 0) & (y > 0) & (x < side - 1) & (y < side - 1)
    sure: Floats = (
        np.maximum(0, (top - gathered.mean(axis=0)) / spread - 2) * np.maximum(0, top) * is_inside
    )
    weight, field = sure, moved
    for _ in range(5):
        total = _smooth(weight[None], _SMOOTH_CELLS)[0] + _HARDLY * sure.max() + 1e-12
        field = np.moveaxis(
            _smooth(np.moveaxis(moved * weight[..., None], 2, 0), _SMOOTH_CELLS) / total,
            0,
            2,
        )
        apart = np.linalg.norm(moved - field, axis=2)
        weight = sure / (1 + (apart / _BAND_PX) ** 2) ** 2
    return field, moved, sure


def _peak(planes: Floats32, best: Rows, along: Rows, side: int, step: int) -> Floats:
    """(rows, columns) the place of the highest plane along one axis, to a part of a step by a parabola."""

    def value(offset: int) -> Floats32:
        index = np.clip(best + offset, 0, len(planes) - 1)
        return np.take_along_axis(planes, index[None], axis=0)[0]

    before, here, after = value(-step), value(0), value(step)
    bend = before - 2 * here + after
    part = np.where(bend < 0, 0.5 * (before - after) / np.minimum(bend, -1e-9), 0.0)
    return along.astype(np.float64) + np.where(
        (along > 0) & (along < side - 1), np.clip(part, -0.5, 0.5), 0.0
    )


def _smooth(planes: Floats | Floats32, sigma_cells: float) -> Floats32:
    """(N, rows, columns) each plane smoothed; the rim counts what is there."""
    _, rows, columns = planes.shape
    smoothed: Floats32 = (
        _blur(rows, sigma_cells) @ planes.astype(np.float32) @ _blur(columns, sigma_cells).T
    )
    return smoothed


@lru_cache(maxsize=16)
def _blur(count: int, sigma: float) -> Floats32:
    """(count, count) a Gaussian's weights between places in a row, each row's sum 1."""
    apart = np.arange(count)[:, None] - np.arange(count)
    weights = np.exp(-0.5 * (apart / sigma) ** 2)
    return (weights / weights.sum(axis=1, keepdims=True)).astype(np.float32)


def _bounded(moved: Floats, most: float) -> Floats:
    """Displacements (rows, columns, 2) no longer than `most`."""
    length = np.linalg.norm(moved, axis=2, keepdims=True)
    return moved * np.minimum(1, most / np.maximum(length, 1e-9))
