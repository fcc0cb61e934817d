"""Many views laid on the forest floor and averaged: crowns blur away, and what lies on the floor comes together.

Levoy et al., "Synthetic aperture confocal imaging" (2004); Schedl, Kurmi and Bimber (2020), doi 10.1038/s42256-020-00261-3.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter, median_filter

from sorvolo.errors import InputError
from sorvolo.geometry.arrays import Floats, Floats32, Mask, Numbers, shrunk
from sorvolo.geometry.ground import laid_pixels
from sorvolo.heights.lattice import Lattice
from sorvolo.heights.views import View, inside

Picture = Callable[[int], Floats32]
"""The picture of view k as `levelled` gives it, (H, W) of a thermal camera or (H, W, 3) in colour."""

LEAST_VIEWS = 24
"""Fewer views of a place do not blur crowns away; by choice."""

_TILE_CELLS = 384
_BODY_M = 0.2  # sigma of what a body is averaged over
_AROUND_M = 3.0  # side of the surroundings that it is held against
_LOCAL_M = 15.0  # side of the ground whose own contrasts an anomaly is measured in
_CLIP = 3.0  # sigmas: what stands out does not widen the spread that it is measured in
_BLOCK_M = 5.0  # side of the ground that gets one height by focus
_FOCUS_STEP_M = 1.5
_CLEAR = 1.25  # times the sharpness below and above the floor
_STANDS_OUT = 3.0  # times the sharpness below the floor, where nothing is and chance makes tops
_NEAR_LEVEL_M = 6.0  # the floor is no farther from its own usual level
_MANY_VIEWS = 32.0
_SPARE = 0.05  # weight of that level beside what a place shows


@dataclass(frozen=True, eq=False)
class UnderTrees:
    """What the floor shows, arrays (H, W) of the lattice's cells, NaN where fewer than `LEAST_VIEWS` see it.

    `contrast` is the mean minus its surroundings. `anomaly` is the contrast of all bands in sigmas of the ground around
    (Reed and Xiaoli 1990); with one band it has the contrast's sign.
    """

    lattice: Lattice
    floor_m: Floats32
    mean: Floats32
    contrast: Floats32
    anomaly: Floats32
    views: Numbers


@dataclass(frozen=True, eq=False)
class Floor:
    """The floor's height (H, W) on a lattice by focus, site metres up, and its one sigma."""

    lattice: Lattice
    up_m: Floats32
    sigma_m: Floats32

    def on(self, lattice: Lattice) -> Floats32:
        """(H, W) the floor's height in the cells of another lattice."""
        at = self.lattice.cells_from_site(lattice.points_m().reshape(-1, 2)).astype(np.float32)
        x, y = at.T.reshape(2, *lattice.shape)
        up = cv2.remap(self.up_m, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(up, np.float32)


def lay(view: View, picture: Floats32, lattice: Lattice, floor_m: Floats32 | float) -> Floats32:
    """(H, W, bands) a view's picture on the floor, one height or (H, W), NaN where it does not show it."""
    size, border = (lattice.width, lattice.height), (np.nan,) * 4
    if isinstance(floor_m, float):
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        warp = pixels_from_cells(view, lattice, floor_m)
        laid = cv2.warpPerspective(picture, warp, size, flags=flags, borderValue=border)
    else:
        x, y = laid_pixels(view.camera, view.site_from_camera, lattice.site_from_cells, floor_m)
        laid = cv2.remap(picture, x, y, cv2.INTER_LINEAR, borderValue=border)
    return np.asarray(_banded(laid), np.float32)


def pixels_from_cells(view: View, lattice: Lattice, up_m: float) -> Floats:
    """(3, 3) from cells on level ground to a view's pixels."""
    plane = np.array([*lattice.site_from_cells[:2], [0, 0, up_m]])
    plane[:, 2] -= view.site_from_camera.translation_m
    return view.camera.matrix @ view.site_from_camera.rotation.T @ plane


def levelled(picture: Numbers) -> Floats32:
    """A picture without its usual level: cameras that adjust their range would leave seams."""
    usual = np.median(_banded(picture)[::4, ::4], axis=(0, 1))
    return np.asarray(picture - usual.astype(np.float32), np.float32)


def integrate(
    views: Sequence[View], picture: Picture, lattice: Lattice, floor_m: Floats32
) -> UnderTrees:
    """All views laid on the floor, (H, W) metres up, and put together, tile by tile."""
    mean = np.full((*lattice.shape, bands_of(picture(0))), np.nan, np.float32)
    count = np.zeros(lattice.shape, np.uint16)
    for x0, y0, x1, y1 in lattice.windows(_TILE_CELLS):
        box = np.s_[y0:y1, x0:x1]
        window = lattice.window(x0, y0, x1, y1)
        mean[box], count[box] = averaged(views, picture, window, floor_m[box], LEAST_VIEWS)
    contrast = against_surroundings(mean, lattice.cell_m)
    return UnderTrees(
        lattice,
        floor_m,
        mean.mean(axis=2),
        contrast.mean(axis=2),
        _anomaly(contrast, lattice.cell_m),
        count,
    )


def averaged(
    views: Sequence[View],
    picture: Picture,
    lattice: Lattice,
    floor_m: Floats32 | float,
    least: int,
) -> tuple[Floats32, Numbers]:
    """(H, W, bands) the mean of views laid on the floor, one height or (H, W), NaN below so many; (H, W) how many."""
    total, halves = _sums(views, picture, lattice, [floor_m])[0]
    count = halves.sum(axis=0)
    return _mean(total.sum(axis=0), count, least), count


def seeing(views: Sequence[View], lattice: Lattice, floor_m: Floats32 | float) -> list[int]:
    """The views that show any of the ground."""
    up_m = np.broadcast_to(np.float32(floor_m), lattice.shape)
    points = np.dstack([lattice.points_m(), up_m])[::16, ::16].reshape(-1, 3)
    return [
        k
        for k, view in enumerate(views)
        if inside(view.pixels_from_site(points), view.camera).any()
    ]


def _sums(
    views: Sequence[View], picture: Picture, lattice: Lattice, floors_m: Sequence[Floats32 | float]
) -> list[tuple[Floats32, Numbers]]:
    """For each floor (2, H, W, bands) sums and (2, H, W) counts of views, of the northern and the southern ones."""
    sums: list[tuple[Floats32, Numbers]] = []
    for number in seeing(views, lattice, floors_m[len(floors_m) // 2]):
        view, image = views[number], picture(number)
        row = lattice.cells_from_site(view.site_from_camera.translation_m[None, :2])[0, 1]
        row = int(np.clip(row, 0, lattice.height))
        for k, floor_m in enumerate(floors_m):
            laid = lay(view, image, lattice, floor_m)
            shown = np.isfinite(laid[..., 0])
            laid[~shown] = 0
            if len(sums) <= k:
                sums.append(
                    (np.zeros((2, *laid.shape), np.float32), np.zeros((2, *shown.shape), np.uint16))
                )
            for half, at in enumerate((slice(row, None), slice(0, row))):
                sums[k][0][half][at] += laid[at]
                sums[k][1][half][at] += shown[at]
    empty = np.zeros((2, *lattice.shape, bands_of(picture(0))), np.float32)
    return sums or [(empty, np.zeros((2, *lattice.shape), np.uint16))] * len(floors_m)


def bands_of(picture: Numbers) -> int:
    """1 of a thermal picture, 3 of one in colour."""
    return picture.shape[2] if picture.ndim == 3 else 1


def _mean(total: Floats32, count: Numbers, least: int) -> Floats32:
    """(H, W, bands) sums over counts, (H, W), NaN below the least."""
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(count[..., None] < least, np.float32(np.nan), total / count[..., None])


def against_surroundings(mean: Floats32, cell_m: float) -> Floats32:
    """(H, W, bands) a body's size of the mean minus what is around it; what is NaN counts for nothing."""
    known = np.isfinite(mean[..., 0])
    side = 2 * round(_AROUND_M / cell_m / 2) + 1
    with np.errstate(invalid="ignore", divide="ignore"):
        near, around = (
            _banded(smooth(np.nan_to_num(mean))) / smooth(known.astype(np.float32))[..., None]
            for smooth in (
                partial(cv2.GaussianBlur, ksize=(0, 0), sigmaX=_BODY_M / cell_m),
                partial(cv2.blur, ksize=(side, side)),
            )
        )
    return np.where(known[..., None], near - around, np.float32(np.nan))


def _banded(image: Any) -> Any:
    return image.reshape(*image.shape[:2], -1)


def _anomaly(contrast: Floats32, cell_m: float) -> Floats32:
    """(H, W) Reed and Xiaoli's: contrasts in sigmas of those around, what stands out clipped."""
    known = np.isfinite(contrast[..., 0])
    if not known.any():
        return np.full(known.shape, np.nan, np.float32)
    usual = 1.4826 * np.nanmedian(np.abs(contrast), axis=(0, 1)) + 1e-6
    clipped = np.nan_to_num(np.clip(contrast, -_CLIP * usual, _CLIP * usual))
    side = (round(_LOCAL_M / cell_m),) * 2
    with np.errstate(invalid="ignore", divide="ignore"):
        share = cv2.blur(known.astype(np.float32), side)
        spread = np.stack(
            [
                [cv2.blur(a * b, side) / share for b in np.moveaxis(clipped, 2, 0)]
                for a in np.moveaxis(clipped, 2, 0)
            ]
        )
    spread = np.moveaxis(spread, (0, 1), (2, 3))[known] + 0.1 * np.diag(usual**2)
    seen = contrast[known]
    far = np.sqrt(np.einsum("ni,nij,nj->n", seen, np.linalg.inv(spread), seen))
    anomaly = np.full(known.shape, np.nan, np.float32)
    anomaly[known] = far * np.sign(seen[:, 0]) if seen.shape[1] == 1 else far
    return anomaly


def focus(
    views: Sequence[View], picture: Picture, lattice: Lattice, low_m: float, high_m: float
) -> Floor:
    """The floor's height between two, metres up: where the integral is sharpest. Crowns are sharp at their own heights;
    the lowest height that is clear is the floor's. Its sigma holds what the northern and the southern views differ by."""
    fine = lattice.coarser(max(1, round(0.18 / lattice.cell_m)))
    cells = max(1, round(_BLOCK_M / fine.cell_m))
    blocks = fine.coarser(cells)
    heights_m = np.arange(low_m, high_m + _FOCUS_STEP_M, _FOCUS_STEP_M)
    score = np.zeros((3, len(heights_m), *blocks.shape), np.float32)
    often = np.zeros(blocks.shape, np.float32)
    for x0, y0, x1, y1 in blocks.windows(6):
        window = fine.window(x0 * cells, y0 * cells, x1 * cells, y1 * cells)
        floors_m = [float(each) for each in heights_m]
        for k, (total, count) in enumerate(_sums(views, picture, window, floors_m)):
            shape = x1 - x0, y1 - y0
            seen = count.sum(axis=0).astype(np.float32)
            often[y0:y1, x0:x1] = shrunk(seen, shape)
            for part, halves in enumerate(([0, 1], [0], [1])):
                seen = count[halves].sum(axis=0)
                mean = _mean(total[halves].sum(axis=0), seen, LEAST_VIEWS // 2)
                sharp = np.nan_to_num(against_surroundings(mean, fine.cell_m)) ** 2
                # few views leave noise; squared once more, for a floor may show little but what lies on it
                sharp = (sharp.sum(axis=2) * np.minimum(seen / _MANY_VIEWS, 1)) ** 2
                score[part, k, y0:y1, x0:x1] = shrunk(sharp, shape)
    score = gaussian_filter(score, (0, 0.7, 1.0, 1.0))
    # what few views show is crowns that have not blurred away
    pooled = score[0][:, often >= often.max() / 2].mean(axis=1)
    stands_out = pooled > _STANDS_OUT * np.minimum.accumulate(pooled)
    level_tops = np.flatnonzero(_clear_tops(pooled) & stands_out)
    if not len(level_tops):
        raise InputError(
            f"no height between {low_m:.0f} and {high_m:.0f} m brings a floor into focus: the cameras are not known "
            "well enough, the strips see it from one side, or it shows nothing (water); fly strips side by side"
        )
    near = round(_NEAR_LEVEL_M / _FOCUS_STEP_M)
    first = max(0, level_tops[0] - near)
    around = score[0, first : level_tops[0] + near + 1]
    tops = _clear_tops(around)
    found = tops.any(axis=0)
    at = np.where(found, np.argmax(around * tops, axis=0) + first, level_tops[0])
    up_m, one_m, other_m = (heights_m[at] + _FOCUS_STEP_M * _top(each, at) for each in score)
    # a block that shows nothing takes the height of those around, or the level of all
    level_m = np.median(up_m[found]) if found.any() else heights_m[level_tops[0]]
    usual_m = median_filter(np.where(found, up_m, level_m), 3)
    off_m2 = np.where(found, (one_m - other_m) ** 2 / 4 + (up_m - usual_m) ** 2, 0)
    share = gaussian_filter(found.astype(np.float64), 1.0) + _SPARE
    smooth_m = (gaussian_filter(np.where(found, usual_m, 0), 1.0) + _SPARE * level_m) / share
    sigma_m = np.sqrt((gaussian_filter(off_m2, 1.0) + _SPARE * _FOCUS_STEP_M**2) / share)
    return Floor(blocks, smooth_m.astype(np.float32), sigma_m.astype(np.float32))


def _clear_tops(score: Floats32) -> Mask:
    """Which heights, (N, ...), are sharper than those beside them and clearly than some below and some above."""
    tops = np.zeros(score.shape, bool)
    below, above = np.minimum.accumulate(score), np.minimum.accumulate(score[::-1])[::-1]
    clear = score > _CLEAR * np.maximum(below, above)
    tops[1:-1] = (score[1:-1] >= score[:-2]) & (score[1:-1] > score[2:]) & clear[1:-1]
    return tops


def _top(score: Floats32, at: Any) -> Floats:
    """Where a parabola through the score at these heights and their neighbours has its top, steps from them."""
    before, middle, after = (np.take_along_axis(score, at[None] + k, 0)[0] for k in (-1, 0, 1))
    with np.errstate(invalid="ignore", divide="ignore"):
        step = (before - after) / (2 * (before - 2 * middle + after))
    return np.clip(np.nan_to_num(step), -1, 1)
