"""Which ground a flight showed and which of it was searched for what, in square cells, while its frames come."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from sorvolo.geometry.arrays import Floats, Mask, PointsM, frozen
from sorvolo.geometry.grid import SiteGrid
from sorvolo.geometry.polygons import points_inside
from sorvolo.search.cells import Cells, round_side_m
from sorvolo.search.conditions import FARTHEST
from sorvolo.survey.flight import Site

_CELLS_ACROSS = 24  # the shorter side of the first frame's ground; by choice
_MOST_CELLS = 8_000_000  # a frame so far from all others has a wrong place


class GroundState(IntEnum):
    """What became of a cell of ground for one class: the numbers of `LookedGround.states`."""

    NOT_SHOWN = 0
    LOOKED_AT = 1
    TOO_COARSE = 2
    SKIPPED = 3

    @property
    def words(self) -> str:
        """For people."""
        return self.name.lower().replace("_", " ")


@dataclass(frozen=True)
class ClassGround:
    """The flown ground as it was searched for one class, m2: looked at, searched in too coarse pixels, skipped."""

    looked_m2: float
    coarse_m2: float
    skipped_m2: float

    @property
    def share(self) -> float:
        """The share of the flown ground that was looked at, 0 to 1; 0 where none was flown."""
        total_m2 = self.looked_m2 + self.coarse_m2 + self.skipped_m2
        return self.looked_m2 / total_m2 if total_m2 else 0.0


class LookedGround:
    """The ground that frames showed and that a detector searched. Only `show` and `look` change it.

    `coarsest_m` is, by class, the most ground that a pixel may cover for the class to be recognised.
    """

    def __init__(self, site: Site, coarsest_m: Mapping[str, float]) -> None:
        self._site, self._coarsest_m = site, dict(coarsest_m)
        self._grid: SiteGrid | None = None
        self._left = self._top = 0
        # (layers, rows, columns): shown, then for each class searched and looked at finely enough
        self._layers = np.zeros((1 + 2 * len(self._coarsest_m), 0, 0), bool)

    def show(self, outline_m: PointsM) -> None:
        """A frame shows the ground within these corners, (4, 2) site metres."""
        at, inside = self._within(outline_m)
        self._layers[0][at] |= inside

    def look(self, outline_m: PointsM, m_per_px: float, classes: Collection[str]) -> None:
        """A frame of this ground was searched for these classes; a pixel of it covers `m_per_px`. What that is too coarse
        for counts as too coarse, searched for or not."""
        at, inside = self._within(outline_m)
        self._layers[0][at] |= inside
        for row, (name, coarsest_m) in enumerate(self._coarsest_m.items()):
            if name in classes or m_per_px > coarsest_m:
                self._layers[1 + 2 * row][at] |= inside
                if m_per_px <= coarsest_m:
                    self._layers[2 + 2 * row][at] |= inside

    def new_share(self, outline_m: PointsM) -> float:
        """The share of this ground, 0 to 1, that no frame was searched for any class."""
        at, inside = self._within(outline_m)
        count = int(inside.sum())
        known = np.any(self._layers[1::2][(slice(None), *at)], axis=0)
        return int((inside & ~known).sum()) / count if count else 0.0

    @property
    def flown_m2(self) -> float:
        """The ground that any frame showed."""
        return float(self._layers[0].sum()) * self._cell_m2

    def of_classes(self) -> dict[str, ClassGround]:
        """What became of the flown ground, by class."""
        counts = {
            name: np.bincount(self.states(name), minlength=len(GroundState)) * self._cell_m2
            for name in self._coarsest_m
        }
        return {
            name: ClassGround(*(float(each) for each in own[1:])) for name, own in counts.items()
        }

    def states(self, name: str) -> NDArray[np.uint8]:
        """(N,) the `GroundState` of each of `cells` for a class."""
        row = 1 + 2 * list(self._coarsest_m).index(name)
        shown, searched, fine = self._layers[0], self._layers[row], self._layers[row + 1]
        states = np.where(searched, GroundState.TOO_COARSE, GroundState.SKIPPED)
        states = np.where(fine, GroundState.LOOKED_AT, states) * shown
        return states.astype(np.uint8).ravel()

    def cells(self) -> Cells | None:
        """The cells, those that were shown as the wanted ones; None where no ground was shown."""
        if self._grid is None:
            return None
        rows, columns = self._layers.shape[1:]
        return Cells(self._grid, self._left, self._top, columns, rows, self._layers[0].ravel())

    @property
    def _cell_m2(self) -> float:
        return 0.0 if self._grid is None else self._grid.grid.m_per_px**2

    def _within(self, outline_m: PointsM) -> tuple[tuple[slice, slice], Mask]:
        """The block of cells around an outline, and which of its cells lie within; an empty block far from all."""
        if self._grid is None:
            sides_m = np.linalg.norm(outline_m - np.roll(outline_m, 1, axis=0), axis=1)
            side_m = round_side_m(max(float(sides_m.min()) / _CELLS_ACROSS, 0.1))
            self._grid = SiteGrid.at(self._site.origin, side_m, self._site.crs)
        corners_px = self._grid.grid_from_site(outline_m)
        low = np.floor(corners_px.min(axis=0)).astype(int)
        high = np.ceil(corners_px.max(axis=0)).astype(int) + 1
        if not self._grow(low, high):
            return (slice(0, 0), slice(0, 0)), np.zeros((0, 0), bool)
        x, y = np.meshgrid(np.arange(low[0], high[0]), np.arange(low[1], high[1]))
        centres_px = np.column_stack([x.ravel(), y.ravel()]).astype(np.float64)
        inside = points_inside([corners_px], centres_px).reshape(x.shape)
        left, top = low - (self._left, self._top)
        return (slice(top, top + x.shape[0]), slice(left, left + x.shape[1])), inside

    def _grow(self, low: NDArray[np.int_], high: NDArray[np.int_]) -> bool:
        """Make the layers reach from pixel `low` to before `high`, (2,) each; not where that takes too many cells."""
        rows, columns = self._layers.shape[1:]
        if not rows:
            self._left, self._top = int(low[0]), int(low[1])
        spare = (high - low).max() if rows else 0
        left = max(0, self._left - int(low[0])) and self._left - int(low[0]) + spare
        top = max(0, self._top - int(low[1])) and self._top - int(low[1]) + spare
        right = max(0, int(high[0]) - self._left - columns)
        bottom = max(0, int(high[1]) - self._top - rows)
        right, bottom = right and right + spare, bottom and bottom + spare
        if (rows + top + bottom) * (columns + left + right) > _MOST_CELLS:
            return False
        if left or top or right or bottom:
            self._layers = np.pad(self._layers, ((0, 0), (top, bottom), (left, right)))
            self._left, self._top = self._left - left, self._top - top
        return True


def near_ground(outline_m: PointsM, camera_m: Floats) -> PointsM:
    """The outline (4, 2) of a frame with corners no farther than is looked at from a camera at `camera_m` (3,)."""
    reach_m = outline_m - camera_m[:2]
    far = np.linalg.norm(reach_m, axis=1, keepdims=True) / max(FARTHEST * float(camera_m[2]), 1e-3)
    return frozen(camera_m[:2] + reach_m / np.maximum(far, 1.0))
