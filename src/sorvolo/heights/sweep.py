"""Heights of cells by a sweep of level planes: where photos laid on a plane agree, the ground is at its height.

Collins 1996, with the photos compared pair by pair (normalised cross-correlation), so that no photo is the reference
and one that cannot see a place does not decide about it.
"""

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import TypeAlias

import cv2
import numpy as np

from sorvolo.geometry.arrays import Floats, Floats32, ImageGray, Mask, Matrix3, PointsM
from sorvolo.heights.lattice import Lattice
from sorvolo.heights.obstacles import Obstacles
from sorvolo.heights.views import View, inside


@dataclass(frozen=True)
class SmoothingSettings:
    """What heights cost beside their matching cost (0 to 1), in its units."""

    one_level: float = 0.1  # a change of height between neighbours
    more_levels: float = 0.9  # of any larger change: an edge of a roof
    unseen_sigmas: float = (
        1.5  # below a cell's mean cost is that of a height at which fewer than two photos see it
    )
    temperature: float = 0.04  # of a path's total cost, by which a height is e times less likely: fits sigma to errors


def smoothed(cost: Floats32, settings: SmoothingSettings) -> Floats32:
    """(H, D, W) sums over eight paths of a matching cost, (H, D, W) float32: rows, levels, columns."""
    total = np.zeros_like(cost)
    _sweep(cost, total, settings)
    _sweep(cost[::-1], total[::-1], settings)
    turned: Floats32 = np.ascontiguousarray(cost.transpose(2, 1, 0))
    across = np.zeros_like(turned)
    _straight(turned, across, settings)
    _straight(turned[::-1], across[::-1], settings)
    total += across.transpose(2, 1, 0)
    return total


def _sweep(cost: Floats32, total: Floats32, settings: SmoothingSettings) -> None:
    """Add the paths that come from the row above: straight, from the left and from the right."""
    before = [cost[0]] * 3
    total[0] += 3 * cost[0]
    for row in range(1, len(cost)):
        left, right = np.empty_like(before[1]), np.empty_like(before[2])
        left[:, 1:], left[:, :1] = before[1][:, :-1], before[1][:, :1]
        right[:, :-1], right[:, -1:] = before[2][:, 1:], before[2][:, -1:]
        before = [_next(cost[row], each, settings) for each in (before[0], left, right)]
        for each in before:
            total[row] += each


def _straight(cost: Floats32, total: Floats32, settings: SmoothingSettings) -> None:
    before = cost[0]
    total[0] += before
    for row in range(1, len(cost)):
        before = _next(cost[row], before, settings)
        total[row] += before


def _next(cost: Floats32, before: Floats32, settings: SmoothingSettings) -> Floats32:
    """(D, W) the cost of paths that go on from `before`, (D, W), the least of it taken off so that sums stay small."""
    least = before.min(axis=0)
    reached = np.minimum(before, least + np.float32(settings.more_levels))
    step = np.float32(settings.one_level)
    np.minimum(reached[1:], before[:-1] + step, out=reached[1:])
    np.minimum(reached[:-1], before[1:] + step, out=reached[:-1])
    reached += cost
    reached -= least
    return reached


_MORE = 3  # views beyond the wanted ones ...
_LEFT_OUT = 0.04  # ... while two of those that are chosen leave out so much of the ground that two could show
_ANGLES = 16  # directions in a picture that are distinguished, over half a turn
_ANGLE_RAD = np.pi / _ANGLES

Seen: TypeAlias = Mask | bool
"""Where a photo sees the cells of a window: (H, W), or everywhere, or nowhere."""


_VIEWS = 4  # laid over each other at a time
_CONTRAST_PX = 9  # side of the surroundings that a pixel's gray is measured against
_PAIR_SHARE = 0.5  # of the pairs of photos that see a cell: the others may be hidden from it
_NOISE_LEVELS = 3.0  # gray levels; texture below it decides nothing
_LEVEL_PX = 0.8  # parallax between two planes, of the two photos farthest apart
_MOST_LEVELS = 160  # planes of one sweep: bounds time and memory
_LEAST_SCORE = 0.1  # of agreement, 0 to 1, below which a cell stays a hole


@dataclass(frozen=True)
class SweepSettings:
    """How photos are compared."""

    window_cells: tuple[int, int] = (
        5,
        15,
    )  # sides of the patches that are compared: detail, and what is sure
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
    laid = [_Laid(views[k], pictures(k), lattice, bounds, eyes_m, settings) for k in chosen]
    least, usual_m = min(settings.window_cells), np.array([bounds.usual_m])
    seen = [np.broadcast_to(next(each.wholes(usual_m, least)), shape) for each in laid]
    if obstacles is not None:
        for each, eye_m in zip(laid, eyes_m):
            each.hide(obstacles.hidden_below_m(lattice, eye_m))
    agreement = _agreements(laid, levels, settings)
    seen_by = np.sum(seen, axis=0).astype(np.float32)
    total = smoothed(_cost(agreement, settings.smoothing), settings.smoothing)
    up_m, score = _best(total, agreement, levels)
    # (H, W) the root mean square distance of the other levels from a height, each by its
    # probability.
    chance = np.exp(
        (total.min(axis=1, keepdims=True) - total) / (8 * settings.smoothing.temperature)
    )
    away = levels[None, :, None].astype(np.float32) - up_m[:, None]
    deviation = np.asarray(np.sqrt((chance * away**2).sum(axis=1) / chance.sum(axis=1)), np.float32)
    up_m[~(score >= _LEAST_SCORE)] = (
        np.nan
    )  # no two photos see the height that fits, or they do not agree
    shown_by = np.sum(
        [each.shows(up_m, min(settings.window_cells)) for each in laid], axis=0
    ).astype(np.float32)
    return Swept(up_m, score, seen_by, _widest(seen, spreads), deviation, shown_by)


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
    laid = [_Laid(views[k], pictures(k), lattice, bounds, eyes_m, settings) for k in chosen]
    shown = [each.shows(up_m, min(settings.window_cells)) for each in laid]
    on = [each.on(up_m) for each in laid]
    for i, j in itertools.combinations(range(len(laid)), 2):
        both = shown[i] & shown[j]
        if both.any():
            alike = _likeness(on[i][j] * on[j][i], [both] * len(settings.window_cells), settings)
            yield chosen[i], chosen[j], np.maximum(alike, 0)


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
    wanted = np.minimum(
        covers.sum(axis=0), 2
    )  # ground that only photos left out see would be a hole
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
        least = np.minimum(least, _usefulness(angle))
    return chosen


def _level_shown(lattice: Lattice, views: Sequence[View], up_m: float) -> tuple[PointsM, Mask]:
    """Places all over a lattice at a height, (P, 3), and which of the views show each, (V, P)."""
    across = np.linspace(0, 1, 5)
    x, y = np.meshgrid(across * (lattice.width - 1), across * (lattice.height - 1))
    cells = np.column_stack([x.ravel(), y.ravel(), np.ones(x.size)])
    ground = np.column_stack([(cells @ lattice.site_from_cells.T)[:, :2], np.full(x.size, up_m)])
    shown = [inside(view.pixels_from_site(ground), view.camera) for view in views]
    return ground, np.array(shown).reshape(len(views), -1)


def _usefulness(angle: Floats) -> Floats:
    """0 to 1: two photos from the same place show no height, from too far apart nothing alike."""
    return np.clip(angle / 0.35, 0.05, 1) * np.clip((1.2 - angle) / 0.5, 0.02, 1)


def _spreads(lattice: Lattice, views: Sequence[View], up_m: float) -> Floats:
    """(V, V) how far apart two photos stand, seen from the lattice's middle, over how high they are."""
    middle = lattice.site_from_cells @ [(lattice.width - 1) / 2, (lattice.height - 1) / 2, 1.0]
    rays = np.array([view.site_from_camera.translation_m for view in views]) - [
        middle[0],
        middle[1],
        up_m,
    ]
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
    """A photo that is laid on level planes over a lattice: of each pixel how it differs from its surroundings."""

    def __init__(
        self,
        view: View,
        picture: ImageGray,
        lattice: Lattice,
        bounds: Bounds,
        others_m: PointsM,
        settings: SweepSettings,
    ) -> None:
        self.shape = lattice.shape
        self._hidden_below_m: Floats32 | None = None
        self._clear_m = -np.inf  # nothing from here up is hidden
        camera = view.camera.resized(picture.shape[1], picture.shape[0])
        turn = view.site_from_camera.rotation.T
        project = camera.matrix @ np.column_stack(
            [turn, -turn @ view.site_from_camera.translation_m]
        )
        self._level = project[:, :2] @ lattice.site_from_cells[:2] + np.outer(
            project[:, 3], [0, 0, 1]
        )
        self._up = np.outer(project[:, 2], [0, 0, 1])
        right, bottom = lattice.width - 1, lattice.height - 1
        self._corners = np.array([[0, right, 0, right], [0, 0, bottom, bottom], [1.0, 1, 1, 1]])
        self._size = picture.shape[1], picture.shape[0]
        piece = self._crop_to(picture, bounds, settings)
        away_m = others_m - view.site_from_camera.translation_m
        # (N,) in which direction of the picture, in steps, things move with their height against
        # other photos.
        cells_from_site = np.linalg.inv(lattice.site_from_cells)[:2, :2]
        middle = np.array([(lattice.width - 1) / 2, (lattice.height - 1) / 2])
        ends = np.concatenate([[middle], middle + _unit(away_m[:, :2] @ cells_from_site.T)])
        seen = (
            np.column_stack([ends, np.ones(len(ends))]) @ self._picture_from_cells(bounds.usual_m).T
        )
        places = seen[:, :2] / np.maximum(np.abs(seen[:, 2:]), 1e-9)
        moved = places[1:] - places[0]
        angles = np.asarray(np.rint(np.arctan2(moved[:, 1], moved[:, 0]) / _ANGLE_RAD) % _ANGLES)
        others = (away_m != 0).any(axis=1)
        channels, which = np.unique(angles[others], return_inverse=True)
        self._contrast = [
            _contrast(piece, each * _ANGLE_RAD, settings) for each in channels.tolist()
        ]
        self._channel = np.zeros(
            len(others), int
        )  # of each of the others; nobody asks for the photo's own
        self._channel[others] = which
        self._px_per_cell = (
            lattice.cell_m
            * camera.fx_px
            / max(float(view.site_from_camera.translation_m[2]) - bounds.usual_m, 1e-3)
        )

    def at(self, up_m: float) -> list[Floats32]:
        """The photo on the plane at a height, (H, W) float32, for each of the others; 0 outside of it."""
        there = self._from_picture @ self._picture_from_cells(up_m)
        laid = [
            np.asarray(
                cv2.warpPerspective(
                    each,
                    there,
                    self.shape[::-1],
                    flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
                ),
                np.float32,
            )
            for each in self._contrast
        ]
        return [laid[each] for each in self._channel.tolist()]

    def on(self, up_m: Floats32) -> list[Floats32]:
        """The photo on heights, (H, W), for each of the others; 0 outside of it."""
        columns, rows = np.arange(self.shape[1]), np.arange(self.shape[0])[:, None]
        level, up = self._from_picture @ self._level, self._from_picture @ self._up
        x, y, z = (
            each[0] * columns + (each[1] * rows + each[2]) + rise[2] * up_m
            for each, rise in zip(level, up)
        )
        z = np.where(z > 1e-6, z, np.nan)
        u, v = (np.nan_to_num(each / z, nan=-1e6).astype(np.float32) for each in (x, y))
        laid = [
            np.asarray(cv2.remap(each, u, v, cv2.INTER_LINEAR), np.float32)
            for each in self._contrast
        ]
        return [laid[each] for each in self._channel.tolist()]

    def wholes(self, levels_m: Floats, side: int) -> Iterator[Seen]:
        """Where a patch lies in the photo as a whole when the ground is at each of some heights, (L,).

        Beyond its border it would see the border, not the ground.
        """
        # (L, 4, 3) a photo's sides on level planes: positive on the inner side, where the
        # picture's depth is.
        inset = 0.5 * (side * self._px_per_cell + self._apron)
        (w, h), planes = self._size, self._level + levels_m[:, None, None] * self._up
        x, y, z = planes[:, 0], planes[:, 1], planes[:, 2]
        lines = np.stack(
            [x - inset * z, (w - 1 - inset) * z - x, y - inset * z, (h - 1 - inset) * z - y], axis=1
        )
        inside = lines @ self._corners >= 0
        everywhere, nowhere = inside.all(axis=(1, 2)), ~inside.any(axis=2).all(axis=1)
        for number, up_m in enumerate(levels_m.tolist()):
            if nowhere[number] or (everywhere[number] and up_m >= self._clear_m):
                yield bool(everywhere[number])
                continue
            known = self._within(lines[number][~inside[number].all(axis=1)])
            if self._hidden_below_m is not None and up_m < self._clear_m:
                known &= up_m >= self._hidden_below_m
            yield known if known.any() else False

    def hide(self, below_m: Floats32 | None) -> None:
        """From here on the photo does not show what lies lower than (H, W) heights."""
        if below_m is not None:
            self._hidden_below_m, self._clear_m = below_m, float(below_m.max())

    def _within(self, lines: Floats) -> Mask:
        """(H, W) the cells on the inner side of lines, (K, 3)."""
        columns, rows = np.arange(self.shape[1]), np.arange(self.shape[0])[:, None]
        known = np.ones(self.shape, bool)
        for line in lines:
            known &= line[0] * columns + (line[1] * rows + line[2]) >= 0
        return known

    def shows(self, up_m: Floats32, side: int) -> Mask:
        """(H, W) where a patch lies in the photo as a whole at each cell's own height, (H, W); nowhere for NaN."""
        inset = 0.5 * (side * self._px_per_cell + self._apron)
        columns, rows = np.arange(self.shape[1]), np.arange(self.shape[0])[:, None]
        (w, h), (x, y, z) = (
            self._size,
            (
                level[0] * columns + (level[1] * rows + level[2]) + up[2] * up_m
                for level, up in zip(self._level, self._up)
            ),
        )
        left, top = x - inset * z, y - inset * z
        shown: Mask = (
            (left >= 0) & (top >= 0) & (x <= (w - 1 - inset) * z) & (y <= (h - 1 - inset) * z)
        )
        return shown if self._hidden_below_m is None else shown & (up_m >= self._hidden_below_m)

    def _picture_from_cells(self, up_m: float) -> Matrix3:
        return np.asarray(self._level + up_m * self._up)

    def _crop_to(self, picture: ImageGray, bounds: Bounds, settings: SweepSettings) -> Floats32:
        """Keep of the picture what the cells see at all heights."""
        apron = self._apron = _CONTRAST_PX
        low, high = np.zeros(2, int), np.array(self._size)
        seen = [
            self._picture_from_cells(each) @ self._corners for each in (bounds.low_m, bounds.high_m)
        ]
        ends = np.concatenate(seen, axis=1)
        if (ends[2] > 1e-6).all():
            places = (ends[:2] / ends[2]).T
            low = np.clip(np.floor(places.min(axis=0)) - apron, 0, high - 1).astype(int)
            high = np.clip(np.ceil(places.max(axis=0)) + apron + 1, low + 1, high).astype(int)
        self._from_picture = np.array([[1.0, 0, -low[0]], [0, 1, -low[1]], [0, 0, 1]])
        return picture[low[1] : high[1], low[0] : high[0]].astype(np.float32)


def _unit(vectors: Floats) -> Floats:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-9)


def _contrast(picture: Floats32, angle_rad: float, settings: SweepSettings) -> Floats32:
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


def _agreements(laid: Sequence[_Laid], levels_m: Floats, settings: SweepSettings) -> Floats32:
    """(H, L, W) how well the photos agree at each of L heights."""
    wholes = [[each.wholes(levels_m, side) for each in laid] for side in settings.window_cells]
    result = np.empty((laid[0].shape[0], len(levels_m), laid[0].shape[1]), np.float32)
    for number, up_m in enumerate(levels_m.tolist()):
        known = [[next(each) for each in of_side] for of_side in wholes]
        result[:, number] = _agreement(laid, up_m, known, settings)
    return result


def _agreement(
    laid: Sequence[_Laid], up_m: float, known: Sequence[Sequence[Seen]], settings: SweepSettings
) -> Floats32:
    """(H, W) how well the photos agree at a height, 0 to 1; NaN where fewer than two see it.

    `known` is where each photo sees the patches of each size. The mean over the better half of the pairs that see a
    cell, for a photo from which something hides it agrees with none (Kang, Szeliski and Chai 2001).
    """
    pairs = list(_pairs(known))
    if not pairs:
        return np.full(laid[0].shape, np.nan, np.float32)
    pictures = {k: laid[k].at(up_m) for k in {k for i, j, _ in pairs for k in (i, j)}}
    scores = [_likeness(pictures[i][j] * pictures[j][i], both, settings) for i, j, both in pairs]
    is_whole = all(any(each is True for each in both) for _, _, both in pairs)
    return (_better_mean if is_whole else _better_mean_of_known)(scores, _PAIR_SHARE)


def _pairs(known: Sequence[Sequence[Seen]]) -> Iterator[tuple[int, int, list[Seen]]]:
    """The photos that see patches together, two by two, and where they do, for each size of a patch."""
    for i, j in itertools.combinations(range(len(known[0])), 2):
        both = [_both(seen[i], seen[j]) for seen in known]
        if any(each is not False for each in both):
            yield i, j, both


def _both(first: Seen, second: Seen) -> Seen:
    """Where two photos see a patch."""
    if first is False or second is False:
        return False
    if first is True or second is True:
        return second if first is True else first
    both = first & second
    return both if both.any() else False


def _likeness(product: Floats32, both: Sequence[Seen], settings: SweepSettings) -> Floats32:
    """(H, W) how alike patches are in two photos, the mean over those of their sizes that both see; -1 for none."""
    total, whole, partly = None, 0, []
    for side, seen in zip(settings.window_cells, both):
        if seen is False:
            continue
        alike = np.asarray(cv2.boxFilter(product, -1, (side, side)), np.float32)
        np.maximum(alike, 0, out=alike)
        if seen is True:
            whole += 1
        else:
            alike *= seen
            partly.append(seen)
        total = alike if total is None else np.add(total, alike, out=total)
    assert total is not None
    if not partly:
        return np.divide(total, np.float32(whole), out=total)
    count = np.sum(partly, axis=0, dtype=np.float32) + np.float32(whole)
    return np.where(count > 0, total / np.maximum(count, 1), np.float32(-1))


def _better_mean(scores: list[Floats32], share: float) -> Floats32:
    """(H, W) the mean over the best `share` of the scores."""
    wanted = int(np.ceil(len(scores) * share))
    total = np.zeros_like(scores[0])
    for each in itertools.islice(_from_the_largest(scores), wanted):
        total += each
    total /= wanted
    return total


def _better_mean_of_known(scores: list[Floats32], share: float) -> Floats32:
    """(H, W) the mean over the best `share` of the scores that are known (not -1); NaN where none is."""
    counted = np.zeros(scores[0].shape, np.float32)
    for each in scores:
        counted += each >= 0
    wanted = np.ceil(counted * share)
    total = np.zeros_like(counted)
    for rank, each in enumerate(
        itertools.islice(_from_the_largest(scores), int(np.ceil(len(scores) * share)))
    ):
        total += each * (rank < wanted)
    with np.errstate(invalid="ignore"):
        return np.asarray(
            np.where(counted > 0, total / np.maximum(wanted, 1), np.float32(np.nan)), np.float32
        )


def _from_the_largest(scores: list[Floats32]) -> Iterator[Floats32]:
    """(H, W) of each cell its largest score, then its second, and so on; `scores` change."""
    lower = np.empty_like(scores[0])
    for left in range(len(scores) - 1, -1, -1):
        for k in range(left):  # the largest of those left moves to their end
            np.minimum(scores[k], scores[k + 1], out=lower)
            np.maximum(scores[k], scores[k + 1], out=scores[k + 1])
            scores[k], lower = lower, scores[k]
        yield scores[left]


def _cost(agreement: Floats32, settings: SmoothingSettings) -> Floats32:
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
    chance = np.clip(mean - np.float32(settings.unseen_sigmas) * scatter, 0, 1)
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
