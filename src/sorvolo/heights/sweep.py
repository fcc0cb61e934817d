"""Heights of cells by a sweep of level planes: where photos laid on a plane agree, the ground is at its height.

Collins 1996, with the photos compared pair by pair (normalised cross-correlation), so that no photo is the reference
and one that cannot see a place does not decide about it.
"""

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from sorvolo import kernels
from sorvolo.geometry.arrays import Floats, Floats32, ImageGray, Mask, Matrix3, PointsM
from sorvolo.geometry.homography import shifted
from sorvolo.heights.lattice import Lattice
from sorvolo.heights.obstacles import Obstacles
from sorvolo.heights.views import View, inside

_MORE = 3  # views beyond the wanted ones ...
_LEFT_OUT = 0.04  # ... while two of those that are chosen leave out so much of the ground that two could show
_ANGLES = 16  # directions in a picture that are distinguished, over half a turn
_ANGLE_RAD = np.pi / _ANGLES

_VIEWS = 4  # laid over each other at a time
_CONTRAST_PX = 9  # side of the surroundings that a pixel's gray is measured against
_PAIR_SHARE = 0.5  # of the pairs of photos that see a cell: the others may be hidden from it
_NOISE_LEVELS = 3.0  # gray levels; texture below it decides nothing
_LEVEL_PX = 0.8  # parallax between two planes, of the two photos farthest apart
_MOST_LEVELS = 160  # planes of one sweep: bounds time and memory
_LEAST_SCORE = 0.1  # of agreement, 0 to 1, below which a cell stays a hole
# what heights cost beside their matching cost (0 to 1), in its units
_ONE_LEVEL = 0.1  # a change of height between neighbours
# below a cell's mean cost is that of a height at which fewer than two photos see it
_UNSEEN_SIGMAS = np.float32(1.5)
# of a path's total cost, by which a height is e times less likely: fits sigma to errors
_TEMPERATURE = 0.04


@dataclass(frozen=True)
class SweepSettings:
    """How photos are compared."""

    # sides of the patches that are compared: detail, and what is sure
    window_cells: tuple[int, int] = (
        5,
        15,
    )
    edge_cost: float = 0.9  # of any change of height above one level: an edge of a roof


@dataclass(frozen=True)
class Bounds:
    """Which heights are looked for, and at which most ground lies, m."""

    low_m: float
    high_m: float
    usual_m: float


@dataclass(frozen=True, eq=False)
class Swept:
    """Heights of a window of cells, (H, W) each: `up_m` NaN where nothing agrees, the agreement (0 to 1), how many
    photos see the cell, the tangent of the angle between the two of them farthest apart, how far from the height
    those lie that are likely too, and how many photos see the cell at its height."""

    up_m: Floats32
    score: Floats32
    seen_by: Floats32
    spread: Floats32
    deviation_m: Floats32
    shown_by: Floats32


def sweep(
    lattice: Lattice,
    views: Sequence[View],
    pictures: Callable[[int], ImageGray],
    bounds: Bounds,
    settings: SweepSettings,
    obstacles: Obstacles | None = None,
) -> Swept:
    """The heights within bounds of a lattice's cells; a photo from which an obstacle hides a height does not count.

    `pictures(i)` is view i's gray picture, uint8, of any size; it should have about a cell's detail. Which photos
    see a cell depends on its height: where fewer than two see the height that fits best, the cell is a hole.
    """
    low_m, high_m = bounds.low_m, bounds.high_m
    chosen = choose_views(lattice, views, bounds.usual_m, _VIEWS, obstacles)
    shape = lattice.shape
    if len(chosen) < 2:
        nothing = np.full(shape, np.nan, np.float32)
        return Swept(
            nothing,
            *(np.full(shape, each, np.float32) for each in (0.0, len(chosen), 0.0, np.nan, 0.0)),
        )
    spreads = _spreads(lattice, [views[k] for k in chosen], bounds.usual_m)
    finest_m = _LEVEL_PX * lattice.cell_m / max(float(spreads.max()), 0.05)
    level_m = max(finest_m, (high_m - low_m) / (_MOST_LEVELS - 1))
    levels: Floats = low_m + level_m * np.arange(int(np.ceil((high_m - low_m) / level_m)) + 1.0)
    eyes_m = np.array([views[k].site_from_camera.translation_m for k in chosen])
    laid = [_Laid(views[k], pictures(k), lattice, bounds, eyes_m) for k in chosen]
    least, usual_m = min(settings.window_cells), np.full(shape, bounds.usual_m, np.float32)
    seen = [each.shows(usual_m, least) for each in laid]
    if obstacles is not None:
        for each, eye_m in zip(laid, eyes_m):
            each.hidden_below_m = obstacles.hidden_below_m(lattice, eye_m)
    agreement = kernels.agreements(
        [each.contrast for each in laid],
        np.array([each.channel for each in laid]),
        np.array([each.planes for each in laid]),
        np.array([each.frame for each in laid]),
        np.array([[each.inset_px(side) for side in settings.window_cells] for each in laid]),
        [each.hidden_below_m for each in laid],
        levels,
        settings.window_cells,
        laid[0].shape,
        _PAIR_SHARE,
        cv2.getNumThreads(),
    )
    seen_by = np.sum(seen, axis=0).astype(np.float32)
    total = kernels.path_costs(_cost(agreement), _ONE_LEVEL, settings.edge_cost)
    up_m, score = _best(total, agreement, levels)
    # (H, W) the root mean square distance of the other levels from a height, each by its
    # probability.
    chance = np.exp((total.min(axis=1, keepdims=True) - total) / (8 * _TEMPERATURE))
    away = levels[None, :, None].astype(np.float32) - up_m[:, None]
    deviation = np.asarray(np.sqrt((chance * away**2).sum(axis=1) / chance.sum(axis=1)), np.float32)
    # no two photos see the height that fits, or they do not agree
    up_m[~(score >= _LEAST_SCORE)] = np.nan
    shown_by = np.sum([each.shows(up_m, least) for each in laid], axis=0).astype(np.float32)
    # (H, W) the largest spread of two photos that see a cell; 0 where fewer do
    widest = np.zeros(seen[0].shape, np.float32)
    for i in range(len(seen)):
        for j in range(i):
            np.maximum(widest, np.float32(spreads[i, j]), out=widest, where=seen[i] & seen[j])
    return Swept(up_m, score, seen_by, widest, deviation, shown_by)


def likeness_on(
    lattice: Lattice,
    views: Sequence[View],
    pictures: Callable[[int], ImageGray],
    up_m: Floats32,
    chosen: Sequence[int],
    settings: SweepSettings,
) -> Iterator[tuple[int, int, Floats32]]:
    """Two of the chosen views each, by number, and how alike (0 to 1) they are on heights without holes, (H, W).

    It is 0 where a photo does not show the smaller patch as a whole.
    """
    if len(chosen) < 2:
        return
    bounds = Bounds(float(up_m.min()), float(up_m.max()), float(np.median(up_m)))
    eyes_m = np.array([views[k].site_from_camera.translation_m for k in chosen])
    laid = [_Laid(views[k], pictures(k), lattice, bounds, eyes_m) for k in chosen]
    shown = [each.shows(up_m, min(settings.window_cells)) for each in laid]
    on = [each.on(up_m) for each in laid]
    for i, j in itertools.combinations(range(len(laid)), 2):
        both = shown[i] & shown[j]
        if both.any():
            product = on[i][j] * on[j][i]
            alike = sum(
                np.maximum(cv2.boxFilter(product, -1, (side, side)), 0)
                for side in settings.window_cells
            )
            share = np.float32(1 / len(settings.window_cells))
            yield chosen[i], chosen[j], np.asarray(alike * both * share, np.float32)


def choose_views(
    lattice: Lattice,
    views: Sequence[View],
    up_m: float,
    count: int,
    obstacles: Obstacles | None = None,
) -> list[int]:
    """The rows of the views to compare over a lattice: those that see much of it, from angles that differ well.

    `obstacles` hide ground from them; without any, the ground is level at a height.
    """
    ground, covers = (
        _level_shown(lattice, views, up_m) if obstacles is None else obstacles.shown(lattice, views)
    )
    middle = ground.mean(axis=0)
    rays = np.array([view.site_from_camera.translation_m for view in views]) - middle
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    chosen: list[int] = []
    least = np.ones(len(views))
    seen = np.zeros(len(ground))
    # ground that only photos left out see would be a hole
    wanted = np.minimum(covers.sum(axis=0), 2)
    while len(chosen) < count or (
        len(chosen) < count + _MORE and (seen < wanted).mean() >= _LEFT_OUT
    ):
        need = 1 / (1.0 + seen) ** 2
        worth = (
            (covers * need).sum(axis=1) / need.sum() * (np.abs(rays[:, 2]) if not chosen else least)
        )
        worth[chosen] = 0
        best = int(worth.argmax())
        if worth[best] <= 1e-3:
            break
        chosen.append(best)
        seen += covers[best]
        angle = np.arccos(np.clip(rays @ rays[best], -1, 1))
        least = np.minimum(
            least, np.clip(angle / 0.35, 0.05, 1) * np.clip((1.2 - angle) / 0.5, 0.02, 1)
        )
    return chosen


def _level_shown(lattice: Lattice, views: Sequence[View], up_m: float) -> tuple[PointsM, Mask]:
    """Places all over a lattice at a height, (P, 3), and which of the views show each, (V, P)."""
    across = np.linspace(0, 1, 5)
    x, y = np.meshgrid(across * (lattice.width - 1), across * (lattice.height - 1))
    cells = np.column_stack([x.ravel(), y.ravel(), np.ones(x.size)])
    ground = np.column_stack([(cells @ lattice.site_from_cells.T)[:, :2], np.full(x.size, up_m)])
    shown = [inside(view.pixels_from_site(ground), view.camera) for view in views]
    return ground, np.array(shown).reshape(len(views), -1)


def _spreads(lattice: Lattice, views: Sequence[View], up_m: float) -> Floats:
    """(V, V) how far apart two photos stand, seen from the lattice's middle, over how high they are."""
    middle = lattice.site_from_cells @ [(lattice.width - 1) / 2, (lattice.height - 1) / 2, 1.0]
    rays = np.array([view.site_from_camera.translation_m for view in views]) - [
        middle[0],
        middle[1],
        up_m,
    ]
    rays = rays[:, :2] / np.maximum(rays[:, 2:], 0.1)
    return np.linalg.norm(rays[:, None] - rays[None], axis=2)


class _Laid:
    """A photo that is laid on heights over a lattice: of each pixel how it differs from its surroundings.

    `contrast` (C, h, w) is that along each of C directions, of the part of the picture that the cells see; `channel`
    (N,) which of them counts against each of the others. `planes` (2, 3, 3) map cells to that part at height 0, and
    what a metre of height adds; `frame` left, top, right, bottom is where the photo ends in it.
    """

    def __init__(
        self,
        view: View,
        picture: ImageGray,
        lattice: Lattice,
        bounds: Bounds,
        others_m: PointsM,
    ) -> None:
        self.shape = lattice.shape
        self.hidden_below_m: Floats32 | None = None  # it does not show what lies lower, (H, W)
        camera = view.camera.resized(picture.shape[1], picture.shape[0])
        eye_m, turn = view.site_from_camera.translation_m, view.site_from_camera.rotation.T
        project = camera.matrix @ np.column_stack([turn, -turn @ eye_m])
        level = project[:, :2] @ lattice.site_from_cells[:2] + np.outer(project[:, 3], [0, 0, 1])
        self.planes: Floats = np.stack([level, np.outer(project[:, 2], [0, 0, 1])])
        right, bottom = lattice.width - 1, lattice.height - 1
        corners = np.array([[0, right, 0, right], [0, 0, bottom, bottom], [1.0, 1, 1, 1]])
        low, high = np.zeros(2, int), np.array(picture.shape[::-1])
        self.frame: Floats = np.concatenate([low, high - 1.0])
        ends = np.concatenate(
            [self._at(each) @ corners for each in (bounds.low_m, bounds.high_m)], 1
        )
        if (ends[2] > 1e-6).all():
            places = (ends[:2] / ends[2]).T
            low = np.clip(np.floor(places.min(axis=0)) - _CONTRAST_PX, 0, high - 2).astype(int)
            high = np.clip(np.ceil(places.max(axis=0)) + _CONTRAST_PX + 1, low + 2, high).astype(
                int
            )
        self.planes = shifted(-low[0], -low[1]) @ self.planes
        self.frame -= np.tile(low, 2)
        piece = picture[low[1] : high[1], low[0] : high[0]].astype(np.float32)
        away_m = others_m - eye_m
        # (N,) in which direction of the picture, in steps, things move with their height against
        # other photos.
        cells_from_site = np.linalg.inv(lattice.site_from_cells)[:2, :2]
        middle = np.array([(lattice.width - 1) / 2, (lattice.height - 1) / 2])
        ends = np.concatenate([[middle], middle + _unit(away_m[:, :2] @ cells_from_site.T)])
        seen = np.column_stack([ends, np.ones(len(ends))]) @ self._at(bounds.usual_m).T
        places = seen[:, :2] / np.maximum(np.abs(seen[:, 2:]), 1e-9)
        moved = places[1:] - places[0]
        angles = np.rint(np.arctan2(moved[:, 1], moved[:, 0]) / _ANGLE_RAD) % _ANGLES
        others = (away_m != 0).any(axis=1)
        directions, which = np.unique(angles[others], return_inverse=True)
        self.contrast = np.stack([_contrast(piece, each * _ANGLE_RAD) for each in directions])
        self.channel = np.zeros(len(others), int)  # nobody asks for the photo's own
        self.channel[others] = which
        above_m = max(float(eye_m[2]) - bounds.usual_m, 1e-3)
        self._px_per_cell = lattice.cell_m * camera.fx_px / above_m

    def on(self, up_m: Floats32) -> list[Floats32]:
        """The photo on heights, (H, W), for each of the others; 0 outside of it."""
        x, y, z = self._homogeneous(up_m)
        z = np.where(z > 1e-6, z, np.nan)
        u, v = (np.nan_to_num(each / z, nan=-1e6).astype(np.float32) for each in (x, y))
        laid = [
            np.asarray(cv2.remap(each, u, v, cv2.INTER_LINEAR), np.float32)
            for each in self.contrast
        ]
        return [laid[each] for each in self.channel.tolist()]

    def inset_px(self, side: int) -> float:
        """How far within the photo a patch lies as a whole: beyond its border it would see the border."""
        return 0.5 * (side * self._px_per_cell + _CONTRAST_PX)

    def shows(self, up_m: Floats32, side: int) -> Mask:
        """(H, W) where a patch lies in the photo as a whole at each cell's own height, (H, W); nowhere for NaN."""
        (left, top, right, bottom), inset = self.frame.tolist(), self.inset_px(side)
        x, y, z = self._homogeneous(up_m)
        shown: Mask = (x >= (left + inset) * z) & (y >= (top + inset) * z)
        shown &= (x <= (right - inset) * z) & (y <= (bottom - inset) * z)
        return shown if self.hidden_below_m is None else shown & (up_m >= self.hidden_below_m)

    def _homogeneous(self, up_m: Floats32) -> list[Floats]:
        """x, y and depth, (H, W) each, of the cells at heights, (H, W), in the part of the picture."""
        columns, rows = np.arange(self.shape[1]), np.arange(self.shape[0])[:, None]
        return [
            level[0] * columns + (level[1] * rows + level[2]) + up[2] * up_m
            for level, up in zip(*self.planes)
        ]

    def _at(self, up_m: float) -> Matrix3:
        return self.planes[0] + up_m * self.planes[1]


def _unit(vectors: Floats) -> Floats:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-9)


def _contrast(picture: Floats32, angle_rad: float) -> Floats32:
    """(H, W) how a picture's gray differs from its mean along a line, over how much it does so around.

    Along the line between two photos, for an edge along that line fits itself at every height.
    """
    side = _CONTRAST_PX
    way = np.linspace(-(side // 2), side // 2, 4 * side)
    line = np.zeros((side, side), np.float32)
    x, y = way * np.cos(angle_rad) + side // 2, way * np.sin(angle_rad) + side // 2
    for ax, wx in ((np.floor(x), 1 - x % 1), (np.floor(x) + 1, x % 1)):
        for ay, wy in ((np.floor(y), 1 - y % 1), (np.floor(y) + 1, y % 1)):
            np.add.at(
                line,
                (np.minimum(ay, side - 1).astype(int), np.minimum(ax, side - 1).astype(int)),
                wx * wy,
            )
    away = picture - cv2.filter2D(picture, -1, line / line.sum())
    spread = cv2.sqrBoxFilter(away, -1, (side, side))
    return np.asarray(away / np.sqrt(spread + np.float32(_NOISE_LEVELS**2)), np.float32)


def _cost(agreement: Floats32) -> Floats32:
    """(H, D, W) what heights cost by their agreement; one that is not seen (NaN) as much as a cell's chance matches.

    How well photos agree by chance depends on the ground's texture: it is taken from the cell's other heights.
    """
    unseen = np.isnan(agreement)
    cost: Floats32 = np.asarray(1 - agreement, np.float32)
    if not unseen.any():
        return cost
    cost[unseen] = 0
    seen = np.maximum((~unseen).sum(axis=1), 1).astype(np.float32)
    mean = cost.sum(axis=1) / seen
    scatter = np.sqrt(np.maximum((cost**2).sum(axis=1) / seen - mean**2, 0))
    chance = np.clip(mean - _UNSEEN_SIGMAS * scatter, 0, 1)
    return np.where(unseen, chance[:, None], cost)


def _best(total: Floats32, agreement: Floats32, levels: Floats) -> tuple[Floats32, Floats32]:
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
