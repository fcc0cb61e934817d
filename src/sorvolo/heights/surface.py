"""The height model of a flight: swept coarsely over all ground, then finely tile by tile around what was found."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from sorvolo.geometry.arrays import Floats32, ImageGray, Mask, PointsM, square
from sorvolo.heights.borders import beyond_borders
from sorvolo.heights.free_space import ONE_PAIR, islands, seen_through
from sorvolo.heights.lattice import Lattice
from sorvolo.heights.obstacles import Obstacles
from sorvolo.heights.smooth_sigma import SmoothSigma
from sorvolo.heights.sweep import Bounds, SweepSettings, Swept, sweep
from sorvolo.heights.views import View

_FINE = SweepSettings()
# to find what heights a tile has: a crown is few coarse cells wide
_NARROW = SweepSettings(window_cells=(3, 7), edge_cost=0.6)


_COARSER = 2  # cells of the first sweep, in those of the model
_TILE_CELLS = 320  # side of a tile: with its apron it fits the memory of a small computer
_TILE_SHARE = 0.3  # of a photo's ground: a tile is seen whole by the photos that are compared on it
_APRON_CELLS = 10  # beyond a tile, so that neighbouring tiles agree: more than half a patch
_COARSE_APRON_CELLS = 5  # of the first sweep, whose patches are smaller
_MARGIN_CELLS = 12.0  # heights searched above and below what the first sweep found, in cells
_MATCH_CELLS = 0.12  # sigma of a match where photos agree perfectly, in cells of parallax
# of the heights' spread around a cell: at an edge it is not known which is right
_RELIEF_SHARE = 0.25


def sizes_m(cell_m: float) -> tuple[float, float]:
    """What a pixel covers of the ground in the pictures that the two sweeps take, for cells of `cell_m`."""
    return _COARSER * cell_m, cell_m


@dataclass(frozen=True, eq=False)
class Surface:
    """A height model: `up_m` (H, W) float32 above the site's ground, NaN in holes; `sigma_m` one sigma of it.

    `covered` (H, W) are the cells that two photos see at least.
    """

    lattice: Lattice
    up_m: Floats32
    sigma_m: Floats32
    covered: Mask

    def above(self, zero_m: float) -> tuple[Floats32, Floats32]:
        """The heights when the site's ground is at `zero_m`, and their sigma, (H, W) float32."""
        return self.up_m + np.float32(zero_m), self.sigma_m


def sweep_surface(
    lattice: Lattice,
    views: Sequence[View],
    pictures: Callable[[int, float], ImageGray],
    points_m: PointsM,
    camera_sigma: SmoothSigma,
    *,
    unsure_cells: float = 3.0,
    island_cells: int = 340,
) -> Iterator[Surface | float]:
    """Yields the share of tiles done, 0 to 1, and in the end the surface.

    `pictures(i, size_m)` is view i's gray picture whose pixels cover about `size_m` of ground; `points_m` (P, 3) are
    points in space that bound the heights to look for; `camera_sigma` is what heights err by the cameras. One pair of
    photos decides nothing where other heights that are likely lie `unsure_cells` off, nor on a piece of `island_cells`.
    """
    heights_m = np.array([view.site_from_camera.translation_m[2] for view in views])
    # The heights to look for: those of the points, and beyond them, for crowns have few points,
    # or none.
    camera_m = float(np.median(heights_m))
    low, high = np.percentile(points_m[:, 2], [0.5, 99.5])
    ground = float(np.median(points_m[:, 2]))
    reach = camera_m - ground
    everywhere = Bounds(float(low - 0.05 * reach), float(max(high, ground + 0.4 * reach)), ground)
    side = _tile_cells(lattice.cell_m, views)
    wide = lattice.coarser(_COARSER)
    coarse = _coarse(wide, views, pictures, everywhere)
    obstacles = Obstacles.surely(wide, coarse, max(_NARROW.window_cells))
    up_m, sigma_m = (np.full(lattice.shape, np.nan, np.float32) for _ in range(2))
    covered, shown_by = np.zeros(lattice.shape, bool), np.zeros(lattice.shape, np.uint8)
    tiles = list(lattice.windows(side))
    for number, (x0, y0, x1, y1) in enumerate(tiles):
        apron = _APRON_CELLS
        window = lattice.window(x0 - apron, y0 - apron, x1 + apron, y1 + apron)
        bounds = _tile_bounds(coarse, (x0, y0, x1, y1), lattice.cell_m)
        if bounds is not None:
            swept = sweep(
                window,
                views,
                lambda i: pictures(i, lattice.cell_m),
                bounds,
                _FINE,
                obstacles,
            )
            found = _calmed(swept)
            unsure = swept.deviation_m > unsure_cells * lattice.cell_m
            found[unsure & (swept.shown_by <= ONE_PAIR)] = np.nan
            sigma = _sigma_m(swept, found, window, camera_sigma)
            inner = slice(apron, -apron), slice(apron, -apron)
            up_m[y0:y1, x0:x1], sigma_m[y0:y1, x0:x1] = found[inner], sigma[inner]
            covered[y0:y1, x0:x1] = (swept.seen_by[inner] >= 2) | np.isfinite(found[inner])
            shown_by[y0:y1, x0:x1] = swept.shown_by[inner]
        yield (number + 1) / len(tiles)
    up_m[islands(up_m, shown_by, lattice.cell_m, island_cells)] = np.nan
    ground_m = beyond_borders(
        lattice,
        up_m,
        views,
        lambda i: pictures(i, lattice.cell_m),
        side,
        _FINE,
    )
    given = np.isfinite(ground_m)
    sigma_m[given] = np.hypot(sigma_m[given], _RELIEF_SHARE * (up_m[given] - ground_m[given]))
    up_m[given] = ground_m[given]
    up_m[_seen_through(lattice, up_m, views, pictures)] = np.nan
    sigma_m[np.isnan(up_m)] = np.nan
    yield Surface(lattice, up_m, sigma_m, covered)


def _seen_through(
    lattice: Lattice,
    up_m: Floats32,
    views: Sequence[View],
    pictures: Callable[[int, float], ImageGray],
) -> Mask:
    """(H, W) the cells that photos see through, found on cells of the first sweep."""
    times = _COARSER
    coarse = lattice.coarser(times)
    found = seen_through(
        coarse,
        np.ascontiguousarray(up_m[::times, ::times]),
        views,
        lambda i: pictures(i, coarse.cell_m),
        _tile_cells(coarse.cell_m, views),
        _NARROW,
    )
    return np.repeat(np.repeat(found, times, axis=0), times, axis=1)[
        : lattice.height, : lattice.width
    ]


def _coarse(
    lattice: Lattice,
    views: Sequence[View],
    pictures: Callable[[int, float], ImageGray],
    bounds: Bounds,
) -> Floats32:
    up_m = np.full(lattice.shape, np.nan, np.float32)
    apron = _COARSE_APRON_CELLS
    for x0, y0, x1, y1 in lattice.windows(_tile_cells(lattice.cell_m, views)):
        window = lattice.window(x0 - apron, y0 - apron, x1 + apron, y1 + apron)
        swept = sweep(window, views, lambda i: pictures(i, lattice.cell_m), bounds, _NARROW)
        up_m[y0:y1, x0:x1] = _calmed(swept)[apron:-apron, apron:-apron]
    return up_m


def _tile_cells(cell_m: float, views: Sequence[View]) -> int:
    ground_m = [
        view.site_from_camera.translation_m[2]
        * min(view.camera.width_px, view.camera.height_px)
        / view.camera.fx_px
        for view in views
    ]
    return int(np.clip(_TILE_SHARE * np.median(ground_m) / cell_m, 32, _TILE_CELLS))


def _tile_bounds(
    coarse: Floats32, window: tuple[int, int, int, int], cell_m: float
) -> Bounds | None:
    """The heights to search in a tile; None where the coarse model has a hole as large as the tile."""
    x0, y0, x1, y1 = (round(each / _COARSER) for each in window)
    around = coarse[max(0, y0 - 6) : y1 + 7, max(0, x0 - 6) : x1 + 7]
    known = around[np.isfinite(around)]
    if not len(known):
        return None
    low, high = np.percentile(known, [0.5, 99.5])
    margin = _MARGIN_CELLS * cell_m
    return Bounds(float(low - margin), float(high + margin), float(np.median(known)))


def _calmed(swept: Swept) -> Floats32:
    """(H, W) the heights with single cells that differ from all around put right: the median of 5 x 5."""
    known = np.isfinite(swept.up_m)
    if not known.any():
        return swept.up_m
    filled = np.where(known, swept.up_m, np.nanmedian(swept.up_m)).astype(np.float32)
    return np.where(known, cv2.medianBlur(filled, 5), np.nan).astype(np.float32)


def _sigma_m(
    swept: Swept,
    up_m: Floats32,
    lattice: Lattice,
    camera_sigma: SmoothSigma,
) -> Floats32:
    """(H, W) one sigma of the heights: of the match, of other likely heights, of an edge nearby, of the cameras."""
    likeness = np.sqrt(np.clip(swept.score, 0.01, 1))
    match = _MATCH_CELLS * lattice.cell_m / np.maximum(swept.spread, 0.02) / likeness
    # (H, W) highest minus lowest within two cells
    known = np.isfinite(up_m)
    around = square(5)
    high = cv2.dilate(np.where(known, up_m, -1e6).astype(np.float32), around)
    low = cv2.erode(np.where(known, up_m, 1e6).astype(np.float32), around)
    relief = _RELIEF_SHARE * np.where(known, high - low, 0.0)
    other = np.nan_to_num(swept.deviation_m)
    sigma = np.sqrt(match**2 + relief**2 + other**2 + camera_sigma.on(lattice) ** 2).astype(
        np.float32
    )
    sigma[~np.isfinite(up_m)] = np.nan
    return sigma
