"""Heights of cells by a sweep of level planes: where photos laid on a plane agree, the ground is at its height.

Collins 1996, with the photos compared pair by pair (normalised cross-correlation), so that no photo is the reference
and one that cannot see a place does not decide about it.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np

from sorvolo.geometry.arrays import Anything, Floats, ImageGray, Matrix3, Numbers
from sorvolo.heights.lattice import Lattice
from sorvolo.heights.semiglobal import SmoothingSettings, smoothed
from sorvolo.heights.views import View, inside


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


@dataclass(frozen=True, eq=False)
class Swept:
    """Heights of a window of cells, (H, W) each: `up_m` NaN where nothing agrees, the agreement (0 to 1) and how many
    photos could see the cell; `level_m` between planes."""

    up_m: Numbers
    score: Numbers
    seen_by: Numbers
    level_m: float
    spread: float  # tangent of the angle between the two photos farthest apart


def sweep(
    lattice: Lattice, views: Sequence[View], pictures: Callable[[int], ImageGray], low_m: float, high_m: float,
    settings: SweepSettings,
) -> Swept:
    """The heights between `low_m` and `high_m` of a lattice's cells.

    `pictures(i)` is view i's gray picture, uint8, of any size; it should have about a cell's detail.
    """
    chosen = choose_views(lattice, views, (low_m + high_m) / 2, settings.views)
    shape = lattice.shape
    if len(chosen) < 2:
        nothing = np.full(shape, np.nan, np.float32)
        return Swept(nothing, np.zeros(shape, np.float32), np.full(shape, len(chosen), np.float32), np.nan, 0.0)
    spread = _widest(lattice, [views[k] for k in chosen], (low_m + high_m) / 2)
    level_m = max(settings.level_px * lattice.cell_m / spread, (high_m - low_m) / (settings.most_levels - 1))
    levels = low_m + level_m * np.arange(int(np.ceil((high_m - low_m) / level_m)) + 1)
    laid = [_Laid(views[k], pictures(k), lattice) for k in chosen]
    agreement = np.empty((shape[0], len(levels), shape[1]), np.float32)
    seen_by = np.zeros(shape, np.float32)
    for number, up_m in enumerate(levels):
        agreement[:, number], seen = _agreement([each.at(float(up_m)) for each in laid], settings)
        np.maximum(seen_by, seen, out=seen_by)
    total = smoothed(1 - agreement, settings.smoothing)
    up_m, score = _best(total, agreement, levels)
    up_m[(score < settings.least_score) | (seen_by < 2)] = np.nan
    return Swept(up_m, score, seen_by, float(level_m), spread)


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
    while len(chosen) < count:
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


def _widest(lattice: Lattice, views: Sequence[View], up_m: float) -> float:
    middle = lattice.site_from_cells @ [(lattice.width - 1) / 2, (lattice.height - 1) / 2, 1.0]
    rays = np.array([view.site_from_camera.translation_m for view in views]) - [middle[0], middle[1], up_m]
    rays = rays[:, :2] / np.maximum(rays[:, 2:], 0.1)
    return max(0.05, float(np.linalg.norm(rays[:, None] - rays[None], axis=2).max()))


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

    def at(self, up_m: float) -> Anything:
        """(H, W) float32 the photo on the plane at a height; 0 outside of it."""
        picture_from_cells: Matrix3 = self._level + up_m * self._up
        return cv2.warpPerspective(
            self._picture, picture_from_cells, self._size, flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        ).astype(np.float32)


def _agreement(laid: list[Anything], settings: SweepSettings) -> tuple[Anything, Anything]:
    """(H, W) how well the photos agree, 0 to 1, and how many there are: the mean over pairs and sizes of patches."""
    known = [(each > 0).astype(np.float32) for each in laid]
    total, pairs = np.zeros_like(laid[0]), np.zeros_like(laid[0])
    patches = [_Patches(laid, known, side, settings.noise_levels) for side in settings.window_cells]
    for i in range(len(laid)):
        for j in range(i):
            product = cv2.multiply(laid[i], laid[j])
            for each in patches:
                total += each.likeness(product, i, j)
            pairs += known[i] * known[j]
    return total / (len(patches) * np.maximum(pairs, 1)), np.sum(known, axis=0)


class _Patches:
    """Means and spreads of the patches of one size, in each of the photos."""

    def __init__(self, laid: list[Anything], known: list[Anything], side: int, noise_levels: float) -> None:
        self._side = side, side
        self._means = [cv2.boxFilter(each, -1, self._side) for each in laid]
        self._weights = []
        for each, mean, there in zip(laid, self._means, known):
            spread = cv2.sqrBoxFilter(each, -1, self._side) - mean * mean
            self._weights.append(there / np.sqrt(np.maximum(spread, 0) + np.float32(noise_levels**2)))

    def likeness(self, product: Anything, i: int, j: int) -> Anything:
        """(H, W) the correlation of two photos' patches, 0 where they do not agree or are not known."""
        likeness: Anything = cv2.boxFilter(product, -1, self._side)
        likeness -= self._means[i] * self._means[j]
        likeness *= self._weights[i]
        likeness *= self._weights[j]
        return np.maximum(likeness, 0, out=likeness)


def _best(total: Anything, agreement: Anything, levels: Anything) -> tuple[Anything, Anything]:
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
