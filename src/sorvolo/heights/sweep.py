"""Heights of cells by a sweep of level planes: where photos laid on a plane agree, the ground is at its height.

Collins 1996, with the photos compared pair by pair (normalised cross-correlation), so that no photo is the reference
and one that cannot see a place does not decide about it.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np

from sorvolo.geometry.arrays import Floats, Floats32, ImageGray, Mask, Matrix3
from sorvolo.heights.lattice import Lattice
from sorvolo.heights.semiglobal import SmoothingSettings, smoothed
from sorvolo.heights.views import View, inside

_MORE = 3  # views beyond the wanted ones


@dataclass(frozen=True)
class SweepSettings:
    """How photos are compared."""

    views: int = 4  # laid over each other at a time
    window_cells: tuple[int, int] = (5, 15)  # sides of the patches that are compared: detail, and what is sure
    noise_levels: float = 3.0  # gray levels; texture below it decides nothing
    level_px: float = 0.8  # parallax between two planes, of the two photos farthest apart
    most_levels: int = 160
    least_score: float = 0.1  # of agreement, 0 to 1, below which a cell stays a hole
    smoothing: SmoothingSettings = field(default_factory=SmoothingSettings)


@dataclass(frozen=True)
class Bounds:
    """Which heights are looked for, and at which most ground lies, m."""

    low_m: float
    high_m: float
    usual_m: float


@dataclass(frozen=True, eq=False)
class Swept:
    """Heights of a window of cells, (H, W) each: `up_m` NaN where nothing agrees, the agreement (0 to 1), how many
    photos see the cell, and the tangent of the angle between the two of them farthest apart."""

    up_m: Floats32
    score: Floats32
    seen_by: Floats32
    spread: Floats32


def sweep(
    lattice: Lattice, views: Sequence[View], pictures: Callable[[int], ImageGray], bounds: Bounds,
    settings: SweepSettings,
) -> Swept:
    """The heights within bounds of a lattice's cells.

    `pictures(i)` is view i's gray picture, uint8, of any size; it should have about a cell's detail. A cell that fewer
    than two photos see when it lies at the usual height is a hole: two photos see more of the depth than of the ground,
    so that at their rim every match is too low.
    """
    low_m, high_m = bounds.low_m, bounds.high_m
    chosen = choose_views(lattice, views, bounds.usual_m, settings.views)
    shape = lattice.shape
    if len(chosen) < 2:
        nothing = np.full(shape, np.nan, np.float32)
        return Swept(nothing, *(np.full(shape, each, np.float32) for each in (0.0, len(chosen), 0.0)))
    spreads = _spreads(lattice, [views[k] for k in chosen], bounds.usual_m)
    finest_m = settings.level_px * lattice.cell_m / max(float(spreads.max()), 0.05)
    level_m = max(finest_m, (high_m - low_m) / (settings.most_levels - 1))
    levels = low_m + level_m * np.arange(int(np.ceil((high_m - low_m) / level_m)) + 1)
    laid = [_Laid(views[k], pictures(k), lattice) for k in chosen]
    agreement = np.empty((shape[0], len(levels), shape[1]), np.float32)
    for number, up_m in enumerate(levels):
        agreement[:, number] = _agreement([each.at(float(up_m)) for each in laid], settings)
    seen = [_whole(each.at(bounds.usual_m), min(settings.window_cells)) for each in laid]
    seen_by = np.sum(seen, axis=0).astype(np.float32)
    total = smoothed(1 - agreement, settings.smoothing)
    up_m, score = _best(total, agreement, levels)
    up_m[(score < settings.least_score) | (seen_by < 2)] = np.nan
    return Swept(up_m, score, seen_by, _widest(seen, spreads))


def choose_views(lattice: Lattice, views: Sequence[View], up_m: float, count: int) -> list[int]:
    """The rows of the views to compare over a lattice: those that see much of it, from angles that differ well."""
    across = np.linspace(0, 1, 5)
    x, y = np.meshgrid(across * (lattice.width - 1), across * (lattice.height - 1))
    cells = np.column_stack([x.ravel(), y.ravel(), np.ones(x.size)])
    ground = np.column_stack([(cells @ lattice.site_from_cells.T)[:, :2], np.full(x.size, up_m)])
    covers = np.array([inside(view.pixels_from_site(ground), view.camera) for view in views]).reshape(len(views), -1)
    middle = ground.mean(axis=0)
    rays = np.array([view.site_from_camera.translation_m for view in views]) - middle
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    chosen: list[int] = []
    least = np.ones(len(views))
    seen = np.zeros(len(ground))
    wanted = np.minimum(covers.sum(axis=0), 2)  # ground that only photos left out see would be a hole
    while len(chosen) < count or (len(chosen) < count + _MORE and (seen < wanted).any()):
        need = 1 / (1.0 + seen) ** 2
        worth = (covers * need).sum(axis=1) / need.sum() * (np.abs(rays[:, 2]) if not chosen else least)
        worth[chosen] = 0
        best = int(worth.argmax())
        if worth[best] <= 1e-3:
            break
        chosen.append(best)
        seen += covers[best]
        angle = np.arccos(np.clip(rays @ rays[best], -1, 1))
        least = np.minimum(least, _usefulness(angle))
    return chosen


def _usefulness(angle: Floats) -> Floats:
    """0 to 1: two photos from the same place show no height, from too far apart nothing alike."""
    return np.clip(angle / 0.35, 0.05, 1) * np.clip((1.2 - angle) / 0.5, 0.02, 1)


def _spreads(lattice: Lattice, views: Sequence[View], up_m: float) -> Floats:
    """(V, V) how far apart two photos stand, seen from the lattice's middle, over how high they are."""
    middle = lattice.site_from_cells @ [(lattice.width - 1) / 2, (lattice.height - 1) / 2, 1.0]
    rays = np.array([view.site_from_camera.translation_m for view in views]) - [middle[0], middle[1], up_m]
    rays = rays[:, :2] / np.maximum(rays[:, 2:], 0.1)
    return np.asarray(np.linalg.norm(rays[:, None] - rays[None], axis=2))


def _widest(seen: Sequence[Mask], spreads: Floats) -> Floats32:
    """(H, W) the largest spread of two photos that see a cell; 0 where fewer do."""
    widest = np.zeros(seen[0].shape, np.float32)
    for i in range(len(seen)):
        for j in range(i):
            np.maximum(widest, np.float32(spreads[i, j]), out=widest, where=seen[i] & seen[j])
    return widest


class _Laid:
    """A photo that is laid on level planes over a lattice."""

    def __init__(self, view: View, picture: ImageGray, lattice: Lattice) -> None:
        # black is what lies outside of the photo
        self._picture = np.maximum(picture, 1)
        self._size = lattice.width, lattice.height
        camera = view.camera.resized(picture.shape[1], picture.shape[0])
        turn = view.site_from_camera.rotation.T
        project = camera.matrix @ np.column_stack([turn, -turn @ view.site_from_camera.translation_m])
        self._level = project[:, :2] @ lattice.site_from_cells[:2] + np.outer(project[:, 3], [0, 0, 1])
        self._up = np.outer(project[:, 2], [0, 0, 1])

    def at(self, up_m: float) -> Floats32:
        """(H, W) float32 the photo on the plane at a height; 0 outside of it."""
        picture_from_cells: Matrix3 = self._level + up_m * self._up
        return cv2.warpPerspective(
            self._picture, picture_from_cells, self._size, flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        ).astype(np.float32)


def _agreement(laid: list[Floats32], settings: SweepSettings) -> Floats32:
    """(H, W) how well the photos agree, 0 to 1: the mean over pairs and over the sizes of patches that they have."""
    total, pairs = np.zeros_like(laid[0]), np.zeros_like(laid[0])
    patches = [_Patches(laid, side, settings.noise_levels) for side in settings.window_cells]
    for i in range(len(laid)):
        for j in range(i):
            product = laid[i] * laid[j]
            for each in patches:
                total += each.likeness(product, i, j)
                pairs += each.known[i] * each.known[j]
    return np.asarray(total / np.maximum(pairs, 1), np.float32)


class _Patches:
    """Means and spreads of the patches of one size in each of the photos, where they lie in it as a whole."""

    def __init__(self, laid: list[Floats32], side: int, noise_levels: float) -> None:
        self._side = side, side
        self.known = [_whole(each, side).astype(np.float32) for each in laid]
        self._means = [cv2.boxFilter(each, -1, self._side) for each in laid]
        self._weights = []
        for each, mean, there in zip(laid, self._means, self.known):
            spread = cv2.sqrBoxFilter(each, -1, self._side) - mean * mean
            self._weights.append(there / np.sqrt(np.maximum(spread, 0) + np.float32(noise_levels**2)))

    def likeness(self, product: Floats32, i: int, j: int) -> Floats32:
        """(H, W) the correlation of two photos' patches, 0 where they do not agree or are not known."""
        likeness = np.asarray(cv2.boxFilter(product, -1, self._side), np.float32)
        likeness -= self._means[i] * self._means[j]
        likeness *= self._weights[i]
        likeness *= self._weights[j]
        return np.maximum(likeness, 0, out=likeness)


def _whole(laid: Floats32, side: int) -> Mask:
    """(H, W) where a patch lies in the photo as a whole: beyond its border it would see the border, not the ground."""
    return cv2.erode((laid > 0).view(np.uint8), np.ones((side, side), np.uint8)) > 0


def _best(total: Floats32, agreement: Floats32, levels: Floats32) -> tuple[Floats32, Floats32]:
    """(H, W) the height of least total cost, between levels by a parabola, and the agreement there."""
    best = total.argmin(axis=1)
    around = np.clip(best, 1, max(len(levels) - 2, 1))
    rows, columns = np.indices(best.shape, sparse=True)
    score = agreement[rows, best, columns]
    if len(levels) < 3:
        return levels[best].astype(np.float32), score
    below, here, above = (total[rows, around + k, columns] for k in (-1, 0, 1))
    bend = np.maximum(below + above - 2 * here, 1e-6)
    shift = np.clip((below - above) / (2 * bend), -0.5, 0.5)
    up_m = levels[around] + shift * (levels[1] - levels[0])
    is_edge = best != around
    up_m[is_edge] = levels[best[is_edge]]
    return up_m.astype(np.float32), score
